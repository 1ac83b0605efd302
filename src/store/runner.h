/* runner.h: the store as the jobs room sees it: submissions, claims, saved losses, ends of jobs.
 *
 * Row ids of the database appear here and nowhere above: they name genotypes, controllers, settings
 * and environments in memory while a job runs. */
#ifndef MORPHO_STORE_RUNNER_H
#define MORPHO_STORE_RUNNER_H

#include "store/store.h"

/* ---- submission ---- */

struct mo_submission {
  const struct mo_bits *forms;     /* (n_designs) canonical */
  const struct mo_bits *genotypes; /* (n_designs) placed */
  uint32_t n_designs;
  const char *environment_set;               /* or NULL */
  const struct mo_environment *environments; /* (n_environments) when there is no set */
  uint32_t n_environments;
  const char *controller; /* name or "sha256:<hex>" */
  struct mo_physics physics;
  enum mo_precision precision;
  enum mo_urgency priority;
  enum mo_back_end back_end;
  double weight;     /* 0: 1 */
  const char *label; /* nullable */
  bool verify, record_com, record_masses;
  uint32_t record_stride;
  const char *idempotency_key; /* nullable */
  struct mo_sha256 body_sha256;
};
/* Designs, genotypes, environments, settings, job, key and event in one transaction. Errors as in
 * mo_jobs_submit_evaluation. */
int mo_store_submit(struct mo_store *store, const struct mo_submission *submission, int64_t *id,
                    bool *replayed);
/* The job of a key that is known. MO_ERR_NOT_FOUND: it is not; MO_ERR_CONFLICT: known with another
 * body. */
int mo_store_replay(struct mo_store *store, const char *key, const struct mo_sha256 *body_sha256,
                    int64_t *id);
int mo_store_environment_set_size(struct mo_store *store, const char *name,
                                  uint32_t *n); /* MO_ERR_NOT_FOUND */

/* ---- state changes asked for by people; each with its event ---- */

/* Retry: of a training or campaign that has failed, which is queued again with no attempts counted;
 * nothing of one that is not over. */
enum mo_job_change { MO_CHANGE_CANCEL, MO_CHANGE_PAUSE, MO_CHANGE_RESUME, MO_CHANGE_RETRY };
/* *before: the state that it left. MO_ERR_NOT_FOUND, MO_ERR_CONFLICT. */
int mo_store_change_job(struct mo_store *store, int64_t id, enum mo_job_change change,
                        enum mo_job_state *before);

/* Of a job that is not over, with its event; the same weight changes nothing. MO_ERR_NOT_FOUND;
 * MO_ERR_CONFLICT: it is over. */
int mo_store_set_weight(struct mo_store *store, int64_t id, double weight);

/* ---- start ---- */

/* What ran when the last process ended is queued again. `crashed` (0: none): the job that the
 * marker named; its attempts grow by one, and at max_attempts it fails with `text`; also when its
 * start was not written before the crash. */
int mo_store_requeue(struct mo_store *store, int64_t crashed, uint32_t max_attempts,
                     const char *text);
int mo_store_fingerprint(struct mo_store *store, const char *text, int64_t *id);
/* Open jobs of every kind, and the rollouts of evaluations. */
int mo_store_open_work(struct mo_store *store, uint64_t *jobs, uint64_t *rollouts);

/* ---- the scheduler's reads: on a connection of their own, from one thread at a time ---- */

/* Ids of queued evaluations of a priority, ascending, > after. Returns their number or an error. */
int64_t mo_store_queued(struct mo_store *store, enum mo_urgency priority, int64_t after,
                        int64_t *ids, size_t limit);

/* One evaluation, ready to run. */
struct mo_work {
  struct mo_job job;
  int64_t controller, physics, environment_set; /* rows; set 0: none */
  uint32_t n_designs, n_environments;
  int64_t *environment_rows;           /* (n_environments) */
  struct mo_environment *environments; /* (n_environments) */
  int64_t *genotype_rows;              /* (n_designs) */
  struct mo_bits *genotypes;           /* (n_designs) */
  uint8_t *finished; /* (n_designs, n_environments) 1: a verify or recording job has done this one
                        before; else NULL */
  uint64_t n_finished, n_finished_diverged;
};
int mo_store_load_work(struct mo_store *store, int64_t id, struct mo_work **work);
void mo_work_free(struct mo_work *work); /* NULL-safe */

struct mo_score {
  double loss;
  int32_t diverged_step;
  bool known;
};
/* What is stored of one genotype: scores (n). */
int mo_store_scores(struct mo_store *store, int64_t genotype, int64_t controller, int64_t physics,
                    const int64_t *environment_rows, uint32_t n, struct mo_score *scores);

/* ---- saving: one transaction of everything that a moment brought ---- */

struct mo_saved_score {
  int64_t genotype, controller, physics, environment, fingerprint;
  double loss;
  int32_t diverged_step;
  /* For a verify job: also noted as recomputed by that job; 0: not. */
  int64_t verify_job;
  uint32_t design_position, environment_position;
};
struct mo_saved_trajectory {
  int64_t job;
  uint32_t design_position, environment_position;
  uint32_t stride, frames, n_masses;
  const double *com_m; /* or NULL */
  const float *mass_m; /* or NULL */
};
/* A genotype of which a named set is complete. */
struct mo_saved_design {
  int64_t genotype, controller, physics, environment_set;
};
enum mo_job_step {
  MO_STEP_START,    /* queued → running under this epoch (and again, if it is so already) */
  MO_STEP_PROGRESS, /* counts */
  MO_STEP_SUCCEED,  /* running → succeeded, with counts */
  MO_STEP_RETRY,    /* running (or queued: its start was lost) → queued, one attempt more; at
                       max_attempts → failed */
  MO_STEP_PARK,     /* running → queued */
  MO_STEP_HALT /* running (or queued) → paused, with an error: no device is there to compute it */
};
struct mo_job_update {
  int64_t job;
  enum mo_job_step step;
  uint64_t total, done, cached, diverged; /* total 0: the counts stay as they are */
  int64_t started_us;                     /* start */
  int error;                              /* retry */
  char error_text[256];
  uint32_t max_attempts;
  bool quiet; /* no event */
  bool
      applied; /* result: false when the job was no longer in the state that the step starts from */
  enum mo_job_state state; /* result, when applied: the state it is in now */
};
struct mo_save {
  struct mo_saved_score *scores;
  size_t n_scores;
  struct mo_saved_trajectory *trajectories;
  size_t n_trajectories;
  struct mo_saved_design *designs;
  size_t n_designs;
  struct mo_job_update *updates; /* in order */
  size_t n_updates;
  void (*done)(struct mo_save *save,
               int status); /* on the writer's thread after the commit or its failure */
  void *context;
};
/* Queues the save; `save` and what it points to stay until `done`. All of it or nothing of it is
 * stored. MO_ERR_NO_MEMORY: not queued. */
int mo_store_save(struct mo_store *store, struct mo_save *save);

#endif
