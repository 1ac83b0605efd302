/* runners.c: the threads of jobs with their own thread (trainings, campaigns), and requests to
 * them.
 *
 * Each kind has as many threads as jobs of the kind may run concurrently. A free thread takes the
 * first queued job that no other thread holds. A request (pause, stop, cancel) sets a flag that
 * every long call of a run polls, and wakes a thread that waits for space. A run that lacks memory
 * or descriptors has not failed: its thread repeats it later. */
#include <errno.h>
#include <stdlib.h>
#include <time.h>

#include "base/clock.h"
#include "base/thread.h"
#include "jobs/internal.h"

#define CLAIMS_MAX   65 /* queued jobs per look-up: one more than the most threads of a kind */
#define LONGEST_WAIT 30 /* for memory, in multiples of retry_ms */

struct mo_runner *mo_runners_find(struct mo_runners *runners, int64_t id)
{
  for (uint32_t i = 0; i < runners->n; i++)
    if (runners->runner[i].id == id)
      return &runners->runner[i];
  return NULL;
}

/* ---- requests ---- */

static void put_wish(struct mo_runner *runner, enum mo_runner_wish wish)
{
  if (runner->wish < wish)
    runner->wish = wish;
  __atomic_store_n(&runner->interrupt, 1, __ATOMIC_RELAXED);
}

void mo_runners_wish(struct mo_runners *runners, int64_t id, enum mo_runner_wish wish)
{
  struct mo_runner *runner;
  pthread_mutex_lock(&runners->mutex);
  runner = mo_runners_find(runners, id);
  if (runner != NULL)
    put_wish(runner, wish);
  pthread_cond_broadcast(&runners->news);
  pthread_mutex_unlock(&runners->mutex);
}

void mo_runners_wake(struct mo_runners *runners)
{
  pthread_mutex_lock(&runners->mutex);
  runners->look++;
  pthread_cond_broadcast(&runners->news);
  pthread_mutex_unlock(&runners->mutex);
}

enum mo_runner_wish mo_runner_wished(struct mo_runner *runner)
{
  enum mo_runner_wish wish;
  pthread_mutex_lock(&runner->runners->mutex);
  wish = runner->wish;
  pthread_mutex_unlock(&runner->runners->mutex);
  return wish;
}

bool mo_runner_is_interrupted(const struct mo_runner *runner)
{
  return __atomic_load_n(&runner->interrupt, __ATOMIC_RELAXED) != 0;
}

void mo_runner_sleep(struct mo_runner *runner, uint32_t ms, enum mo_runner_wish least)
{
  struct mo_runners *runners = runner->runners;
  int64_t end_us = mo_clock_us() + (int64_t)ms * 1000;
  struct timespec deadline = {.tv_sec = end_us / 1000000, .tv_nsec = (end_us % 1000000) * 1000};
  pthread_mutex_lock(&runners->mutex);
  while (runner->wish < least && !runners->stopping)
    if (pthread_cond_timedwait(&runners->news, &runners->mutex, &deadline) == ETIMEDOUT)
      break;
  pthread_mutex_unlock(&runners->mutex);
}

int mo_runner_set_waiting(struct mo_runner *runner, bool waits, int phase, const char *reason)
{
  pthread_mutex_lock(&runner->runners->mutex);
  runner->waits = waits;
  pthread_mutex_unlock(&runner->runners->mutex);
  return runner->runners->kind->set_phase(runner, phase, reason);
}

/* ---- claiming ---- */

/* Reserves the first job that no other thread holds and for which there is memory; 0: none. */
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
    runner->wish = MO_WISH_NONE;
    runner->waits = false;
    runners->kind->begin(runner);
    __atomic_store_n(&runner->interrupt, 0, __ATOMIC_RELAXED);
    __atomic_store_n(&runner->replayed, 0, __ATOMIC_RELAXED);
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
  runner->wish = MO_WISH_NONE;
  runner->waits = false;
  runners->look++; /* this job may be queued again, or others may have waited for a thread */
  atomic_fetch_sub(&runners->active, 1);
  pthread_cond_broadcast(&runners->news);
  pthread_mutex_unlock(&runners->mutex);
  mo_memory_give(runner->jobs, id);
}

/* Waits `ms` for memory. false: a request arrived. */
static bool await_memory(struct mo_runner *runner, int64_t id, uint32_t ms)
{
  const struct mo_runner_kind *kind = runner->runners->kind;
  const struct mo_jobs_config *config = &runner->jobs->config;
  char reason[160];
  snprintf(reason, sizeof(reason),
           "no memory, or no file descriptor, for the %s: it goes on by itself when there is some",
           kind->noun);
  (void)mo_runner_set_waiting(runner, true, kind->waiting, reason);
  if (ms == config->retry_ms && config->warn != NULL)
    config->warn(config->warn_context, id, MO_ERR_NO_MEMORY, reason);
  mo_runner_sleep(runner, ms, MO_WISH_PAUSE);
  return mo_runner_wished(runner) == MO_WISH_NONE;
}

/* Runs a started job, and repeats the run while it ends for lack of memory. Returns whether it
 * failed. */
static bool run(struct mo_runner *runner, int64_t id)
{
  struct mo_runners *runners = runner->runners;
  const uint32_t retry_ms = runner->jobs->config.retry_ms;
  bool failed;
  for (uint32_t ms = retry_ms;; ms = ms < LONGEST_WAIT * retry_ms ? 2 * ms : ms) {
    runner->is_short = false;
    failed = runners->kind->run(runner, id);
    if (!runner->is_short)
      return failed;
    if (!await_memory(runner, id, ms))
      break;
    pthread_mutex_lock(&runners->mutex);
    runner->waits = false;
    runners->kind->begin(runner);
    pthread_mutex_unlock(&runners->mutex);
  }
  /* A paused or cancelled job keeps its state. If this write fails, the next process finds the job
   * running and requeues it. */
  (void)runners->kind->park(runner->jobs->store, id, MO_OK, NULL, 0, NULL);
  return false;
}

/* Runs the first queued job. false: there is none, or it cannot start now (*again: try later). */
static bool run_next(struct mo_runner *runner, bool *again)
{
  const struct mo_runner_kind *kind = runner->runners->kind;
  struct mo_jobs *jobs = runner->jobs;
  int64_t ids[CLAIMS_MAX];
  int64_t n = kind->queued(jobs->store, ids, CLAIMS_MAX);
  int64_t id;
  bool failed = false;
  int error;
  if (n >= 0)
    mo_memory_keep(jobs, kind, ids, n);
  id = reserve(runner, ids, n);
  *again = n < 0;
  if (id == 0)
    return false;
  error = kind->start(jobs->store, id);
  if (error == MO_OK) {
    mo_thread_tag = id;
    failed = run(runner, id);
    mo_thread_tag = -1;
  }
  release(runner);
  *again = error != MO_OK &&
           error != MO_ERR_CONFLICT; /* no space to record its start, or the store is closing */
  if (failed)
    mo_runner_sleep(runner, runner->jobs->config.retry_ms, MO_WISH_STOP);
  return !*again;
}

static void *serve(void *context)
{
  struct mo_runner *runner = context;
  struct mo_runners *runners = runner->runners;
  uint64_t seen = 0;
  bool again = true;
  for (;;) {
    bool stopping;
    pthread_mutex_lock(&runners->mutex);
    while (!runners->stopping && runners->look == seen && !again)
      pthread_cond_wait(&runners->news, &runners->mutex);
    seen = runners->look;
    stopping = runners->stopping;
    pthread_mutex_unlock(&runners->mutex);
    if (stopping)
      break;
    while (run_next(runner, &again))
      ;
    if (again)
      mo_runner_sleep(runner, runner->jobs->config.retry_ms, MO_WISH_STOP);
  }
  pthread_mutex_lock(&runners->mutex);
  runners->alive--;
  pthread_cond_broadcast(&runners->news);
  pthread_mutex_unlock(&runners->mutex);
  return NULL;
}

/* ---- start and stop ---- */

void mo_runners_init(struct mo_runners *runners, const pthread_condattr_t *monotonic)
{
  pthread_mutex_init(&runners->mutex, NULL);
  pthread_cond_init(&runners->news, monotonic);
}

void mo_runners_destroy(struct mo_runners *runners)
{
  pthread_mutex_destroy(&runners->mutex);
  pthread_cond_destroy(&runners->news);
}

int mo_runners_start(struct mo_jobs *jobs, struct mo_runners *runners,
                     const struct mo_runner_kind *kind, uint32_t n)
{
  struct mo_runner *made = calloc(n, sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  pthread_mutex_lock(&runners->mutex);
  runners->kind = kind;
  runners->runner = made;
  runners->n = n;
  for (uint32_t i = 0; i < n; i++) {
    made[i].jobs = jobs;
    made[i].runners = runners;
  }
  for (uint32_t i = 0; i < n; i++) {
    made[i].thread_started = pthread_create(&made[i].thread, NULL, serve, &made[i]) == 0;
    runners->alive += made[i].thread_started;
  }
  n -= runners->alive;
  pthread_mutex_unlock(&runners->mutex);
  return n == 0 ? MO_OK : MO_ERR_NO_MEMORY;
}

void mo_runners_stop(struct mo_runners *runners)
{
  pthread_mutex_lock(&runners->mutex);
  runners->stopping = true;
  for (uint32_t i = 0; i < runners->n; i++)
    put_wish(&runners->runner[i], MO_WISH_STOP);
  pthread_cond_broadcast(&runners->news);
  pthread_mutex_unlock(&runners->mutex);
}

bool mo_runners_wait(struct mo_runners *runners, const struct timespec *deadline)
{
  bool ended;
  pthread_mutex_lock(&runners->mutex);
  while (runners->alive > 0)
    if (pthread_cond_timedwait(&runners->news, &runners->mutex, deadline) == ETIMEDOUT)
      break;
  ended = runners->alive == 0;
  pthread_mutex_unlock(&runners->mutex);
  return ended;
}

void mo_runners_free(struct mo_runners *runners)
{
  mo_runners_stop(runners);
  for (uint32_t i = 0; i < runners->n; i++)
    if (runners->runner[i].thread_started)
      pthread_join(runners->runner[i].thread, NULL);
  free(runners->runner);
  runners->runner = NULL;
  runners->n = 0;
}
