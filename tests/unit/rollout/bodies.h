/* bodies.h: bodies and environments for the tests of this room. */
#ifndef MORPHO_TESTS_BODIES_H
#define MORPHO_TESTS_BODIES_H

#include <stdlib.h>

#include <morpho/rollout.h>

/* All voxels of a workspace; `lattice` is made too. NULL: no memory. */
static inline struct mo_body *full_body(struct mo_workspace workspace, struct mo_lattice **lattice)
{
  struct mo_body *body = NULL;
  const uint32_t n = mo_workspace_voxels(workspace);
  uint64_t *bits = calloc(mo_workspace_words(workspace), sizeof(uint64_t));
  if (bits != NULL && mo_lattice_create(workspace, lattice) == MO_OK) {
    for (uint32_t v = 0; v < n; v++)
      bits[v >> 6] |= UINT64_C(1) << (v & 63);
    if (mo_body_create(*lattice, bits, &body) < 0)
      body = NULL;
  }
  free(bits);
  return body;
}

static inline struct mo_environment flat_environment(double height_m, double light_x_m,
                                                     double light_y_m)
{
  struct mo_environment environment = {.light_xy_m = {light_x_m, light_y_m}};
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
    environment.terrain_heights_m[k] = height_m;
  return environment;
}

#endif
