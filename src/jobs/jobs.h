/* jobs.h: accepts evaluations and trainings (jobs/trainings.h), runs them on a compute back end,
 * keeps their results in the store.
 *
 * A scheduler thread claims queued jobs, cuts them into blocks (one design, up to MO_BLOCK_LANES
 * environments), keeps a small window of blocks in flight in the back end, and saves losses in
 * grouped writes as they come. Interactive jobs go first. Batch work shares the back end by weight:
 * every running training and campaign has a share of worker time of its own, all evaluations
 * together have one, whose weight is the sum of theirs, and divide it by weight among them. A score
 * that the store holds, or that another job is computing, is not computed again. What a crash costs
 * is the blocks in flight.
 *
 * States:  queued → running → succeeded | failed         pause:  queued, running → paused resume:
 * paused → queued cancel: queued, running, paused → cancelled    restart: running → queued
 * (trainings, campaigns: failed, too) All functions may be called from any thread. Reading (jobs,
 * results, events, designs) is the store's: store/store.h. */
#ifndef MORPHO_JOBS_JOBS_H
#define MORPHO_JOBS_JOBS_H

#include <morpho/compute.h>

#include "store/store.h"

struct mo_jobs;

struct mo_jobs_config {
  uint32_t max_open_jobs;          /* queued, running and paused together; 0: 10000 */
  uint64_t max_open_rollouts;      /* of all open jobs; 0: 20 million */
  uint64_t max_recorded_bytes;     /* of one evaluation; 0: 64 MiB */
  uint32_t max_active_batch;       /* jobs that run side by side; 0: 8 */
  uint32_t max_active_interactive; /* 0: 64 */
  uint32_t max_active_trainings;   /* trainings that run side by side, ≤ 16; 0: 1 */
  uint32_t max_active_campaigns;   /* campaigns that run side by side, ≤ 64; 0: 4 */
  uint32_t window_batch;           /* blocks in flight; 0: 2 per worker */
  uint32_t window_interactive;     /* 0: 4 per worker */
  uint32_t window_device;          /* of evaluations that devices compute; 0: 8192 per device */
  uint32_t
      controllers_kept;  /* controllers kept ready for the back end, least recently used go; 0: 8 */
  uint32_t max_attempts; /* crashes or errors until a job is parked as failed; 0: 3 */
  uint32_t retry_ms;     /* between an error, or want of room, and the next try; 0: 1000 */
  uint32_t save_interval_ms; /* losses wait at most this long for their commit; 0: 100 */
  const char *version;       /* of the product, for the lineage of trained controllers; NULL: "" */
  const char *crash_marker;  /* file that mo_jobs_crash_note wrote in an earlier life; NULL: none.
                                Read, then emptied */
  /* Told, for the log, of every error that ends an attempt of a job, of a damaged checkpoint that
   * is passed over, and of a training that waits for room (once each time); on the scheduler's or a
   * training's thread. Nullable. */
  void (*warn)(void *context, int64_t job, int error, const char *text);
  void *warn_context;
};

/* `store` and `compute` must outlive it. Requeues what ran when the last process ended; starts the
 * scheduler. The config is copied. */
int mo_jobs_create(struct mo_store *store, struct mo_compute *compute,
                   const struct mo_jobs_config *config, struct mo_jobs **jobs,
                   struct mo_message *message);

/* Parks: nothing new starts, blocks in flight are cancelled, what is computed is saved, trainings
 * write a checkpoint, running jobs become queued. Returns MO_OK when all is saved, MO_ERR_BUSY when
 * `deadline_ms` passed first (the process may end all the same: nothing acknowledged is lost).
 * Submissions give MO_ERR_CANCELLED from now on. */
int mo_jobs_stop(struct mo_jobs *jobs, uint32_t deadline_ms);
void mo_jobs_free(struct mo_jobs *jobs); /* stops first when that was not done; NULL-safe */

/* ---- submission ---- */

/* Where a job is to be computed: enum mo_back_end, or this: on devices if one works and they suit
 * it. Of an evaluation that is a batch in float32 of at least MO_DEVICE_ROLLOUTS_MIN rollouts that
 * neither records nor verifies. */
#define MO_BACK_END_AUTO       (-1)
#define MO_DEVICE_ROLLOUTS_MIN 1000

struct mo_evaluation_request {
  const struct mo_bits *genotypes;           /* (n_designs) as asked for: valid; placed here */
  uint32_t n_designs;                        /* 1 … MO_DESIGNS_MAX */
  const char *environment_set;               /* "paper-test", or NULL: `environments` */
  const struct mo_environment *environments; /* (n_environments) checked */
  uint32_t n_environments;                   /* 1 … MO_ENVIRONMENTS_MAX; ignored with a set */
  const char *controller;                    /* name or "sha256:<64 hex>"; NULL: "default" */
  struct mo_physics physics;                 /* checked */
  enum mo_precision precision;
  int priority; /* enum mo_urgency, or −1: interactive up to 64 rollouts that are not for devices */
  int back_end;      /* enum mo_back_end or MO_BACK_END_AUTO */
  double weight;     /* MO_WEIGHT_MIN … MO_WEIGHT_MAX; 0: 1 */
  const char *label; /* nullable */
  bool verify, record_com, record_masses;
  uint32_t record_stride;       /* 1 … n_steps; ignored when nothing is recorded */
  const char *idempotency_key;  /* nullable; ≤ MO_IDEMPOTENCY_BYTES_MAX */
  struct mo_sha256 body_sha256; /* of the request's bytes; used with a key */
};
/* Returns after the commit. *id: the job. *replayed: the key was known with the same body, *id is
 * the earlier job. MO_ERR_NOT_FOUND  no such controller or set           MO_ERR_CONFLICT  the key
 * was used with another body MO_ERR_BUSY       the queue is full: try again later   MO_ERR_LIMIT
 * would record more than max_recorded_bytes MO_ERR_NO_SPACE   the disk is full: try again later
 * MO_ERR_CANCELLED stopping MO_ERR_UNSUPPORTED the controller is for another workspace
 *   MO_ERR_DEVICE     no device works, or devices do not do this (float64, recordings, interactive)
 * MO_ERR_INVALID, MO_ERR_RANGE: a value breaks this contract; `message` says which. */
int mo_jobs_submit_evaluation(struct mo_jobs *jobs, const struct mo_evaluation_request *request,
                              int64_t *id, bool *replayed, struct mo_message *message);

/* ---- control: each returns after its commit. MO_ERR_NOT_FOUND; MO_ERR_CONFLICT: not possible in
 * the job's state. Asking for the state that the job is in already (pause of a paused job, cancel
 * of a cancelled one excepted) is a conflict. ---- */
int mo_jobs_cancel(struct mo_jobs *jobs, int64_t id); /* also one that cannot be read */
int mo_jobs_pause(struct mo_jobs *jobs,
                  int64_t id); /* pausing a paused job: MO_OK, nothing changes */
/* A job whose devices are lost, or have no memory for its smallest part, is paused, with
 * MO_ERR_DEVICE and the reason; so it is again when it is resumed and nothing has changed. Resuming
 * a queued or running job: MO_OK, nothing changes. A training or campaign that has failed goes on
 * from what it has saved, with its attempts counted anew; MO_ERR_BUSY: too many jobs are open. */
int mo_jobs_resume(struct mo_jobs *jobs, int64_t id);

/* Counts at once, also while the job runs. MO_ERR_RANGE; MO_ERR_NOT_FOUND; MO_ERR_CONFLICT: the job
 * is over. */
int mo_jobs_set_weight(struct mo_jobs *jobs, int64_t id, double weight);

/* ---- waiting: mo_store_subscribe tells of every change (event type "job.finished", …). For a
 * thread that may block: ---- */
/* Waits until the job is final or `timeout_ms` passed; fills *job with its last state.
 * MO_ERR_NOT_FOUND. */
int mo_jobs_wait(struct mo_jobs *jobs, int64_t id, uint32_t timeout_ms, struct mo_job *job);

/* ---- what is going on ---- */
struct mo_jobs_stats {
  uint64_t open_jobs, open_rollouts;         /* queued, running, paused */
  uint64_t active_batch, active_interactive; /* jobs being cut into blocks */
  uint64_t blocks_in_flight;
  uint64_t rollouts_computed, rollouts_cached, rollouts_shared,
      rollouts_diverged; /* since the start; shared: computed once for
                                        several jobs */
  uint64_t jobs_submitted, jobs_succeeded, jobs_failed, jobs_cancelled; /* since the start */
  uint64_t active_trainings; /* running or being prepared */
  uint64_t active_campaigns; /* running or being prepared */
  uint64_t campaign_generations,
      campaign_designs;       /* committed; born in them; since the start, as all below */
  uint64_t campaign_rollouts; /* for scores, computed; campaign_cached, _diverged: of committed
                                 generations, found, diverged */
  uint64_t campaign_cached, campaign_diverged;
  uint64_t campaign_steps; /* of learning */
  uint64_t training_steps, training_robots, training_diverged, training_zeroed,
      training_validations, training_checkpoints; /* since the start */
  double training_step_s;                         /* sum of the wall time of these steps */
  double worker_s[MO_JOB_KINDS]; /* worker seconds since the start, by kind of job */
  double device_s[MO_JOB_KINDS]; /* seconds of devices, likewise */
  int64_t
      heartbeat_us; /* monotonic clock: when the scheduler last came round (at least once per s) */
  bool no_space;    /* running jobs wait for room on the disk; they go on by themselves */
  bool stopping;
};
void mo_jobs_get_stats(struct mo_jobs *jobs,
                       struct mo_jobs_stats *stats); /* waits for no computing and no store */
/* Trainings and campaigns that wait for room now, for mo_job_query: while they run they are shown
 * as paused. Returns their number. */
size_t mo_jobs_waiting(struct mo_jobs *jobs, int64_t ids[MO_WAITING_MAX]);
/* Worker seconds that a running training or campaign has had since it was last started; < 0: it has
 * no share now. */
double mo_jobs_busy_s(struct mo_jobs *jobs, int64_t id);

/* ---- crashes ---- */
/* For a handler of SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT: writes "<tag> <signal>\n" to `fd`, a
 * marker file that was opened beforehand, where tag is mo_compute_current_tag(), the id of the job
 * that the faulting thread was working on (of a training's own thread: that training). Writes
 * nothing on threads that work for no job. Async-signal-safe. Pass the file's path as
 * `crash_marker` at the next start. */
void mo_jobs_crash_note(int fd, int signal_number);

#endif
