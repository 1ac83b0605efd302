/* terrain.c: heights and gradients compared with corner values, differences and closed forms. */
#include "../make.h"

#define SPACING (5.0 / 7.0)

static void corners(void)
{
  struct mo_environment environment = {0};
  double *heights = environment.terrain_heights_m;
  for (int k = 0; k < 64; k++)
    heights[k] = sin(3.0 * k) * 0.1;
  for (int j = 0; j < 8; j++)
    for (int i = 0; i < 8; i++)
      CHECK_NEAR(mo_terrain_height(&environment, i * SPACING, j * SPACING), heights[j * 8 + i],
                 1e-15);
}

/* A bilinear function is reproduced exactly everywhere. */
static void bilinear(void)
{
  struct mo_environment environment = {0};
  double *heights = environment.terrain_heights_m;
  for (int k = 0; k < 64; k++) {
    double x = k % 8 * SPACING;
    double y = k / 8 * SPACING; // NOLINT(bugprone-integer-division): the row
    heights[k] = 0.3 + 0.2 * x - 0.1 * y + 0.05 * x * y;
  }
  struct mo_random random = dice(1, 0, 0);
  for (int n = 0; n < 1000; n++) {
    double x = 5.0 * mo_random_uniform(&random);
    double y = 5.0 * mo_random_uniform(&random);
    double gradient[2];
    mo_terrain_gradient(&environment, x, y, gradient);
    CHECK_NEAR(mo_terrain_height(&environment, x, y), 0.3 + 0.2 * x - 0.1 * y + 0.05 * x * y,
               1e-14);
    CHECK_NEAR(gradient[0], 0.2 + 0.05 * y, 1e-13);
    CHECK_NEAR(gradient[1], -0.1 + 0.05 * x, 1e-13);
  }
}

static void differences(void)
{
  struct mo_environment environment = {0};
  double *heights = environment.terrain_heights_m;
  mo_terrain_random(5, 0, 0, 0.1, heights);
  struct mo_random random = dice(2, 0, 0);
  double step = 1e-6;
  for (int n = 0; n < 1000; n++) {
    /* inside one cell, so that no line between cells lies within the step */
    double x =
        ((double)mo_random_below(&random, 7) + 0.01 + 0.98 * mo_random_uniform(&random)) * SPACING;
    double y =
        ((double)mo_random_below(&random, 7) + 0.01 + 0.98 * mo_random_uniform(&random)) * SPACING;
    double gradient[2];
    mo_terrain_gradient(&environment, x, y, gradient);
    CHECK_NEAR(gradient[0],
               (mo_terrain_height(&environment, x + step, y) -
                mo_terrain_height(&environment, x - step, y)) /
                   (2 * step),
               1e-8);
    CHECK_NEAR(gradient[1],
               (mo_terrain_height(&environment, x, y + step) -
                mo_terrain_height(&environment, x, y - step)) /
                   (2 * step),
               1e-8);
  }
}

static void outside(void)
{
  struct mo_environment environment = {0};
  double *heights = environment.terrain_heights_m;
  mo_terrain_random(6, 0, 0, 0.1, heights);
  double gradient[2];
  CHECK(mo_terrain_height(&environment, -1.0, 2.0) == mo_terrain_height(&environment, 0.0, 2.0));
  CHECK(mo_terrain_height(&environment, 9.0, 2.0) == mo_terrain_height(&environment, 5.0, 2.0));
  CHECK(mo_terrain_height(&environment, 1.0, -1e300) == mo_terrain_height(&environment, 1.0, 0.0));
  CHECK(mo_terrain_height(&environment, INFINITY, 1e300) == heights[63]);
  CHECK(mo_terrain_height(&environment, 5.0, 5.0) == heights[63]);
  CHECK(isfinite(mo_terrain_height(&environment, NAN, NAN)));
  mo_terrain_gradient(&environment, -0.1, 2.0, gradient);
  CHECK(gradient[0] == 0.0 && gradient[1] != 0.0);
  mo_terrain_gradient(&environment, 2.0, 5.1, gradient);
  CHECK(gradient[0] != 0.0 && gradient[1] == 0.0);
  /* The far edge itself belongs to the last cell. */
  mo_terrain_gradient(&environment, 5.0, 5.0, gradient);
  CHECK_NEAR(gradient[0], (heights[63] - heights[62]) / SPACING, 1e-13);
  CHECK_NEAR(gradient[1], (heights[63] - heights[55]) / SPACING, 1e-13);
  double highest = mo_terrain_highest(&environment);
  int met = 0;
  for (int k = 0; k < 64; k++) {
    CHECK(heights[k] <= highest);
    met += heights[k] == highest;
  }
  CHECK(met >= 1);
}

static void checks(void)
{
  struct mo_environment environment;
  uint32_t where = 99;
  mo_environment_training(1, 2, 3, &environment);
  CHECK_INT(mo_environment_check(&environment, &where), MO_OK);
  CHECK_INT(where, 99);
  const struct {
    double *number;
    double value;
    int code;
    uint32_t where;
  } bad[] = {{&environment.light_xy_m[1], NAN, MO_ERR_INVALID, 1},
             {&environment.light_xy_m[0], -1000.5, MO_ERR_RANGE, 0},
             {&environment.terrain_heights_m[63], -INFINITY, MO_ERR_INVALID, 65},
             {&environment.terrain_heights_m[7], 100.5, MO_ERR_RANGE, 9},
             {&environment.terrain_heights_m[7], 100.0, MO_OK, 9}};
  for (size_t i = 0; i < COUNT(bad); i++) {
    const double good = *bad[i].number;
    *bad[i].number = bad[i].value;
    CHECK_INT(mo_environment_check(&environment, &where), bad[i].code);
    CHECK_INT(where, bad[i].where);
    *bad[i].number = good;
  }
}

static const struct check_case cases[] = {
    {"grid points have their heights", corners}, {"bilinear functions are exact", bilinear},
    {"gradients are differences", differences},  {"coordinates are clamped", outside},
    {"environments are checked", checks},
};
CHECK_MAIN(cases)
