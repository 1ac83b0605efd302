/* terrain.h: the cells of a terrain along each axis, for all shapes: a profile is a grid with one
 * row of cells, and its height does not change with y; and the words of families. */
#ifndef MORPHO_WORLD_TERRAIN_H
#define MORPHO_WORLD_TERRAIN_H

#include <morpho/world.h>

/* Names of the families, in their order. */
#define MO_TERRAIN_FAMILY_WORDS                                                                    \
  "rough", "flat", "slope", "stairs-up", "stairs-down", "hurdles", "gaps", "steps"

/* Adds a plane that rises toward toward_rad (from +x to +y; |toward_rad| ≤
 * MO_TERRAIN_TOWARD_MAX_RAD) to a grid, and shifts it so that the lowest height is
 * MO_TERRAIN_FLOOR_M. degrees: −45 … 45. */
void mo_terrain_tilt(double degrees, double toward_rad, double heights_m[MO_TERRAIN_HEIGHTS]);

struct mo_terrain_axis {
  double from_m;      /* coordinates count from here; 0, except for a custom grid */
  double size_m;      /* coordinates are clamped to 0 … size_m */
  double cells_per_m; /* 0: the height does not change along this axis */
  int cells;
};

struct mo_terrain_map {
  struct mo_terrain_axis axis[2];
  int row; /* offset from a height to the one in the next row: the number of columns, or 0 for a
              profile */
  const double *heights_m;
};

static inline struct mo_terrain_map mo_terrain_map_of(const struct mo_environment *environment)
{
  const double *heights_m = environment->terrain_heights_m;
  const struct mo_terrain_grid *grid = environment->grid;
  if (grid != NULL) {
    const int across = (int)grid->columns - 1, along = (int)grid->rows - 1;
    const double per_m = 1 / grid->spacing_m;
    return (struct mo_terrain_map){{{grid->from_m[0], across * grid->spacing_m, per_m, across},
                                    {grid->from_m[1], along * grid->spacing_m, per_m, along}},
                                   (int)grid->columns,
                                   grid->heights_m};
  }
  if (environment->n_profile == 0) {
    const struct mo_terrain_axis axis = {
        0, MO_TERRAIN_SIZE_M, (MO_TERRAIN_SIDE - 1) / MO_TERRAIN_SIZE_M, MO_TERRAIN_SIDE - 1};
    return (struct mo_terrain_map){{axis, axis}, MO_TERRAIN_SIDE, heights_m};
  }
  const int cells = (int)environment->n_profile - 1;
  const struct mo_terrain_axis along = {0, cells * environment->profile_spacing_m,
                                        1 / environment->profile_spacing_m, cells};
  return (struct mo_terrain_map){{along, {0, 0, 0, 1}}, 0, heights_m};
}

#endif
