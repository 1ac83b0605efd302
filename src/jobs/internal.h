/* internal.h: the state of the scheduler. Only for this room.
 *
 * The scheduler's thread owns the structures above mo_wish and everything in mo_jobs below `The
 * scheduler's own`. Other threads use the inbox: finished blocks, requests to stop a job or change
 * its weight, results of saves.
 *
 * - active: a running job; each cell (design × environment) is to do, in flight, or done
 * - rollout: one (genotype, controller, physics, environment) that is being computed or waits for
 * its commit. All cells of all jobs that need the rollout wait for it, so it is computed once.
 * - flight: one block in the back end, up to MO_BLOCK_LANES rollouts of one genotype
 * - pending: what the next save will write; at most one save is in progress */
#ifndef MORPHO_JOBS_INTERNAL_H
#define MORPHO_JOBS_INTERNAL_H

#include <pthread.h>
#include <stdatomic.h>
#include <stdio.h>

#include "jobs/campaigns.h"
#include "jobs/trainings.h"
#include "store/runner.h"

#define MO_ROLLOUT_BUCKETS 4096
#define MO_DELAYED_MAX     64

/* A queue of jobs that wait for the same resource: workers, workers with priority, devices. Each
 * lane has its own window and virtual time. */
enum mo_lane { MO_LANE_BATCH = 0, MO_LANE_INTERACTIVE = 1, MO_LANE_DEVICE = 2, MO_LANES };

enum mo_cell { MO_CELL_TO_DO = 0, MO_CELL_UNDER_WAY = 1, MO_CELL_DONE = 2 };

/* A controller that is loaded into the back end. */
struct mo_loaded {
  struct mo_sha256 sha256;
  struct mo_controller *controller;
  struct mo_compute_controller *ready;
  uint32_t users;
  uint64_t last_used;
  struct mo_loaded *next;
};

struct mo_active {
  struct mo_work *work; /* NULL: could not be loaded */
  int64_t id;
  enum mo_urgency priority;
  enum mo_back_end back_end;
  double weight;
  struct mo_loaded *controller;
  uint8_t *cells;  /* (n_designs, n_environments) enum mo_cell */
  uint8_t *left;   /* (n_designs) cells that are not done */
  uint32_t cursor; /* no earlier design has a cell to do */
  uint64_t total, done, cached, diverged;
  /* Counts reported before this claim of a job that shares rollouts. The job finds its cells in the
   * store again, in any order; meanwhile the reported counts never decrease. */
  uint64_t done_before, cached_before, diverged_before;
  uint64_t own_before; /* rollouts computed before this claim; found in the store, but not counted
                          as cached */
  double pass;         /* virtual time: rollout steps / weight; the job with the least goes next */
  bool private_runs;   /* verify or recording: shares no rollouts and skips look-ups */
  bool detached;  /* cancelled, paused or failed: makes no new blocks; finished ones still count */
  bool failing;   /* detached, and its error is not committed yet */
  bool finishing; /* a save contains its end */
  bool changed;   /* counts differ from those last saved */
  int64_t last_event_us;
  uint32_t references; /* from waiting cells and saves */
  struct mo_active *next;
};

struct mo_waiter {
  struct mo_active *active;
  size_t cell;
  bool owner; /* the block was made for this cell */
  struct mo_waiter *next;
};

struct mo_rollout {
  int64_t genotype, controller, physics, environment, fingerprint; /* the class of its jobs */
  struct mo_flight *flight; /* NULL: computed, waits for its commit */
  double loss;
  int32_t diverged_step;
  struct mo_waiter *waiters;
  struct mo_rollout *next;      /* in its bucket */
  struct mo_rollout *next_save; /* in pending or in the current save */
};

struct mo_flight {
  struct mo_block block;
  struct mo_jobs *jobs;
  struct mo_rollout *rollouts[MO_BLOCK_LANES];
  struct mo_bits genotype;
  volatile int cancel;
  uint64_t serial;
  /* The job that launched the flight; in private runs also its cells and recordings. */
  struct mo_active *owner;
  size_t cells[MO_BLOCK_LANES];
  struct mo_body *body;
  struct mo_recording recordings[MO_BLOCK_LANES];
  uint32_t frames;
  uint64_t recorded_bytes;
  struct mo_flight *next, *previous; /* among all flights */
  struct mo_flight *next_inbox;      /* among the finished */
};

/* The growing arrays of one save. */
struct mo_pending {
  struct mo_save save;
  size_t scores_room, trajectories_room, designs_room, updates_room, owners_room;
  struct mo_active **owners;   /* (save.n_updates) the job of each update; each holds a reference */
  struct mo_rollout *rollouts; /* to forget after the commit */
  uint64_t recorded_bytes;
  int64_t since_us; /* time of the first entry; 0: empty */
  bool urgent;
};

struct mo_wish {
  int64_t id;
  bool weigh; /* only the weight has changed */
  struct mo_wish *next;
};

/* A running training's or campaign's share of the back end. */
struct mo_job_share {
  int64_t id;
  enum mo_job_kind kind;
  struct mo_compute_share *share;
  struct mo_job_share *next;
};

/* ---- runners: jobs with their own thread (runners.c, attempt.c) ---- */

/* A request to a running job; the larger value wins. */
enum mo_runner_wish { MO_WISH_NONE = 0, MO_WISH_PAUSE, MO_WISH_STOP, MO_WISH_CANCEL };

struct mo_runner;
struct mo_attempt;

/* ---- memory.c ---- */
/* The memory that a job needs while it runs, in bytes. */
struct mo_need {
  uint64_t own;
  uint64_t shared, shared_key; /* excluded bodies: one set for all jobs with the same key */
  uint64_t
      scratch; /* of the workers, for gradients: one for all jobs, as large as the largest need */
};
/* An error that passes by itself. */
static inline bool mo_is_shortage(int error)
{
  return error == MO_ERR_NO_MEMORY || error == MO_ERR_NO_SPACE || error == MO_ERR_BUSY;
}
struct mo_memory_user {
  int64_t id;
  const struct mo_runner_kind *kind;
  struct mo_need need;
  bool is_proven;     /* has saved something since it was admitted */
  uint32_t overtaken; /* later jobs that were admitted first */
  char reason[160];   /* why the job waits */
  struct mo_memory_user *next;
};
struct mo_memory {
  pthread_mutex_t mutex;
  struct mo_memory_user *users, *waiting; /* waiting: in order of arrival */
  /* Jobs that may have killed the process: one starts at a time until so many are proven or over.
   */
  uint32_t n_suspects;
  uint32_t n_workers;
  uint64_t tape_bytes; /* limit of one worker's tape */
};

/* The functions of one kind of job with its own thread. */
struct mo_runner_kind {
  const char *noun; /* "training" */
  int64_t (*queued)(struct mo_store *store, int64_t *ids, size_t limit);
  /* Sets *need to 0 for an unreadable job: its run will report the error. Returns an error only
   * for a shortage that passes. */
  int (*need)(struct mo_jobs *jobs, int64_t id, struct mo_need *need);
  int (*start)(struct mo_store *store, int64_t id);
  int (*park)(struct mo_store *store, int64_t id, int error, const char *error_text,
              uint32_t max_attempts, enum mo_job_state *after);
  /* Runs a started job to its end or until a request, and stores the outcome. Returns whether an
   * error ended the attempt. */
  bool (*run)(struct mo_runner *runner, int64_t id);
  /* Resets the live figures for a claimed job; under the mutex. */
  void (*begin)(struct mo_runner *runner);
  /* Sets the phase that the live figures show, with a reason for waiting; returns the previous
   * phase. */
  int (*set_phase)(struct mo_runner *runner, int phase, const char *reason);
  int waiting, busy; /* phases: waiting for space or memory; where it continues */
};

/* A thread that runs one job after the other. The mutex of its runners protects the fields, except
 * the flags that the back end reads. */
struct mo_runner {
  struct mo_jobs *jobs;
  struct mo_runners *runners;
  pthread_t thread;
  bool thread_started;
  int64_t id; /* 0: runs no job */
  enum mo_runner_wish wish;
  bool waits;    /* for disk space or memory */
  bool is_short; /* the last run lacked memory and must be repeated; only for this thread */
  union {
    struct mo_training_live training;
    struct mo_campaign_live campaign;
  } live;
  volatile int interrupt;     /* set with every request */
  volatile uint64_t replayed; /* of a training: bodies drawn again so far */
};

/* All threads for one kind of job. */
struct mo_runners {
  const struct mo_runner_kind *kind;
  pthread_mutex_t mutex;
  pthread_cond_t news;      /* requests, queued jobs, ends of threads */
  struct mo_runner *runner; /* (n) */
  uint32_t n;
  uint32_t alive; /* running threads */
  uint64_t look;  /* grows when there may be queued jobs */
  bool stopping;
  atomic_bool unsaved; /* a stopped job could not be saved */
  atomic_uint_fast64_t active;
};

/* A runner's attempt at a job; first member of the state of each kind. */
struct mo_attempt {
  struct mo_jobs *jobs;
  struct mo_runner *runner;
  int64_t id;
  bool winding_down; /* a request arrived or the job failed: only computed results are saved */
  bool is_short;     /* lacks memory: what cannot be saved at once is computed again */
  int error;
  char text[256]; /* of the error */
};

struct mo_jobs { /* NOLINT(clang-analyzer-optin.performance.Padding): grouped by owner */
  struct mo_store *store;
  struct mo_compute *compute;
  struct mo_jobs_config config;
  struct mo_lattice *lattice;
  struct mo_classes classes;
  int listener;

  /* Admission. */
  pthread_mutex_t admission_mutex;
  atomic_uint_fast64_t open_jobs, open_rollouts; /* changed under the mutex */

  /* Threads that wait for the end of a job. */
  pthread_mutex_t wait_mutex;
  pthread_cond_t ended;
  uint64_t endings;

  /* Inbox. */
  pthread_mutex_t mutex;
  pthread_cond_t news;
  struct mo_flight *finished;
  struct mo_wish *wishes;
  bool look; /* there may be queued jobs */
  bool saved;
  int save_status;
  bool stopping, stopped;
  bool abandon; /* stop waiting for saves that fail */
  pthread_cond_t stop_done;

  /* Shares. */
  pthread_mutex_t weigh_mutex; /* taken before shares_mutex, so that reading a weight from the store
                                  and setting it is one operation */
  pthread_mutex_t shares_mutex; /* held briefly */
  struct mo_job_share *shares;
  double ended_s[MO_JOB_KINDS];         /* worker seconds of closed shares */
  double ended_device_s[MO_JOB_KINDS];  /* device seconds, likewise */
  struct mo_compute_share *evaluations; /* shared by all evaluations */
  double evaluations_weight;            /* only for the scheduler */

  struct mo_runners trainings, campaigns;
  struct mo_memory memory;
  pthread_mutex_t exclusions_mutex;
  struct mo_exclusion
      *exclusions;        /* bodies of pretrainings, shared by campaigns (campaign_excluded.c) */
  char *code_versions[2]; /* by back end */

  /* The scheduler's own. */
  pthread_t thread;
  bool thread_started;
  struct mo_active *actives;
  struct mo_flight *flights;
  uint32_t n_flights[MO_LANES];
  uint64_t recording_bytes; /* of recordings in flight */
  uint64_t serial, use_clock;
  struct mo_rollout *buckets[MO_ROLLOUT_BUCKETS];
  struct mo_loaded *controllers;
  struct mo_pending pending, saving;
  double pass[MO_LANES]; /* virtual time */
  bool save_under_way;
  int64_t retry_save_us; /* time of the next try after lack of space */
  bool broken;           /* the store is lost: no more work is started */
  bool look_again;       /* as `look`, from the scheduler itself */
  struct {
    int64_t id, until_us;
  } delayed[MO_DELAYED_MAX];
  unsigned n_delayed;

  atomic_uint_fast64_t active_batch, active_interactive, blocks_in_flight;
  atomic_uint_fast64_t computed, cached, shared, diverged, submitted, succeeded, failed, cancelled;
  atomic_uint_fast64_t campaign_generations, campaign_designs, campaign_rollouts, campaign_cached,
      campaign_diverged, campaign_steps;
  atomic_uint_fast64_t training_steps, training_robots, training_diverged, training_zeroed,
      training_validations, training_checkpoints, training_ns;
  atomic_int_fast64_t heartbeat_us;
  atomic_bool no_space, is_stopping;
};

/* ---- submit.c ---- */
/* Places every genotype and finds its canonical form. MO_ERR_INVALID names the first invalid one.
 */
int mo_designs_place(const struct mo_bits *asked, uint32_t n, struct mo_bits *forms,
                     struct mo_bits *genotypes, struct mo_message *message);
int mo_jobs_admit(struct mo_jobs *jobs, uint64_t rollouts,
                  struct mo_message *message); /* MO_ERR_BUSY */
int mo_weight_check(
    double weight, struct mo_message *message); /* MO_ERR_RANGE; 0 means "not given" and is valid */
/* Fills *message with the reason for an error of the store. */
int mo_submission_explain(int error, const char *controller, struct mo_message *message);
/* Checks 1 to MO_ENVIRONMENTS_MAX environments for simulation. MO_ERR_INVALID, MO_ERR_RANGE. whose:
 * "an evaluation". */
int mo_environments_check(const struct mo_environment *environments, uint32_t n, const char *whose,
                          struct mo_message *message);
int mo_submission_check_texts(const char *label, const char *idempotency_key,
                              struct mo_message *message);

/* ---- runners.c ---- */
void mo_runners_init(struct mo_runners *runners, const pthread_condattr_t *monotonic);
void mo_runners_destroy(struct mo_runners *runners);
int mo_runners_start(struct mo_jobs *jobs, struct mo_runners *runners,
                     const struct mo_runner_kind *kind, uint32_t n);
void mo_runners_stop(struct mo_runners *runners); /* requests a stop without waiting */
bool mo_runners_wait(struct mo_runners *runners,
                     const struct timespec *deadline); /* true: all threads have ended */
void mo_runners_free(struct mo_runners *runners);      /* stops, waits for and frees the threads */
void mo_runners_wake(struct mo_runners *runners);
void mo_runners_wish(struct mo_runners *runners, int64_t id, enum mo_runner_wish wish);
/* Returns the runner of a job, or NULL; under the mutex. */
struct mo_runner *mo_runners_find(struct mo_runners *runners, int64_t id);
enum mo_runner_wish mo_runner_wished(struct mo_runner *runner);
bool mo_runner_is_interrupted(const struct mo_runner *runner);
/* Shows whether the job waits, with the reason. Returns the previous phase. */
int mo_runner_set_waiting(struct mo_runner *runner, bool waits, int phase, const char *reason);
/* Sleeps until the time is over or a request of at least `least` has arrived. */
void mo_runner_sleep(struct mo_runner *runner, uint32_t ms, enum mo_runner_wish least);

/* ---- memory.c ---- */
/* Initializes the accounting and limits the memory that the back end uses for gradients. */
void mo_memory_init(struct mo_jobs *jobs);
void mo_memory_free(struct mo_jobs *jobs);
struct mo_need mo_need_of_training(const struct mo_jobs *jobs,
                                   const struct mo_training_record *record,
                                   enum mo_back_end back_end);
/* Computes the need of a campaign. controller: nullable. Errors as mo_lineage_reckon. */
int mo_need_of_campaign(struct mo_jobs *jobs, const struct mo_campaign_settings *settings,
                        const struct mo_sha256 *controller, enum mo_back_end back_end,
                        struct mo_need *need, struct mo_message *message);
/* MO_ERR_LIMIT: the job would not fit even without other jobs. */
int mo_memory_check(const struct mo_jobs *jobs, const struct mo_need *need,
                    struct mo_message *message);
/* Admits a queued job. true: the caller runs the job and gives it back later. false: the job waits,
 * or another thread has it. */
bool mo_memory_take(struct mo_jobs *jobs, const struct mo_runner_kind *kind, int64_t id);
/* Returns the memory of a job, once the run has freed everything. */
void mo_memory_give(struct mo_jobs *jobs, int64_t id);
/* Forgets a waiting job that may no longer be queued. */
void mo_memory_forget(struct mo_jobs *jobs, int64_t id);
/* Forgets the waiting jobs of the kind that are not in `ids`, the queued ones. */
void mo_memory_keep(struct mo_jobs *jobs, const struct mo_runner_kind *kind, const int64_t *ids,
                    int64_t n);
/* Computes a job's need again after a change of its settings. */
void mo_memory_renew(struct mo_jobs *jobs, const struct mo_runner_kind *kind, int64_t id);
/* Records that a job has saved something. */
void mo_memory_prove(struct mo_jobs *jobs, int64_t id);
/* Stores why a job waits; false: the job does not wait. */
bool mo_memory_reason(struct mo_jobs *jobs, int64_t id, char reason[160]);

/* ---- attempt.c ---- */
/* Stores the text for an error, and returns the error. */
int mo_attempt_fail(struct mo_attempt *attempt, int error, const char *text);
/* Does the same for a job that the store could not read. */
int mo_attempt_fail_unreadable(struct mo_attempt *attempt, int error);
/* Does the same for an unusable file of weights. */
int mo_attempt_fail_controller(struct mo_attempt *attempt, int error,
                               const struct mo_sha256 *sha256);
void mo_attempt_warn(const struct mo_attempt *attempt, int error, const char *text);
/* Repeats `write` until it succeeds or fails permanently: waits for disk space, memory or
 * descriptors, and reports that `what` cannot be written. MO_ERR_CANCELLED: a request came first.
 */
int mo_attempt_persist(struct mo_attempt *attempt, int (*write)(void *context), void *context,
                       const char *what);
/* Ends an attempt with `error`; `save` saves computed results. MO_ERR_CANCELLED: a request arrived.
 * MO_ERR_NO_MEMORY: the runner waits, then repeats the attempt. Returns whether the attempt failed.
 */
bool mo_attempt_settle(struct mo_attempt *attempt, int error, int (*save)(void *context),
                       void *context);

/* ---- shares.c ---- */
/* Opens a share for the thread of a training or campaign. The share follows the job's weight until
 * it is closed. Name the share in every block and batch of the job. MO_ERR_NO_MEMORY, and errors of
 * reading the job. */
int mo_share_open(struct mo_jobs *jobs, int64_t id, enum mo_job_kind kind,
                  struct mo_compute_share **share);
/* Closes the job's share, if any. None of its blocks may be queued or in flight. */
void mo_share_close(struct mo_jobs *jobs, int64_t id);
void mo_share_reweigh(struct mo_jobs *jobs, int64_t id); /* applies a new weight from the store */
void mo_shares_seconds(struct mo_jobs *jobs, double worker_s[MO_JOB_KINDS],
                       double device_s[MO_JOB_KINDS]);

/* ---- learner.c ---- */
/* A training with the state that the back end needs for its gradients. */
struct mo_learner {
  struct mo_training *training;
  struct mo_gradient_state *gradients;
  enum mo_back_end back_end; /* set by mo_learner_prepare */
  /* The current gradient; batch.computed_on names the back end that computed it. */
  struct mo_gradient_batch batch;
  int status;
  bool computes, draws; /* threads of this step */
  pthread_t computing, drawing;
  int64_t start_us;
  double *d_parameters;
  struct mo_outcome *outcomes;
};
/* Prepares the learner for its training. Call it again when another training of the same controller
 * and batch takes its place. MO_ERR_NO_MEMORY. */
int mo_learner_prepare(struct mo_jobs *jobs, enum mo_back_end back_end, struct mo_learner *learner);
/* Sets the designs of the training and discards the batch that was laid out ahead. */
int mo_learner_set_designs(struct mo_learner *learner, const uint64_t *designs, uint32_t n,
                           struct mo_message *message);
/* One step: the gradient of the drawn robots, then its application. `write` writes what is due from
 * earlier steps and may read the state of the training. On devices, `write` and the drawing of the
 * next robots run during the gradient. On workers, where a gradient takes a hundred times as long,
 * that would gain nothing, so the gradient starts after `write` succeeds. An error of `write` comes
 * before one of the gradient. seconds: of the whole step. */
struct mo_learner_turn {
  enum mo_urgency urgency;
  int64_t tag;
  struct mo_compute_share *share;
  const volatile int *cancel;
  int (*write)(void *context);
  void *context;
};
int mo_learner_gradient(struct mo_learner *learner, const struct mo_robot *robots,
                        const struct mo_learner_turn *turn);
int mo_learner_apply(struct mo_learner *learner, struct mo_training_report *report,
                     double *seconds);
void mo_learner_free(struct mo_learner *learner); /* also frees the training */

/* ---- campaign_run.c ---- */
extern const struct mo_runner_kind mo_campaign_runners;

/* ---- training_run.c ---- */
extern const struct mo_runner_kind mo_training_runners;

/* ---- training_held_out.c ---- */
int mo_held_out_load(struct mo_store *store, const struct mo_training_status *status,
                     struct mo_held_out *held_out);
/* Scores the held-out designs with the current weights. MO_ERR_CANCELLED; MO_ERR_NO_MEMORY and
 * other errors of blocks. */
int mo_held_out_score(struct mo_jobs *jobs, const struct mo_held_out *held_out,
                      const struct mo_controller *controller, const struct mo_physics *physics,
                      enum mo_back_end back_end, int64_t tag, struct mo_compute_share *share,
                      const volatile int *cancel, struct mo_training_validation_row *row);

/* ---- back_end.c ---- */
/* Chooses the back end if the request leaves it open. suits: devices can compute the job; is_large:
 * devices are worth it. MO_ERR_DEVICE. */
int mo_back_end_choose(const struct mo_jobs *jobs, int asked, bool suits, bool is_large,
                       enum mo_back_end *back_end, struct mo_message *message);
/* MO_ERR_DEVICE: the job needs devices and none works. Check before a job starts: drawing its
 * bodies again can take minutes. */
int mo_back_end_check(const struct mo_jobs *jobs, enum mo_back_end back_end);
/* Maps an error of a block or gradient to that of its job. Lack of device memory pauses the job as
 * a lost device does, because the lack may last. */
int mo_back_end_error(enum mo_back_end back_end, int error);
/* Says why a job on devices is paused (lost devices or lack of memory), and what to do. */
void mo_back_end_describe_loss(struct mo_jobs *jobs, char *text, size_t size);
/* Returns the row of the fingerprint under which float32 scores are stored. */
int64_t mo_back_end_fingerprint(const struct mo_jobs *jobs, enum mo_back_end back_end);
/* Returns how many blocks one job keeps submitted. */
uint32_t mo_back_end_window(const struct mo_jobs *jobs, enum mo_back_end back_end);

/* ---- scheduler.c ---- */
enum mo_lane mo_lane_of(enum mo_urgency priority, enum mo_back_end back_end);
void *mo_scheduler_loop(void *jobs);
void mo_jobs_wake(struct mo_jobs *jobs);
void mo_jobs_closed(struct mo_jobs *jobs,
                    uint64_t rollouts);    /* subtracts a job that is no longer open */
int mo_jobs_recount(struct mo_jobs *jobs); /* counts open jobs and rollouts in the store */
void mo_active_release(struct mo_jobs *jobs, struct mo_active *active);
/* Requeues the job with one more attempt; with MO_ERR_DEVICE, pauses it. */
void mo_active_fail(struct mo_jobs *jobs, struct mo_active *active, int error, const char *text);
void mo_actives_free_all(struct mo_jobs *jobs);
struct mo_active *mo_active_find(struct mo_jobs *jobs, int64_t id);

/* ---- blocks.c ---- */
/* Visits designs of `active` until a block is submitted (1), `budget` designs were visited (0), or
 * no cell is to do (−1). */
int mo_active_advance(struct mo_jobs *jobs, struct mo_active *active, unsigned *budget);
/* Stores the results of a finished block and frees it. */
void mo_flight_land(struct mo_jobs *jobs, struct mo_flight *flight);
/* Cancels the flights for which only detached jobs wait; all: every flight. */
void mo_flights_cancel(struct mo_jobs *jobs, bool all);
void mo_rollout_forget(struct mo_jobs *jobs, struct mo_rollout *rollout);
/* Returns the error of lane i of a finished block. A diverged rollout has the loss +infinity. NaN
 * and −infinity must not be stored; no input should give them, so they are an error, which
 * mo_block_describe words. */
int mo_block_check(const struct mo_block *block, uint32_t i);
void mo_block_describe(int status, char text[128]);

/* ---- saver.c ---- */
int mo_pending_score(struct mo_jobs *jobs, const struct mo_saved_score *score);
int mo_pending_design(struct mo_jobs *jobs, const struct mo_saved_design *design);
int mo_pending_trajectory(struct mo_jobs *jobs, const struct mo_saved_trajectory *trajectory);
int mo_pending_update(struct mo_jobs *jobs, struct mo_active *active, enum mo_job_step step,
                      int error, const char *text);
/* Marks that something must be saved. */
void mo_pending_touch(struct mo_jobs *jobs);
/* Starts a save when one is due, or at once. Returns the time when the next one is due, INT64_MAX
 * for none. */
int64_t mo_saver_run(struct mo_jobs *jobs, bool at_once);
bool mo_saver_idle(const struct mo_jobs *jobs); /* nothing pending or in progress */
/* Returns whether unsaved recordings take so much memory that no new recording may start. */
bool mo_saver_is_full(const struct mo_jobs *jobs);
/* Returns whether the store lags so far that no new work may start. */
bool mo_saver_is_behind(const struct mo_jobs *jobs);
void mo_saver_finished(struct mo_jobs *jobs, int status);
void mo_pending_free(struct mo_pending *pending);

/* ---- controllers.c ---- */
int mo_loaded_acquire(struct mo_jobs *jobs, const struct mo_sha256 *sha256,
                      struct mo_loaded **loaded);
void mo_loaded_release(struct mo_jobs *jobs, struct mo_loaded *loaded);
void mo_loaded_free_all(struct mo_jobs *jobs);

#endif
