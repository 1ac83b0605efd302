/* shape.h: what the files of this room share about shapes. */
#ifndef MORPHO_MORPHOSPACE_SHAPE_H
#define MORPHO_MORPHOSPACE_SHAPE_H

#include <morpho/morphospace.h>

/* Sets in `reached` (zeroed by the caller) the component of `bits` that holds voxel `start`, which
 * must be set. */
int mo_shape_component(struct mo_workspace workspace, const uint64_t *bits, uint32_t start,
                       uint64_t *reached);

#endif
