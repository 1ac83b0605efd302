/* campaign_request.c: see campaign_request.h.
 *
 * The defaults depend on mode and preset. A first pass over the text finds these two; a second pass
 * reads all members over their defaults. Checks that involve several fields come last. */
#include "api/campaign_request.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/request_parts.h"
#include "store/fields.h"

/* Members of a request besides the settings of the tables. */
#define OTHER_MEMBERS                                                                              \
  "mode, preset, replicates, controller, environments, initial, learning, name, label, priority, " \
  "weight, device"

/* Which members were given, where other members depend on that. */
struct given {
  bool mode, known_mode; /* known_mode: its word is valid */
  bool controller, no_controller, learning, sensor, name;
};

/* ---- words ---- */

static int find_mode(const char *word, int *value)
{
  enum mo_campaign_mode mode = MO_ZERO_SHOT;
  int code = mo_campaign_mode_from_name(word, &mode);
  *value = (int)mode;
  return code;
}

static int find_preset(const char *word, int *value)
{
  enum mo_preset preset = MO_PRESET_WORKSTATION;
  int code = mo_preset_from_name(word, &preset);
  *value = (int)preset;
  return code;
}

/* ---- learning ---- */

static void read_learning(struct mo_json *json, struct mo_campaign_record *record,
                          struct given *given)
{
  struct mo_json_slice key;
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    given->sensor |= mo_json_is(key, "sensor");
    if (!mo_fields_read_member(json, key, &mo_campaign_record_learning_fields, record))
      mo_fields_unknown(json, NULL, &mo_campaign_record_learning_fields);
  }
}

/* ---- the initial population ---- */

static int read_initial(struct mo_json *json, struct mo_parsed_campaign *parsed)
{
  struct mo_campaign_record *record = &parsed->request.record;
  enum mo_json_kind next = mo_json_peek(json);
  unsigned depth = json->depth, ways = 0;
  struct mo_json_slice key;
  int code = MO_OK;
  if (next == MO_JSON_STRING) {
    if (mo_json_string(json, &key) && !mo_json_is(key, "random"))
      mo_json_fault_at(json, depth, "",
                       "\"random\", or an object with designs or campaign, is expected");
    return MO_OK;
  }
  if (next != MO_JSON_OBJECT) {
    if (next != MO_JSON_NONE) {
      mo_json_fault(json, "\"random\", or an object with designs or campaign, is expected");
      mo_json_skip(json);
    }
    return MO_OK;
  }
  mo_json_object(json);
  while (code == MO_OK && mo_json_member(json, &key)) {
    if (mo_json_is(key, "designs")) {
      code = mo_read_designs(json, &parsed->genotypes, &record->n_listed);
    } else if (mo_json_is(key, "campaign")) {
      mo_read_job_id(json, "a campaign", &record->initial_campaign);
    } else {
      mo_read_unknown(json, "designs or campaign");
      continue;
    }
    ways++;
  }
  if (code == MO_OK && !json->stop && ways != 1)
    mo_json_fault_at(json, depth, "",
                     "an initial population is random, or of exactly one of designs and campaign; "
                     "what is missing is "
                     "filled up with random bodies");
  return code;
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
  uint32_t place, first; /* first: place of the first design with this form */
};

static int by_form(const void *a, const void *b)
{
  const struct listed *x = a, *y = b;
  int order = memcmp(&x->form, &y->form, sizeof(x->form));
  return order != 0 ? order : x->place < y->place ? -1 : x->place > y->place;
}

static int by_place(const void *a, const void *b)
{
  const struct listed *x = a, *y = b;
  return x->place < y->place ? -1 : x->place > y->place;
}

/* Adds faults for designs that do not fit the campaign's workspace or repeat an earlier one.
 * Designs with faults of their own are empty here. */
static int check_listed(struct mo_json *json, const struct mo_parsed_campaign *parsed)
{
  const struct mo_campaign_record *record = &parsed->request.record;
  const struct mo_workspace workspace = record->settings.workspace;
  uint32_t n = 0;
  struct listed *listed = malloc((record->n_listed + 1) * sizeof(*listed));
  if (listed == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < record->n_listed; i++) {
    uint32_t size[3];
    char below[40];
    snprintf(below, sizeof(below), "/initial/designs/%u", i);
    extent(&parsed->genotypes[i], size);
    if (size[0] > workspace.nx || size[1] > workspace.ny || size[2] > workspace.nz)
      mo_json_fault_at(
          json, 0, below,
          "the body takes %u × %u × %u voxels; the workspace of the campaign has %u × %u × %u",
          size[0], size[1], size[2], workspace.nx, workspace.ny, workspace.nz);
    else if (size[0] > 0) {
      mo_genotype_canonical(MO_DEFAULT_WORKSPACE, parsed->genotypes[i].words, listed[n].form.words);
      listed[n].place = listed[n].first = i;
      n++;
    }
  }
  qsort(listed, n, sizeof(*listed), by_form);
  for (uint32_t i = 1; i < n; i++)
    if (memcmp(&listed[i].form, &listed[i - 1].form, sizeof(listed[i].form)) == 0)
      listed[i].first = listed[i - 1].first;
  qsort(listed, n, sizeof(*listed), by_place);
  for (uint32_t i = 0; i < n; i++)
    if (listed[i].first != listed[i].place) {
      char below[40];
      snprintf(below, sizeof(below), "/initial/designs/%u", listed[i].place);
      mo_json_fault_at(
          json, 0, below,
          "the design is given twice: it has the form of design %u; each design is born once",
          listed[i].first);
    }
  free(listed);
  return MO_OK;
}

/* ---- the whole ---- */

/* Checks what depends on the mode. */
static void check_mode(struct mo_json *json, const struct mo_parsed_campaign *parsed,
                       const struct given *given)
{
  enum mo_campaign_mode mode = parsed->request.record.settings.mode;
  bool random = mode == MO_SIMULTANEOUS && (!given->controller || given->no_controller);
  if (mode != MO_SIMULTANEOUS && given->no_controller)
    mo_json_fault_at(json, 0, "/controller",
                     "null is given; a %s campaign needs a controller: its name, or sha256: and 64 "
                     "hexadecimal digits, "
                     "is expected",
                     mo_campaign_mode_name(mode));
  if (mode == MO_ZERO_SHOT && given->learning)
    mo_json_fault_at(
        json, 0, "/learning",
        "nothing learns in a zero-shot campaign; settings of learning are expected of few-shot and "
        "simultaneous alone");
  else if (given->sensor && !random)
    mo_json_fault_at(
        json, 0, "/learning/sensor",
        "the campaign starts from a controller, which has its sensor; none is expected here");
  if (mode == MO_ZERO_SHOT && given->name)
    mo_json_fault_at(json, 0, "/name",
                     "a zero-shot campaign gives no controller; a name for it is expected of "
                     "few-shot and simultaneous "
                     "alone");
}

/* Checks what depends on several fields. */
static int check_together(struct mo_json *json, const struct mo_parsed_campaign *parsed,
                          const struct given *given)
{
  const struct mo_campaign_record *record = &parsed->request.record;
  const struct mo_campaign_settings *settings = &record->settings;
  uint64_t designs = (uint64_t)settings->population * ((uint64_t)settings->generations + 1);
  uint64_t steps =
      settings->child_steps +
      ((uint64_t)settings->parent_steps + settings->child_steps) * settings->generations;
  if (!given->mode)
    mo_json_fault_at(json, 0, "",
                     "mode is missing: \"zero-shot\", \"few-shot\" or \"simultaneous\"");
  if (given->known_mode)
    check_mode(json, parsed, given);
  if (designs > MO_CAMPAIGN_DESIGNS_MAX)
    mo_json_fault_at(json, 0, "/generations",
                     "%u designs in each of %u generations and the initial population are %llu; at "
                     "most %llu are "
                     "expected",
                     settings->population, settings->generations, (unsigned long long)designs,
                     (unsigned long long)MO_CAMPAIGN_DESIGNS_MAX);
  if (settings->mode != MO_ZERO_SHOT && settings->population > MO_TRAINING_DESIGNS_MAX)
    mo_json_fault_at(json, 0, "/population",
                     "%u is given; at most %d are expected of a campaign that learns",
                     settings->population, MO_TRAINING_DESIGNS_MAX);
  if (settings->mode != MO_ZERO_SHOT && settings->parent_steps + settings->child_steps == 0)
    mo_json_fault_at(json, 0, "/learning",
                     "neither parent_steps nor child_steps is above 0; a campaign that learns "
                     "takes a step in each "
                     "generation");
  if (settings->mode == MO_SIMULTANEOUS && steps > MO_TRAINING_STEPS_MAX)
    mo_json_fault_at(json, 0, "/learning",
                     "%llu steps of learning are asked for in all generations together; at most %d "
                     "are expected",
                     (unsigned long long)steps, MO_TRAINING_STEPS_MAX);
  if (settings->seed + record->replicates - 1 > (uint64_t)MO_SEED_MAX)
    mo_json_fault_at(json, 0, "/seed", "the seeds of %u replicates from %llu on go beyond %lld",
                     record->replicates, (unsigned long long)settings->seed,
                     (long long)MO_SEED_MAX);
  if (record->n_listed > settings->population)
    mo_json_fault_at(json, 0, "/initial/designs",
                     "%u designs are given; at most the population, which is %u, is expected",
                     record->n_listed, settings->population);
  return record->n_listed > 0 ? check_listed(json, parsed) : MO_OK;
}

static void read_controller(struct mo_json *json, struct mo_parsed_campaign *parsed,
                            struct given *given)
{
  given->controller = true;
  if (mo_json_peek(json) == MO_JSON_NULL) {
    given->no_controller = true;
    mo_json_skip(json);
    return;
  }
  mo_read_controller(json, parsed->controller);
}

/* Reads a member that all jobs have. False: `key` is none of these. */
static bool read_job_field(struct mo_json *json, struct mo_json_slice key,
                           struct mo_parsed_campaign *parsed)
{
  struct mo_campaign_request *request = &parsed->request;
  int choice;
  if (mo_json_is(key, "label")) {
    if (mo_read_label(json, parsed->label))
      request->label = parsed->label;
  } else if (mo_json_is(key, "priority")) {
    if (mo_read_choice(json, "batch", "interactive", &choice))
      request->priority = choice ? MO_INTERACTIVE : MO_BATCH;
  } else if (mo_json_is(key, "device")) {
    mo_read_device(json, &request->back_end);
  } else if (mo_json_is(key, "weight")) {
    mo_read_weight(json, &request->weight);
  } else if (mo_json_is(key, "replicates")) {
    mo_read_count(json, 1, MO_REPLICATES_MAX, &request->record.replicates);
  } else {
    return false;
  }
  return true;
}

static int read_field(struct mo_json *json, struct mo_json_slice key,
                      struct mo_parsed_campaign *parsed, struct given *given)
{
  struct mo_campaign_record *record = &parsed->request.record;
  int word;
  if (mo_json_is(key, "mode")) {
    given->mode = true;
    given->known_mode =
        mo_read_word(json, find_mode, "\"zero-shot\", \"few-shot\" or \"simultaneous\"", &word);
  } else if (mo_json_is(key, "preset")) {
    mo_read_word(json, find_preset, "\"paper\", \"workstation\" or \"demo\"", &word);
  } else if (mo_json_is(key, "controller")) {
    read_controller(json, parsed, given);
  } else if (mo_json_is(key, "environments")) {
    return mo_read_environments(json, &parsed->environments, &record->n_environments);
  } else if (mo_json_is(key, "initial")) {
    return read_initial(json, parsed);
  } else if (mo_json_is(key, "learning")) {
    given->learning = true;
    read_learning(json, record, given);
  } else if (mo_json_is(key, "name")) {
    given->name = true;
    mo_read_name(json, record->name);
  } else if (!read_job_field(json, key, parsed) &&
             !mo_fields_read_member(json, key, &mo_campaign_record_fields, record)) {
    mo_fields_unknown(json, OTHER_MEMBERS, &mo_campaign_record_fields);
  }
  return MO_OK;
}

static int read_text(struct mo_json *json, const char *text, size_t size,
                     struct mo_parsed_campaign *parsed, struct mo_faults *faults)
{
  static const char *const keys[] = {"mode", "preset"};
  struct mo_campaign_record *record = &parsed->request.record;
  char words[2][MO_WORD_BYTES];
  enum mo_campaign_mode mode = MO_ZERO_SHOT;
  enum mo_preset preset = MO_PRESET_WORKSTATION;
  struct given given = {0};
  struct mo_message message = {""};
  struct mo_json_slice key;
  int code = mo_find_words(json, text, size, keys, words, 2);
  if (code != MO_OK)
    return code;
  if (mo_campaign_mode_from_name(words[0], &mode) != MO_OK)
    mode = MO_ZERO_SHOT; /* the second pass reports the fault */
  if (mo_preset_from_name(words[1], &preset) != MO_OK)
    preset = MO_PRESET_WORKSTATION;
  record->settings = mo_campaign_preset(mode, preset);
  snprintf(record->preset, sizeof(record->preset), "%s", mo_preset_name(preset));
  mo_json_start(json, text, size, faults);
  bool object = mo_json_object(json);
  if (object)
    while (code == MO_OK && mo_json_member(json, &key))
      code = read_field(json, key, parsed, &given);
  if (code == MO_OK && !json->stop && object)
    code = check_together(json, parsed, &given);
  if (code != MO_OK)
    return code;
  mo_json_finish(json);
  if (mode != MO_SIMULTANEOUS && !given.controller)
    memcpy(parsed->controller, "default", sizeof("default"));
  if (faults->malformed)
    return MO_ERR_FORMAT;
  if (faults->n == 0 && mo_campaign_settings_check(&record->settings, &message) != MO_OK)
    mo_faults_add(faults, MO_FAULT_BODY, "", "%s", message.text);
  return faults->n > 0 ? MO_ERR_INVALID : MO_OK;
}

int mo_campaign_parse(const char *text, size_t size, struct mo_parsed_campaign *parsed,
                      struct mo_faults *faults)
{
  *parsed = (struct mo_parsed_campaign){
      .request = {.priority = MO_BATCH,
                  .back_end = MO_BACK_END_AUTO,
                  .weight = 1,
                  .record = {.replicates = 1, .checkpoint_every_s = 60}}};
  struct mo_json *json = malloc(sizeof(*json));
  if (json == NULL)
    return MO_ERR_NO_MEMORY;
  struct mo_campaign_request *request = &parsed->request;
  int code = read_text(json, text, size, parsed, faults);
  free(json);
  if (code == MO_OK || code == MO_ERR_INVALID)
    request->controller = parsed->controller[0] != '\0' ? parsed->controller : NULL;
  if (code == MO_OK) {
    request->genotypes = parsed->genotypes;
    request->environments = parsed->environments;
    if (parsed->environments == NULL)
      snprintf(request->record.environment_set, sizeof(request->record.environment_set),
               "paper-test");
  }
  return code;
}

void mo_campaign_parsed_free(struct mo_parsed_campaign *parsed)
{
  free(parsed->genotypes);
  free(parsed->environments);
  *parsed = (struct mo_parsed_campaign){0};
}

/* ---- small bodies ---- */

/* Reads an object of counts. needed: a required key; nullable. */
struct count_field {
  const char *key;
  uint32_t min, max, *value;
};
static int read_counts(const char *text, size_t size, const struct count_field *fields, size_t n,
                       const char *needed, const char *expected, struct mo_faults *faults)
{
  struct mo_json *json = malloc(sizeof(*json));
  struct mo_json_slice key;
  bool found = needed == NULL;
  if (json == NULL)
    return MO_ERR_NO_MEMORY;
  mo_json_start(json, text, size, faults);
  if (mo_json_object(json)) {
    while (mo_json_member(json, &key)) {
      size_t i = 0;
      found |= needed != NULL && mo_json_is(key, needed);
      while (i < n && !mo_json_is(key, fields[i].key))
        i++;
      if (i < n)
        mo_read_count(json, fields[i].min, fields[i].max, fields[i].value);
      else
        mo_read_unknown(json, expected);
    }
    if (!json->stop && !found)
      mo_json_fault_at(json, 0, "", "%s is missing: a positive integer", needed);
  }
  mo_json_finish(json);
  free(json);
  return faults->malformed ? MO_ERR_FORMAT : faults->n > 0 ? MO_ERR_INVALID : MO_OK;
}

int mo_extension_parse(const char *text, size_t size, uint32_t *generations,
                       struct mo_faults *faults)
{
  const struct count_field fields[] = {{"generations", 1, MO_GENERATIONS_MAX, generations}};
  return read_counts(text, size, fields, 1, "generations", "generations", faults);
}

int mo_champions_parse(const char *text, size_t size, uint32_t *count, uint32_t *stride,
                       struct mo_faults *faults)
{
  const struct count_field fields[] = {{"count", 1, MO_CHAMPIONS_MAX, count},
                                       {"stride", 1, MO_STEPS_MAX, stride}};
  return read_counts(text, size, fields, 2, NULL, "count, stride", faults);
}
