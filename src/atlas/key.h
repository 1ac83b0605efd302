/* key.h: a body as one number.
 *
 * The key of a body of n voxels is the place of its canonical form among all sets of n voxels of
 * the workspace, in the order of their sorted lists of voxel indices. It takes 50 bits for ten
 * voxels of 144; the bits of the form take 144, a list of voxel indices 80. Among bodies of one
 * size, a smaller key is a larger id: the first voxel is the top bit of an id. */
#ifndef MORPHO_ATLAS_KEY_H
#define MORPHO_ATLAS_KEY_H

#include <morpho/atlas.h>

/* of[v][n]: the number of sets of n voxels among v (Pascal's triangle). 17 KB in every stream and
 * every open atlas: with quotients of factorials instead, computing a key would take longer than
 * looking it up. */
struct mo_atlas_sets {
  uint32_t voxels; /* of the workspace */
  uint64_t of[MO_ATLAS_WORKSPACE_MAX + 1][MO_ATLAS_VOXELS_MAX + 1];
};
void mo_atlas_sets_fill(struct mo_workspace workspace, struct mo_atlas_sets *sets);

/* voxels: (n) ascending indices, at least one. */
uint64_t mo_atlas_key_of(const struct mo_atlas_sets *sets, const uint32_t *voxels, uint32_t n);
/* key: below sets->of[sets->voxels][n]. */
void mo_atlas_key_voxels(const struct mo_atlas_sets *sets, uint64_t key, uint32_t n,
                         uint32_t *voxels);

/* Returns the number of voxels of a genotype, and the first MO_ATLAS_VOXELS_MAX indices. */
uint32_t mo_atlas_voxels_of(struct mo_workspace workspace, const uint64_t *bits,
                            uint32_t voxels[MO_ATLAS_VOXELS_MAX]);
/* Writes the genotype with these voxels. */
void mo_atlas_bits_of(struct mo_workspace workspace, const uint32_t *voxels, uint32_t n,
                      uint64_t *bits);

/* Sorts by the low `bytes` bytes, ascending; items with equal low bytes keep their order. scratch:
 * (n). */
void mo_atlas_sort(uint64_t *items, uint64_t *scratch, size_t n, unsigned bytes);

#endif
