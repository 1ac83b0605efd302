/* variation.c: random bodies, mutation, crossover.
 *
 * The results of a seed depend on which numbers are taken from a stream, and in what order, so this
 * must never change.
 *   random body  one below(volumes), one below(boxes of that volume), one normal, then one
 *                32-bit number per voxel of the box in voxel order; all of it repeated while no
 *                voxel is active. A voxel is active if its number is below p · 2³²
 *   mutation     one 32-bit number per voxel of the workspace in voxel order; a voxel flips if
 *                its number is below rate · 2³² */
#include <morpho/morphospace.h>

#include "morphospace/bits.h"

#define ACTIVE_MEAN  0.35
#define ACTIVE_SIGMA 0.125
#define ACTIVE_LEAST 0.1
#define ACTIVE_MOST  0.6
#define CHUNK        256

/* Returns the number p · 2³², which a 32-bit random number is below with probability p. */
static uint64_t threshold(double p)
{
  return (uint64_t)(p * 0x1p32);
}

/* Makes a valid, placed genotype from the raw result of a draw. */
static int finish(struct mo_workspace workspace, uint64_t *made, uint64_t *bits)
{
  uint32_t words = mo_workspace_words(workspace);
  if (mo_bits_empty(made, words))
    return MO_ERR_EMPTY;
  int code = mo_genotype_keep_largest(workspace, made);
  if (code == MO_OK) {
    mo_genotype_place(workspace, made);
    memcpy(bits, made, words * sizeof(uint64_t));
  }
  return code;
}

/* ---- random bodies ---- */

struct box {
  uint32_t x, y, z;
};

/* Sets a bit for every volume that a box inside the workspace can have. `volumes` is a zeroed bit
 * array of voxels + 1 bits. */
static void find_volumes(struct mo_workspace workspace, uint64_t *volumes)
{
  if (mo_workspace_equal(workspace, MO_DEFAULT_WORKSPACE)) {
    /* Precomputed result of the loop below, which would take a fifth of the time of a draw. */
    volumes[0] = UINT64_C(0x104521114b15977e);
    volumes[1] = UINT64_C(0x0100101104010901);
    volumes[2] = UINT64_C(0x0000000000010000);
    return;
  }
  for (uint32_t x = 1; x <= workspace.nx; x++) {
    for (uint32_t y = 1; y <= workspace.ny; y++) {
      uint32_t area = x * y;
      for (uint32_t volume = area; volume <= area * workspace.nz; volume += area)
        mo_bits_set(volumes, volume);
    }
  }
}

/* Draws a volume that boxes inside the workspace can have, then one of the boxes of that volume, in
 * lexicographic order. */
static struct box draw_box(struct mo_workspace workspace, struct mo_random *random,
                           const uint64_t *volumes)
{
  uint32_t words = mo_workspace_voxels(workspace) / 64 + 1;
  uint32_t left = mo_random_below(random, mo_bits_count(volumes, words));
  uint32_t w = 0;
  uint32_t in_word;
  while ((in_word = mo_bits_count_word(volumes[w])) <= left) {
    left -= in_word;
    w++;
  }
  uint64_t rest = volumes[w];
  while (left-- > 0)
    rest &= rest - 1;
  uint32_t volume = w * 64 + (uint32_t)__builtin_ctzll(rest);

  uint32_t boxes = 0;
  for (uint32_t x = 1; x <= workspace.nx; x++)
    for (uint32_t y = 1; y <= workspace.ny; y++)
      boxes += volume % (x * y) == 0 && volume / (x * y) <= workspace.nz;
  left = mo_random_below(random, boxes);
  for (uint32_t x = 1; x <= workspace.nx; x++) {
    for (uint32_t y = 1; y <= workspace.ny; y++)
      if (volume % (x * y) == 0 && volume / (x * y) <= workspace.nz && left-- == 0)
        return (struct box){x, y, volume / (x * y)};
  }
  return (struct box){1, 1, 1}; /* not reached, because 1 ≤ boxes */
}

/* Activates each voxel of a box at the origin with the probability of `limit` (see threshold);
 * returns the number of active voxels. */
static uint32_t activate(struct mo_workspace workspace, struct box box, uint64_t limit,
                         struct mo_random *random, uint64_t *bits)
{
  uint32_t numbers[CHUNK];
  uint32_t left = box.x * box.y * box.z;
  uint32_t used = CHUNK;
  uint32_t active = 0;
  for (uint32_t x = 0; x < box.x; x++) {
    for (uint32_t y = 0; y < box.y; y++) {
      uint32_t v = (x * workspace.ny + y) * workspace.nz;
      for (uint32_t end = v + box.z; v < end; v++) {
        if (used == CHUNK) {
          mo_random_fill(random, numbers, left < CHUNK ? left : CHUNK);
          used = 0;
        }
        uint64_t on = numbers[used++] < limit;
        bits[v >> 6] |= on << (v & 63);
        active += (uint32_t)on;
        left--;
      }
    }
  }
  return active;
}

int mo_genotype_random(struct mo_workspace workspace, struct mo_random *random, uint64_t *bits)
{
  uint32_t words = mo_workspace_words(workspace);
  uint32_t volume_words = mo_workspace_voxels(workspace) / 64 + 1;
  struct mo_scratch body;
  if (mo_scratch_open(&body, words + volume_words) != MO_OK)
    return MO_ERR_NO_MEMORY;
  uint64_t *volumes = body.bits + words;
  uint32_t active = 0;
  find_volumes(workspace, volumes);
  while (active == 0) {
    struct box box = draw_box(workspace, random, volumes);
    double p = ACTIVE_MEAN + ACTIVE_SIGMA * mo_random_normal(random);
    p = p < ACTIVE_LEAST ? ACTIVE_LEAST : p > ACTIVE_MOST ? ACTIVE_MOST : p;
    active = activate(workspace, box, threshold(p), random, body.bits);
  }
  int code = finish(workspace, body.bits, bits);
  mo_scratch_close(&body);
  return code;
}

/* ---- children ---- */

/* Sets the bits of the numbers below the limit. `bits` has the zeroed words of n bits. */
static void mark_below(const uint32_t *numbers, uint32_t n, uint64_t limit, uint64_t *bits)
{
  uint8_t is_below[CHUNK] = {0};
  const uint32_t last = (uint32_t)(limit - 1);
  for (uint32_t i = 0; limit > 0 && i < n; i++)
    is_below[i] = numbers[i] <= last;
  for (uint32_t i = 0; i < n; i += 8) {
    uint64_t bytes;
    memcpy(&bytes, is_below + i, sizeof(bytes));
    /* The lowest bits of eight bytes become the bits of one byte. */
    bits[i >> 6] |= bytes * UINT64_C(0x0102040810204080) >> 56 << (i & 63);
  }
}

int mo_genotype_mutate(struct mo_workspace workspace, const uint64_t *parent, double rate,
                       struct mo_random *random, uint64_t *child)
{
  if (!(rate >= 0.0 && rate <= 1.0))
    return MO_ERR_RANGE;
  uint32_t voxels = mo_workspace_voxels(workspace);
  struct mo_scratch made;
  if (mo_scratch_open(&made, mo_workspace_words(workspace)) != MO_OK)
    return MO_ERR_NO_MEMORY;
  const uint64_t limit = threshold(rate);
  uint32_t numbers[CHUNK];
  for (uint32_t v = 0; v < voxels;) {
    uint32_t n = voxels - v < CHUNK ? voxels - v : CHUNK; /* CHUNK is a multiple of a word */
    mo_random_fill(random, numbers, n);
    mark_below(numbers, n, limit, made.bits + (v >> 6));
    v += n;
  }
  for (uint32_t w = 0; w < mo_workspace_words(workspace); w++)
    made.bits[w] ^= parent[w];
  int code = finish(workspace, made.bits, child);
  mo_scratch_close(&made);
  return code;
}

int mo_genotype_crossover(struct mo_workspace workspace, const uint64_t *a, const uint64_t *b,
                          uint64_t *child)
{
  struct mo_scratch made;
  if (mo_scratch_open(&made, mo_workspace_words(workspace)) != MO_OK)
    return MO_ERR_NO_MEMORY;
  for (uint32_t w = 0; w < mo_workspace_words(workspace); w++)
    made.bits[w] = a[w] ^ b[w];
  int code = finish(workspace, made.bits, child);
  mo_scratch_close(&made);
  return code;
}
