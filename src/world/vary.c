/* vary.c: applies variations to environments. */
#include <math.h>
#include <string.h>

#include "world/factors.h"
#include "world/terrain.h"

/* Largest distance between two heights of an 8 × 8 grid. */
#define DIAGONAL_M (M_SQRT2 * MO_TERRAIN_SIZE_M)

int mo_environment_vary(const struct mo_variation *by, struct mo_environment *environment)
{
  const double drop_m = environment->drop_m + by->drop_m;
  double heights_m[MO_TERRAIN_HEIGHTS];
  if (!(drop_m <= MO_DROP_MAX_M))
    return MO_ERR_RANGE;
  if (by->slope_degrees != 0) {
    if (environment->grid != NULL || environment->n_profile != 0)
      return MO_ERR_UNSUPPORTED;
    memcpy(heights_m, environment->terrain_heights_m, sizeof(heights_m));
    mo_terrain_tilt(by->slope_degrees, by->toward_rad, heights_m);
    for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
      if (!(heights_m[k] <= MO_HEIGHT_LIMIT_M))
        return MO_ERR_RANGE;
    memcpy(environment->terrain_heights_m, heights_m, sizeof(heights_m));
  }
  environment->drop_m = drop_m;
  environment->factors = mo_factors_times(&environment->factors, &by->factors);
  return MO_OK;
}

/* Returns an upper bound on the height of a grid after the steepest slope. */
static double highest_after(const struct mo_environment *environment, double degrees)
{
  double lowest = INFINITY, highest = -INFINITY;
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++) {
    lowest = fmin(lowest, environment->terrain_heights_m[k]);
    highest = fmax(highest, environment->terrain_heights_m[k]);
  }
  return highest - lowest + DIAGONAL_M * tan(degrees * M_PI / 180) + 2 * MO_TERRAIN_FLOOR_M;
}

int mo_environment_check_vary(const struct mo_environment *environment,
                              const struct mo_factor_ranges *ranges, struct mo_message *message)
{
  const double degrees = ranges->given ? ranges->slope_degrees[1] : 0;
  const double drop_m = environment->drop_m + (ranges->given ? ranges->drop_m[1] : 0);
  if (degrees > 0 && (environment->grid != NULL || environment->n_profile != 0))
    return mo_fail(message, MO_ERR_UNSUPPORTED,
                   "slope_degrees needs ground of 8 × 8 heights (terrain_heights_m, "
                   "terrain_sigma_m, or a terrain of the family rough or flat); a %s cannot slope",
                   environment->grid != NULL ? "custom grid" : "profile");
  if (degrees > 0 && highest_after(environment, degrees) > MO_HEIGHT_LIMIT_M)
    return mo_fail(message, MO_ERR_RANGE,
                   "with slope_degrees of %g, heights could exceed %g m; use flatter ground",
                   degrees, MO_HEIGHT_LIMIT_M);
  if (drop_m > MO_DROP_MAX_M)
    return mo_fail(message, MO_ERR_RANGE,
                   "the sum of drop_m (%g) and the largest drawn drop must be at most %g m, "
                   "got %.9g",
                   environment->drop_m, MO_DROP_MAX_M, drop_m);
  return MO_OK;
}
