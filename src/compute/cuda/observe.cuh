/* observe.cuh: the part of rollout/measuring.c that a device computes, by one lane, in float64 with
 * the same operations in the same order: the same poses give the same bits. A test without a device
 * compares them; this file is also valid C17. It must be compiled without contraction
 * (nvcc -fmad=false). */
#ifndef MORPHO_COMPUTE_CUDA_OBSERVE_CUH
#define MORPHO_COMPUTE_CUDA_OBSERVE_CUH

#include "compute/cuda/observe.h"
#include "compute/cuda/terrain.cuh"

#include <math.h>

MO_TERRAIN double observe_height(const struct mo_environment *environment, const double com_m[3])
{
  const struct terrain_map map = terrain_map_of(environment);
  return com_m[2] - terrain_height(&map, environment->terrain_heights_m, com_m[0], com_m[1]);
}

/* Like mo_observer_begin. */
MO_TERRAIN void observe_begin(struct mo_observed_row *row, const struct mo_environment *environment,
                              const double com_start_m[3])
{
  const struct mo_observed_row none = {{0, 0, 0}, {2, 0}, {0, 0, 0}, 0, 0, 0, 0, 0, 0,
                                       0,         0,      0,         0, 0, 0, 0, 0};
  *row = none;
  for (int axis = 0; axis < 3; axis++)
    row->com_m[axis] = com_start_m[axis];
  row->peak_height_m = observe_height(environment, com_start_m);
}

/* Like turns_between. */
MO_TERRAIN int observe_turns(const double from[2], const double to[2])
{
  const double cross = from[0] * to[1] - from[1] * to[0];
  if ((from[1] < 0) == (to[1] < 0))
    return 0;
  if (from[1] < 0)
    return cross < 0 ? -1 : 0;
  return cross > 0 ? 1 : 0;
}

/* Like mo_observe. */
MO_TERRAIN void observe_pose(struct mo_observed_row *row, const struct mo_environment *environment,
                             const double com_m[3], const double turn[2])
{
  const double dx = com_m[0] - row->com_m[0], dy = com_m[1] - row->com_m[1];
  const double height = observe_height(environment, com_m);
  row->path_m += sqrt(dx * dx + dy * dy);
  row->height_sum_m += height;
  if (height > row->peak_height_m)
    row->peak_height_m = height;
  row->turns += observe_turns(row->turn, turn);
  for (int axis = 0; axis < 3; axis++)
    row->com_m[axis] = com_m[axis];
  row->turn[0] = turn[0];
  row->turn[1] = turn[1];
}

#endif
