/* carve.h: divides one allocation into pieces whose addresses are multiples of MO_ALIGNMENT. */
#ifndef MORPHO_ROLLOUT_CARVE_H
#define MORPHO_ROLLOUT_CARVE_H

#include <stddef.h>

#define MO_ALIGNMENT ((size_t)64)

static inline size_t mo_aligned(size_t bytes)
{
  return (bytes + MO_ALIGNMENT - 1) / MO_ALIGNMENT * MO_ALIGNMENT;
}

/* If `base` is NULL, only the size is computed. */
struct carver {
  char *base;
  size_t used;
};

static inline void *carve(struct carver *carver, size_t n, size_t size)
{
  void *piece = carver->base != NULL ? carver->base + carver->used : NULL;
  carver->used += mo_aligned(n * size);
  return piece;
}

#endif
