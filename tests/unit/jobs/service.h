/* service.h: a store, a back end and the jobs room together, in a folder of their own; what tests
 * look at while jobs run. */
#ifndef MORPHO_TESTS_JOBS_SERVICE_H
#define MORPHO_TESTS_JOBS_SERVICE_H

#include <sqlite3.h>

#include "../check.h"
#include "../store/fixture.h"
#include "base/clock.h"
#include "fake_compute.h"
#include "jobs/campaigns.h"
#include "jobs/evaluations.h"
#include "jobs/state.h"
#include "jobs/trainings.h"

#define END_S 120 /* jobs take at most so long, also on a busy machine under a sanitizer */

struct service {
  struct fixture fixture;
  struct mo_compute *compute;
  struct mo_jobs *jobs;
  struct mo_jobs_config config;
  const char *vfs;
  uint32_t n_workers; /* 0: 2 */
  struct mo_bits *bodies[4];
};

static inline double now_s(void)
{
  return 1e-6 * (double)mo_clock_us();
}

/* Waits up to END_S seconds for a condition, evaluated every half millisecond. Its value is that of
 * the condition at the end. */
#define AWAIT(condition)                                                                           \
  ({                                                                                               \
    const double await_end_s = now_s() + END_S;                                                    \
    bool await_holds;                                                                              \
    while (!(await_holds = (condition)) && now_s() < await_end_s)                                  \
      usleep(500);                                                                                 \
    await_holds;                                                                                   \
  })

/* ---- warnings ---- */

static char warned[256]; /* the last one */
static atomic_int warnings;
static pthread_mutex_t warned_mutex = PTHREAD_MUTEX_INITIALIZER;

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

static inline bool has_warned(const char *words)
{
  bool found;
  pthread_mutex_lock(&warned_mutex);
  found = strstr(warned, words) != NULL;
  pthread_mutex_unlock(&warned_mutex);
  return found;
}

/* ---- start and end ---- */

static inline int service_open(struct service *service)
{
  struct mo_store_config store_config = {.path = service->fixture.path, .vfs = service->vfs};
  struct mo_compute_config compute_config = {
      .n_workers = service->n_workers > 0 ? service->n_workers : 2, .isa = mo_isa_best()};
  struct mo_controller_record record;
  int error = mo_store_open(&store_config, &service->fixture.store, &service->fixture.message);
  if (error == MO_OK &&
      mo_store_controller(service->fixture.store, "default", &record) == MO_ERR_NOT_FOUND)
    error = fixture_controller(service->fixture.store, "default", 1, &record);
  if (error == MO_OK)
    error = mo_compute_create_cpu(&compute_config, &service->compute);
  if (error == MO_OK)
    error = mo_jobs_create(service->fixture.store, service->compute, &service->config,
                           &service->jobs, &service->fixture.message);
  return error;
}

/* A new folder, closed. */
static inline int service_begin(struct service *service)
{
  memset(service, 0, sizeof(*service));
  if (fake_reset != NULL)
    fake_reset();
  service->config.retry_ms = 100;
  service->config.warn = keep_warning;
  warned[0] = '\0';
  warnings = 0;
  return fixture_folder(&service->fixture);
}

/* side_by_side: so many trainings and so many campaigns run at once; 0: as by default. */
static inline int service_start(struct service *service, uint32_t side_by_side)
{
  int error = service_begin(service);
  service->config.max_active_trainings = service->config.max_active_campaigns = side_by_side;
  return error == MO_OK ? service_open(service) : error;
}

static inline void service_close(struct service *service)
{
  mo_jobs_free(service->jobs);
  mo_compute_free(service->compute);
  mo_store_close(service->fixture.store);
  service->jobs = NULL;
  service->compute = NULL;
  service->fixture.store = NULL;
}

static inline int service_reopen(struct service *service)
{
  service_close(service);
  return service_open(service);
}

static inline void service_end(struct service *service)
{
  service_close(service);
  fixture_remove(service->fixture.path);
  for (int i = 0; i < 4; i++)
    free(service->bodies[i]);
}

/* Sets the states of two jobs in the closed database, as if the process had been killed. */
static inline void service_set_states(const struct service *service, int64_t first, int64_t second,
                                      enum mo_job_state state)
{
  char path[512], sql[128];
  sqlite3 *db = NULL;
  snprintf(path, sizeof(path), "%s/morphod.db", service->fixture.path);
  snprintf(sql, sizeof(sql), "UPDATE jobs SET state=%d WHERE id IN (%lld,%lld)", (int)state,
           (long long)first, (long long)second);
  CHECK_INT(sqlite3_open(path, &db), SQLITE_OK);
  CHECK_INT(sqlite3_exec(db, sql, NULL, NULL, NULL), SQLITE_OK);
  sqlite3_close(db);
}

/* Defines a case that runs with an open service, as for service_start. */
#define SERVICE_CASE(name, side_by_side)                                                           \
  static void name##_with(struct service *service);                                                \
  __attribute__((unused)) static void name(void)                                                   \
  {                                                                                                \
    struct service service;                                                                        \
    REQUIRE(service_start(&service, side_by_side) == MO_OK);                                       \
    name##_with(&service);                                                                         \
    service_end(&service);                                                                         \
  }                                                                                                \
  static void name##_with(struct service *service)

/* ---- what jobs are made of ---- */

/* (n) distinct bodies, placed; freed with the service. */
static inline const struct mo_bits *bodies(struct service *service, uint64_t seed, uint32_t n)
{
  struct mo_bits *forms = NULL, *genotypes = NULL;
  int i = 0;
  CHECK_INT(fixture_bodies(seed, n, &forms, &genotypes), MO_OK);
  free(forms);
  while (service->bodies[i] != NULL)
    i++;
  service->bodies[i] = genotypes;
  return genotypes;
}

/* The weights that fixture_controller stores with a seed. */
static inline struct mo_controller *weights_of(uint64_t seed)
{
  struct mo_controller *weights = NULL;
  CHECK_INT(mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &weights), MO_OK);
  mo_controller_randomize(weights, seed);
  return weights;
}

/* Those of "default". Call it first before there are other threads. */
static inline const struct mo_controller *default_weights(void)
{
  static struct mo_controller *weights;
  if (weights == NULL)
    weights = weights_of(1);
  return weights;
}

static inline struct mo_evaluation_request service_request(const struct mo_bits *genotypes,
                                                           uint32_t n)
{
  return (struct mo_evaluation_request){.genotypes = genotypes,
                                        .n_designs = n,
                                        .environment_set = "paper-test",
                                        .physics = mo_default_physics(),
                                        .priority = -1,
                                        .record_stride = 100};
}

static inline int64_t submitted(const struct service *service, int error, int64_t id)
{
  if (error != MO_OK)
    printf("# submission: %s\n", service->fixture.message.text);
  return error != MO_OK ? error : id;
}

/* These return the job's id or the error. */
static inline int64_t service_submit(struct service *service,
                                     const struct mo_evaluation_request *request)
{
  int64_t id = 0;
  bool replayed;
  int error =
      mo_jobs_submit_evaluation(service->jobs, request, &id, &replayed, &service->fixture.message);
  return submitted(service, error, id);
}

static inline int64_t submit_training(struct service *service,
                                      const struct mo_training_request *request)
{
  int64_t id = 0;
  bool replayed;
  int error =
      mo_jobs_submit_training(service->jobs, request, &id, &replayed, &service->fixture.message);
  return submitted(service, error, id);
}

static inline int64_t submit_campaign(struct service *service,
                                      const struct mo_campaign_request *request)
{
  int64_t id = 0;
  bool replayed;
  int error = mo_jobs_submit_campaign(service->jobs, request, &id, &replayed, NULL,
                                      &service->fixture.message);
  return submitted(service, error, id);
}

/* ---- while jobs run ---- */

static inline struct mo_job job_of(struct service *service, int64_t id)
{
  struct mo_job job = {.state = MO_JOB_QUEUED};
  (void)mo_store_job(service->fixture.store, id, &job);
  return job;
}

static inline enum mo_job_state state_of(struct service *service, int64_t id)
{
  return job_of(service, id).state;
}

static inline bool await_state(struct service *service, int64_t id, enum mo_job_state state)
{
  return AWAIT(state_of(service, id) == state);
}

/* The job when it is final. */
static inline struct mo_job end_of(struct service *service, int64_t id)
{
  CHECK(AWAIT(mo_job_state_is_final(state_of(service, id))));
  return job_of(service, id);
}

/* Whether a job succeeds; *job (nullable): at its end. */
static inline bool succeeds(struct service *service, int64_t id, struct mo_job *job)
{
  const struct mo_job ended = end_of(service, id);
  if (job != NULL)
    *job = ended;
  return ended.state == MO_JOB_SUCCEEDED;
}

static inline struct mo_live live_of(struct service *service, int64_t id)
{
  struct mo_live live;
  mo_jobs_live(service->jobs, id, &live);
  return live;
}

static inline bool await_phase(struct service *service, int64_t id, enum mo_phase phase)
{
  return AWAIT(live_of(service, id).phase == phase);
}

/* Whether the job comes to wait for a reason with these words. */
static inline bool await_reason(struct service *service, int64_t id, const char *words)
{
  struct mo_live live;
  bool waits = AWAIT((live = live_of(service, id)).phase == MO_PHASE_WAIT &&
                     strstr(live.reason, words) != NULL);
  if (!waits)
    printf("# job %lld: %s\n", (long long)id, live.reason);
  return waits;
}

static inline struct mo_jobs_stats stats_of(struct service *service)
{
  struct mo_jobs_stats stats;
  mo_jobs_get_stats(service->jobs, &stats);
  return stats;
}

static inline uint64_t computed(struct service *service)
{
  return stats_of(service).rollouts_computed;
}

/* The figures follow a commit by a moment, and a runner ends after its job. */
static inline struct mo_jobs_stats idle_stats(struct service *service)
{
  struct mo_jobs_stats stats;
  (void)AWAIT((stats = stats_of(service)).open_jobs == 0 && stats.active_campaigns == 0);
  return stats;
}

/* The number of a job's events of a type. */
static inline int count_events(struct service *service, int64_t id, const char *type)
{
  struct mo_event events[80];
  const int64_t n = mo_store_events(service->fixture.store, 0, id, events, 80, NULL, NULL);
  int found = 0;
  for (int64_t i = 0; i < n; i++)
    found += strcmp(events[i].type, type) == 0;
  return found;
}

#endif
