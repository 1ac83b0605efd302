/* settings.c: the settings of a campaign: names, presets and bounds. */
#include "evolution/internal.h"

#include <inttypes.h>

#include "evolution/fields.h"

const char *const mo_campaign_mode_words[] = {"zero-shot", "few-shot", "simultaneous", "study",
                                              NULL};
const char *const mo_preset_words[] = {"paper", "workstation", "demo", NULL};
const char *const mo_operator_words[] = {"random",   "listed",    "inherited",
                                         "mutation", "crossover", NULL};

const struct mo_mode mo_modes[] = {
    [MO_ZERO_SHOT] = {.makes_children = true,
                      .generations = {100, 100, 30},
                      .schedule = MO_SCHEDULE_PAPER_FINETUNE},
    [MO_FEW_SHOT] = {.makes_children = true,
                     .learns = true,
                     .generations = {7, 10, 3},
                     .steps = 30,
                     .schedule = MO_SCHEDULE_PAPER_FINETUNE},
    [MO_SIMULTANEOUS] = {.makes_children = true,
                         .learns = true,
                         .inherits_learning = true,
                         .starts_untrained = true,
                         .generations = {180, 180, 30},
                         .steps = 1,
                         .schedule = MO_SCHEDULE_PAPER_SIMULTANEOUS},
    [MO_STUDY] = {.schedule = MO_SCHEDULE_PAPER_FINETUNE},
};
#define MODES (sizeof(mo_modes) / sizeof(mo_modes[0]))
_Static_assert(MODES + 1 == sizeof(mo_campaign_mode_words) / sizeof(mo_campaign_mode_words[0]),
               "each mode has a word");

/* ---- presets ---- */

struct mo_campaign_settings mo_campaign_preset(enum mo_campaign_mode mode, enum mo_preset preset)
{
  static const uint32_t populations[MO_PRESETS] = {8192, 512, 64};
  const unsigned p = (unsigned)preset < MO_PRESETS ? (unsigned)preset : MO_PRESET_PAPER;
  const unsigned m = (unsigned)mode < MODES ? (unsigned)mode : MO_ZERO_SHOT;
  struct mo_campaign_settings settings = {
      .mode = (enum mo_campaign_mode)m,
      .seed = 1,
      .workspace = MO_DEFAULT_WORKSPACE,
      .population = populations[p],
      .generations = mo_modes[m].generations[p],
      .mutation_share = 0.25,
      .mutation_rate = 0.0,
      .mutation_growth = 1.025,
      .selection = {.kind = MO_SELECT_TRUNCATION,
                    .tournament_size = 4,
                    .novelty_weight = 0.5,
                    .n_layers = 4,
                    .age_gap = 5},
      .aggregate = {.kind = MO_AGGREGATE_MEAN, .level = 0.9, .weight = 1},
      .exclude_pretraining = mo_modes[m].makes_children,
      .collapse_share = 0.5,
      .parent_steps = mo_modes[m].steps,
      .child_steps = mo_modes[m].steps,
      .batch = 0,
      .learning = mo_learning_defaults(mo_modes[m].schedule),
      .sensor = MO_SENSOR_INVERSE_SQRT,
      .physics = p == MO_PRESET_PAPER ? mo_paper_physics() : mo_default_physics(),
  };
  if (p != MO_PRESET_PAPER && mo_modes[m].starts_untrained)
    settings.physics.scheme.control_period_s = MO_DEFAULT_CONTROL_PERIOD_S;
  return settings;
}

/* ---- bounds ---- */

static int check_designs(const struct mo_campaign_settings *settings, struct mo_message *message)
{
  const uint64_t designs = (uint64_t)settings->population * (settings->generations + UINT64_C(1));
  if (designs > MO_CAMPAIGN_DESIGNS_MAX)
    return mo_fail(message, MO_ERR_RANGE,
                   "population × (generations + 1) is %" PRIu64
                   "; a campaign may have at most %" PRIu64
                   " designs, so lower the population or the generations",
                   designs, MO_CAMPAIGN_DESIGNS_MAX);
  return MO_OK;
}

static int check_steps(const struct mo_campaign_settings *settings, struct mo_message *message)
{
  const uint32_t steps[] = {settings->parent_steps, settings->child_steps};
  if (steps[0] + steps[1] == 0)
    return mo_fail(message, MO_ERR_RANGE,
                   "parent_steps and child_steps are both 0; a campaign that learns needs a step "
                   "in each generation");
  const uint64_t all = steps[1] + (uint64_t)(steps[0] + steps[1]) * settings->generations;
  if (mo_modes[settings->mode].inherits_learning && all > MO_TRAINING_STEPS_MAX)
    return mo_fail(message, MO_ERR_RANGE,
                   "child_steps + (parent_steps + child_steps) × generations is %" PRIu64
                   "; it must be at most %d",
                   all, MO_TRAINING_STEPS_MAX);
  return MO_OK;
}

/* Checks the learning settings that only campaigns have; the check of training settings covers the
 * rest. */
static int check_learning(const struct mo_campaign_settings *settings, struct mo_message *message)
{
  if (settings->population > MO_TRAINING_DESIGNS_MAX)
    return mo_fail(message, MO_ERR_RANGE,
                   "population is %" PRIu32
                   "; it must be at most %d in a campaign that learns (few-shot, simultaneous)",
                   settings->population, MO_TRAINING_DESIGNS_MAX);
  int r = mo_fields_check(&mo_campaign_learning_fields, "", settings, message);
  if (r == MO_OK)
    r = check_steps(settings, message);
  if (r != MO_OK)
    return r;
  const struct mo_training_settings training = mo_campaign_training(settings, 0);
  return mo_training_settings_check(&training, message);
}

int mo_campaign_settings_check(const struct mo_campaign_settings *settings,
                               struct mo_message *message)
{
  if ((unsigned)settings->mode >= MODES)
    return mo_fail(message, MO_ERR_INVALID,
                   "mode must be 0 (zero-shot), 1 (few-shot), 2 (simultaneous) or 3 (study), got "
                   "%d",
                   (int)settings->mode);
  int r = mo_fields_check(&mo_campaign_fields, "", settings, message);
  if (r == MO_OK)
    r = mo_fields_check(&mo_campaign_aggregate_fields, "", settings, message);
  if (r == MO_OK)
    r = mo_physics_check(&settings->physics, message);
  if (r == MO_OK)
    r = check_designs(settings, message);
  return r == MO_OK && mo_modes[settings->mode].learns ? check_learning(settings, message) : r;
}

/* ---- the settings of its training run ---- */

struct mo_training_settings mo_campaign_training(const struct mo_campaign_settings *settings,
                                                 uint32_t generation)
{
  struct mo_training_settings training = mo_training_defaults(MO_TRAINING_FINETUNE);
  const uint32_t first =
      settings->child_steps > 0 ? settings->child_steps : 1; /* generation 0 has no parents */
  const uint32_t steps = settings->parent_steps + settings->child_steps;
  training.seed = settings->seed;
  training.n_steps =
      settings->generations > 0 ? settings->child_steps + steps * settings->generations : first;
  if (!mo_modes[settings->mode].inherits_learning) {
    struct mo_random random;
    mo_random_init(&random, settings->seed, MO_PURPOSE_EVOLUTION_SEED, generation, 0);
    training.seed = mo_random_u64(&random) >> 11;
    training.n_steps = generation > 0 ? steps : first;
  }
  training.batch = settings->batch > 0 ? settings->batch : settings->population;
  training.learning = settings->learning;
  training.physics = settings->physics;
  training.sensor = settings->sensor;
  training.held_out_designs = 0;
  training.held_out_environments = 0;
  return training;
}
