/* checkpoint.c: a training saved at any step goes on to the same bytes; nothing damaged is read;
 * lineage. */
#include "fixture.h"

#include "learning/internal.h"

#include <errno.h>

struct blob {
  uint8_t *bytes;
  size_t size;
};

static struct blob encoded(const struct mo_training *training)
{
  struct blob blob = {NULL, 0};
  if (mo_training_encode(training, &blob.bytes, &blob.size) < 0)
    exit(1);
  return blob;
}

static bool same(const struct blob *a, const struct blob *b)
{
  return a->size == b->size && memcmp(a->bytes, b->bytes, a->size) == 0;
}

static struct mo_training *decoded(const struct blob *blob)
{
  struct mo_training *training = NULL;
  struct mo_message message = {""};
  if (mo_training_decode(blob->bytes, blob->size, &training, &message) < 0) {
    printf("# %s\n", message.text);
    return NULL;
  }
  return training;
}

static struct mo_training *begin(enum mo_training_kind kind)
{
  struct mo_training_settings settings = small_settings(kind);
  struct mo_training *training = NULL;
  settings.physics.impact = MO_IMPACT_BISECTION;
  settings.sensor = MO_SENSOR_INVERSE_SQUARE;
  if (kind == MO_TRAINING_FINETUNE)
    return finetuning(&settings, 4, 1.0F);
  return mo_training_create(&settings, NULL, NULL, 0, &training, NULL) == MO_OK ? training : NULL;
}

/* Advances by one; step 5's gradient is not finite. */
static int advance_one(struct mo_training *training, struct made_up *made_up)
{
  const struct mo_robot *robots = NULL;
  const int r = mo_training_draw(training, NULL, NULL, &robots);
  if (r < 0)
    return r;
  make_up(made_up, training, robots);
  if (mo_training_step(training) == 5)
    made_up->gradient[9] = NAN;
  return mo_training_apply(training, made_up->gradient, made_up->outcomes, &made_up->counts, NULL);
}

static void resume(void)
{
  for (int kind = 0; kind < 2; kind++) {
    struct mo_training *whole = begin((enum mo_training_kind)kind),
                       *broken = begin((enum mo_training_kind)kind);
    struct made_up made_up;
    REQUIRE(whole != NULL && broken != NULL && made_up_create(&made_up, whole) == 0);
    const uint32_t n = mo_training_settings_of(whole)->n_steps;
    for (uint32_t step = 0; step < n; step++) {
      /* The one is never saved; the other is saved and restored at every step, drawn or not. */
      const struct mo_robot *robots;
      if (step % 3 == 1)
        REQUIRE(mo_training_draw(broken, NULL, NULL, &robots) == MO_OK);
      struct blob blob = encoded(broken);
      mo_training_free(broken);
      broken = decoded(&blob);
      REQUIRE(broken != NULL);
      struct blob again = encoded(broken);
      CHECK(same(&blob, &again));
      free(blob.bytes);
      free(again.bytes);
      REQUIRE(advance_one(whole, &made_up) == MO_OK && advance_one(broken, &made_up) == MO_OK);
    }
    struct blob a = encoded(whole), b = encoded(broken);
    CHECK(same(&a, &b));
    CHECK_INT(mo_training_step(broken), n);
    CHECK_INT(broken->skipped, 1);
    CHECK(a.size < MO_CHECKPOINT_BYTES_MAX);
    free(a.bytes);
    free(b.bytes);
    made_up_free(&made_up);
    mo_training_free(whole);
    mo_training_free(broken);
  }
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
      .learning.adjoint_bound = 3.5,
      .learning.adjoint_rule = MO_ADJOINT_RESTART,
      .learning.restart_weight = 2.25,
      .physics = mo_default_physics(),
      .sensor = MO_SENSOR_INVERSE_SQUARE,
      .held_out_designs = 12,
      .held_out_environments = 13};
  s.physics.dt_s = 0.003, s.physics.n_steps = 77, s.physics.stiffness_n_per_m = 1e4,
  s.physics.mass_kg = 1.25;
  s.physics.drag_per_s = 14, s.physics.gravity_m_per_s2 = 9, s.physics.actuation = 0.15,
  s.physics.friction = 0.8;
  s.physics.friction_cap = 0.9, s.physics.drop_height_m = 0.5,
  s.physics.impact = MO_IMPACT_BISECTION;
  s.physics.bisections = 9;
  struct mo_training *training = NULL;
  REQUIRE(mo_training_create(&s, NULL, NULL, 0, &training, NULL) == MO_OK);
  struct blob blob = encoded(training);
  mo_training_free(training);
  training = decoded(&blob);
  REQUIRE(training != NULL);
  const struct mo_training_settings *k = mo_training_settings_of(training);
  CHECK(k->kind == s.kind && k->seed == s.seed && k->n_steps == s.n_steps && k->batch == s.batch);
  CHECK(k->learning.schedule.kind == s.learning.schedule.kind &&
        k->learning.schedule.peak == s.learning.schedule.peak);
  CHECK(k->learning.schedule.floor == s.learning.schedule.floor &&
        k->learning.schedule.decay == s.learning.schedule.decay);
  CHECK(k->learning.schedule.cycle_steps == 11 && k->learning.schedule.cycle_growth == 3 &&
        k->learning.schedule.warmup_steps == 4);
  CHECK(k->learning.beta1 == s.learning.beta1 && k->learning.beta2 == s.learning.beta2 &&
        k->learning.epsilon == s.learning.epsilon);
  CHECK(k->learning.norm_limit == s.learning.norm_limit &&
        k->learning.adjoint_bound == s.learning.adjoint_bound && k->sensor == s.sensor);
  CHECK_INT(k->learning.adjoint_rule, MO_ADJOINT_RESTART);
  CHECK(k->learning.restart_weight == 2.25);
  CHECK(k->held_out_designs == 12 && k->held_out_environments == 13);
  const struct mo_physics *p = &k->physics, *q = &s.physics;
  CHECK(p->dt_s == q->dt_s && p->n_steps == q->n_steps &&
        p->stiffness_n_per_m == q->stiffness_n_per_m);
  CHECK(p->mass_kg == q->mass_kg && p->drag_per_s == q->drag_per_s &&
        p->gravity_m_per_s2 == q->gravity_m_per_s2);
  CHECK(p->actuation == q->actuation && p->friction == q->friction &&
        p->friction_cap == q->friction_cap);
  CHECK(p->drop_height_m == q->drop_height_m && p->impact == q->impact &&
        p->bisections == q->bisections);
  struct mo_controller *exported = NULL;
  REQUIRE(mo_training_export(training, NULL, "1.2.3", NULL, &exported) == MO_OK);
  CHECK(strstr(mo_controller_get_metadata(exported, "morphod.settings"),
               "\"adjoint_bound\":3.5,\"adjoint_rule\":\"restart\",\"restart_weight\":2.25,"
               "\"physics\"") != NULL);
  mo_controller_free(exported);
  free(blob.bytes);
  mo_training_free(training);
}

static void expect_refused(const uint8_t *bytes, size_t size, const char *says)
{
  struct mo_training *training = NULL;
  struct mo_message message = {""};
  CHECK_INT(mo_training_decode(bytes, size, &training, &message), MO_ERR_FORMAT);
  CHECK(training == NULL);
  if (strstr(message.text, says) == NULL) {
    printf("# \"%s\" lacks \"%s\"\n", message.text, says);
    CHECK(0);
  }
}

/* Bytes all over the header and the rest, changed in one bit; and cut short anywhere. */
static void damaged(void)
{
  struct mo_training *training = begin(MO_TRAINING_FINETUNE);
  REQUIRE(training != NULL);
  struct blob blob = encoded(training);
  for (size_t i = 0; i < blob.size; i += i < 16 ? 1 : i < 400 ? 7 : blob.size / 40) {
    blob.bytes[i] ^= (uint8_t)(1 << i % 8);
    expect_refused(blob.bytes, blob.size,
                   i < 8    ? "not a checkpoint"
                   : i < 12 ? "this program reads version 3"
                            : "checksum is wrong");
    blob.bytes[i] ^= (uint8_t)(1 << i % 8);
  }
  blob.bytes[blob.size - 1] ^= 128;
  expect_refused(blob.bytes, blob.size, "checksum is wrong");
  blob.bytes[blob.size - 1] ^= 128;
  const size_t cuts[] = {0, 7, 8, 100, 243, 244, 255, 256, 5000, blob.size / 2, blob.size - 1};
  for (size_t i = 0; i < sizeof(cuts) / sizeof(cuts[0]); i++) {
    uint8_t *cut = malloc(cuts[i] + 1); /* of its size, for the sanitizer */
    REQUIRE(cut != NULL);
    memcpy(cut, blob.bytes, cuts[i]);
    expect_refused(cut, cuts[i], cuts[i] < 8 ? "not a checkpoint" : "damaged");
    free(cut);
  }
  struct mo_training *good = decoded(&blob);
  CHECK(good != NULL);
  mo_training_free(good);
  free(blob.bytes);
  mo_training_free(training);
}

/* Writes a value over that of a member of the settings, and blanks over the rest. */
static void overwrite(uint8_t *bytes, const char *member, const char *value)
{
  char *at = strstr((char *)bytes + 72, member);
  REQUIRE(at != NULL);
  at += strlen(member);
  const size_t n = strcspn(at, ",}");
  REQUIRE(strlen(value) <= n);
  memset(at, ' ', n);
  memcpy(at, value, strlen(value));
}

/* A checksum can be right and the contents wrong all the same: a program that errs, or a hostile
 * file. */
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
  struct mo_training *training = begin(MO_TRAINING_FINETUNE);
  REQUIRE(training != NULL);
  struct blob blob = encoded(training);
  uint32_t settings_bytes;
  memcpy(&settings_bytes, blob.bytes + SETTINGS_BYTES, sizeof(settings_bytes));
  const size_t arrays = SETTINGS + settings_bytes, designs = (size_t)4 * MO_DEFAULT_WORDS * 8;
  const size_t n = 620912, first = arrays + designs + 4 * n, second = first + 8 * n;
  const double nan = NAN, minus = -1.0;
  const float huge = 2e6F, infinite = INFINITY;
  const uint32_t many = 13, most = UINT32_MAX, kind = 2;
  const uint64_t none = 0, one = 1, several = 13, all = UINT64_MAX;
  const struct {
    size_t at, size;
    const void *value;
    const char *says;
  } cases[] = {
      {KIND, 4, &kind,
       "the checkpoint's settings are not acceptable: kind of training must be 0 (pretrain) or 1 "
       "(finetune), got 2"},
      {SENSOR, 4, &kind, "sensor must be \"inverse_sqrt\" or \"inverse_square\", got number 2"},
      {SETTINGS_BYTES, 4, &most, "its settings are longer than it"},
      {SETTINGS_BYTES, 4, &many, "the checkpoint's settings are not acceptable"},
      {STEP, 4, &many, "more steps than its training"},
      {SKIPPED, 4, &many, "more steps than its training"},
      {DRAWS, 8, &one, "stream of bodies"},
      {N_DESIGNS, 8, &none, "number of its designs"},
      {N_DESIGNS, 8, &all, "number of its designs"},
      {N_DESIGNS, 8, &several, "size does not agree"},
      {N_PARAMETERS, 8, &all, "another number of parameters"},
      {arrays + 16, 8, &all, "design 0 has bits past"},
      {arrays + designs, 4, &infinite, "a weight is not finite"},
      {arrays + designs + 4 * (n - 1), 4, &huge, "a weight is not finite or beyond"},
      {first, 8, &nan, "a moment is not finite"},
      {second + 8 * (n - 1), 8, &nan, "a moment is not finite"},
      {second, 8, &minus, "a second moment is negative"},
  };
  static const struct {
    const char *member, *value, *says;
  } settings[] = {
      {"\"steps\":", "0", "/steps: 0 is given; an integer from 1 to 1000000 is expected"},
      {"\"peak\":", "2", "/schedule/peak: must be above 0 and at most 1, got 2"},
      {"\"adjoint_rule\":", "\"flip\"", "/adjoint_rule: "},
      {"\"restart_weight\":", "x", "the checkpoint's settings are not acceptable"},
  };
  const size_t n_cases = sizeof(cases) / sizeof(cases[0]),
               n_settings = sizeof(settings) / sizeof(settings[0]);
  CHECK_INT(blob.size, second + 8 * n + 8);
  uint8_t *copy = malloc(blob.size);
  REQUIRE(copy != NULL);
  for (size_t i = 0; i < n_cases + n_settings; i++) {
    memcpy(copy, blob.bytes, blob.size);
    if (i < n_cases)
      memcpy(copy + cases[i].at, cases[i].value, cases[i].size);
    else
      overwrite(copy, settings[i - n_cases].member, settings[i - n_cases].value);
    const uint64_t sum = mo_checksum(copy, blob.size - 8);
    memcpy(copy + blob.size - 8, &sum, 8);
    expect_refused(copy, blob.size, i < n_cases ? cases[i].says : settings[i - n_cases].says);
  }
  free(copy);
  free(blob.bytes);
  mo_training_free(training);
}

static void checksum(void)
{
  /* The check value that the catalogues give for CRC-64/XZ. */
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
  struct made_up made_up;
  REQUIRE(training != NULL && made_up_create(&made_up, training) == 0);
  REQUIRE(advance_one(training, &made_up) == MO_OK);
  struct mo_controller *c = NULL;
  struct mo_training_lineage code = {3, {{0, ""}, {1, "later"}, {2, "latest"}}};
  REQUIRE(mo_training_export(training, "ab12", "1.2.3", &code, &c) == MO_OK);
  CHECK(memcmp(c->parameters, mo_training_controller(training)->parameters,
               c->n_parameters * sizeof(float)) == 0);
  CHECK_INT(c->sensor, MO_SENSOR_INVERSE_SQUARE);
  CHECK_TEXT(mo_controller_get_metadata(c, "morphod.kind"), "finetune");
  CHECK_TEXT(mo_controller_get_metadata(c, "morphod.parent"), "ab12");
  CHECK_TEXT(mo_controller_get_metadata(c, "morphod.seed"), "1");
  CHECK_TEXT(mo_controller_get_metadata(c, "morphod.step"), "1");
  CHECK_TEXT(mo_controller_get_metadata(c, "morphod.version"), "1.2.3");
  CHECK_TEXT(mo_controller_get_metadata(c, "morphod.settings"),
             "{\"steps\":9,\"batch\":5,\"schedule\":{\"kind\":\"cosine\",\"peak\":0.0003,\"floor\":"
             "1e-06,\"decay\":1,"
             "\"cycle_steps\":100,\"cycle_growth\":1,\"warmup_steps\":2},\"adam\":{\"beta1\":0.9,"
             "\"beta2\":0.999,"
             "\"epsilon\":1e-08},\"gradient_norm_limit\":1,\"adjoint_bound\":2,\"adjoint_rule\":"
             "\"clip\",\"restart_weight\":3,"
             "\"physics\":{"
             "\"dt_s\":0.004,\"n_steps\":1000,"
             "\"stiffness_n_per_m\":15000,\"mass_kg\":1,\"drag_per_s\":15,\"gravity_m_per_s2\":9.8,"
             "\"actuation\":0.2,"
             "\"friction\":0.9,\"friction_cap\":0.95,\"drop_height_m\":0,\"impact\":\"bisection8\"}"
             ",\"designs\":4}");
  CHECK_TEXT(mo_controller_get_metadata(c, "morphod.code"),
             "[{\"from_step\":0,\"fingerprint\":null}]");
  const char *designs = mo_controller_get_metadata(c, "morphod.designs_crc64");
  CHECK(designs != NULL && strlen(designs) == 16);
  /* The file reads back, and equal trainings give equal files. */
  struct mo_controller *again = NULL, *read = NULL;
  struct blob blob = encoded(training), file = {NULL, 0}, file2 = {NULL, 0};
  struct mo_training *other = decoded(&blob);
  REQUIRE(other != NULL && mo_training_export(other, "ab12", "1.2.3", &code, &again) == MO_OK);
  REQUIRE(mo_controller_encode(c, &file.bytes, &file.size) == MO_OK);
  REQUIRE(mo_controller_encode(again, &file2.bytes, &file2.size) == MO_OK);
  CHECK(same(&file, &file2));
  REQUIRE(mo_controller_decode(file.bytes, file.size, &read, NULL) == MO_OK);
  CHECK_TEXT(mo_controller_get_metadata(read, "morphod.step"), "1");
  mo_controller_free(again);
  again = NULL;
  /* Which code it was computed by, as far as it has come. */
  REQUIRE(advance_one(training, &made_up) == MO_OK &&
          mo_training_export(training, "ab12", "1.2.3", &code, &again) == MO_OK);
  CHECK_TEXT(
      mo_controller_get_metadata(again, "morphod.code"),
      "[{\"from_step\":0,\"fingerprint\":null},{\"from_step\":1,\"fingerprint\":\"later\"}]");
  mo_controller_free(again);
  again = NULL;
  for (const char *bad = "\"\\\n\x7f"; *bad != '\0'; bad++) {
    code.codes[1].fingerprint[0] = *bad;
    CHECK_INT(mo_training_export(training, "ab12", "1.2.3", &code, &again), MO_ERR_INVALID);
  }
  CHECK_INT(mo_training_export(training, "\xff", "1", NULL, &again), MO_ERR_INVALID);
  CHECK(again == NULL);
  mo_training_free(other);
  other = begin(MO_TRAINING_PRETRAIN);
  REQUIRE(other != NULL && mo_training_export(other, NULL, "1.2.3", NULL, &again) == MO_OK);
  CHECK_TEXT(mo_controller_get_metadata(again, "morphod.parent"), "random");
  CHECK_TEXT(mo_controller_get_metadata(again, "morphod.kind"), "pretrain");
  CHECK(mo_controller_get_metadata(again, "morphod.designs_crc64") == NULL);
  CHECK(mo_controller_get_metadata(again, "morphod.code") == NULL);
  free(blob.bytes);
  free(file.bytes);
  free(file2.bytes);
  mo_controller_free(read);
  mo_controller_free(again);
  mo_controller_free(c);
  mo_training_free(other);
  made_up_free(&made_up);
  mo_training_free(training);
}

static const struct check_case cases[] = {
    {"saved and restored at every step, the same bytes at the end", resume},
    {"every setting survives", settings_kept},
    {"the checksum", checksum},
    {"damaged bytes are refused", damaged},
    {"wrong contents under a right checksum are refused", wrong_contents},
    {"lineage", lineage},
};
CHECK_MAIN(cases)
