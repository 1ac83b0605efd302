/* bits.h: bit arrays of 64-bit words, and scratch arrays that stay on the stack while small. */
#ifndef MORPHO_MORPHOSPACE_BITS_H
#define MORPHO_MORPHOSPACE_BITS_H

#include <morpho/morphospace.h>

#include <stdlib.h>
#include <string.h>

static inline int mo_bits_get(const uint64_t *bits, uint32_t i)
{
  return (int)(bits[i >> 6] >> (i & 63) & 1);
}

static inline void mo_bits_set(uint64_t *bits, uint32_t i)
{
  bits[i >> 6] |= UINT64_C(1) << (i & 63);
}

/* Counts with arithmetic, because the baseline instruction set has no population count. */
static inline uint32_t mo_bits_count_word(uint64_t word)
{
  word -= word >> 1 & UINT64_C(0x5555555555555555);
  word = (word & UINT64_C(0x3333333333333333)) + (word >> 2 & UINT64_C(0x3333333333333333));
  word = (word + (word >> 4)) & UINT64_C(0x0f0f0f0f0f0f0f0f);
  return (uint32_t)(word * UINT64_C(0x0101010101010101) >> 56);
}

static inline uint32_t mo_bits_count(const uint64_t *bits, uint32_t words)
{
  uint32_t count = 0;
  for (uint32_t w = 0; w < words; w++)
    count += mo_bits_count_word(bits[w]);
  return count;
}

static inline int mo_bits_empty(const uint64_t *bits, uint32_t words)
{
  for (uint32_t w = 0; w < words; w++)
    if (bits[w] != 0)
      return 0;
  return 1;
}

#define MO_SCRATCH_WORDS (MO_SMALL_VOXELS / 64)

/* A zeroed bit array for the duration of one call. */
struct mo_scratch {
  uint64_t local[MO_SCRATCH_WORDS];
  uint64_t *bits;
};

static inline int mo_scratch_open(struct mo_scratch *scratch, uint32_t words)
{
  if (words <= MO_SCRATCH_WORDS) {
    memset(scratch->local, 0, words * sizeof(uint64_t));
    scratch->bits = scratch->local;
    return MO_OK;
  }
  scratch->bits = calloc(words, sizeof(uint64_t));
  return scratch->bits != NULL ? MO_OK : MO_ERR_NO_MEMORY;
}

static inline void mo_scratch_close(struct mo_scratch *scratch)
{
  if (scratch->bits != scratch->local)
    free(scratch->bits);
}

#endif
