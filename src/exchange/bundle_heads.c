/* bundle_heads.c: the first lines of a bundle, a campaign, or an evaluation with recordings, as
 * tables; and the controllers. See bundle_lines.c. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "exchange/bundle_line.h"
#include "exchange/values.h"
#include "store/fields.h"
#include "store/store.h"

/* ---- members with their own readers ---- */

static void read_id(struct mo_json *json, void *value)
{
  char digits[24] = "";
  char *end = NULL;
  int64_t *id = value;
  mo_line_text(json, digits, sizeof(digits));
  *id = strtoll(digits, &end, 10);
  if (*id < 1 || *end != '\0')
    mo_json_fault(json, "must be an id");
}

static void write_id(struct mo_text *text, const void *value)
{
  mo_text_format(text, "\"%lld\"", (long long)*(const int64_t *)value);
}

/* A label, preceded by a flag that says whether there is one. */
struct label {
  bool is_given;
  char text[MO_LABEL_BYTES_MAX + 1];
};
#define HAS_LABEL(type)                                                                            \
  (offsetof(type, label) == offsetof(type, has_label) + offsetof(struct label, text))
_Static_assert(HAS_LABEL(struct mo_imported_campaign) && HAS_LABEL(struct mo_imported_evaluation),
               "labels follow their flags");

static void read_label(struct mo_json *json, void *value)
{
  struct label *label = value;
  label->is_given = mo_json_peek(json) == MO_JSON_STRING;
  if (label->is_given)
    mo_line_text(json, label->text, sizeof(label->text));
  else
    mo_json_skip(json);
  if (mo_utf8_length(label->text, strlen(label->text)) > MO_LABEL_BYTES_MAX / 4)
    mo_json_fault(json, "the text is too long");
}

static void write_label(struct mo_text *text, const void *value)
{
  const struct label *label = value;
  if (label->is_given)
    mo_text_json_string(text, label->text, strlen(label->text));
  else
    mo_text_add(text, "null");
}

static void read_generation(struct mo_json *json, void *value)
{
  mo_json_integer(json, -1, MO_GENERATIONS_MAX, value);
}

static void write_generation(struct mo_text *text, const void *value)
{
  mo_text_format(text, "%lld", (long long)*(const int64_t *)value);
}

static void write_null(struct mo_text *text, const void *value)
{
  (void)value;
  mo_text_add(text, "null");
}

static void write_physics_hash(struct mo_text *text, const void *value)
{
  const struct mo_campaign_settings *settings = value;
  struct mo_sha256 physics;
  mo_physics_hash(&settings->physics, MO_FLOAT32, settings->sensor, &physics);
  mo_hash_field.write(text, &physics);
}

static void read_settings(struct mo_json *json, void *value)
{
  struct mo_campaign_record *record = value;
  struct mo_message words = {""};
  mo_json_peek(json);
  const size_t from = json->at;
  mo_json_skip(json);
  char *text = strndup(json->text + from, json->at - from);
  if (text == NULL || mo_settings_read(MO_JOB_CAMPAIGN, text, record) != MO_OK)
    mo_json_fault(json, "not the settings of a campaign");
  else if (mo_campaign_settings_check(&record->settings, &words) != MO_OK)
    mo_json_fault(json, "%s", words.text);
  free(text);
}

static void write_settings(struct mo_text *text, const void *value)
{
  mo_settings_write(MO_JOB_CAMPAIGN, value, text);
}

static const struct mo_field_own id = {.read = read_id, .write = write_id},
                                 label = {.read = read_label, .write = write_label},
                                 newest = {.read = read_generation, .write = write_generation},
                                 no_name = {.read = mo_line_skip, .write = write_null},
                                 physics = {.read = mo_line_skip, .write = write_physics_hash},
                                 settings = {.read = read_settings, .write = write_settings};

/* A member of 64 bits has the range of a seed: 0 to 2^53 − 1. */
#define LONG MO_FIELD_SEED
#define NULL_TEXT(member, most)                                                                    \
  MO_FIELD_TEXT, MO_FIELD_NULL | MO_FIELD_UTF8, AT(member), .max = 0.25 * (most)
#define TEXT(member) AT(member), .max = sizeof(((STRUCT *)NULL)->member) - 1

/* ---- the bundle ---- */

#define FORMAT "morphod-bundle"

static void read_campaigns(struct mo_json *json, void *value)
{
  struct mo_bundle_head *head = value;
  if (!mo_json_array(json))
    return;
  while (mo_json_item(json))
    if (head->n < MO_BUNDLE_CAMPAIGNS)
      read_id(json, &head->campaigns[head->n++]);
    else
      mo_json_skip(json);
}

static void write_campaigns(struct mo_text *text, const void *value)
{
  const struct mo_bundle_head *head = value;
  mo_text_add(text, "[");
  for (uint32_t i = 0; i < head->n; i++) {
    mo_text_add(text, i > 0 ? "," : "");
    write_id(text, &head->campaigns[i]);
  }
  mo_text_add(text, "]");
}

static const struct mo_field_own campaigns = {.read = read_campaigns, .write = write_campaigns};
#define STRUCT     struct mo_bundle_head
#define AT(member) offsetof(STRUCT, member)
static const struct mo_field head_rows[] = {
    {"format", MO_FIELD_TEXT, 0, TEXT(format)},
    {"version", MO_FIELD_COUNT, 0, AT(version), .max = UINT32_MAX},
    {"program", MO_FIELD_TEXT, 0, TEXT(program)},
    {"campaigns", MO_FIELD_OWN, 0, 0, .own = &campaigns},
};
const struct mo_fields mo_bundle_head_fields = MO_FIELDS(head_rows);
#undef AT
#undef STRUCT

static int check_head(const void *any, struct mo_message *message)
{
  const struct mo_bundle_head *head = any;
  if (strcmp(head->format, FORMAT) != 0)
    return mo_fail(message, MO_ERR_FORMAT, "/format: must be \"" FORMAT "\"");
  for (uint32_t i = 1; i < head->n; i++)
    if (head->campaigns[i] <= head->campaigns[i - 1])
      return mo_fail(message, MO_ERR_FORMAT, "/campaigns: must be in ascending order");
  return MO_OK;
}

int mo_bundle_read_head(struct mo_bundle_lines *lines, const char *line, size_t size,
                        struct mo_bundle_head *head, struct mo_message *message)
{
  static const char begin[] = "{\"format\":\"" FORMAT "\",\"version\":";
  memset(head, 0, sizeof(*head));
  if (strncmp(line, begin, strlen(begin)) != 0)
    return mo_fail(message, MO_ERR_FORMAT, "not a bundle");
  if (strtoul(line + strlen(begin), NULL, 10) != MO_BUNDLE_VERSION)
    return mo_fail(message, MO_ERR_FORMAT,
                   "the format has version %.10s; this program reads version %d",
                   line + strlen(begin), MO_BUNDLE_VERSION);
  return mo_line_read(lines, line, size, &mo_bundle_head_fields, head, check_head, message);
}

/* ---- campaigns ---- */

#define STRUCT     struct mo_imported_campaign
#define AT(member) offsetof(STRUCT, member)

/* The controllers at the beginning and the end of the campaign, or null. A bundle has no name for
 * the second one. */
#define IN(first, member) (AT(member) - AT(first))
static const struct mo_field start_rows[] = {
    {"name", MO_FIELD_TEXT, MO_FIELD_NULL, IN(has_controller, controller_name),
     .max = sizeof(((STRUCT *)NULL)->controller_name) - 1},
    {"sha256", MO_FIELD_OWN, 0, IN(has_controller, controller_sha256), .own = &mo_hash_field},
};
static const struct mo_field result_rows[] = {
    {"name", MO_FIELD_OWN, 0, 0, .own = &no_name},
    {"sha256", MO_FIELD_OWN, 0, IN(has_result, result_sha256), .own = &mo_hash_field},
};
#undef IN
static const struct mo_fields start = MO_FIELDS(start_rows), result = MO_FIELDS(result_rows);

static const struct mo_field campaign_source_rows[] = {
    {"store", MO_FIELD_OWN, 0, offsetof(struct mo_import_source, store), .own = &mo_line_store},
    {"campaign", MO_FIELD_OWN, 0, offsetof(struct mo_import_source, job), .own = &id},
};
static const struct mo_fields campaign_source = MO_FIELDS(campaign_source_rows);
static const struct mo_field campaign_rows[] = {
    {"source", MO_FIELD_GROUP, 0, AT(source), .group = &campaign_source},
    {"group", MO_FIELD_OWN, 0, AT(record.group), .own = &id},
    {"replicate", MO_FIELD_COUNT, 0, AT(record.replicate), .max = MO_REPLICATES_MAX},
    {"replicates", MO_FIELD_COUNT, 0, AT(record.replicates), .max = MO_REPLICATES_MAX},
    {"state", MO_FIELD_WORD, 0, AT(state), .words = mo_job_state_words},
    {"end", MO_FIELD_COUNT, 0, AT(end), .max = MO_CAMPAIGN_EXHAUSTED},
    {"label", MO_FIELD_OWN, 0, AT(has_label), .own = &label},
    {"experiment", NULL_TEXT(experiment, MO_EXPERIMENT_BYTES_MAX)},
    {"note", NULL_TEXT(note, MO_NOTE_BYTES_MAX)},
    {"weight", MO_FIELD_NUMBER, 0, AT(weight), .min = MO_WEIGHT_MIN, .max = MO_WEIGHT_MAX},
    {"back_end", MO_FIELD_COUNT, 0, AT(back_end), .max = MO_ON_DEVICE},
    {"created_us", LONG, 0, AT(created_us)},
    {"started_us", LONG, 0, AT(started_us)},
    {"finished_us", LONG, 0, AT(finished_us)},
    {"preset", MO_FIELD_TEXT, 0, TEXT(record.preset)},
    {"name", MO_FIELD_TEXT, 0, TEXT(record.name)},
    {"controller", MO_FIELD_GROUP, MO_FIELD_NULL, AT(has_controller), .group = &start},
    {"result", MO_FIELD_GROUP, MO_FIELD_NULL, AT(has_result), .group = &result},
    {"environment_set", MO_FIELD_TEXT, 0, TEXT(record.environment_set)},
    {"environments", MO_FIELD_COUNT, 0, AT(record.n_environments), .max = MO_ENVIRONMENTS_MAX},
    {"listed", MO_FIELD_COUNT, 0, AT(record.n_listed), .max = MO_POPULATION_MAX},
    {"generation", MO_FIELD_OWN, 0, AT(generation), .own = &newest},
    {"designs", LONG, 0, AT(n_designs)},
    {"diversity_max", MO_FIELD_NUMBER, 0, AT(diversity_max), .max = 1},
    {"physics_sha256", MO_FIELD_OWN, 0, AT(record.settings), .own = &physics},
    {"settings", MO_FIELD_OWN, 0, AT(record), .own = &settings},
};
const struct mo_fields mo_bundle_campaign_fields = MO_FIELDS(campaign_rows);
#undef AT
#undef STRUCT

static int check_campaign(const void *any, struct mo_message *message)
{
  const struct mo_imported_campaign *campaign = any;
  const struct mo_campaign_record *record = &campaign->record;
  const uint32_t generations = record->settings.generations;
  if (campaign->state != MO_JOB_SUCCEEDED && campaign->state != MO_JOB_CANCELLED)
    return mo_fail(message, MO_ERR_FORMAT, "/state: the campaign must have ended");
  if ((campaign->state == MO_JOB_SUCCEEDED) != (campaign->end != MO_CAMPAIGN_OPEN))
    return mo_fail(message, MO_ERR_FORMAT, "/end: contradicts the state");
  if (record->replicates < 1 || record->replicate >= record->replicates)
    return mo_fail(message, MO_ERR_FORMAT, "/replicate: must be below the number of replicates");
  if (record->n_environments < 1 || record->n_listed > record->settings.population)
    return mo_fail(message, MO_ERR_FORMAT, "/environments, /listed: too few or too many");
  if (campaign->generation > generations || campaign->n_designs > MO_CAMPAIGN_DESIGNS_MAX ||
      (campaign->generation < 0) != (campaign->n_designs == 0))
    return mo_fail(message, MO_ERR_FORMAT, "/generation: contradicts the settings or the designs");
  if (mo_word_index(mo_preset_words, record->preset) < 0 && record->preset[0] != '\0')
    return mo_fail(message, MO_ERR_FORMAT, "/preset: unknown preset");
  if ((record->name[0] != '\0' && mo_controller_name_check(record->name) != MO_OK) ||
      (campaign->controller_name[0] != '\0' &&
       mo_controller_name_check(campaign->controller_name) != MO_OK))
    return mo_fail(message, MO_ERR_FORMAT, "/name: must be a controller's name");
  if (!mo_modes[record->settings.mode].makes_children)
    return mo_fail(message, MO_ERR_FORMAT, "/settings/mode: a bundle cannot hold studies");
  if (!campaign->has_controller && !mo_modes[record->settings.mode].starts_untrained)
    return mo_fail(message, MO_ERR_FORMAT, "/controller: this mode requires one");
  if (record->measures != 0 && campaign->back_end == MO_ON_DEVICE)
    return mo_fail(message, MO_ERR_FORMAT, "/back_end: devices compute no measures");
  return MO_OK;
}

int mo_bundle_read_campaign(struct mo_bundle_lines *lines, const char *line, size_t size,
                            struct mo_imported_campaign *campaign, struct mo_message *message)
{
  memset(campaign, 0, sizeof(*campaign));
  return mo_line_read(lines, line, size, &mo_bundle_campaign_fields, campaign, check_campaign,
                      message);
}

void mo_bundle_digest_source(struct mo_text *digest, const struct mo_import_source *source,
                             int64_t created_us)
{
  mo_text_format(digest, "%016llx %lld %lld\n", (unsigned long long)source->store,
                 (long long)source->job, (long long)created_us);
}

/* ---- evaluations with recordings ---- */

static void read_environments(struct mo_json *json, void *value)
{
  struct mo_imported_evaluation *evaluation = value;
  mo_json_counts(json, MO_ENVIRONMENTS_MAX - 1, evaluation->environments, MO_ENVIRONMENTS_MAX,
                 &evaluation->n_environments);
}

static void write_environments(struct mo_text *text, const void *value)
{
  const struct mo_imported_evaluation *evaluation = value;
  mo_text_counts(text, evaluation->environments, evaluation->n_environments);
}

static void read_numbers(struct mo_json *json, void *value)
{
  struct mo_imported_evaluation *evaluation = value;
  mo_json_counts(json, UINT32_MAX - 1, evaluation->numbers, MO_DESIGNS_MAX, &evaluation->n_designs);
}

static void write_numbers(struct mo_text *text, const void *value)
{
  const struct mo_imported_evaluation *evaluation = value;
  mo_text_counts(text, evaluation->numbers, evaluation->n_designs);
}

static const struct mo_field_own environments = {.read = read_environments,
                                                 .write = write_environments},
                                 numbers = {.read = read_numbers, .write = write_numbers};
#define STRUCT     struct mo_imported_evaluation
#define AT(member) offsetof(STRUCT, member)
static const struct mo_field evaluation_source_rows[] = {
    {"store", MO_FIELD_OWN, 0, offsetof(struct mo_import_source, store), .own = &mo_line_store},
    {"evaluation", MO_FIELD_OWN, 0, offsetof(struct mo_import_source, job), .own = &id},
};
static const struct mo_fields evaluation_source = MO_FIELDS(evaluation_source_rows);
static const struct mo_field evaluation_rows[] = {
    {"source", MO_FIELD_GROUP, 0, AT(source), .group = &evaluation_source},
    {"label", MO_FIELD_OWN, 0, AT(has_label), .own = &label},
    {"experiment", NULL_TEXT(experiment, MO_EXPERIMENT_BYTES_MAX)},
    {"note", NULL_TEXT(note, MO_NOTE_BYTES_MAX)},
    {"back_end", MO_FIELD_COUNT, 0, AT(back_end), .max = MO_ON_DEVICE},
    {"created_us", LONG, 0, AT(created_us)},
    {"started_us", LONG, 0, AT(started_us)},
    {"finished_us", LONG, 0, AT(finished_us)},
    {"controller", MO_FIELD_TEXT, 0, TEXT(controller_name)},
    {"environment_set", MO_FIELD_TEXT, 0, TEXT(environment_set)},
    {"class", MO_FIELD_TEXT, 0, TEXT(fingerprint), .min = 1},
    {"workers_class", MO_FIELD_TEXT, 0, TEXT(workers)},
    {"record", MO_FIELD_COUNT, 0, AT(record), .min = 1, .max = (1 << MO_CHANNELS) - 1},
    {"stride", MO_FIELD_COUNT, 0, AT(stride), .min = 1, .max = UINT32_MAX},
    {"environments", MO_FIELD_OWN, 0, 0, .own = &environments},
    {"numbers", MO_FIELD_OWN, 0, 0, .own = &numbers},
};
const struct mo_fields mo_bundle_evaluation_fields = MO_FIELDS(evaluation_rows);
#undef AT
#undef STRUCT

static int check_evaluation(const void *any, struct mo_message *message)
{
  const struct mo_imported_evaluation *evaluation = any;
  if (evaluation->n_designs < 1 || evaluation->n_designs > MO_DESIGNS_MAX ||
      evaluation->n_environments < 1 || evaluation->n_environments > MO_ENVIRONMENTS_MAX)
    return mo_fail(message, MO_ERR_FORMAT, "/numbers, /environments: too few or too many");
  if (evaluation->controller_name[0] != '\0' &&
      mo_controller_name_check(evaluation->controller_name) != MO_OK)
    return mo_fail(message, MO_ERR_FORMAT, "/controller: must be a controller's name");
  return MO_OK;
}

int mo_bundle_read_evaluation(struct mo_bundle_lines *lines, const char *line, size_t size,
                              struct mo_imported_evaluation *evaluation, struct mo_message *message)
{
  char source[160];
  memset(evaluation, 0, sizeof(*evaluation));
  const int error = mo_line_read(lines, line, size, &mo_bundle_evaluation_fields, evaluation,
                                 check_evaluation, message);
  snprintf(source, sizeof(source), "evaluation %016llx %lld %lld %lld %lld",
           (unsigned long long)evaluation->source.store, (long long)evaluation->source.job,
           (long long)evaluation->created_us, (long long)evaluation->started_us,
           (long long)evaluation->finished_us);
  mo_sha256_of(source, strlen(source), &evaluation->source.digest);
  return error;
}

/* ---- controllers ---- */

int mo_bundle_read_weights(const struct mo_archive_member *member,
                           struct mo_controller **controller, struct mo_message *message)
{
  struct mo_message words = {""};
  char name[MO_ARCHIVE_NAME_BYTES];
  mo_bundle_weights_name(&member->sha256, name);
  if (strcmp(name, member->name) != 0)
    return mo_archive_refuse(member, 0, "the name must be the hash of the file", message);
  const int error =
      mo_controller_decode((const uint8_t *)member->bytes, member->size, controller, &words);
  return error == MO_OK || error == MO_ERR_NO_MEMORY
             ? error
             : mo_archive_refuse(member, 0, words.text, message);
}

void mo_bundle_weights_name(const struct mo_sha256 *sha256, char name[MO_ARCHIVE_NAME_BYTES])
{
  snprintf(name, MO_ARCHIVE_NAME_BYTES, "controllers/%s.safetensors", MO_SHA256_HEX(sha256));
}
