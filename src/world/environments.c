/* environments.c: random terrains, training environments, the paper test set.
 *
 * Every number comes from Philox streams and exact algebra (no sine, cosine or logarithm of the C
 * library), so that the same name yields the same environment, bit for bit, on every machine.
 *
 * Training environment (seed, step, index): the stream LIGHT supplies σ, then points in the square
 * around the ring until one lies in the ring; the stream TERRAIN supplies the heights. Held out:
 * the same with step 0, from the streams HELD_OUT_LIGHT and HELD_OUT_TERRAIN.
 *
 * Paper test set: key MO_PAPER_TEST_SEED, purpose TEST_SET, step 0. Index 0 shuffles the five σ for
 * the ring of 2.0 m, then for the ring of 1.5 m (Fisher-Yates from the top); index 1 + i supplies
 * the heights of environment i. */
#include <morpho/random.h>

#include "world/environment.h"

#define RING         5
#define SIGMA_TOP_M  0.1
#define LIGHT_NEAR_M 0.4
#define LIGHT_FAR_M  2.0

static void draw_terrain(struct mo_random *random, double sigma_m,
                         double heights_m[MO_TERRAIN_HEIGHTS])
{
  double lowest = 0.0;
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++) {
    heights_m[k] = sigma_m * mo_random_normal(random);
    if (k == 0 || heights_m[k] < lowest)
      lowest = heights_m[k];
  }
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
    heights_m[k] = (heights_m[k] - lowest) + MO_TERRAIN_FLOOR_M;
}

void mo_terrain_random(uint64_t seed, uint32_t step, uint64_t index, double sigma_m,
                       double heights_m[MO_TERRAIN_HEIGHTS])
{
  struct mo_random random;
  mo_random_init(&random, seed, MO_PURPOSE_TERRAIN, step, index);
  draw_terrain(&random, sigma_m, heights_m);
}

/* Returns σ. */
static double draw_light(struct mo_random *random, double light_xy_m[2])
{
  double sigma_m = SIGMA_TOP_M * mo_random_uniform(random);
  double x;
  double y;
  double square;
  do {
    x = LIGHT_FAR_M * (2.0 * mo_random_uniform(random) - 1.0);
    y = LIGHT_FAR_M * (2.0 * mo_random_uniform(random) - 1.0);
    square = x * x + y * y;
  } while (square < LIGHT_NEAR_M * LIGHT_NEAR_M || square > LIGHT_FAR_M * LIGHT_FAR_M);
  light_xy_m[0] = MO_WORLD_CENTER_M + x;
  light_xy_m[1] = MO_WORLD_CENTER_M + y;
  return sigma_m;
}

static void draw_environment(uint64_t seed, enum mo_purpose light, enum mo_purpose terrain,
                             uint32_t step, uint64_t index, struct mo_environment *environment)
{
  struct mo_random random;
  *environment = mo_environment_defaults;
  mo_random_init(&random, seed, light, step, index);
  const double sigma_m = draw_light(&random, environment->light_xy_m);
  mo_random_init(&random, seed, terrain, step, index);
  draw_terrain(&random, sigma_m, environment->terrain_heights_m);
}

void mo_environment_training(uint64_t seed, uint32_t step, uint64_t index,
                             struct mo_environment *environment)
{
  draw_environment(seed, MO_PURPOSE_LIGHT, MO_PURPOSE_TERRAIN, step, index, environment);
}

void mo_environment_held_out(uint64_t seed, uint64_t index, struct mo_environment *environment)
{
  draw_environment(seed, MO_PURPOSE_HELD_OUT_LIGHT, MO_PURPOSE_HELD_OUT_TERRAIN, 0, index,
                   environment);
}

void mo_environment_paper_test(struct mo_environment environments[MO_PAPER_TEST_COUNT])
{
  /* cos and sin of k · 36°, k = 0 … 9. */
  static const double cosine[2 * RING] = {1.0,
                                          0.80901699437494742410,
                                          0.30901699437494742410,
                                          -0.30901699437494742410,
                                          -0.80901699437494742410,
                                          -1.0,
                                          -0.80901699437494742410,
                                          -0.30901699437494742410,
                                          0.30901699437494742410,
                                          0.80901699437494742410};
  static const double sine[2 * RING] = {0.0,
                                        0.58778525229247312917,
                                        0.95105651629515357212,
                                        0.95105651629515357212,
                                        0.58778525229247312917,
                                        0.0,
                                        -0.58778525229247312917,
                                        -0.95105651629515357212,
                                        -0.95105651629515357212,
                                        -0.58778525229247312917};
  static const double radius_m[2] = {2.0, 1.5};
  struct mo_random pairing;
  mo_random_init(&pairing, MO_PAPER_TEST_SEED, MO_PURPOSE_TEST_SET, 0, 0);
  for (int ring = 0; ring < 2; ring++) {
    double sigma_m[RING] = {0.02, 0.04, 0.06, 0.08, 0.10};
    for (uint32_t i = RING - 1; i > 0; i--) {
      uint32_t j = mo_random_below(&pairing, i + 1);
      double swapped = sigma_m[i];
      sigma_m[i] = sigma_m[j];
      sigma_m[j] = swapped;
    }
    for (int i = 0; i < RING; i++) {
      int place = ring * RING + i;
      struct mo_environment *environment = &environments[place];
      int angle = 2 * i + ring; /* in units of 36° */
      *environment = mo_environment_defaults;
      environment->light_xy_m[0] = MO_WORLD_CENTER_M + radius_m[ring] * cosine[angle];
      environment->light_xy_m[1] = MO_WORLD_CENTER_M + radius_m[ring] * sine[angle];
      struct mo_random random;
      mo_random_init(&random, MO_PAPER_TEST_SEED, MO_PURPOSE_TEST_SET, 0,
                     UINT64_C(1) + (uint64_t)place);
      draw_terrain(&random, sigma_m[i], environment->terrain_heights_m);
    }
  }
}
