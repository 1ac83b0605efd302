/* settings.c: names, presets, requests that must be refused with a reason, and the training run
 * inside a campaign. */
#include "fixture.h"

static void names(void)
{
  CHECK_TEXT(mo_campaign_mode_words[MO_FEW_SHOT], "few-shot");
  CHECK_TEXT(mo_selection_words[MO_SELECT_AGE_LAYERED], "age-layered");
  CHECK_TEXT(mo_preset_words[MO_PRESET_WORKSTATION], "workstation");
  CHECK_TEXT(mo_operator_words[MO_BORN_CROSSOVER], "crossover");
  CHECK(mo_campaign_mode_words[4] == NULL && mo_preset_words[3] == NULL &&
        mo_operator_words[MO_OPERATORS] == NULL);
}

static void presets(void)
{
  static const uint32_t populations[] = {8192, 512, 64};
  static const uint32_t generations[3][3] = {
      {100, 7, 180}, {100, 10, 180}, {30, 3, 30}}; /* preset, mode */
  for (int p = 0; p < 3; p++)
    for (int m = 0; m < 3; m++) {
      const struct mo_campaign_settings s =
          mo_campaign_preset((enum mo_campaign_mode)m, (enum mo_preset)p);
      struct mo_message message = {""};
      CHECK_INT(mo_campaign_settings_check(&s, &message), MO_OK);
      CHECK((int)s.mode == m && s.population == populations[p] &&
            s.generations == generations[p][m]);
      CHECK(s.mutation_share == 0.25 && s.mutation_rate == 0.0 && s.mutation_growth == 1.025);
      CHECK(s.selection.kind == MO_SELECT_TRUNCATION && s.exclude_pretraining && s.batch == 0);
      CHECK(s.workspace.nx == 6 && s.workspace.ny == 6 && s.workspace.nz == 4);
      CHECK(s.parent_steps == (m == 0 ? 0 : m == 1 ? 30 : 1) && s.child_steps == s.parent_steps);
      CHECK(s.learning.beta1 == 0.9 && s.learning.beta2 == 0.999 && s.learning.norm_limit == 1.0 &&
            s.learning.gradient.adjoint_bound == MO_ADJOINT_BOUND);
      CHECK_INT(s.learning.gradient.adjoint_rule, MO_ADJOINT_CLIP);
      CHECK(s.learning.gradient.restart_weight == MO_RESTART_WEIGHT);
    }
}

static void refused(void)
{
  static struct mo_campaign_settings s;
  enum { ZERO = MO_ZERO_SHOT, FEW = MO_FEW_SHOT, BOTH = MO_SIMULTANEOUS };
  static const struct {
    int mode;
    void *field;
    size_t size;
    double value;
    int code;
    const char *says;
  } cases[] = {
      {ZERO, FIELD(s.mode), 4, MO_ERR_INVALID,
       "mode must be 0 (zero-shot), 1 (few-shot), 2 (simultaneous) or 3 (study), got 4"},
      {ZERO, FIELD(s.selection.kind), 4, MO_ERR_INVALID,
       "\"truncation\", \"tournament\", \"novelty\" or \"age-layered\", got number 4"},
      {ZERO, FIELD(s.workspace.nx), 7, MO_ERR_RANGE, "1x1x1 to 6x6x4 voxels, got 7x6x4"},
      {ZERO, FIELD(s.workspace.nz), 5, MO_ERR_RANGE, "1x1x1 to 6x6x4 voxels, got 6x6x5"},
      {ZERO, FIELD(s.workspace.nz), 1, MO_OK, ""},
      {ZERO, FIELD(s.population), 1, MO_ERR_RANGE, "at least 2 and at most 65536, got 1"},
      {ZERO, FIELD(s.population), 65536, MO_OK, ""},
      {FEW, FIELD(s.population), 10001, MO_ERR_RANGE,
       "population is 10001; it must be at most 10000 in a campaign that"},
      {BOTH, FIELD(s.population), 10000, MO_OK, ""},
      {ZERO, FIELD(s.generations), 100001, MO_ERR_RANGE, "at most 100000, got 100001"},
      {ZERO, FIELD(s.generations), 0, MO_OK, ""},
      {ZERO, FIELD(s.generations), 32768, MO_ERR_RANGE,
       "population × (generations + 1) is 268443648"},
      {ZERO, FIELD(s.generations), 32767, MO_OK, ""},
      {ZERO, FIELD(s.mutation_share), 1.5, MO_ERR_RANGE, "at least 0 and at most 1, got 1.5"},
      {ZERO, FIELD(s.mutation_share), 1, MO_OK, ""},
      {ZERO, FIELD(s.mutation_rate), 0.51, MO_ERR_RANGE,
       "rate must be above 0 and at most 0.5, or null, got 0.51"},
      {ZERO, FIELD(s.mutation_growth), 0.9, MO_ERR_RANGE, "at least 1 and at most 2, got 0.9"},
      {ZERO, FIELD(s.mutation_growth), 1, MO_OK, ""},
      {ZERO, FIELD(s.selection.tournament_size), 1, MO_ERR_RANGE, "at least 2 and at most 64"},
      {ZERO, FIELD(s.selection.n_layers), 17, MO_ERR_RANGE, "at most 16, got 17"},
      {ZERO, FIELD(s.collapse_share), 2, MO_ERR_RANGE, "collapse_share must be at least 0"},
      {FEW, FIELD(s.parent_steps), 10001, MO_ERR_RANGE, "parent_steps must be at least 0"},
      {FEW, FIELD(s.parent_steps), 10000, MO_OK, ""},
      {BOTH, FIELD(s.parent_steps), 9999, MO_ERR_RANGE,
       "(parent_steps + child_steps) × generations is 1800001; it must be"},
      {ZERO, FIELD(s.parent_steps), 1e6, MO_OK, ""}, /* learning settings are not checked */
      {ZERO, FIELD(s.learning.beta1), 2, MO_OK, ""},
      {ZERO, FIELD(s.learning.schedule.peak), -1, MO_OK, ""},
      {FEW, FIELD(s.batch), 65537, MO_ERR_RANGE,
       "batch must be at least 1 and at most 65536, or null, got 65537"},
      {FEW, FIELD(s.learning.beta1), 1, MO_ERR_RANGE, "beta1 must be at least 0 and below 1"},
      {FEW, FIELD(s.learning.gradient.adjoint_bound), 0, MO_OK, ""},
      {FEW, FIELD(s.learning.gradient.adjoint_rule), MO_ADJOINT_RESTART, MO_OK, ""},
      {BOTH, FIELD(s.sensor), 2, MO_ERR_INVALID, "\"inverse_square\", got number 2"},
      {BOTH, FIELD(s.learning.schedule.peak), -1, MO_ERR_RANGE, "peak must be above 0"},
      {ZERO, FIELD(s.physics.scheme.dt_s), 1, MO_ERR_RANGE, "dt_s must be at least 1e-07"},
  };
  struct mo_message message;
  for (size_t i = 0; i < COUNT(cases); i++) {
    s = mo_campaign_preset((enum mo_campaign_mode)cases[i].mode, MO_PRESET_PAPER);
    set_field(cases[i].field, cases[i].size, cases[i].value);
    message.text[0] = '\0';
    CHECK_INT(mo_campaign_settings_check(&s, &message), cases[i].code);
    CHECK_INT(mo_campaign_settings_check(&s, NULL), cases[i].code);
    CHECK_SAYS(message, cases[i].says);
  }
  s = mo_campaign_preset(MO_FEW_SHOT, MO_PRESET_PAPER);
  s.parent_steps = s.child_steps = 0;
  CHECK_INT(mo_campaign_settings_check(&s, &message), MO_ERR_RANGE);
  CHECK_SAYS(message, "parent_steps and child_steps are both 0");
}

static double rate(const struct mo_training_settings *training, uint32_t step)
{
  return mo_schedule_rate(&training->learning.schedule, step, training->n_steps);
}

/* The paper: 60 steps of a cycle of 100 from 3.5e-4, which ends at about 1.5e-4. Each generation
 * starts afresh, with its own robots. */
static void few_shot(void)
{
  struct mo_campaign_settings s = mo_campaign_preset(MO_FEW_SHOT, MO_PRESET_PAPER);
  uint64_t seeds[100];
  for (uint32_t g = 0; g < 100; g++) {
    const struct mo_training_settings training = mo_campaign_training(&s, g);
    CHECK_INT(mo_training_settings_check(&training, NULL), MO_OK);
    CHECK(training.kind == MO_TRAINING_FINETUNE && training.n_steps == (g > 0 ? 60 : 30) &&
          training.batch == 8192);
    CHECK(training.held_out_designs == 0 && training.held_out_environments == 0);
    CHECK_NEAR(rate(&training, 0), 3.5e-4, 1e-12);
    CHECK_NEAR(rate(&training, 59), 1.5e-4, 2e-6);
    for (uint32_t t = 1; t < 60; t++)
      CHECK(rate(&training, t) < rate(&training, t - 1));
    seeds[g] = training.seed;
    CHECK(training.seed < UINT64_C(1) << 53);
    CHECK(mo_campaign_training(&s, g).seed == training.seed);
    for (uint32_t other = 0; other < g; other++)
      CHECK(seeds[other] != seeds[g]);
  }
  s.seed = 2;
  CHECK(mo_campaign_training(&s, 3).seed != seeds[3]);
  s.batch = 100;
  s.child_steps = 5;
  CHECK_INT(mo_campaign_training(&s, 1).learning.gradient.adjoint_rule, MO_ADJOINT_CLIP);
  CHECK(mo_campaign_training(&s, 1).learning.gradient.restart_weight == MO_RESTART_WEIGHT);
  s.learning.gradient.adjoint_rule = MO_ADJOINT_RESTART;
  s.learning.gradient.restart_weight = 0.5;
  CHECK_INT(mo_campaign_training(&s, 1).learning.gradient.adjoint_rule, MO_ADJOINT_RESTART);
  CHECK(mo_campaign_training(&s, 1).learning.gradient.restart_weight == 0.5);
  CHECK(mo_campaign_training(&s, 1).batch == 100 && mo_campaign_training(&s, 1).n_steps == 35);
}

/* Cycles of 10, 20, 40, … steps over the whole campaign; each starts at 0.65 times the previous
 * peak. */
static void simultaneous(void)
{
  struct mo_campaign_settings s = mo_campaign_preset(MO_SIMULTANEOUS, MO_PRESET_WORKSTATION);
  s.seed = 41;
  const struct mo_training_settings training = mo_campaign_training(&s, 9);
  CHECK_INT(mo_training_settings_check(&training, NULL), MO_OK);
  CHECK(training.n_steps == 361 && training.batch == 512 && training.seed == 41);
  double peak = 1e-3;
  for (uint32_t start = 0, length = 10; start < 360; start += length, length *= 2, peak *= 0.65) {
    CHECK_NEAR(rate(&training, start), peak, 1e-12);
    if (start + length < 360)
      CHECK(rate(&training, start + length - 1) < 0.1 * peak + 1e-5);
  }
  CHECK(mo_campaign_training(&s, 1).seed == training.seed);
  s.generations = 0; /* nothing is learned, but the training run can be created */
  CHECK_INT(mo_campaign_training(&s, 0).n_steps, 1);
}

static const struct check_case cases[] = {
    {"names in both directions", names},
    {"presets", presets},
    {"settings that are refused, and why", refused},
    {"few-shot: each generation's training", few_shot},
    {"simultaneous: one training", simultaneous},
};
CHECK_MAIN(cases)
