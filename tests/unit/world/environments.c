/* environments.c: random terrains, training environments and the paper's test set compared with
 * their specifications. */
#include "../make.h"

static double lowest(const double heights_m[64])
{
  double low = heights_m[0];
  for (int k = 1; k < 64; k++)
    low = fmin(low, heights_m[k]);
  return low;
}

static double deviation(const double heights_m[64])
{
  double mean = 0, square = 0;
  for (int k = 0; k < 64; k++)
    mean += heights_m[k] / 64;
  for (int k = 0; k < 64; k++)
    square += (heights_m[k] - mean) * (heights_m[k] - mean) / 63;
  return sqrt(square);
}

static void terrains(void)
{
  double heights[64], other[64], square = 0;
  const int n = 2000;
  for (int i = 0; i < n; i++) {
    mo_terrain_random(8, 1, (uint64_t)i, 0.06, heights);
    CHECK(lowest(heights) == MO_TERRAIN_FLOOR_M);
    double d = deviation(heights);
    square += d * d / n;
  }
  /* The mean of the sample variance is σ², with relative error sqrt(2/(63 n)). */
  CHECK_NEAR(square / (0.06 * 0.06), 1.0, 4.0 * sqrt(2.0 / 63 / n));
  mo_terrain_random(8, 1, 0, 0.0, heights);
  for (int k = 0; k < 64; k++)
    CHECK(heights[k] == MO_TERRAIN_FLOOR_M);
  mo_terrain_random(8, 1, 5, 0.06, heights);
  mo_terrain_random(8, 1, 5, 0.06, other);
  CHECK(SAME(heights, other, COUNT(heights)));
  mo_terrain_random(9, 1, 5, 0.06, other);
  CHECK(!SAME(heights, other, COUNT(heights)));
  mo_terrain_random(8, 2, 5, 0.06, other);
  CHECK(!SAME(heights, other, COUNT(heights)));
}

/* Uniform by area: r² is uniform between 0.16 and 4, the angle is uniform. */
static void training(void)
{
  enum { N = 40000, BINS = 16 };
  int by_area[BINS] = {0}, by_angle[BINS] = {0};
  double sigma_sum = 0, chi_area = 0, chi_angle = 0;
  for (int i = 0; i < N; i++) {
    struct mo_environment environment;
    mo_environment_training(3, 4, (uint64_t)i, &environment);
    CHECK_INT(mo_environment_check(&environment, NULL), MO_OK);
    CHECK(lowest(environment.terrain_heights_m) == MO_TERRAIN_FLOOR_M);
    double x = environment.light_xy_m[0] - 2.5;
    double y = environment.light_xy_m[1] - 2.5;
    double square = x * x + y * y;
    REQUIRE(square >= 0.16 - 1e-12 && square <= 4.0 + 1e-12);
    int area = (int)((square - 0.16) / 3.84 * BINS);
    int angle = (int)((atan2(y, x) / (2.0 * M_PI) + 0.5) * BINS);
    by_area[area < 0 ? 0 : area > BINS - 1 ? BINS - 1 : area]++;
    by_angle[angle > BINS - 1 ? BINS - 1 : angle]++;
    sigma_sum += deviation(environment.terrain_heights_m);
  }
  const double expected = (double)N / BINS;
  for (int i = 0; i < BINS; i++) {
    chi_area += (by_area[i] - expected) * (by_area[i] - expected) / expected;
    chi_angle += (by_angle[i] - expected) * (by_angle[i] - expected) / expected;
  }
  CHECK_NEAR(chi_area, BINS - 1, 4.0 * sqrt(2.0 * (BINS - 1)));
  CHECK_NEAR(chi_angle, BINS - 1, 4.0 * sqrt(2.0 * (BINS - 1)));
  CHECK_NEAR(sigma_sum / N, 0.05 * (1.0 - 1.0 / 252),
             0.001); /* the mean of σ, and the deviation of a sample's own value from it */
}

static void test_set(void)
{
  struct mo_environment environments[MO_PAPER_TEST_COUNT], again[MO_PAPER_TEST_COUNT];
  mo_environment_paper_test(environments);
  mo_environment_paper_test(again);
  CHECK(SAME(environments, again, COUNT(environments)));
  int used[2] = {0, 0};
  for (int i = 0; i < MO_PAPER_TEST_COUNT; i++) {
    CHECK_INT(mo_environment_check(&environments[i], NULL), MO_OK);
    int ring = i / 5;
    double radius = ring == 0 ? 2.0 : 1.5;
    double angle = 2.0 * M_PI * (i % 5) / 5.0 + (ring == 0 ? 0.0 : M_PI / 5.0);
    CHECK_NEAR(environments[i].light_xy_m[0], 2.5 + radius * cos(angle), 1e-15);
    CHECK_NEAR(environments[i].light_xy_m[1], 2.5 + radius * sin(angle), 1e-15);
    CHECK(lowest(environments[i].terrain_heights_m) == MO_TERRAIN_FLOOR_M);
    /* The heights are σ times the normal numbers of a documented stream, shifted. */
    struct mo_random random;
    double z[64];
    mo_random_init(&random, MO_PAPER_TEST_SEED, MO_PURPOSE_TEST_SET, 0, (uint64_t)i + 1);
    for (int k = 0; k < 64; k++)
      z[k] = mo_random_normal(&random);
    const double *heights = environments[i].terrain_heights_m;
    double sigma = (heights[1] - heights[0]) / (z[1] - z[0]);
    for (int k = 2; k < 64; k++)
      CHECK_NEAR(heights[k] - heights[0], sigma * (z[k] - z[0]), 1e-12);
    int level = (int)lround(sigma / 0.02);
    printf("# environment %d: light (%.4f, %.4f) m, sigma %.4f m\n", i,
           environments[i].light_xy_m[0], environments[i].light_xy_m[1], sigma);
    CHECK_NEAR(sigma, 0.02 * level, 1e-9);
    CHECK(level >= 1 && level <= 5);
    used[ring] |= 1 << level;
  }
  CHECK_INT(used[0], 0x3e);
  CHECK_INT(used[1], 0x3e);
}

static const struct check_case cases[] = {
    {"random terrains have their deviation and floor", terrains},
    {"training environments fill the ring evenly", training},
    {"the paper's test set has its rings, with every difficulty on each", test_set},
};
CHECK_MAIN(cases)
