/* campaign_designs.h: all designs of a campaign, its populations and lines of descent. Threads and
 * errors as in store/campaigns.h. */
#ifndef MORPHO_STORE_CAMPAIGN_DESIGNS_H
#define MORPHO_STORE_CAMPAIGN_DESIGNS_H

#include "store/campaign_records.h"
#include "store/certified.h"

struct mo_campaign_design {
  uint32_t number;
  struct mo_genotype form, genotype;
  struct mo_descent descent; /* parents as numbers */
  uint32_t born;
  int64_t died; /* first generation whose population does not have it (`born`: never selected); −1:
                 * none */
  double score; /* its last score; +infinity: a rollout diverged */
  bool is_cut;  /* the score is a lower bound: scoring stopped early, because the design cannot
                   survive */
  struct mo_design_size size;
  struct mo_certified certified;   /* the newest certificate under a controller of the campaign */
  struct mo_re_evaluated held_out; /* the newest result; in a population: not newer than its
                                      generation */
  /* Of a study. */ char
      own_operator[MO_STUDY_WORD_MAX + 1]; /* "": descent.op is one of enum mo_operator */
  uint32_t n_measures;                     /* also for a campaign that names measures */
  double measures[MO_DESIGN_MEASURES_MAX]; /* (n_measures) NaN: not given, or no mean */
};
/* Returns the name of the operator that created a design. */
static inline const char *mo_campaign_operator(const struct mo_campaign_design *design)
{
  return design->own_operator[0] != '\0' ? design->own_operator
                                         : mo_operator_words[design->descent.op];
}
/* Reads designs with numbers > after (−1: from the first), ascending, at most `limit` ≤
 * MO_PAGE_MAX. Like all reads here, it takes ≤ 50 ms in a campaign of a million designs. */
int64_t mo_store_campaign_designs(struct mo_store *store, int64_t id, int64_t after,
                                  struct mo_campaign_design *rows, size_t limit);
/* Reads the designs with these numbers, in this order. MO_ERR_NOT_FOUND: a design does not
 * exist. */
int mo_store_campaign_designs_of(struct mo_store *store, int64_t id, const uint32_t *numbers,
                                 size_t n, struct mo_campaign_design *rows);
/* Reads the population after a generation (−1: the newest), best first, starting at place `offset`,
 * with its scores at that time. *n: its size. Returns the number of rows or an error;
 * MO_ERR_NOT_FOUND: no such generation. */
int64_t mo_store_campaign_population(struct mo_store *store, int64_t id, int64_t generation,
                                     uint32_t offset, struct mo_campaign_design *rows, size_t limit,
                                     uint32_t *n);
/* Reads the results of a re-evaluated generation, by number. Returns their number; 0: it was not
 * re-evaluated. */
int64_t mo_store_campaign_held_out(struct mo_store *store, int64_t id, uint32_t generation,
                                   struct mo_re_evaluated rows[MO_ELITE_MAX]);
/* Finds the newest re-evaluated generation up to this one. MO_ERR_NOT_FOUND: there is none. */
int mo_store_campaign_re_evaluated(struct mo_store *store, int64_t id, int64_t generation,
                                   int64_t *ret);
/* Reads all descents so far (malloc), and the generation of each birth (malloc, nullable). *n:
 * designs. */
int mo_store_campaign_descents(struct mo_store *store, int64_t id, struct mo_descent **descents,
                               uint32_t **born, uint32_t *n);
/* Every design so far, by number. One block of memory: free frees all of it. */
struct mo_campaign_columns {
  uint32_t n;
  uint32_t *parents[2];  /* (n) each; MO_NO_PARENT */
  uint32_t *born, *died; /* (n) generations; died: MO_ALIVE */
  uint8_t *operators;    /* (n) enum mo_operator, or MO_OPERATORS + index of a study's own
                            operator */
  float *scores; /* (n) last scores; NaN: a rollout diverged; below 0: a lower bound, negated */
  uint8_t *voxels, *footprints; /* (n) each */
  struct mo_study_words words;
  double *measures[MO_DESIGN_MEASURES_MAX]; /* (words.n_measures, n) NaN: not given */
};
#define MO_ALIVE       UINT32_MAX
#define MO_COLUMNS_MAX (INT64_C(1) << 22) /* they are held in memory, about 100 bytes each */
/* MO_ERR_LIMIT: the campaign has more designs. */
int mo_store_campaign_columns(struct mo_store *store, int64_t id,
                              struct mo_campaign_columns **columns);
/* One birth of a form. */
struct mo_campaign_place {
  int64_t campaign;
  uint32_t number;
};
/* Finds births of a form in campaigns with ids above after_campaign, in order of campaigns. */
int64_t mo_store_campaigns_of_design(struct mo_store *store, const struct mo_genotype *form,
                                     int64_t after_campaign, struct mo_campaign_place *places,
                                     size_t limit);

#endif
