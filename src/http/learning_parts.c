/* learning_parts.c: see learning_parts.h. */
#include "http/learning_parts.h"

#include <math.h>

#include "base/number.h"
#include "http/request_parts.h"

#define GROWTH_MAX 1000 /* of a cycle over the one before */

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
  mo_json_fault_at(
      json, depth, "",
      "there is no such schedule; \"paper-pretrain\", \"paper-finetune\", \"paper-simultaneous\", "
      "\"one-cosine\", \"finetune-cosine\", or an object with kind, peak, floor … is expected");
}

static bool read_schedule_kind(struct mo_json *json, enum mo_schedule_kind *kind)
{
  static const char *const names[] = {"restarts", "cosine", "constant"};
  static const enum mo_schedule_kind kinds[] = {MO_SCHEDULE_RESTARTS, MO_SCHEDULE_COSINE,
                                                MO_SCHEDULE_CONSTANT};
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

/* The fields that are not given are those of the paper's pretraining (restarts, constant) or of one
 * cosine. */
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
      mo_read_positive(json, 1, &read.peak);
    } else if (mo_json_is(key, "floor")) {
      mo_read_positive(json, 1, &read.floor);
    } else if (mo_json_is(key, "decay")) {
      mo_read_positive(json, 1, &read.decay);
    } else if (mo_json_is(key, "cycle_steps")) {
      mo_read_count(json, 1, MO_TRAINING_STEPS_MAX, &read.cycle_steps);
    } else if (mo_json_is(key, "cycle_growth")) {
      mo_read_count(json, 1, GROWTH_MAX, &read.cycle_growth);
    } else if (mo_json_is(key, "warmup_steps")) {
      has_warmup = mo_read_count(json, 0, MO_TRAINING_STEPS_MAX, &read.warmup_steps);
    } else {
      mo_read_unknown(json, "kind, peak, floor, decay, cycle_steps, cycle_growth, warmup_steps");
    }
  }
  if (json->stop)
    return;
  if (!has_kind)
    mo_json_fault_at(json, depth, "", "kind is missing: \"restarts\", \"cosine\" or \"constant\"");
  struct mo_schedule full =
      kind == MO_SCHEDULE_COSINE ? mo_schedule_one_cosine() : mo_schedule_paper_pretrain();
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
    mo_json_fault_at(json, depth, "/floor",
                     "%s is given; at most the peak, which is %s, is expected",
                     MO_NUMBER(full.floor), MO_NUMBER(full.peak));
  else if (mo_schedule_check(&full, &message) != MO_OK)
    mo_json_fault_at(json, depth, "", "%s", message.text);
  else
    *schedule = full;
}

void mo_read_schedule(struct mo_json *json, struct mo_schedule *schedule)
{
  enum mo_json_kind kind = mo_json_peek(json);
  if (kind == MO_JSON_STRING) {
    read_schedule_name(json, schedule);
  } else if (kind == MO_JSON_OBJECT) {
    read_schedule_object(json, schedule);
  } else if (kind != MO_JSON_NONE) {
    mo_json_fault(json,
                  "the name of a schedule, or an object with kind, peak, floor … is expected");
    mo_json_skip(json);
  }
}

/* ---- the optimizer ---- */

/* 0 ≤ number < 1. */
static void read_share(struct mo_json *json, double *value)
{
  double number;
  if (!mo_json_number(json, &number))
    return;
  if (number < 0 || number >= 1)
    mo_json_fault(json, "%s is given; a number from 0 to below 1 is expected", MO_NUMBER(number));
  else
    *value = number;
}

void mo_read_adam(struct mo_json *json, double *beta1, double *beta2, double *epsilon)
{
  struct mo_json_slice key;
  if (!mo_json_object(json))
    return;
  while (mo_json_member(json, &key)) {
    if (mo_json_is(key, "beta1"))
      read_share(json, beta1);
    else if (mo_json_is(key, "beta2"))
      read_share(json, beta2);
    else if (mo_json_is(key, "epsilon"))
      mo_read_positive(json, 1, epsilon);
    else
      mo_read_unknown(json, "beta1, beta2, epsilon");
  }
}

/* ---- the way back ---- */

void mo_read_adjoint_rule(struct mo_json *json, enum mo_adjoint_rule *rule)
{
  int choice;
  if (mo_read_choice(json, "clip", "restart", &choice))
    *rule = choice ? MO_ADJOINT_RESTART : MO_ADJOINT_CLIP;
}

/* ---- the controller ---- */

void mo_read_sensor(struct mo_json *json, enum mo_sensor *sensor)
{
  int choice;
  if (mo_read_choice(json, "inverse_sqrt", "inverse_square", &choice))
    *sensor = choice ? MO_SENSOR_INVERSE_SQUARE : MO_SENSOR_INVERSE_SQRT;
}
