/* training_request.c: see training_request.h.
 *
 * The defaults depend on kind and preset, and JSON members have no order. A first pass over the
 * text finds these two; a second pass reads all members over their defaults. Checks that involve
 * several fields come last. */
#include "api/training_request.h"

#include <stdlib.h>
#include <string.h>

#include "api/request_parts.h"
#include "store/fields.h"

/* Members of a request besides the settings of the table. */
#define OTHER_MEMBERS                                                                              \
  "kind, preset, name, controller, designs, population, priority, weight, device, label"

/* Which members were given, where other members depend on that. */
struct given {
  bool kind, controller, no_controller, sensor, designs, population;
  bool known_kind; /* kind is a valid word */
  bool object;     /* the body is an object, so fields can be missing */
  enum mo_learning_preset preset;
};

/* ---- the designs of another job ---- */

static void read_population(struct mo_json *json, struct mo_parsed_training *parsed)
{
  struct mo_training_request *request = &parsed->request;
  unsigned depth = json->depth, jobs = 0;
  struct mo_json_slice key;
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    bool campaign = mo_json_is(key, "campaign");
    if (campaign || mo_json_is(key, "evaluation")) {
      jobs++;
      parsed->population_kind = campaign ? MO_JOB_CAMPAIGN : MO_JOB_EVALUATION;
      mo_read_job_id(json, campaign ? "a campaign" : "an evaluation", &request->population);
    } else if (mo_json_is(key, "best")) {
      mo_read_count(json, 1, MO_TRAINING_DESIGNS_MAX, &request->population_best);
    } else {
      mo_read_unknown(json, "evaluation or campaign, best");
    }
  }
  if (!json->stop && jobs != 1)
    mo_json_fault_at(json, depth, "",
                     "a population is that of exactly one job: evaluation, the id of one whose "
                     "designs are learned "
                     "from, or campaign, the id of one whose newest population is");
}

/* ---- names ---- */

static void read_kind(struct mo_json *json, struct given *given)
{
  int choice;
  given->kind = true;
  given->known_kind = mo_read_choice(json, "pretrain", "finetune", &choice);
}

static int find_preset(const char *word, int *value)
{
  enum mo_learning_preset preset = MO_LEARNING_PRESET_WORKSTATION;
  int code = mo_learning_preset_from_name(word, &preset);
  *value = (int)preset;
  return code;
}

static void read_preset(struct mo_json *json, struct given *given)
{
  int preset;
  if (mo_read_word(json, find_preset, "\"workstation\", \"phototaxis\" or \"paper\"", &preset))
    given->preset = (enum mo_learning_preset)preset;
}

static void read_parent(struct mo_json *json, struct mo_parsed_training *parsed,
                        struct given *given)
{
  given->controller = true;
  if (mo_json_peek(json) == MO_JSON_NULL) {
    given->no_controller = true;
    mo_json_skip(json);
    return;
  }
  mo_read_controller(json, parsed->parent);
}

/* ---- the whole ---- */

/* Checks what depends on several fields. */
static void check_together(struct mo_json *json, struct mo_parsed_training *parsed,
                           const struct given *given)
{
  bool finetune = parsed->request.record.settings.kind == MO_TRAINING_FINETUNE;
  if (!given->kind)
    mo_json_fault_at(json, 0, "", "kind is missing: \"pretrain\" or \"finetune\"");
  if (!given->known_kind)
    return;
  if (finetune) {
    if (given->designs == given->population)
      mo_json_fault_at(json, 0, "",
                       "%s; a finetuning learns from exactly one of designs (a list) and "
                       "population (those of an "
                       "evaluation or a campaign)",
                       given->designs ? "both designs and population are given"
                                      : "neither designs nor population is given");
    if (given->no_controller)
      mo_json_fault_at(json, 0, "/controller",
                       "null is given; a finetuning starts from a controller: its name, or sha256: "
                       "and 64 hexadecimal "
                       "digits, is expected");
    if (given->preset == MO_LEARNING_PRESET_PHOTOTAXIS)
      mo_json_fault_at(json, 0, "/preset",
                       "\"phototaxis\" is how a controller was pretrained; \"workstation\" or "
                       "\"paper\" is expected of a "
                       "finetuning");
  } else {
    if (given->designs)
      mo_json_fault_at(
          json, 0, "/designs",
          "a pretraining draws bodies of its own; designs are expected of a finetuning alone");
    if (given->population)
      mo_json_fault_at(
          json, 0, "/population",
          "a pretraining draws bodies of its own; a population is expected of a finetuning alone");
    const struct mo_training_settings *settings = &parsed->request.record.settings;
    if ((uint64_t)settings->n_steps * settings->batch > MO_TRAINING_BODIES_MAX)
      mo_json_fault_at(json, 0, "/steps",
                       "%u steps of %u bodies are %llu; at most %llu distinct bodies are expected "
                       "of a pretraining",
                       settings->n_steps, settings->batch,
                       (unsigned long long)settings->n_steps * settings->batch,
                       (unsigned long long)MO_TRAINING_BODIES_MAX);
  }
  if (given->sensor && (finetune || (given->controller && !given->no_controller)))
    mo_json_fault_at(
        json, 0, "/sensor",
        "the training starts from a controller, which has its sensor; none is expected here");
}

static int read_request(struct mo_json *json, struct mo_parsed_training *parsed,
                        struct given *given)
{
  struct mo_training_request *request = &parsed->request;
  struct mo_training_record *record = &request->record;
  struct mo_json_slice key;
  int code = MO_OK, choice;
  given->object = mo_json_object(json);
  if (!given->object)
    return MO_OK;
  while (code == MO_OK && mo_json_member(json, &key)) {
    if (mo_json_is(key, "kind")) {
      read_kind(json, given);
    } else if (mo_json_is(key, "preset")) {
      read_preset(json, given);
    } else if (mo_json_is(key, "name")) {
      mo_read_name(json, record->name);
    } else if (mo_json_is(key, "controller")) {
      read_parent(json, parsed, given);
    } else if (mo_json_is(key, "designs")) {
      given->designs = true;
      code = mo_read_designs(json, &parsed->genotypes, &record->n_designs);
    } else if (mo_json_is(key, "population")) {
      given->population = true;
      read_population(json, parsed);
    } else if (mo_json_is(key, "priority")) {
      if (mo_read_choice(json, "batch", "interactive", &choice))
        request->priority = choice ? MO_INTERACTIVE : MO_BATCH;
    } else if (mo_json_is(key, "device")) {
      mo_read_device(json, &request->back_end);
    } else if (mo_json_is(key, "weight")) {
      mo_read_weight(json, &request->weight);
    } else if (mo_json_is(key, "label")) {
      if (mo_read_label(json, parsed->label))
        request->label = parsed->label;
    } else {
      given->sensor |= mo_json_is(key, "sensor");
      if (!mo_fields_read_member(json, key, &mo_training_record_fields, record))
        mo_fields_unknown(json, OTHER_MEMBERS, &mo_training_record_fields);
    }
  }
  return code;
}

static int read_text(struct mo_json *json, const char *text, size_t size,
                     struct mo_parsed_training *parsed, struct mo_faults *faults)
{
  struct mo_training_record *record = &parsed->request.record;
  struct given given = {0};
  struct mo_message message = {""};
  static const char *const keys[] = {"kind", "preset"};
  char words[2][MO_WORD_BYTES];
  int code = mo_find_words(json, text, size, keys, words, 2);
  if (code != MO_OK)
    return code;
  enum mo_training_kind kind =
      strcmp(words[0], "finetune") == 0 ? MO_TRAINING_FINETUNE : MO_TRAINING_PRETRAIN;
  enum mo_learning_preset preset = MO_LEARNING_PRESET_WORKSTATION;
  if (mo_learning_preset_from_name(words[1], &preset) != MO_OK)
    preset = MO_LEARNING_PRESET_WORKSTATION; /* the second pass reports the fault */
  record->settings = mo_training_preset(kind, preset);
  record->validate_every_steps = 50;
  record->checkpoint_every_s = 60;
  record->checkpoints_kept = 3;
  mo_json_start(json, text, size, faults);
  code = read_request(json, parsed, &given);
  if (code != MO_OK)
    return code;
  if (!json->stop && given.object)
    check_together(json, parsed, &given);
  mo_json_finish(json);
  if (kind == MO_TRAINING_FINETUNE && !given.controller)
    memcpy(parsed->parent, "default", sizeof("default"));
  if (faults->malformed)
    return MO_ERR_FORMAT;
  if (faults->n == 0 && mo_training_settings_check(&record->settings, &message) != MO_OK)
    mo_faults_add(faults, MO_FAULT_BODY, "", "%s", message.text);
  return faults->n > 0 ? MO_ERR_INVALID : MO_OK;
}

int mo_training_parse(const char *text, size_t size, struct mo_parsed_training *parsed,
                      struct mo_faults *faults)
{
  *parsed = (struct mo_parsed_training){
      .request = {.priority = MO_BATCH, .back_end = MO_BACK_END_AUTO, .weight = 1}};
  struct mo_json *json = malloc(sizeof(*json));
  if (json == NULL)
    return MO_ERR_NO_MEMORY;
  int code = read_text(json, text, size, parsed, faults);
  free(json);
  if (code == MO_OK || code == MO_ERR_INVALID)
    parsed->request.parent = parsed->parent[0] != '\0' ? parsed->parent : NULL;
  if (code == MO_OK)
    parsed->request.genotypes = parsed->genotypes;
  return code;
}

void mo_training_parsed_free(struct mo_parsed_training *parsed)
{
  free(parsed->genotypes);
  *parsed = (struct mo_parsed_training){0};
}
