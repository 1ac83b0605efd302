/* grid.h: operations on genotypes of any workspace, one voxel at a time. The word-parallel versions
 * in slabs.inc must agree with them; shape.c chooses. The header also declares functions about
 * shapes that the files of this room share. */
#ifndef MORPHO_MORPHOSPACE_GRID_H
#define MORPHO_MORPHOSPACE_GRID_H

#include <morpho/morphospace.h>

/* Sets in `reached` (zeroed by the caller) the component of `bits` that holds voxel `start`, which
 * must be set. */
int mo_shape_component(struct mo_workspace workspace, const uint64_t *bits, uint32_t start,
                       uint64_t *reached);
/* Writes image k (below) of a genotype that is not empty, aligned to the origin; `image` and `bits`
 * do not overlap. MO_ERR_RANGE: it does not fit. */
int mo_shape_image(struct mo_workspace workspace, const uint64_t *bits, unsigned k,
                   uint64_t *image);
/* Sets the lattice's masses and springs that a genotype expresses, in zeroed bit arrays (body.c).
 */
void mo_body_mark(const struct mo_lattice *lattice, const uint64_t *bits, uint64_t *masses,
                  uint64_t *springs);

/* Like mo_shape_component. */
int mo_grid_component(struct mo_workspace workspace, const uint64_t *bits, uint32_t start,
                      uint64_t *reached);
int mo_grid_keep_largest(struct mo_workspace workspace, uint64_t *bits);
/* Returns how far to move a body along one axis of `side` voxels. Its `n` voxels have coordinates
 * from `low` to `high`, with the sum `sum`. Among all shifts that keep it inside, chooses the one
 * with the centroid sum/n + shift nearest to (side − 1)/2; the lower of two equal ones. */
int32_t mo_place_shift(uint32_t side, uint32_t low, uint32_t high, uint64_t n, uint64_t sum);
void mo_grid_place(struct mo_workspace workspace, uint64_t *bits);
/* Like mo_genotype_move, without placing the result. */
int mo_grid_move(struct mo_workspace from, const uint64_t *bits, struct mo_workspace to,
                 uint64_t *moved);

/* A view of one of the 8 images of a genotype: voxel (x, y, z) of the image, aligned to the origin,
 * maps to a voxel of the genotype. Bits of k: 1 mirrors the image in x, 2 mirrors it in y, 4
 * (first) swaps x and y. */
struct mo_grid_view {
  unsigned k;
  uint32_t low[3];  /* lower corner of the genotype's bounding box */
  uint32_t side[3]; /* sides of the image; all 0 for an empty genotype */
};

/* MO_ERR_RANGE if the image does not fit the workspace. */
int mo_grid_view_image(struct mo_workspace workspace, const uint64_t *bits, unsigned k,
                       struct mo_grid_view *view);
/* Makes the view of the canonical form. */
void mo_grid_view_canonical(struct mo_workspace workspace, const uint64_t *bits,
                            struct mo_grid_view *view);
/* Writes the view as a genotype; `image` and `bits` do not overlap. */
void mo_grid_view_write(struct mo_workspace workspace, const uint64_t *bits,
                        const struct mo_grid_view *view, uint64_t *image);

#endif
