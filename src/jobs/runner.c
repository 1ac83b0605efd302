/* runner.c: requests to running jobs, and the common parts of all attempts of jobs with their own
 * thread: waiting for space, failing, stopping.
 *
 * A request (pause, stop, cancel) sets a flag that every long call of a run polls, and wakes a
 * thread that waits for space.
 *
 * A write that lacks disk space, memory or descriptors is retried every second (retry_ms) until it
 * succeeds or a request arrives. A stop request does not wait: the next process continues from the
 * saved state. A lack of memory outside a write ends the attempt, which frees memory for other
 * jobs; the runner repeats the attempt. Any other error also ends the attempt; the third error in a
 * row ends the job (max_attempts). */
#include "jobs/runner.h"

#include <math.h>

#include "base/clock.h"
#include "base/thread.h"
#include "jobs/controllers.h"
#include "jobs/state.h"
#include "jobs/submission.h"

#define EARLY_US INT64_C(2000000)

/* ---- requests ---- */

struct mo_runner *mo_runners_find(struct mo_runners *runners, int64_t id)
{
  for (uint32_t i = 0; i < runners->n; i++)
    if (runners->runner[i].id == id)
      return &runners->runner[i];
  return NULL;
}

void mo_runner_put_request(struct mo_runner *runner, enum mo_job_request request)
{
  if (runner->request < request)
    runner->request = request;
  __atomic_store_n(&runner->interrupt, 1, __ATOMIC_RELAXED);
}

void mo_runners_request(struct mo_runners *runners, int64_t id, enum mo_job_request request)
{
  MO_GUARD(&runners->mutex);
  struct mo_runner *runner = mo_runners_find(runners, id);
  if (runner != NULL)
    mo_runner_put_request(runner, request);
  runners->requests++;
  pthread_cond_broadcast(&runners->news);
}

void mo_runners_wake(struct mo_runners *runners)
{
  MO_GUARD(&runners->mutex);
  runners->look++;
  pthread_cond_broadcast(&runners->news);
}

enum mo_job_request mo_runner_requested(struct mo_runner *runner)
{
  MO_GUARD(&runner->runners->mutex);
  return runner->request;
}

bool mo_runner_is_interrupted(const struct mo_runner *runner)
{
  return __atomic_load_n(&runner->interrupt, __ATOMIC_RELAXED) != 0;
}

void mo_runner_sleep(struct mo_runner *runner, uint32_t ms, enum mo_job_request least)
{
  struct mo_runners *runners = runner->runners;
  const int64_t end_us = mo_clock_us() + (int64_t)ms * 1000;
  MO_GUARD(&runners->mutex);
  while (runner->request < least && !runners->stopping &&
         mo_wait_until(&runners->news, &runners->mutex, end_us))
    ;
}

/* ---- live figures ---- */

enum mo_phase mo_runner_set_waiting(struct mo_runner *runner, bool waits, enum mo_phase phase,
                                    const char *reason)
{
  MO_GUARD(&runner->runners->mutex);
  runner->waits = waits;
  enum mo_phase before = runner->live.phase;
  runner->live.phase = phase;
  snprintf(runner->live.reason, sizeof(runner->live.reason), "%s", reason);
  return before;
}

enum mo_phase mo_runner_enter(struct mo_runner *runner, enum mo_phase phase)
{
  return mo_runner_set_waiting(runner, false, phase, "");
}

const char *mo_figure(double value, char text[32])
{
  snprintf(text, 32, isfinite(value) ? "%.9g" : "null", value);
  return text;
}

/* ---- checkpoints ---- */

bool mo_checkpoint_is_due(const struct mo_job *job, int64_t since_us, uint32_t every_s)
{
  const int64_t passed_us = mo_clock_us() - since_us;
  return (every_s > 0 && passed_us >= (int64_t)every_s * 1000000) ||
         (job->attempts > 0 && passed_us >= EARLY_US);
}

/* ---- errors ---- */

int mo_runner_fail(struct mo_runner *runner, int error, const char *text)
{
  snprintf(runner->text, sizeof(runner->text), "%s", text);
  return error;
}

int mo_runner_fail_unreadable(struct mo_runner *runner, int error)
{
  snprintf(runner->text, sizeof(runner->text), "the job cannot be read: %s", mo_error_text(error));
  return error;
}

int mo_runner_give_up(struct mo_runner *runner, int error, const char *text)
{
  runner->gives_up = true;
  return mo_runner_fail(runner, error, text);
}

int mo_runner_load(struct mo_runner *runner, const struct mo_sha256 *sha256,
                   struct mo_controller **controller)
{
  const int error = mo_controller_load(runner->jobs->store, sha256, controller);
  if (mo_controller_is_unusable(error))
    mo_controller_describe_fault(sha256, "resume the job", runner->text);
  return error;
}

void mo_runner_warn(const struct mo_runner *runner, int error, const char *text)
{
  const struct mo_jobs_config *config = &runner->jobs->config;
  if (config->warn != NULL)
    config->warn(config->warn_context, runner->id, error, text);
}

/* ---- writes that wait for space ---- */

/* Returns whether the cause of the error can disappear without a request. */
static bool is_temporary(const struct mo_runner *runner, int error)
{
  return mo_is_shortage(error) && !(error == MO_ERR_NO_MEMORY && runner->is_short);
}

static const char *temporary_text(int error)
{
  switch (error) {
  case MO_ERR_NO_SPACE:
    return "no space left in the state folder for %s; free some space, and the job will continue";
  case MO_ERR_BUSY:
    return "another program has locked the database, so %s cannot be written; stop that program, "
           "and the job will continue";
  default:
    return "no memory or file descriptor for %s; the job will continue when one is available";
  }
}

int mo_runner_persist(struct mo_runner *runner, int (*write)(void *context), void *context,
                      const char *what)
{
  enum mo_job_request least = runner->winding_down ? MO_REQUEST_STOP : MO_REQUEST_PAUSE;
  enum mo_phase phase = MO_PHASE_WAIT;
  char reason[160];
  int error;
  while (is_temporary(runner, error = write(context))) {
    if (phase == MO_PHASE_WAIT) {
      if (error == MO_ERR_BUSY && runner->busy_text != NULL)
        snprintf(reason, sizeof(reason), "%s", runner->busy_text);
      else
        snprintf(reason, sizeof(reason), temporary_text(error), what);
      phase = mo_runner_set_waiting(runner, true, MO_PHASE_WAIT, reason);
      mo_runner_warn(runner, error, reason);
    }
    if (mo_runner_requested(runner) >= least) {
      error = MO_ERR_CANCELLED;
      break;
    }
    mo_runner_sleep(runner, runner->jobs->config.retry_ms, least);
  }
  if (phase != MO_PHASE_WAIT)
    (void)mo_runner_enter(runner, phase);
  return error;
}

/* ---- the end ---- */

/* Requeues the job. A paused or cancelled job keeps its state. */
static int write_park(void *context)
{
  struct mo_runner *runner = context;
  return mo_store_run_park(runner->jobs->store, runner->id, MO_OK, NULL, 0, NULL);
}

/* Ends a stopped attempt: saves computed results and requeues the job, unless it was cancelled. */
static void wind_down(struct mo_runner *runner, void *run)
{
  runner->winding_down = true;
  if (mo_runner_requested(runner) == MO_REQUEST_CANCEL)
    return;
  int error = runner->runners->kind->save(run);
  int parked = mo_runner_persist(runner, write_park, runner, "its place in the queue");
  if (error == MO_OK || error == MO_ERR_CANCELLED)
    error = parked != MO_OK ? parked : error;
  if (error != MO_OK && error != MO_ERR_CONFLICT && mo_runner_requested(runner) == MO_REQUEST_STOP)
    atomic_store(&runner->runners->unsaved, true);
  if (error != MO_OK && error != MO_ERR_CONFLICT && error != MO_ERR_CANCELLED)
    mo_runner_warn(runner, error,
                   "the work since the last save could not be saved, and will be repeated");
}

static int write_failure(void *context)
{
  const struct mo_runner *runner = context;
  struct mo_jobs *jobs = runner->jobs;
  enum mo_job_state after = MO_JOB_QUEUED;
  int error = mo_store_run_park(jobs->store, runner->id, runner->error, runner->text,
                                runner->gives_up ? 1 : MO_ATTEMPTS_MAX, &after);
  if (error == MO_OK && after == MO_JOB_FAILED) {
    atomic_fetch_add(&jobs->jobs_failed, 1);
    mo_jobs_closed(jobs, 1, 0);
  }
  return error;
}

static void fail(struct mo_runner *runner, int error)
{
  runner->winding_down = true;
  runner->error = error;
  mo_runner_warn(runner, error, runner->text);
  (void)mo_runner_persist(runner, write_failure, runner, "the record of an error");
}

bool mo_runner_end_attempt(struct mo_runner *runner, int error, void *run)
{
  const struct mo_kind *kind = runner->runners->kind;
  switch (error) {
  case MO_OK:
    atomic_fetch_add(&runner->jobs->jobs_succeeded, 1);
    mo_jobs_closed(runner->jobs, 1, 0);
    return false;
  case MO_ERR_CANCELLED: wind_down(runner, run); return false;
  case MO_ERR_DEVICE: /* no device is left, so the job is paused */
    runner->winding_down = true;
    (void)kind->save(run);
    mo_back_end_describe_loss(runner->jobs, runner->text, sizeof(runner->text));
    fail(runner, error);
    return false;
  case MO_ERR_NO_MEMORY: /* the attempt is repeated once its memory is freed */
    runner->winding_down = runner->is_short = true;
    (void)kind->save(run);
    return false;
  case MO_ERR_CONFLICT:
    /* The job was paused or cancelled while its end was being written, and keeps that state. */
    return false;
  default: break;
  }
  if (runner->text[0] == '\0')
    snprintf(runner->text, sizeof(runner->text), "the %s cannot continue: %s",
             mo_job_kind_name(kind->kind), mo_error_text(error));
  fail(runner, error);
  return true;
}
