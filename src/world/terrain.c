/* terrain.c: heights and gradients of the terrain.
 *
 * With the fractions u, v of a cell and its corner heights h00, h10 (x), h01 (y), h11:
 *   h = h00 + u (h10 − h00) + v (h01 − h00) + u v (h11 − h10 − h01 + h00).
 * In a profile, h01 = h00 and h11 = h10. */
#include "world/terrain.h"

#include <math.h>
#include <stddef.h>

/* A coordinate within the map: the cell, and the fraction of the cell from its lower edge. NaN
 * counts as 0. */
struct place {
  int cell;
  double fraction;
  int clamped;
};

static struct place find_place(const struct mo_terrain_axis *axis, double position_m)
{
  const double coordinate_m = position_m - axis->from_m;
  struct place place = {0, 0.0, 1};
  if (coordinate_m > axis->size_m) {
    place.cell = axis->cells - 1;
    place.fraction = 1.0;
  } else if (coordinate_m >= 0.0) {
    double cells = coordinate_m * axis->cells_per_m;
    place.cell = cells < axis->cells ? (int)cells : axis->cells - 1;
    place.fraction = cells - place.cell;
    place.clamped = 0;
  }
  return place;
}

double mo_terrain_height(const struct mo_environment *environment, double x_m, double y_m)
{
  const struct mo_terrain_map map = mo_terrain_map_of(environment);
  struct place x = find_place(&map.axis[0], x_m);
  struct place y = find_place(&map.axis[1], y_m);
  const double *corner = map.heights_m + y.cell * map.row + x.cell;
  double near = corner[0] + x.fraction * (corner[1] - corner[0]);
  double far = corner[map.row] + x.fraction * (corner[map.row + 1] - corner[map.row]);
  return near + y.fraction * (far - near);
}

void mo_terrain_gradient(const struct mo_environment *environment, double x_m, double y_m,
                         double gradient[2])
{
  const struct mo_terrain_map map = mo_terrain_map_of(environment);
  struct place x = find_place(&map.axis[0], x_m);
  struct place y = find_place(&map.axis[1], y_m);
  const double *corner = map.heights_m + y.cell * map.row + x.cell;
  double along_x_near = corner[1] - corner[0];
  double along_x_far = corner[map.row + 1] - corner[map.row];
  double along_y_left = corner[map.row] - corner[0];
  double along_y_right = corner[map.row + 1] - corner[1];
  gradient[0] = x.clamped ? 0.0
                          : (along_x_near + y.fraction * (along_x_far - along_x_near)) *
                                map.axis[0].cells_per_m;
  gradient[1] = y.clamped ? 0.0
                          : (along_y_left + x.fraction * (along_y_right - along_y_left)) *
                                map.axis[1].cells_per_m;
}

double mo_terrain_highest(const struct mo_environment *environment)
{
  const double *heights_m = environment->terrain_heights_m;
  if (environment->grid != NULL)
    return environment->grid->highest_m;
  const uint32_t n = environment->n_profile != 0 ? environment->n_profile : MO_TERRAIN_HEIGHTS;
  double highest = heights_m[0];
  for (uint32_t k = 1; k < n; k++)
    if (heights_m[k] > highest)
      highest = heights_m[k];
  return highest;
}
