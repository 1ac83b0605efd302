/* fields.c: see fields.h. A schedule is read by name or as an object; the members that an object
 * leaves out depend on its kind. */
#include "learning/fields.h"

#include <math.h>

#include "base/text.h"
#include "rollout/gradient_options.h"
#include "rollout/physics.h"
#include "world/factors.h"

/* ---- schedule ---- */

#define AT(member)    offsetof(struct mo_schedule, member)
#define GROWTH_MAX    1000 /* factor from one cycle to the next */
#define NOT_GIVEN_U32 UINT32_MAX

static const struct mo_field schedule_rows[] = {
    {"kind", MO_FIELD_WORD, 0, AT(kind), .words = mo_schedule_words, .unit = "",
     .help = "restarts: cosine annealing with warm restarts; cosine: one cosine over all steps"},
    {"peak", MO_FIELD_NUMBER, MO_FIELD_ABOVE_MIN, AT(peak), .min = 0, .max = 1, .unit = "",
     .help = "largest learning rate"},
    {"floor", MO_FIELD_NUMBER, MO_FIELD_ABOVE_MIN, AT(floor), .min = 0, .max = 1, .unit = "",
     .help = "smallest learning rate"},
    {"decay", MO_FIELD_NUMBER, MO_FIELD_ABOVE_MIN, AT(decay), .min = 0, .max = 1, .unit = "",
     .help = "restarts: factor of the peak from one cycle to the next"},
    {"cycle_steps", MO_FIELD_COUNT, 0, AT(cycle_steps), .min = 1, .max = MO_TRAINING_STEPS_MAX,
     .unit = "steps", .help = "restarts: steps of the first cycle"},
    {"cycle_growth", MO_FIELD_COUNT, 0, AT(cycle_growth), .min = 1, .max = GROWTH_MAX, .unit = "",
     .help = "restarts: factor of the length from one cycle to the next"},
    {"warmup_steps", MO_FIELD_COUNT, 0, AT(warmup_steps), .min = 0, .max = MO_TRAINING_STEPS_MAX,
     .unit = "steps", .help = "steps over which the rate grows to its peak"},
};
#undef AT
static const struct mo_fields schedule_fields = MO_FIELDS(schedule_rows);

static void read_schedule_name(struct mo_json *json, struct mo_schedule *schedule)
{
  struct mo_json_slice name;
  const unsigned depth = json->depth;
  char list[MO_WORDS_BYTES];
  if (!mo_json_string(json, &name))
    return;
  for (size_t i = 0; mo_schedule_preset_words[i] != NULL; i++)
    if (mo_json_is(name, mo_schedule_preset_words[i])) {
      *schedule = mo_schedule_presets[i];
      return;
    }
  mo_json_fault_at(json, depth, "", "must be %s, or an object with kind, peak, floor …",
                   mo_words_list(mo_schedule_preset_words, list));
}

/* Reads a schedule object. Missing members default to the paper's pretraining (restarts, constant)
 * or to one cosine. */
static void read_schedule_object(struct mo_json *json, struct mo_schedule *schedule)
{
  struct mo_schedule read = {.kind = (enum mo_schedule_kind) - 1, .warmup_steps = NOT_GIVEN_U32};
  const unsigned depth = json->depth, before = json->faults->n;
  char list[MO_WORDS_BYTES];
  mo_fields_read(json, &schedule_fields, &read);
  if (json->stop || json->faults->n > before)
    return;
  if ((int)read.kind < 0) {
    mo_json_fault_at(json, depth, "", "kind is missing: %s",
                     mo_words_list(mo_schedule_words, list));
    return;
  }
  const struct mo_schedule paper = mo_schedule_presets[MO_SCHEDULE_PAPER_PRETRAIN];
  struct mo_schedule full =
      read.kind == MO_SCHEDULE_COSINE ? mo_schedule_presets[MO_SCHEDULE_ONE_COSINE] : paper;
  full.kind = read.kind;
  full.peak = read.peak > 0 ? read.peak : full.peak;
  full.floor = read.floor > 0 ? read.floor : fmin(full.floor, full.peak);
  full.decay = read.decay > 0 ? read.decay : paper.decay;
  full.cycle_steps = read.cycle_steps > 0 ? read.cycle_steps : paper.cycle_steps;
  full.cycle_growth = read.cycle_growth > 0 ? read.cycle_growth : paper.cycle_growth;
  full.warmup_steps = read.warmup_steps != NOT_GIVEN_U32 ? read.warmup_steps : full.warmup_steps;
  if (full.floor > full.peak)
    mo_json_fault_at(json, depth, "/floor", "must be at most the peak, which is %s, got %s",
                     MO_NUMBER(full.peak), MO_NUMBER(full.floor));
  else
    *schedule = full;
}

static void read_schedule(struct mo_json *json, void *value)
{
  const enum mo_json_kind kind = mo_json_peek(json);
  if (kind == MO_JSON_STRING) {
    read_schedule_name(json, value);
  } else if (kind == MO_JSON_OBJECT) {
    read_schedule_object(json, value);
  } else if (kind != MO_JSON_NONE) {
    mo_json_fault(json, "must be the name of a schedule, or an object with kind, peak, floor …");
    mo_json_skip(json);
  }
}

static void write_schedule(struct mo_text *text, const void *value)
{
  mo_fields_write_object(text, &schedule_fields, value);
}

static int check_schedule(const char *name, const void *value, struct mo_message *message)
{
  const struct mo_schedule *schedule = value;
  int error = mo_fields_check(&schedule_fields, name, schedule, message);
  if (error == MO_OK && schedule->floor > schedule->peak)
    error = mo_fail(message, MO_ERR_RANGE, "%s.floor must be at most the peak, which is %s, got %s",
                    name, MO_NUMBER(schedule->peak), MO_NUMBER(schedule->floor));
  return error;
}

/* ---- learning ---- */

#define AT(member) offsetof(struct mo_learning, member)
static const struct mo_field adam_rows[] = {
    {"beta1", MO_FIELD_NUMBER, MO_FIELD_BELOW_MAX, AT(beta1), .min = 0, .max = 1, .unit = "",
     .help = "Adam's decay of the mean of gradients"},
    {"beta2", MO_FIELD_NUMBER, MO_FIELD_BELOW_MAX, AT(beta2), .min = 0, .max = 1, .unit = "",
     .help = "Adam's decay of the mean of their squares"},
    {"epsilon", MO_FIELD_NUMBER, MO_FIELD_ABOVE_MIN, AT(epsilon), .min = 0, .max = 1, .unit = "",
     .help = "Adam's smallest divisor"},
};
static const struct mo_fields adam_fields = MO_FIELDS(adam_rows);
static const struct mo_field_own schedule = {read_schedule, write_schedule, check_schedule};
static const struct mo_field learning_rows[] = {
    {"schedule", MO_FIELD_OWN, 0, AT(schedule), .group = &schedule_fields, .own = &schedule,
     .unit = "", .help = "learning rate: the name of a schedule, or an object"},
    {"adam", MO_FIELD_GROUP, 0, 0, .group = &adam_fields, .unit = "", .help = "the optimizer"},
    {"gradient_norm_limit", MO_FIELD_NUMBER, 0, AT(norm_limit), .min = 0,
     .max = MO_GRADIENT_NORM_LIMIT_MAX, .unit = "",
     .help = "largest norm of a step's gradient; 0: no limit"},
    {NULL, MO_FIELD_INLINE, 0, AT(gradient), .group = &mo_gradient_fields},
    {"vary", MO_FIELD_OWN, 0, AT(vary), .group = &mo_vary_fields, .own = &mo_vary_own, .unit = "",
     .help = "ranges of factors, drop and slope of each robot's world"},
};
#undef AT
const struct mo_fields mo_learning_fields = MO_FIELDS(learning_rows);

/* ---- training runs ---- */

const char *const mo_training_kind_words[] = {"pretrain", "finetune", NULL};

#define AT(member) offsetof(struct mo_training_settings, member)
static const struct mo_field recipe_rows[] = {
    {"steps", MO_FIELD_COUNT, 0, AT(n_steps), .min = 1, .max = MO_TRAINING_STEPS_MAX,
     .unit = "steps", .help = "steps of gradient descent"},
    {"batch", MO_FIELD_COUNT, 0, AT(batch), .min = 1, .max = MO_TRAINING_BATCH_MAX,
     .unit = "robots", .help = "robots in each step"},
    {NULL, MO_FIELD_INLINE, 0, AT(learning), .group = &mo_learning_fields},
    {"physics", MO_FIELD_GROUP, 0, AT(physics), .group = &mo_physics_fields, .unit = "",
     .help = "constants of the world"},
};
const struct mo_fields mo_recipe_fields = MO_FIELDS(recipe_rows);
static const struct mo_field training_rows[] = {
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &mo_recipe_fields},
    {"seed", MO_FIELD_SEED, 0, AT(seed), .unit = "",
     .help = "seed of bodies, environments and initial weights"},
    {"sensor", MO_FIELD_WORD, MO_FIELD_NULL, AT(sensor), .words = mo_sensor_words, .unit = "",
     .help = "sensor of a controller that starts from random weights"},
};
#undef AT
const struct mo_fields mo_training_fields = MO_FIELDS(training_rows);
