/* random.c: Philox4x32-10 and the random streams based on it.
 *
 * One block is ten rounds of two 32 × 32 → 64 bit products on four counter words; see Salmon et
 * al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011. Blocks are independent, so
 * mo_random_fill computes several at once. */
#include <morpho/random.h>

#include "base/normal.h"

#include <emmintrin.h>

#define MULTIPLIER_0 UINT32_C(0xD2511F53)
#define MULTIPLIER_1 UINT32_C(0xCD9E8D57)
#define WEYL_0       UINT32_C(0x9E3779B9)
#define WEYL_1       UINT32_C(0xBB67AE85)
#define ROUNDS       10
#define LANES        8

void mo_philox4x32_10(const uint32_t counter[4], const uint32_t key[2], uint32_t out[4])
{
  uint32_t c0 = counter[0];
  uint32_t c1 = counter[1];
  uint32_t c2 = counter[2];
  uint32_t c3 = counter[3];
  uint32_t k0 = key[0];
  uint32_t k1 = key[1];
  for (int round = 0; round < ROUNDS; round++) {
    uint64_t p0 = (uint64_t)MULTIPLIER_0 * c0;
    uint64_t p1 = (uint64_t)MULTIPLIER_1 * c2;
    c0 = (uint32_t)(p1 >> 32) ^ c1 ^ k0;
    c1 = (uint32_t)p1;
    c2 = (uint32_t)(p0 >> 32) ^ c3 ^ k1;
    c3 = (uint32_t)p0;
    k0 += WEYL_0;
    k1 += WEYL_1;
  }
  out[0] = c0;
  out[1] = c1;
  out[2] = c2;
  out[3] = c3;
}

/* Computes LANES blocks with consecutive first counter words, and writes them one after another.
 * Each vector has two lanes, in the low halves of its 64-bit words. The product instruction reads
 * only low halves, so the high halves may have any value. */
static void philox_lanes(const uint32_t counter[4], const uint32_t key[2], uint32_t out[LANES * 4])
{
  const __m128i multiplier_0 = _mm_set1_epi64x(MULTIPLIER_0);
  const __m128i multiplier_1 = _mm_set1_epi64x(MULTIPLIER_1);
  __m128i c0[LANES / 2];
  __m128i c1[LANES / 2];
  __m128i c2[LANES / 2];
  __m128i c3[LANES / 2];
  for (int i = 0; i < LANES / 2; i++) {
    c0[i] = _mm_set_epi64x((uint32_t)(counter[0] + 2 * (uint32_t)i + 1),
                           (uint32_t)(counter[0] + 2 * (uint32_t)i));
    c1[i] = _mm_set1_epi64x(counter[1]);
    c2[i] = _mm_set1_epi64x(counter[2]);
    c3[i] = _mm_set1_epi64x(counter[3]);
  }
  uint32_t k0 = key[0];
  uint32_t k1 = key[1];
  for (int round = 0; round < ROUNDS; round++) {
    const __m128i key_0 = _mm_set1_epi64x(k0);
    const __m128i key_1 = _mm_set1_epi64x(k1);
    for (int i = 0; i < LANES / 2; i++) {
      __m128i p0 = _mm_mul_epu32(c0[i], multiplier_0);
      __m128i p1 = _mm_mul_epu32(c2[i], multiplier_1);
      c0[i] = _mm_xor_si128(_mm_xor_si128(_mm_srli_epi64(p1, 32), c1[i]), key_0);
      c1[i] = p1;
      c2[i] = _mm_xor_si128(_mm_xor_si128(_mm_srli_epi64(p0, 32), c3[i]), key_1);
      c3[i] = p0;
    }
    k0 += WEYL_0;
    k1 += WEYL_1;
  }
  for (int i = 0; i < LANES / 2; i++) {
    /* Merge words 0 and 1 of a lane into one 64-bit word, words 2 and 3 into another, then store by
     * lane. */
    const __m128i low = _mm_set1_epi64x(UINT32_MAX);
    __m128i first = _mm_or_si128(_mm_and_si128(c0[i], low), _mm_slli_epi64(c1[i], 32));
    __m128i second = _mm_or_si128(_mm_and_si128(c2[i], low), _mm_slli_epi64(c3[i], 32));
    _mm_storeu_si128((__m128i *)(void *)(out + 8 * i), _mm_unpacklo_epi64(first, second));
    _mm_storeu_si128((__m128i *)(void *)(out + 8 * i + 4), _mm_unpackhi_epi64(first, second));
  }
}

void mo_random_init(struct mo_random *random, uint64_t seed, enum mo_purpose purpose, uint32_t step,
                    uint64_t index)
{
  random->key[0] = (uint32_t)seed;
  random->key[1] = (uint32_t)(seed >> 32);
  random->counter[0] = 0;
  random->counter[1] = (uint32_t)index;
  random->counter[2] = step;
  random->counter[3] = (uint32_t)purpose << 16 | ((uint32_t)(index >> 32) & 0xffff);
  random->used = 4;
}

/* Invariant: `counter` belongs to the block after the one in `block`. */
uint32_t mo_random_u32(struct mo_random *random)
{
  if (random->used >= 4) {
    mo_philox4x32_10(random->counter, random->key, random->block);
    random->counter[0]++;
    random->used = 0;
  }
  return random->block[random->used++];
}

void mo_random_fill(struct mo_random *random, uint32_t *numbers, size_t n)
{
  size_t i = 0;
  while (i < n && random->used < 4) {
    numbers[i++] = random->block[random->used++];
  }
  for (; n - i >= (size_t)LANES * 4; i += (size_t)LANES * 4) {
    philox_lanes(random->counter, random->key, numbers + i);
    random->counter[0] += LANES;
  }
  if (n - i > 4) { /* the remaining numbers, at the cost of one group */
    uint32_t group[LANES * 4];
    philox_lanes(random->counter, random->key, group);
    uint32_t whole = (uint32_t)((n - i) / 4);
    for (uint32_t k = 0; k < whole * 4; k++) {
      numbers[i++] = group[k];
    }
    random->counter[0] += whole;
  }
  while (i < n) {
    numbers[i++] = mo_random_u32(random);
  }
}

uint64_t mo_random_u64(struct mo_random *random)
{
  uint64_t low = mo_random_u32(random);
  return low | (uint64_t)mo_random_u32(random) << 32;
}

double mo_random_uniform(struct mo_random *random)
{
  return (double)(mo_random_u64(random) >> 11) * 0x1p-53;
}

/* Multiplies and shifts (Lemire 2019): the low half of the product determines whether the number
 * must be rejected to keep all results equally likely. */
uint32_t mo_random_below(struct mo_random *random, uint32_t n)
{
  if (n == 0) {
    return 0;
  }
  uint64_t product = (uint64_t)mo_random_u32(random) * n;
  if ((uint32_t)product < n) {
    uint32_t excess = (uint32_t)-n % n;
    while ((uint32_t)product < excess) {
      product = (uint64_t)mo_random_u32(random) * n;
    }
  }
  return (uint32_t)(product >> 32);
}

/* Uses 52 bits plus one half, so that the argument is exact, symmetric about ½, and never 0 or
 * 1. */
double mo_random_normal(struct mo_random *random)
{
  return mo_normal_quantile(((double)(mo_random_u64(random) >> 12) + 0.5) * 0x1p-52);
}
