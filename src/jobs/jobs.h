/* jobs.h: accepts jobs of all kinds (evaluations.h, trainings.h, campaigns.h), runs them on a
 * compute back end, and keeps their results in the store.
 *
 * Interactive jobs go first. Batch jobs share the back end by weight. Each running training or
 * campaign has its own share of worker time. All evaluations together have one share, whose weight
 * is the sum of their weights, and divide that share by weight.
 *
 * States:
 * - queued → running → succeeded | failed
 * - pause: queued, running → paused
 * - resume: paused → queued (trainings and campaigns: failed → queued, too)
 * - cancel: queued, running, paused → cancelled
 * - restart of the process: running → queued
 *
 * All functions may be called from any thread. The store reads jobs, results, events and designs:
 * store/store.h. */
#ifndef MORPHO_JOBS_JOBS_H
#define MORPHO_JOBS_JOBS_H

#include <morpho/compute.h>

#include "store/store.h"

struct mo_jobs;

/* Value of `back_end` in a request beside enum mo_back_end: devices if one works and the job suits
 * them. */
#define MO_BACK_END_AUTO (-1)

struct mo_jobs_config {
  uint32_t max_open_jobs;          /* queued, running and paused together; 0: 10000 */
  uint64_t max_open_rollouts;      /* total of all open jobs; 0: 20 million */
  uint64_t max_recorded_bytes;     /* limit of one evaluation; 0: 64 MiB */
  uint32_t max_active_batch;       /* jobs that run concurrently; 0: 8 */
  uint32_t max_active_interactive; /* 0: 64 */
  uint32_t max_active_trainings;   /* trainings that run concurrently, ≤ 16; 0: 1 */
  uint32_t max_active_campaigns;   /* campaigns that run concurrently, ≤ 64; 0: 4 */
  uint32_t window_batch;           /* blocks in flight; 0: 2 per worker */
  uint32_t window_interactive;     /* 0: 4 per worker */
  uint32_t window_device;          /* for evaluations on devices; 0: 8192 per device */
  /* Size of the cache of controllers that are ready for the back end; evicts the least recently
   * used. 0: 8. */
  uint32_t controllers_kept;
  /* After so many crashes or errors a job fails. 0: 3. */
  uint32_t max_attempts;
  /* Delay before a retry after an error or for lack of space. 0: 1000. */
  uint32_t retry_ms;
  /* Losses wait at most this long for their commit. 0: 100. */
  uint32_t save_interval_ms;
  uint64_t max_memory; /* limit of the process in bytes; 0: no limit */
  /* Product version, for the lineage of trained controllers; NULL: "". */
  const char *version;
  /* File that mo_jobs_crash_note wrote in an earlier process, or NULL. Read once, then emptied. */
  const char *crash_marker;
  /* When the last process began (wall clock), if it was killed, perhaps for lack of memory; else 0.
   * If only one running training or campaign had saved nothing since, the kill counts as a crash of
   * that job. */
  int64_t killed_us;
  /* Called for the log with every error that ends an attempt of a job, with every damaged
   * checkpoint that is skipped, and once each time that a training or campaign starts to wait for
   * disk space or memory. Runs on the scheduler's or the job's thread. Nullable. */
  void (*warn)(void *context, int64_t job, int error, const char *text);
  void *warn_context;
};

/* Requeues the jobs that ran when the last process ended and starts the scheduler. `store` and
 * `compute` must outlive *jobs. Copies the config. */
int mo_jobs_create(struct mo_store *store, struct mo_compute *compute,
                   const struct mo_jobs_config *config, struct mo_jobs **jobs,
                   struct mo_message *message);

/* Stops the service's jobs: starts no new work, cancels blocks in flight, saves computed results
 * and a checkpoint of each training, and requeues running jobs. Returns MO_OK when all is saved, or
 * MO_ERR_BUSY when `deadline_ms` passed first. The process may end in either case: nothing
 * acknowledged is lost. Submissions fail with MO_ERR_CANCELLED from now on. */
int mo_jobs_stop(struct mo_jobs *jobs, uint32_t deadline_ms);
void mo_jobs_free(struct mo_jobs *jobs); /* stops first if needed; NULL-safe */

/* ---- control: each returns after its commit. MO_ERR_NOT_FOUND; MO_ERR_CONFLICT: not possible in
 * the job's state. A request for the state that the job already has is a conflict, except pausing a
 * paused job and cancelling a cancelled one. ---- */
int mo_jobs_cancel(struct mo_jobs *jobs, int64_t id);
/* Pauses the job. Pausing a paused job changes nothing and returns MO_OK. */
int mo_jobs_pause(struct mo_jobs *jobs, int64_t id);
/* Resumes a paused job. Resuming a queued or running job changes nothing and returns MO_OK. A
 * failed training or campaign continues from its saved state with its attempts counted from 0
 * again; MO_ERR_BUSY: too many jobs are open. A job whose devices are lost, or lack memory for its
 * smallest part, is paused with MO_ERR_DEVICE and the reason; if nothing has changed when the job
 * is resumed, it is paused again. */
int mo_jobs_resume(struct mo_jobs *jobs, int64_t id);

/* Sets the weight at once, also while the job runs. MO_ERR_RANGE; MO_ERR_NOT_FOUND;
 * MO_ERR_CONFLICT: the job has ended. */
int mo_jobs_set_weight(struct mo_jobs *jobs, int64_t id, double weight);

/* ---- waiting: mo_store_subscribe reports every change (event type "job.finished", …); the
 * function below is for a thread that may block ---- */
/* Waits until the job is final or `timeout_ms` has passed, and fills *job with its last state.
 * MO_ERR_NOT_FOUND. */
int mo_jobs_wait(struct mo_jobs *jobs, int64_t id, uint32_t timeout_ms, struct mo_job *job);

/* ---- what is going on ---- */
struct mo_jobs_stats {
  uint64_t open_jobs, open_rollouts;         /* queued, running, paused */
  uint64_t active_batch, active_interactive; /* jobs being cut into blocks */
  uint64_t blocks_in_flight;
  uint64_t rollouts_computed, rollouts_cached, rollouts_shared,
      rollouts_diverged; /* since the start; shared: computed once for several jobs */
  uint64_t jobs_submitted, jobs_succeeded, jobs_failed, jobs_cancelled; /* since the start */
  uint64_t active_trainings; /* running or being prepared */
  uint64_t active_campaigns; /* running or being prepared */
  uint64_t campaign_generations,
      campaign_designs;       /* committed; born in them; since the start, as all below */
  uint64_t campaign_rollouts; /* computed for scores; campaign_cached and campaign_diverged count
                               * found and diverged rollouts of committed generations */
  uint64_t campaign_cached, campaign_diverged;
  uint64_t campaign_steps; /* learning steps */
  uint64_t training_steps, training_robots, training_diverged, training_zeroed,
      training_validations, training_checkpoints; /* since the start */
  double training_step_s;                         /* total wall time of these steps */
  double worker_s[MO_JOB_KINDS]; /* worker seconds since the start, by kind of job */
  double device_s[MO_JOB_KINDS]; /* device seconds, likewise */
  /* Monotonic time of the scheduler's last round (at least one per second). */
  int64_t heartbeat_us;
  bool no_space; /* running jobs wait for disk space; they continue without a request */
  bool stopping;
};
/* Fills *stats without waiting for computation or the store. */
void mo_jobs_get_stats(struct mo_jobs *jobs, struct mo_jobs_stats *stats);
/* Returns the number of trainings and campaigns that wait for disk space or memory now, and their
 * ids for mo_job_query, which shows them as paused while they run. */
size_t mo_jobs_waiting(struct mo_jobs *jobs, int64_t ids[MO_WAITING_MAX]);
/* Returns the worker seconds that a running training or campaign has used since its last start.
 * Negative: the job has no share now. */
double mo_jobs_busy_s(struct mo_jobs *jobs, int64_t id);

/* ---- crashes ---- */
/* For a handler of SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT: writes "<tag> <signal>\n" to `fd`, a
 * marker file that was opened beforehand. The tag is mo_compute_current_tag(), the id of the job on
 * which the faulting thread worked; on a job's own thread, the id of that job. Writes nothing on
 * threads that work for no job. Async-signal-safe. Pass the file's path as `crash_marker` at the
 * next start. */
void mo_jobs_crash_note(int fd, int signal_number);

#endif
