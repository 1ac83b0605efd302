/* trainings.c: the threads that run trainings: who runs which, and what people ask of it.
 *
 * There are as many threads as trainings may run side by side. A free one takes the oldest queued training that no other holds.
 * A wish (pause, stop, cancel) sets a flag that every long call of a run looks at, and wakes a thread that waits for room. */
#include "jobs/trainings.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "jobs/internal.h"

#define RETRY_MS 1000

const char *mo_training_phase_name(enum mo_training_phase phase)
{
  static const char *const names[] = {"idle", "replaying", "learning", "validating", "saving", "waiting"};
  return (unsigned)phase < sizeof(names) / sizeof(names[0]) ? names[phase] : "unknown";
}

int mo_jobs_training_live(struct mo_jobs *jobs, int64_t id, struct mo_training_live *live)
{
  *live = (struct mo_training_live){.phase = MO_TRAINING_IDLE, .seconds_left = -1};
  pthread_mutex_lock(&jobs->trainers_mutex);
  for (uint32_t i = 0; i < jobs->config.max_active_trainings && jobs->trainers != NULL; i++)
    if (jobs->trainers[i].id == id) {
      *live = jobs->trainers[i].live;
      live->replayed = __atomic_load_n(&jobs->trainers[i].replayed, __ATOMIC_RELAXED);
    }
  pthread_mutex_unlock(&jobs->trainers_mutex);
  return MO_OK;
}

const char *mo_jobs_code_version(const struct mo_jobs *jobs)
{
  return jobs->code_version;
}

/* ---- wishes ---- */

static void put_wish(struct mo_trainer *trainer, enum mo_trainer_wish wish)
{
  if (trainer->wish < wish)
    trainer->wish = wish;
  __atomic_store_n(&trainer->interrupt, 1, __ATOMIC_RELAXED);
}

void mo_trainers_wish(struct mo_jobs *jobs, int64_t id, enum mo_trainer_wish wish)
{
  pthread_mutex_lock(&jobs->trainers_mutex);
  for (uint32_t i = 0; i < jobs->config.max_active_trainings; i++)
    if (jobs->trainers[i].id == id)
      put_wish(&jobs->trainers[i], wish);
  pthread_cond_broadcast(&jobs->trainers_news);
  pthread_mutex_unlock(&jobs->trainers_mutex);
}

void mo_trainers_wake(struct mo_jobs *jobs)
{
  pthread_mutex_lock(&jobs->trainers_mutex);
  jobs->trainers_look++;
  pthread_cond_broadcast(&jobs->trainers_news);
  pthread_mutex_unlock(&jobs->trainers_mutex);
}

enum mo_trainer_wish mo_trainer_wished(struct mo_trainer *trainer)
{
  enum mo_trainer_wish wish;
  pthread_mutex_lock(&trainer->jobs->trainers_mutex);
  wish = trainer->wish;
  pthread_mutex_unlock(&trainer->jobs->trainers_mutex);
  return wish;
}

void mo_trainer_sleep(struct mo_trainer *trainer, uint32_t ms, enum mo_trainer_wish least)
{
  struct mo_jobs *jobs = trainer->jobs;
  int64_t end_us = mo_jobs_clock_us() + (int64_t)ms * 1000;
  struct timespec deadline = {.tv_sec = end_us / 1000000, .tv_nsec = (end_us % 1000000) * 1000};
  pthread_mutex_lock(&jobs->trainers_mutex);
  while (trainer->wish < least && !jobs->trainers_stopping)
    if (pthread_cond_timedwait(&jobs->trainers_news, &jobs->trainers_mutex, &deadline) == ETIMEDOUT)
      break;
  pthread_mutex_unlock(&jobs->trainers_mutex);
}

/* ---- claiming ---- */

/* Reserves the first of these that no other thread holds; 0: there is none. */
static int64_t reserve(struct mo_trainer *trainer, const int64_t *ids, int64_t n)
{
  struct mo_jobs *jobs = trainer->jobs;
  int64_t found = 0;
  pthread_mutex_lock(&jobs->trainers_mutex);
  for (int64_t i = 0; i < n && found == 0 && !jobs->trainers_stopping; i++) {
    bool held = false;
    for (uint32_t k = 0; k < jobs->config.max_active_trainings; k++)
      held = held || jobs->trainers[k].id == ids[i];
    found = held ? 0 : ids[i];
  }
  if (found != 0) {
    trainer->id = found;
    trainer->wish = MO_WISH_NONE;
    trainer->live = (struct mo_training_live){.phase = MO_TRAINING_LEARN, .seconds_left = -1};
    __atomic_store_n(&trainer->interrupt, 0, __ATOMIC_RELAXED);
    __atomic_store_n(&trainer->replayed, 0, __ATOMIC_RELAXED);
    atomic_fetch_add(&jobs->active_trainings, 1);
  }
  pthread_mutex_unlock(&jobs->trainers_mutex);
  return found;
}

static void release(struct mo_trainer *trainer)
{
  struct mo_jobs *jobs = trainer->jobs;
  pthread_mutex_lock(&jobs->trainers_mutex);
  trainer->id = 0;
  trainer->wish = MO_WISH_NONE;
  jobs->trainers_look++; /* it may be queued again, and so may others that waited for a thread */
  atomic_fetch_sub(&jobs->active_trainings, 1);
  pthread_cond_broadcast(&jobs->trainers_news);
  pthread_mutex_unlock(&jobs->trainers_mutex);
}

/* Runs the oldest queued training. false: there is none, or it cannot be started now (*again: look again in a while). */
static bool run_next(struct mo_trainer *trainer, bool *again)
{
  struct mo_jobs *jobs = trainer->jobs;
  int64_t ids[17];
  int64_t n = mo_store_queued_trainings(jobs->store, ids, (size_t)jobs->config.max_active_trainings + 1);
  int64_t id = reserve(trainer, ids, n);
  bool failed = false;
  int error;
  *again = n < 0;
  if (id == 0)
    return false;
  error = mo_store_training_start(jobs->store, id);
  if (error == MO_OK) {
    mo_trainer_tag = id;
    failed = mo_training_run(trainer, id);
    mo_trainer_tag = -1;
  }
  release(trainer);
  *again = error != MO_OK && error != MO_ERR_CONFLICT; /* no room for its start, or the store is closing */
  if (failed)
    mo_trainer_sleep(trainer, RETRY_MS, MO_WISH_STOP);
  return !*again;
}

static void *train(void *context)
{
  struct mo_trainer *trainer = context;
  struct mo_jobs *jobs = trainer->jobs;
  uint64_t seen = 0;
  bool again = true;
  for (;;) {
    bool stopping;
    pthread_mutex_lock(&jobs->trainers_mutex);
    while (!jobs->trainers_stopping && jobs->trainers_look == seen && !again)
      pthread_cond_wait(&jobs->trainers_news, &jobs->trainers_mutex);
    seen = jobs->trainers_look;
    stopping = jobs->trainers_stopping;
    pthread_mutex_unlock(&jobs->trainers_mutex);
    if (stopping)
      break;
    while (run_next(trainer, &again))
      ;
    if (again)
      mo_trainer_sleep(trainer, RETRY_MS, MO_WISH_STOP);
  }
  pthread_mutex_lock(&jobs->trainers_mutex);
  jobs->trainers_alive--;
  pthread_cond_broadcast(&jobs->trainers_news);
  pthread_mutex_unlock(&jobs->trainers_mutex);
  return NULL;
}

/* ---- start and stop ---- */

int mo_trainers_start(struct mo_jobs *jobs)
{
  uint32_t n = jobs->config.max_active_trainings;
  jobs->trainers = calloc(n, sizeof(*jobs->trainers));
  if (jobs->trainers == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < n; i++)
    jobs->trainers[i].jobs = jobs;
  for (uint32_t i = 0; i < n; i++) {
    pthread_mutex_lock(&jobs->trainers_mutex);
    jobs->trainers_alive++;
    if (pthread_create(&jobs->trainers[i].thread, NULL, train, &jobs->trainers[i]) != 0)
      jobs->trainers_alive--;
    else
      jobs->trainers[i].thread_started = true;
    pthread_mutex_unlock(&jobs->trainers_mutex);
    if (!jobs->trainers[i].thread_started)
      return MO_ERR_NO_MEMORY;
  }
  return MO_OK;
}

void mo_trainers_stop(struct mo_jobs *jobs)
{
  pthread_mutex_lock(&jobs->trainers_mutex);
  jobs->trainers_stopping = true;
  for (uint32_t i = 0; i < jobs->config.max_active_trainings && jobs->trainers != NULL; i++)
    put_wish(&jobs->trainers[i], MO_WISH_STOP);
  pthread_cond_broadcast(&jobs->trainers_news);
  pthread_mutex_unlock(&jobs->trainers_mutex);
}

bool mo_trainers_wait(struct mo_jobs *jobs, const struct timespec *deadline)
{
  bool ended;
  pthread_mutex_lock(&jobs->trainers_mutex);
  while (jobs->trainers_alive > 0)
    if (pthread_cond_timedwait(&jobs->trainers_news, &jobs->trainers_mutex, deadline) == ETIMEDOUT)
      break;
  ended = jobs->trainers_alive == 0;
  pthread_mutex_unlock(&jobs->trainers_mutex);
  return ended;
}

void mo_trainers_free(struct mo_jobs *jobs)
{
  if (jobs->trainers == NULL)
    return;
  mo_trainers_stop(jobs);
  for (uint32_t i = 0; i < jobs->config.max_active_trainings; i++)
    if (jobs->trainers[i].thread_started)
      pthread_join(jobs->trainers[i].thread, NULL);
  free(jobs->trainers);
  jobs->trainers = NULL;
}
