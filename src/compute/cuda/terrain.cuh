/* terrain.cuh: world/terrain.c for a device, in float64: heights and slopes of the map, where
 * bodies and lights are placed. lane.cuh has the float32 terrain of contact. Also valid C17. */
#ifndef MORPHO_COMPUTE_CUDA_TERRAIN_CUH
#define MORPHO_COMPUTE_CUDA_TERRAIN_CUH

#include <morpho/world.h>

#include <stdbool.h>

#ifdef __CUDACC__
#define MO_TERRAIN static __host__ __device__ __forceinline__
#else
#define MO_TERRAIN static inline __attribute__((unused))
#endif

/* A terrain along an axis, as in world/terrain.h. */
struct terrain_axis {
  double size_m, cells_per_m;
  int cells;
};

/* What the cells of an environment's terrain are; row: from a height to that of the next row. */
struct terrain_map {
  struct terrain_axis axis[2];
  int row;
};

MO_TERRAIN struct terrain_map terrain_map_of_grid(void)
{
  const double per_m = (MO_TERRAIN_SIDE - 1) / MO_TERRAIN_SIZE_M;
  const struct terrain_map map = {{{MO_TERRAIN_SIZE_M, per_m, MO_TERRAIN_SIDE - 1},
                                   {MO_TERRAIN_SIZE_M, per_m, MO_TERRAIN_SIDE - 1}},
                                  MO_TERRAIN_SIDE};
  return map;
}

/* Like mo_terrain_map_of. */
MO_TERRAIN struct terrain_map terrain_map_of(const struct mo_environment *environment)
{
  struct terrain_map map = terrain_map_of_grid();
  if (environment->n_profile == 0)
    return map;
  map.axis[0].cells = (int)environment->n_profile - 1;
  map.axis[0].size_m = map.axis[0].cells * environment->profile_spacing_m;
  map.axis[0].cells_per_m = 1 / environment->profile_spacing_m;
  map.axis[1].size_m = map.axis[1].cells_per_m = 0;
  map.axis[1].cells = 1;
  map.row = 0;
  return map;
}

/* A coordinate within the map: the cell, and the fraction of the cell from its lower edge. */
struct terrain_place {
  int cell;
  double fraction;
  bool clamped;
};

MO_TERRAIN struct terrain_place terrain_place_of(const struct terrain_axis *axis,
                                                 double coordinate_m)
{
  struct terrain_place place = {0, 0.0, true};
  if (coordinate_m > axis->size_m) {
    place.cell = axis->cells - 1;
    place.fraction = 1.0;
  } else if (coordinate_m >= 0.0) {
    const double cells = coordinate_m * axis->cells_per_m;
    place.cell = cells < axis->cells ? (int)cells : axis->cells - 1;
    place.fraction = cells - place.cell;
    place.clamped = false;
  }
  return place;
}

/* Like mo_terrain_height. */
MO_TERRAIN double terrain_height(const struct terrain_map *map, const double *heights_m, double x_m,
                                 double y_m)
{
  const struct terrain_place x = terrain_place_of(&map->axis[0], x_m),
                             y = terrain_place_of(&map->axis[1], y_m);
  const double *corner = heights_m + y.cell * map->row + x.cell;
  const double near = corner[0] + x.fraction * (corner[1] - corner[0]);
  const double far = corner[map->row] + x.fraction * (corner[map->row + 1] - corner[map->row]);
  return near + y.fraction * (far - near);
}

/* Like mo_terrain_gradient. */
MO_TERRAIN void terrain_slope(const struct terrain_map *map, const double *heights_m, double x_m,
                              double y_m, double slope[2])
{
  const struct terrain_place x = terrain_place_of(&map->axis[0], x_m),
                             y = terrain_place_of(&map->axis[1], y_m);
  const double *corner = heights_m + y.cell * map->row + x.cell;
  const double near = corner[1] - corner[0], far = corner[map->row + 1] - corner[map->row];
  const double left = corner[map->row] - corner[0], right = corner[map->row + 1] - corner[1];
  slope[0] = x.clamped ? 0.0 : (near + y.fraction * (far - near)) * map->axis[0].cells_per_m;
  slope[1] = y.clamped ? 0.0 : (left + x.fraction * (right - left)) * map->axis[1].cells_per_m;
}

#endif
