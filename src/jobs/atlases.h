/* atlases.h: atlases as jobs: submission. One atlas is built at a time; the others wait in the
 * order of their submission. After a crash, a job continues where its file ends (atlas.c). */
#ifndef MORPHO_JOBS_ATLASES_H
#define MORPHO_JOBS_ATLASES_H

#include "jobs/live.h"
#include "store/atlases.h"

/* Submits the build of an atlas, like mo_jobs_submit_training. controller NULL: "default".
 * MO_ERR_DUPLICATE: as in mo_store_submit_atlas. */
int mo_jobs_submit_atlas(struct mo_jobs *jobs, const struct mo_atlas_request *request, int64_t *id,
                         bool *replayed, struct mo_message *message);

#endif
