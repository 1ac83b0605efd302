/* import_compare.h: compares what a bundle has with what is stored of it, by content. Stores
 * nothing. Threads and errors as in store.h. */
#ifndef MORPHO_STORE_IMPORT_COMPARE_H
#define MORPHO_STORE_IMPORT_COMPARE_H

#include "store/imports.h"

/* Rows of the store; 0: nothing of it is stored. {0} at first. */
struct mo_import_comparison {
  int64_t controller, physics, environments[MO_ENVIRONMENTS_MAX]; /* of the campaign */
  int64_t *genotypes;                                             /* (n) by number */
  uint32_t n, room;
  char fingerprint[MO_FINGERPRINT_BYTES]; /* of the score before */
  int64_t class;
  int64_t evaluation;
};
/* Each of what comes behind belongs to the campaign. MO_ERR_CONFLICT: what is stored of it has
 * other bits. mo_compare_evaluation: returns 1, or 0: it is not here; rollouts belong to one that
 * is. */
int mo_compare_campaign(struct mo_store *store, struct mo_import_comparison *rows,
                        const struct mo_imported_campaign *campaign);
int mo_compare_design(struct mo_store *store, struct mo_import_comparison *rows,
                      const struct mo_campaign_design *design);
int mo_compare_score(struct mo_store *store, struct mo_import_comparison *rows,
                     const struct mo_campaign_score *score);
int mo_compare_evaluation(struct mo_store *store, struct mo_import_comparison *rows,
                          const struct mo_imported_evaluation *evaluation);
int mo_compare_rollout(struct mo_store *store, const struct mo_import_comparison *rows,
                       const struct mo_saved_trajectory *rollout);
void mo_compare_end(struct mo_import_comparison *rows);

#endif
