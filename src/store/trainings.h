/* trainings.h: the store's part in trainings: what was asked for, how it went, its checkpoints.
 *
 * A training is a job of kind MO_JOB_TRAINING. Its settings never change. Its progress is rows: one
 * per step, one per validation, one per checkpoint that is kept. A checkpoint's bytes are a file
 * trainings/<job>/<step>.checkpoint, there (synced, with its folder) before its row, which names
 * its hash. Steps after the last checkpoint are run again after a crash and give the same numbers:
 * writing a step's row again replaces it.
 *
 * Threads and errors as in store.h. */
#ifndef MORPHO_STORE_TRAININGS_H
#define MORPHO_STORE_TRAININGS_H

#include <morpho/learning.h>

#include "store/store.h"

#define MO_CHECKPOINTS_KEPT_MAX   100
#define MO_CHECKPOINT_SECONDS_MAX 86400 /* between two */

/* What a training is: immutable after submission. */
struct mo_training_record {
  struct mo_training_settings settings;
  char name[MO_NAME_BYTES_MAX + 1]; /* of the resulting controller; "" : "training-<id>" */
  char parent_name[MO_NAME_BYTES_MAX +
                   8]; /* as asked for; "" : random weights, or asked for by hash */
  bool has_parent;
  struct mo_sha256 parent_sha256; /* with has_parent: what the name meant at submission */
  uint32_t n_designs;             /* finetune */
  int64_t population; /* finetune: the job whose designs they are; 0: listed in the request */
  uint32_t validate_every_steps; /* 0: never; else also before the first and after the last step */
  uint32_t checkpoint_every_steps; /* 0: by time alone */
  uint32_t checkpoint_every_s; /* 0: by steps alone; a checkpoint is always written at a pause, a
                                  stop and the end */
  uint32_t checkpoints_kept;   /* 1 … MO_CHECKPOINTS_KEPT_MAX */
};

/* A row of the learning curve. */
struct mo_training_step_row {
  struct mo_training_report report;
  double seconds; /* wall time of the step on this machine: the only number here that a repeat
                     changes */
  struct mo_row_damage damage;
};
struct mo_training_validation_row {
  uint32_t step; /* with the weights after so many steps */
  uint32_t rollouts, diverged;
  double mean_score,
      standard_error; /* over the designs of which no rollout diverged, of their mean loss */
  struct mo_row_damage damage;
};
struct mo_training_checkpoint_row {
  uint32_t step;
  struct mo_sha256 sha256;
  uint64_t size;
  int64_t stored_us;
};

/* A training as it stands: read in one transaction. */
struct mo_training_status {
  struct mo_job job; /* kind, state, version, times, attempts, error */
  struct mo_training_record record;
  uint32_t step; /* newest row of the curve; after a crash the run may go on from an earlier
                    checkpoint */
  struct mo_training_step_row last; /* step > 0; nothing is known of it if it has damage */
  bool has_validation;
  struct mo_training_validation_row validation; /* the newest; it may have damage, too */
  uint32_t checkpoint_step;                     /* the newest; 0: none */
  struct mo_training_lineage code;              /* which code computed it */
  bool has_result;
  struct mo_sha256 result_sha256; /* succeeded: the controller */
};

/* ---- submission (by jobs) ---- */

struct mo_training_submission {
  struct mo_training_record record; /* parent_sha256 is filled in by the store from `parent` */
  const char *parent;               /* name or "sha256:<hex>", or NULL: random weights */
  const struct mo_bits *forms;      /* (record.n_designs) canonical; finetune */
  const struct mo_bits *genotypes;  /* (record.n_designs) placed */
  enum mo_urgency priority;
  enum mo_back_end back_end;
  double weight;               /* 0: 1 */
  const char *label;           /* nullable */
  const char *idempotency_key; /* nullable */
  struct mo_sha256 body_sha256;
};
/* Errors as mo_store_submit. */
int mo_store_submit_training(struct mo_store *store,
                             const struct mo_training_submission *submission, int64_t *id,
                             bool *replayed);

/* ---- reading ---- */

/* MO_ERR_NOT_FOUND. MO_ERR_CORRUPT: status->job.damage tells, as in mo_store_job; the rest of
 * *status is as it was. */
int mo_store_training(struct mo_store *store, int64_t id, struct mo_training_status *status);
/* As mo_store_jobs, trainings alone whatever the query's kind. */
int64_t mo_store_trainings(struct mo_store *store, const struct mo_job_query *query,
                           struct mo_training_status *statuses, size_t limit);
/* Steps > after, ascending, at most `limit` ≤ MO_PAGE_MAX. stride ≥ 1: only steps that are
 * multiples of it. One with a number that cannot be told is there with its damage, and its step;
 * validations likewise. */
int64_t mo_store_training_steps(struct mo_store *store, int64_t id, uint32_t after, uint32_t stride,
                                struct mo_training_step_row *rows, size_t limit);
int64_t mo_store_training_validations(struct mo_store *store, int64_t id, int64_t after,
                                      struct mo_training_validation_row *rows,
                                      size_t limit); /* after −1: from the first */
int64_t mo_store_training_checkpoints(struct mo_store *store, int64_t id,
                                      struct mo_training_checkpoint_row *rows,
                                      size_t limit); /* newest first */
/* The designs of a finetuning, in order: genotypes (malloc). */
int mo_store_training_designs(struct mo_store *store, int64_t id, struct mo_bits **genotypes,
                              uint32_t *n);
/* A checkpoint's bytes (malloc), checked against the hash: MO_ERR_CORRUPT. step 0: the newest. */
int mo_store_training_checkpoint_bytes(struct mo_store *store, int64_t id, uint32_t step,
                                       uint8_t **bytes, size_t *size);
/* The placed genotypes of a finished evaluation, or of a campaign's newest population, best score
 * first (malloc); at most `best` of them (0: all), each once. MO_ERR_NOT_FOUND: no such evaluation
 * or campaign; MO_ERR_CONFLICT: the evaluation has not succeeded, the campaign has no generation
 * yet. Designs that diverged are left out: *n may be 0. */
int mo_store_population(struct mo_store *store, int64_t id, uint32_t best,
                        struct mo_bits **genotypes, uint32_t *n);

/* ---- the runner's writes: each returns after its commit, with its event ---- */

/* By priority, then ascending. */
int64_t mo_store_queued_trainings(struct mo_store *store, int64_t *ids, size_t limit);
/* All of them but the start give MO_ERR_CONFLICT when the training is over, or was not started
 * under this opening of the store. */
int mo_store_training_start(struct mo_store *store,
                            int64_t id); /* queued → running; MO_ERR_CONFLICT */
/* Rows of steps and validations; event "training.progress" of the last one, or quiet. */
int mo_store_training_progress(struct mo_store *store, int64_t id,
                               const struct mo_training_step_row *steps, size_t n_steps,
                               const struct mo_training_validation_row *validation /* nullable */,
                               const char *event_data /* JSON object; nullable: quiet */);
/* The run's code, before its first step: `step` steps are learned. What was noted from there on was
 * of steps that are now computed anew. lineage: all of it. Where the code before was another, or is
 * not known, event "training.code_changed". After MO_LINEAGE_MAX changes the last entry says
 * "various". MO_ERR_RANGE, MO_ERR_INVALID: not a fingerprint. */
int mo_store_training_code(struct mo_store *store, int64_t id, uint32_t step,
                           const char *fingerprint, struct mo_training_lineage *lineage);
/* A step beyond every checkpoint before forgives the job's attempts. Writes the file, then the row,
 * then drops all but the newest `keep` (rows, then files), and those of later steps: they are not
 * of the run that is at `step` now. step ≥ 1. Event "training.checkpoint". MO_ERR_NO_SPACE: nothing
 * changed, try again when there is room. */
int mo_store_training_checkpoint(struct mo_store *store, int64_t id, uint32_t step,
                                 const uint8_t *bytes, size_t size, uint32_t keep);
/* Removes a checkpoint (step > 0), or all that are not needed (0): of a training that has ended
 * every one; of another all but the newest, which it goes on from. On a full disk with the reserve.
 * MO_ERR_NOT_FOUND: no such training, or it keeps no checkpoint of this step; MO_ERR_CONFLICT: the
 * training has not ended and goes on from this one. */
struct mo_checkpoints_removed {
  uint32_t steps[MO_CHECKPOINTS_KEPT_MAX]; /* (n) descending */
  size_t n;
  uint64_t bytes; /* of their files */
};
int mo_store_training_checkpoints_remove(struct mo_store *store, int64_t id, uint32_t step,
                                         struct mo_checkpoints_removed *removed);
/* running → succeeded with its controller under its name, in one transaction (file first). */
int mo_store_training_finish(struct mo_store *store, int64_t id, const char *name,
                             const uint8_t *bytes, size_t size,
                             const struct mo_controller *controller);
/* running → queued (park: a stop; attempts stay) or, with an error, one attempt more; at
 * max_attempts → failed. One that is not running stays as it is. *after (nullable): the state it is
 * in then. */
int mo_store_training_park(struct mo_store *store, int64_t id, int error, const char *error_text,
                           uint32_t max_attempts, enum mo_job_state *after);

#endif
