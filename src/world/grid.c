/* grid.c: terrain grids of any size: their memory, which environments share. */
#include <morpho/world.h>

#include <math.h>
#include <stdlib.h>

static int check(uint32_t columns, uint32_t rows, double spacing_m, const double *heights_m)
{
  if (columns < MO_GRID_SIDE_MIN || columns > MO_GRID_SIDE_MAX || rows < MO_GRID_SIDE_MIN ||
      rows > MO_GRID_SIDE_MAX)
    return MO_ERR_RANGE;
  if (!(spacing_m >= MO_GRID_SPACING_MIN_M && spacing_m <= MO_GRID_SPACING_MAX_M))
    return isfinite(spacing_m) ? MO_ERR_RANGE : MO_ERR_INVALID;
  for (size_t k = 0; k < (size_t)columns * rows; k++)
    if (!(fabs(heights_m[k]) <= MO_HEIGHT_LIMIT_M))
      return isfinite(heights_m[k]) ? MO_ERR_RANGE : MO_ERR_INVALID;
  return MO_OK;
}

int mo_terrain_grid_create(uint32_t columns, uint32_t rows, double spacing_m,
                           const double *heights_m, const struct mo_terrain_grid **grid)
{
  const int error = check(columns, rows, spacing_m, heights_m);
  if (error != MO_OK)
    return error;
  const size_t n = (size_t)columns * rows;
  struct mo_terrain_grid *made = malloc(sizeof(*made) + n * sizeof(double));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  *made = (struct mo_terrain_grid){
      .columns = columns,
      .rows = rows,
      .spacing_m = spacing_m,
      .from_m = {MO_WORLD_CENTER_M - (columns - 1) * spacing_m / 2,
                 MO_WORLD_CENTER_M - (rows - 1) * spacing_m / 2},
      .highest_m = heights_m[0],
      .holders = 1,
  };
  for (size_t k = 0; k < n; k++) {
    made->heights_m[k] = heights_m[k] + 0.0; /* −0 becomes 0 */
    if (heights_m[k] > made->highest_m)
      made->highest_m = made->heights_m[k];
  }
  *grid = made;
  return MO_OK;
}

/* Returns the grid without const, because the count of holders changes. */
static struct mo_terrain_grid *own_of(const struct mo_terrain_grid *grid)
{
  const union {
    const struct mo_terrain_grid *shared;
    struct mo_terrain_grid *own;
  } pointer = {grid};
  return pointer.own;
}

void mo_terrain_grid_hold(const struct mo_terrain_grid *grid)
{
  if (grid != NULL)
    __atomic_add_fetch(&own_of(grid)->holders, 1, __ATOMIC_RELAXED);
}

void mo_terrain_grid_drop(const struct mo_terrain_grid *grid)
{
  if (grid != NULL && __atomic_sub_fetch(&own_of(grid)->holders, 1, __ATOMIC_ACQ_REL) == 0)
    free(own_of(grid));
}

void mo_environments_hold(const struct mo_environment *environments, size_t n)
{
  for (size_t i = 0; i < n; i++)
    mo_terrain_grid_hold(environments[i].grid);
}

void mo_environments_drop(struct mo_environment *environments, size_t n)
{
  for (size_t i = 0; i < n; i++) {
    mo_terrain_grid_drop(environments[i].grid);
    environments[i].grid = NULL;
  }
}

void mo_environments_free(struct mo_environment *environments, size_t n)
{
  if (environments != NULL)
    mo_environments_drop(environments, n);
  free(environments);
}
