/* settings.c: presets, and requests that must be refused with a reason. */
#include "fixture.h"

static void defaults(void)
{
  const struct mo_training_settings pretrain = mo_training_defaults(MO_TRAINING_PRETRAIN);
  const struct mo_training_settings finetune = mo_training_defaults(MO_TRAINING_FINETUNE);
  CHECK_INT(mo_training_settings_check(&pretrain, NULL), MO_OK);
  CHECK_INT(mo_training_settings_check(&finetune, NULL), MO_OK);
  CHECK(pretrain.n_steps == 1400 && pretrain.batch == 256 && finetune.n_steps == 60);
  CHECK(pretrain.learning.schedule.kind == MO_SCHEDULE_COSINE &&
        pretrain.learning.adjoint_bound == 2.0 && pretrain.learning.norm_limit == 1.0);
  CHECK(pretrain.learning.adjoint_rule == MO_ADJOINT_CLIP &&
        finetune.learning.adjoint_rule == MO_ADJOINT_CLIP);
  CHECK(pretrain.learning.restart_weight == 3.0 && finetune.learning.restart_weight == 3.0);
  CHECK(pretrain.learning.beta1 == 0.9 && pretrain.learning.beta2 == 0.999);
}

/* ---- presets ---- */

static void check_schedule(const struct mo_schedule *actual, struct mo_schedule expected)
{
  CHECK(actual->kind == expected.kind && actual->peak == expected.peak &&
        actual->floor == expected.floor);
  CHECK(actual->decay == expected.decay && actual->cycle_steps == expected.cycle_steps);
  CHECK(actual->cycle_growth == expected.cycle_growth &&
        actual->warmup_steps == expected.warmup_steps);
}

static void check_preset(enum mo_training_kind kind, enum mo_learning_preset preset,
                         struct mo_training_settings expected)
{
  const struct mo_training_settings s = mo_training_preset(kind, preset);
  CHECK_INT(mo_training_settings_check(&s, NULL), MO_OK);
  CHECK(s.kind == kind && s.seed == 1 && s.n_steps == expected.n_steps &&
        s.batch == expected.batch);
  check_schedule(&s.learning.schedule, expected.learning.schedule);
  CHECK(s.learning.beta1 == expected.learning.beta1 && s.learning.beta2 == 0.999 &&
        s.learning.epsilon == 1e-8 && s.learning.norm_limit == 1);
  CHECK(s.learning.adjoint_bound == expected.learning.adjoint_bound &&
        s.learning.adjoint_rule == expected.learning.adjoint_rule &&
        s.learning.restart_weight == 3);
  CHECK(s.physics.n_steps == 1000 && s.physics.dt_s == 0.004 &&
        s.physics.impact == MO_IMPACT_EXACT);
  CHECK(s.sensor == MO_SENSOR_INVERSE_SQRT && s.held_out_designs == 64 &&
        s.held_out_environments == 8);
}

static void presets(void)
{
  const struct mo_schedule one_cosine = {MO_SCHEDULE_COSINE, 2e-3, 1e-5, 1, 1, 1, 10},
                           finetune_cosine = {MO_SCHEDULE_COSINE, 3e-4, 1e-6, 1, 100, 1, 0},
                           shipped = {MO_SCHEDULE_RESTARTS, 2e-3, 1e-5, 0.75, 61, 22, 5},
                           paper = {MO_SCHEDULE_RESTARTS, 1e-3, 1e-5, 0.7, 10, 2, 0},
                           paper_finetune = {MO_SCHEDULE_RESTARTS, 3.5e-4, 3.5e-5, 1, 100, 1, 0};
  const struct {
    enum mo_training_kind kind;
    enum mo_learning_preset preset;
    struct mo_training_settings expected;
  } all[] = {
      {MO_TRAINING_PRETRAIN,
       MO_LEARNING_PRESET_WORKSTATION,
       {.n_steps = 1400,
        .batch = 256,
        .learning.schedule = one_cosine,
        .learning.beta1 = 0.9,
        .learning.adjoint_bound = 2}},
      {MO_TRAINING_PRETRAIN,
       MO_LEARNING_PRESET_PHOTOTAXIS,
       {.n_steps = 1400,
        .batch = 8192,
        .learning.schedule = shipped,
        .learning.beta1 = 0.8,
        .learning.adjoint_bound = 8,
        .learning.adjoint_rule = MO_ADJOINT_RESTART}},
      {MO_TRAINING_PRETRAIN,
       MO_LEARNING_PRESET_PAPER,
       {.n_steps = 1400,
        .batch = 8192,
        .learning.schedule = paper,
        .learning.beta1 = 0.9,
        .learning.adjoint_bound = 0}},
      {MO_TRAINING_FINETUNE,
       MO_LEARNING_PRESET_WORKSTATION,
       {.n_steps = 60,
        .batch = 256,
        .learning.schedule = finetune_cosine,
        .learning.beta1 = 0.9,
        .learning.adjoint_bound = 2}},
      {MO_TRAINING_FINETUNE,
       MO_LEARNING_PRESET_PHOTOTAXIS, /* has none */
       {.n_steps = 60,
        .batch = 256,
        .learning.schedule = finetune_cosine,
        .learning.beta1 = 0.9,
        .learning.adjoint_bound = 2}},
      {MO_TRAINING_FINETUNE,
       MO_LEARNING_PRESET_PAPER,
       {.n_steps = 60,
        .batch = 8192,
        .learning.schedule = paper_finetune,
        .learning.beta1 = 0.9,
        .learning.adjoint_bound = 0}},
  };
  for (size_t i = 0; i < sizeof(all) / sizeof(all[0]); i++)
    check_preset(all[i].kind, all[i].preset, all[i].expected);
}

static void preset_names(void)
{
  static const char *const names[] = {"workstation", "phototaxis", "paper"};
  for (int i = 0; i < 3; i++)
    CHECK_TEXT(mo_learning_preset_words[i], names[i]);
  CHECK(mo_learning_preset_words[3] == NULL);
}

/* The shipped controller says of itself what its preset would make it say. It is older than
 * restart_weight, which was 3. */
static void shipped(void)
{
  const struct mo_training_settings settings =
      mo_training_preset(MO_TRAINING_PRETRAIN, MO_LEARNING_PRESET_PHOTOTAXIS);
  static const char weight[] = ",\"restart_weight\":3";
  const char *root = getenv("MORPHO_SOURCE_DIR");
  char path[1024], expected[2048];
  struct mo_controller *file = NULL, *made = NULL;
  struct mo_training *training = NULL;
  snprintf(path, sizeof(path), "%s/data/controllers/phototaxis.safetensors",
           root != NULL ? root : ".");
  REQUIRE(mo_controller_read(path, &file, NULL) == MO_OK);
  REQUIRE(mo_training_create(&settings, NULL, NULL, 0, &training, NULL) == MO_OK);
  REQUIRE(mo_training_export(training, NULL, "", NULL, &made) == MO_OK);
  const char *is = mo_controller_get_metadata(file, "morphod.settings");
  const char *would_be = mo_controller_get_metadata(made, "morphod.settings");
  REQUIRE(is != NULL && would_be != NULL);
  const char *cut = strstr(would_be, weight);
  REQUIRE(cut != NULL);
  if (strstr(is, "restart_weight") != NULL)
    cut = would_be + strlen(would_be);
  snprintf(expected, sizeof(expected), "%.*s%s", (int)(cut - would_be), would_be,
           *cut != '\0' ? cut + strlen(weight) : "");
  CHECK_TEXT(is, expected);
  static const char *const same[] = {"morphod.kind", "morphod.parent", "morphod.seed"};
  for (int i = 0; i < 3; i++)
    CHECK_TEXT(mo_controller_get_metadata(file, same[i]),
               mo_controller_get_metadata(made, same[i]));
  CHECK_TEXT(mo_controller_get_metadata(file, "morphod.step"), "1400");
  CHECK_INT(file->sensor, settings.sensor);
  mo_training_free(training);
  mo_controller_free(made);
  mo_controller_free(file);
}

/* ---- what is refused ---- */

static void expect(int actual, int code, const struct mo_message *message, const char *says)
{
  CHECK_INT(actual, code);
  if (strstr(message->text, says) == NULL) {
    printf("# \"%s\" lacks \"%s\"\n", message->text, says);
    CHECK(0);
  }
}

static void refused_settings(void)
{
  static const struct {
    enum {
      KIND,
      STEPS,
      BATCH,
      BETA1,
      BETA2,
      EPSILON,
      NORM,
      BOUND,
      RULE,
      WEIGHT,
      SENSOR,
      DESIGNS,
      ENVIRONMENTS,
      PEAK,
      DT
    } what;
    double value;
    int code;
    const char *says;
  } cases[] = {
      {KIND, 2, MO_ERR_INVALID, "kind of training must be 0 (pretrain) or 1 (finetune), got 2"},
      {STEPS, 0, MO_ERR_RANGE, "steps must be at least 1 and at most 1000000, got 0"},
      {STEPS, 1e9, MO_ERR_RANGE, "steps must be at least 1 and at most 1000000, got 1000000000"},
      {BATCH, 0, MO_ERR_RANGE, "batch must be at least 1 and at most 65536, got 0"},
      {BATCH, 65537, MO_ERR_RANGE, "batch must be at least 1 and at most 65536, got 65537"},
      {BATCH, 65536, MO_OK, ""},
      {BETA1, 1, MO_ERR_RANGE, "adam.beta1 must be at least 0 and below 1, got 1"},
      {BETA1, -0.1, MO_ERR_RANGE, "adam.beta1 must be at least 0 and below 1, got -0.1"},
      {BETA1, NAN, MO_ERR_INVALID,
       "adam.beta1 must be at least 0 and below 1, got a number that is not finite"},
      {BETA2, 1.5, MO_ERR_RANGE, "adam.beta2 must be at least 0 and below 1, got 1.5"},
      {EPSILON, 0, MO_ERR_RANGE, "adam.epsilon must be above 0 and at most 1, got 0"},
      {NORM, -1, MO_ERR_RANGE, "gradient_norm_limit must be at least 0 and at most 1e+06, got -1"},
      {NORM, INFINITY, MO_ERR_INVALID,
       "gradient_norm_limit must be at least 0 and at most 1e+06, got a number that is not finite"},
      {NORM, 0, MO_OK, ""},
      {BOUND, -2, MO_ERR_RANGE, "adjoint_bound must be at least 0 and at most 1e+06, got -2"},
      {BOUND, NAN, MO_ERR_INVALID,
       "adjoint_bound must be at least 0 and at most 1e+06, got a number that is not finite"},
      {RULE, 2, MO_ERR_INVALID, "adjoint_rule must be \"clip\" or \"restart\", got number 2"},
      {RULE, -1, MO_ERR_INVALID, "adjoint_rule must be \"clip\" or \"restart\", got number -1"},
      {RULE, MO_ADJOINT_RESTART, MO_OK, ""},
      {WEIGHT, -1, MO_ERR_RANGE, "restart_weight must be at least 0 and at most 1e+06, got -1"},
      {WEIGHT, 1000000.0000001, MO_ERR_RANGE,
       "restart_weight must be at least 0 and at most 1e+06, got 1000000.0000001"},
      {WEIGHT, 1e7, MO_ERR_RANGE, "restart_weight must be at least 0 and at most 1e+06, got 1e+07"},
      {WEIGHT, NAN, MO_ERR_INVALID,
       "restart_weight must be at least 0 and at most 1e+06, got a number that is not finite"},
      {WEIGHT, 0, MO_OK, ""},
      {WEIGHT, MO_RESTART_WEIGHT_MAX, MO_OK, ""},
      {SENSOR, 2, MO_ERR_INVALID, "inverse_sqrt"},
      {DESIGNS, 10001, MO_ERR_RANGE, "held-out designs must be at most 10000, got 10001"},
      {ENVIRONMENTS, 65, MO_ERR_RANGE, "held-out environments must be at most 64, got 65"},
      {ENVIRONMENTS, 0, MO_OK, ""},
      {PEAK, -1e-3, MO_ERR_RANGE, "schedule.peak must be above 0 and at most 1, got -0.001"},
      {DT, 1, MO_ERR_RANGE, "physics.dt_s must be at least 1e-07 and at most 0.1, got 1"},
  };
  for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
    struct mo_training_settings s = mo_training_defaults(MO_TRAINING_PRETRAIN);
    struct mo_message message = {""};
    const double value = cases[i].value;
    switch (cases[i].what) {
    case KIND: s.kind = (enum mo_training_kind)value; break;
    case STEPS: s.n_steps = (uint32_t)value; break;
    case BATCH: s.batch = (uint32_t)value; break;
    case BETA1: s.learning.beta1 = value; break;
    case BETA2: s.learning.beta2 = value; break;
    case EPSILON: s.learning.epsilon = value; break;
    case NORM: s.learning.norm_limit = value; break;
    case BOUND: s.learning.adjoint_bound = value; break;
    case RULE: s.learning.adjoint_rule = (enum mo_adjoint_rule)(int)value; break;
    case WEIGHT: s.learning.restart_weight = value; break;
    case SENSOR: s.sensor = (enum mo_sensor)value; break;
    case DESIGNS: s.held_out_designs = (uint32_t)value; break;
    case ENVIRONMENTS: s.held_out_environments = (uint32_t)value; break;
    case PEAK: s.learning.schedule.peak = value; break;
    case DT: s.physics.dt_s = value; break;
    }
    expect(mo_training_settings_check(&s, &message), cases[i].code, &message, cases[i].says);
    struct mo_training *training = NULL;
    if (cases[i].code != MO_OK) {
      CHECK_INT(mo_training_create(&s, NULL, NULL, 0, &training, NULL), cases[i].code);
      CHECK(training == NULL);
    }
  }
  struct mo_training_settings s = mo_training_defaults(MO_TRAINING_PRETRAIN);
  struct mo_message message = {""};
  s.n_steps = MO_TRAINING_STEPS_MAX;
  CHECK_INT(mo_training_settings_check(&s, NULL), MO_OK);
  s.batch = 8192;
  expect(mo_training_settings_check(&s, &message), MO_ERR_RANGE, &message,
         "steps × batch is 8192000000");
  s.kind = MO_TRAINING_FINETUNE; /* draws no bodies */
  CHECK_INT(mo_training_settings_check(&s, NULL), MO_OK);
}

static void refused_requests(void)
{
  const struct mo_training_settings pretrain = mo_training_defaults(MO_TRAINING_PRETRAIN);
  const struct mo_training_settings finetune = mo_training_defaults(MO_TRAINING_FINETUNE);
  struct mo_training *training = NULL;
  struct mo_controller *parent = NULL, *tiny = NULL;
  struct mo_message message = {""};
  uint64_t designs[2 * MO_DEFAULT_WORDS];
  REQUIRE(mo_held_out_designs(1, 2, designs) == MO_OK);
  REQUIRE(mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQUARE, &parent) == MO_OK);
  REQUIRE(mo_controller_create((struct mo_workspace){1, 2, 3}, MO_SENSOR_INVERSE_SQRT, &tiny) ==
          MO_OK);
  expect(mo_training_create(&finetune, NULL, designs, 2, &training, &message), MO_ERR_INVALID,
         &message, "needs a controller to start from");
  expect(mo_training_create(&finetune, parent, NULL, 0, &training, &message), MO_ERR_INVALID,
         &message, "needs 1 to 10000 designs");
  expect(mo_training_create(&finetune, parent, designs, 10001, &training, &message), MO_ERR_RANGE,
         &message, "10001 designs");
  expect(mo_training_create(&pretrain, NULL, designs, 2, &training, &message), MO_ERR_INVALID,
         &message, "draws its own bodies");
  expect(mo_training_create(&pretrain, tiny, NULL, 0, &training, &message), MO_ERR_UNSUPPORTED,
         &message, "1x2x3 voxels; trainings need one for 6x6x4");
  expect(mo_training_create(&finetune, tiny, designs, 2, &training, &message), MO_ERR_UNSUPPORTED,
         &message, "1x2x3");
  const uint64_t good = designs[MO_DEFAULT_WORDS];
  memset(designs + MO_DEFAULT_WORDS, 0, MO_DEFAULT_WORDS * sizeof(uint64_t));
  expect(mo_training_create(&finetune, parent, designs, 2, &training, &message), MO_ERR_INVALID,
         &message, "design 1 is empty or not in one piece");
  designs[MO_DEFAULT_WORDS] = UINT64_C(1); /* a corner of the workspace */
  expect(mo_training_create(&finetune, parent, designs, 2, &training, &message), MO_ERR_INVALID,
         &message, "design 1 is not placed");
  designs[2 * MO_DEFAULT_WORDS - 1] = UINT64_C(1) << 63;
  expect(mo_training_create(&finetune, parent, designs, 2, &training, &message), MO_ERR_INVALID,
         &message, "design 1 has bits past the last voxel");
  designs[MO_DEFAULT_WORDS] = good;
  parent->parameters[17] = NAN;
  expect(mo_training_create(&pretrain, parent, NULL, 0, &training, &message), MO_ERR_INVALID,
         &message, "parameter 17");
  parent->parameters[17] = -2e6F;
  expect(mo_training_create(&pretrain, parent, NULL, 0, &training, &message), MO_ERR_INVALID,
         &message, "parameter 17");
  CHECK(training == NULL);
  parent->parameters[17] =
      0.25F; /* a good one keeps its weights and its sensor, whatever the settings say */
  REQUIRE(mo_training_create(&pretrain, parent, NULL, 0, &training, &message) == MO_OK);
  CHECK(mo_training_controller(training)->parameters[17] == 0.25F);
  CHECK_INT(mo_training_controller(training)->sensor, MO_SENSOR_INVERSE_SQUARE);
  CHECK_INT(mo_training_settings_of(training)->sensor, MO_SENSOR_INVERSE_SQUARE);
  mo_training_free(training);
  mo_controller_free(parent);
  mo_controller_free(tiny);
  mo_training_free(NULL);
}

/* Random weights come from the seed: the same seed, the same weights; another one, others. */
static void initial_weights(void)
{
  struct mo_training *trainings[3];
  for (int i = 0; i < 3; i++) {
    struct mo_training_settings s = mo_training_defaults(MO_TRAINING_PRETRAIN);
    s.seed = i == 2 ? 9 : 8;
    REQUIRE(mo_training_create(&s, NULL, NULL, 0, &trainings[i], NULL) == MO_OK);
  }
  const struct mo_controller *c[3] = {mo_training_controller(trainings[0]),
                                      mo_training_controller(trainings[1]),
                                      mo_training_controller(trainings[2])};
  CHECK(memcmp(c[0]->parameters, c[1]->parameters, c[0]->n_parameters * sizeof(float)) == 0);
  CHECK(memcmp(c[0]->parameters, c[2]->parameters, c[0]->n_parameters * sizeof(float)) != 0);
  CHECK(c[0]->norm_gain[1][5] == 1.0F && c[0]->bias[2][7] == 0.0F);
  for (int i = 0; i < 3; i++)
    mo_training_free(trainings[i]);
}

static const struct check_case cases[] = {
    {"defaults", defaults},
    {"presets", presets},
    {"names of presets", preset_names},
    {"the shipped controller has the settings of its preset", shipped},
    {"bad settings are refused with a reason", refused_settings},
    {"bad requests are refused with a reason", refused_requests},
    {"initial weights", initial_weights},
};
CHECK_MAIN(cases)
