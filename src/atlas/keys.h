/* keys.h: the keys of all bodies of one size. */
#ifndef MORPHO_ATLAS_KEYS_H
#define MORPHO_ATLAS_KEYS_H

#include "atlas/key.h"

/* Finds the bodies of n voxels and returns their keys, ascending (malloc; NULL if there are none).
 * MO_ERR_NO_MEMORY. */
int mo_atlas_keys_find(struct mo_workspace workspace, const struct mo_atlas_sets *sets, uint32_t n,
                       uint64_t **keys, uint64_t *n_keys);

#endif
