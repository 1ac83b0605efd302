/* jobs.h: accepts jobs of all kinds (evaluations.h, trainings.h, campaigns.h, atlases.h,
 * certificates.h), runs them on a compute back end, and keeps their results in the store.
 *
 * Interactive jobs go first. Batch jobs share the back end by weight: each running job has its own
 * share of worker time.
 *
 * States:
 * - queued → running → succeeded | failed
 * - pause: queued, running → paused
 * - resume: paused → queued (all kinds but evaluations: also failed → queued)
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

/* Value of `back_end` in a request in addition to enum mo_back_end: devices, if one works and they
 * can compute the job. */
#define MO_BACK_END_AUTO (-1)

struct mo_jobs_config {
  uint32_t max_open_jobs;        /* queued, running and paused together; 0: 10000 */
  uint64_t max_open_rollouts;    /* total over all open jobs; 0: 20 million */
  uint64_t max_recorded_bytes;   /* limit of one evaluation; 0: 64 MiB */
  uint32_t max_active_trainings; /* training jobs that run concurrently, ≤ 16; 0: 1 */
  uint32_t max_active_campaigns; /* campaigns that run concurrently, ≤ 64; 0: 4 */
  /* Delay before a retry after an error or for lack of space. 0: 1000. */
  uint32_t retry_ms;
  uint64_t max_memory; /* limit of the process in bytes; 0: no limit */
  /* Product version, for the lineage of trained controllers; outlives the service. NULL: "". */
  const char *version;
  /* File that mo_jobs_crash_note wrote in an earlier process, or NULL. Read once, then emptied. */
  const char *crash_marker;
  /* When the last process began (wall clock), if it was killed, possibly for lack of memory;
   * otherwise 0. If exactly one of the running training jobs and campaigns had saved nothing since
   * then, the kill counts as a crash of that job. */
  int64_t killed_us;
  /* Called for the log with every error that ends an attempt of a job, with every damaged
   * checkpoint that is skipped, and once each time that a training job or campaign starts to wait
   * for disk space or memory. Runs on the scheduler's or the job's thread. Nullable. */
  void (*warn)(void *context, int64_t job, int error, const char *text);
  void *warn_context;
};

/* Requeues the jobs that were running when the last process ended, and starts the scheduler.
 * `store` and `compute` must outlive *jobs. Copies the config. */
int mo_jobs_create(struct mo_store *store, struct mo_compute *compute,
                   const struct mo_jobs_config *config, struct mo_jobs **jobs,
                   struct mo_message *message);

/* Stops the service's jobs: starts no new work, cancels blocks in flight, saves computed results
 * and a checkpoint of each training run, and requeues running jobs. Returns MO_OK when everything
 * is saved, or MO_ERR_BUSY if `deadline_ms` passes first. The process may end in either case:
 * nothing acknowledged is lost. Submissions fail with MO_ERR_CANCELLED from now on. */
int mo_jobs_stop(struct mo_jobs *jobs, uint32_t deadline_ms);
void mo_jobs_free(struct mo_jobs *jobs); /* stops first if needed; NULL-safe */

/* Sets the class of devices that only workers on other machines have. The first class that is set
 * in a process is kept. MO_ERR_CONFLICT: a different class is set, or the service itself has
 * devices; MO_ERR_LIMIT: too long; errors of the store. */
int mo_jobs_name_devices(struct mo_jobs *jobs, const char *scores, const char *gradients);

/* ---- control: each returns after its commit. MO_ERR_NOT_FOUND; MO_ERR_CONFLICT: not possible in
 * the job's state. A request for the state that the job already has is a conflict, except pausing a
 * paused job and cancelling a cancelled one. ---- */
int mo_jobs_cancel(struct mo_jobs *jobs, int64_t id);
/* Pauses the job. Pausing a paused job changes nothing and returns MO_OK. */
int mo_jobs_pause(struct mo_jobs *jobs, int64_t id);
/* Resumes a paused job. Resuming a queued or running job changes nothing and returns MO_OK. A
 * failed training run or campaign continues from its saved state, and its attempts are counted from
 * 0 again. MO_ERR_BUSY: too many jobs are open. A job whose devices are lost, or lack memory for
 * its smallest part, is paused with MO_ERR_DEVICE and the reason; if nothing has changed when the
 * job is resumed, it is paused again. */
int mo_jobs_resume(struct mo_jobs *jobs, int64_t id);

/* Sets the weight at once, even while the job runs. MO_ERR_NOT_FOUND; MO_ERR_CONFLICT: the job has
 * ended. */
int mo_jobs_set_weight(struct mo_jobs *jobs, int64_t id, double weight);

/* Changes the label, note and other data that clients attach to a job, even while it runs.
 * MO_ERR_NOT_FOUND. */
int mo_jobs_edit(struct mo_jobs *jobs, int64_t id, const struct mo_job_edit *edit);

/* ---- activity ---- */
/* Returns the lattice of the service's workspace, for all of its bodies; valid as long as
 * `jobs`. */
const struct mo_lattice *mo_jobs_lattice(const struct mo_jobs *jobs);

/* After this many crashes or errors a job fails. */
#define MO_ATTEMPTS_MAX 3

/* Counters. Active jobs are those being cut into blocks. All counts are since the start, except the
 * counts of open jobs and blocks. Shared rollouts were computed once for several evaluations.
 * campaign_rollouts: computed for scores; campaign_cached and campaign_diverged: found and diverged
 * rollouts of committed generations; campaign_designs: designs born in these generations. */
/* clang-format off */
#define MO_JOBS_COUNTS(X)                                                                          \
  X(open_jobs) X(open_rollouts) X(active_batch) X(active_interactive) X(blocks_in_flight)          \
  X(rollouts_computed) X(rollouts_cached) X(rollouts_shared) X(rollouts_diverged)                  \
  X(jobs_submitted) X(jobs_succeeded) X(jobs_failed) X(jobs_cancelled) X(campaign_generations)     \
  X(campaign_designs) X(campaign_rollouts) X(campaign_cached) X(campaign_diverged)                 \
  X(campaign_steps) X(training_steps) X(training_robots) X(training_diverged) X(training_zeroed)   \
  X(training_validations) X(training_checkpoints) X(atlas_bodies) X(atlas_rollouts)                \
  X(certificate_rollouts)
/* clang-format on */
struct mo_jobs_stats {
#define MO_JOBS_COUNT(name) uint64_t name;
  MO_JOBS_COUNTS(MO_JOBS_COUNT)
#undef MO_JOBS_COUNT
  /* Running or being prepared. */
  uint64_t active_trainings, active_campaigns, active_atlases, active_certificates;
  double training_step_s;        /* total wall time of training_steps */
  double worker_s[MO_JOB_KINDS]; /* worker seconds since the start, by kind of job */
  double device_s[MO_JOB_KINDS]; /* device seconds since the start, by kind of job */
  /* Monotonic time of the scheduler's last round (at least one per second). */
  int64_t heartbeat_us;
  bool no_space; /* running jobs wait for disk space; they continue without a request */
};
/* Fills *stats without waiting for computation or the store. */
void mo_jobs_get_stats(struct mo_jobs *jobs, struct mo_jobs_stats *stats);
/* Returns the number of training runs, campaigns, atlases and certificates that are waiting for
 * disk space or memory, and writes their ids for mo_job_query, which shows them as paused although
 * they are running. */
size_t mo_jobs_waiting(struct mo_jobs *jobs, int64_t ids[MO_WAITING_MAX]);

/* ---- crashes ---- */
/* For a handler of SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT: writes "<tag> <signal>\n" to `fd`, a
 * marker file that was opened beforehand. The tag is mo_thread_tag, the id of the job that the
 * faulting thread was working on. Writes nothing on threads that do not work for a job.
 * Async-signal-safe. Pass the file's path as `crash_marker` at the next start. */
void mo_jobs_crash_note(int fd, int signal_number);

#endif
