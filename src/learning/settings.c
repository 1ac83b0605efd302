/* settings.c: the settings of a training run: presets and bounds. */
#include "learning/fields.h"

#include <inttypes.h>

#define STEPS_PRETRAIN 1400
#define STEPS_FINETUNE 60
#define BATCH          256
#define BATCH_PAPER    8192

/* ---- presets ---- */

const char *const mo_learning_preset_words[] = {"workstation", "phototaxis", "paper", "robust",
                                                NULL};

struct mo_learning mo_learning_defaults(enum mo_schedule_preset schedule)
{
  struct mo_learning learning = {.schedule = mo_schedule_presets[schedule],
                                 .beta1 = 0.9,
                                 .beta2 = 0.999,
                                 .epsilon = 1e-8,
                                 .norm_limit = 1.0,
                                 .gradient = mo_default_gradient_options(),
                                 .vary = mo_factors_constant()};
  learning.gradient.weight = 0;
  return learning;
}

struct mo_training_settings mo_training_defaults(enum mo_training_kind kind)
{
  struct mo_training_settings settings = {
      .kind = kind,
      .seed = 1,
      .n_steps = kind == MO_TRAINING_FINETUNE ? STEPS_FINETUNE : STEPS_PRETRAIN,
      .batch = BATCH,
      .learning = mo_learning_defaults(kind == MO_TRAINING_FINETUNE ? MO_SCHEDULE_FINETUNE_COSINE
                                                                    : MO_SCHEDULE_ONE_COSINE),
      .physics = mo_default_physics(),
      .sensor = MO_SENSOR_INVERSE_SQRT,
      .held_out_designs = 64,
      .held_out_environments = 8,
  };
  if (kind == MO_TRAINING_PRETRAIN)
    settings.physics.scheme.control_period_s = MO_DEFAULT_CONTROL_PERIOD_S;
  return settings;
}

/* Sets one short cosine, then a long one to the end: 5 + 61 + 1342 steps, 8 more than the run
 * has. */
static void set_phototaxis(struct mo_training_settings *settings)
{
  settings->batch = BATCH_PAPER;
  settings->learning.schedule = (struct mo_schedule){.kind = MO_SCHEDULE_RESTARTS,
                                                     .peak = 2e-3,
                                                     .floor = 1e-5,
                                                     .decay = 0.75,
                                                     .cycle_steps = 61,
                                                     .cycle_growth = 22,
                                                     .warmup_steps = 5};
  settings->learning.beta1 = 0.8;
  settings->learning.gradient.adjoint_bound = 8.0;
  settings->learning.gradient.adjoint_rule = MO_ADJOINT_RESTART;
  settings->learning.gradient.restart_weight = 3.0;
}

/* Friction alone: a controller that learns with less friction gets better in all other worlds, too,
 * while other constants that vary cost more than they gain (docs/learning.md). */
static void set_robust(struct mo_training_settings *settings)
{
  set_phototaxis(settings);
  settings->learning.vary = mo_factors_constant();
  settings->learning.vary.given = true;
  settings->learning.vary.friction[0] = 0.4;
}

static void set_paper(struct mo_training_settings *settings)
{
  const bool finetune = settings->kind == MO_TRAINING_FINETUNE;
  settings->physics = mo_paper_physics();
  settings->batch = BATCH_PAPER;
  settings->learning.schedule =
      mo_schedule_presets[finetune ? MO_SCHEDULE_PAPER_FINETUNE : MO_SCHEDULE_PAPER_PRETRAIN];
  settings->learning.gradient.adjoint_bound = 0.0;
}

struct mo_training_settings mo_training_preset(enum mo_training_kind kind,
                                               enum mo_learning_preset preset)
{
  struct mo_training_settings settings = mo_training_defaults(kind);
  if (preset == MO_LEARNING_PRESET_PHOTOTAXIS && kind == MO_TRAINING_PRETRAIN)
    set_phototaxis(&settings);
  else if (preset == MO_LEARNING_PRESET_ROBUST && kind == MO_TRAINING_PRETRAIN)
    set_robust(&settings);
  else if (preset == MO_LEARNING_PRESET_PAPER)
    set_paper(&settings);
  return settings;
}

/* ---- bounds ---- */

static int check_together(const struct mo_training_settings *settings, struct mo_message *message)
{
  if (settings->held_out_designs > MO_TRAINING_DESIGNS_MAX)
    return mo_fail(message, MO_ERR_RANGE, "held-out designs must be at most %d, got %u",
                   MO_TRAINING_DESIGNS_MAX, settings->held_out_designs);
  if (settings->held_out_environments > MO_HELD_OUT_ENVIRONMENTS_MAX)
    return mo_fail(message, MO_ERR_RANGE, "held-out environments must be at most %d, got %u",
                   MO_HELD_OUT_ENVIRONMENTS_MAX, settings->held_out_environments);
  const uint64_t bodies = (uint64_t)settings->n_steps * settings->batch;
  if (settings->kind == MO_TRAINING_PRETRAIN && bodies > MO_TRAINING_BODIES_MAX)
    return mo_fail(message, MO_ERR_RANGE,
                   "steps × batch is %" PRIu64 "; a pretraining run may draw at most %" PRIu64
                   " distinct bodies, so lower the steps or the batch",
                   bodies, MO_TRAINING_BODIES_MAX);
  return MO_OK;
}

int mo_training_settings_check(const struct mo_training_settings *settings,
                               struct mo_message *message)
{
  struct mo_message why = {""};
  if (settings->kind != MO_TRAINING_PRETRAIN && settings->kind != MO_TRAINING_FINETUNE)
    return mo_fail(message, MO_ERR_INVALID,
                   "kind of training must be %d (pretrain) or %d (finetune), got %d",
                   (int)MO_TRAINING_PRETRAIN, (int)MO_TRAINING_FINETUNE, (int)settings->kind);
  int error = mo_fields_check(&mo_training_fields, "", settings, message);
  if (error == MO_OK)
    error = mo_physics_check(&settings->physics, message);
  if (error == MO_OK && mo_control_steps(&settings->physics.scheme) > MO_GRADIENT_PERIOD_MAX)
    error = mo_fail(message, MO_ERR_RANGE,
                    "control_period_s must be at most %d steps where a controller learns, got %u",
                    MO_GRADIENT_PERIOD_MAX, mo_control_steps(&settings->physics.scheme));
  if (error == MO_OK)
    error = mo_factor_ranges_check("vary", &settings->learning.vary, message);
  if (error == MO_OK)
    error = mo_physics_check_in(&settings->physics, NULL, &settings->learning.vary, &why);
  if (error != MO_OK && why.text[0] != '\0')
    return mo_fail(message, error, "vary puts constants out of range: %.180s", why.text);
  return error != MO_OK ? error : check_together(settings, message);
}
