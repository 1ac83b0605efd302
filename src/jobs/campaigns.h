/* campaigns.h: campaigns as jobs: accepted, run generation by generation on the compute back end,
 * saved, resumed, extended.
 *
 * Each running campaign has a thread of its own, which makes the children, waits for learning and
 * scores, selects, and commits. max_active_campaigns run side by side; the others wait in the order
 * in which they came. Pause, stop and cancel break off the blocks that are under way. After a crash
 * a campaign goes on from its newest committed generation; losses and checkpoints saved inside the
 * generation under way are not computed again. docs/evolution.md, "As a job", has what is decided
 * here.
 *
 * A full disk: the campaign waits (paused, with its reason in `live`) and goes on by itself when
 * there is room. */
#ifndef MORPHO_JOBS_CAMPAIGNS_H
#define MORPHO_JOBS_CAMPAIGNS_H

#include "jobs/jobs.h"
#include "store/campaigns.h"

struct mo_campaign_request {
  struct mo_campaign_record record; /* settings checked here; controller fields, group, replicate
                                       are filled in by the store */
  const char *controller; /* name or "sha256:<hex>"; NULL: "default", in a simultaneous campaign
                             random weights */
  const struct mo_environment *environments; /* (record.n_environments) when there is no set */
  const struct mo_bits
      *genotypes; /* (record.n_listed) as asked for: valid; placed here; of the default workspace */
  int priority;   /* MO_BATCH */
  int back_end;   /* enum mo_back_end or MO_BACK_END_AUTO */
  double weight;  /* 0.001 … 1000 */
  const char *label, *idempotency_key;
  struct mo_sha256 body_sha256;
};
/* As mo_jobs_submit_training. MO_ERR_DUPLICATE: two listed designs have one form; MO_ERR_RANGE: one
 * does not fit the campaign's workspace; more listed than the population. *fault: which. */
int mo_jobs_submit_campaign(struct mo_jobs *jobs, const struct mo_campaign_request *request,
                            int64_t *id, bool *replayed, uint32_t *fault,
                            struct mo_message *message);
/* As mo_store_extend_campaign; key (nullable): one that is known is answered even when the queue is
 * full. */
int mo_jobs_extend_campaign(struct mo_jobs *jobs, int64_t id, uint32_t generations,
                            const struct mo_request_key *key, struct mo_message *message);
/* mo_jobs_cancel, mo_jobs_pause, mo_jobs_resume and mo_jobs_wait work on campaigns, too. */

enum mo_campaign_phase {
  MO_CAMPAIGN_IDLE = 0, /* not running here */
  MO_CAMPAIGN_PREPARE,  /* reads its state; draws the bodies of the pretraining again */
  MO_CAMPAIGN_VARY,
  MO_CAMPAIGN_LEARN,
  MO_CAMPAIGN_SCORE,
  MO_CAMPAIGN_SAVE,
  MO_CAMPAIGN_WAIT /* for room on the disk */
};
const char *
mo_campaign_phase_name(enum mo_campaign_phase phase); /* "idle", "preparing", "varying", "learning",
                                                         "scoring", "saving", "waiting" */
struct mo_campaign_live {
  enum mo_campaign_phase phase;
  uint32_t generation;   /* under way */
  uint64_t done, total;  /* of the phase: bodies drawn again, by whichever campaign, learning steps,
                            designs scored */
  double rollouts_per_s; /* 0: not known yet */
  double seconds_left;   /* of the campaign; of the drawing alone while nothing is known of
                            generations; < 0: not known */
  double busy_s; /* worker seconds that it has had since it was last started; < 0: it has no share
                    now */
  char reason[160]; /* MO_CAMPAIGN_WAIT: why, and what to do; MO_CAMPAIGN_PREPARE: whose drawing it
                       waits for; "" */
};
int mo_jobs_campaign_live(struct mo_jobs *jobs, int64_t id, struct mo_campaign_live *live);

/* Champions of a generation (−1: the newest): mo_champions of its population. rows: room for m; *n:
 * how many. MO_ERR_NOT_FOUND. */
int mo_jobs_campaign_champions(struct mo_jobs *jobs, int64_t id, int64_t generation, uint32_t m,
                               struct mo_campaign_design *rows, double *distinctiveness,
                               uint32_t *n);
/* An evaluation of the champions of the newest generation in the campaign's environments with the
 * controller that scored them (of a campaign that learns: stored from its newest checkpoint, by
 * hash), recording the centre of mass every `stride` steps. key (nullable): known, the evaluation
 * that it brought; MO_ERR_DUPLICATE: known with another request. */
int mo_jobs_campaign_record_champions(struct mo_jobs *jobs, int64_t id, uint32_t m, uint32_t stride,
                                      const struct mo_request_key *key, int64_t *evaluation,
                                      struct mo_message *message);

#endif
