/* plain.h: bodies as lists of cells: a slow way to the same results. */
#ifndef MORPHO_TESTS_MORPHOSPACE_PLAIN_H
#define MORPHO_TESTS_MORPHOSPACE_PLAIN_H

#include "../make.h"

#include <stdbool.h>

enum { CELLS_MAX = 8448, WORDS_MAX = CELLS_MAX / 64 };

struct cells {
  int n, at[CELLS_MAX][3];
};

static inline bool has(const uint64_t *bits, uint32_t v)
{
  return bits[v / 64] >> v % 64 & 1;
}

static inline void unpack(struct mo_workspace w, const uint64_t *bits, struct cells *cells)
{
  cells->n = 0;
  for (uint32_t v = 0; v < mo_workspace_voxels(w); v++)
    if (has(bits, v)) {
      const int at[3] = {(int)(v / w.nz / w.ny), (int)(v / w.nz % w.ny), (int)(v % w.nz)};
      memcpy(cells->at[cells->n++], at, sizeof(at));
    }
}

/* Moves the cells by `shift`; returns false if one leaves the workspace. */
static inline bool pack(struct mo_workspace w, const struct cells *cells, const int shift[3],
                        uint64_t *bits)
{
  const int limit[3] = {w.nx, w.ny, w.nz};
  memset(bits, 0, mo_workspace_words(w) * sizeof(uint64_t));
  for (int i = 0; i < cells->n; i++) {
    int p[3];
    for (int axis = 0; axis < 3; axis++) {
      p[axis] = cells->at[i][axis] + shift[axis];
      if (p[axis] < 0 || p[axis] >= limit[axis])
        return false;
    }
    const uint32_t v = (uint32_t)((p[0] * w.ny + p[1]) * w.nz + p[2]);
    bits[v / 64] |= UINT64_C(1) << v % 64;
  }
  return true;
}

/* Computes image k (4: x and y swapped, then 1: x and 2: y mirrored) in a corner of workspace `to`,
 * and its sides; returns false if it does not fit. */
static inline bool image_by_cells(struct mo_workspace from, const uint64_t *bits, unsigned k,
                                  struct mo_workspace to, uint64_t *image, int side[3])
{
  static struct cells cells;
  int shift[3] = {0}, high[3] = {0};
  unpack(from, bits, &cells);
  for (int i = 0; i < cells.n; i++) {
    int *at = cells.at[i];
    const int x = k & 4 ? at[1] : at[0], y = k & 4 ? at[0] : at[1];
    at[0] = k & 1 ? -x : x;
    at[1] = k & 2 ? -y : y;
    for (int axis = 0; axis < 3; axis++) {
      shift[axis] = i == 0 || -at[axis] > shift[axis] ? -at[axis] : shift[axis];
      high[axis] = i == 0 || at[axis] > high[axis] ? at[axis] : high[axis];
    }
  }
  for (int axis = 0; axis < 3; axis++)
    side[axis] = cells.n > 0 ? high[axis] + shift[axis] + 1 : 0;
  return pack(to, &cells, shift, image);
}

/* Draws some of the voxels of a box. */
static inline void random_bits(struct mo_workspace w, struct mo_random *random, uint64_t *bits)
{
  memset(bits, 0, mo_workspace_words(w) * sizeof(uint64_t));
  const uint32_t box[3] = {1 + mo_random_below(random, w.nx), 1 + mo_random_below(random, w.ny),
                           1 + mo_random_below(random, w.nz)};
  const uint32_t percent = 10 + mo_random_below(random, 90);
  for (uint32_t v = 0; v < mo_workspace_voxels(w); v++)
    if (v / w.nz / w.ny < box[0] && v / w.nz % w.ny < box[1] && v % w.nz < box[2] &&
        mo_random_below(random, 100) < percent)
      bits[v / 64] |= UINT64_C(1) << v % 64;
}

static inline bool is_placed(struct mo_workspace w, const uint64_t *bits)
{
  uint64_t placed[WORDS_MAX];
  memcpy(placed, bits, mo_workspace_words(w) * sizeof(uint64_t));
  mo_genotype_place(w, placed);
  return SAME(placed, bits, mo_workspace_words(w));
}

#endif
