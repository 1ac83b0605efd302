/* settings.c: presets, settings that must be refused with a reason, and initial weights. */
#include "fixture.h"

#include "rollout/physics.h"
#include "world/factors.h"

static void presets(void)
{
  static const struct mo_schedule one_cosine = {MO_SCHEDULE_COSINE, 2e-3, 1e-5, 1, 1, 1, 10},
                                  finetune = {MO_SCHEDULE_COSINE, 3e-4, 1e-6, 1, 100, 1, 0},
                                  shipped = {MO_SCHEDULE_RESTARTS, 2e-3, 1e-5, 0.75, 61, 22, 5},
                                  paper = {MO_SCHEDULE_RESTARTS, 1e-3, 1e-5, 0.7, 10, 2, 0},
                                  paper_finetune = {
                                      MO_SCHEDULE_RESTARTS, 3.5e-4, 3.5e-5, 1, 100, 1, 0};
  static const struct {
    uint32_t n_steps, batch;
    const struct mo_schedule *schedule;
    double beta1, bound;
    enum mo_adjoint_rule rule;
  } all[2][4] = {{{1400, 256, &one_cosine, 0.9, 2, MO_ADJOINT_CLIP},
                  {1400, 8192, &shipped, 0.8, 8, MO_ADJOINT_RESTART},
                  {1400, 8192, &paper, 0.9, 0, MO_ADJOINT_CLIP},
                  {1400, 8192, &shipped, 0.8, 8, MO_ADJOINT_RESTART}},
                 {{60, 256, &finetune, 0.9, 2, MO_ADJOINT_CLIP},
                  {60, 256, &finetune, 0.9, 2, MO_ADJOINT_CLIP}, /* phototaxis has none */
                  {60, 8192, &paper_finetune, 0.9, 0, MO_ADJOINT_CLIP},
                  {60, 256, &finetune, 0.9, 2, MO_ADJOINT_CLIP}}}; /* nor has robust */
  for (int kind = 0; kind < 2; kind++)
    for (int preset = 0; preset < 4; preset++) {
      const struct mo_training_settings s =
          mo_training_preset((enum mo_training_kind)kind, (enum mo_learning_preset)preset);
      const struct mo_schedule *a = &s.learning.schedule, *b = all[kind][preset].schedule;
      CHECK_INT(mo_training_settings_check(&s, NULL), MO_OK);
      CHECK((int)s.kind == kind && s.seed == 1 && s.n_steps == all[kind][preset].n_steps &&
            s.batch == all[kind][preset].batch);
      CHECK(a->kind == b->kind && a->peak == b->peak && a->floor == b->floor);
      CHECK(a->decay == b->decay && a->cycle_steps == b->cycle_steps &&
            a->cycle_growth == b->cycle_growth && a->warmup_steps == b->warmup_steps);
      CHECK(s.learning.beta1 == all[kind][preset].beta1 && s.learning.beta2 == 0.999 &&
            s.learning.epsilon == 1e-8 && s.learning.norm_limit == 1);
      CHECK(s.learning.gradient.adjoint_bound == all[kind][preset].bound &&
            s.learning.gradient.adjoint_rule == all[kind][preset].rule &&
            s.learning.gradient.restart_weight == 3);
      struct mo_physics physics = preset == 2 ? mo_paper_physics() : mo_default_physics();
      if (kind == MO_TRAINING_PRETRAIN && preset != 2)
        physics.scheme.control_period_s = 0.016;
      CHECK(mo_physics_equal(&s.physics, &physics));
      CHECK(s.sensor == MO_SENSOR_INVERSE_SQRT && s.held_out_designs == 64 &&
            s.held_out_environments == 8);
    }
}

/* `robust` is `phototaxis` with ranges, and no other preset varies anything. */
static void robust(void)
{
  for (int kind = 0; kind < 2; kind++)
    for (int preset = 0; preset < 4; preset++) {
      const struct mo_training_settings s =
          mo_training_preset((enum mo_training_kind)kind, (enum mo_learning_preset)preset);
      const struct mo_factor_ranges *vary = &s.learning.vary;
      CHECK(mo_factors_vary(vary) == (preset == 3 && kind == MO_TRAINING_PRETRAIN));
      if (!mo_factors_vary(vary))
        continue;
      CHECK(vary->friction[0] == 0.4 && vary->friction[1] == 1);
      CHECK(vary->stiffness[0] == 1 && vary->mass[1] == 1 && vary->drag[0] == 1 &&
            vary->gravity[1] == 1 && vary->actuation[0] == 1);
      CHECK(vary->drop_m[1] == 0 && vary->slope_degrees[1] == 0);
    }
}

static void preset_names(void)
{
  static const char *const names[] = {"workstation", "phototaxis", "paper", "robust"};
  for (int i = 0; i < 4; i++)
    CHECK_TEXT(mo_learning_preset_words[i], names[i]);
  CHECK(mo_learning_preset_words[4] == NULL);
}

/* Removes the first occurrence of `part`, which must exist. */
static void cut_out(char *text, const char *part)
{
  char *at = strstr(text, part);
  REQUIRE(at != NULL);
  memmove(at, at + strlen(part), strlen(at + strlen(part)) + 1);
}

/* A shipped controller says of itself what these settings would make it say. The one for the
 * paper's physics is older than restart_weight, which was 3, control_period_s, which was 0, and
 * integrator, which was paper. */
static void expect_settings(const char *name, const struct mo_training_settings *settings)
{
  char expected[2048];
  struct mo_controller *file = make_shipped_controller(name), *made = NULL;
  struct mo_training *training = make_training(settings, NULL, NULL, 0);
  REQUIRE(mo_training_export(training, NULL, "", NULL, &made) == MO_OK);
  const char *is = mo_controller_get_metadata(file, "morphod.settings");
  const char *would_be = mo_controller_get_metadata(made, "morphod.settings");
  REQUIRE(is != NULL && would_be != NULL);
  snprintf(expected, sizeof(expected), "%s", would_be);
  if (strstr(is, "restart_weight") == NULL)
    cut_out(expected, ",\"restart_weight\":3");
  if (strstr(is, "vary") == NULL)
    cut_out(expected, ",\"vary\":null");
  if (strstr(is, "control_period_s") == NULL)
    cut_out(expected, ",\"control_period_s\":0");
  if (strstr(is, "integrator") == NULL)
    cut_out(expected, ",\"integrator\":\"paper\"");
  CHECK_TEXT(is, expected);
  static const char *const same[] = {"morphod.kind", "morphod.parent", "morphod.seed"};
  for (int i = 0; i < 3; i++)
    CHECK_TEXT(mo_controller_get_metadata(file, same[i]),
               mo_controller_get_metadata(made, same[i]));
  CHECK_TEXT(mo_controller_get_metadata(file, "morphod.step"), "1400");
  CHECK_INT(file->sensor, settings->sensor);
  mo_controller_free(made);
}

static void shipped(void)
{
  struct mo_training_settings settings =
      mo_training_preset(MO_TRAINING_PRETRAIN, MO_LEARNING_PRESET_PHOTOTAXIS);
  expect_settings("phototaxis-16ms", &settings);
  settings.physics = mo_paper_physics();
  expect_settings("phototaxis", &settings);
}

/* ---- refused settings ---- */

static void refused_settings(void)
{
  static struct mo_training_settings s;
  static const struct field_case cases[] = {
      {FIELD(s.kind), 2, MO_ERR_INVALID,
       "kind of training must be 0 (pretrain) or 1 (finetune), got 2"},
      {FIELD(s.n_steps), 0, MO_ERR_RANGE, "steps must be at least 1 and at most 1000000, got 0"},
      {FIELD(s.batch), 0, MO_ERR_RANGE, "batch must be at least 1 and at most 65536, got 0"},
      {FIELD(s.learning.beta1), 1, MO_ERR_RANGE,
       "adam.beta1 must be at least 0 and below 1, got 1"},
      {FIELD(s.learning.beta1), NAN, MO_ERR_INVALID, "below 1, got a number that is not finite"},
      {FIELD(s.learning.epsilon), 0, MO_ERR_RANGE,
       "adam.epsilon must be above 0 and at most 1, got 0"},
      {FIELD(s.learning.norm_limit), -1, MO_ERR_RANGE,
       "gradient_norm_limit must be at least 0 and at most 1e+06, got -1"},
      {FIELD(s.learning.gradient.adjoint_rule), 2, MO_ERR_INVALID,
       "adjoint_rule must be \"clip\" or \"restart\", got number 2"},
      {FIELD(s.learning.gradient.adjoint_rule), MO_ADJOINT_RESTART, MO_OK, ""},
      {FIELD(s.learning.gradient.restart_weight), 1000000.0000001, MO_ERR_RANGE,
       "got 1000000.0000001"},
      {FIELD(s.learning.gradient.restart_weight), MO_RESTART_WEIGHT_MAX, MO_OK, ""},
      {FIELD(s.sensor), 2, MO_ERR_INVALID, "inverse_sqrt"},
      {FIELD(s.held_out_designs), 10001, MO_ERR_RANGE,
       "held-out designs must be at most 10000, got 10001"},
      {FIELD(s.held_out_environments), 0, MO_OK, ""},
      {FIELD(s.learning.schedule.peak), -1e-3, MO_ERR_RANGE,
       "schedule.peak must be above 0 and at most 1, got -0.001"},
      {FIELD(s.physics.scheme.dt_s), 1, MO_ERR_RANGE,
       "physics.dt_s must be at least 1e-07 and at most 0.1, got 1"},
  };
  struct mo_message message;
  for (size_t i = 0; i < COUNT(cases); i++) {
    s = mo_training_defaults(MO_TRAINING_PRETRAIN);
    set_field(cases[i].field, cases[i].size, cases[i].value);
    message.text[0] = '\0';
    CHECK_INT(mo_training_settings_check(&s, &message), cases[i].code);
    CHECK_SAYS(message, cases[i].says);
  }
  s = mo_training_defaults(MO_TRAINING_PRETRAIN);
  s.n_steps = MO_TRAINING_STEPS_MAX;
  CHECK_INT(mo_training_settings_check(&s, NULL), MO_OK);
  s.batch = 8192;
  CHECK_INT(mo_training_settings_check(&s, &message), MO_ERR_RANGE);
  CHECK_SAYS(message, "steps × batch is 8192000000");
  s.kind = MO_TRAINING_FINETUNE; /* draws no bodies */
  CHECK_INT(mo_training_settings_check(&s, NULL), MO_OK);
}

/* A parent passes on its weights and its sensor. */
static void from_a_parent(void)
{
  const struct mo_training_settings pretrain = mo_training_defaults(MO_TRAINING_PRETRAIN);
  struct mo_controller *parent = make_controller(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQUARE);
  parent->parameters[17] = 0.25F;
  struct mo_training *training = make_training(&pretrain, parent, NULL, 0);
  CHECK(mo_training_controller(training)->parameters[17] == 0.25F);
  CHECK_INT(mo_training_controller(training)->sensor, MO_SENSOR_INVERSE_SQUARE);
  CHECK_INT(mo_training_settings_of(training)->sensor, MO_SENSOR_INVERSE_SQUARE);
  mo_training_free(NULL);
}

/* Random weights come from the seed: equal seeds give equal weights, different seeds different
 * ones. */
static void initial_weights(void)
{
  const struct mo_controller *c[3];
  for (int i = 0; i < 3; i++) {
    struct mo_training_settings s = mo_training_defaults(MO_TRAINING_PRETRAIN);
    s.seed = i == 2 ? 9 : 8;
    c[i] = mo_training_controller(make_training(&s, NULL, NULL, 0));
  }
  CHECK(SAME(c[0]->parameters, c[1]->parameters, c[0]->n_parameters));
  CHECK(!SAME(c[0]->parameters, c[2]->parameters, c[0]->n_parameters));
  CHECK(c[0]->norm_gain[1][5] == 1.0F && c[0]->bias[2][7] == 0.0F);
}

static const struct check_case cases[] = {
    {"presets", presets},
    {"what robust varies", robust},
    {"names of presets", preset_names},
    {"the shipped controller has the settings of its preset", shipped},
    {"invalid settings are refused with a reason", refused_settings},
    {"the weights and the sensor of a parent", from_a_parent},
    {"initial weights", initial_weights},
};
CHECK_MAIN(cases)
