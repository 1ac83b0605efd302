/* import_compare.h: compares the content of a bundle with the stored rows. Stores nothing. Threads
 * and errors as in store.h. */
#ifndef MORPHO_STORE_IMPORT_COMPARE_H
#define MORPHO_STORE_IMPORT_COMPARE_H

#include "store/imports.h"

/* A line of scores in the bundle. */
struct mo_compared_score {
  uint32_t number, class; /* class: place in `classes` */
  uint64_t environments;  /* bit k: place k */
};

/* Rows of the store; 0: not stored. Start from {0}. */
struct mo_import_comparison {
  int64_t controller, physics, environments[MO_ENVIRONMENTS_MAX]; /* of the campaign */
  int64_t *genotypes;                                             /* (n) by number */
  uint32_t n, room;
  char fingerprint[MO_FINGERPRINT_BYTES]; /* of the previous score */
  int64_t class;
  int64_t evaluation;
  struct mo_compared_score *scores; /* (n_scores) of the campaign, by number */
  size_t n_scores, scores_room;
  char (*classes)[MO_FINGERPRINT_BYTES]; /* (n_classes) of these scores */
  uint32_t n_classes, classes_room;
};
/* The calls after mo_compare_campaign belong to that campaign. MO_ERR_CONFLICT: the stored data has
 * different bits. mo_compare_evaluation returns 1, or 0 if the evaluation is not stored; rollouts
 * belong to the last stored one. */
int mo_compare_campaign(struct mo_store *store, struct mo_import_comparison *rows,
                        const struct mo_imported_campaign *campaign);
int mo_compare_design(struct mo_store *store, struct mo_import_comparison *rows,
                      const struct mo_campaign_design *design);
int mo_compare_score(struct mo_store *store, struct mo_import_comparison *rows,
                     const struct mo_campaign_score *score);
int mo_compare_evaluation(struct mo_store *store, struct mo_import_comparison *rows,
                          const struct mo_imported_evaluation *evaluation);
/* Checks that each loss of an evaluation is in the bundle or in the store. MO_ERR_NOT_FOUND. */
int mo_compare_losses(struct mo_store *store, const struct mo_import_comparison *rows,
                      const struct mo_imported_evaluation *evaluation);
int mo_compare_rollout(struct mo_store *store, const struct mo_import_comparison *rows,
                       const struct mo_saved_trajectory *rollout);
void mo_compare_end(struct mo_import_comparison *rows);

#endif
