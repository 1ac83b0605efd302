/* families.c: terrains by the name of a family.
 *
 * Every number comes from Philox streams and exact algebra (no function of the C library that
 * rounds), so that the same recipe yields the same terrain, bit for bit, on every machine. Stream:
 * (seed, PROFILE, family, 0). */
#include <morpho/random.h>

#include <math.h>
#include <string.h>

#include "world/terrain.h"

#define SPACING_M          0.1
#define SPACING_MIN_M      0.08 /* at this spacing, 64 heights span 5 m */
#define N                  MO_TERRAIN_HEIGHTS
#define RADIANS_PER_DEGREE (M_PI / 180)

const char *const mo_terrain_family_words[] = {MO_TERRAIN_FAMILY_WORDS, NULL};

struct mo_terrain_recipe mo_terrain_recipe_default(enum mo_terrain_family family)
{
  struct mo_terrain_recipe recipe = {.family = family, .spacing_m = SPACING_M};
  switch (family) {
  case MO_TERRAIN_ROUGH: recipe.sigma_m = 0.05; break;
  case MO_TERRAIN_FLAT: break;
  case MO_TERRAIN_SLOPE: recipe.degrees = 8; break;
  case MO_TERRAIN_STAIRS_UP:
  case MO_TERRAIN_STAIRS_DOWN:
    recipe.rise_m = 0.05;
    recipe.run_m = 0.3;
    break;
  case MO_TERRAIN_HURDLES:
    recipe.height_m = 0.06;
    recipe.every_m = 0.5;
    break;
  case MO_TERRAIN_GAPS:
    recipe.depth_m = 0.1;
    recipe.gap_m = 0.2;
    recipe.platform_m = 0.4;
    break;
  case MO_TERRAIN_STEPS:
    recipe.height_m = 0.08;
    recipe.run_m = 0.3;
    break;
  }
  if (family == MO_TERRAIN_ROUGH || family == MO_TERRAIN_FLAT)
    recipe.spacing_m = 0;
  return recipe;
}

/* ---- checks ---- */

static int check_number(const char *name, double value, double min, double max,
                        struct mo_message *message)
{
  if (!isfinite(value))
    return mo_fail(message, MO_ERR_INVALID, "%s must be a finite number", name);
  if (value < min || value > max)
    return mo_fail(message, MO_ERR_RANGE, "%s must be at least %g and at most %g, got %g", name,
                   min, max, value);
  return MO_OK;
}

/* Checks a rise over one spacing. */
static int check_rise(const struct mo_terrain_recipe *recipe, const char *name, double value,
                      struct mo_message *message)
{
  if (!isfinite(value))
    return mo_fail(message, MO_ERR_INVALID, "%s must be a finite number", name);
  if (value <= 0 || value > recipe->spacing_m)
    return mo_fail(message, MO_ERR_RANGE,
                   "%s must be above 0 and at most spacing_m (%g), so that no ramp is steeper than "
                   "45 degrees, got %g",
                   name, recipe->spacing_m, value);
  return MO_OK;
}

/* Checks a length along x, and writes it to *spacings as a number of spacings. */
static int check_length(const struct mo_terrain_recipe *recipe, const char *name, double value,
                        int least, int *spacings, struct mo_message *message)
{
  if (!isfinite(value))
    return mo_fail(message, MO_ERR_INVALID, "%s must be a finite number", name);
  const double exact = value / recipe->spacing_m;
  if (exact < least - 1e-6 || exact > N - 1 || fabs(exact - floor(exact + 0.5)) > 1e-6)
    return mo_fail(message, MO_ERR_RANGE,
                   "%s must be a whole number of spacings (spacing_m is %g), at least %d and at "
                   "most %d of them, got %g",
                   name, recipe->spacing_m, least, N - 1, value);
  *spacings = (int)(exact + 0.5);
  return MO_OK;
}

/* ---- shapes: heights above the level where the robot starts ---- */

/* Returns the index of the first height at or beyond x_m, ignoring rounding. */
static int first_at(const struct mo_terrain_recipe *recipe, double x_m)
{
  return (int)ceil(x_m / recipe->spacing_m - 1e-9);
}

/* Computes the sine and cosine of x, |x| ≤ π/4, from their series. */
static void sine_cosine(double x, double *sine, double *cosine)
{
  const double s = x * x;
  double of_sine = 0, of_cosine = 0;
  for (int n = 20; n > 0; n -= 2) {
    of_sine = (1 + of_sine) * -s / ((n + 1) * n);
    of_cosine = (1 + of_cosine) * -s / (n * (n - 1));
  }
  *sine = x + x * of_sine;
  *cosine = 1 + of_cosine;
}

/* Returns tan x, |x| ≤ π/4, within 4 ulp. */
static double tangent(double x)
{
  double sine, cosine;
  sine_cosine(x, &sine, &cosine);
  return sine / cosine;
}

static int slope(const struct mo_terrain_recipe *recipe, double heights_m[N],
                 struct mo_message *message)
{
  const int error = check_number("degrees", recipe->degrees, -MO_TERRAIN_DEGREES_MAX,
                                 MO_TERRAIN_DEGREES_MAX, message);
  const int begin = first_at(recipe, MO_SLOPE_BEGINS_M);
  const double rise_m = recipe->spacing_m * tangent(recipe->degrees * RADIANS_PER_DEGREE);
  for (int k = begin + 1; k < N && error == MO_OK; k++)
    heights_m[k] = (k - begin) * rise_m;
  return error;
}

static int stairs(const struct mo_terrain_recipe *recipe, double heights_m[N],
                  struct mo_message *message)
{
  const double sign = recipe->family == MO_TERRAIN_STAIRS_UP ? 1 : -1;
  int run = 2, error = check_rise(recipe, "rise_m", recipe->rise_m, message);
  if (error == MO_OK)
    error = check_length(recipe, "run_m", recipe->run_m, 2, &run, message);
  const int begin = first_at(recipe, MO_FAMILY_BEGINS_M);
  for (int k = begin + 1; k < N && error == MO_OK; k++) {
    const int step = (k - begin + run - 1) / run;
    heights_m[k] = sign * recipe->rise_m * step;
  }
  return error;
}

static int hurdles(const struct mo_terrain_recipe *recipe, struct mo_random *random,
                   double heights_m[N], struct mo_message *message)
{
  int every = 0, error = check_rise(recipe, "height_m", recipe->height_m, message);
  if (error == MO_OK)
    error = check_length(recipe, "every_m", recipe->every_m, 3, &every, message);
  if (error != MO_OK)
    return error;
  /* Two hurdles are at least two spacings apart. */
  const int quarter = every / 4, most = (every - 2) / 2, shift = quarter < most ? quarter : most;
  for (int at = first_at(recipe, MO_FAMILY_BEGINS_M) + 1;; at += every) {
    const int top = at + (int)mo_random_below(random, 2 * (uint32_t)shift + 1);
    if (top > N - 2)
      return MO_OK;
    heights_m[top] = recipe->height_m * (0.5 + 0.5 * mo_random_uniform(random));
  }
}

static int gaps(const struct mo_terrain_recipe *recipe, struct mo_random *random,
                double heights_m[N], struct mo_message *message)
{
  int gap = 0, platform = 0, error = check_rise(recipe, "depth_m", recipe->depth_m, message);
  if (error == MO_OK)
    error = check_length(recipe, "gap_m", recipe->gap_m, 2, &gap, message);
  if (error == MO_OK)
    error = check_length(recipe, "platform_m", recipe->platform_m, 2, &platform, message);
  if (error != MO_OK)
    return error;
  int at = first_at(recipe, MO_FAMILY_BEGINS_M) + (int)mo_random_below(random, 3);
  while (at + gap < N) {
    for (int k = 1; k < gap; k++)
      heights_m[at + k] = -recipe->depth_m;
    at += gap + platform - 1 + (int)mo_random_below(random, 3);
  }
  return MO_OK;
}

static int steps(const struct mo_terrain_recipe *recipe, struct mo_random *random,
                 double heights_m[N], struct mo_message *message)
{
  int run = 2, error = check_rise(recipe, "height_m", recipe->height_m, message);
  if (error == MO_OK)
    error = check_length(recipe, "run_m", recipe->run_m, 2, &run, message);
  const int begin = first_at(recipe, MO_FAMILY_BEGINS_M) + 1;
  double height_m = 0;
  for (int k = begin; k < N && error == MO_OK; k++) {
    if ((k - begin) % run == 0)
      height_m = recipe->height_m * (mo_random_uniform(random) - 0.5);
    heights_m[k] = height_m;
  }
  return error;
}

/* ---- all families ---- */

static int draw_profile(const struct mo_terrain_recipe *recipe, double heights_m[N],
                        struct mo_message *message)
{
  const int error = check_number("spacing_m", recipe->spacing_m, SPACING_MIN_M,
                                 MO_PROFILE_SPACING_MAX_M, message);
  if (error != MO_OK)
    return error;
  struct mo_random random;
  mo_random_init(&random, recipe->seed, MO_PURPOSE_PROFILE, recipe->family, 0);
  switch (recipe->family) {
  case MO_TERRAIN_SLOPE: return slope(recipe, heights_m, message);
  case MO_TERRAIN_STAIRS_UP:
  case MO_TERRAIN_STAIRS_DOWN: return stairs(recipe, heights_m, message);
  case MO_TERRAIN_HURDLES: return hurdles(recipe, &random, heights_m, message);
  case MO_TERRAIN_GAPS: return gaps(recipe, &random, heights_m, message);
  case MO_TERRAIN_STEPS: return steps(recipe, &random, heights_m, message);
  default:
    return mo_fail(message, MO_ERR_INVALID, "unknown family of terrains %d", (int)recipe->family);
  }
}

/* Shifts the heights so that the lowest is MO_TERRAIN_FLOOR_M. */
static void lift(double heights_m[N])
{
  double lowest = heights_m[0];
  for (int k = 1; k < N; k++)
    if (heights_m[k] < lowest)
      lowest = heights_m[k];
  for (int k = 0; k < N; k++)
    heights_m[k] = (heights_m[k] - lowest) + MO_TERRAIN_FLOOR_M;
}

/* The direction is that of an eighth of the angle, doubled three times, because the series are for
 * small angles. */
void mo_terrain_tilt(double degrees, double toward_rad, double heights_m[N])
{
  const double rise = tangent(degrees * RADIANS_PER_DEGREE);
  const double spacing_m = MO_TERRAIN_SIZE_M / (MO_TERRAIN_SIDE - 1);
  double sine, cosine;
  sine_cosine(toward_rad / 8, &sine, &cosine);
  for (int i = 0; i < 3; i++) {
    const double twice = 2 * sine * cosine;
    cosine = cosine * cosine - sine * sine;
    sine = twice;
  }
  for (int k = 0; k < N; k++) {
    const int row = k / MO_TERRAIN_SIDE, column = k % MO_TERRAIN_SIDE;
    heights_m[k] += rise * (cosine * column + sine * row) * spacing_m;
  }
  lift(heights_m);
}

static int draw_grid(const struct mo_terrain_recipe *recipe, double heights_m[N],
                     struct mo_message *message)
{
  const bool is_flat = recipe->family == MO_TERRAIN_FLAT;
  int error = is_flat
                  ? MO_OK
                  : check_number("sigma_m", recipe->sigma_m, 0, MO_TERRAIN_SIGMA_MAX_M, message);
  if (error == MO_OK)
    error = check_number("degrees", recipe->degrees, -MO_TERRAIN_DEGREES_MAX,
                         MO_TERRAIN_DEGREES_MAX, message);
  if (error == MO_OK)
    error = check_number("toward_rad", recipe->toward_rad, -MO_TERRAIN_TOWARD_MAX_RAD,
                         MO_TERRAIN_TOWARD_MAX_RAD, message);
  if (error != MO_OK)
    return error;
  mo_terrain_random(recipe->seed, 0, 0, is_flat ? 0 : recipe->sigma_m, heights_m);
  if (recipe->degrees != 0)
    mo_terrain_tilt(recipe->degrees, recipe->toward_rad, heights_m);
  for (int k = 0; k < N; k++)
    if (heights_m[k] > MO_HEIGHT_LIMIT_M)
      return mo_fail(message, MO_ERR_RANGE, "a drawn height exceeds %g m; use another seed",
                     MO_HEIGHT_LIMIT_M);
  return MO_OK;
}

int mo_terrain_draw(const struct mo_terrain_recipe *recipe, struct mo_environment *environment,
                    struct mo_message *message)
{
  const bool is_grid = recipe->family == MO_TERRAIN_ROUGH || recipe->family == MO_TERRAIN_FLAT;
  double heights_m[N] = {0};
  const int error =
      is_grid ? draw_grid(recipe, heights_m, message) : draw_profile(recipe, heights_m, message);
  if (error != MO_OK)
    return error;
  if (!is_grid)
    lift(heights_m);
  memcpy(environment->terrain_heights_m, heights_m, sizeof(heights_m));
  environment->n_profile = is_grid ? 0 : N;
  environment->profile_spacing_m = is_grid ? 0 : recipe->spacing_m;
  return MO_OK;
}
