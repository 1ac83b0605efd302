/* image.h: the 8 images of a genotype, which tests compare. */
#ifndef MORPHO_TESTS_IMAGE_H
#define MORPHO_TESTS_IMAGE_H

#include "morphospace/grid.h"

/* Computes the k-th image (k = 0 … 7), aligned to the origin: x and y swapped if k & 4, then
 * mirrored in x if k & 1 and in y if k & 2. MO_ERR_RANGE: it does not fit the workspace. */
static inline int make_image(struct mo_workspace workspace, const uint64_t *bits, unsigned k,
                             uint64_t *image)
{
  struct mo_grid_view view;
  const int code = mo_grid_view_image(workspace, bits, k, &view);
  if (code == MO_OK)
    mo_grid_view_write(workspace, bits, &view, image);
  return code;
}

#endif
