/* The contract agrees with the tables: names, types, bounds, words and units of every setting, and
 * the columns of every numeric row. */
#include "unit/check.h"

#include <jansson.h>

#include "api/atlas_request.h"
#include "api/certificate_request.h"
#include "api/openapi.h"
#include "api/replicates.h"
#include "api/requests.h"
#include "rollout/physics.h"
#include "store/fields.h"
#include "world/environment.h"

static json_t *contract;

static const json_t *schema(const char *name)
{
  return json_object_get(json_object_get(json_object_get(contract, "components"), "schemas"), name);
}

/* Follows a reference; if the schema is "this or null", returns this. */
static const json_t *resolve(const json_t *node)
{
  const char *reference;
  while ((reference = json_string_value(json_object_get(node, "$ref"))) != NULL)
    node = schema(strrchr(reference, '/') + 1);
  const json_t *any = json_object_get(node, "anyOf"), *one;
  size_t i;
  json_array_foreach(any, i, one)
  {
    const char *type = json_string_value(json_object_get(one, "type"));
    if (type == NULL || strcmp(type, "null") != 0)
      return resolve(one);
  }
  return node;
}

static const json_t *property(const json_t *object, const char *name)
{
  return resolve(json_object_get(json_object_get(object, "properties"), name));
}

/* Returns whether the type of a schema is, or may be, this one. */
static bool has_type(const json_t *node, const char *wanted)
{
  const json_t *type = json_object_get(node, "type"), *one;
  size_t i;
  if (json_is_string(type))
    return strcmp(json_string_value(type), wanted) == 0;
  json_array_foreach(type, i, one)
  {
    if (strcmp(json_string_value(one), wanted) == 0)
      return true;
  }
  return false;
}

static bool has_number(const json_t *node, const char *key, double value)
{
  const json_t *number = json_object_get(node, key);
  return json_is_number(number) && json_number_value(number) == value;
}

/* Returns whether the name ends with its unit, if it has one of these. */
static bool tells_unit(const struct mo_field *field)
{
  static const char *const units[][2] = {{"_n_per_m", "N/m"}, {"_m_per_s2", "m/s^2"},
                                         {"_per_s", "1/s"},   {"_kg", "kg"},
                                         {"_m", "m"},         {"_s", "s"}};
  const char *unit = field->unit != NULL ? field->unit : "";
  for (size_t i = 0; i < sizeof(units) / sizeof(units[0]); i++) {
    size_t n = strlen(field->name), size = strlen(units[i][0]);
    if (n > size && strcmp(field->name + n - size, units[i][0]) == 0)
      return strcmp(unit, units[i][1]) == 0;
    if (strcmp(unit, units[i][1]) == 0)
      return false;
  }
  return true;
}

static bool has_words(const json_t *node, const char *const *words)
{
  const json_t *list = json_object_get(node, "enum");
  size_t n = 0;
  for (; words[n] != NULL; n++) {
    bool found = false;
    for (size_t i = 0; i < json_array_size(list); i++)
      found |= strcmp(json_string_value(json_array_get(list, i)), words[n]) == 0;
    if (!found)
      return false;
  }
  return json_array_size(list) == n;
}

/* Returns the object of a table. In a request, it is the second of two variants if the table has
 * words; the first has the words. */
static const json_t *object_of(const json_t *node, const struct mo_fields *fields, bool bounds)
{
  if (!bounds || fields->words == NULL)
    return node;
  const json_t *variants = json_object_get(node, "oneOf");
  CHECK(has_words(resolve(json_array_get(variants, 0)), fields->words->words));
  return resolve(json_array_get(variants, 1));
}

static size_t check_members(const json_t *object, const struct mo_fields *fields, bool bounds);

static bool agrees(const json_t *node, const struct mo_field *field, bool bounds)
{
  bool above = field->flags & MO_FIELD_ABOVE_MIN, below = field->flags & MO_FIELD_BELOW_MAX;
  double max = field->type == MO_FIELD_SEED ? (double)MO_SEED_MAX : field->max;
  switch (field->type) {
  case MO_FIELD_COUNT:
  case MO_FIELD_SEED:
  case MO_FIELD_NUMBER:
    if (!has_type(node, field->type == MO_FIELD_NUMBER ? "number" : "integer"))
      return false;
    return !bounds || (has_number(node, above ? "exclusiveMinimum" : "minimum", field->min) &&
                       has_number(node, below ? "exclusiveMaximum" : "maximum", max) &&
                       has_type(node, "null") == ((field->flags & MO_FIELD_NULL) != 0));
  case MO_FIELD_FLAG: return has_type(node, "boolean");
  case MO_FIELD_WORD: return has_type(node, "string") && has_words(node, field->words);
  case MO_FIELD_GROUP:
    node = object_of(node, field->group, bounds);
    return check_members(node, field->group, bounds) ==
           json_object_size(json_object_get(node, "properties"));
  default: return node != NULL; /* special types are described in words */
  }
}

/* Checks that each row of a table is a property and agrees with it. Returns the number of rows. */
static size_t check_members(const json_t *object, const struct mo_fields *fields, bool bounds)
{
  size_t n = 0;
  for (size_t i = 0; i < fields->n; i++) {
    const struct mo_field *field = &fields->rows[i];
    if (field->type == MO_FIELD_INLINE) {
      n += check_members(object, field->group, bounds);
      continue;
    }
    if (!agrees(property(object, field->name), field, bounds) || !tells_unit(field))
      printf("# %s disagrees\n", field->name);
    CHECK(agrees(property(object, field->name), field, bounds));
    CHECK(tells_unit(field));
    n++;
  }
  return n;
}

/* others: members that are not in the table. */
static void check_object(const char *name, const struct mo_fields *fields, size_t others,
                         bool bounds)
{
  const json_t *object = object_of(schema(name), fields, bounds);
  printf("# %s\n", name);
  CHECK_INT(check_members(object, fields, bounds) + others,
            json_object_size(json_object_get(object, "properties")));
}

static void begin(void)
{
  contract = json_loadb(mo_openapi_json, mo_openapi_json_size, JSON_REJECT_DUPLICATES, NULL);
  REQUIRE(contract != NULL);
}

static void requests(void)
{
  begin();
  check_object("PhysicsRequest", &mo_physics_fields, 0, true);
  CHECK(has_words(schema("EnvironmentSet"), mo_set_words));
  CHECK(has_words(schema("Suite"), mo_suite_words));
  CHECK(has_words(schema("SuiteTaskName"), mo_suite_task_words));
  check_object("EnvironmentRequest", &mo_place_fields, 7, true);
  check_object("EvaluationRequest", &mo_evaluation_request_fields, 0, true);
  check_object("TrainingRequest", &mo_training_request_fields, 0, true);
  check_object("CampaignRequest", &mo_campaign_request_fields, 0, true);
  check_object("CampaignLearningRequest", &mo_campaign_record_learning_fields, 0, true);
  check_object("WeightRequest", &mo_weight_fields, 0, true);
  check_object("AtlasRequest", &mo_atlas_request_fields, 0, true);
  check_object("CertificateRequest", &mo_certificate_request_fields, 0, true);
  check_object("TellRequest", &mo_tell_fields, 0, true);
  check_object("AskRequest", &mo_ask_fields, 0, true);
  check_object("RolloutsRequest", &mo_rollouts_request_fields, 0, true);
  check_object("RandomBodiesRequest", &mo_random_request_fields, 0, true);
  check_object("MutatedBodiesRequest", &mo_mutation_request_fields, 0, true);
  check_object("CrossedBodiesRequest", &mo_crossing_request_fields, 0, true);
  check_object("CanonicalBodiesRequest", &mo_canonical_request_fields, 0, true);
}

/* Settings have the same names in replies as in requests; optional ones are filled in. */
static void replies(void)
{
  check_object("Physics", &mo_physics_fields, 0, false);
  check_object("TrainingSettings", &mo_training_record_fields, 7, false);
  check_object("CampaignSettings", &mo_campaign_record_fields, 3, false);
  check_object("CampaignLearning", &mo_campaign_record_learning_fields, 0, false);
  check_object("CertificateSettings", &mo_certificate_fields, 11, false);
}

/* Counts the properties of an object that are not objects themselves, including nested ones. */
static size_t count_leaves(const json_t *object)
{
  const json_t *properties = json_object_get(object, "properties");
  if (properties == NULL)
    return 1;
  size_t n = 0;
  for (void *at = json_object_iter((json_t *)properties); at != NULL;
       at = json_object_iter_next((json_t *)properties, at))
    n += count_leaves(resolve(json_object_iter_value(at)));
  return n;
}

static void check_columns(const char *name, const struct mo_columns *columns)
{
  for (size_t i = 0; i < columns->n; i++) {
    const struct mo_column *column = &columns->items[i];
    const json_t *node = schema(name);
    char part[64];
    for (const char *path = column->path; *path != '\0'; path += *path == '.') {
      size_t size = strcspn(path, ".");
      snprintf(part, sizeof(part), "%.*s", (int)size, path);
      node = property(node, part);
      path += size;
    }
    const char *type = column->type == MO_COLUMN_FLAG     ? "boolean"
                       : column->type == MO_COLUMN_WORD   ? "string"
                       : column->type == MO_COLUMN_NUMBER ? "number"
                                                          : "integer";
    if (!has_type(node, type))
      printf("# %s %s disagrees\n", name, column->path);
    CHECK(has_type(node, type));
  }
  CHECK_INT(count_leaves(schema(name)), columns->n);
}

static void rows(void)
{
  check_columns("StepRow", &mo_step_columns);
  check_columns("ValidationRow", &mo_validation_columns);
  check_columns("GenerationRow", &mo_generation_columns);
  check_columns("CampaignStepRow", &mo_campaign_step_columns);
  check_columns("ReplicateRow", &mo_replicate_columns);
  json_decref(contract);
}

static const struct check_case cases[] = {
    {"requests", requests}, {"replies", replies}, {"rows of numbers", rows}};
CHECK_MAIN(cases)
