/* shape.h: what the files of this room share about shapes. */
#ifndef MORPHO_MORPHOSPACE_SHAPE_H
#define MORPHO_MORPHOSPACE_SHAPE_H

#include <morpho/morphospace.h>

/* Sets in `reached` (zeroed by the caller) the component of `bits` that holds voxel `start`, which
 * must be set. */
int mo_shape_component(struct mo_workspace workspace, const uint64_t *bits, uint32_t start,
                       uint64_t *reached);
/* Sets the lattice's masses and springs that a genotype expresses, in zeroed bit arrays (body.c).
 */
void mo_body_mark(const struct mo_lattice *lattice, const uint64_t *bits, uint64_t *masses,
                  uint64_t *springs);

#endif
