/* slabs.h: operations on genotypes of small workspaces, many voxels at a time.
 *
 * A genotype is held as one 64-bit word per x, its slab: bit y·nz + z, the order of the genotype's
 * own bits. A step along z is a shift by 1, along y by nz, along x the next slab. For workspaces
 * with nx ≤ 64, ny·nz ≤ 64 and nz ≤ 63.
 *
 * Everything is inlined into shape.c, once with the default workspace as constants (the compiler
 * then unrolls it) and once with run-time sizes. */
#ifndef MORPHO_MORPHOSPACE_SLABS_H
#define MORPHO_MORPHOSPACE_SLABS_H

#include "morphospace/bits.h"
#include "morphospace/grid.h"

#define MO_SLABS_MAX    64
#define MO_SLABS_INLINE static inline __attribute__((always_inline))

struct mo_slab_shape {
  uint32_t nx, ny, nz;
  uint64_t bottom; /* the bits with z = 0 */
  uint64_t all;    /* the bits of a slab */
};

#define MO_SLAB_SHAPE_DEFAULT                                                                      \
  ((struct mo_slab_shape){6, 6, 4, UINT64_C(0x111111), UINT64_C(0xffffff)})

MO_SLABS_INLINE int mo_slabs_fit(struct mo_workspace w)
{
  const uint32_t length = (uint32_t)w.ny * w.nz;
  return w.nx >= 1 && w.nx <= MO_SLABS_MAX && length >= 1 && length <= 64 && w.nz < 64;
}

MO_SLABS_INLINE struct mo_slab_shape mo_slabs_shape(struct mo_workspace w)
{
  struct mo_slab_shape shape = {w.nx, w.ny, w.nz, 0, 0};
  for (uint32_t y = 0; y < w.ny; y++) {
    shape.bottom |= UINT64_C(1) << y * w.nz;
  }
  shape.all = UINT64_MAX >> (64 - (uint32_t)w.ny * w.nz);
  return shape;
}

MO_SLABS_INLINE void mo_slabs_load(struct mo_slab_shape s, const uint64_t *bits, uint64_t *slab)
{
  const uint32_t length = s.ny * s.nz;
  for (uint32_t x = 0; x < s.nx; x++) {
    uint32_t place = x * length;
    uint32_t part = place & 63;
    uint64_t word = bits[place >> 6] >> part;
    if (part + length > 64) {
      word |= bits[(place >> 6) + 1] << (64 - part);
    }
    slab[x] = word & s.all;
  }
}

MO_SLABS_INLINE void mo_slabs_store(struct mo_slab_shape s, const uint64_t *slab, uint64_t *bits)
{
  const uint32_t length = s.ny * s.nz;
  memset(bits, 0, (s.nx * length + 63) / 64 * sizeof(uint64_t));
  for (uint32_t x = 0; x < s.nx; x++) {
    uint32_t place = x * length;
    uint32_t part = place & 63;
    bits[place >> 6] |= slab[x] << part;
    if (part + length > 64) {
      bits[(place >> 6) + 1] |= slab[x] >> (64 - part);
    }
  }
}

/* Arrays below have MO_SLABS_MAX words, of which the first nx are used and written before they are
 * read. The analyzer cannot follow that through loops over a run-time nx, and zeroing 512 bytes
 * would double the cost of these operations. The address sanitizer, the fuzz target and the
 * comparison with grid.c check it instead. NOLINTBEGIN(clang-analyzer-core.*) */

/* ---- components ---- */

/* Returns the voxels of `body` within its slab that are connected to `seed` through faces. */
MO_SLABS_INLINE uint64_t mo_slabs_spread(struct mo_slab_shape s, uint64_t body, uint64_t seed)
{
  const uint64_t not_bottom = ~s.bottom;
  seed &= body;
  for (;;) {
    uint64_t up = (seed << 1) & not_bottom;
    uint64_t down = (seed & not_bottom) >> 1;
    uint64_t grown = (seed | up | down | seed << s.nz | seed >> s.nz) & body;
    if (grown == seed) {
      return seed;
    }
    seed = grown;
  }
}

/* Grows `part`, a non-empty part of `body`, to its whole component: sweeps up and down until
 * nothing changes. */
MO_SLABS_INLINE void mo_slabs_flood(struct mo_slab_shape s, const uint64_t *body, uint64_t *part)
{
  uint64_t changed;
  part[0] = mo_slabs_spread(s, body[0], part[0]);
  do {
    changed = 0;
    for (uint32_t x = 1; x < s.nx; x++) {
      uint64_t grown = mo_slabs_spread(s, body[x], part[x] | part[x - 1]);
      changed |= grown ^ part[x];
      part[x] = grown;
    }
    for (uint32_t x = s.nx - 1; x-- > 0;) {
      uint64_t grown = mo_slabs_spread(s, body[x], part[x] | part[x + 1]);
      changed |= grown ^ part[x];
      part[x] = grown;
    }
  } while (changed != 0);
}

MO_SLABS_INLINE uint32_t mo_slabs_count(struct mo_slab_shape s, const uint64_t *slab)
{
  uint32_t n = 0;
  for (uint32_t x = 0; x < s.nx; x++) {
    n += mo_bits_count_word(slab[x]);
  }
  return n;
}

/* Keeps the largest component of `body`; of equal ones the one with the lowest voxel. */
MO_SLABS_INLINE void mo_slabs_keep_largest(struct mo_slab_shape s, uint64_t *body)
{
  uint64_t best[MO_SLABS_MAX];
  uint64_t part[MO_SLABS_MAX];
  uint32_t best_n = 0;
  uint32_t left = mo_slabs_count(s, body);
  if (left == 0) {
    return;
  }
  uint32_t first = 0;
  while (left > best_n) {
    while (body[first] == 0) {
      first++;
    }
    for (uint32_t x = 0; x < s.nx; x++) {
      part[x] = 0;
    }
    part[first] = body[first] & (0 - body[first]);
    mo_slabs_flood(s, body, part);
    uint32_t n = mo_slabs_count(s, part);
    left -= n;
    for (uint32_t x = 0; x < s.nx; x++) {
      body[x] &= ~part[x];
      best[x] = n > best_n ? part[x] : best[x];
    }
    best_n = n > best_n ? n : best_n;
  }
  for (uint32_t x = 0; x < s.nx; x++) {
    body[x] = best[x];
  }
}

/* ---- extent and placement ---- */

struct mo_slab_extent {
  uint32_t low[3], high[3];
};

/* Bounding box of a genotype that is not empty. */
MO_SLABS_INLINE struct mo_slab_extent mo_slabs_extent(struct mo_slab_shape s, const uint64_t *slab)
{
  struct mo_slab_extent extent;
  uint64_t shadow = 0;
  uint32_t low = s.nx;
  uint32_t high = 0;
  for (uint32_t x = 0; x < s.nx; x++) {
    shadow |= slab[x];
    if (slab[x] != 0) {
      high = x;
      low = low == s.nx ? x : low;
    }
  }
  extent.low[0] = low;
  extent.high[0] = high;
  extent.low[1] = (uint32_t)__builtin_ctzll(shadow) / s.nz;
  extent.high[1] = (63 - (uint32_t)__builtin_clzll(shadow)) / s.nz;
  uint32_t z = 0;
  while ((shadow & s.bottom << z) == 0) {
    z++;
  }
  extent.low[2] = z;
  z = s.nz - 1;
  while ((shadow & s.bottom << z) == 0) {
    z--;
  }
  extent.high[2] = z;
  return extent;
}

/* Moves a genotype, of the extent `e`, by (dx, dy, −low z). */
MO_SLABS_INLINE void mo_slabs_move(struct mo_slab_shape s, struct mo_slab_extent e, int32_t dx,
                                   int32_t dy, uint64_t *slab)
{
  uint64_t moved[MO_SLABS_MAX] = {0};
  int32_t shift = dy * (int32_t)s.nz - (int32_t)e.low[2];
  for (uint32_t x = e.low[0]; x <= e.high[0]; x++) {
    moved[(int32_t)x + dx] = shift >= 0 ? slab[x] << shift : slab[x] >> -shift;
  }
  for (uint32_t x = 0; x < s.nx; x++) {
    slab[x] = moved[x];
  }
}

MO_SLABS_INLINE void mo_slabs_place(struct mo_slab_shape s, uint64_t *slab)
{
  uint64_t any = 0;
  uint64_t n = 0;
  uint64_t sum_x = 0;
  for (uint32_t x = 0; x < s.nx; x++) {
    uint64_t in_slab = mo_bits_count_word(slab[x]);
    any |= slab[x];
    n += in_slab;
    sum_x += x * in_slab;
  }
  if (any == 0) {
    return;
  }
  uint64_t sum_y = 0;
  const uint64_t column = UINT64_MAX >> (64 - s.nz);
  for (uint32_t x = 0; x < s.nx; x++) {
    for (uint32_t y = 1; y < s.ny; y++) {
      sum_y += y * (uint64_t)mo_bits_count_word(slab[x] >> y * s.nz & column);
    }
  }
  struct mo_slab_extent e = mo_slabs_extent(s, slab);
  int32_t dx = mo_place_shift(s.nx, e.low[0], e.high[0], n, sum_x);
  int32_t dy = mo_place_shift(s.ny, e.low[1], e.high[1], n, sum_y);
  mo_slabs_move(s, e, dx, dy, slab);
}

/* ---- images ---- */

/* A genotype aligned to the origin, and its sides in x and y. */
struct mo_slab_image {
  uint64_t slab[MO_SLABS_MAX];
  uint32_t dx, dy;
};

MO_SLABS_INLINE void mo_slabs_align(struct mo_slab_shape s, const uint64_t *slab,
                                    struct mo_slab_image *image)
{
  struct mo_slab_extent e = mo_slabs_extent(s, slab);
  uint32_t shift = e.low[1] * s.nz + e.low[2];
  image->dx = e.high[0] - e.low[0] + 1;
  image->dy = e.high[1] - e.low[1] + 1;
  for (uint32_t x = 0; x < s.nx; x++) {
    image->slab[x] = x < image->dx ? slab[e.low[0] + x] >> shift : 0;
  }
}

/* Mirrored in y. */
MO_SLABS_INLINE void mo_slabs_mirror(struct mo_slab_shape s, const struct mo_slab_image *from,
                                     struct mo_slab_image *to)
{
  const uint64_t column = UINT64_MAX >> (64 - s.nz);
  to->dx = from->dx;
  to->dy = from->dy;
  for (uint32_t x = 0; x < s.nx; x++) {
    uint64_t rest = from->slab[x];
    uint64_t mirrored = 0;
    for (uint32_t y = 0; y < from->dy; y++) {
      mirrored = mirrored << s.nz | (rest & column);
      rest >>= s.nz;
    }
    to->slab[x] = mirrored;
  }
}

/* x and y swapped; it fits only if dx ≤ ny and dy ≤ nx. */
MO_SLABS_INLINE void mo_slabs_swap(struct mo_slab_shape s, const struct mo_slab_image *from,
                                   struct mo_slab_image *to)
{
  const uint64_t column = UINT64_MAX >> (64 - s.nz);
  to->dx = from->dy;
  to->dy = from->dx;
  for (uint32_t y = 0; y < s.nx; y++) {
    uint64_t row = 0;
    if (y < from->dy) {
      for (uint32_t x = 0; x < from->dx; x++) {
        row |= (from->slab[x] >> y * s.nz & column) << x * s.nz;
      }
    }
    to->slab[y] = row;
  }
}

/* Puts `candidate` (with its slabs in reverse order if `reverse`) into `best` if it is smaller: at
 * the first difference in voxel order, the lowest differing bit, the smaller one has 0. */
MO_SLABS_INLINE void mo_slabs_take_smaller(struct mo_slab_shape s,
                                           const struct mo_slab_image *candidate, int reverse,
                                           uint64_t *best)
{
  const uint32_t last = candidate->dx - 1;
  for (uint32_t x = 0; x <= last; x++) {
    uint64_t mine = candidate->slab[reverse ? last - x : x];
    uint64_t difference = mine ^ best[x];
    if (difference != 0) {
      if ((mine & difference & (0 - difference)) == 0) {
        for (uint32_t i = 0; i < s.nx; i++) {
          best[i] = i > last ? 0 : candidate->slab[reverse ? last - i : i];
        }
      }
      return;
    }
  }
}

/* The canonical form of a genotype that is not empty. */
MO_SLABS_INLINE void mo_slabs_canonical(struct mo_slab_shape s, uint64_t *slab)
{
  struct mo_slab_image upright;
  struct mo_slab_image mirrored;
  struct mo_slab_image swapped;
  mo_slabs_align(s, slab, &upright);
  int swap_fits = upright.dx <= s.ny && upright.dy <= s.nx;
  int only_swapped = swap_fits && upright.dy < upright.dx;
  if (only_swapped) {
    mo_slabs_swap(s, &upright, &swapped);
    upright = swapped;
  }
  for (uint32_t x = 0; x < s.nx; x++) {
    slab[x] = upright.slab[x];
  }
  mo_slabs_mirror(s, &upright, &mirrored);
  mo_slabs_take_smaller(s, &upright, 1, slab);
  mo_slabs_take_smaller(s, &mirrored, 0, slab);
  mo_slabs_take_smaller(s, &mirrored, 1, slab);
  if (swap_fits && upright.dx == upright.dy) {
    mo_slabs_swap(s, &upright, &swapped);
    mo_slabs_mirror(s, &swapped, &mirrored);
    mo_slabs_take_smaller(s, &swapped, 0, slab);
    mo_slabs_take_smaller(s, &swapped, 1, slab);
    mo_slabs_take_smaller(s, &mirrored, 0, slab);
    mo_slabs_take_smaller(s, &mirrored, 1, slab);
  }
}

/* NOLINTEND(clang-analyzer-core.*) */

#endif
