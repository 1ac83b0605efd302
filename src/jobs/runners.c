/* runners.c: the threads that run jobs one after another.
 *
 * Each kind has one thread for each job that may run concurrently. A free thread takes the first
 * queued job that no other thread holds. A run that lacks memory or descriptors has not failed; its
 * thread repeats it later. */
#include <stdlib.h>

#include "base/thread.h"
#include "base/words.h"
#include "jobs/evaluation.h"
#include "jobs/state.h"

/* Queued jobs per look-up: one more than the largest number of threads of a kind. */
#define CLAIMS_MAX   65
#define LONGEST_WAIT 30 /* for memory, in multiples of retry_ms */

/* ---- claiming ---- */

/* Prepares the runner for an attempt; under the mutex. */
static void begin(struct mo_runner *runner)
{
  runner->waits = runner->winding_down = runner->is_short = runner->gives_up = false;
  runner->error = MO_OK;
  runner->text[0] = '\0';
  runner->live = (struct mo_live){.phase = runner->runners->kind->first, .seconds_left = -1};
  __atomic_store_n(&runner->replayed, 0, __ATOMIC_RELAXED);
}

/* Reserves the first job that no other thread holds and for which there is enough memory. Returns 0
 * if there is none. */
static int64_t reserve(struct mo_runner *runner, const int64_t *ids, int64_t n)
{
  struct mo_runners *runners = runner->runners;
  int64_t found = 0;
  for (int64_t i = 0; i < n && found == 0; i++)
    if (mo_memory_take(runner->jobs, runners->kind, ids[i]))
      found = ids[i];
  pthread_mutex_lock(&runners->mutex);
  if (found != 0 && runners->stopping) {
    pthread_mutex_unlock(&runners->mutex);
    mo_memory_give(runner->jobs, found);
    return 0;
  }
  if (found != 0) {
    runner->id = found;
    runner->request = MO_REQUEST_NONE;
    begin(runner);
    __atomic_store_n(&runner->interrupt, 0, __ATOMIC_RELAXED);
    atomic_fetch_add(&runners->active, 1);
  }
  pthread_mutex_unlock(&runners->mutex);
  return found;
}

static void release(struct mo_runner *runner)
{
  struct mo_runners *runners = runner->runners;
  const int64_t id = runner->id;
  pthread_mutex_lock(&runners->mutex);
  runner->id = 0;
  runner->request = MO_REQUEST_NONE;
  runner->waits = false;
  /* This job may have been requeued, or other jobs may be waiting for this thread. */
  runners->look++;
  atomic_fetch_sub(&runners->active, 1);
  pthread_cond_broadcast(&runners->news);
  pthread_mutex_unlock(&runners->mutex);
  mo_memory_give(runner->jobs, id);
}

/* Waits `ms` for memory. Returns false if a request arrived. */
static bool await_memory(struct mo_runner *runner, uint32_t ms)
{
  char reason[160];
  snprintf(reason, sizeof(reason),
           "no memory or file descriptor for the %s; it will continue when one is available",
           mo_job_kind_name(runner->runners->kind->kind));
  (void)mo_runner_set_waiting(runner, true, MO_PHASE_WAIT, reason);
  if (ms == runner->jobs->config.retry_ms)
    mo_runner_warn(runner, MO_ERR_NO_MEMORY, reason);
  mo_runner_sleep(runner, ms, MO_REQUEST_PAUSE);
  return mo_runner_requested(runner) == MO_REQUEST_NONE;
}

/* Runs a started job once. Returns whether it failed. */
static bool attempt(struct mo_runner *runner)
{
  const struct mo_kind *kind = runner->runners->kind;
  void *run = calloc(1, kind->run_bytes);
  if (run == NULL) {
    runner->is_short = true;
    return false;
  }
  int error = mo_share_open(runner->jobs, runner->id, kind->kind, &runner->share);
  error = error == MO_OK ? kind->run(runner, run) : mo_runner_fail_unreadable(runner, error);
  bool failed = mo_runner_end_attempt(runner, error, run);
  kind->clean_up(run);
  mo_share_close(runner->jobs, runner->id);
  free(run);
  return failed;
}

/* Runs a started job, and repeats the run while it ends for lack of memory. Returns whether it
 * failed. */
static bool run(struct mo_runner *runner)
{
  struct mo_runners *runners = runner->runners;
  const uint32_t retry_ms = runner->jobs->config.retry_ms;
  for (uint32_t ms = retry_ms;; ms = ms < LONGEST_WAIT * retry_ms ? 2 * ms : ms) {
    const bool failed = attempt(runner);
    if (!runner->is_short)
      return failed;
    if (!await_memory(runner, ms))
      break;
    pthread_mutex_lock(&runners->mutex);
    begin(runner);
    pthread_mutex_unlock(&runners->mutex);
  }
  /* A paused or cancelled job keeps its state. If this write fails, the next process finds the job
   * running and requeues it. */
  (void)mo_store_run_park(runner->jobs->store, runner->id, MO_OK, NULL, 0, NULL);
  return false;
}

/* Runs the first queued job. Returns false if there is none, or if it cannot start now (*again:
 * retry later). */
static bool run_next(struct mo_runner *runner, bool *again)
{
  const struct mo_kind *kind = runner->runners->kind;
  struct mo_jobs *jobs = runner->jobs;
  int64_t ids[CLAIMS_MAX];
  int64_t n = mo_store_queued_runs(jobs->store, kind->kind, ids, CLAIMS_MAX);
  bool failed = false;
  if (n >= 0)
    mo_memory_keep(jobs, kind, ids, n);
  int64_t id = reserve(runner, ids, n);
  *again = n < 0;
  if (id == 0)
    return false;
  int error = mo_store_run_start(jobs->store, id);
  if (error == MO_OK) {
    mo_thread_tag = id;
    failed = run(runner);
    mo_thread_tag = -1;
  }
  release(runner);
  *again = error != MO_OK &&
           error != MO_ERR_CONFLICT; /* no space to record its start, or the store is closing */
  if (failed)
    mo_runner_sleep(runner, jobs->config.retry_ms, MO_REQUEST_STOP);
  return !*again;
}

static void serve_one_at_a_time(struct mo_runner *runner)
{
  struct mo_runners *runners = runner->runners;
  uint64_t seen = 0;
  bool again = true;
  for (;;) {
    pthread_mutex_lock(&runners->mutex);
    while (!runners->stopping && runners->look == seen && !again)
      pthread_cond_wait(&runners->news, &runners->mutex);
    seen = runners->look;
    const bool stopping = runners->stopping;
    pthread_mutex_unlock(&runners->mutex);
    if (stopping)
      return;
    while (run_next(runner, &again))
      ;
    if (again)
      mo_runner_sleep(runner, runner->jobs->config.retry_ms, MO_REQUEST_STOP);
  }
}

static void *serve(void *context)
{
  struct mo_runner *runner = context;
  struct mo_runners *runners = runner->runners;
  if (runners->kind->serve != NULL)
    runners->kind->serve(runner);
  else
    serve_one_at_a_time(runner);
  MO_GUARD(&runners->mutex);
  runners->alive--;
  pthread_cond_broadcast(&runners->news);
  return NULL;
}

/* ---- live figures ---- */

const char *mo_phase_name(enum mo_phase phase)
{
  static const char *const names[] = {"idle",    "replaying",  "preparing", "varying", "learning",
                                      "scoring", "validating", "saving",    "waiting", NULL};
  return mo_word(names, phase);
}

void mo_jobs_live(struct mo_jobs *jobs, int64_t id, struct mo_live *live)
{
  mo_share_live(jobs, id, live);
  struct mo_live used = *live;
  bool runs = live->phase != MO_PHASE_IDLE;
  for (int kind = 0; kind < MO_JOB_KINDS && !runs; kind++) {
    struct mo_runners *runners = &jobs->runners[kind];
    MO_GUARD(&runners->mutex);
    const struct mo_runner *runner = mo_runners_find(runners, id);
    runs = runner != NULL;
    if (runs) {
      *live = runner->live;
      live->done += __atomic_load_n(&runner->replayed, __ATOMIC_RELAXED);
    }
  }
  if (!runs && (mo_memory_reason(jobs, id, live->reason) ||
                mo_drawer_reason(jobs->evaluations, id, live->reason)))
    live->phase = MO_PHASE_WAIT;
  /* Gradients on the CPU never wait for other machines. */
  if (used.busy_s >= 0 && live->reason[0] == '\0' &&
      (used.back_end == MO_ON_DEVICE || live->phase == MO_PHASE_SCORE ||
       live->phase == MO_PHASE_VALIDATE))
    mo_back_end_describe_wait(jobs, used.back_end, live->reason, sizeof(live->reason));
  live->busy_s = used.busy_s;
  live->worker_s = used.worker_s;
  live->device_s = used.device_s;
}

size_t mo_jobs_running(struct mo_jobs *jobs, struct mo_running *rows, size_t limit)
{
  const size_t found = mo_shares_heaviest(jobs, rows, limit);
  size_t n = 0;
  for (size_t i = 0; i < found; i++) {
    mo_jobs_live(jobs, rows[i].id, &rows[i].live);
    if (rows[i].live.phase != MO_PHASE_IDLE && rows[i].live.phase != MO_PHASE_WAIT)
      rows[n++] = rows[i];
  }
  return n;
}

size_t mo_jobs_waiting(struct mo_jobs *jobs, int64_t ids[MO_WAITING_MAX])
{
  size_t n = 0;
  for (int kind = 0; kind < MO_JOB_KINDS; kind++) {
    struct mo_runners *runners = &jobs->runners[kind];
    MO_GUARD(&runners->mutex);
    for (uint32_t i = 0; i < runners->n && n < MO_WAITING_MAX; i++)
      if (runners->runner[i].id != 0 && runners->runner[i].waits)
        ids[n++] = runners->runner[i].id;
  }
  return n;
}

const char *mo_result_name(const struct mo_job *job, const char *asked, char made[MO_MADE_BYTES])
{
  snprintf(made, MO_MADE_BYTES, "%s-%lld", mo_job_kind_name(job->kind), (long long)job->id);
  return asked[0] != '\0' ? asked : made;
}

/* ---- start and stop ---- */

int mo_runners_start(struct mo_jobs *jobs, struct mo_runners *runners, uint32_t n)
{
  struct mo_runner *made = calloc(n, sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  MO_GUARD(&runners->mutex);
  runners->runner = made;
  runners->n = n;
  for (uint32_t i = 0; i < n; i++) {
    made[i].jobs = jobs;
    made[i].runners = runners;
    made[i].has_thread = pthread_create(&made[i].thread, NULL, serve, &made[i]) == 0;
    runners->alive += made[i].has_thread;
  }
  n -= runners->alive;
  return n == 0 ? MO_OK : MO_ERR_NO_MEMORY;
}

void mo_runners_stop(struct mo_runners *runners)
{
  MO_GUARD(&runners->mutex);
  runners->stopping = true;
  runners->look++;
  for (uint32_t i = 0; i < runners->n; i++)
    mo_runner_put_request(&runners->runner[i], MO_REQUEST_STOP);
  pthread_cond_broadcast(&runners->news);
}

bool mo_runners_wait(struct mo_runners *runners, int64_t until_us)
{
  MO_GUARD(&runners->mutex);
  while (runners->alive > 0 && mo_wait_until(&runners->news, &runners->mutex, until_us))
    ;
  return runners->alive == 0;
}

void mo_runners_free(struct mo_runners *runners)
{
  for (uint32_t i = 0; i < runners->n; i++)
    if (runners->runner[i].has_thread)
      pthread_join(runners->runner[i].thread, NULL);
  free(runners->runner);
  runners->runner = NULL;
  runners->n = 0;
}
