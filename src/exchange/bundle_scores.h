/* bundle_scores.h: checks that the score lines of one design agree with each other. */
#ifndef MORPHO_EXCHANGE_BUNDLE_SCORES_H
#define MORPHO_EXCHANGE_BUNDLE_SCORES_H

#include "store/imports.h"

struct mo_bundle_scores;                                     /* for one design at a time */
struct mo_bundle_scores *mo_bundle_scores_create(void);      /* Returns NULL if memory runs out. */
void mo_bundle_scores_free(struct mo_bundle_scores *scores); /* NULL-safe */
/* Begins a campaign, after its environments have been read. */
void mo_bundle_scores_open(struct mo_bundle_scores *scores,
                           const struct mo_imported_campaign *campaign);
/* Discards the lines so far, and begins this design. */
void mo_bundle_scores_begin(struct mo_bundle_scores *scores, uint32_t number);
/* Adds a line. Returns 1, or 0 if earlier lines from other blocks have all of its losses.
 * MO_ERR_DUPLICATE: an earlier line is the same, or too many lines returned 0. MO_ERR_FORMAT. */
int mo_bundle_scores_add(struct mo_bundle_scores *scores, const struct mo_campaign_score *score,
                         struct mo_message *message);
/* Checks that the losses yield the score of the design, and the measures their means (NULL: the
 * campaign names none). If the campaign selects by a measure, the score was checked with its mean.
 * MO_ERR_FORMAT. */
int mo_bundle_scores_end(const struct mo_bundle_scores *scores, double score, bool is_cut,
                         const double *means, struct mo_message *message);

#endif
