/* internal.h: declarations shared by the files of this room. */
#ifndef MORPHO_EVOLUTION_INTERNAL_H
#define MORPHO_EVOLUTION_INTERNAL_H

#include <morpho/evolution.h>

/* Index of the stream (seed, SELECTION, generation, index). Results of a seed depend on it: never
 * renumber. */
enum mo_selection_stream {
  MO_STREAM_GROUPS = 0, /* which parents mutate, which recombine */
  MO_STREAM_TOURNAMENTS = 1,
  MO_STREAM_PARENTS = 2 /* which designs of a study's population are parents */
};

/* After 2^16 attempts in a row without a new form, the morphospace counts as exhausted. */
#define MO_FRUITLESS_MAX (UINT32_C(1) << 16)

/* seen.c: same as mo_seen_add, except that excluded forms count as new. */
int mo_seen_add_own(struct mo_seen *seen, const uint64_t *genotype);

/* A candidate's place and the values that rank it. */
struct mo_rank {
  double score;
  uint64_t number;
  uint32_t place;
};
/* statistics.c: sorts ascending by score, then by number, so that no two have the same rank. */
void mo_rank_sort(struct mo_rank *ranks, uint32_t n);

/* racing.c: cuts the environments of a race into waves of these sizes; a wave that would leave a
 * single environment includes it. */
void mo_race_cut_waves(struct mo_race *race, const uint8_t sizes[MO_RACE_WAVES_MAX]);

#endif
