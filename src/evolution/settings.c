/* settings.c: what a campaign is asked to do: names, presets and bounds. */
#include "evolution/internal.h"

#include <inttypes.h>
#include <string.h>

#include "base/number.h"

#define MODES      3
#define SELECTIONS 4
#define PRESETS    3

#define TOURNAMENT_MAX 64
#define LAYERS_MAX     16
#define AGE_GAP_MAX    1000

static const char *const mode_names[MODES] = {"zero-shot", "few-shot", "simultaneous"};
static const char *const selection_names[SELECTIONS] = {"truncation", "tournament", "novelty",
                                                        "age-layered"};
static const char *const preset_names[PRESETS] = {"paper", "workstation", "demo"};
static const char *const operator_names[MO_OPERATORS] = {"random", "listed", "inherited",
                                                         "mutation", "crossover"};

static const char *name_of(const char *const *names, unsigned n, unsigned i)
{
  return i < n ? names[i] : "unknown";
}

static int find(const char *const *names, unsigned n, const char *name, unsigned *found)
{
  for (unsigned i = 0; i < n; i++)
    if (strcmp(name, names[i]) == 0) {
      *found = i;
      return MO_OK;
    }
  return MO_ERR_NOT_FOUND;
}

const char *mo_campaign_mode_name(enum mo_campaign_mode mode)
{
  return name_of(mode_names, MODES, (unsigned)mode);
}

int mo_campaign_mode_from_name(const char *name, enum mo_campaign_mode *mode)
{
  unsigned i = 0;
  const int r = find(mode_names, MODES, name, &i);
  if (r == MO_OK)
    *mode = (enum mo_campaign_mode)i;
  return r;
}

const char *mo_selection_name(enum mo_selection_kind kind)
{
  return name_of(selection_names, SELECTIONS, (unsigned)kind);
}

int mo_selection_from_name(const char *name, enum mo_selection_kind *kind)
{
  unsigned i = 0;
  const int r = find(selection_names, SELECTIONS, name, &i);
  if (r == MO_OK)
    *kind = (enum mo_selection_kind)i;
  return r;
}

const char *mo_preset_name(enum mo_preset preset)
{
  return name_of(preset_names, PRESETS, (unsigned)preset);
}

int mo_preset_from_name(const char *name, enum mo_preset *preset)
{
  unsigned i = 0;
  const int r = find(preset_names, PRESETS, name, &i);
  if (r == MO_OK)
    *preset = (enum mo_preset)i;
  return r;
}

const char *mo_operator_name(enum mo_operator birth)
{
  return name_of(operator_names, MO_OPERATORS, (unsigned)birth);
}

/* ---- presets ---- */

struct mo_campaign_settings mo_campaign_preset(enum mo_campaign_mode mode, enum mo_preset preset)
{
  static const uint32_t populations[PRESETS] = {8192, 512, 64};
  static const uint32_t generations[PRESETS][MODES] = {{100, 7, 180}, {100, 10, 180}, {30, 3, 30}};
  static const uint32_t steps[MODES] = {0, 30, 1};
  const unsigned p = (unsigned)preset < PRESETS ? (unsigned)preset : MO_PRESET_PAPER;
  const unsigned m = (unsigned)mode < MODES ? (unsigned)mode : MO_ZERO_SHOT;
  return (struct mo_campaign_settings){
      .mode = (enum mo_campaign_mode)m,
      .seed = 1,
      .workspace = MO_DEFAULT_WORKSPACE,
      .population = populations[p],
      .generations = generations[p][m],
      .mutation_share = 0.25,
      .mutation_rate = 0.0,
      .mutation_growth = 1.025,
      .selection = {.kind = MO_SELECT_TRUNCATION,
                    .tournament_size = 4,
                    .novelty_weight = 0.5,
                    .n_layers = 4,
                    .age_gap = 5},
      .exclude_pretraining = true,
      .collapse_share = 0.5,
      .parent_steps = steps[m],
      .child_steps = steps[m],
      .batch = 0,
      .schedule =
          m == MO_SIMULTANEOUS ? mo_schedule_paper_simultaneous() : mo_schedule_paper_finetune(),
      .beta1 = 0.9,
      .beta2 = 0.999,
      .epsilon = 1e-8,
      .norm_limit = 1.0,
      .adjoint_bound = MO_ADJOINT_BOUND,
      .adjoint_rule = MO_ADJOINT_CLIP,
      .restart_weight = MO_RESTART_WEIGHT,
      .sensor = MO_SENSOR_INVERSE_SQRT,
      .physics = mo_default_physics(),
  };
}

/* ---- bounds ---- */

static int check_kinds(const struct mo_campaign_settings *settings, struct mo_message *message)
{
  if ((unsigned)settings->mode >= MODES)
    return mo_fail(message, MO_ERR_INVALID,
                   "mode is %d; it must be 0 (zero-shot), 1 (few-shot) or 2 (simultaneous)",
                   (int)settings->mode);
  if ((unsigned)settings->selection.kind >= SELECTIONS)
    return mo_fail(message, MO_ERR_INVALID,
                   "selection is %d; it must be 0 (truncation), 1 (tournament), 2 (novelty) or 3 "
                   "(age-layered)",
                   (int)settings->selection.kind);
  const struct mo_workspace most = MO_DEFAULT_WORKSPACE;
  const struct mo_workspace w = settings->workspace;
  if (w.nx < 1 || w.ny < 1 || w.nz < 1 || w.nx > most.nx || w.ny > most.ny || w.nz > most.nz)
    return mo_fail(
        message, MO_ERR_RANGE,
        "workspace is %ux%ux%u voxels; it must be 1x1x1 to %ux%ux%u, which controllers are for",
        w.nx, w.ny, w.nz, most.nx, most.ny, most.nz);
  return MO_OK;
}

static int check_counts(const struct mo_campaign_settings *settings, struct mo_message *message)
{
  const struct {
    const char *name;
    uint32_t value, low, high;
  } counts[] = {
      {"population", settings->population, MO_POPULATION_MIN, MO_POPULATION_MAX},
      {"generations", settings->generations, 0, MO_GENERATIONS_MAX},
      {"tournament_size", settings->selection.tournament_size, 2, TOURNAMENT_MAX},
      {"layers", settings->selection.n_layers, 2, LAYERS_MAX},
      {"age_gap", settings->selection.age_gap, 1, AGE_GAP_MAX},
  };
  for (size_t i = 0; i < sizeof(counts) / sizeof(counts[0]); i++)
    if (counts[i].value < counts[i].low || counts[i].value > counts[i].high)
      return mo_fail(message, MO_ERR_RANGE, "%s is %" PRIu32 "; it must be %" PRIu32 " to %" PRIu32,
                     counts[i].name, counts[i].value, counts[i].low, counts[i].high);
  const uint64_t designs = (uint64_t)settings->population * (settings->generations + UINT64_C(1));
  if (designs > MO_CAMPAIGN_DESIGNS_MAX)
    return mo_fail(message, MO_ERR_RANGE,
                   "population × (generations + 1) is %" PRIu64 "; a campaign may have %" PRIu64
                   " designs at most: lower the population or the generations",
                   designs, MO_CAMPAIGN_DESIGNS_MAX);
  return MO_OK;
}

static int check_variation(const struct mo_campaign_settings *settings, struct mo_message *message)
{
  const struct mo_bounded numbers[] = {
      {"mutation_share", settings->mutation_share, 0.0, 1.0, false, false},
      {"mutation_rate", settings->mutation_rate, 0.0, 0.5, false, false},
      {"mutation_growth", settings->mutation_growth, 1.0, 2.0, false, false},
      {"novelty_weight", settings->selection.novelty_weight, 0.0, 1.0, false, false},
      {"collapse_share", settings->collapse_share, 0.0, 1.0, false, false},
  };
  return mo_bounded_check(numbers, sizeof(numbers) / sizeof(numbers[0]), message);
}

static int check_steps(const struct mo_campaign_settings *settings, struct mo_message *message)
{
  const uint32_t steps[] = {settings->parent_steps, settings->child_steps};
  static const char *const names[] = {"parent_steps", "child_steps"};
  for (int i = 0; i < 2; i++)
    if (steps[i] > MO_CAMPAIGN_STEPS_MAX)
      return mo_fail(message, MO_ERR_RANGE, "%s is %" PRIu32 "; it must be 0 to %d", names[i],
                     steps[i], MO_CAMPAIGN_STEPS_MAX);
  if (steps[0] + steps[1] == 0)
    return mo_fail(message, MO_ERR_RANGE,
                   "parent_steps and child_steps are both 0; a campaign that learns needs a step "
                   "in each generation");
  const uint64_t all = steps[1] + (uint64_t)(steps[0] + steps[1]) * settings->generations;
  if (settings->mode == MO_SIMULTANEOUS && all > MO_TRAINING_STEPS_MAX)
    return mo_fail(message, MO_ERR_RANGE,
                   "child_steps + (parent_steps + child_steps) × generations is %" PRIu64
                   "; it must be at most %d",
                   all, MO_TRAINING_STEPS_MAX);
  return MO_OK;
}

/* What a campaign says in its own words; the rest is that of the training inside. */
static int check_learning(const struct mo_campaign_settings *settings, struct mo_message *message)
{
  if (settings->population > MO_TRAINING_DESIGNS_MAX)
    return mo_fail(message, MO_ERR_RANGE,
                   "population is %" PRIu32
                   "; it must be at most %d in a campaign that learns (few-shot, "
                   "simultaneous)",
                   settings->population, MO_TRAINING_DESIGNS_MAX);
  if (settings->batch > MO_TRAINING_BATCH_MAX)
    return mo_fail(message, MO_ERR_RANGE,
                   "batch is %" PRIu32 "; it must be 1 to %d, or 0 for the population",
                   settings->batch, MO_TRAINING_BATCH_MAX);
  int r = check_steps(settings, message);
  if (r != MO_OK)
    return r;
  const struct mo_training_settings training = mo_campaign_training(settings, 0);
  return mo_training_settings_check(&training, message);
}

int mo_campaign_settings_check(const struct mo_campaign_settings *settings,
                               struct mo_message *message)
{
  int r = check_kinds(settings, message);
  if (r == MO_OK)
    r = check_counts(settings, message);
  if (r == MO_OK)
    r = check_variation(settings, message);
  if (r == MO_OK && settings->mode != MO_ZERO_SHOT)
    r = check_learning(settings, message);
  if (r == MO_OK)
    r = mo_physics_check(&settings->physics, message);
  return r;
}

/* ---- the training inside ---- */

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
  if (settings->mode != MO_SIMULTANEOUS) {
    struct mo_random random;
    mo_random_init(&random, settings->seed, MO_PURPOSE_EVOLUTION_SEED, generation, 0);
    training.seed = mo_random_u64(&random) >> 11;
    training.n_steps = generation > 0 ? steps : first;
  }
  training.batch = settings->batch > 0 ? settings->batch : settings->population;
  training.schedule = settings->schedule;
  training.beta1 = settings->beta1;
  training.beta2 = settings->beta2;
  training.epsilon = settings->epsilon;
  training.norm_limit = settings->norm_limit;
  training.adjoint_bound = settings->adjoint_bound;
  training.adjoint_rule = settings->adjoint_rule;
  training.restart_weight = settings->restart_weight;
  training.physics = settings->physics;
  training.sensor = settings->sensor;
  training.held_out_designs = 0;
  training.held_out_environments = 0;
  return training;
}
