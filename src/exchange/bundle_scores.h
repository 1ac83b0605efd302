/* bundle_scores.h: checks the lines with scores of one design against each other. */
#ifndef MORPHO_EXCHANGE_BUNDLE_SCORES_H
#define MORPHO_EXCHANGE_BUNDLE_SCORES_H

#include "store/imports.h"

struct mo_bundle_scores;                                     /* of one design at a time */
struct mo_bundle_scores *mo_bundle_scores_create(void);      /* NULL: no memory */
void mo_bundle_scores_free(struct mo_bundle_scores *scores); /* NULL-safe */
/* Begins with a campaign; its environments were read. */
void mo_bundle_scores_open(struct mo_bundle_scores *scores,
                           const struct mo_imported_campaign *campaign);
/* Forgets the lines so far; lines of this design follow. */
void mo_bundle_scores_begin(struct mo_bundle_scores *scores, uint32_t number);
/* Takes a line. Returns 1, or 0 where earlier lines have all its losses in other blocks.
 * MO_ERR_DUPLICATE: they have the line itself, or too many lines returned 0. MO_ERR_FORMAT. */
int mo_bundle_scores_add(struct mo_bundle_scores *scores, const struct mo_campaign_score *score,
                         struct mo_message *message);
/* Checks that the losses are those of the design's score. MO_ERR_FORMAT. */
int mo_bundle_scores_end(const struct mo_bundle_scores *scores, double score, bool is_cut,
                         struct mo_message *message);

#endif
