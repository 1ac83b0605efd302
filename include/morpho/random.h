/* random.h: counter-based random numbers, Philox4x32-10 (Salmon et al., SC 2011).
 *
 * A stream is identified by (seed, purpose, step, index). The same identifiers yield the same
 * numbers on every machine, in any order of use and on any number of threads, so a restart needs no
 * replay. Key: the 64-bit seed. Counter words: 0 the number of the block within the stream, 1 the
 * low half of the index, 2 the step, 3 the purpose (high 16 bits) and the upper 16 bits of the
 * index. All results are bit-exact across instruction sets (no libm). */
#ifndef MORPHO_RANDOM_H
#define MORPHO_RANDOM_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* What a stream is for. Values are part of the file format: never renumber. */
enum mo_purpose {
  MO_PURPOSE_BODY = 1,
  MO_PURPOSE_TERRAIN = 2,
  MO_PURPOSE_LIGHT = 3,
  MO_PURPOSE_TEST_SET = 4,
  MO_PURPOSE_WEIGHTS = 5,
  MO_PURPOSE_MUTATION = 6,
  MO_PURPOSE_CROSSOVER = 7,
  MO_PURPOSE_SELECTION = 8,
  MO_PURPOSE_CHECK = 9, /* property tests and benchmarks */
  MO_PURPOSE_HELD_OUT_BODY = 10,
  MO_PURPOSE_HELD_OUT_TERRAIN = 11,
  MO_PURPOSE_HELD_OUT_LIGHT = 12,
  MO_PURPOSE_POPULATION = 13,     /* initial populations of campaigns */
  MO_PURPOSE_EVOLUTION_SEED = 14, /* seeds of the training runs in a campaign */
  MO_PURPOSE_AUDIT = 15,          /* selects the leases that are computed twice */
  MO_PURPOSE_PROFILE = 16,        /* terrain profiles of random families; step: the family */
  MO_PURPOSE_SUITE = 17,          /* worlds of morpho-12; step: the task */
  MO_PURPOSE_TRAINING_WORLD = 18, /* which of its own environments a robot in a training run gets */
  MO_PURPOSE_FACTORS = 19,        /* factors of environments; index: the number of the factor, or
                                     after these 6: drop, 7: slope, 8: direction of the slope */
  MO_PURPOSE_RE_EVALUATION = 20, /* seeds of the fresh worlds of a campaign; step: the generation */
  MO_PURPOSE_ATLAS_SAMPLE = 21   /* bodies drawn from an atlas; index: the stratum */
};

struct mo_random {
  uint32_t key[2];
  uint32_t counter[4];
  uint32_t block[4]; /* the numbers of the current counter */
  uint32_t used;     /* how many of `block` were returned; 4: compute the next block */
};

/* Applies the bijection once: out = Philox4x32-10(counter, key). */
void mo_philox4x32_10(const uint32_t counter[4], const uint32_t key[2], uint32_t out[4]);

/* index: 48 bits; higher bits are ignored. */
void mo_random_init(struct mo_random *random, uint64_t seed, enum mo_purpose purpose, uint32_t step,
                    uint64_t index);

uint32_t mo_random_u32(struct mo_random *random);
void mo_random_fill(struct mo_random *random, uint32_t *numbers,
                    size_t n);                      /* n times mo_random_u32, faster */
uint64_t mo_random_u64(struct mo_random *random);   /* first number is the low half */
double mo_random_uniform(struct mo_random *random); /* [0, 1), 53 bits */
uint32_t mo_random_below(struct mo_random *random,
                         uint32_t n); /* uniform on 0 … n−1, unbiased; 0 for n = 0 */
double
mo_random_normal(struct mo_random *random); /* N(0, 1) by inversion: one uniform per number */

#ifdef __cplusplus
}
#endif
#endif
