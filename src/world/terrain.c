/* terrain.c: heights and gradients of the bilinear map.
 *
 * With the fractions u, v of a cell and its corner heights h00, h10 (x), h01 (y), h11:
 *   h = h00 + u (h10 − h00) + v (h01 − h00) + u v (h11 − h10 − h01 + h00). */
#include <morpho/world.h>

#include <math.h>
#include <stddef.h>

#define CELLS       (MO_TERRAIN_SIDE - 1)
#define CELLS_PER_M (CELLS / MO_TERRAIN_SIZE_M)

/* A coordinate within the map: the cell, and the fraction of the cell from its lower edge. NaN
 * counts as 0. */
struct place {
  int cell;
  double fraction;
  int clamped;
};

static struct place find_place(double coordinate_m)
{
  struct place place = {0, 0.0, 1};
  if (coordinate_m > MO_TERRAIN_SIZE_M) {
    place.cell = CELLS - 1;
    place.fraction = 1.0;
  } else if (coordinate_m >= 0.0) {
    double cells = coordinate_m * CELLS_PER_M;
    place.cell = cells < CELLS ? (int)cells : CELLS - 1;
    place.fraction = cells - place.cell;
    place.clamped = 0;
  }
  return place;
}

double mo_terrain_height(const double heights_m[MO_TERRAIN_HEIGHTS], double x_m, double y_m)
{
  struct place x = find_place(x_m);
  struct place y = find_place(y_m);
  const double *corner = heights_m + y.cell * MO_TERRAIN_SIDE + x.cell;
  double near = corner[0] + x.fraction * (corner[1] - corner[0]);
  double far = corner[MO_TERRAIN_SIDE] +
               x.fraction * (corner[MO_TERRAIN_SIDE + 1] - corner[MO_TERRAIN_SIDE]);
  return near + y.fraction * (far - near);
}

void mo_terrain_gradient(const double heights_m[MO_TERRAIN_HEIGHTS], double x_m, double y_m,
                         double gradient[2])
{
  struct place x = find_place(x_m);
  struct place y = find_place(y_m);
  const double *corner = heights_m + y.cell * MO_TERRAIN_SIDE + x.cell;
  double along_x_near = corner[1] - corner[0];
  double along_x_far = corner[MO_TERRAIN_SIDE + 1] - corner[MO_TERRAIN_SIDE];
  double along_y_left = corner[MO_TERRAIN_SIDE] - corner[0];
  double along_y_right = corner[MO_TERRAIN_SIDE + 1] - corner[1];
  gradient[0] =
      x.clamped ? 0.0 : (along_x_near + y.fraction * (along_x_far - along_x_near)) * CELLS_PER_M;
  gradient[1] =
      y.clamped ? 0.0 : (along_y_left + x.fraction * (along_y_right - along_y_left)) * CELLS_PER_M;
}

double mo_terrain_highest(const double heights_m[MO_TERRAIN_HEIGHTS])
{
  double highest = heights_m[0];
  for (int k = 1; k < MO_TERRAIN_HEIGHTS; k++)
    if (heights_m[k] > highest)
      highest = heights_m[k];
  return highest;
}
