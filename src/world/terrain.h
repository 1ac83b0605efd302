/* terrain.h: the cells of a terrain along each axis, which both shapes have: a profile is a grid of
 * one row of cells, whose height does not change with y; and the words of families. */
#ifndef MORPHO_WORLD_TERRAIN_H
#define MORPHO_WORLD_TERRAIN_H

#include <morpho/world.h>

/* Of the families, in their order. */
#define MO_TERRAIN_FAMILY_WORDS                                                                    \
  "rough", "flat", "slope", "stairs-up", "stairs-down", "hurdles", "gaps", "steps"

struct mo_terrain_axis {
  double size_m;      /* coordinates are clamped to 0 … size_m */
  double cells_per_m; /* 0: the height does not change along this axis */
  int cells;
};

struct mo_terrain_map {
  struct mo_terrain_axis axis[2];
  int row; /* from a height to that of the next row: MO_TERRAIN_SIDE, or 0 for a profile */
};

static inline struct mo_terrain_map mo_terrain_map_of(const struct mo_environment *environment)
{
  if (environment->n_profile == 0) {
    const struct mo_terrain_axis axis = {
        MO_TERRAIN_SIZE_M, (MO_TERRAIN_SIDE - 1) / MO_TERRAIN_SIZE_M, MO_TERRAIN_SIDE - 1};
    return (struct mo_terrain_map){{axis, axis}, MO_TERRAIN_SIDE};
  }
  const int cells = (int)environment->n_profile - 1;
  const struct mo_terrain_axis along = {cells * environment->profile_spacing_m,
                                        1 / environment->profile_spacing_m, cells};
  return (struct mo_terrain_map){{along, {0, 0, 1}}, 0};
}

#endif
