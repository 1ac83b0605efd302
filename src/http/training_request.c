/* training_request.c: see training_request.h.
 *
 * The defaults depend on the kind, and JSON has no order of members: a first pass over the text finds the kind alone, a second
 * reads everything over the defaults of that kind. What depends on several fields is checked after the last of them. */
#include "http/training_request.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "http/field.h"
#include "http/request_parts.h"

#define CHECKPOINT_SECONDS 86400
#define GROWTH_MAX         1000 /* of a cycle over the one before */

/* What was given, as far as other fields depend on it. */
struct given {
  bool kind, controller, no_controller, sensor, designs, population;
  bool known_kind; /* kind is one of its words */
  bool object;     /* the body is one: it has fields to speak of */
};

/* ---- numbers ---- */

/* min … max, both included, as uint32. */
static bool read_count(struct mo_json *json, uint32_t min, uint32_t max, uint32_t *count)
{
  int64_t number;
  if (!mo_json_integer(json, min, max, &number))
    return false;
  *count = (uint32_t)number;
  return true;
}

/* 0 < number ≤ max. */
static bool read_positive(struct mo_json *json, double max, double *value)
{
  double number;
  if (!mo_json_number(json, &number))
    return false;
  if (number <= 0 || number > max) {
    mo_json_fault(json, "%g is given; a number above 0, at most %g, is expected", number, max);
    return false;
  }
  *value = number;
  return true;
}

/* 0 ≤ number < 1. */
static void read_share(struct mo_json *json, double *value)
{
  double number;
  if (!mo_json_number(json, &number))
    return;
  if (number < 0 || number >= 1)
    mo_json_fault(json, "%g is given; a number from 0 to below 1 is expected", number);
  else
    *value = number;
}

/* A limit; 0 takes it away. */
static void read_limit(struct mo_json *json, double max, double *value)
{
  double number;
  if (!mo_json_number(json, &number))
    return;
  if (number < 0 || number > max)
    mo_json_fault(json, "%g is given; a number above 0, at most %g, or 0 for no limit, is expected", number, max);
  else
    *value = number;
}

/* ---- the learning rate ---- */

static void read_schedule_name(struct mo_json *json, struct mo_schedule *schedule)
{
  static const struct {
    const char *name;
    struct mo_schedule (*make)(void);
  } named[] = {{"paper-pretrain", mo_schedule_paper_pretrain},
               {"paper-finetune", mo_schedule_paper_finetune},
               {"paper-simultaneous", mo_schedule_paper_simultaneous},
               {"one-cosine", mo_schedule_one_cosine},
               {"finetune-cosine", mo_schedule_finetune}};
  struct mo_json_slice name;
  unsigned depth = json->depth;
  if (!mo_json_string(json, &name))
    return;
  for (size_t i = 0; i < sizeof(named) / sizeof(named[0]); i++)
    if (mo_json_is(name, named[i].name)) {
      *schedule = named[i].make();
      return;
    }
  mo_json_fault_at(json, depth, "",
                   "there is no such schedule; \"paper-pretrain\", \"paper-finetune\", \"paper-simultaneous\", "
                   "\"one-cosine\", \"finetune-cosine\", or an object with kind, peak, floor … is expected");
}

static bool read_schedule_kind(struct mo_json *json, enum mo_schedule_kind *kind)
{
  static const char *const names[] = {"restarts", "cosine", "constant"};
  static const enum mo_schedule_kind kinds[] = {MO_SCHEDULE_RESTARTS, MO_SCHEDULE_COSINE, MO_SCHEDULE_CONSTANT};
  struct mo_json_slice name;
  unsigned depth = json->depth;
  if (!mo_json_string(json, &name))
    return false;
  for (size_t i = 0; i < 3; i++)
    if (mo_json_is(name, names[i])) {
      *kind = kinds[i];
      return true;
    }
  mo_json_fault_at(json, depth, "", "\"restarts\", \"cosine\" or \"constant\" is expected");
  return false;
}

/* The fields that are not given are those of the paper's pretraining (restarts, constant) or of one cosine. */
static void read_schedule_object(struct mo_json *json, struct mo_schedule *schedule)
{
  struct mo_schedule read = {.peak = 0, .floor = 0, .decay = 0};
  enum mo_schedule_kind kind = MO_SCHEDULE_COSINE;
  bool has_kind = false, has_warmup = false;
  unsigned depth = json->depth, before = json->faults->n;
  struct mo_json_slice key;
  mo_json_object(json);
  while (mo_json_member(json, &key)) {
    if (mo_json_is(key, "kind")) {
      has_kind = true;
      read_schedule_kind(json, &kind);
    } else if (mo_json_is(key, "peak")) {
      read_positive(json, 1, &read.peak);
    } else if (mo_json_is(key, "floor")) {
      read_positive(json, 1, &read.floor);
    } else if (mo_json_is(key, "decay")) {
      read_positive(json, 1, &read.decay);
    } else if (mo_json_is(key, "cycle_steps")) {
      read_count(json, 1, MO_TRAINING_STEPS_MAX, &read.cycle_steps);
    } else if (mo_json_is(key, "cycle_growth")) {
      read_count(json, 1, GROWTH_MAX, &read.cycle_growth);
    } else if (mo_json_is(key, "warmup_steps")) {
      has_warmup = read_count(json, 0, MO_TRAINING_STEPS_MAX, &read.warmup_steps);
    } else {
      mo_read_unknown(json, "kind, peak, floor, decay, cycle_steps, cycle_growth, warmup_steps");
    }
  }
  if (json->stop)
    return;
  if (!has_kind)
    mo_json_fault_at(json, depth, "", "kind is missing: \"restarts\", \"cosine\" or \"constant\"");
  struct mo_schedule full = kind == MO_SCHEDULE_COSINE ? mo_schedule_one_cosine() : mo_schedule_paper_pretrain();
  struct mo_schedule paper = mo_schedule_paper_pretrain();
  full.kind = kind;
  full.peak = read.peak > 0 ? read.peak : full.peak;
  full.floor = read.floor > 0 ? read.floor : fmin(full.floor, full.peak);
  full.decay = read.decay > 0 ? read.decay : paper.decay;
  full.cycle_steps = read.cycle_steps > 0 ? read.cycle_steps : paper.cycle_steps;
  full.cycle_growth = read.cycle_growth > 0 ? read.cycle_growth : paper.cycle_growth;
  full.warmup_steps = has_warmup ? read.warmup_steps : full.warmup_steps;
  if (json->faults->n > before)
    return;
  struct mo_message message = {""};
  if (full.floor > full.peak)
    mo_json_fault_at(json, depth, "/floor", "%g is given; at most the peak, which is %g, is expected", full.floor,
                     full.peak);
  else if (mo_schedule_check(&full, &message) != MO_OK)
    mo_json_fault_at(json, depth, "", "%s", message.text);
  else
    *schedule = full;
}

static void read_schedule(struct mo_json *json, struct mo_schedule *schedule)
{
  enum mo_json_kind kind = mo_json_peek(json);
  if (kind == MO_JSON_STRING) {
    read_schedule_name(json, schedule);
  } else if (kind == MO_JSON_OBJECT) {
    read_schedule_object(json, schedule);
  } else if (kind != MO_JSON_NONE) {
    mo_json_fault(json, "the name of a schedule, or an object with kind, peak, floor … is expected");
    mo_json_skip(json);
  }
}

/* ---- further groups of settings ---- */

static void read_adam(struct mo_json *json, struct mo_training_settings *settings)
{
  struct mo_json_slice key;
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    if (mo_json_is(key, "beta1"))
      read_share(json, &settings->beta1);
    else if (mo_json_is(key, "beta2"))
      read_share(json, &settings->beta2);
    else if (mo_json_is(key, "epsilon"))
      read_positive(json, 1, &settings->epsilon);
    else
      mo_read_unknown(json, "beta1, beta2, epsilon");
  }
}

static void read_validation(struct mo_json *json, struct mo_training_record *record)
{
  struct mo_training_settings *settings = &record->settings;
  struct mo_json_slice key;
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    if (mo_json_is(key, "every_steps"))
      read_count(json, 0, MO_TRAINING_STEPS_MAX, &record->validate_every_steps);
    else if (mo_json_is(key, "designs"))
      read_count(json, 1, MO_TRAINING_DESIGNS_MAX, &settings->held_out_designs);
    else if (mo_json_is(key, "environments"))
      read_count(json, 1, MO_HELD_OUT_ENVIRONMENTS_MAX, &settings->held_out_environments);
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
      read_count(json, 0, MO_TRAINING_STEPS_MAX, &record->checkpoint_every_steps);
    else if (mo_json_is(key, "every_s"))
      read_count(json, 0, CHECKPOINT_SECONDS, &record->checkpoint_every_s);
    else if (mo_json_is(key, "keep"))
      read_count(json, 1, MO_CHECKPOINTS_KEPT_MAX, &record->checkpoints_kept);
    else
      mo_read_unknown(json, "every_steps, every_s, keep");
  }
}

static void read_population(struct mo_json *json, struct mo_training_request *request)
{
  unsigned depth = json->depth;
  bool evaluation = false;
  struct mo_json_slice key;
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    unsigned inner = json->depth;
    struct mo_json_slice id;
    if (mo_json_is(key, "evaluation")) {
      evaluation = true;
      if (mo_json_string(json, &id) &&
          (id.size == 0 || id.bytes[0] == '0' || !mo_decimal(id.bytes, id.size, 1, INT64_MAX, &request->population)))
        mo_json_fault_at(json, inner, "", "the id of an evaluation, a positive integer in decimal digits, is expected");
    } else if (mo_json_is(key, "best")) {
      read_count(json, 1, MO_TRAINING_DESIGNS_MAX, &request->population_best);
    } else {
      mo_read_unknown(json, "evaluation, best");
    }
  }
  if (!json->stop && !evaluation)
    mo_json_fault_at(json, depth, "", "evaluation is missing: the id of the evaluation whose designs are learned from");
}

/* ---- names ---- */

static void read_kind(struct mo_json *json, struct given *given)
{
  int choice;
  given->kind = true;
  given->known_kind = mo_read_choice(json, "pretrain", "finetune", &choice);
}

static void read_name(struct mo_json *json, char name[MO_NAME_BYTES_MAX + 1])
{
  struct mo_json_slice words;
  unsigned depth = json->depth;
  char text[MO_NAME_BYTES_MAX + 1] = "";
  if (!mo_json_string(json, &words))
    return;
  bool good = words.size <= MO_NAME_BYTES_MAX && memchr(words.bytes, '\0', words.size) == NULL;
  if (good) {
    memcpy(text, words.bytes, words.size);
    text[words.size] = '\0';
    good = mo_controller_name_check(text) == MO_OK;
  }
  if (good)
    memcpy(name, text, sizeof(text));
  else
    mo_json_fault_at(json, depth, "",
                     "a controller's name is expected: 1 to %d of a-z, 0-9, '.', '_' and '-', beginning with a letter "
                     "or digit",
                     MO_NAME_BYTES_MAX);
}

static void read_parent(struct mo_json *json, struct mo_parsed_training *parsed, struct given *given)
{
  given->controller = true;
  if (mo_json_peek(json) == MO_JSON_NULL) {
    given->no_controller = true;
    mo_json_skip(json);
    return;
  }
  mo_read_controller(json, parsed->parent);
}

static void read_sensor(struct mo_json *json, enum mo_sensor *sensor, struct given *given)
{
  int choice;
  given->sensor = true;
  if (mo_read_choice(json, "inverse_sqrt", "inverse_square", &choice))
    *sensor = choice ? MO_SENSOR_INVERSE_SQUARE : MO_SENSOR_INVERSE_SQRT;
}

/* ---- the whole ---- */

/* What depends on several fields. */
static void check_together(struct mo_json *json, struct mo_parsed_training *parsed, const struct given *given)
{
  bool finetune = parsed->request.record.settings.kind == MO_TRAINING_FINETUNE;
  if (!given->kind)
    mo_json_fault_at(json, 0, "", "kind is missing: \"pretrain\" or \"finetune\"");
  if (!given->known_kind)
    return;
  if (finetune) {
    if (given->designs == given->population)
      mo_json_fault_at(json, 0, "",
                       "%s; a finetuning learns from exactly one of designs (a list) and population (those of an "
                       "evaluation)",
                       given->designs ? "both designs and population are given"
                                      : "neither designs nor population is given");
    if (given->no_controller)
      mo_json_fault_at(json, 0, "/controller",
                       "null is given; a finetuning starts from a controller: its name, or sha256: and 64 hexadecimal "
                       "digits, is expected");
  } else {
    if (given->designs)
      mo_json_fault_at(json, 0, "/designs",
                       "a pretraining draws bodies of its own; designs are expected of a finetuning alone");
    if (given->population)
      mo_json_fault_at(json, 0, "/population",
                       "a pretraining draws bodies of its own; a population is expected of a finetuning alone");
    const struct mo_training_settings *settings = &parsed->request.record.settings;
    if ((uint64_t)settings->n_steps * settings->batch > MO_TRAINING_BODIES_MAX)
      mo_json_fault_at(json, 0, "/steps",
                       "%u steps of %u bodies are %llu; at most %llu distinct bodies are expected of a pretraining",
                       settings->n_steps, settings->batch, (unsigned long long)settings->n_steps * settings->batch,
                       (unsigned long long)MO_TRAINING_BODIES_MAX);
  }
  if (given->sensor && (finetune || (given->controller && !given->no_controller)))
    mo_json_fault_at(json, 0, "/sensor",
                     "the training starts from a controller, which has its sensor; none is expected here");
}

static int read_request(struct mo_json *json, struct mo_parsed_training *parsed, struct given *given)
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
    } else if (mo_json_is(key, "name")) {
      read_name(json, record->name);
    } else if (mo_json_is(key, "controller")) {
      read_parent(json, parsed, given);
    } else if (mo_json_is(key, "sensor")) {
      read_sensor(json, &settings->sensor, given);
    } else if (mo_json_is(key, "designs")) {
      given->designs = true;
      code = mo_read_designs(json, &parsed->genotypes, &record->n_designs);
    } else if (mo_json_is(key, "population")) {
      given->population = true;
      read_population(json, request);
    } else if (mo_json_is(key, "steps")) {
      read_count(json, 1, MO_TRAINING_STEPS_MAX, &settings->n_steps);
    } else if (mo_json_is(key, "batch")) {
      read_count(json, 1, MO_TRAINING_BATCH_MAX, &settings->batch);
    } else if (mo_json_is(key, "seed")) {
      if (mo_json_integer(json, 0, MO_SEED_MAX, &seed))
        settings->seed = (uint64_t)seed;
    } else if (mo_json_is(key, "schedule")) {
      read_schedule(json, &settings->schedule);
    } else if (mo_json_is(key, "adam")) {
      read_adam(json, settings);
    } else if (mo_json_is(key, "gradient_norm_limit")) {
      read_limit(json, MO_GRADIENT_NORM_LIMIT_MAX, &settings->norm_limit);
    } else if (mo_json_is(key, "adjoint_bound")) {
      read_limit(json, MO_ADJOINT_BOUND_MAX, &settings->adjoint_bound);
    } else if (mo_json_is(key, "physics")) {
      mo_read_physics(json, &settings->physics);
    } else if (mo_json_is(key, "validation")) {
      read_validation(json, record);
    } else if (mo_json_is(key, "checkpoint")) {
      read_checkpoint(json, record);
    } else if (mo_json_is(key, "priority")) {
      if (mo_read_choice(json, "batch", "interactive", &choice))
        request->priority = choice ? MO_INTERACTIVE : MO_BATCH;
    } else if (mo_json_is(key, "label")) {
      if (mo_read_label(json, parsed->label))
        request->label = parsed->label;
    } else {
      mo_read_unknown(json, "kind, name, controller, sensor, designs, population, steps, batch, seed, schedule, adam, "
                            "gradient_norm_limit, adjoint_bound, physics, validation, checkpoint, priority, label");
    }
  }
  return code;
}

/* The kind of a request, whatever else is wrong with it; a pretraining if none can be found. */
static enum mo_training_kind find_kind(struct mo_json *json, const char *text, size_t size, struct mo_faults *faults)
{
  enum mo_training_kind kind = MO_TRAINING_PRETRAIN;
  struct mo_json_slice key, word;
  mo_json_start(json, text, size, faults);
  if (mo_json_object(json))
    while (mo_json_member(json, &key)) {
      if (mo_json_is(key, "kind") && mo_json_peek(json) == MO_JSON_STRING) {
        if (mo_json_string(json, &word) && mo_json_is(word, "finetune"))
          kind = MO_TRAINING_FINETUNE;
      } else {
        mo_json_skip(json);
      }
    }
  return kind;
}

static int read_text(struct mo_json *json, const char *text, size_t size, struct mo_parsed_training *parsed,
                     struct mo_faults *faults)
{
  struct mo_training_record *record = &parsed->request.record;
  struct given given = {0};
  struct mo_message message = {""};
  unsigned before = faults->n;
  enum mo_training_kind kind = find_kind(json, text, size, faults);
  faults->n = before; /* the second pass tells them all */
  faults->malformed = false;
  record->settings = mo_training_defaults(kind);
  record->validate_every_steps = 50;
  record->checkpoint_every_s = 60;
  record->checkpoints_kept = 3;
  mo_json_start(json, text, size, faults);
  int code = read_request(json, parsed, &given);
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

int mo_training_parse(const char *text, size_t size, struct mo_parsed_training *parsed, struct mo_faults *faults)
{
  *parsed = (struct mo_parsed_training){.request = {.priority = MO_BATCH}};
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
