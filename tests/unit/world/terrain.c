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

/* ---- profiles ---- */

static struct mo_environment profile_of(uint64_t k, uint32_t n, double spacing_m)
{
  struct mo_environment environment = {.n_profile = n, .profile_spacing_m = spacing_m};
  struct mo_random random = dice(11, 0, k);
  for (uint32_t i = 0; i < n; i++)
    environment.terrain_heights_m[i] = 0.1 * mo_random_normal(&random);
  return environment;
}

static const struct {
  uint32_t n;
  double spacing_m;
} profiles[] = {{2, 0.02}, {2, 1}, {9, 0.37}, {64, 0.1}, {64, 0.02}, {63, 1}};

/* Linear interpolation, and its slope, by a search for the interval; x beyond the ends is moved to
 * them. */
static void profile_values(void)
{
  struct mo_random random = dice(12, 0, 0);
  for (size_t c = 0; c < COUNT(profiles); c++) {
    const uint32_t n = profiles[c].n;
    const double d = profiles[c].spacing_m, end = (n - 1) * d;
    const struct mo_environment environment = profile_of(c, n, d);
    const double *h = environment.terrain_heights_m;
    for (int trial = 0; trial < 2000; trial++) {
      const double x = (1.4 * mo_random_uniform(&random) - 0.2) * end,
                   y = 20 * mo_random_uniform(&random) - 10;
      double gradient[2], height = x < 0 ? h[0] : h[n - 1], slope = 0;
      for (uint32_t k = 0; k + 1 < n && x >= 0; k++)
        if (x >= k * d && x < (k + 1) * d) {
          height = (h[k] * ((k + 1) * d - x) + h[k + 1] * (x - k * d)) / d;
          slope = (h[k + 1] - h[k]) / d;
        }
      mo_terrain_gradient(&environment, x, y, gradient);
      CHECK_NEAR(mo_terrain_height(&environment, x, y), height, 1e-13);
      CHECK_NEAR(gradient[0], slope, 1e-11);
      CHECK(gradient[1] == 0);
    }
  }
}

/* At the heights themselves, beyond the ends, on the lines, and for values that are not finite. */
static void profile_limits(void)
{
  for (size_t c = 0; c < COUNT(profiles); c++) {
    const uint32_t n = profiles[c].n;
    const double d = profiles[c].spacing_m;
    const struct mo_environment environment = profile_of(c, n, d);
    const double *h = environment.terrain_heights_m;
    double gradient[2];
    for (uint32_t k = 0; k < n; k++)
      CHECK_NEAR(mo_terrain_height(&environment, k * d, 2.5), h[k], 1e-13);
    CHECK(mo_terrain_height(&environment, -1e300, 1) == h[0]);
    CHECK_NEAR(mo_terrain_height(&environment, INFINITY, -INFINITY), h[n - 1], 1e-15);
    CHECK_NEAR(mo_terrain_height(&environment, 1e-9 + (n - 1) * d, NAN), h[n - 1], 1e-15);
    CHECK(isfinite(mo_terrain_height(&environment, NAN, INFINITY)));
    mo_terrain_gradient(&environment, -1e-9, 0, gradient);
    CHECK(gradient[0] == 0 && gradient[1] == 0);
    mo_terrain_gradient(&environment, (n - 1) * d * (1 + 1e-12), 0, gradient);
    CHECK(gradient[0] == 0);
    mo_terrain_gradient(&environment, (n - 1) * d, INFINITY, gradient); /* of the last cell */
    CHECK_NEAR(gradient[0], (h[n - 1] - h[n - 2]) / d, 1e-11);
    CHECK(gradient[1] == 0);
    mo_terrain_gradient(&environment, 0, -3, gradient);
    CHECK_NEAR(gradient[0], (h[1] - h[0]) / d, 1e-11);
    double highest = h[0];
    for (uint32_t k = 1; k < n; k++)
      highest = fmax(highest, h[k]);
    CHECK(mo_terrain_highest(&environment) == highest);
  }
  /* Heights that it does not have do not count. */
  struct mo_environment low = {.n_profile = 3, .profile_spacing_m = 0.1};
  for (int k = 0; k < 3; k++)
    low.terrain_heights_m[k] = -1 - k;
  CHECK(mo_terrain_highest(&low) == -1);
}

static void profile_checks(void)
{
  const struct {
    uint32_t n;
    double spacing_m;
    int set; /* a height that is 1 */
    int code;
    uint32_t where;
  } tries[] = {{0, 0, 63, MO_OK, 99},
               {2, 0.02, 1, MO_OK, 99},
               {64, 1, 63, MO_OK, 99},
               {0, 0.1, 0, MO_ERR_RANGE, MO_ENVIRONMENT_PROFILE},
               {1, 0.1, 0, MO_ERR_RANGE, MO_ENVIRONMENT_PROFILE},
               {65, 0.1, 0, MO_ERR_RANGE, MO_ENVIRONMENT_PROFILE},
               {8, 0, 0, MO_ERR_RANGE, MO_ENVIRONMENT_PROFILE},
               {8, 0.0199, 0, MO_ERR_RANGE, MO_ENVIRONMENT_PROFILE},
               {8, 1.001, 0, MO_ERR_RANGE, MO_ENVIRONMENT_PROFILE},
               {8, -0.1, 0, MO_ERR_RANGE, MO_ENVIRONMENT_PROFILE},
               {8, NAN, 0, MO_ERR_INVALID, MO_ENVIRONMENT_PROFILE},
               {0, INFINITY, 0, MO_ERR_INVALID, MO_ENVIRONMENT_PROFILE},
               {8, 0.1, 8, MO_ERR_INVALID, 10},
               {8, 0.1, 63, MO_ERR_INVALID, 65}};
  for (size_t i = 0; i < COUNT(tries); i++) {
    struct mo_environment environment = {.n_profile = tries[i].n,
                                         .profile_spacing_m = tries[i].spacing_m};
    uint32_t where = 99;
    environment.terrain_heights_m[tries[i].set] = 1;
    CHECK_INT(mo_environment_check(&environment, &where), tries[i].code);
    CHECK_INT(where, tries[i].where);
    CHECK_INT(mo_environment_check(&environment, NULL), tries[i].code);
  }
}

/* ---- grids of other sizes ---- */

/* A bilinear function of the distance from the center is reproduced everywhere, with its slopes;
 * beyond the edges, the height is that of the edge. */
static void grid_values(void)
{
  static const struct {
    uint32_t columns, rows;
    double spacing_m;
  } shapes[] = {{2, 2, 2}, {128, 128, 0.02}, {128, 3, 0.3}, {9, 40, 0.11}, {8, 8, SPACING}};
  struct mo_random random = dice(13, 0, 0);
  for (size_t c = 0; c < COUNT(shapes); c++) {
    const uint32_t columns = shapes[c].columns, rows = shapes[c].rows;
    const double d = shapes[c].spacing_m, half_x = (columns - 1) * d / 2,
                 half_y = (rows - 1) * d / 2;
    struct mo_environment environment = {.grid = NULL};
    double *heights = make_zeros((size_t)columns * rows, sizeof(double)), highest = -INFINITY;
    for (uint32_t k = 0; k < columns * rows; k++) {
      const double x = k % columns * d - half_x;
      const double y = k / columns * d - half_y; // NOLINT(bugprone-integer-division): the row
      heights[k] = 0.3 + 0.2 * x - 0.1 * y + 0.05 * x * y;
      highest = fmax(highest, heights[k]);
    }
    REQUIRE_OK(mo_terrain_grid_create(columns, rows, d, heights, &environment.grid));
    CHECK(mo_environment_check(&environment, NULL) == MO_OK);
    CHECK(mo_terrain_highest(&environment) == highest);
    for (int trial = 0; trial < 2000; trial++) {
      const double x = 2.6 * (mo_random_uniform(&random) - 0.5) * half_x,
                   y = 2.6 * (mo_random_uniform(&random) - 0.5) * half_y;
      const double u = fmin(fmax(x, -half_x), half_x), w = fmin(fmax(y, -half_y), half_y);
      double gradient[2];
      mo_terrain_gradient(&environment, 2.5 + x, 2.5 + y, gradient);
      CHECK_NEAR(mo_terrain_height(&environment, 2.5 + x, 2.5 + y),
                 0.3 + 0.2 * u - 0.1 * w + 0.05 * u * w, 1e-12);
      CHECK_NEAR(gradient[0], u == x ? 0.2 + 0.05 * w : 0, 1e-10);
      CHECK_NEAR(gradient[1], w == y ? -0.1 + 0.05 * u : 0, 1e-10);
    }
    CHECK(isfinite(mo_terrain_height(&environment, NAN, INFINITY)));
    mo_environments_drop(&environment, 1);
    CHECK(environment.grid == NULL);
  }
}

/* With the size of the usual grid, every number is the same, on and beyond the map. */
static void grid_as_usual(void)
{
  struct mo_environment usual = {.grid = NULL}, other = {.grid = NULL};
  struct mo_random random = dice(14, 0, 0);
  mo_terrain_random(5, 0, 0, 0.1, usual.terrain_heights_m);
  REQUIRE_OK(mo_terrain_grid_create(8, 8, SPACING, usual.terrain_heights_m, &other.grid));
  CHECK(other.grid->from_m[0] == 0 && other.grid->from_m[1] == 0);
  for (int trial = 0; trial < 5000; trial++) {
    const double x = 7 * mo_random_uniform(&random) - 1, y = 7 * mo_random_uniform(&random) - 1;
    double a[2], b[2];
    mo_terrain_gradient(&usual, x, y, a);
    mo_terrain_gradient(&other, x, y, b);
    CHECK(mo_terrain_height(&usual, x, y) == mo_terrain_height(&other, x, y));
    CHECK(a[0] == b[0] && a[1] == b[1]);
  }
  mo_terrain_grid_drop(other.grid);
}

static void grid_checks(void)
{
  static const struct {
    uint32_t columns, rows;
    double spacing_m, height_m;
    int code;
  } tries[] = {{2, 128, 0.02, 100, MO_OK},       {128, 2, 2, -100, MO_OK},
               {1, 5, 0.1, 0, MO_ERR_RANGE},     {5, 1, 0.1, 0, MO_ERR_RANGE},
               {129, 5, 0.1, 0, MO_ERR_RANGE},   {5, 129, 0.1, 0, MO_ERR_RANGE},
               {5, 5, 0.0199, 0, MO_ERR_RANGE},  {5, 5, 2.01, 0, MO_ERR_RANGE},
               {5, 5, NAN, 0, MO_ERR_INVALID},   {5, 5, 0.1, 100.5, MO_ERR_RANGE},
               {5, 5, 0.1, NAN, MO_ERR_INVALID}, {5, 5, 0.1, -INFINITY, MO_ERR_INVALID}};
  double *heights = make_zeros(129 * 129, sizeof(double));
  for (size_t i = 0; i < COUNT(tries); i++) {
    struct mo_environment environments[2] = {{.grid = NULL}, {.grid = NULL}};
    uint32_t where = 99;
    heights[3] = tries[i].height_m;
    CHECK_INT(mo_terrain_grid_create(tries[i].columns, tries[i].rows, tries[i].spacing_m, heights,
                                     &environments[0].grid),
              tries[i].code);
    if (tries[i].code != MO_OK)
      continue;
    environments[1] = environments[0];
    mo_environments_hold(&environments[1], 1);
    mo_environments_drop(&environments[0], 1);
    CHECK_INT(mo_environment_check(&environments[1], &where), MO_OK);
    environments[1].terrain_heights_m[5] = 1;
    CHECK_INT(mo_environment_check(&environments[1], &where), MO_ERR_INVALID);
    CHECK_INT(where, 7);
    environments[1].n_profile = 8;
    environments[1].profile_spacing_m = 0.1;
    CHECK_INT(mo_environment_check(&environments[1], &where), MO_ERR_INVALID);
    CHECK_INT(where, MO_ENVIRONMENT_PROFILE);
    mo_environments_drop(&environments[1], 1);
  }
}

static const struct check_case cases[] = {
    {"grid points have their heights", corners},
    {"bilinear functions are exact", bilinear},
    {"gradients are differences", differences},
    {"coordinates are clamped", outside},
    {"environments are checked", checks},
    {"profiles are linear between heights", profile_values},
    {"profiles end at their first and last heights", profile_limits},
    {"the shape of a terrain is checked", profile_checks},
    {"grids of other sizes are bilinear around the center", grid_values},
    {"a grid of the usual size has the usual numbers", grid_as_usual},
    {"grids are checked and shared", grid_checks},
};
CHECK_MAIN(cases)
