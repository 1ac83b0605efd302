/* campaign_excluded.h: the bodies that a campaign's controller was pretrained on. */
#ifndef MORPHO_JOBS_CAMPAIGN_EXCLUDED_H
#define MORPHO_JOBS_CAMPAIGN_EXCLUDED_H

#include "jobs/campaign_run.h"

/* ---- campaign_lineage.c ---- */
/* The pretraining runs in the lineage of the campaign's controller, newest first. */
#define MO_LINEAGE_PARTS_MAX 16
struct mo_lineage_part {
  uint64_t seed, n_bodies; /* ≥ 1 */
};
struct mo_lineage {
  struct mo_lineage_part parts[MO_LINEAGE_PARTS_MAX];
  uint32_t n_parts;
};
/* Reads the lineage of a controller. Omits the parts that depend on an unreadable field. run
 * (nullable): reports each such field as an event of the campaign. MO_ERR_LIMIT with a message:
 * there are more bodies than can be redrawn. MO_ERR_CANCELLED: a request arrived while an event
 * waited for space. */
int mo_lineage_read(struct mo_jobs *jobs, const struct mo_sha256 *sha256,
                    struct mo_campaign_run *run, struct mo_lineage *lineage,
                    struct mo_message *message);

/* ---- campaign_excluded.c ---- */
/* Finds the forms of the bodies that the campaign's controller and its ancestors were pretrained
 * on, and keeps them for the run. Redraws these bodies, or shares the set of another campaign that
 * has them or is redrawing them. If there are none, *forms stays unchanged. MO_ERR_CANCELLED: a
 * request arrived. */
int mo_exclusion_acquire(struct mo_campaign_run *run, const struct mo_form_set **forms);
void mo_exclusion_release(struct mo_campaign_run *run); /* frees the forms of the run, if it has
                                                         * any */

#endif
