/* internal.h: how the scheduler keeps what is running. For this room alone.
 *
 * Everything below `scheduler's own` in mo_jobs, and every structure here, belongs to the
 * scheduler's thread. Other threads reach it through the inbox: finished blocks, wishes to stop a
 * job, results of saves.
 *
 *   active    one job that runs: its cells (design × environment) are to do, under way, or done
 *   rollout   one (genotype, controller, physics, environment) that is being computed, or computed
 * and not yet committed; every cell of every job that wants it waits at it, so it is computed once
 *   flight    one block in the back end: up to MO_BLOCK_LANES rollouts of one genotype
 *   pending   what the next save will write; one save is under way at a time */
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

/* Jobs that wait for the same: workers at once, workers, devices. Each lane has a window and a
 * virtual time of its own. */
enum mo_lane { MO_LANE_BATCH = 0, MO_LANE_INTERACTIVE = 1, MO_LANE_DEVICE = 2, MO_LANES };

enum mo_cell { MO_CELL_TO_DO = 0, MO_CELL_UNDER_WAY = 1, MO_CELL_DONE = 2 };

/* A controller loaded into the back end. */
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
  uint32_t cursor; /* no design before it has a cell to do */
  uint64_t total, done, cached, diverged;
  /* What was told of a shared job before it was claimed this time: its cells are found again in the
   * store, in any order, and what is told meanwhile never goes back. */
  uint64_t done_before, cached_before, diverged_before;
  uint64_t own_before; /* rollouts that this job computed then: found in the store, but not counted
                          as cached */
  double pass;       /* virtual time, rollout steps over weight: the job with the least goes next */
  bool private_runs; /* verify or recording: shares nothing, looks nothing up */
  bool detached;     /* cancelled, paused, failed: makes no more blocks; what comes back is counted
                        still */
  bool failing;      /* detached, and the note of it is not committed yet */
  bool finishing;    /* its end is in a save */
  bool changed;      /* counts differ from the last save's */
  int64_t last_event_us;
  uint32_t references; /* waiting cells and saves that name it */
  struct mo_active *next;
};

struct mo_waiter {
  struct mo_active *active;
  size_t cell;
  bool owner; /* the block was made for this cell */
  struct mo_waiter *next;
};

struct mo_rollout {
  int64_t genotype, controller, physics, environment;
  struct mo_flight *flight; /* NULL: computed, waits for its commit */
  double loss;
  int32_t diverged_step;
  struct mo_waiter *waiters;
  struct mo_rollout *next;      /* in its bucket */
  struct mo_rollout *next_save; /* in pending or in the save under way */
};

struct mo_flight {
  struct mo_block block;
  struct mo_jobs *jobs;
  struct mo_rollout *rollouts[MO_BLOCK_LANES];
  struct mo_bits genotype;
  volatile int cancel;
  uint64_t serial;
  /* Private runs: whose, which cells, and what they record. */
  struct mo_active *owner;
  size_t cells[MO_BLOCK_LANES];
  struct mo_body *body;
  struct mo_recording recordings[MO_BLOCK_LANES];
  uint32_t frames;
  struct mo_flight *next, *previous; /* among all flights */
  struct mo_flight *next_inbox;      /* among the finished */
};

/* Growing arrays of one save. */
struct mo_pending {
  struct mo_save save;
  size_t scores_room, trajectories_room, designs_room, updates_room, owners_room;
  struct mo_active **owners;   /* (save.n_updates) whose updates they are; each holds a reference */
  struct mo_rollout *rollouts; /* that end with the commit */
  uint64_t recorded_bytes;
  int64_t since_us; /* when the first thing came in; 0: empty */
  bool urgent;
};

struct mo_wish {
  int64_t id;
  bool cancel; /* blocks that nobody else waits for are broken off */
  bool weigh;  /* only its weight has changed */
  struct mo_wish *next;
};

/* The part of the back end of a running training or campaign. */
struct mo_job_share {
  int64_t id;
  enum mo_job_kind kind;
  struct mo_compute_share *share;
  struct mo_job_share *next;
};

/* ---- runners: jobs that have a thread of their own (runners.c, attempt.c) ---- */

/* What a running job is asked to do; the larger one counts. */
enum mo_runner_wish { MO_WISH_NONE = 0, MO_WISH_PAUSE, MO_WISH_STOP, MO_WISH_CANCEL };

struct mo_runner;
struct mo_attempt;

/* What one kind of such jobs has of its own. */
struct mo_runner_kind {
  const char *noun; /* "training" */
  int64_t (*queued)(struct mo_store *store, int64_t *ids, size_t limit);
  int (*start)(struct mo_store *store, int64_t id);
  int (*park)(struct mo_store *store, int64_t id, int error, const char *error_text,
              uint32_t max_attempts, enum mo_job_state *after);
  /* Runs a job that was started, to its end or until a wish; tells the store what came of it.
   * Returns whether it ended an attempt with an error. */
  bool (*run)(struct mo_runner *runner, int64_t id);
  void (*begin)(struct mo_runner
                    *runner); /* sets the live figures of a job that was claimed; under the mutex */
  /* Changes the phase that the live figures show, with a reason for waiting; returns the one
   * before. */
  int (*set_phase)(struct mo_attempt *attempt, int phase, const char *reason);
  int waiting, busy; /* phases: waits for room; what it returns to at least */
};

/* A thread that runs one job after the other. Fields under the mutex of its runners, but for the
 * flags that the back end reads. */
struct mo_runner {
  struct mo_jobs *jobs;
  struct mo_runners *runners;
  pthread_t thread;
  bool thread_started;
  int64_t id; /* 0: it runs none */
  enum mo_runner_wish wish;
  bool waits; /* for room */
  union {
    struct mo_training_live training;
    struct mo_campaign_live campaign;
  } live;
  volatile int interrupt;     /* set with every wish */
  volatile uint64_t replayed; /* of a training: written by draws of bodies that were drawn before */
};

/* All threads for one kind of jobs. */
struct mo_runners {
  const struct mo_runner_kind *kind;
  pthread_mutex_t mutex;
  pthread_cond_t news;      /* wishes, queued jobs, ends of threads */
  struct mo_runner *runner; /* (n) */
  uint32_t n;
  uint32_t alive; /* threads that have not ended */
  uint64_t look;  /* grows when there may be queued jobs */
  bool stopping;
  atomic_bool unsaved; /* one was stopped for which there was no room */
  atomic_uint_fast64_t active;
};

/* A runner's attempt at a job; first member of what a kind knows of it. */
struct mo_attempt {
  struct mo_jobs *jobs;
  struct mo_runner *runner;
  int64_t id;
  bool winding_down; /* a wish has come, or it has failed: only what is computed is saved */
  int error;
  char text[256]; /* of the error */
};

struct mo_jobs { /* NOLINT(clang-analyzer-optin.performance.Padding): grouped by who may touch what
                  */
  struct mo_store *store;
  struct mo_compute *compute;
  struct mo_jobs_config config;
  struct mo_lattice *lattice;
  int64_t fingerprints[2];    /* by precision */
  int64_t device_fingerprint; /* 0: there are no devices */
  int listener;

  /* Admission. */
  pthread_mutex_t admission_mutex;
  atomic_uint_fast64_t open_jobs, open_rollouts; /* changed under the mutex */

  /* Waiting threads. */
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
  bool abandon; /* stop waiting for saves that do not succeed */
  pthread_cond_t stop_done;

  /* Shares. */
  pthread_mutex_t weigh_mutex; /* taken before shares_mutex: a weight is read from the store and set
                                  in one go */
  pthread_mutex_t shares_mutex; /* for moments */
  struct mo_job_share *shares;
  double ended_s[MO_JOB_KINDS];         /* worker seconds of shares that are gone */
  double ended_device_s[MO_JOB_KINDS];  /* of devices */
  struct mo_compute_share *evaluations; /* of all evaluations together */
  double evaluations_weight;            /* the scheduler's */

  struct mo_runners trainings, campaigns;
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
  uint64_t serial, use_clock;
  struct mo_rollout *buckets[MO_ROLLOUT_BUCKETS];
  struct mo_loaded *controllers;
  struct mo_pending pending, saving;
  double pass[MO_LANES]; /* virtual time */
  bool save_under_way;
  int64_t retry_save_us; /* when to try again after want of space */
  bool broken;           /* the store is lost: nothing more is done */
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

int64_t mo_jobs_clock_us(void); /* monotonic */

/* ---- submit.c ---- */
/* Places every genotype and finds its canonical form. MO_ERR_INVALID with the first that is none.
 */
int mo_designs_place(const struct mo_bits *asked, uint32_t n, struct mo_bits *forms,
                     struct mo_bits *genotypes, struct mo_message *message);
int mo_jobs_admit(struct mo_jobs *jobs, uint64_t rollouts,
                  struct mo_message *message);                  /* MO_ERR_BUSY */
int mo_weight_check(double weight, struct mo_message *message); /* MO_ERR_RANGE; 0 is none */
int mo_submission_explain(int error, const char *controller,
                          struct mo_message *message); /* what the store said */
/* 1 to MO_ENVIRONMENTS_MAX of them, each fit to be simulated in. MO_ERR_INVALID, MO_ERR_RANGE.
 * whose: "an evaluation". */
int mo_environments_check(const struct mo_environment *environments, uint32_t n, const char *whose,
                          struct mo_message *message);
int mo_submission_check_texts(const char *label, const char *idempotency_key,
                              struct mo_message *message);

/* ---- runners.c ---- */
void mo_runners_init(struct mo_runners *runners, const pthread_condattr_t *monotonic);
void mo_runners_destroy(struct mo_runners *runners);
int mo_runners_start(struct mo_jobs *jobs, struct mo_runners *runners,
                     const struct mo_runner_kind *kind, uint32_t n);
void mo_runners_stop(struct mo_runners *runners); /* asks; does not wait */
bool mo_runners_wait(struct mo_runners *runners,
                     const struct timespec *deadline); /* true: all have ended */
void mo_runners_free(struct mo_runners *runners);      /* stops, waits, frees the threads */
void mo_runners_wake(struct mo_runners *runners);
void mo_runners_wish(struct mo_runners *runners, int64_t id, enum mo_runner_wish wish);
/* The runner of a job, NULL: none; under the mutex. */
struct mo_runner *mo_runners_find(struct mo_runners *runners, int64_t id);
enum mo_runner_wish mo_runner_wished(struct mo_runner *runner);
bool mo_runner_is_interrupted(const struct mo_runner *runner);
/* Sleeps until the time is over or a wish of at least `least` has come. */
void mo_runner_sleep(struct mo_runner *runner, uint32_t ms, enum mo_runner_wish least);

/* ---- attempt.c ---- */
/* Notes the text that an error is to be told with, and returns the error. */
int mo_attempt_fail(struct mo_attempt *attempt, int error, const char *text);
/* As mo_attempt_fail, for a job that the store could not read: its damage, if that was it. */
int mo_attempt_fail_unreadable(struct mo_attempt *attempt, int error, const struct mo_job *job);
/* As mo_attempt_fail, for a file of weights that cannot be used. */
int mo_attempt_fail_controller(struct mo_attempt *attempt, int error,
                               const struct mo_sha256 *sha256);
void mo_attempt_warn(const struct mo_attempt *attempt, int error, const char *text);
/* Runs `write` until it is done or fails for a reason that does not pass by itself: want of room is
 * waited for, and told as `what` that cannot be written. MO_ERR_CANCELLED: a wish came first. */
int mo_attempt_persist(struct mo_attempt *attempt, int (*write)(void *context), void *context,
                       const char *what);
/* The end of an attempt with `error`. MO_ERR_CANCELLED: a wish has come; `save` saves what is
 * computed. Returns whether it failed. */
bool mo_attempt_settle(struct mo_attempt *attempt, int error, int (*save)(void *context),
                       void *context);
/* There is not even memory for an attempt: it is noted as soon as it can be. */
void mo_attempt_give_up(struct mo_runner *runner, int64_t id);

/* ---- shares.c ---- */
/* For the thread that runs a training or a campaign: a share of the job's weight, which follows
 * that weight until it is closed. Name it in every block and batch of the job. MO_ERR_NO_MEMORY,
 * and what reading the job gives. */
int mo_share_open(struct mo_jobs *jobs, int64_t id, enum mo_job_kind kind,
                  struct mo_compute_share **share);
void mo_share_close(
    struct mo_jobs *jobs,
    int64_t id); /* when none of its blocks is queued or running; no share: nothing */
void mo_share_reweigh(struct mo_jobs *jobs, int64_t id); /* the weight in the store has changed */
void mo_shares_seconds(struct mo_jobs *jobs, double worker_s[MO_JOB_KINDS],
                       double device_s[MO_JOB_KINDS]);

/* ---- learner.c ---- */
/* A training with what the back end needs for its gradients. */
struct mo_learner {
  struct mo_training *training;
  struct mo_gradient_state *gradients;
  enum mo_back_end back_end; /* set by mo_learner_prepare */
  /* The gradient that is computed, or to be applied: batch.computed_on says who computed it. */
  struct mo_gradient_batch batch;
  int status;
  bool computes, draws; /* threads of this step */
  pthread_t computing, drawing;
  int64_t start_us;
  double *d_parameters;
  struct mo_outcome *outcomes;
};
/* Everything but the training, for it; to be called again when another of the same controller and
 * batch takes its place. MO_ERR_NO_MEMORY. */
int mo_learner_prepare(struct mo_jobs *jobs, enum mo_back_end back_end, struct mo_learner *learner);
/* The training's own, where what is laid out ahead has to be forgotten. */
int mo_learner_set_designs(struct mo_learner *learner, const uint64_t *designs, uint32_t n,
                           struct mo_message *message);
/* A step: the gradient of the robots that were drawn, then their application. `write` writes what
 * is due of the steps before, and may read the state of the training. On devices it is called while
 * they compute, and the robots of the step after are drawn then; workers, on which a gradient takes
 * a hundred times as long and which would not gain by it, begin after it, if it succeeded. Its
 * error comes before that of the gradient. seconds: of the whole step. */
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
void mo_learner_free(struct mo_learner *learner); /* the training, too */

/* ---- campaign_run.c ---- */
extern const struct mo_runner_kind mo_campaign_runners;

/* ---- training_run.c ---- */
extern const struct mo_runner_kind mo_training_runners;

/* ---- training_held_out.c ---- */
int mo_held_out_load(struct mo_store *store, const struct mo_training_status *status,
                     struct mo_held_out *held_out);
/* Scores it with weights as they are. MO_ERR_CANCELLED; MO_ERR_NO_MEMORY and other errors of
 * blocks. */
int mo_held_out_score(struct mo_jobs *jobs, const struct mo_held_out *held_out,
                      const struct mo_controller *controller, const struct mo_physics *physics,
                      enum mo_back_end back_end, int64_t tag, struct mo_compute_share *share,
                      const volatile int *cancel, struct mo_training_validation_row *row);

/* ---- back_end.c ---- */
/* Where a job is computed: what was asked for, or chosen. suits: devices can do it; is_large: they
 * are worth it. MO_ERR_DEVICE. */
int mo_back_end_choose(const struct mo_jobs *jobs, int asked, bool suits, bool is_large,
                       enum mo_back_end *back_end, struct mo_message *message);
/* MO_ERR_DEVICE: devices are to compute it, and none works. Asked before a job is taken up: what it
 * draws again may take minutes. */
int mo_back_end_check(const struct mo_jobs *jobs, enum mo_back_end back_end);
/* What an error of a block or a gradient means for its job: want of memory of devices pauses it as
 * their loss does, for it may last. */
int mo_back_end_error(enum mo_back_end back_end, int error);
/* Why a job that devices compute is paused, lost or without memory, and what to do. */
void mo_back_end_describe_loss(struct mo_jobs *jobs, char *text, size_t size);
/* The row of what computes scores of a job in float32. */
int64_t mo_back_end_fingerprint(const struct mo_jobs *jobs, enum mo_back_end back_end);
/* Blocks to be kept submitted by one job. */
uint32_t mo_back_end_window(const struct mo_jobs *jobs, enum mo_back_end back_end);

/* ---- scheduler.c ---- */
enum mo_lane mo_lane_of(enum mo_urgency priority, enum mo_back_end back_end);
void *mo_scheduler_loop(void *jobs);
void mo_jobs_wake(struct mo_jobs *jobs);
void mo_jobs_closed(struct mo_jobs *jobs, uint64_t rollouts); /* a job is no longer open */
int mo_jobs_recount(struct mo_jobs *jobs); /* open jobs and rollouts, from the store */
void mo_active_release(struct mo_jobs *jobs, struct mo_active *active);
/* The job goes back to the queue, with one attempt more; with MO_ERR_DEVICE it is paused. */
void mo_active_fail(struct mo_jobs *jobs, struct mo_active *active, int error, const char *text);
void mo_actives_free_all(struct mo_jobs *jobs);
struct mo_active *mo_active_find(struct mo_jobs *jobs, int64_t id);

/* ---- blocks.c ---- */
/* Looks at designs of `active` until a block is submitted (1), `budget` designs were answered from
 * the store (0), or none is to do (−1). */
int mo_active_advance(struct mo_jobs *jobs, struct mo_active *active, unsigned *budget);
/* Takes in a finished block and frees it. */
void mo_flight_land(struct mo_jobs *jobs, struct mo_flight *flight);
/* Breaks off the flights that only detached jobs wait for; all: every flight. */
void mo_flights_cancel(struct mo_jobs *jobs, bool all);
void mo_rollout_forget(struct mo_jobs *jobs, struct mo_rollout *rollout);
/* What came of lane i of a finished block. A diverged rollout has the loss +infinity; no input may
 * give NaN or −infinity, and neither may be stored: an error as any other, which mo_block_describe
 * puts in words. */
int mo_block_check(const struct mo_block *block, uint32_t i);
void mo_block_describe(int status, char text[128]);

/* ---- saver.c ---- */
int mo_pending_score(struct mo_jobs *jobs, const struct mo_saved_score *score);
int mo_pending_design(struct mo_jobs *jobs, const struct mo_saved_design *design);
int mo_pending_trajectory(struct mo_jobs *jobs, const struct mo_saved_trajectory *trajectory);
int mo_pending_update(struct mo_jobs *jobs, struct mo_active *active, enum mo_job_step step,
                      int error, const char *text);
void mo_pending_touch(struct mo_jobs *jobs); /* something is to be saved */
/* Starts a save when one is due, or at once. Returns the clock time at which one will be due,
 * INT64_MAX for none. */
int64_t mo_saver_run(struct mo_jobs *jobs, bool at_once);
bool mo_saver_idle(const struct mo_jobs *jobs); /* nothing pending, nothing under way */
/* The store does not keep up: nothing new is to be computed until it does. */
bool mo_saver_is_behind(const struct mo_jobs *jobs);
void mo_saver_finished(struct mo_jobs *jobs, int status);
void mo_pending_free(struct mo_pending *pending);

/* ---- controllers.c ---- */
int mo_loaded_acquire(struct mo_jobs *jobs, const struct mo_sha256 *sha256,
                      struct mo_loaded **loaded);
void mo_loaded_release(struct mo_jobs *jobs, struct mo_loaded *loaded);
void mo_loaded_free_all(struct mo_jobs *jobs);

#endif
