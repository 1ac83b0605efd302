/* bodies.h: the stream of all bodies as keys. */
#ifndef MORPHO_ATLAS_BODIES_H
#define MORPHO_ATLAS_BODIES_H

#include <morpho/atlas.h>

/* Like mo_atlas_bodies_next. */
int mo_atlas_bodies_next_key(struct mo_atlas_bodies *bodies, uint32_t *n_voxels, uint64_t *key);

#endif
