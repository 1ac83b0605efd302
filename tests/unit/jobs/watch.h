/* watch.h: what the tests of the scheduler look at while jobs run. */
#ifndef MORPHO_TESTS_JOBS_WATCH_H
#define MORPHO_TESTS_JOBS_WATCH_H

#include <pthread.h>
#include <time.h>

#include "../check.h"
#include "jobs/state.h"
#include "service.h"

static struct mo_controller *weights;

/* The weights that fixture_controller stores with a seed. */
static inline const struct mo_controller *default_weights(void)
{
  if (weights == NULL &&
      mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &weights) == MO_OK)
    mo_controller_randomize(weights, 1);
  return weights;
}

static inline bool right(struct service *service, int64_t id, const struct mo_bits *genotypes)
{
  struct mo_physics physics = mo_default_physics();
  return service_results_right(service, id, genotypes, &physics, MO_FLOAT32, default_weights());
}

static inline double now_s(void)
{
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static inline uint64_t computed(struct service *service)
{
  struct mo_jobs_stats stats;
  mo_jobs_get_stats(service->jobs, &stats);
  return stats.rollouts_computed;
}

static inline enum mo_job_state state_of(struct service *service, int64_t id)
{
  struct mo_job job = {.state = MO_JOB_QUEUED};
  (void)mo_store_job(service->fixture.store, id, &job);
  return job.state;
}

static inline bool await_state(struct service *service, int64_t id, enum mo_job_state state,
                               double seconds)
{
  double end = now_s() + seconds;
  while (state_of(service, id) != state) {
    if (now_s() > end)
      return false;
    usleep(2000);
  }
  return true;
}

/* The figures follow a commit by a moment. */
static inline struct mo_jobs_stats idle_stats(struct service *service)
{
  struct mo_jobs_stats stats;
  double end = now_s() + 5;
  do {
    mo_jobs_get_stats(service->jobs, &stats);
    usleep(1000);
  } while ((stats.open_jobs > 0 || stats.active_campaigns > 0) &&
           now_s() < end); /* a runner ends after its job */
  return stats;
}

/* ---- warnings ---- */

static char warned[256];

static pthread_mutex_t warned_mutex = PTHREAD_MUTEX_INITIALIZER;

static int warnings;

static inline void keep_warning(void *context, int64_t job, int error, const char *text)
{
  (void)context;
  (void)job;
  (void)error;
  pthread_mutex_lock(&warned_mutex);
  snprintf(warned, sizeof(warned), "%s", text);
  warnings++;
  pthread_mutex_unlock(&warned_mutex);
}

/* A new folder, closed, for a service whose warnings are kept. */
static inline int watch_start(struct service *service)
{
  int error = service_start(service);
  service_close(service);
  pthread_mutex_lock(&warned_mutex);
  warnings = 0;
  warned[0] = '\0';
  pthread_mutex_unlock(&warned_mutex);
  service->config.warn = keep_warning;
  return error;
}

#endif
