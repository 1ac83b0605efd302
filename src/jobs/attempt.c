/* attempt.c: what all runs of jobs with their own thread have in common: waiting for space,
 * failing, stopping.
 *
 * A write that lacks disk space, memory or descriptors is tried again every second (retry_ms) until
 * it succeeds or a request arrives. A stop request does not wait: the next process continues from
 * the saved state. Lack of memory outside a write ends the attempt, which frees memory for other
 * jobs; the runner repeats the attempt. Any other error ends the attempt, too; the third one in a
 * row ends the job (max_attempts). */
#include <stdlib.h>
#include <string.h>

#include "jobs/internal.h"

int mo_attempt_fail(struct mo_attempt *attempt, int error, const char *text)
{
  snprintf(attempt->text, sizeof(attempt->text), "%s", text);
  return error;
}

int mo_attempt_fail_unreadable(struct mo_attempt *attempt, int error)
{
  snprintf(attempt->text, sizeof(attempt->text), "the job cannot be read: %s",
           mo_error_text(error));
  return error;
}

int mo_attempt_fail_controller(struct mo_attempt *attempt, int error,
                               const struct mo_sha256 *sha256)
{
  char digits[MO_SHA256_DIGITS + 1];
  mo_sha256_to_hex(sha256, digits);
  snprintf(attempt->text, sizeof(attempt->text),
           "the file controllers/%s.safetensors is missing, damaged or unreadable: store the same "
           "file again (PUT "
           "/v1/controllers/<name>), then resume the job",
           digits);
  return error;
}

void mo_attempt_warn(const struct mo_attempt *attempt, int error, const char *text)
{
  const struct mo_jobs_config *config = &attempt->jobs->config;
  if (config->warn != NULL)
    config->warn(config->warn_context, attempt->id, error, text);
}

static const struct mo_runner_kind *kind_of(const struct mo_attempt *attempt)
{
  return attempt->runner->runners->kind;
}

/* ---- writes that wait for space ---- */

/* Returns whether the error can pass without a request. */
static bool is_passing(const struct mo_attempt *attempt, int error)
{
  return error == MO_ERR_NO_SPACE || error == MO_ERR_BUSY ||
         (error == MO_ERR_NO_MEMORY && !attempt->is_short);
}

static const char *passing_text(int error)
{
  switch (error) {
  case MO_ERR_NO_SPACE:
    return "no space on the disk of the state folder for %s: make room there; it goes on by itself";
  case MO_ERR_BUSY:
    return "another program holds the database locked, %s cannot be written: end it; it goes on by "
           "itself";
  default:
    return "no memory, or no file descriptor, for %s: it goes on by itself when there is some";
  }
}

int mo_attempt_persist(struct mo_attempt *attempt, int (*write)(void *context), void *context,
                       const char *what)
{
  const struct mo_runner_kind *kind = kind_of(attempt);
  enum mo_runner_wish least = attempt->winding_down ? MO_WISH_STOP : MO_WISH_PAUSE;
  char reason[160];
  bool waits = false;
  int error, phase = kind->busy;
  for (;;) {
    error = write(context);
    if (!is_passing(attempt, error))
      break;
    if (!waits) {
      snprintf(reason, sizeof(reason), passing_text(error), what);
      phase = mo_runner_set_waiting(attempt->runner, true, kind->waiting, reason);
      mo_attempt_warn(attempt, error, reason);
      waits = true;
    }
    if (mo_runner_wished(attempt->runner) >= least) {
      error = MO_ERR_CANCELLED;
      break;
    }
    mo_runner_sleep(attempt->runner, attempt->runner->jobs->config.retry_ms, least);
  }
  if (waits)
    (void)mo_runner_set_waiting(attempt->runner, false, phase, "");
  return error;
}

/* ---- the end ---- */

/* Requeues the job. A paused or cancelled job keeps its state. */
static int write_park(void *context)
{
  struct mo_attempt *attempt = context;
  return kind_of(attempt)->park(attempt->jobs->store, attempt->id, MO_OK, NULL, 0, NULL);
}

/* Ends a stopped attempt: saves computed results and requeues the job, unless it was cancelled. */
static void wind_down(struct mo_attempt *attempt, int (*save)(void *context), void *context)
{
  int error, parked;
  attempt->winding_down = true;
  if (mo_runner_wished(attempt->runner) == MO_WISH_CANCEL)
    return;
  error = save(context);
  parked = mo_attempt_persist(attempt, write_park, attempt, "its place in the queue");
  if (error == MO_OK || error == MO_ERR_CANCELLED)
    error = parked != MO_OK ? parked : error;
  if (error != MO_OK && error != MO_ERR_CONFLICT &&
      mo_runner_wished(attempt->runner) == MO_WISH_STOP)
    atomic_store(&attempt->runner->runners->unsaved, true);
  if (error != MO_OK && error != MO_ERR_CONFLICT && error != MO_ERR_CANCELLED)
    mo_attempt_warn(attempt, error,
                    "what was done since the last save could not be saved: it will be done again");
}

static int note_failure(struct mo_jobs *jobs, const struct mo_runner_kind *kind, int64_t id,
                        int error, const char *text)
{
  enum mo_job_state after = MO_JOB_QUEUED;
  int status = kind->park(jobs->store, id, error, text, jobs->config.max_attempts, &after);
  if (status == MO_OK && after == MO_JOB_FAILED) {
    atomic_fetch_add(&jobs->failed, 1);
    mo_jobs_closed(jobs, 0);
  }
  return status;
}

static int write_failure(void *context)
{
  struct mo_attempt *attempt = context;
  return note_failure(attempt->jobs, kind_of(attempt), attempt->id, attempt->error, attempt->text);
}

/* Saves and pauses a job for which no device is left. */
static void halt(struct mo_attempt *attempt, int (*save)(void *context), void *context)
{
  attempt->winding_down = true;
  attempt->error = MO_ERR_DEVICE;
  (void)save(context);
  mo_back_end_describe_loss(attempt->jobs, attempt->text, sizeof(attempt->text));
  mo_attempt_warn(attempt, MO_ERR_DEVICE, attempt->text);
  (void)mo_attempt_persist(attempt, write_failure, attempt, "the note of an error");
}

/* Saves a job that lacks memory and lets its runner repeat the attempt once its memory is freed. */
static void make_way(struct mo_attempt *attempt, int (*save)(void *context), void *context)
{
  attempt->winding_down = attempt->is_short = true;
  (void)save(context);
  attempt->runner->is_short = true;
}

bool mo_attempt_settle(struct mo_attempt *attempt, int error, int (*save)(void *context),
                       void *context)
{
  switch (error) {
  case MO_OK:
    atomic_fetch_add(&attempt->jobs->succeeded, 1);
    mo_jobs_closed(attempt->jobs, 0);
    return false;
  case MO_ERR_CANCELLED: wind_down(attempt, save, context); return false;
  case MO_ERR_DEVICE: halt(attempt, save, context); return false;
  case MO_ERR_NO_MEMORY: make_way(attempt, save, context); return false;
  case MO_ERR_CONFLICT:
    return false; /* paused or cancelled while its end was written: keeps that state */
  default: break;
  }
  if (attempt->text[0] == '\0')
    snprintf(attempt->text, sizeof(attempt->text), "the %s cannot go on: %s",
             kind_of(attempt)->noun, mo_error_text(error));
  mo_attempt_warn(attempt, error, attempt->text);
  attempt->winding_down = true;
  attempt->error = error;
  (void)mo_attempt_persist(attempt, write_failure, attempt, "the note of an error");
  return true;
}
