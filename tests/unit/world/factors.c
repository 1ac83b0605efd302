/* Factors, drops and slopes of environments: drawing by Latin hypercube sampling, products, checks,
 * and what they do to an environment. */
#include "../make.h"

#include "world/factors.h"

enum { N = 500, FACTORS = 6 };

static const struct mo_factor_ranges ranges = {.given = true,
                                               .stiffness = {0.7, 1.3},
                                               .mass = {0.5, 2},
                                               .drag = {1, 1},
                                               .gravity = {0.8, 0.8},
                                               .actuation = {0, 1},
                                               .friction = {1.0 / 3, 4.0 / 3},
                                               .drop_m = {0.05, 0.2},
                                               .slope_degrees = {0, 10}};

static double factor(const struct mo_factors *factors, int k)
{
  const double all[FACTORS] = {factors->stiffness, factors->mass,      factors->drag,
                               factors->gravity,   factors->actuation, factors->friction};
  return all[k];
}

static const double *range(int k)
{
  const double *all[FACTORS] = {ranges.stiffness, ranges.mass,      ranges.drag,
                                ranges.gravity,   ranges.actuation, ranges.friction};
  return all[k];
}

/* Each of the n parts of a range has one number. */
static void one_in_each_part(void)
{
  struct mo_factors drawn[N];
  REQUIRE_OK(mo_factors_draw(&ranges, 5, 3, N, drawn));
  for (int k = 0; k < FACTORS; k++) {
    uint32_t counts[N] = {0}, wrong = 0;
    const double low = range(k)[0], high = range(k)[1];
    for (uint32_t i = 0; i < N; i++) {
      const double value = factor(&drawn[i], k);
      CHECK(drawn[i].given == 1 && mo_factors_check(&drawn[i]) == MO_OK);
      if (low == high)
        CHECK(value == low);
      else
        counts[(uint32_t)fmin(N - 1, (value - low) / (high - low) * N)]++;
    }
    for (uint32_t i = 0; i < N; i++)
      wrong += low < high && counts[i] != 1;
    CHECK(wrong <= 2); /* a number at the border of two parts may be rounded across it */
  }
}

/* Factors are paired at random: their ranks correlate little. */
static void not_correlated(void)
{
  struct mo_factors drawn[N];
  REQUIRE_OK(mo_factors_draw(&ranges, 6, 0, N, drawn));
  for (int a = 0; a < FACTORS; a++)
    for (int b = a + 1; b < FACTORS; b++) {
      const double wide = (range(a)[1] - range(a)[0]) * (range(b)[1] - range(b)[0]);
      double sum = 0;
      for (uint32_t i = 0; i < N && wide > 0; i++)
        sum += (factor(&drawn[i], a) - 0.5 * (range(a)[0] + range(a)[1])) *
               (factor(&drawn[i], b) - 0.5 * (range(b)[0] + range(b)[1]));
      CHECK(wide == 0 || fabs(12 * sum / (wide * N)) < 4 / sqrt(N));
    }
}

static bool same(const struct mo_factors *a, const struct mo_factors *b)
{
  uint32_t n = 0;
  for (uint32_t i = 0; i < N; i++)
    n += a[i].given == b[i].given && mo_fields_equal(&mo_factor_fields, &a[i], &b[i]);
  return n == N;
}

static void streams(void)
{
  struct mo_factors a[N], b[N];
  const struct mo_factor_ranges constant = mo_factors_constant();
  REQUIRE_OK(mo_factors_draw(&ranges, 5, 3, N, a));
  REQUIRE_OK(mo_factors_draw(&ranges, 5, 3, N, b));
  CHECK(same(a, b));
  REQUIRE_OK(mo_factors_draw(&ranges, 5, 4, N, b));
  CHECK(!same(a, b));
  REQUIRE_OK(mo_factors_draw(&ranges, 6, 3, N, b));
  CHECK(!same(a, b));
  REQUIRE_OK(mo_factors_draw(&constant, 6, 3, N, b));
  for (uint32_t i = 0; i < N; i++)
    CHECK(b[i].given == 0);
  CHECK(mo_factors_vary(&ranges) && !mo_factors_vary(&constant));
}

/* One number in each part of the ranges of drop, slope and direction; the factors are those of
 * mo_factors_draw; and each name has numbers of its own, whatever else varies. */
static void variations(void)
{
  static struct mo_variation drawn[N], alone[N];
  struct mo_factors factors[N];
  struct mo_factor_ranges one = mo_factors_constant();
  uint32_t counts[3][N] = {{0}}, wrong = 0;
  double sum[3] = {0};
  REQUIRE_OK(mo_variations_draw(&ranges, 5, 3, N, drawn));
  REQUIRE_OK(mo_factors_draw(&ranges, 5, 3, N, factors));
  for (uint32_t i = 0; i < N; i++) {
    const double shares[3] = {(drawn[i].drop_m - 0.05) / 0.15, drawn[i].slope_degrees / 10,
                              drawn[i].toward_rad / (2 * M_PI)};
    CHECK(drawn[i].factors.given == factors[i].given &&
          mo_fields_equal(&mo_factor_fields, &drawn[i].factors, &factors[i]));
    for (int k = 0; k < 3; k++) {
      REQUIRE(shares[k] >= 0 && shares[k] < 1);
      counts[k][(uint32_t)(shares[k] * N)]++;
      sum[k] += (shares[k] - 0.5) * (shares[(k + 1) % 3] - 0.5);
    }
  }
  for (uint32_t i = 0; i < N; i++)
    for (int k = 0; k < 3; k++)
      wrong += counts[k][i] != 1;
  CHECK(wrong <= 4); /* a number at the border of two parts may be rounded across it */
  for (int k = 0; k < 3; k++)
    CHECK(fabs(12 * sum[k] / N) < 4 / sqrt(N));
  one.given = true;
  memcpy(one.slope_degrees, ranges.slope_degrees, sizeof(one.slope_degrees));
  REQUIRE_OK(mo_variations_draw(&one, 5, 3, N, alone));
  for (uint32_t i = 0; i < N; i++)
    CHECK(alone[i].factors.given == 0 && alone[i].drop_m == 0 &&
          alone[i].slope_degrees == drawn[i].slope_degrees &&
          alone[i].toward_rad == drawn[i].toward_rad);
  CHECK(mo_factors_vary(&one));
  REQUIRE_OK(mo_variations_draw(&one, 5, 4, N, drawn));
  CHECK(drawn[0].slope_degrees != alone[0].slope_degrees);
  one.given = false;
  REQUIRE_OK(mo_variations_draw(&one, 5, 3, N, alone));
  CHECK(!mo_factors_vary(&one) && alone[0].slope_degrees == 0 && alone[0].toward_rad == 0);
}

/* A slope is that of the family `rough` with the same heights, bit for bit. */
static void slopes(void)
{
  struct mo_terrain_recipe recipe = mo_terrain_recipe_default(MO_TERRAIN_ROUGH);
  for (uint64_t seed = 0; seed < 20; seed++) {
    struct mo_environment plain = {.light_xy_m = {4, 3}}, steep = plain, varied;
    struct mo_variation by = {.drop_m = 0.25, .slope_degrees = 1 + (double)seed};
    by.toward_rad = 0.3 * (double)seed;
    recipe.seed = seed;
    recipe.degrees = recipe.toward_rad = 0;
    REQUIRE_OK(mo_terrain_draw(&recipe, &plain, NULL));
    recipe.degrees = by.slope_degrees;
    recipe.toward_rad = by.toward_rad;
    REQUIRE_OK(mo_terrain_draw(&recipe, &steep, NULL));
    varied = plain;
    REQUIRE_OK(mo_environment_vary(&by, &varied));
    CHECK(SAME(varied.terrain_heights_m, steep.terrain_heights_m, MO_TERRAIN_HEIGHTS));
    CHECK(varied.drop_m == 0.25 && mo_environment_check(&varied, NULL) == MO_OK);
    by.slope_degrees = 0;
    varied = plain;
    REQUIRE_OK(mo_environment_vary(&by, &varied));
    CHECK(SAME(varied.terrain_heights_m, plain.terrain_heights_m, MO_TERRAIN_HEIGHTS));
  }
}

static void refused_variations(void)
{
  struct mo_environment environment = {.light_xy_m = {4, 3}}, before;
  struct mo_factor_ranges sloping = mo_factors_constant(), dropping = sloping;
  const struct mo_terrain_recipe stairs = mo_terrain_recipe_default(MO_TERRAIN_STAIRS_UP);
  const struct mo_variation drop = {.drop_m = 0.7}, slope = {.slope_degrees = 3};
  struct mo_message message;
  sloping.given = dropping.given = true;
  sloping.slope_degrees[1] = 30;
  dropping.drop_m[1] = 0.6;
  CHECK_OK(mo_environment_check_vary(&environment, &sloping, NULL));
  environment.drop_m = 0.4;
  CHECK_OK(mo_environment_check_vary(&environment, &dropping, NULL));
  environment.drop_m = 0.5;
  CHECK_INT(mo_environment_check_vary(&environment, &dropping, &message), MO_ERR_RANGE);
  CHECK_SAYS(message, "drop_m (0.5)");
  before = environment;
  CHECK_INT(mo_environment_vary(&drop, &environment), MO_ERR_RANGE);
  CHECK(SAME(&before, &environment, 1));
  environment.terrain_heights_m[0] = 98;
  CHECK_INT(mo_environment_check_vary(&environment, &sloping, &message), MO_ERR_RANGE);
  CHECK_SAYS(message, "100 m");
  REQUIRE_OK(mo_terrain_draw(&stairs, &environment, NULL));
  CHECK_INT(mo_environment_check_vary(&environment, &sloping, &message), MO_ERR_UNSUPPORTED);
  CHECK_SAYS(message, "a profile cannot slope");
  before = environment;
  CHECK_INT(mo_environment_vary(&slope, &environment), MO_ERR_UNSUPPORTED);
  CHECK(SAME(&before, &environment, 1));
  environment.drop_m = 0;
  CHECK_OK(mo_environment_check_vary(&environment, &dropping, NULL));
}

static void products(void)
{
  const struct mo_factors none = {0}, a = {1, 2, 1, 1, 0.5, 1, 0.25}, b = {1, 0.5, 1, 1, 2, 1, 4},
                          c = {1, 3, 1, 1, 1, 1, 1};
  struct mo_factors product = mo_factors_times(&a, &none);
  CHECK(SAME(&product, &a, 1));
  product = mo_factors_times(&none, &a);
  CHECK(SAME(&product, &a, 1));
  product = mo_factors_times(&a, &b);
  CHECK(SAME(&product, &none, 1)); /* all are 1 */
  product = mo_factors_times(&a, &c);
  CHECK(product.stiffness == 6 && product.gravity == 0.5 && product.friction == 0.25);
}

static void checks(void)
{
  struct mo_factors one = mo_factors_ones();
  struct mo_factor_ranges range = ranges;
  struct mo_message message;
  CHECK(mo_factors_check(&one) == MO_ERR_INVALID); /* given, but all are 1 */
  one.mass = 0.009;
  CHECK(mo_factors_check(&one) == MO_ERR_RANGE);
  one.mass = NAN;
  CHECK(mo_factors_check(&one) == MO_ERR_INVALID);
  one.mass = 2;
  CHECK(mo_factors_check(&one) == MO_OK);
  one.given = 0;
  CHECK(mo_factors_check(&one) == MO_ERR_INVALID);
  CHECK(mo_factor_ranges_check("vary", &range, NULL) == MO_OK);
  range.slope_degrees[1] = 31;
  CHECK(mo_factor_ranges_check("vary", &range, &message) == MO_ERR_RANGE);
  CHECK(strstr(message.text, "vary.slope_degrees") != NULL);
  range = ranges;
  range.drop_m[1] = 0.01;
  CHECK(mo_factor_ranges_check("vary", &range, &message) == MO_ERR_RANGE);
  CHECK(strcmp(message.text, "vary.drop_m must be [lowest, highest], got [0.05, 0.01]") == 0);
  range = ranges;
  range.mass[0] = 0;
  CHECK(mo_factor_ranges_check("vary", &range, &message) == MO_ERR_RANGE);
  CHECK(strstr(message.text, "vary.mass") != NULL);
  range.mass[0] = 3;
  CHECK(mo_factor_ranges_check("vary", &range, &message) == MO_ERR_RANGE);
  CHECK(strcmp(message.text, "vary.mass must be [lowest, highest], got [3, 2]") == 0);
}

static const struct check_case cases[] = {
    {"one number in each part of a range", one_in_each_part},
    {"factors are paired at random", not_correlated},
    {"streams", streams},
    {"drops and slopes", variations},
    {"what a slope does to the ground", slopes},
    {"variations that do not suit an environment", refused_variations},
    {"products", products},
    {"checks", checks},
};
CHECK_MAIN(cases)
