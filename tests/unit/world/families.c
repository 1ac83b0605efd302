/* families.c: terrains by the name of a family: their shapes, bounds and frozen bits. */
#include "../make.h"

enum { N = MO_TERRAIN_HEIGHTS, FAMILIES = MO_TERRAIN_STEPS + 1 };

static struct mo_environment draw(const struct mo_terrain_recipe *recipe)
{
  struct mo_environment environment = {.light_xy_m = {4, 3}};
  struct mo_message message = {""};
  make_check(mo_terrain_draw(recipe, &environment, &message), message.text);
  CHECK(environment.light_xy_m[0] == 4 && environment.light_xy_m[1] == 3);
  CHECK_INT(mo_environment_check(&environment, NULL), MO_OK);
  return environment;
}

static struct mo_environment draw_default(int family, uint64_t seed)
{
  struct mo_terrain_recipe recipe = mo_terrain_recipe_default((enum mo_terrain_family)family);
  recipe.seed = seed;
  return draw(&recipe);
}

static bool is_random(int family)
{
  return family == MO_TERRAIN_ROUGH || family >= MO_TERRAIN_HURDLES;
}

/* A new hash here is another terrain under the same name. */
static void frozen(void)
{
  static const uint64_t expected[FAMILIES] = {
      UINT64_C(0x71a9e91d599f576c), UINT64_C(0xf5f9bb3659bbd515), UINT64_C(0xbeb4637efb371698),
      UINT64_C(0xe7eb8df6f99f84b1), UINT64_C(0x67a872b806adf0bb), UINT64_C(0xc82246ee01c6e645),
      UINT64_C(0x972a24acfab8f6b2), UINT64_C(0xdee7a2e5e29cdc53),
  };
  for (int family = 0; family < FAMILIES; family++) {
    const struct mo_environment e = draw_default(family, 7);
    uint64_t h = FNV_START;
    hash(&h, e.terrain_heights_m, sizeof(e.terrain_heights_m));
    hash(&h, &e.n_profile, sizeof(e.n_profile));
    hash(&h, &e.profile_spacing_m, sizeof(e.profile_spacing_m));
    printf("# %s: %016llx\n", mo_terrain_family_words[family], (unsigned long long)h);
    CHECK(h == expected[family]);
  }
  CHECK(mo_terrain_family_words[FAMILIES] == NULL);
}

/* With the defaults, and with the steepest that is allowed. */
static void shapes(void)
{
  for (int family = MO_TERRAIN_SLOPE; family < FAMILIES; family++)
    for (int steep = 0; steep < 2; steep++)
      for (uint64_t seed = 0; seed < 100; seed++) {
        struct mo_terrain_recipe recipe = mo_terrain_recipe_default((enum mo_terrain_family)family);
        recipe.seed = seed;
        if (steep) {
          recipe.spacing_m = 0.08 + 0.01 * (double)seed;
          recipe.degrees = seed % 2 == 0 ? 45 : -45;
          recipe.rise_m = recipe.height_m = recipe.depth_m = recipe.spacing_m;
          recipe.run_m = recipe.gap_m = recipe.platform_m = 2 * recipe.spacing_m;
          recipe.every_m = 3 * recipe.spacing_m;
          if (recipe.spacing_m > 1)
            continue;
        }
        const struct mo_environment e = draw(&recipe);
        const double *h = e.terrain_heights_m,
                     begin_m = family == MO_TERRAIN_SLOPE ? MO_SLOPE_BEGINS_M : MO_FAMILY_BEGINS_M;
        double lowest = h[0], steepest = 0, level = h[0];
        int rises = 0;
        CHECK(e.n_profile == N && e.profile_spacing_m == recipe.spacing_m);
        for (int k = 0; k < N; k++) {
          lowest = fmin(lowest, h[k]);
          if (k > 0)
            steepest = fmax(steepest, fabs(h[k] - h[k - 1]) / recipe.spacing_m);
          rises += k > 0 && h[k] != h[k - 1];
          if ((k - 1) * recipe.spacing_m < begin_m - 1e-9)
            CHECK(h[k] == level); /* up to the first height at begin_m or beyond it */
        }
        CHECK(lowest == MO_TERRAIN_FLOOR_M);
        CHECK(steepest <= 1 + 1e-12 && steepest > 0);
        CHECK(rises >= 2);
        CHECK(mo_terrain_height(&e, 2.5, 0) == level);
        CHECK_NEAR(mo_terrain_height(&e, begin_m, 9), level, 1e-12);
      }
}

static void grids(void)
{
  struct mo_terrain_recipe recipe = mo_terrain_recipe_default(MO_TERRAIN_ROUGH);
  recipe.seed = 5;
  recipe.sigma_m = 0.07;
  double heights_m[N];
  mo_terrain_random(5, 0, 0, 0.07, heights_m);
  const struct mo_environment rough = draw(&recipe), flat = draw_default(MO_TERRAIN_FLAT, 3);
  CHECK(SAME(rough.terrain_heights_m, heights_m, N));
  CHECK(rough.n_profile == 0 && rough.profile_spacing_m == 0 && flat.n_profile == 0);
  for (int k = 0; k < N; k++)
    CHECK(flat.terrain_heights_m[k] == MO_TERRAIN_FLOOR_M);
}

/* The tangent is within a few ulp of the C library's; nothing depends on its bits. */
static void slopes(void)
{
  struct mo_terrain_recipe recipe = mo_terrain_recipe_default(MO_TERRAIN_SLOPE);
  double worst = 0;
  for (int i = -4500; i <= 4500; i++) {
    recipe.degrees = i / 100.0;
    const struct mo_environment e = draw(&recipe);
    const double expected = tan(recipe.degrees * M_PI / 180) * 3.5;
    const double climb = e.terrain_heights_m[N - 1] - e.terrain_heights_m[0];
    worst = fmax(worst, fabs(climb - expected));
    CHECK_NEAR(e.terrain_heights_m[45] - e.terrain_heights_m[0], expected * 17 / 35, 1e-14);
  }
  printf("# largest difference at the end of a slope: %.1e m\n", worst);
  CHECK(worst < 1e-14);
}

/* Heights above the level, in units of the rise. */
static void stairs(void)
{
  struct mo_terrain_recipe recipe = mo_terrain_recipe_default(MO_TERRAIN_STAIRS_UP);
  static const int expected[] = {0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3}; /* from x = 3 m on */
  recipe.rise_m = 0.0625;
  for (int down = 0; down < 2; down++) {
    recipe.family = down ? MO_TERRAIN_STAIRS_DOWN : MO_TERRAIN_STAIRS_UP;
    const struct mo_environment e = draw(&recipe);
    for (int k = 0; k < (int)COUNT(expected); k++)
      CHECK_NEAR(e.terrain_heights_m[30 + k] - e.terrain_heights_m[0],
                 (down ? -0.0625 : 0.0625) * expected[k], 1e-15);
  }
}

/* Distances and heights of random families, over many seeds: within their bounds, and on average
 * what was requested. */
static void random_families(void)
{
  double distance_sum = 0, height_sum = 0, platform_sum = 0, square = 0;
  int distances = 0, ridges = 0, platforms = 0, heights = 0;
  for (uint64_t seed = 0; seed < 400; seed++) {
    const struct mo_environment hurdles = draw_default(MO_TERRAIN_HURDLES, seed),
                                gaps = draw_default(MO_TERRAIN_GAPS, seed),
                                steps = draw_default(MO_TERRAIN_STEPS, seed);
    for (int k = 32, last = 0; k < N - 1; k++) {
      const double above = hurdles.terrain_heights_m[k] - MO_TERRAIN_FLOOR_M;
      if (above == 0)
        continue;
      CHECK(above >= 0.03 - 1e-15 && above <= 0.06);
      CHECK(hurdles.terrain_heights_m[k - 1] == MO_TERRAIN_FLOOR_M &&
            hurdles.terrain_heights_m[k + 1] == MO_TERRAIN_FLOOR_M);
      CHECK(last == 0 || (k - last >= 3 && k - last <= 7));
      distance_sum += last == 0 ? 0 : 0.1 * (k - last);
      distances += last != 0;
      height_sum += above;
      ridges++;
      last = k;
    }
    for (int k = 31, length = 0; k < N; k++) {
      const bool deep = gaps.terrain_heights_m[k] < 0.1;
      CHECK_NEAR(gaps.terrain_heights_m[k], deep ? 0.05 : 0.15, 1e-15);
      if (deep && length > 0 && k > 35) { /* one height at the bottom: from level to level 0.2 m */
        CHECK(length >= 4 && length <= 6);
        platform_sum += 0.1 * (length - 1);
        platforms++;
      }
      length = deep ? 0 : length + 1;
    }
    for (int k = 32; k < N; k += 3) {
      const double above = steps.terrain_heights_m[k] - steps.terrain_heights_m[0];
      CHECK(above >= -0.04 && above <= 0.04);
      for (int i = k; i < k + 3 && i < N; i++)
        CHECK(steps.terrain_heights_m[i] == steps.terrain_heights_m[k]);
      square += above * above;
      heights++;
    }
  }
  CHECK_NEAR(distance_sum / distances, 0.5, 0.02);
  CHECK_NEAR(height_sum / ridges, 0.045, 0.001);
  CHECK_NEAR(platform_sum / platforms, 0.4, 0.01);
  CHECK_NEAR(sqrt(square / heights), 0.08 / sqrt(12), 0.001);
}

static void seeds(void)
{
  for (int family = 0; family < FAMILIES; family++) {
    const struct mo_environment a = draw_default(family, 1), b = draw_default(family, 1),
                                c = draw_default(family, 2);
    CHECK(SAME(a.terrain_heights_m, b.terrain_heights_m, N));
    CHECK(SAME(a.terrain_heights_m, c.terrain_heights_m, N) != is_random(family));
  }
}

static void refusals(void)
{
  struct mo_terrain_recipe recipe;
  const struct {
    enum mo_terrain_family family;
    double *number, value;
    int code;
    const char *message;
  } bad[] = {
      {MO_TERRAIN_ROUGH, &recipe.sigma_m, -1, MO_ERR_RANGE,
       "sigma_m must be at least 0 and at most 10, got -1"},
      {MO_TERRAIN_ROUGH, &recipe.sigma_m, NAN, MO_ERR_INVALID, "sigma_m must be a finite number"},
      {MO_TERRAIN_SLOPE, &recipe.degrees, 45.5, MO_ERR_RANGE,
       "degrees must be at least -45 and at most 45, got 45.5"},
      {MO_TERRAIN_SLOPE, &recipe.degrees, INFINITY, MO_ERR_INVALID,
       "degrees must be a finite number"},
      {MO_TERRAIN_SLOPE, &recipe.spacing_m, 0, MO_ERR_RANGE,
       "spacing_m must be at least 0.08 and at most 1, got 0"},
      {MO_TERRAIN_STEPS, &recipe.spacing_m, NAN, MO_ERR_INVALID,
       "spacing_m must be a finite number"},
      {MO_TERRAIN_STAIRS_UP, &recipe.rise_m, 0.11, MO_ERR_RANGE,
       "rise_m must be above 0 and at most spacing_m (0.1), so that no ramp is steeper than 45 "
       "degrees, got 0.11"},
      {MO_TERRAIN_STAIRS_DOWN, &recipe.rise_m, 0, MO_ERR_RANGE,
       "rise_m must be above 0 and at most spacing_m (0.1), so that no ramp is steeper than 45 "
       "degrees, got 0"},
      {MO_TERRAIN_STAIRS_UP, &recipe.run_m, 0.25, MO_ERR_RANGE,
       "run_m must be a whole number of spacings (spacing_m is 0.1), at least 2 and at most 63 of "
       "them, got 0.25"},
      {MO_TERRAIN_STEPS, &recipe.run_m, 0.1, MO_ERR_RANGE,
       "run_m must be a whole number of spacings (spacing_m is 0.1), at least 2 and at most 63 of "
       "them, got 0.1"},
      {MO_TERRAIN_STEPS, &recipe.height_m, NAN, MO_ERR_INVALID, "height_m must be a finite number"},
      {MO_TERRAIN_HURDLES, &recipe.every_m, 0.2, MO_ERR_RANGE,
       "every_m must be a whole number of spacings (spacing_m is 0.1), at least 3 and at most 63 "
       "of them, got 0.2"},
      {MO_TERRAIN_HURDLES, &recipe.height_m, 0.2, MO_ERR_RANGE,
       "height_m must be above 0 and at most spacing_m (0.1), so that no ramp is steeper than 45 "
       "degrees, got 0.2"},
      {MO_TERRAIN_GAPS, &recipe.gap_m, 7, MO_ERR_RANGE,
       "gap_m must be a whole number of spacings (spacing_m is 0.1), at least 2 and at most 63 of "
       "them, got 7"},
      {MO_TERRAIN_GAPS, &recipe.depth_m, -0.1, MO_ERR_RANGE,
       "depth_m must be above 0 and at most spacing_m (0.1), so that no ramp is steeper than 45 "
       "degrees, got -0.1"},
      {MO_TERRAIN_GAPS, &recipe.platform_m, -INFINITY, MO_ERR_INVALID,
       "platform_m must be a finite number"},
      {(enum mo_terrain_family)FAMILIES, &recipe.spacing_m, 0.1, MO_ERR_INVALID,
       "unknown family of terrains 8"},
      {MO_TERRAIN_FLAT, &recipe.sigma_m, NAN, MO_OK, ""}, /* unused */
  };
  for (size_t i = 0; i < COUNT(bad); i++) {
    struct mo_environment environment = {.n_profile = 5, .terrain_heights_m = {3}};
    struct mo_message message = {""};
    recipe = mo_terrain_recipe_default(bad[i].family);
    *bad[i].number = bad[i].value;
    CHECK_INT(mo_terrain_draw(&recipe, &environment, &message), bad[i].code);
    CHECK_TEXT(message.text, bad[i].message);
    CHECK_INT(mo_terrain_draw(&recipe, &environment, NULL), bad[i].code);
    CHECK(bad[i].code == MO_OK ||
          (environment.n_profile == 5 && environment.terrain_heights_m[0] == 3));
  }
}

/* Sloping ground is the level one plus a plane; the lowest height is the usual one. */
static void sloping_ground(void)
{
  static const double degrees[] = {5, -12, 45, 0.1}, toward[] = {0, 0.7, 3.2, -6.1};
  for (int i = 0; i < 8; i++) {
    struct mo_terrain_recipe recipe =
        mo_terrain_recipe_default(i % 2 == 0 ? MO_TERRAIN_ROUGH : MO_TERRAIN_FLAT);
    recipe.seed = 4;
    const struct mo_environment level = draw(&recipe);
    recipe.degrees = degrees[i % 4];
    recipe.toward_rad = toward[i / 2];
    const struct mo_environment sloping = draw(&recipe);
    const double rise = tan(recipe.degrees * M_PI / 180), cell_m = 5.0 / 7;
    double lowest = INFINITY, worst = 0;
    for (int k = 0; k < N; k++) {
      const double plane_m =
          rise * cell_m * (cos(recipe.toward_rad) * (k % 8) + sin(recipe.toward_rad) * (k / 8));
      const double up_m = sloping.terrain_heights_m[k] - level.terrain_heights_m[k] - plane_m;
      const double first_m = sloping.terrain_heights_m[0] - level.terrain_heights_m[0];
      worst = fmax(worst, fabs(up_m - first_m));
      lowest = fmin(lowest, sloping.terrain_heights_m[k]);
    }
    CHECK(worst < 1e-13);
    CHECK(lowest == MO_TERRAIN_FLOOR_M && sloping.n_profile == 0);
  }
  struct mo_terrain_recipe recipe = mo_terrain_recipe_default(MO_TERRAIN_FLAT);
  struct mo_environment environment = {0};
  recipe.toward_rad = 1; /* without a slope, the direction has no effect */
  const struct mo_environment flat = draw(&recipe);
  for (int k = 0; k < N; k++)
    CHECK(flat.terrain_heights_m[k] == MO_TERRAIN_FLOOR_M);
  recipe.degrees = 46;
  CHECK(mo_terrain_draw(&recipe, &environment, NULL) == MO_ERR_RANGE);
  recipe.degrees = 1;
  recipe.toward_rad = 6.4;
  CHECK(mo_terrain_draw(&recipe, &environment, NULL) == MO_ERR_RANGE);
}

static const struct check_case cases[] = {
    {"frozen bits", frozen},
    {"level start, lowest height, steepest ramp", shapes},
    {"rough and flat are grids", grids},
    {"rough and flat ground on slopes", sloping_ground},
    {"slopes have their angle", slopes},
    {"stairs", stairs},
    {"random distances and heights", random_families},
    {"seeds", seeds},
    {"refusals", refusals},
};
CHECK_MAIN(cases)
