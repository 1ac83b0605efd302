/* evolution_store.h: `morpho-bench evolution --store`: commits each generation to a store, as the
 * daemon does. */
#ifndef MORPHO_BENCH_EVOLUTION_STORE_H
#define MORPHO_BENCH_EVOLUTION_STORE_H

#include <morpho/evolution.h>

struct bench_campaign;

/* Makes a new state folder in `folder`, with a running zero-shot campaign. */
struct bench_campaign *bench_campaign_create(const struct mo_campaign_settings *settings,
                                             const char *folder);

/* A generation before its selection: parents, then children. The losses are the scores, ten times.
 */
struct bench_generation {
  uint32_t generation, n_parents, n_children, n_survivors;
  const uint64_t *genotypes;             /* (n_parents + n_children, MO_DEFAULT_WORDS) */
  const struct mo_candidate *candidates; /* the same shape */
  const struct mo_design_size *sizes;    /* the same shape */
  const struct mo_birth *births;         /* (n_children) */
  const uint32_t *survivors;             /* (n_survivors) places */
  struct mo_population_stats stats;
  struct mo_variation_counts counts;
};
/* Returns the seconds that the commit took. */
double bench_campaign_commit(struct bench_campaign *campaign,
                             const struct bench_generation *generation);
/* Prints sizes, and how long pages take. */
void bench_campaign_report(struct bench_campaign *campaign);

#endif
