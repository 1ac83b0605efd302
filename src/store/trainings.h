/* trainings.h: training runs in the store: settings, learning curve, checkpoints.
 *
 * A training run is a job of kind MO_JOB_TRAINING. Its settings never change. Its progress is rows:
 * one per step, one per validation, one per kept checkpoint. The bytes of a checkpoint are the file
 * trainings/<job>/<step>.checkpoint. The file and its folder are synced before the row, which holds
 * the file's hash, is written. After a crash, steps after the last checkpoint are rerun with the
 * same numbers; a rewritten step replaces its row.
 *
 * Threads and errors as in store.h. */
#ifndef MORPHO_STORE_TRAININGS_H
#define MORPHO_STORE_TRAININGS_H

#include <morpho/learning.h>

#include "store/atlas_sample.h"
#include "store/checkpoints.h"

enum mo_keep { MO_KEEP_NONE = 0, MO_KEEP_ALL = 1 };
extern const char *const mo_keep_words[];
/* The settings of a training run. They never change after submission. */
struct mo_training_record {
  struct mo_training_settings settings;
  char name[MO_NAME_BYTES_MAX + 1]; /* of the resulting controller; "": "training-<id>" */
  uint32_t n_designs;               /* finetune */
  /* Its own environments: a named set, or "": listed in the request. n_environments 0: none, the
   * run draws its environments. With its own, settings.held_out_environments has the same number.
   * draws_worlds: only their tasks are its own, in drawn environments. */
  char environment_set[MO_NAME_BYTES_MAX + 1];
  uint32_t n_environments;
  bool draws_worlds;
  int64_t population; /* finetune: the job whose designs are used; 0: listed in the request, or */
  struct mo_atlas_sample sample; /* drawn from an atlas */
  /* finetune: each design learns alone, one after the other, from the same controller and with the
   * same seed. Steps are then numbered consecutively: step s of design i is
   * i · settings.n_steps + s. Either all controllers are kept, or those of the keep_best best
   * designs. */
  bool each;
  int keep; /* enum mo_keep */
  uint32_t keep_best;
  uint32_t validate_every_steps;   /* 0: never; else also before the first and after the last
                                      step */
  uint32_t checkpoint_every_steps; /* 0: by time only */
  uint32_t checkpoint_every_s; /* 0: by steps only; pausing, stopping and finishing always write a
                                  checkpoint */
  uint32_t checkpoints_kept;   /* 1 … MO_CHECKPOINTS_KEPT_MAX */
};

/* A row of the learning curve. */
struct mo_training_step_row {
  struct mo_training_report report;
  double seconds; /* wall time of the step: the only number here that differs when the step is
                     repeated */
};
struct mo_training_validation_row {
  uint32_t step; /* number of steps that the weights had learned */
  uint32_t rollouts, diverged;
  double mean_score, standard_error; /* over the mean losses of the designs that never diverged */
};

/* The current status of a training run, read in one transaction. */
struct mo_training_status {
  struct mo_job job; /* kind, state, version, times, attempts, error */
  struct mo_training_record record;
  /* Newest row of the curve. After a crash the run may resume from an earlier checkpoint. */
  uint32_t step;
  struct mo_training_step_row last; /* if step > 0 */
  bool has_validation;
  struct mo_training_validation_row validation; /* the newest */
  uint32_t checkpoint_step;                     /* the newest; 0: none */
  struct mo_training_lineage code;              /* the code that computed the training run */
  uint32_t bodies_done;                         /* if each design is trained separately */
};

/* ---- submission (by jobs) ---- */

/* Like struct mo_evaluation_request: as requested and as stored. */
struct mo_training_request {
  struct mo_submission job;
  struct mo_training_record record;
  const char *parent;              /* name or "sha256:<hex>"; NULL: random weights */
  const struct mo_bits *genotypes; /* (record.n_designs) finetune; as requested: only without a
                                      population or an atlas */
  const struct mo_bits *forms;     /* (record.n_designs) canonical; as stored */
  struct mo_design_note *notes;    /* (n_notes) as in mo_evaluation_request */
  uint32_t n_notes;
  const struct mo_environment *environments; /* (record.n_environments) without a set; checked */
  uint32_t population_best; /* number of best designs of record.population to use; 0: all */
};
/* Errors as in mo_store_submit. */
int mo_store_submit_training(struct mo_store *store, const struct mo_training_request *request,
                             int64_t *id, bool *replayed);

/* ---- reading ---- */

/* MO_ERR_NOT_FOUND. */
int mo_store_training(struct mo_store *store, int64_t id, struct mo_training_status *status);
/* Like mo_store_jobs, but only training runs; ignores the query's kind. */
int64_t mo_store_trainings(struct mo_store *store, const struct mo_job_query *query,
                           void *statuses /* struct mo_training_status */, size_t limit);
/* Reads steps > after, ascending, at most `limit` ≤ MO_PAGE_MAX. stride ≥ 1: only multiples of
 * it. */
int64_t mo_store_training_steps(struct mo_store *store, int64_t id, uint32_t after, uint32_t stride,
                                struct mo_training_step_row *rows, size_t limit);
int64_t mo_store_training_validations(struct mo_store *store, int64_t id, int64_t after,
                                      struct mo_training_validation_row *rows,
                                      size_t limit); /* after −1: from the first */
/* Reads a checkpoint's bytes (malloc) and checks their hash: MO_ERR_CORRUPT. step 0: the newest. */
int mo_store_training_checkpoint_bytes(struct mo_store *store, int64_t id, uint32_t step,
                                       uint8_t **bytes, size_t *size);
/* Reads the placed genotypes of a succeeded evaluation, or of a campaign's newest population
 * (malloc): best score first, without duplicates, at most `best` (0: all). Designs that diverged or
 * have only a lower bound are left out, so *n may be less than `best`, or 0. MO_ERR_NOT_FOUND: no
 * such evaluation or campaign; MO_ERR_CONFLICT: the evaluation has not succeeded, or the campaign
 * has no generation yet. */
int mo_store_population(struct mo_store *store, int64_t id, uint32_t best,
                        struct mo_bits **genotypes, uint32_t *n);

/* ---- the runner's writes: each returns after its commit, with its event ---- */

/* All return MO_ERR_CONFLICT if the run has ended, or was not started under this opening of the
 * store. */
/* Writes rows of steps and validations, with the event "training.progress" of the last step. */
int mo_store_training_progress(struct mo_store *store, int64_t id,
                               const struct mo_training_step_row *steps, size_t n_steps,
                               const struct mo_training_validation_row *validation /* nullable */,
                               const char *event_data /* JSON object; NULL: no event */);
/* Stores which code computes the run that is starting, after `step` learned steps. Replaces entries
 * starting at `step`, because their steps are recomputed. *lineage: the complete lineage. Event
 * "training.code_changed" if the code was different before, or is unknown. After MO_LINEAGE_MAX
 * changes the last entry becomes "various". */
int mo_store_training_code(struct mo_store *store, int64_t id, uint32_t step,
                           const char *fingerprint, struct mo_training_lineage *lineage);
/* Stores a checkpoint: the file, then the row. Then deletes, rows before files, all but the newest
 * `keep` checkpoints, and the checkpoints of later steps, which do not belong to the current run. A
 * step beyond all earlier checkpoints resets the job's attempts. step ≥ 1. Event
 * "training.checkpoint". MO_ERR_NO_SPACE: nothing changed; retry when there is space. */
int mo_store_training_checkpoint(struct mo_store *store, int64_t id, uint32_t step,
                                 const uint8_t *bytes, size_t size, uint32_t keep);
/* running → succeeded. Writes the controller's file, then its row, its name and the training run's
 * state in one transaction. controller NULL: there is none. */
int mo_store_training_finish(struct mo_store *store, int64_t id, const char *name,
                             const uint8_t *bytes, size_t size,
                             const struct mo_controller *controller);

#endif
