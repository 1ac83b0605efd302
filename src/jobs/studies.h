/* studies.h: the requests of a study's client: scoring a batch, bodies to try, and finishing. A
 * study is a campaign (campaigns.h) of the mode MO_STUDY; while no batch is pending it waits in the
 * queue, without a thread. */
#ifndef MORPHO_JOBS_STUDIES_H
#define MORPHO_JOBS_STUDIES_H

#include "jobs/live.h"
#include "store/campaign_designs.h"
#include "store/campaign_runs.h"
#include "store/campaigns.h"
#include "store/studies.h"

/* Places the children's bodies, stores the batch, and queues it for scoring. Submitting the same
 * batch again changes nothing. Returns the errors of mo_store_study_tell, with a message. */
int mo_jobs_tell(struct mo_jobs *jobs, int64_t id, struct mo_study_telling *telling,
                 struct mo_telling_reply *reply, struct mo_message *message);

struct mo_ask {
  uint32_t n;              /* bodies, 1 … the population */
  bool is_random;          /* random bodies; otherwise variations of the parents, if there are
                            * any */
  const uint32_t *parents; /* (n_parents) numbers; NULL: the population */
  uint32_t n_parents;
};
struct mo_asked {
  uint32_t batch;                  /* the batch that they are for */
  uint32_t n;                      /* fewer than requested: the morphospace is exhausted */
  struct mo_study_child *children; /* (n) malloc */
};
/* Makes bodies that the study has never seen, by the settings' mutation and crossover. They depend
 * only on the settings, the study's designs so far, and the request. Nothing is stored.
 * MO_ERR_NOT_FOUND: no such study; MO_ERR_CONFLICT: a batch is pending, or the study has ended;
 * MO_ERR_RANGE: a parent does not exist; MO_ERR_LIMIT: the study has more than MO_COLUMNS_MAX
 * designs. */
int mo_jobs_ask(struct mo_jobs *jobs, int64_t id, const struct mo_ask *ask, struct mo_asked *asked,
                struct mo_message *message);

/* Ends a study. MO_ERR_NOT_FOUND; MO_ERR_CONFLICT: a batch is pending, or the study was cancelled
 * or has failed. */
int mo_jobs_finish_study(struct mo_jobs *jobs, int64_t id);

/* Reads the losses of designs of a study. losses: (n), by place; measures: (n, environments) space
 * for the measures of the rollouts, to which losses->measures then point; NULL: only the losses are
 * read. known: (n) whether the losses belong to the code that computes the study now. */
int mo_jobs_study_losses(struct mo_jobs *jobs, int64_t id, const struct mo_bits *genotypes,
                         uint32_t n, struct mo_campaign_loss *losses,
                         double (*measures)[MO_MEASURES], uint8_t *known);

#endif
