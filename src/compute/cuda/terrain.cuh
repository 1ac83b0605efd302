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

#define MO_TERRAIN_CELLS_PER_M ((MO_TERRAIN_SIDE - 1) / MO_TERRAIN_SIZE_M)

/* A coordinate within the map: the cell, and the fraction of the cell from its lower edge. */
struct terrain_place {
  int cell;
  double fraction;
  bool clamped;
};

MO_TERRAIN struct terrain_place terrain_place_of(double coordinate_m)
{
  struct terrain_place place = {0, 0.0, true};
  if (coordinate_m > MO_TERRAIN_SIZE_M) {
    place.cell = MO_TERRAIN_SIDE - 2;
    place.fraction = 1.0;
  } else if (coordinate_m >= 0.0) {
    const double cells = coordinate_m * MO_TERRAIN_CELLS_PER_M;
    place.cell = cells < MO_TERRAIN_SIDE - 1 ? (int)cells : MO_TERRAIN_SIDE - 2;
    place.fraction = cells - place.cell;
    place.clamped = false;
  }
  return place;
}

/* As mo_terrain_height. */
MO_TERRAIN double terrain_height(const double *heights_m, double x_m, double y_m)
{
  const struct terrain_place x = terrain_place_of(x_m), y = terrain_place_of(y_m);
  const double *corner = heights_m + y.cell * MO_TERRAIN_SIDE + x.cell;
  const double near = corner[0] + x.fraction * (corner[1] - corner[0]);
  const double far = corner[MO_TERRAIN_SIDE] +
                     x.fraction * (corner[MO_TERRAIN_SIDE + 1] - corner[MO_TERRAIN_SIDE]);
  return near + y.fraction * (far - near);
}

/* As mo_terrain_gradient. */
MO_TERRAIN void terrain_slope(const double *heights_m, double x_m, double y_m, double slope[2])
{
  const struct terrain_place x = terrain_place_of(x_m), y = terrain_place_of(y_m);
  const double *corner = heights_m + y.cell * MO_TERRAIN_SIDE + x.cell;
  const double near = corner[1] - corner[0],
               far = corner[MO_TERRAIN_SIDE + 1] - corner[MO_TERRAIN_SIDE];
  const double left = corner[MO_TERRAIN_SIDE] - corner[0],
               right = corner[MO_TERRAIN_SIDE + 1] - corner[1];
  slope[0] = x.clamped ? 0.0 : (near + y.fraction * (far - near)) * MO_TERRAIN_CELLS_PER_M;
  slope[1] = y.clamped ? 0.0 : (left + x.fraction * (right - left)) * MO_TERRAIN_CELLS_PER_M;
}

#endif
