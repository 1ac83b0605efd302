/* runner.h: functions of the store for `jobs` only: submission, changes of state, losses.
 *
 * Row ids of the database appear only here and in jobs. While a job runs, they identify genotypes,
 * controllers, settings and environments in memory. */
#ifndef MORPHO_STORE_RUNNER_H
#define MORPHO_STORE_RUNNER_H

#include "store/save.h"
#include "store/store.h"

/* ---- submission ---- */

/* Finds the job of an idempotency key. MO_ERR_NOT_FOUND: the key is unknown; MO_ERR_CONFLICT: it
 * was used with a different body. */
int mo_store_replay(struct mo_store *store, const struct mo_request_key *key, int64_t *id);
/* Stores a key, if there is one, with the job that answers its request. Errors as above. */
int mo_store_keep_key(struct mo_store *store, const struct mo_request_key *key, int64_t id);
int mo_store_environment_set_size(struct mo_store *store, const char *name,
                                  uint32_t *n); /* MO_ERR_NOT_FOUND */

/* The designs of large evaluations are stored after the submission, in groups of this size. */
#define MO_DESIGN_GROUP 1000
/* Finds the queued evaluation with the fewest designs still to be stored. *id 0: none. */
int mo_store_waiting(struct mo_store *store, int64_t *id);
/* Reads the listed designs first … first + n − 1 of a waiting group, as submitted.
 * MO_ERR_NOT_FOUND; MO_ERR_CORRUPT. */
int mo_store_waiting_designs(struct mo_store *store, int64_t id, uint32_t first,
                             struct mo_bits *genotypes, uint32_t n);
/* Stores the designs first … first + n − 1, counted from 0, which then no longer wait.
 * MO_ERR_CONFLICT: the evaluation is no longer queued, or a different number of designs is
 * stored. */
int mo_store_group(struct mo_store *store, int64_t id, uint32_t first, const struct mo_bits *forms,
                   const struct mo_bits *genotypes, uint32_t n);

/* ---- state changes that clients request; each with its event ---- */

/* Retry requeues a failed training run or campaign and resets its attempts. It is a no-op for a job
 * that is not final. */
enum mo_job_change { MO_CHANGE_CANCEL, MO_CHANGE_PAUSE, MO_CHANGE_RESUME, MO_CHANGE_RETRY };
/* Changes a job's state. *before: the previous state. MO_ERR_NOT_FOUND, MO_ERR_CONFLICT. */
int mo_store_change_job(struct mo_store *store, int64_t id, enum mo_job_change change,
                        enum mo_job_state *before);

/* Changes the weight of a job that is not final, with its event; setting the same weight is a
 * no-op. MO_ERR_NOT_FOUND; MO_ERR_CONFLICT: the job is final. */
int mo_store_set_weight(struct mo_store *store, int64_t id, double weight);

/* ---- start ---- */

/* Finds the training runs and campaigns that were running when the last process ended. *n: their
 * number; *n_idle: the number that saved nothing after `since_us` (no checkpoint, no generation
 * and, from one second after the start, no losses); *id: the newest of these, or 0. Call it before
 * mo_store_requeue. */
int mo_store_running(struct mo_store *store, int64_t since_us, int64_t *id, uint32_t *n_idle,
                     uint32_t *n);
/* Requeues all running jobs. `crashed` (0: none), the job in the crash marker, is charged one
 * attempt, even if its start was not written before the crash. At max_attempts, it fails with
 * `text`. */
int mo_store_requeue(struct mo_store *store, int64_t crashed, uint32_t max_attempts,
                     const char *text);
int mo_store_fingerprint(struct mo_store *store, const char *text, int64_t *id);
/* The class of the devices that the service used last, either its own devices or devices of
 * workers; "": none. */
struct mo_device_memory {
  char scores[MO_FINGERPRINT_BYTES], gradients[MO_FINGERPRINT_BYTES];
  uint64_t open_jobs; /* open jobs on devices */
};
int mo_store_device_memory(struct mo_store *store, struct mo_device_memory *memory);
/* MO_ERR_LIMIT: too long. */
int mo_store_keep_device_class(struct mo_store *store, const char *scores, const char *gradients);
/* Finds or inserts a row of `origins`, which records who computed a score. */
int mo_store_origin(struct mo_store *store, const char *text, int64_t *id);
/* Counts the unfinished jobs of every kind, and the rollouts of evaluations among them. */
int mo_store_open_work(struct mo_store *store, uint64_t *jobs, uint64_t *rollouts);

/* ---- reads by the scheduler: on their own connection, from one thread at a time ---- */

/* Reads the ids of queued evaluations with a given priority, if all their designs are stored: ids >
 * after, ascending. Returns their number. large: includes evaluations of more than MO_DESIGNS_MAX
 * designs. */
int64_t mo_store_queued(struct mo_store *store, enum mo_urgency priority, int64_t after, bool large,
                        int64_t *ids, size_t limit);

/* The classes of this process: rows of fingerprints. device 0: there are no devices. */
struct mo_classes {
  int64_t cpu[2], device; /* cpu: by precision */
};

/* One evaluation, with everything needed to run it. */
struct mo_work {
  struct mo_job job;
  int64_t controller, sets[MO_SUITE_TASKS]; /* rows; sets: (n_sets); 0: listed environments */
  /* Its class; and the class of bodies that devices leave to the workers or, with a tolerance, of
   * the rungs in float64. */
  int64_t fingerprint, workers;
  /* n_designs: without designs that were skipped. If errors are estimated, each of these occurs
   * once per run (score_ladder.h), run after run: design i belongs to run
   * i / (n_designs / n_runs). In a suite each occurs once per set, set after set, and has the
   * n_environments of set i / (n_designs / n_sets). A job has only one run or only one set. */
  uint32_t n_designs, n_environments, n_runs, n_sets;
  int64_t physics_rows[MO_LADDER_RUNS_MAX]; /* (n_runs) */
  int64_t *environment_rows;                /* (n_sets, n_environments) */
  struct mo_environment *environments;      /* (n_sets, n_environments) */
  int64_t *genotype_rows;                   /* (n_designs) */
  uint32_t *positions;                      /* (n_designs) ascending: places in the request */
  struct mo_bits *genotypes;                /* (n_designs) */
  uint8_t *finished; /* (n_designs, n_environments) 1: an earlier attempt of a verify or recording
                        job finished this rollout; NULL: other jobs */
  uint64_t n_finished, n_finished_diverged;
};
/* Loads an evaluation as work for the classes of this process. */
int mo_store_load_work(struct mo_store *store, int64_t id, const struct mo_classes *classes,
                       struct mo_work **work);
void mo_work_free(struct mo_work *work); /* NULL-safe */

struct mo_score {
  double loss;
  int32_t diverged_step;
  bool known;
};
/* Reads the stored scores of one genotype into scores (n ≤ MO_ENVIRONMENTS_MAX): scores of the
 * class `fingerprint` or, where there are none, of the class `workers` (0: none). */
int mo_store_scores(struct mo_store *store, const struct mo_saved_design *design,
                    const int64_t *environment_rows, uint32_t n, struct mo_score *scores);
/* Reads in which of n environments all measures of a set are stored, as bits. */
int mo_store_measured(struct mo_store *store, const struct mo_saved_design *design,
                      const int64_t *environment_rows, uint32_t n, uint32_t set, uint64_t *known);

#endif
