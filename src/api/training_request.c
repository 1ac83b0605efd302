/* training_request.c: the body of POST /v1/trainings.
 *
 * The defaults depend on kind and preset, and JSON members have no order. A first pass over the
 * text finds these two; a second pass reads all members over their defaults. Checks that involve
 * several fields come last. */
#include <string.h>

#include "api/requests.h"
#include "store/fields.h"
#include "world/factors.h"

#define NOT_GIVEN UINT32_MAX
/* Longest name that leaves room for "-" and the position of a design. */
#define EACH_NAME_MAX (MO_NAME_BYTES_MAX - 5)
_Static_assert(MO_TRAINING_DESIGNS_MAX <= 10000, "positions have at most four digits");

static void read_population(struct mo_json *json, void *value)
{
  struct mo_parsed_training *parsed = value;
  struct mo_training_request *request = &parsed->request;
  parsed->has_population = true;
  mo_read_population(json, MO_TRAINING_DESIGNS_MAX, &parsed->population_kind,
                     &request->record.population, &request->population_best,
                     &request->record.sample);
}

/* ---- the whole body ---- */

#define AT(member) offsetof(struct mo_parsed_training, member)
static const char *const kind_words[] = {"pretrain", "finetune", NULL};
static const struct mo_field_own population = {.read = read_population};
static const struct mo_field rows[] = {
    {"kind", MO_FIELD_WORD, 0, AT(request.record.settings.kind), .words = kind_words},
    {"preset", MO_FIELD_WORD, 0, AT(preset), .words = mo_learning_preset_words},
    {"name", MO_FIELD_OWN, 0, AT(request.record.name), .own = &mo_name_field},
    {"designs", MO_FIELD_OWN, 0, AT(parts), .own = &mo_designs_field},
    {"population", MO_FIELD_OWN, 0, 0, .own = &population},
    {"environments", MO_FIELD_OWN, 0, AT(parts), .own = &mo_environments_field},
    {"tasks", MO_FIELD_OWN, 0, AT(parts), .own = &mo_tasks_field},
    {"each", MO_FIELD_FLAG, 0, AT(request.record.each)},
    {"keep", MO_FIELD_WORD, 0, AT(request.record.keep), .words = mo_keep_words},
    {"best", MO_FIELD_COUNT, 0, AT(request.record.keep_best), .min = 1,
     .max = MO_TRAINING_DESIGNS_MAX},
    {NULL, MO_FIELD_INLINE, 0, AT(parts), .group = &mo_parts_fields},
    {NULL, MO_FIELD_INLINE, 0, AT(request.record), .group = &mo_training_record_fields},
};
#undef AT
const struct mo_fields mo_training_request_fields = MO_FIELDS(rows);
_Static_assert(MO_TRAINING_PRETRAIN == 0 && MO_TRAINING_FINETUNE == 1,
               "the words are in the order of their values");

static void check_finetune(struct mo_json *json, const struct mo_parsed_training *parsed)
{
  bool designs = parsed->parts.has_designs;
  if (designs == parsed->has_population)
    mo_json_fault_at(json, 0, "", "%s; a finetuning run needs exactly one of them",
                     designs ? "both designs and population are given"
                             : "neither designs nor population is given");
  if (parsed->parts.no_controller)
    mo_json_fault_at(json, 0, "/controller",
                     "must not be null, because a finetuning run starts from a controller; give "
                     "its name, or sha256: and 64 hexadecimal digits");
  if (parsed->preset == MO_LEARNING_PRESET_PHOTOTAXIS ||
      parsed->preset == MO_LEARNING_PRESET_ROBUST)
    mo_json_fault_at(json, 0, "/preset",
                     "\"%s\" is a preset of pretraining; use \"workstation\" or \"paper\" for "
                     "finetuning",
                     mo_learning_preset_words[parsed->preset]);
}

/* Each design is its own validation set, which is scored before its first and after its last step.
 * A request may contain these settings explicitly, as replies do. Names get the position of the
 * design. */
static void check_each(struct mo_json *json, struct mo_parsed_training *parsed)
{
  struct mo_training_record *record = &parsed->request.record;
  const bool keeps = record->keep == MO_KEEP_ALL || record->keep_best > 0;
  if (record->keep >= 0 && record->keep_best > 0)
    mo_json_fault_at(json, 0, "/best", "cannot be combined with keep; give only one of them");
  if (record->validate_every_steps != NOT_GIVEN &&
      record->validate_every_steps != record->settings.n_steps)
    mo_json_fault_at(json, 0, "/validation/every_steps",
                     "must be left out, because each design is scored before its first and after "
                     "its last step");
  if (record->settings.held_out_designs != NOT_GIVEN && record->settings.held_out_designs != 1)
    mo_json_fault_at(json, 0, "/validation/designs",
                     "must be left out, because each design is scored individually");
  if (keeps && strlen(record->name) > EACH_NAME_MAX)
    mo_json_fault_at(json, 0, "/name",
                     "must have at most %d characters, because the position of a design is added "
                     "to it",
                     EACH_NAME_MAX);
}

/* Refuses members that are only for training each design separately, in other training runs. */
static void check_not_each(struct mo_json *json, const struct mo_parsed_training *parsed)
{
  static const char words[] =
      "is only for finetuning with \"each\": true, which makes a controller per design";
  if (parsed->request.record.keep >= 0)
    mo_json_fault_at(json, 0, "/keep", "%s", words);
  if (parsed->request.record.keep_best > 0)
    mo_json_fault_at(json, 0, "/best", "%s", words);
}

static void check_pretrain(struct mo_json *json, const struct mo_parsed_training *parsed)
{
  const struct mo_training_settings *settings = &parsed->request.record.settings;
  const uint64_t bodies = (uint64_t)settings->n_steps * settings->batch;
  if (parsed->parts.has_designs)
    mo_json_fault_at(json, 0, "/designs",
                     "a pretraining run draws its own bodies; only a finetuning run has designs");
  if (parsed->has_population)
    mo_json_fault_at(json, 0, "/population",
                     "a pretraining run draws its own bodies; only a finetuning run has a "
                     "population");
  if (parsed->request.record.each)
    mo_json_fault_at(json, 0, "/each",
                     "a pretraining run draws its own bodies; only a finetuning run has designs");
  if (bodies > MO_TRAINING_BODIES_MAX)
    mo_json_fault_at(
        json, 0, "/steps",
        "%u steps of %u bodies need %llu distinct bodies; a pretraining run can use at most %llu",
        settings->n_steps, settings->batch, (unsigned long long)bodies,
        (unsigned long long)MO_TRAINING_BODIES_MAX);
}

/* Checks what depends on several fields. Unless they were given, the sensor is negative, and the
 * number of held-out environments is 0. */
static int check(struct mo_json *json, void *any)
{
  struct mo_parsed_training *parsed = any;
  struct mo_training_settings *settings = &parsed->request.record.settings;
  const struct mo_parts *parts = &parsed->parts;
  bool finetune = settings->kind == MO_TRAINING_FINETUNE;
  bool has_sensor = (int)settings->sensor >= 0;
  if (parts->has_environments && parts->has_tasks)
    mo_json_fault_at(json, 0, "/tasks",
                     "cannot be combined with environments, which may have tasks themselves; give "
                     "only one of them");
  if (parts->has_environments && settings->held_out_environments > 0)
    mo_json_fault_at(json, 0, "/validation/environments",
                     "must be left out, because a training run with its own environments is "
                     "validated in all of them");
  settings->learning.vary.given = mo_factors_vary(&settings->learning.vary);
  mo_parts_check_factors(json, &parsed->parts, &settings->physics, &settings->learning.vary);
  mo_parts_check_gradients(json, parts, "");
  if (!parsed->has_kind)
    mo_json_fault_at(json, 0, "", "kind is missing; it must be \"pretrain\" or \"finetune\"");
  else if ((int)settings->kind < 0)
    return MO_OK; /* already reported */
  if (parsed->has_kind && finetune)
    check_finetune(json, parsed);
  else if (parsed->has_kind)
    check_pretrain(json, parsed);
  if (parsed->request.record.each)
    check_each(json, parsed);
  else
    check_not_each(json, parsed);
  if (parsed->has_kind && has_sensor &&
      (finetune || (parts->has_controller && !parts->no_controller)))
    mo_json_fault_at(
        json, 0, "/sensor",
        "the training run starts from a controller, which determines the sensor; omit it here");
  return MO_OK;
}

int mo_training_parse(const char *text, size_t size, struct mo_parsed_training *parsed,
                      struct mo_faults *faults)
{
  struct mo_training_request *request = &parsed->request;
  struct mo_training_settings *settings = &request->record.settings;
  struct mo_parts *parts = &parsed->parts;
  struct mo_message message = {""};
  *parsed = (struct mo_parsed_training){.parts.job = {.priority = MO_BATCH, .weight = 1},
                                        .preset = MO_LEARNING_PRESET_WORKSTATION};
  settings->kind = (enum mo_training_kind) - 1;
  mo_read_words(text, size, &(struct mo_fields){rows, 2}, parsed, &parsed->has_kind);
  const bool known = (int)settings->kind >= 0;
  const enum mo_training_kind kind = known ? settings->kind : MO_TRAINING_PRETRAIN;
  request->record =
      (struct mo_training_record){.settings = mo_training_preset(kind, parsed->preset),
                                  .validate_every_steps = NOT_GIVEN,
                                  .checkpoint_every_s = 60,
                                  .checkpoints_kept = 3,
                                  .sample.seed = 1};
  const enum mo_sensor sensor = settings->sensor;
  settings->sensor = (enum mo_sensor) - 1;
  const uint32_t held_out_environments = settings->held_out_environments;
  settings->held_out_environments = 0;
  const uint32_t held_out_designs = settings->held_out_designs;
  settings->held_out_designs = NOT_GIVEN;
  request->record.keep = -1;
  if (!known)
    settings->kind = (enum mo_training_kind) - 1;
  int error = mo_read_body(text, size, &mo_training_request_fields, parsed, parts, check, faults);
  if ((int)settings->sensor < 0)
    settings->sensor = sensor;
  if (settings->held_out_environments == 0)
    settings->held_out_environments = held_out_environments;
  if (settings->held_out_designs == NOT_GIVEN)
    settings->held_out_designs = request->record.each ? 1 : held_out_designs;
  if (request->record.keep < 0)
    request->record.keep = MO_KEEP_NONE;
  if (request->record.validate_every_steps == NOT_GIVEN)
    request->record.validate_every_steps = request->record.each ? settings->n_steps : 50;
  if (kind == MO_TRAINING_FINETUNE && !parts->has_controller)
    memcpy(parts->controller, "default", sizeof("default"));
  if (error == MO_OK && mo_training_settings_check(settings, &message) != MO_OK) {
    mo_faults_add(faults, MO_FAULT_BODY, "", "%s", message.text);
    error = MO_ERR_INVALID;
  }
  request->parent = mo_parts_controller(parts);
  request->job = parts->job;
  request->genotypes = parts->genotypes;
  request->notes = parts->notes;
  request->n_notes = parts->n_notes;
  request->record.n_designs = parts->n_designs;
  request->environments = parts->environments;
  request->record.n_environments = parts->n_environments;
  request->record.draws_worlds = parts->has_tasks;
  if (parts->environment_set != NULL)
    snprintf(request->record.environment_set, sizeof(request->record.environment_set), "%s",
             parts->environment_set);
  return error;
}
