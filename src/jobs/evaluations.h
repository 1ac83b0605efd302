/* evaluations.h: evaluations as jobs: submission. A score that the store holds, or that another
 * evaluation is computing, is not computed again. A crash loses only the blocks in flight
 * (evaluation.c). */
#ifndef MORPHO_JOBS_EVALUATIONS_H
#define MORPHO_JOBS_EVALUATIONS_H

#include "jobs/jobs.h"

/* MO_BACK_END_AUTO means devices for a float32 batch of at least so many rollouts that neither
 * records nor verifies. */
#define MO_DEVICE_ROLLOUTS_MIN 1000

struct mo_evaluation_request {
  const struct mo_bits *genotypes;           /* (n_designs) valid, not yet placed */
  uint32_t n_designs;                        /* with n_skipped 1 … MO_DESIGNS_MAX */
  const struct mo_design_note *notes;        /* (n_notes) ascending */
  uint32_t n_notes, n_skipped;               /* n_skipped: notes of skipped designs */
  const char *environment_set;               /* "paper-test", or NULL: `environments` */
  const struct mo_environment *environments; /* (n_environments) checked */
  uint32_t n_environments;                   /* 1 … MO_ENVIRONMENTS_MAX; ignored with a set */
  const char *controller;                    /* name or "sha256:<64 hex>"; NULL: "default" */
  struct mo_physics physics;                 /* checked */
  enum mo_precision precision;
  int priority; /* enum mo_urgency, or −1: interactive up to 64 rollouts that are not for devices */
  int back_end;             /* enum mo_back_end or MO_BACK_END_AUTO */
  double weight;            /* MO_WEIGHT_MIN … MO_WEIGHT_MAX; 0: 1 */
  const char *label;        /* nullable */
  const char *submitted_by; /* nullable: the name of a token */
  bool verify;
  unsigned record;              /* channels */
  uint32_t record_stride;       /* 1 … n_steps; ignored when nothing is recorded */
  const char *idempotency_key;  /* nullable; ≤ MO_IDEMPOTENCY_BYTES_MAX */
  struct mo_sha256 body_sha256; /* hash of the request's bytes; used with a key */
};
/* Submits an evaluation and returns after the commit. *id: the job. *replayed: the key was known
 * with the same body, and *id is the earlier job. `message` names the invalid value.
 * - MO_ERR_INVALID, MO_ERR_RANGE: a value breaks this contract
 * - MO_ERR_NOT_FOUND: no such controller or set
 * - MO_ERR_CONFLICT: the key was used with another body
 * - MO_ERR_BUSY: the queue is full; try again later
 * - MO_ERR_LIMIT: the job would record more than max_recorded_bytes
 * - MO_ERR_NO_SPACE: the disk is full; try again later
 * - MO_ERR_CANCELLED: `jobs` is stopping
 * - MO_ERR_UNSUPPORTED: the controller is for another workspace
 * - MO_ERR_DEVICE: no device works, or devices cannot do this (float64, recordings, interactive) */
int mo_jobs_submit_evaluation(struct mo_jobs *jobs, const struct mo_evaluation_request *request,
                              int64_t *id, bool *replayed, struct mo_message *message);

#endif
