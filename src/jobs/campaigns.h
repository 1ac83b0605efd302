/* campaigns.h: campaigns as jobs: submission, extension, champions. max_active_campaigns run
 * concurrently; the others wait in the order of their submission. After a crash a campaign
 * continues from its newest committed generation (campaign.c; docs/evolution.md, "As a job"). */
#ifndef MORPHO_JOBS_CAMPAIGNS_H
#define MORPHO_JOBS_CAMPAIGNS_H

#include "jobs/live.h"
#include "store/campaign_designs.h"
#include "store/campaign_runs.h"
#include "store/campaigns.h"

/* Submits a campaign, like mo_jobs_submit_training. controller NULL: "default", or random weights
 * in a simultaneous campaign. MO_ERR_DUPLICATE: as in mo_store_submit_campaign. */
int mo_jobs_submit_campaign(struct mo_jobs *jobs, const struct mo_campaign_request *request,
                            int64_t *id, bool *replayed, struct mo_message *message);
/* Extends a campaign, like mo_store_extend_campaign. key (nullable): a known key is answered even
 * if the queue is full. */
int mo_jobs_extend_campaign(struct mo_jobs *jobs, int64_t id, uint32_t generations,
                            const struct mo_request_key *key, struct mo_message *message);

/* Selects the champions of a generation's population with mo_champions (generation −1: the newest).
 * rows, distinctiveness (nullable): space for m; *n: the number of champions. MO_ERR_NOT_FOUND. */
int mo_jobs_campaign_champions(struct mo_jobs *jobs, int64_t id, int64_t generation, uint32_t m,
                               struct mo_campaign_design *rows, double *distinctiveness,
                               uint32_t *n);
struct mo_champions_request {
  uint32_t count, stride;      /* ≥ 1; steps between frames */
  unsigned record;             /* channels; 0: none */
  const char *environment_set; /* a set or suite; NULL: the campaign's environments */
  const char *controller;      /* name or "sha256:…"; NULL: the one that scored the champions */
  const char *label, *submitted_by; /* nullable */
};
/* Submits an evaluation of the newest generation's champions. In a campaign that learns, its newest
 * checkpoint is stored as a controller, by hash. key (nullable): a known key returns its
 * evaluation; MO_ERR_DUPLICATE: the key was used with a different request. */
int mo_jobs_campaign_record_champions(struct mo_jobs *jobs, int64_t id,
                                      const struct mo_champions_request *request,
                                      const struct mo_request_key *key, int64_t *evaluation,
                                      struct mo_message *message);

#endif
