/* campaigns.h: campaigns in the store: settings, generations, every design ever born.
 *
 * A campaign is a job of kind MO_JOB_CAMPAIGN. Its settings never change, except the number of
 * generations (extend). A generation is committed in one transaction: designs, births, deaths,
 * scores, population, statistics, learning curve, and the row of the checkpoint that the next
 * generation starts from. Losses of the current generation, and checkpoints during its learning,
 * are saved before that; the commit deletes them.
 *
 * A campaign numbers its designs 0, 1, … in order of birth: initial population, then each
 * generation's children in the order of variation. The births of a generation are one BLOB, and its
 * population is another, so that the phylogeny of a million designs can be read in milliseconds.
 *
 * Threads and errors as in store.h. Genotypes here are placed in the store's workspace. */
#ifndef MORPHO_STORE_CAMPAIGNS_H
#define MORPHO_STORE_CAMPAIGNS_H

#include "store/campaign_records.h"

/* ---- submission (by jobs) ---- */

/* Like struct mo_evaluation_request: as requested and as stored. */
struct mo_campaign_request {
  struct mo_submission job;
  struct mo_campaign_record record; /* of the first replicate; the store fills in controller,
                                       n_environments, group, replicate */
  const char *controller; /* name or "sha256:<hex>"; NULL: random weights (simultaneous) */
  const struct mo_environment *environments; /* (record.n_environments) without a set */
  const struct mo_bits *genotypes;           /* (record.n_listed) */
  const struct mo_bits *forms;               /* (record.n_listed) canonical; as stored */
  struct mo_design_note *notes;              /* (n_notes) as in mo_evaluation_request */
  uint32_t n_notes;
  bool reuses; /* for a study: return the unfinished study with this label, if one exists */
  /* The store copies the population of initial_campaign in the same transaction, like listed
   * designs. */
};
/* Stores all replicates (seed, seed + 1, …) in one transaction. *id: the first; the others have the
 * ids that follow. *replayed: nothing was stored, because the key is known. MO_ERR_DUPLICATE:
 * request->reuses found study *id, and nothing was stored, not even the key; the caller compares
 * the settings, then calls mo_store_keep_key. Designs of the initial campaign that do not fit the
 * workspace are left out, each with a note. Errors as in mo_store_submit, and MO_ERR_NOT_FOUND: no
 * such initial campaign; MO_ERR_CONFLICT: the initial campaign has no population yet; MO_ERR_EMPTY:
 * none of its designs fits. */
int mo_store_submit_campaign(struct mo_store *store, const struct mo_campaign_request *request,
                             int64_t *id, bool *replayed);
/* Adds generations to a queued, running, paused or succeeded campaign; a succeeded one is requeued.
 * *before: its previous state. key (nullable): if it is known, the extension has already been made,
 * and *before is MO_JOB_QUEUED. Event "campaign.extended". MO_ERR_NOT_FOUND; MO_ERR_CONFLICT:
 * failed, cancelled or exhausted; MO_ERR_RANGE: exceeds MO_GENERATIONS_MAX or
 * MO_CAMPAIGN_DESIGNS_MAX; MO_ERR_UNSUPPORTED: the learning rate depends on the number of
 * generations (simultaneous, one cosine); MO_ERR_EMPTY: simultaneous, and the learning state was
 * removed; MO_ERR_DUPLICATE: the key was used with a different request. */
int mo_store_extend_campaign(struct mo_store *store, int64_t id, uint32_t generations,
                             const struct mo_request_key *key, enum mo_job_state *before);

/* ---- reading: lists of an unknown campaign are empty; other reads return MO_ERR_NOT_FOUND ---- */

/* MO_ERR_NOT_FOUND. */
int mo_store_campaign(struct mo_store *store, int64_t id, struct mo_campaign_status *status);
int64_t mo_store_campaigns(struct mo_store *store, const struct mo_job_query *query,
                           void *statuses /* struct mo_campaign_status */, size_t limit);
/* Reads generations > after (−1: from the first), ascending. stride > 1: only multiples of it. */
int64_t mo_store_campaign_generations(struct mo_store *store, int64_t id, int64_t after,
                                      uint32_t stride, struct mo_campaign_generation *rows,
                                      size_t limit);
int64_t mo_store_campaign_steps(struct mo_store *store, int64_t id, int64_t after_generation,
                                uint32_t after_step, struct mo_campaign_step *rows, size_t limit);

#endif
