/* settings.c: what a training is asked to do: presets and bounds. */
#include <morpho/learning.h>

#include <inttypes.h>
#include <string.h>

#include "base/number.h"

#define STEPS_PRETRAIN 1400
#define STEPS_FINETUNE 60
#define BATCH          256
#define BATCH_PAPER    8192
#define PRESETS        3

/* ---- presets ---- */

static const char *const preset_names[PRESETS] = {"workstation", "phototaxis", "paper"};

const char *mo_learning_preset_name(enum mo_learning_preset preset)
{
  return (unsigned)preset < PRESETS ? preset_names[preset] : "unknown";
}

int mo_learning_preset_from_name(const char *name, enum mo_learning_preset *preset)
{
  for (unsigned i = 0; i < PRESETS; i++)
    if (strcmp(name, preset_names[i]) == 0) {
      *preset = (enum mo_learning_preset)i;
      return MO_OK;
    }
  return MO_ERR_NOT_FOUND;
}

struct mo_training_settings mo_training_defaults(enum mo_training_kind kind)
{
  return (struct mo_training_settings){
      .kind = kind,
      .seed = 1,
      .n_steps = kind == MO_TRAINING_FINETUNE ? STEPS_FINETUNE : STEPS_PRETRAIN,
      .batch = BATCH,
      .schedule = kind == MO_TRAINING_FINETUNE ? mo_schedule_finetune() : mo_schedule_one_cosine(),
      .beta1 = 0.9,
      .beta2 = 0.999,
      .epsilon = 1e-8,
      .norm_limit = 1.0,
      .adjoint_bound = MO_ADJOINT_BOUND,
      .adjoint_rule = MO_ADJOINT_CLIP,
      .restart_weight = MO_RESTART_WEIGHT,
      .physics = mo_default_physics(),
      .sensor = MO_SENSOR_INVERSE_SQRT,
      .held_out_designs = 64,
      .held_out_environments = 8,
  };
}

/* One short cosine, then a long one to the end: 5 + 61 + 1342 steps are 8 more than there are. */
static void set_phototaxis(struct mo_training_settings *settings)
{
  settings->batch = BATCH_PAPER;
  settings->schedule = (struct mo_schedule){.kind = MO_SCHEDULE_RESTARTS,
                                            .peak = 2e-3,
                                            .floor = 1e-5,
                                            .decay = 0.75,
                                            .cycle_steps = 61,
                                            .cycle_growth = 22,
                                            .warmup_steps = 5};
  settings->beta1 = 0.8;
  settings->adjoint_bound = 8.0;
  settings->adjoint_rule = MO_ADJOINT_RESTART;
  settings->restart_weight = 3.0;
}

static void set_paper(struct mo_training_settings *settings)
{
  const bool finetune = settings->kind == MO_TRAINING_FINETUNE;
  settings->batch = BATCH_PAPER;
  settings->schedule = finetune ? mo_schedule_paper_finetune() : mo_schedule_paper_pretrain();
  settings->adjoint_bound = 0.0;
}

struct mo_training_settings mo_training_preset(enum mo_training_kind kind,
                                               enum mo_learning_preset preset)
{
  struct mo_training_settings settings = mo_training_defaults(kind);
  if (preset == MO_LEARNING_PRESET_PHOTOTAXIS && kind == MO_TRAINING_PRETRAIN)
    set_phototaxis(&settings);
  else if (preset == MO_LEARNING_PRESET_PAPER)
    set_paper(&settings);
  return settings;
}

/* ---- bounds ---- */

static int check_numbers(const struct mo_training_settings *settings, struct mo_message *message)
{
  const struct mo_bounded numbers[] = {
      {"beta1", settings->beta1, 0.0, 1.0, false, true},
      {"beta2", settings->beta2, 0.0, 1.0, false, true},
      {"epsilon", settings->epsilon, 0.0, 1.0, true, false},
      {"gradient_norm_limit", settings->norm_limit, 0.0, MO_GRADIENT_NORM_LIMIT_MAX, false, false},
      {"adjoint_bound", settings->adjoint_bound, 0.0, MO_ADJOINT_BOUND_MAX, false, false},
      {"restart_weight", settings->restart_weight, 0.0, MO_RESTART_WEIGHT_MAX, false, false},
  };
  return mo_bounded_check(numbers, sizeof(numbers) / sizeof(numbers[0]), message);
}

static int check_counts(const struct mo_training_settings *settings, struct mo_message *message)
{
  const struct {
    const char *name;
    uint32_t value, low, high;
  } counts[] = {
      {"steps", settings->n_steps, 1, MO_TRAINING_STEPS_MAX},
      {"batch", settings->batch, 1, MO_TRAINING_BATCH_MAX},
      {"held-out designs", settings->held_out_designs, 0, MO_TRAINING_DESIGNS_MAX},
      {"held-out environments", settings->held_out_environments, 0, MO_HELD_OUT_ENVIRONMENTS_MAX},
  };
  for (size_t i = 0; i < sizeof(counts) / sizeof(counts[0]); i++)
    if (counts[i].value < counts[i].low || counts[i].value > counts[i].high)
      return mo_fail(message, MO_ERR_RANGE, "%s: %u; it must be %u to %u", counts[i].name,
                     counts[i].value, counts[i].low, counts[i].high);
  const uint64_t bodies = (uint64_t)settings->n_steps * settings->batch;
  if (settings->kind == MO_TRAINING_PRETRAIN && bodies > MO_TRAINING_BODIES_MAX)
    return mo_fail(message, MO_ERR_RANGE,
                   "steps × batch is %" PRIu64 "; a pretraining may draw %" PRIu64
                   " distinct bodies at most: lower the steps or the batch",
                   bodies, MO_TRAINING_BODIES_MAX);
  return MO_OK;
}

int mo_training_settings_check(const struct mo_training_settings *settings,
                               struct mo_message *message)
{
  if (settings->kind != MO_TRAINING_PRETRAIN && settings->kind != MO_TRAINING_FINETUNE)
    return mo_fail(message, MO_ERR_INVALID,
                   "kind of training is %d; it must be %d (pretrain) or %d (finetune)",
                   (int)settings->kind, (int)MO_TRAINING_PRETRAIN, (int)MO_TRAINING_FINETUNE);
  if (settings->sensor != MO_SENSOR_INVERSE_SQRT && settings->sensor != MO_SENSOR_INVERSE_SQUARE)
    return mo_fail(message, MO_ERR_INVALID,
                   "sensor is %d; it must be %d (inverse_sqrt) or %d (inverse_square)",
                   (int)settings->sensor, (int)MO_SENSOR_INVERSE_SQRT,
                   (int)MO_SENSOR_INVERSE_SQUARE);
  if (mo_adjoint_rule_name(settings->adjoint_rule)[0] == '?')
    return mo_fail(message, MO_ERR_INVALID,
                   "adjoint_rule is %d; it must be %d (clip) or %d (restart)",
                   (int)settings->adjoint_rule, (int)MO_ADJOINT_CLIP, (int)MO_ADJOINT_RESTART);
  int r = check_counts(settings, message);
  if (r == MO_OK)
    r = check_numbers(settings, message);
  if (r == MO_OK)
    r = mo_schedule_check(&settings->schedule, message);
  if (r == MO_OK)
    r = mo_physics_check(&settings->physics, message);
  return r;
}
