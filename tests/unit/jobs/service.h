/* service.h: a store, a back end and the jobs room together, in a temporary folder; and what tests
 * observe while jobs run. */
#ifndef MORPHO_TESTS_JOBS_SERVICE_H
#define MORPHO_TESTS_JOBS_SERVICE_H

#include "../store/by_hand.h"
#include "base/clock.h"
#include "fake_compute.h"
#include "jobs/campaigns.h"
#include "jobs/evaluations.h"
#include "jobs/state.h"
#include "jobs/trainings.h"

#define END_S 600 /* upper bound for a job, even on a busy machine under a sanitizer */
/* Immediate effects occur within SOON_S, even on a slow, busy machine. Anything that they must not
 * wait for takes much longer: blocks of LONG_US, and a stop that uses all of its STOP_MS. */
#define SOON_S  30
#define LONG_US 120000000
#define STOP_MS 60000

static struct {
  struct mo_compute *compute;
  struct mo_jobs *jobs;
  struct mo_jobs_config config;
  const char *vfs;
  const struct mo_file_operations *files;
  uint32_t n_workers; /* 0: 2 */
  uint64_t max_excluded_bytes;
} service;

/* Waits up to END_S seconds for a condition, which is evaluated every half millisecond. The result
 * is the condition's last value. */
#define AWAIT(condition)                                                                           \
  ({                                                                                               \
    const double await_end_s = now_s() + END_S;                                                    \
    bool await_holds;                                                                              \
    while (!(await_holds = (condition)) && now_s() < await_end_s)                                  \
      usleep(500);                                                                                 \
    await_holds;                                                                                   \
  })

static inline bool is_soon_after(double begin_s)
{
  return now_s() - begin_s < SOON_S;
}

/* ---- warnings ---- */

static char warned[256]; /* the latest one */
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
  pthread_mutex_lock(&warned_mutex);
  bool found = strstr(warned, words) != NULL;
  pthread_mutex_unlock(&warned_mutex);
  return found;
}

/* ---- start and end ---- */

static inline int service_open(void)
{
  const struct mo_compute_config config = {
      .n_workers = service.n_workers > 0 ? service.n_workers : 2, .isa = mo_isa_best()};
  struct mo_controller_record record;
  int error =
      reopen_with((struct mo_store_config){.vfs = service.vfs,
                                           .files = service.files,
                                           .max_excluded_bytes = service.max_excluded_bytes});
  if (error == MO_OK && mo_store_controller(store, "default", &record) == MO_ERR_NOT_FOUND)
    error = put_weights("default", 1, NULL);
  if (error == MO_OK)
    error = mo_compute_create_cpu(&config, &service.compute);
  if (error == MO_OK)
    error =
        mo_jobs_create(store, service.compute, &service.config, &service.jobs, &fixture.message);
  return error;
}

static inline void service_close(void)
{
  mo_jobs_free(service.jobs);
  mo_compute_free(service.compute);
  close_store();
  service.jobs = NULL;
  service.compute = NULL;
}

static inline void service_end(void *of_the_case)
{
  (void)of_the_case;
  service_close();
  fixture_remove(fixture.path);
}

/* Makes a new folder, with no store open, instead of the previous one. It is removed at the end of
 * the case. */
static inline int service_begin(void)
{
  if (check_place_of(&service) < check_n_kept)
    check_drop_from(&service);
  memset(&service, 0, sizeof(service));
  if (fake_reset != NULL)
    fake_reset();
  service.config.retry_ms = 100;
  service.config.warn = keep_warning;
  warned[0] = '\0';
  warnings = 0;
  check_keep(&service, service_end);
  return fixture_folder();
}

/* side_by_side: how many training runs, and how many campaigns, run at once; 0 = the default. */
static inline int service_start(uint32_t side_by_side)
{
  const int error = service_begin();
  service.config.max_active_trainings = service.config.max_active_campaigns = side_by_side;
  return error == MO_OK ? service_open() : error;
}

static inline int service_reopen(void)
{
  service_close();
  return service_open();
}

/* Sets the states of two jobs in the closed database, as if the process had been killed. */
static inline void service_set_states(int64_t first, int64_t second, enum mo_job_state state)
{
  char sql[128];
  snprintf(sql, sizeof(sql), "UPDATE jobs SET state=%d WHERE id IN (%lld,%lld)", (int)state,
           (long long)first, (long long)second);
  CHECK_OK(outside(sql));
}

/* Begins a case with an open service; parameters as for service_start. */
#define SERVICE_CASE(name, side_by_side)                                                           \
  static void name##_with(void);                                                                   \
  __attribute__((unused)) static void name(void)                                                   \
  {                                                                                                \
    REQUIRE_OK(service_start(side_by_side));                                                       \
    name##_with();                                                                                 \
  }                                                                                                \
  static void name##_with(void)

/* ---- contents of jobs ---- */

/* Returns (n) distinct placed bodies. */
static inline const struct mo_bits *bodies(uint64_t seed, uint32_t n)
{
  return make_bodies(seed, n, NULL);
}

/* Returns the weights that put_weights stores for a seed. */
static inline struct mo_controller *weights_of(uint64_t seed)
{
  struct mo_controller *weights = NULL;
  CHECK_OK(mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &weights));
  mo_controller_randomize(weights, seed);
  return weights;
}

/* Returns the weights of "default". Call it for the first time before there are other threads. */
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
                                        .physics = mo_paper_physics(),
                                        .job.priority = -1,
                                        .record_stride = 100};
}

/* submit_NAME return the job's id or an error. */
#define SUBMIT(name)                                                                               \
  static inline int64_t submit_##name(const struct mo_##name##_request *request)                   \
  {                                                                                                \
    int64_t id = 0;                                                                                \
    bool replayed;                                                                                 \
    const int error =                                                                              \
        mo_jobs_submit_##name(service.jobs, request, &id, &replayed, &fixture.message);            \
    if (error != MO_OK)                                                                            \
      printf("# submission: %s\n", fixture.message.text);                                          \
    return error != MO_OK ? error : id;                                                            \
  }
SUBMIT(evaluation)
SUBMIT(training)
SUBMIT(campaign)
#undef SUBMIT

/* ---- while jobs run ---- */

static inline struct mo_job job_of(int64_t id)
{
  struct mo_job job = {.state = MO_JOB_QUEUED};
  (void)mo_store_job(store, id, &job);
  return job;
}

static inline enum mo_job_state state_of(int64_t id)
{
  return job_of(id).state;
}

static inline bool await_state(int64_t id, enum mo_job_state state)
{
  return AWAIT(state_of(id) == state);
}

/* Waits until the job is final and returns it. */
static inline struct mo_job end_of(int64_t id)
{
  CHECK(AWAIT(mo_job_state_is_final(state_of(id))));
  return job_of(id);
}

/* Returns whether a job succeeds; *job (nullable): its final state. */
static inline bool succeeds(int64_t id, struct mo_job *job)
{
  const struct mo_job ended = end_of(id);
  if (job != NULL)
    *job = ended;
  return ended.state == MO_JOB_SUCCEEDED;
}

/* Checks that the job fails after this many attempts, with this text in its error. */
static inline void check_failed(int64_t id, uint32_t attempts, int error, const char *words)
{
  const struct mo_job job = end_of(id);
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK_INT(job.attempts, attempts);
  CHECK_INT(job.error, error);
  CHECK_HAS(job.error_text, words);
}

static inline struct mo_live live_of(int64_t id)
{
  struct mo_live live;
  mo_jobs_live(service.jobs, id, &live);
  return live;
}

static inline bool await_phase(int64_t id, enum mo_phase phase)
{
  return AWAIT(live_of(id).phase == phase);
}

/* Returns whether the job eventually waits for a reason that contains this text. */
static inline bool await_reason(int64_t id, const char *words)
{
  struct mo_live live;
  bool waits =
      AWAIT((live = live_of(id)).phase == MO_PHASE_WAIT && strstr(live.reason, words) != NULL);
  if (!waits)
    printf("# job %lld: %s\n", (long long)id, live.reason);
  return waits;
}

static inline struct mo_jobs_stats stats_of(void)
{
  struct mo_jobs_stats stats;
  mo_jobs_get_stats(service.jobs, &stats);
  return stats;
}

static inline uint64_t computed(void)
{
  return stats_of().rollouts_computed;
}

/* Figures are updated shortly after a commit, and a runner ends after its job. */
static inline struct mo_jobs_stats idle_stats(void)
{
  struct mo_jobs_stats stats;
  (void)AWAIT((stats = stats_of()).open_jobs == 0 && stats.active_campaigns == 0);
  return stats;
}

/* Returns the number of a job's events of one type. */
static inline int count_events(int64_t id, const char *type)
{
  struct mo_event events[80];
  const int64_t n = mo_store_events(store, 0, id, events, 80, NULL, NULL);
  int found = 0;
  for (int64_t i = 0; i < n; i++)
    found += strcmp(events[i].type, type) == 0;
  return found;
}

#endif
