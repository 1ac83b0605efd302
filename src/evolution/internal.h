/* internal.h: what the files of this room share. */
#ifndef MORPHO_EVOLUTION_INTERNAL_H
#define MORPHO_EVOLUTION_INTERNAL_H

#include <morpho/evolution.h>

/* Which of the streams of (seed, SELECTION, generation): part of what a seed means. */
enum mo_selection_stream {
  MO_STREAM_GROUPS = 0, /* who mutates, who recombines */
  MO_STREAM_TOURNAMENTS = 1
};

/* 2^16 attempts in a row that gave nothing new: the morphospace counts as exhausted. */
#define MO_FRUITLESS_MAX (UINT32_C(1) << 16)

/* seen.c. As mo_seen_add, but what is excluded counts as new. */
int mo_seen_add_own(struct mo_seen *seen, const uint64_t *genotype);

/* A candidate's place with what it is ranked by. */
struct mo_rank {
  double score;
  uint64_t number;
  uint32_t place;
};
/* Ascending by score, then by number. */
void mo_rank_sort(struct mo_rank *ranks, uint32_t n);

/* statistics.c: what mo_distinctiveness divides by (n − 1) · voxels: the sum of Hamming distances
 * to all others, exact. */
void mo_distance_sums(struct mo_workspace workspace, const uint64_t *genotypes, uint32_t n,
                      double *sums);

static inline int mo_is_cancelled(const volatile int *cancel)
{
  return cancel != NULL && __atomic_load_n(cancel, __ATOMIC_RELAXED) != 0;
}

#endif
