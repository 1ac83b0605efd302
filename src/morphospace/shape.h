/* shape.h: what the files of this room share about shapes. */
#ifndef MORPHO_MORPHOSPACE_SHAPE_H
#define MORPHO_MORPHOSPACE_SHAPE_H

#include <morpho/morphospace.h>

/* Sets in `reached` (zeroed by the caller) the component of `bits` that holds voxel `start`, which
 * must be set. */
int mo_shape_component(struct mo_workspace workspace, const uint64_t *bits, uint32_t start,
                       uint64_t *reached);

/* How far to move a body along one axis of `side` voxels: `n` voxels whose coordinates, `low` to
 * `high`, sum up to `sum`. Of all shifts that stay inside, the one whose centroid sum/n + shift is
 * nearest to (side − 1)/2; the lower of two equal ones. */
int32_t mo_place_shift(uint32_t side, uint32_t low, uint32_t high, uint64_t n, uint64_t sum);

#endif
