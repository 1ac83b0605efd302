/* encode.c: the encodings that the store hashes. If a hash here changed, every stored score would
 * be lost. */
#include "store/encode.h"

#include "../make.h"
#include "rollout/physics.h"
#include "store/hash.h"

/* The plain encoding of version 1, written by hand. */
static size_t by_hand(const struct mo_physics *p, uint32_t bisections, uint8_t *bytes)
{
  const double numbers[] = {
      p->scheme.dt_s,          p->constants.stiffness_n_per_m, p->constants.mass_kg,
      p->constants.drag_per_s, p->constants.gravity_m_per_s2,  p->constants.actuation,
      p->constants.friction,   p->constants.friction_cap,      p->drop_height_m};
  const uint32_t words[] = {p->scheme.n_steps, (uint32_t)p->scheme.impact, bisections, MO_FLOAT64,
                            MO_SENSOR_INVERSE_SQUARE};
  bytes[0] = 1;
  memcpy(bytes + 1, numbers, sizeof(numbers));
  memcpy(bytes + 1 + sizeof(numbers), words, sizeof(words));
  return 1 + sizeof(numbers) + sizeof(words);
}

static void encodes_physics(void)
{
  struct mo_physics physics = mo_paper_physics(), found;
  uint8_t bytes[MO_PHYSICS_BYTES_MAX], expected[MO_PHYSICS_BYTES_MAX];
  enum mo_precision precision;
  enum mo_sensor sensor;
  physics.constants.stiffness_n_per_m = 11;
  physics.constants.mass_kg = 12;
  physics.constants.drag_per_s = 13;
  for (int is_exact = 0; is_exact < 2; is_exact++) {
    physics.scheme.impact = is_exact ? MO_IMPACT_EXACT : MO_IMPACT_BISECTION;
    physics.scheme.bisections = is_exact ? 8 : 21;
    const size_t size = by_hand(&physics, is_exact ? 0 : 21, expected);
    REQUIRE(size == 93 &&
            mo_encode_physics(&physics, MO_FLOAT64, MO_SENSOR_INVERSE_SQUARE, bytes) == size);
    CHECK(memcmp(bytes, expected, size) == 0);
    REQUIRE_OK(mo_decode_physics(bytes, size, &found, &precision, &sensor));
    CHECK(found.scheme.bisections == physics.scheme.bisections &&
          found.scheme.impact == physics.scheme.impact && found.scheme.n_steps == 1000 &&
          found.constants.drag_per_s == 13 && found.drop_height_m == 0);
    CHECK(precision == MO_FLOAT64 && sensor == MO_SENSOR_INVERSE_SQUARE);
  }
}

/* Settings of later versions are packed in the order of the table. */
static void encodes_later_settings(void)
{
  static const struct {
    uint8_t version;
    double period_s;
    enum mo_integrator integrator;
    size_t size;
  } given[] = {{2, 0.016, MO_INTEGRATOR_PAPER, 101},
               {3, 0, MO_INTEGRATOR_SPLIT, 105},
               {3, 0.016, MO_INTEGRATOR_SPLIT, 105}};
  enum { PERIOD = 1 + 8, WORDS = 1 + 10 * 8, INTEGRATOR = WORDS + 3 * 4 };
  for (size_t i = 0; i < COUNT(given); i++) {
    struct mo_physics physics = mo_paper_physics(), found;
    uint8_t bytes[MO_PHYSICS_BYTES_MAX];
    enum mo_precision precision;
    enum mo_sensor sensor;
    double period_s;
    physics.scheme.control_period_s = given[i].period_s;
    physics.scheme.integrator = given[i].integrator;
    const size_t size = mo_encode_physics(&physics, MO_FLOAT32, MO_SENSOR_INVERSE_SQUARE, bytes);
    REQUIRE(size == given[i].size && bytes[0] == given[i].version);
    memcpy(&period_s, bytes + PERIOD, sizeof(period_s));
    CHECK(period_s == given[i].period_s);
    if (given[i].version == 3)
      CHECK_INT(bytes[INTEGRATOR], given[i].integrator);
    REQUIRE_OK(mo_decode_physics(bytes, size, &found, &precision, &sensor));
    CHECK(mo_physics_equal(&physics, &found) && sensor == MO_SENSOR_INVERSE_SQUARE);
    if (given[i].version == 3) {
      bytes[INTEGRATOR] = 2;
      CHECK_INT(mo_decode_physics(bytes, size, &found, &precision, &sensor), MO_ERR_CORRUPT);
    }
    /* Equal settings have one encoding: a version that the settings do not need is refused. */
    memset(bytes + PERIOD, 0, sizeof(period_s));
    if (given[i].version == 3)
      bytes[INTEGRATOR] = MO_INTEGRATOR_PAPER;
    CHECK_INT(mo_decode_physics(bytes, size, &found, &precision, &sensor), MO_ERR_CORRUPT);
  }
}

static void encodes_environments(void)
{
  struct mo_environment environment = {.light_xy_m = {4, -0.0}, .terrain_heights_m = {0.5}}, found;
  uint8_t bytes[MO_ENVIRONMENT_BYTES_MAX];
  environment.terrain_heights_m[MO_TERRAIN_HEIGHTS - 1] = -7;
  const size_t size = mo_encode_environment(&environment, bytes);
  REQUIRE(size == 66 * sizeof(double));
  REQUIRE_OK(mo_decode_environment(bytes, size, &found));
  CHECK(found.light_xy_m[0] == 4 && !signbit(found.light_xy_m[1]) &&
        memcmp(found.terrain_heights_m, environment.terrain_heights_m,
               sizeof(found.terrain_heights_m)) == 0);
  CHECK_INT(mo_decode_environment(bytes, size - 8, &found), MO_ERR_CORRUPT);
  CHECK_INT(mo_decode_environment(NULL, 0, &found), MO_ERR_CORRUPT);
}

/* A grid follows everything else; it is decoded with a holder of its own. */
static void encodes_grids(void)
{
  struct mo_environment environment = {.light_xy_m = {4, -0.0}}, found;
  struct mo_sha256 hashes[2];
  double heights_m[6] = {0.5, -0.0, -1, 2, 0.25, 7};
  REQUIRE_OK(mo_terrain_grid_create(3, 2, 0.3, heights_m, &environment.grid));
  const size_t size = mo_encoded_environment_bytes(&environment);
  uint8_t *bytes = make_zeros(size, 1);
  CHECK_INT(mo_encode_environment(&environment, bytes), size);
  REQUIRE_OK(mo_decode_environment(bytes, size, &found));
  CHECK(found.grid != environment.grid && found.grid->columns == 3 && found.grid->rows == 2);
  CHECK(found.grid->spacing_m == 0.3 && found.grid->highest_m == 7);
  CHECK(SAME(found.grid->heights_m, environment.grid->heights_m, 6));
  CHECK(!signbit(found.grid->heights_m[1]) && !signbit(found.light_xy_m[1]));
  mo_environments_drop(&found, 1);
  mo_environment_hash(&environment, &hashes[0]);
  mo_sha256_of(bytes, size, &hashes[1]);
  CHECK(mo_sha256_equal(&hashes[0], &hashes[1]));
  for (size_t cut = 1; cut <= 6 * sizeof(double) + 16; cut++) /* within what follows the fields */
    CHECK_INT(mo_decode_environment(bytes, size - cut, &found), MO_ERR_CORRUPT);
  const size_t head = size - 6 * sizeof(double);
  const struct {
    size_t at;
    double value;
  } bad[] = {{head, NAN}, {head, 101}, {head + 8, -0.0}, {head - 8, 3}, {head - 8, 0}};
  for (size_t i = 0; i < COUNT(bad); i++) {
    double kept;
    memcpy(&kept, bytes + bad[i].at, sizeof(kept));
    memcpy(bytes + bad[i].at, &bad[i].value, sizeof(kept));
    CHECK_INT(mo_decode_environment(bytes, size, &found), MO_ERR_CORRUPT);
    CHECK(found.grid == NULL);
    memcpy(bytes + bad[i].at, &kept, sizeof(kept));
  }
  bytes[head - 16] = 2; /* columns */
  CHECK_INT(mo_decode_environment(bytes, size, &found), MO_ERR_CORRUPT);
  bytes[head - 16] = 255;
  CHECK_INT(mo_decode_environment(bytes, size, &found), MO_ERR_CORRUPT);
  bytes[head - 16] = 3;
  bytes[16] = 1; /* one of the 8 × 8 heights, which must be 0 */
  CHECK_INT(mo_decode_environment(bytes, size, &found), MO_ERR_CORRUPT);
  CHECK(found.grid == NULL);
  mo_environments_drop(&environment, 1);
}

/* The shape of a profile follows the task. */
static void encodes_profiles(void)
{
  struct mo_environment environment = {.light_xy_m = {4, 2},
                                       .terrain_heights_m = {0.5, -1, 0.25},
                                       .n_profile = 3,
                                       .profile_spacing_m = 0.3},
                        grid = environment, found;
  uint8_t bytes[MO_ENVIRONMENT_BYTES_MAX], plain[MO_ENVIRONMENT_BYTES_MAX];
  struct mo_sha256 hashes[2];
  grid.n_profile = 0;
  grid.profile_spacing_m = 0;
  const size_t size = mo_encode_environment(&environment, bytes);
  const size_t grid_size = mo_encode_environment(&grid, plain);
  REQUIRE(grid_size == 66 * sizeof(double) && size > grid_size && size <= sizeof(bytes));
  CHECK(SAME(bytes, plain, grid_size));
  REQUIRE_OK(mo_decode_environment(bytes, size, &found));
  CHECK(found.n_profile == 3 && found.profile_spacing_m == 0.3 &&
        found.terrain_heights_m[2] == 0.25);
  CHECK_INT(mo_decode_environment(bytes, size - 12, &found), MO_ERR_CORRUPT);
  mo_environment_hash(&environment, &hashes[0]);
  mo_environment_hash(&grid, &hashes[1]);
  CHECK(memcmp(&hashes[0], &hashes[1], sizeof(hashes[0])) != 0);
  CHECK_TEXT(MO_SHA256_HEX(&hashes[0]),
             "de789e7b68e20bd986e394850830226f71dd305ff109b93d7ba80e15ad729e1d");
}

/* The drop needs version 8; environments without one keep their bytes, with factors or not. */
static void encodes_drops(void)
{
  struct mo_environment environment = {.light_xy_m = {4, 2}, .drop_m = 0.25}, whole, found;
  uint8_t bytes[MO_ENVIRONMENT_BYTES_MAX], plain[MO_ENVIRONMENT_BYTES_MAX];
  struct mo_sha256 hashes[2];
  whole = environment;
  whole.drop_m = 0;
  const size_t size = mo_encode_environment(&environment, bytes);
  REQUIRE(mo_encode_environment(&whole, plain) == 66 * sizeof(double) && size <= sizeof(bytes));
  REQUIRE_OK(mo_decode_environment(bytes, size, &found));
  CHECK(found.drop_m == 0.25 && found.factors.given == 0 && found.light_xy_m[0] == 4);
  mo_environment_hash(&environment, &hashes[0]);
  mo_environment_hash(&whole, &hashes[1]);
  CHECK(!mo_sha256_equal(&hashes[0], &hashes[1]));
  environment.factors = mo_factors_ones();
  environment.factors.mass = 2;
  whole.factors = environment.factors;
  CHECK_INT(mo_encode_environment(&environment, bytes), size);
  CHECK_INT(mo_encode_environment(&whole, plain), size - sizeof(double));
  REQUIRE_OK(mo_decode_environment(bytes, size, &found));
  CHECK(found.drop_m == 0.25 && found.factors.mass == 2);
  environment.drop_m = 1.5;
  CHECK_INT(mo_decode_environment(bytes, mo_encode_environment(&environment, bytes), &found),
            MO_ERR_CORRUPT);
  CHECK_INT(mo_environment_check(&environment, NULL), MO_ERR_RANGE);
}

/* Damage follows the shape of a profile. */
static void encodes_damage(void)
{
  struct mo_environment environment = {.light_xy_m = {4, 2}, .damage = {3, 1.5}}, whole, found;
  uint8_t bytes[MO_ENVIRONMENT_BYTES_MAX], plain[MO_ENVIRONMENT_BYTES_MAX];
  struct mo_sha256 hash;
  whole = environment;
  whole.damage = (struct mo_damage){0, 0};
  const size_t size = mo_encode_environment(&environment, bytes);
  REQUIRE(mo_encode_environment(&whole, plain) == 66 * sizeof(double) && size <= sizeof(bytes));
  CHECK(SAME(bytes, plain, 66 * sizeof(double)));
  REQUIRE_OK(mo_decode_environment(bytes, size, &found));
  CHECK(found.damage.cut == 3 && found.damage.time_s == 1.5 && found.n_profile == 0);
  CHECK_INT(mo_decode_environment(bytes, size - 12, &found), MO_ERR_CORRUPT);
  mo_environment_hash(&environment, &hash);
  CHECK_TEXT(MO_SHA256_HEX(&hash),
             "eead583ca1cb462189629e307ee6b969b43114c8d320de3905e48758f43c3352");
  environment.damage.time_s = -5; /* a row that somebody wrote */
  CHECK_INT(mo_decode_environment(bytes, mo_encode_environment(&environment, bytes), &found),
            MO_ERR_CORRUPT);
  environment.damage.cut = 1 + MO_OCTANTS;
  CHECK_INT(mo_environment_check(&environment, NULL), MO_ERR_RANGE);
  environment.damage = (struct mo_damage){0, 1};
  CHECK_INT(mo_environment_check(&environment, NULL), MO_ERR_INVALID);
}

/* Objectives that came later: environments with the others keep their bytes. */
static void encodes_objectives(void)
{
  struct mo_environment environment = {.light_xy_m = {4, 2}}, found;
  uint8_t bytes[MO_ENVIRONMENT_BYTES_MAX], other[MO_ENVIRONMENT_BYTES_MAX];
  struct mo_sha256 hash;
  environment.task.objective = MO_OBJECTIVE_PURSUE - 1;
  const size_t earlier = mo_encode_environment(&environment, bytes);
  environment.task.objective = MO_OBJECTIVE_JUMP;
  const size_t size = mo_encode_environment(&environment, bytes);
  CHECK(size > earlier && size <= sizeof(bytes));
  REQUIRE_OK(mo_decode_environment(bytes, size, &found));
  CHECK(found.task.objective == MO_OBJECTIVE_JUMP && found.task.n_terms == 0);
  mo_environment_hash(&environment, &hash);
  CHECK_TEXT(MO_SHA256_HEX(&hash),
             "6641b45d55586eebb97a8c8fbc243238661dab937dbd7797bb7aa494135c6337");
  environment.task =
      (struct mo_task){.objective = MO_OBJECTIVE_SUM,
                       .n_terms = 2,
                       .terms = {MO_OBJECTIVE_REACH, MO_TERM_MEASURE + MO_MEASURE_WORK},
                       .weights = {1, -0.001}};
  CHECK_INT(mo_encode_environment(&environment, other), size);
  REQUIRE_OK(mo_decode_environment(other, size, &found));
  CHECK(found.task.objective == MO_OBJECTIVE_SUM && found.task.n_terms == 2 &&
        found.task.terms[1] == MO_TERM_MEASURE + MO_MEASURE_WORK &&
        found.task.weights[1] == -0.001);
  mo_environment_hash(&environment, &hash);
  CHECK_TEXT(MO_SHA256_HEX(&hash),
             "52f08aade5fdaab4b5f25563153fa889b2834e56b48e87198d70febaf5bad4f8");
  environment.task.weights[1] = 0; /* a row that somebody wrote */
  CHECK_INT(mo_decode_environment(other, mo_encode_environment(&environment, other), &found),
            MO_ERR_CORRUPT);
}

static void refuses_other_bytes(void)
{
  const struct mo_physics physics = mo_paper_physics();
  struct mo_physics found;
  uint8_t bytes[MO_PHYSICS_BYTES_MAX];
  enum mo_precision precision;
  enum mo_sensor sensor;
  const size_t size = by_hand(&physics, 0, bytes);
  const size_t bad[] = {0, size - 16, size - 8, size - 4}; /* version, impact, precision, sensor */
  CHECK_INT(mo_decode_physics(NULL, 0, &found, &precision, &sensor), MO_ERR_CORRUPT);
  CHECK_INT(mo_decode_physics(bytes, size - 1, &found, &precision, &sensor), MO_ERR_CORRUPT);
  for (int i = 0; i < 4; i++) {
    const uint8_t kept = bytes[bad[i]];
    bytes[bad[i]] = 7;
    CHECK_INT(mo_decode_physics(bytes, size, &found, &precision, &sensor), MO_ERR_CORRUPT);
    bytes[bad[i]] = kept;
  }
}

/* −0 is encoded as 0, and the number of bisections counts only if it is used. */
static void hashes(void)
{
  struct mo_physics physics = mo_paper_physics();
  struct mo_environment environment = {.light_xy_m = {-0.0, 2}, .terrain_heights_m = {0.5, -0.0}};
  struct mo_sha256 hash;
  physics.drop_height_m = -0.0;
  physics.scheme.bisections = 9;
  mo_physics_hash(&physics, MO_FLOAT32, MO_SENSOR_INVERSE_SQRT, &hash);
  CHECK_TEXT(MO_SHA256_HEX(&hash),
             "b91aae0860adacfc0d9697aca4034ab2b9cc25df772552e7b316eaf374bb11c8");
  physics.scheme.integrator = MO_INTEGRATOR_SPLIT;
  mo_physics_hash(&physics, MO_FLOAT32, MO_SENSOR_INVERSE_SQRT, &hash);
  CHECK_TEXT(MO_SHA256_HEX(&hash),
             "c206598e7d523cd4c319d994bbb5d9118b6dd62ed6a742c86ec72899395ff711");
  mo_environment_hash(&environment, &hash);
  CHECK_TEXT(MO_SHA256_HEX(&hash),
             "e68393e703c13e7004db2d8b7d341dd6dad5ece4be2ad3c3caf9d5f6ab7b23e4");
}

static const struct check_case cases[] = {
    {"encodes physics", encodes_physics},
    {"encodes settings of later versions", encodes_later_settings},
    {"encodes environments", encodes_environments},
    {"encodes profiles", encodes_profiles},
    {"grids of other sizes are encoded with their heights", encodes_grids},
    {"encodes drops", encodes_drops},
    {"encodes damage", encodes_damage},
    {"encodes objectives", encodes_objectives},
    {"refuses other bytes", refuses_other_bytes},
    {"hashes", hashes},
};
CHECK_MAIN(cases)
