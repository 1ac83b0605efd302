/* checkpoint.c: a training run saved at any step continues to the same bytes; damaged files are
 * refused; lineage. */
#include "fixture.h"

#include "learning/internal.h"
#include "rollout/gradient_options.h"
#include "rollout/physics.h"
#include "world/factors.h"

static struct mo_training *begin(enum mo_training_kind kind)
{
  struct mo_training_settings settings = small_settings(kind);
  settings.physics.scheme.impact = MO_IMPACT_BISECTION;
  settings.sensor = MO_SENSOR_INVERSE_SQUARE;
  return kind == MO_TRAINING_FINETUNE ? finetuning(&settings, 4, 1.0F)
                                      : make_training(&settings, NULL, NULL, 0);
}

/* Advances by one step; step 5's gradient is not finite. */
static void advance_one(struct mo_training *training, struct made_up *made_up)
{
  make_up(made_up, training, draw(training));
  if (mo_training_step(training) == 5)
    made_up->gradient[9] = NAN;
  CHECK_INT(apply(training, made_up, NULL), MO_OK);
}

static void resume(void)
{
  for (int kind = 0; kind < 2; kind++) {
    struct mo_training *whole = begin((enum mo_training_kind)kind);
    struct made_up *made_up = make_made_up(whole);
    const uint32_t n = mo_training_settings_of(whole)->n_steps;
    struct blob a = encoded(whole), b = a;
    for (uint32_t step = 0; step < n; step++) {
      /* One training run is never saved; the other is saved and restored at every step, with or
       * without a draw. */
      struct mo_training *broken = decoded(b);
      if (step % 3 == 1)
        draw(broken);
      CHECK(same_blob(encoded(broken), b));
      advance_one(whole, made_up);
      advance_one(broken, made_up);
      b = encoded(broken);
      CHECK_INT(broken->step, step + 1);
      CHECK_INT(broken->skipped, step >= 5);
    }
    a = encoded(whole);
    CHECK(same_blob(a, b));
    CHECK(a.size < MO_CHECKPOINT_BYTES_MAX);
    check_drop_to(0);
  }
}

static bool same_settings(const struct mo_training_settings *a,
                          const struct mo_training_settings *b)
{
  const struct mo_learning *x = &a->learning, *y = &b->learning;
  return a->kind == b->kind && a->seed == b->seed && a->n_steps == b->n_steps &&
         a->batch == b->batch && a->sensor == b->sensor &&
         a->held_out_designs == b->held_out_designs &&
         a->held_out_environments == b->held_out_environments &&
         x->schedule.kind == y->schedule.kind && x->schedule.peak == y->schedule.peak &&
         x->schedule.floor == y->schedule.floor && x->schedule.decay == y->schedule.decay &&
         x->schedule.cycle_steps == y->schedule.cycle_steps &&
         x->schedule.cycle_growth == y->schedule.cycle_growth &&
         x->schedule.warmup_steps == y->schedule.warmup_steps && x->vary.given == y->vary.given &&
         x->vary.mass[1] == y->vary.mass[1] && x->vary.friction[0] == y->vary.friction[0] &&
         x->beta1 == y->beta1 && x->beta2 == y->beta2 && x->epsilon == y->epsilon &&
         x->norm_limit == y->norm_limit &&
         mo_fields_equal(&mo_gradient_fields, &x->gradient, &y->gradient) &&
         mo_physics_equal(&a->physics, &b->physics);
}

/* Every setting survives. */
static void settings_kept(void)
{
  struct mo_training_settings s = {
      .kind = MO_TRAINING_PRETRAIN,
      .seed = UINT64_MAX - 5,
      .n_steps = 101,
      .batch = 7,
      .learning.schedule = {MO_SCHEDULE_RESTARTS, 0.01, 0.002, 0.6, 11, 3, 4},
      .learning.beta1 = 0.85,
      .learning.beta2 = 0.99,
      .learning.epsilon = 1e-7,
      .learning.norm_limit = 2.5,
      .learning.gradient.adjoint_bound = 3.5,
      .learning.gradient.adjoint_rule = MO_ADJOINT_RESTART,
      .learning.gradient.restart_weight = 2.25,
      .sensor = MO_SENSOR_INVERSE_SQUARE,
      .held_out_designs = 12,
      .held_out_environments = 13};
  s.learning.vary = mo_factors_constant();
  s.learning.vary.given = true;
  memcpy(s.learning.vary.stiffness, (double[2]){0.9, 1.1}, 2 * sizeof(double));
  s.learning.vary.mass[1] = 2;
  s.learning.vary.friction[0] = 0.25;
  s.physics = (struct mo_physics){.scheme.dt_s = 0.003,
                                  .scheme.n_steps = 77,
                                  .scheme.control_period_s = 0.009,
                                  .constants.stiffness_n_per_m = 1e4,
                                  .constants.mass_kg = 1.25,
                                  .constants.drag_per_s = 14,
                                  .constants.gravity_m_per_s2 = 9,
                                  .constants.actuation = 0.15,
                                  .constants.friction = 0.8,
                                  .constants.friction_cap = 0.9,
                                  .drop_height_m = 0.5,
                                  .scheme.integrator = MO_INTEGRATOR_SPLIT,
                                  .scheme.impact = MO_IMPACT_BISECTION,
                                  .scheme.bisections = 9};
  const struct mo_training *training = decoded(encoded(make_training(&s, NULL, NULL, 0)));
  CHECK(same_settings(mo_training_settings_of(training), &s));
  struct mo_controller *exported = NULL;
  REQUIRE(mo_training_export(training, NULL, "1.2.3", NULL, &exported) == MO_OK);
  CHECK(strstr(mo_controller_get_metadata(exported, "morphod.settings"),
               "\"adjoint_bound\":3.5,\"adjoint_rule\":\"restart\",\"restart_weight\":2.25,"
               "\"vary\":{\"stiffness\":[0.9,1.1],\"mass\":[1,2],\"drag\":[1,1],\"gravity\":"
               "[1,1],\"actuation\":[1,1],\"friction\":[0.25,1]},") != NULL);
  mo_controller_free(exported);
  /* Drop and slope are written if they vary, so that older settings keep their bytes. */
  s.learning.vary.drop_m[1] = 0.25;
  s.learning.vary.slope_degrees[0] = s.learning.vary.slope_degrees[1] = 7;
  training = decoded(encoded(make_training(&s, NULL, NULL, 0)));
  CHECK(mo_fields_equal(&mo_vary_fields, &mo_training_settings_of(training)->learning.vary,
                        &s.learning.vary));
  exported = NULL;
  REQUIRE(mo_training_export(training, NULL, "1.2.3", NULL, &exported) == MO_OK);
  CHECK(strstr(mo_controller_get_metadata(exported, "morphod.settings"),
               "\"friction\":[0.25,1],\"drop_m\":[0,0.25],\"slope_degrees\":[7,7]},") != NULL);
  mo_controller_free(exported);
}

static void expect_refused(const uint8_t *bytes, size_t size, const char *says)
{
  struct mo_training *training = NULL;
  struct mo_message message = {""};
  CHECK_INT(mo_training_decode(bytes, size, &training, &message), MO_ERR_FORMAT);
  CHECK(training == NULL);
  CHECK_SAYS(message, says);
}

/* One bit is flipped in bytes all over the header and the rest, and the file is cut off
 * anywhere. */
static void damaged(void)
{
  struct blob blob = encoded(begin(MO_TRAINING_FINETUNE));
  for (size_t i = 0; i < blob.size; i += i < 16 ? 1 : i < 400 ? 7 : blob.size / 40) {
    blob.bytes[i] ^= (uint8_t)(1 << i % 8);
    expect_refused(blob.bytes, blob.size,
                   i < 8    ? "not a checkpoint"
                   : i < 12 ? "this program reads versions 3 and 4"
                            : "checksum is wrong");
    blob.bytes[i] ^= (uint8_t)(1 << i % 8);
  }
  blob.bytes[blob.size - 1] ^= 128;
  expect_refused(blob.bytes, blob.size, "checksum is wrong");
  blob.bytes[blob.size - 1] ^= 128;
  const size_t cuts[] = {0, 7, 8, 100, 243, 244, 255, 256, 5000, blob.size / 2, blob.size - 1};
  for (size_t i = 0; i < COUNT(cuts); i++) {
    uint8_t *cut = malloc(cuts[i] + 1); /* of its exact size, for the sanitizer */
    memcpy(cut, blob.bytes, cuts[i]);
    expect_refused(cut, cuts[i], cuts[i] < 8 ? "not a checkpoint" : "damaged");
    free(cut);
  }
  decoded(blob); /* still as good as it was */
}

/* Replaces the value of a member of the settings, and fills the rest with blanks. */
static void overwrite(uint8_t *bytes, const char *member, const char *value)
{
  char *at = strstr((char *)bytes + 72, member);
  at += strlen(member);
  const size_t n = strcspn(at, ",}");
  REQUIRE(strlen(value) <= n);
  memset(at, ' ', n);
  memcpy(at, value, strlen(value));
}

/* The checksum can be correct even though the contents are wrong, because of a program error or a
 * hostile file. */
static void wrong_contents(void)
{
  enum {
    SETTINGS_BYTES = 12,
    KIND = 16,
    SENSOR = 20,
    STEP = 32,
    SKIPPED = 36,
    DRAWS = 48,
    N_DESIGNS = 56,
    N_PARAMETERS = 64,
    SETTINGS = 72
  };
  struct blob blob = encoded(begin(MO_TRAINING_FINETUNE));
  uint32_t settings_bytes;
  memcpy(&settings_bytes, blob.bytes + SETTINGS_BYTES, sizeof(settings_bytes));
  const size_t arrays = SETTINGS + settings_bytes, designs = (size_t)4 * MO_DEFAULT_WORDS * 8;
  const size_t n = 620912, first = arrays + designs + 4 * n, second = first + 8 * n;
  const struct {
    size_t at, size;
    union {
      uint64_t u64;
      double f64;
      float f32;
    } value;
    const char *says;
  } cases[] = {
      {KIND,
       4,
       {2},
       "the checkpoint has invalid settings: kind of training must be 0 (pretrain) or 1 "
       "(finetune), got 2"},
      {SENSOR, 4, {2}, "sensor must be \"inverse_sqrt\" or \"inverse_square\", got number 2"},
      {SETTINGS_BYTES, 4, {UINT32_MAX}, "its settings extend past its end"},
      {SETTINGS_BYTES, 4, {13}, "the checkpoint has invalid settings"},
      {STEP, 4, {13}, "more steps than its training run"},
      {SKIPPED, 4, {13}, "more steps than its training run"},
      {DRAWS, 8, {1}, "stream of bodies"},
      {N_DESIGNS, 8, {0}, "its number of designs"},
      {N_DESIGNS, 8, {UINT64_MAX}, "its number of designs"},
      {N_DESIGNS, 8, {13}, "size does not match"},
      {N_PARAMETERS, 8, {UINT64_MAX}, "number of parameters is wrong"},
      {arrays + 16,
       8,
       {UINT64_MAX},
       "a design is empty, not in one piece, or not in its canonical place"},
      {arrays + designs, 4, {.f32 = INFINITY}, "a weight is not finite"},
      {arrays + designs + 4 * (n - 1), 4, {.f32 = 2e6F}, "a weight is not finite, or exceeds"},
      {first, 8, {.f64 = NAN}, "a moment is not finite"},
      {second + 8 * (n - 1), 8, {.f64 = NAN}, "a moment is not finite"},
      {second, 8, {.f64 = -1}, "a second moment is negative"},
  };
  static const struct {
    const char *member, *value, *says;
  } settings[] = {
      {"\"steps\":", "0", "/steps: must be an integer from 1 to 1000000, got 0"},
      {"\"peak\":", "2", "/schedule/peak: must be above 0 and at most 1, got 2"},
      {"\"adjoint_rule\":", "\"flip\"", "/adjoint_rule: "},
      {"\"restart_weight\":", "x", "the checkpoint has invalid settings"},
  };
  const size_t n_cases = COUNT(cases), n_settings = COUNT(settings);
  CHECK_INT(blob.size, second + 8 * n + 8);
  uint8_t *copy = check_keep(malloc(blob.size), free);
  for (size_t i = 0; i < n_cases + n_settings; i++) {
    memcpy(copy, blob.bytes, blob.size);
    if (i < n_cases)
      memcpy(copy + cases[i].at, &cases[i].value, cases[i].size);
    else
      overwrite(copy, settings[i - n_cases].member, settings[i - n_cases].value);
    const uint64_t sum = mo_checksum(copy, blob.size - 8);
    memcpy(copy + blob.size - 8, &sum, 8);
    expect_refused(copy, blob.size, i < n_cases ? cases[i].says : settings[i - n_cases].says);
  }
}

static void checksum(void)
{
  /* The check value that catalogs list for CRC-64/XZ. */
  CHECK(mo_checksum((const uint8_t *)"123456789", 9) == UINT64_C(0x995DC9BBDF1939FA));
  CHECK(mo_checksum((const uint8_t *)"", 0) == 0);
  uint8_t bytes[64], bitwise_ok = 1;
  for (int i = 0; i < 64; i++)
    bytes[i] = (uint8_t)(37 * i + 11);
  for (size_t n = 0; n <= 64; n++) {
    uint64_t crc = ~UINT64_C(0);
    for (size_t i = 0; i < n; i++) {
      crc ^= bytes[i];
      for (int bit = 0; bit < 8; bit++)
        crc = crc >> 1 ^ (crc & 1 ? UINT64_C(0xC96C5795D7870F42) : 0);
    }
    bitwise_ok &= mo_checksum(bytes, n) == ~crc;
  }
  CHECK(bitwise_ok);
}

static void lineage(void)
{
  struct mo_training *training = begin(MO_TRAINING_FINETUNE);
  struct made_up *made_up = make_made_up(training);
  struct mo_controller *c = NULL, *again = NULL, *read = NULL;
  advance_one(training, made_up);
  struct mo_training_lineage code = {3, {{0, ""}, {1, "later"}, {2, "latest"}}};
  REQUIRE(mo_training_export(training, "ab12", "1.2.3", &code, &c) == MO_OK);
  CHECK(SAME(c->parameters, mo_training_controller(training)->parameters, c->n_parameters));
  CHECK_INT(c->sensor, MO_SENSOR_INVERSE_SQUARE);
  static const char *const entries[][2] = {
      {"kind", "finetune"}, {"parent", "ab12"},
      {"seed", "1"},        {"step", "1"},
      {"version", "1.2.3"}, {"code", "[{\"from_step\":0,\"fingerprint\":null}]"}};
  for (size_t i = 0; i < COUNT(entries); i++) {
    char key[32];
    snprintf(key, sizeof(key), "morphod.%s", entries[i][0]);
    CHECK_TEXT(mo_controller_get_metadata(c, key), entries[i][1]);
  }
  CHECK_TEXT(mo_controller_get_metadata(c, "morphod.settings"),
             "{\"steps\":9,\"batch\":5,\"schedule\":{\"kind\":\"cosine\",\"peak\":0.0003,\"floor\":"
             "1e-06,\"decay\":1,"
             "\"cycle_steps\":100,\"cycle_growth\":1,\"warmup_steps\":2},\"adam\":{\"beta1\":0.9,"
             "\"beta2\":0.999,"
             "\"epsilon\":1e-08},\"gradient_norm_limit\":1,\"adjoint_bound\":2,\"adjoint_rule\":"
             "\"clip\",\"restart_weight\":3,\"vary\":null,"
             "\"physics\":{"
             "\"dt_s\":0.002,\"n_steps\":2000,\"control_period_s\":0,"
             "\"stiffness_n_per_m\":15000,\"mass_kg\":1,\"drag_per_s\":15,\"gravity_m_per_s2\":9.8,"
             "\"actuation\":0.2,"
             "\"friction\":0.9,\"friction_cap\":0.95,\"drop_height_m\":0,\"impact\":\"bisection8\","
             "\"integrator\":\"split\"}"
             ",\"designs\":4}");
  const char *designs = mo_controller_get_metadata(c, "morphod.designs_crc64");
  CHECK(designs != NULL && strlen(designs) == 16);
  /* The file can be read back, and equal training runs export equal files. */
  REQUIRE(mo_training_export(decoded(encoded(training)), "ab12", "1.2.3", &code, &again) == MO_OK);
  struct blob file, file2;
  REQUIRE(mo_controller_encode(c, &file.bytes, &file.size) == MO_OK);
  REQUIRE(mo_controller_encode(again, &file2.bytes, &file2.size) == MO_OK);
  CHECK(same_blob(file, file2));
  REQUIRE(mo_controller_decode(file.bytes, file.size, &read, NULL) == MO_OK);
  CHECK_TEXT(mo_controller_get_metadata(read, "morphod.step"), "1");
  mo_controller_free(again);
  again = NULL;
  /* The lineage lists the code that computed the steps so far. */
  advance_one(training, made_up);
  REQUIRE(mo_training_export(training, "ab12", "1.2.3", &code, &again) == MO_OK);
  CHECK_TEXT(
      mo_controller_get_metadata(again, "morphod.code"),
      "[{\"from_step\":0,\"fingerprint\":null},{\"from_step\":1,\"fingerprint\":\"later\"}]");
  mo_controller_free(again);
  again = NULL;
  code.codes[1].fingerprint[0] = '"';
  REQUIRE(mo_training_export(training, "ab12", "1.2.3", &code, &again) == MO_OK);
  CHECK(strstr(mo_controller_get_metadata(again, "morphod.code"), ":\"\\\"ater\"}]") != NULL);
  mo_controller_free(again);
  again = NULL;
  CHECK_INT(mo_training_export(training, "\xff", "1", NULL, &again), MO_ERR_INVALID);
  CHECK(again == NULL);
  REQUIRE(mo_training_export(begin(MO_TRAINING_PRETRAIN), NULL, "1.2.3", NULL, &again) == MO_OK);
  CHECK_TEXT(mo_controller_get_metadata(again, "morphod.parent"), "random");
  CHECK_TEXT(mo_controller_get_metadata(again, "morphod.kind"), "pretrain");
  CHECK(mo_controller_get_metadata(again, "morphod.designs_crc64") == NULL);
  CHECK(mo_controller_get_metadata(again, "morphod.code") == NULL);
  free(file.bytes);
  free(file2.bytes);
  mo_controller_free(read);
  mo_controller_free(again);
  mo_controller_free(c);
}

static const struct check_case cases[] = {
    {"saved and restored at every step, the same bytes at the end", resume},
    {"every setting survives", settings_kept},
    {"the checksum", checksum},
    {"damaged bytes are refused", damaged},
    {"wrong contents with a correct checksum are refused", wrong_contents},
    {"lineage", lineage},
};
CHECK_MAIN(cases)
