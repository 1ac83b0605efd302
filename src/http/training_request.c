/* training_request.c: see training_request.h.
 *
 * The defaults depend on kind and preset, and JSON has no order of members: a first pass over the
 * text finds these, a second reads everything over their defaults. What depends on several fields
 * is checked after the last of them. */
#include "http/training_request.h"

#include <stdlib.h>
#include <string.h>

#include "http/learning_parts.h"
#include "http/request_parts.h"

/* What was given, as far as other fields depend on it. */
struct given {
  bool kind, controller, no_controller, sensor, designs, population;
  bool known_kind; /* kind is one of its words */
  bool object;     /* the body is one: it has fields to speak of */
  enum mo_learning_preset preset;
};

/* ---- further groups of settings ---- */

static void read_validation(struct mo_json *json, struct mo_training_record *record)
{
  struct mo_training_settings *settings = &record->settings;
  struct mo_json_slice key;
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    if (mo_json_is(key, "every_steps"))
      mo_read_count(json, 0, MO_TRAINING_STEPS_MAX, &record->validate_every_steps);
    else if (mo_json_is(key, "designs"))
      mo_read_count(json, 1, MO_TRAINING_DESIGNS_MAX, &settings->held_out_designs);
    else if (mo_json_is(key, "environments"))
      mo_read_count(json, 1, MO_HELD_OUT_ENVIRONMENTS_MAX, &settings->held_out_environments);
    else
      mo_read_unknown(json, "every_steps, designs, environments");
  }
}

static void read_checkpoint(struct mo_json *json, struct mo_training_record *record)
{
  struct mo_json_slice key;
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    if (mo_json_is(key, "every_steps"))
      mo_read_count(json, 0, MO_TRAINING_STEPS_MAX, &record->checkpoint_every_steps);
    else if (mo_json_is(key, "every_s"))
      mo_read_count(json, 0, MO_CHECKPOINT_SECONDS_MAX, &record->checkpoint_every_s);
    else if (mo_json_is(key, "keep"))
      mo_read_count(json, 1, MO_CHECKPOINTS_KEPT_MAX, &record->checkpoints_kept);
    else
      mo_read_unknown(json, "every_steps, every_s, keep");
  }
}

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

/* What depends on several fields. */
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
  struct mo_training_settings *settings = &record->settings;
  struct mo_json_slice key;
  int code = MO_OK, choice;
  int64_t seed;
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
    } else if (mo_json_is(key, "sensor")) {
      given->sensor = true;
      mo_read_sensor(json, &settings->sensor);
    } else if (mo_json_is(key, "designs")) {
      given->designs = true;
      code = mo_read_designs(json, &parsed->genotypes, &record->n_designs);
    } else if (mo_json_is(key, "population")) {
      given->population = true;
      read_population(json, parsed);
    } else if (mo_json_is(key, "steps")) {
      mo_read_count(json, 1, MO_TRAINING_STEPS_MAX, &settings->n_steps);
    } else if (mo_json_is(key, "batch")) {
      mo_read_count(json, 1, MO_TRAINING_BATCH_MAX, &settings->batch);
    } else if (mo_json_is(key, "seed")) {
      if (mo_json_integer(json, 0, MO_SEED_MAX, &seed))
        settings->seed = (uint64_t)seed;
    } else if (mo_json_is(key, "schedule")) {
      mo_read_schedule(json, &settings->schedule);
    } else if (mo_json_is(key, "adam")) {
      mo_read_adam(json, &settings->beta1, &settings->beta2, &settings->epsilon);
    } else if (mo_json_is(key, "gradient_norm_limit")) {
      mo_read_limit(json, MO_GRADIENT_NORM_LIMIT_MAX, &settings->norm_limit);
    } else if (mo_json_is(key, "adjoint_bound")) {
      mo_read_limit(json, MO_ADJOINT_BOUND_MAX, &settings->adjoint_bound);
    } else if (mo_json_is(key, "adjoint_rule")) {
      mo_read_adjoint_rule(json, &settings->adjoint_rule);
    } else if (mo_json_is(key, "restart_weight")) {
      mo_json_bounded(json, 0, MO_RESTART_WEIGHT_MAX, &settings->restart_weight);
    } else if (mo_json_is(key, "physics")) {
      mo_read_physics(json, &settings->physics);
    } else if (mo_json_is(key, "validation")) {
      read_validation(json, record);
    } else if (mo_json_is(key, "checkpoint")) {
      read_checkpoint(json, record);
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
      mo_read_unknown(json, "kind, preset, name, controller, sensor, designs, population, steps, "
                            "batch, seed, schedule, adam, "
                            "gradient_norm_limit, adjoint_bound, adjoint_rule, restart_weight, "
                            "physics, validation, checkpoint, "
                            "priority, weight, device, label");
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
    preset = MO_LEARNING_PRESET_WORKSTATION; /* the second pass tells it */
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
