/* campaign_request.c: the body of POST /v1/campaigns.
 *
 * The defaults depend on mode and preset. A first pass over the text finds these two; a second pass
 * reads all members over their defaults. Checks that involve several fields come last. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/requests.h"
#include "base/text.h"
#include "store/fields.h"

/* ---- members of their own ---- */

static void read_learning(struct mo_json *json, void *value)
{
  struct mo_parsed_campaign *parsed = value;
  parsed->has_learning = true;
  mo_fields_read(json, &mo_campaign_record_learning_fields, &parsed->request.record);
}

static void read_initial(struct mo_json *json, void *value)
{
  static const char words[] = "\"random\", or an object with designs or campaign, is expected";
  struct mo_parsed_campaign *parsed = value;
  enum mo_json_kind next = mo_json_peek(json);
  unsigned depth = json->depth, ways = 0;
  struct mo_json_slice key;
  if (next == MO_JSON_STRING) {
    if (mo_json_string(json, &key) && !mo_json_is(key, "random"))
      mo_json_fault_at(json, depth, "", "%s", words);
    return;
  }
  if (next != MO_JSON_OBJECT) {
    if (next != MO_JSON_NONE) {
      mo_json_fault(json, "%s", words);
      mo_json_skip(json);
    }
    return;
  }
  mo_json_object(json);
  while (mo_json_member(json, &key)) {
    if (mo_json_is(key, "designs")) {
      mo_designs_field.read(json, &parsed->parts);
    } else if (mo_json_is(key, "campaign")) {
      mo_read_job_id(json, "a campaign", &parsed->request.record.initial_campaign);
    } else {
      mo_fields_unknown(json, "designs or campaign", NULL);
      continue;
    }
    ways++;
  }
  if (!json->stop && ways != 1)
    mo_json_fault_at(json, depth, "",
                     "an initial population is random, or of exactly one of designs and campaign; "
                     "random bodies fill up what is missing");
}

/* Finds the size of the body in voxels along x, y, z; zeros for an empty body. */
static void extent(const struct mo_bits *bits, uint32_t size[3])
{
  const struct mo_workspace ours = MO_DEFAULT_WORKSPACE;
  uint32_t low[3] = {ours.nx, ours.ny, ours.nz}, high[3] = {0};
  for (uint32_t v = 0; v < MO_DEFAULT_VOXELS; v++) {
    if (!(bits->words[v >> 6] >> (v & 63) & 1))
      continue;
    const uint32_t at[3] = {v / (ours.ny * ours.nz), v / ours.nz % ours.ny, v % ours.nz};
    for (int axis = 0; axis < 3; axis++) {
      low[axis] = at[axis] < low[axis] ? at[axis] : low[axis];
      high[axis] = at[axis] + 1 > high[axis] ? at[axis] + 1 : high[axis];
    }
  }
  for (int axis = 0; axis < 3; axis++)
    size[axis] = high[axis] > low[axis] ? high[axis] - low[axis] : 0;
}

struct listed {
  struct mo_bits form;
  uint32_t place;
};

static int by_form(const void *a, const void *b)
{
  const struct listed *x = a, *y = b;
  int order = memcmp(&x->form, &y->form, sizeof(x->form));
  return order != 0 ? order : x->place < y->place ? -1 : x->place > y->place;
}

/* Adds faults for designs that do not fit the campaign's workspace or repeat an earlier one.
 * Designs with faults of their own are empty here. */
static int check_listed(struct mo_json *json, const struct mo_parsed_campaign *parsed)
{
  const struct mo_workspace workspace = parsed->request.record.settings.workspace;
  const uint32_t n_designs = parsed->parts.n_designs;
  struct listed *listed = malloc(n_designs * sizeof(*listed));
  uint32_t *first = malloc(n_designs * sizeof(*first)); /* place of the first one with this form */
  uint32_t n = 0;
  char below[40];
  const bool memory = listed != NULL && first != NULL;
  for (uint32_t i = 0; i < n_designs && memory; i++) {
    uint32_t size[3];
    snprintf(below, sizeof(below), "/initial/designs/%u", i);
    extent(&parsed->parts.genotypes[i], size);
    first[i] = i;
    if (size[0] > workspace.nx || size[1] > workspace.ny || size[2] > workspace.nz)
      mo_json_fault_at(
          json, 0, below,
          "the body takes %u × %u × %u voxels; the workspace of the campaign has %u × %u × %u",
          size[0], size[1], size[2], workspace.nx, workspace.ny, workspace.nz);
    else if (size[0] > 0) {
      mo_genotype_canonical(MO_DEFAULT_WORKSPACE, parsed->parts.genotypes[i].words,
                            listed[n].form.words);
      listed[n++].place = i;
    }
  }
  if (n > 0)
    qsort(listed, n, sizeof(*listed), by_form);
  for (uint32_t i = 1; i < n; i++)
    if (memcmp(&listed[i].form, &listed[i - 1].form, sizeof(listed[i].form)) == 0)
      first[listed[i].place] = first[listed[i - 1].place];
  for (uint32_t i = 0; i < n_designs && memory; i++)
    if (first[i] != i) {
      snprintf(below, sizeof(below), "/initial/designs/%u", i);
      mo_json_fault_at(
          json, 0, below,
          "the design is given twice: it has the form of design %u; each design is born once",
          first[i]);
    }
  free(listed);
  free(first);
  return memory ? MO_OK : MO_ERR_NO_MEMORY;
}

/* ---- the whole ---- */

#define AT(member) offsetof(struct mo_parsed_campaign, member)
static const struct mo_field_own initial = {.read = read_initial};
static const struct mo_field_own learning = {.read = read_learning};
static const struct mo_field rows[] = {
    {"mode", MO_FIELD_WORD, 0, AT(mode), .words = mo_campaign_mode_words},
    {"preset", MO_FIELD_WORD, 0, AT(preset), .words = mo_preset_words},
    {"replicates", MO_FIELD_COUNT, 0, AT(request.record.replicates), .min = 1,
     .max = MO_REPLICATES_MAX, .unit = "campaigns", .help = "campaigns that differ in their seeds"},
    {"name", MO_FIELD_OWN, 0, AT(request.record.name), .own = &mo_name_field},
    {"environments", MO_FIELD_OWN, 0, AT(parts), .own = &mo_environments_field},
    {"initial", MO_FIELD_OWN, 0, 0, .own = &initial},
    {"learning", MO_FIELD_OWN, 0, 0, .own = &learning},
    {NULL, MO_FIELD_INLINE, 0, AT(parts), .group = &mo_parts_fields},
    {NULL, MO_FIELD_INLINE, 0, AT(request.record), .group = &mo_campaign_record_fields},
};
#undef AT
const struct mo_fields mo_campaign_request_fields = MO_FIELDS(rows);

/* Checks what depends on the mode. */
static void check_mode(struct mo_json *json, const struct mo_parsed_campaign *parsed)
{
  enum mo_campaign_mode mode = parsed->request.record.settings.mode;
  const struct mo_parts *parts = &parsed->parts;
  bool random = mode == MO_SIMULTANEOUS && (!parts->has_controller || parts->no_controller);
  if (mode != MO_SIMULTANEOUS && parts->no_controller)
    mo_json_fault_at(json, 0, "/controller",
                     "null is given; a %s campaign needs a controller: its name, or sha256: and 64 "
                     "hexadecimal digits, is expected",
                     mo_campaign_mode_words[mode]);
  if (mode == MO_ZERO_SHOT && parsed->has_learning)
    mo_json_fault_at(json, 0, "/learning",
                     "nothing learns in a zero-shot campaign; settings of learning are expected of "
                     "few-shot and simultaneous only");
  else if (parsed->has_sensor && !random)
    mo_json_fault_at(
        json, 0, "/learning/sensor",
        "the campaign starts from a controller, which has its sensor; none is expected here");
  if (mode == MO_ZERO_SHOT && parsed->request.record.name[0] != '\0')
    mo_json_fault_at(json, 0, "/name",
                     "a zero-shot campaign gives no controller; a name for it is expected of "
                     "few-shot and simultaneous only");
}

/* Checks the sizes of a campaign that learns. */
static void check_learning(struct mo_json *json, const struct mo_campaign_settings *settings)
{
  const uint64_t of_both = (uint64_t)settings->parent_steps + settings->child_steps;
  const uint64_t steps = settings->child_steps + of_both * settings->generations;
  if (settings->population > MO_TRAINING_DESIGNS_MAX)
    mo_json_fault_at(json, 0, "/population",
                     "%u is given; at most %d are expected of a campaign that learns",
                     settings->population, MO_TRAINING_DESIGNS_MAX);
  if (of_both == 0)
    mo_json_fault_at(json, 0, "/learning",
                     "neither parent_steps nor child_steps is above 0; a campaign that learns "
                     "takes a step in each generation");
  if (settings->mode == MO_SIMULTANEOUS && steps > MO_TRAINING_STEPS_MAX)
    mo_json_fault_at(
        json, 0, "/learning",
        "%llu steps of learning are asked for in all generations together; at most %d are expected",
        (unsigned long long)steps, MO_TRAINING_STEPS_MAX);
}

/* Checks what depends on several fields. The sensor is negative unless it was given. */
static int check(struct mo_json *json, void *any)
{
  struct mo_parsed_campaign *parsed = any;
  const struct mo_campaign_record *record = &parsed->request.record;
  const struct mo_campaign_settings *settings = &record->settings;
  const uint32_t n_listed = parsed->parts.n_designs;
  uint64_t designs = (uint64_t)settings->population * ((uint64_t)settings->generations + 1);
  parsed->has_sensor = (int)settings->sensor >= 0;
  if (!parsed->has_mode)
    mo_json_fault_at(json, 0, "",
                     "mode is missing: \"zero-shot\", \"few-shot\" or \"simultaneous\"");
  if (parsed->mode >= 0)
    check_mode(json, parsed);
  if (designs > MO_CAMPAIGN_DESIGNS_MAX)
    mo_json_fault_at(json, 0, "/generations",
                     "%u designs in each of %u generations and the initial population are %llu; at "
                     "most %llu are expected",
                     settings->population, settings->generations, (unsigned long long)designs,
                     (unsigned long long)MO_CAMPAIGN_DESIGNS_MAX);
  if (settings->mode != MO_ZERO_SHOT)
    check_learning(json, settings);
  if (settings->seed + record->replicates - 1 > (uint64_t)MO_SEED_MAX)
    mo_json_fault_at(json, 0, "/seed", "the seeds of %u replicates from %llu on go beyond %lld",
                     record->replicates, (unsigned long long)settings->seed,
                     (long long)MO_SEED_MAX);
  if (n_listed > settings->population)
    mo_json_fault_at(json, 0, "/initial/designs",
                     "%u designs are given; at most the population, which is %u, is expected",
                     n_listed, settings->population);
  return n_listed > 0 ? check_listed(json, parsed) : MO_OK;
}

int mo_campaign_parse(const char *text, size_t size, struct mo_parsed_campaign *parsed,
                      struct mo_faults *faults)
{
  struct mo_campaign_request *request = &parsed->request;
  struct mo_campaign_record *record = &request->record;
  struct mo_parts *parts = &parsed->parts;
  struct mo_message message = {""};
  *parsed = (struct mo_parsed_campaign){
      .parts = {.priority = MO_BATCH, .weight = 1}, .mode = -1, .preset = MO_PRESET_WORKSTATION};
  mo_read_words(text, size, &(struct mo_fields){rows, 2}, parsed, &parsed->has_mode);
  const enum mo_campaign_mode mode =
      parsed->mode >= 0 ? (enum mo_campaign_mode)parsed->mode : MO_ZERO_SHOT;
  const enum mo_preset preset = (enum mo_preset)parsed->preset;
  *record = (struct mo_campaign_record){
      .settings = mo_campaign_preset(mode, preset), .replicates = 1, .checkpoint_every_s = 60};
  snprintf(record->preset, sizeof(record->preset), "%s", mo_preset_words[preset]);
  const enum mo_sensor sensor = record->settings.sensor;
  record->settings.sensor = (enum mo_sensor) - 1;
  int error = mo_read_body(text, size, &mo_campaign_request_fields, parsed, parts, check, faults);
  if ((int)record->settings.sensor < 0)
    record->settings.sensor = sensor;
  if (mode != MO_SIMULTANEOUS && !parts->has_controller)
    memcpy(parts->controller, "default", sizeof("default"));
  if (error == MO_OK && mo_campaign_settings_check(&record->settings, &message) != MO_OK) {
    mo_faults_add(faults, MO_FAULT_BODY, "", "%s", message.text);
    error = MO_ERR_INVALID;
  }
  request->controller = mo_parts_controller(parts);
  request->priority = parts->priority;
  request->back_end = mo_parts_back_end(parts);
  request->weight = parts->weight;
  request->label = parts->has_label ? parts->label : NULL;
  request->genotypes = parts->genotypes;
  record->n_listed = parts->n_designs;
  request->environments = parts->environments;
  record->n_environments = parts->n_environments;
  if (parts->environments == NULL)
    snprintf(record->environment_set, sizeof(record->environment_set), "paper-test");
  return error;
}

/* ---- small bodies ---- */

static int check_extension(struct mo_json *json, void *generations)
{
  if (*(uint32_t *)generations == 0 && json->faults->n == 0)
    mo_json_fault_at(json, 0, "", "generations is missing: a positive integer");
  return MO_OK;
}

int mo_extension_parse(const char *text, size_t size, uint32_t *generations,
                       struct mo_faults *faults)
{
  static const struct mo_field extension[] = {
      {"generations", MO_FIELD_COUNT, 0, 0, .min = 1, .max = MO_GENERATIONS_MAX}};
  static const struct mo_fields of_extension = MO_FIELDS(extension);
  *generations = 0;
  return mo_read_body(text, size, &of_extension, generations, NULL, check_extension, faults);
}

int mo_champions_parse(const char *text, size_t size, struct mo_champions_request *asked,
                       struct mo_faults *faults)
{
  static const struct mo_field champions[] = {
      {"count", MO_FIELD_COUNT, 0, offsetof(struct mo_champions_request, count), .min = 1,
       .max = MO_CHAMPIONS_MAX},
      {"record", MO_FIELD_OWN, 0, offsetof(struct mo_champions_request, record),
       .own = &mo_channels_field},
      {"stride", MO_FIELD_COUNT, 0, offsetof(struct mo_champions_request, stride), .min = 1,
       .max = MO_STEPS_MAX}};
  static const struct mo_fields of_champions = MO_FIELDS(champions);
  return mo_read_body(text, size, &of_champions, asked, NULL, NULL, faults);
}

static int check_weight(struct mo_json *json, void *weight)
{
  if (isnan(*(double *)weight) && json->faults->n == 0)
    mo_json_fault_at(json, 0, "", "weight is missing: a number from %s to %s",
                     MO_NUMBER(MO_WEIGHT_MIN), MO_NUMBER(MO_WEIGHT_MAX));
  return MO_OK;
}

int mo_weight_parse(const char *text, size_t size, double *weight, struct mo_faults *faults)
{
  *weight = NAN;
  return mo_read_body(text, size, &mo_weight_fields, weight, NULL, check_weight, faults);
}
