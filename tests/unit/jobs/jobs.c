/* jobs.c: the scheduler with a fake back end: what is computed, what is not, and what becomes of jobs. */
#include <fcntl.h>
#include <math.h>
#include <pthread.h>
#include <signal.h>
#include <sqlite3.h>
#include <time.h>

#include "../check.h"
#include "../store/fault_vfs.h"
#include "jobs/internal.h"
#include "service.h"

static struct mo_controller *weights;

/* The weights that fixture_controller stores with a seed. */
static const struct mo_controller *default_weights(void)
{
  if (weights == NULL && mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &weights) == MO_OK)
    mo_controller_randomize(weights, 1);
  return weights;
}

static bool right(struct service *service, int64_t id, const struct mo_bits *genotypes)
{
  struct mo_physics physics = mo_default_physics();
  return service_results_right(service, id, genotypes, &physics, MO_FLOAT32, default_weights());
}

static double now_s(void)
{
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static uint64_t computed(struct service *service)
{
  struct mo_jobs_stats stats;
  mo_jobs_get_stats(service->jobs, &stats);
  return stats.rollouts_computed;
}

static enum mo_job_state state_of(struct service *service, int64_t id)
{
  struct mo_job job = {.state = MO_JOB_QUEUED};
  (void)mo_store_job(service->fixture.store, id, &job);
  return job.state;
}

static bool await_state(struct service *service, int64_t id, enum mo_job_state state, double seconds)
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
static struct mo_jobs_stats settled(struct service *service)
{
  struct mo_jobs_stats stats;
  double end = now_s() + 5;
  do {
    mo_jobs_get_stats(service->jobs, &stats);
    usleep(1000);
  } while (stats.open_jobs > 0 && now_s() < end);
  return stats;
}

/* ---- cases ---- */

static void evaluates(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_job job;
  struct mo_jobs_stats stats;
  int64_t id;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(1, 50, &forms, &genotypes) == MO_OK);
  request = service_request(genotypes, 50);
  request.label = "fifty";
  id = service_submit(&service, &request);
  REQUIRE(id > 0);
  REQUIRE(mo_jobs_wait(service.jobs, id, 10000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK_INT(job.priority, MO_BATCH);
  CHECK_INT(job.rollouts_done, 500);
  CHECK_INT(job.rollouts_cached, 0);
  CHECK(job.rollouts_diverged > 0 && job.rollouts_diverged < 100);
  CHECK(job.started_us >= job.created_us && job.finished_us >= job.started_us);
  CHECK(right(&service, id, genotypes));
  stats = settled(&service);
  CHECK_INT(stats.open_jobs, 0);
  CHECK_INT(stats.open_rollouts, 0);
  CHECK_INT(stats.jobs_succeeded, 1);
  CHECK_INT(mo_jobs_wait(service.jobs, 99, 1, &job), MO_ERR_NOT_FOUND);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static void computes_nothing_twice(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes, twice[20];
  struct mo_evaluation_request request;
  struct mo_job job;
  int64_t first, second, third;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(1, 40, &forms, &genotypes) == MO_OK);
  fake_plan.delay_us = 3000;
  request = service_request(genotypes, 30);
  request.priority = MO_BATCH;
  first = service_submit(&service, &request);
  request = service_request(genotypes + 10, 30); /* 20 of them the same, at the same time */
  request.priority = MO_BATCH;
  second = service_submit(&service, &request);
  REQUIRE(mo_jobs_wait(service.jobs, first, 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
  REQUIRE(mo_jobs_wait(service.jobs, second, 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
  CHECK_INT(computed(&service), 400);
  CHECK(right(&service, first, genotypes));
  CHECK(right(&service, second, genotypes + 10));
  /* The same design twice in one request, and again after a restart: from the store. */
  for (int i = 0; i < 20; i++)
    twice[i] = genotypes[30 + i / 2];
  service_close(&service);
  REQUIRE(service_open(&service) == MO_OK);
  request = service_request(twice, 20);
  third = service_submit(&service, &request);
  REQUIRE(mo_jobs_wait(service.jobs, third, 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
  CHECK_INT(computed(&service), 0);
  CHECK_INT(job.rollouts_cached, 200);
  CHECK(right(&service, third, twice));
  /* New ones, doubled within one request. */
  free(forms);
  free(genotypes);
  REQUIRE(fixture_bodies(77, 10, &forms, &genotypes) == MO_OK);
  for (int i = 0; i < 20; i++)
    twice[i] = genotypes[i % 10];
  request = service_request(twice, 20);
  third = service_submit(&service, &request);
  REQUIRE(mo_jobs_wait(service.jobs, third, 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
  CHECK(computed(&service) > 50 && computed(&service) <= 100); /* some small bodies came before */
  CHECK_INT(job.rollouts_cached, 200 - computed(&service));
  CHECK(right(&service, third, twice));
  free(forms);
  free(genotypes);
  service_end(&service);
}

static void puts_interactive_first_and_shares(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_job job;
  int64_t a, b, urgent, tags[400];
  size_t n, of_a = 0, of_b = 0;
  double start;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(3, 201, &forms, &genotypes) == MO_OK);
  fake_plan.delay_us = 4000;
  request = service_request(genotypes, 100);
  a = service_submit(&service, &request);
  request = service_request(genotypes + 100, 100);
  b = service_submit(&service, &request);
  usleep(50000);
  request = service_request(genotypes + 200, 1);
  start = now_s();
  urgent = service_submit(&service, &request);
  REQUIRE(mo_jobs_wait(service.jobs, urgent, 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
  CHECK_INT(job.priority, MO_INTERACTIVE);
  CHECK(now_s() - start < 0.2); /* the two others take 0.4 s more */
  CHECK(state_of(&service, a) == MO_JOB_RUNNING && state_of(&service, b) == MO_JOB_RUNNING);
  REQUIRE(mo_jobs_wait(service.jobs, a, 20000, &job) == MO_OK);
  REQUIRE(mo_jobs_wait(service.jobs, b, 20000, &job) == MO_OK);
  n = fake_history(tags, 400);
  for (size_t i = 20; i < 60 && i < n; i++) { /* once both run, their blocks alternate */
    of_a += tags[i] == a;
    of_b += tags[i] == b;
  }
  CHECK(of_a >= 15 && of_b >= 15);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static void cancels_pauses_resumes(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_job job;
  struct mo_jobs_stats stats;
  int64_t id, other;
  uint64_t before;
  double start;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(4, 60, &forms, &genotypes) == MO_OK);
  fake_plan.delay_us = 5000000;
  request = service_request(genotypes, 50);
  id = service_submit(&service, &request);
  CHECK(await_state(&service, id, MO_JOB_RUNNING, 5));
  start = now_s();
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_OK);
  do {
    usleep(1000);
    mo_jobs_get_stats(service.jobs, &stats);
  } while (stats.blocks_in_flight > 0 && now_s() - start < 3);
  CHECK(now_s() - start < 1); /* blocks of 5 s were broken off */
  CHECK_INT(state_of(&service, id), MO_JOB_CANCELLED);
  CHECK_INT(stats.open_jobs, 0);
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_ERR_CONFLICT);
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_ERR_CONFLICT);
  CHECK_INT(mo_jobs_cancel(service.jobs, 1234), MO_ERR_NOT_FOUND);
  /* Paused in the middle: what is done stays done. */
  fake_plan.delay_us = 20000;
  id = service_submit(&service, &request);
  for (double end = now_s() + 10; computed(&service) == 0 && now_s() < end;)
    usleep(1000);
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
  usleep(300000); /* what was in flight lands */
  before = computed(&service);
  CHECK(before > 0 && before < 500);
  usleep(50000);
  CHECK_INT(computed(&service), before);
  CHECK_INT(state_of(&service, id), MO_JOB_PAUSED);
  fake_plan.delay_us = 1000;
  CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
  CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
  REQUIRE(mo_jobs_wait(service.jobs, id, 20000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK_INT(computed(&service), 500);
  CHECK(right(&service, id, genotypes));
  /* Paused and resumed at once, many times. */
  free(forms);
  free(genotypes);
  REQUIRE(fixture_bodies(5, 60, &forms, &genotypes) == MO_OK);
  fake_plan.delay_us = 50000;
  request = service_request(genotypes, 60);
  id = service_submit(&service, &request);
  for (int i = 0; i < 30; i++) {
    CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
    CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
    usleep((useconds_t)(i * 100));
  }
  /* A shared rollout outlives the job that started it. */
  other = service_submit(&service, &request);
  usleep(5000);
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_OK);
  fake_plan.delay_us = 1000;
  REQUIRE(mo_jobs_wait(service.jobs, other, 20000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK(right(&service, other, genotypes));
  free(forms);
  free(genotypes);
  service_end(&service);
}

/* Whatever kind of job: nothing is computed twice, its own work is not "cached", and its counts never go back. */
static void counts_through_pauses(void)
{
  enum { DESIGNS = 40, ROLLOUTS = DESIGNS * 10, ROUNDS = 12 };
  for (int kind = 0; kind < 3; kind++) {
    struct service service;
    struct mo_bits *forms, *genotypes;
    struct mo_evaluation_request request;
    struct mo_job job = {.state = MO_JOB_QUEUED};
    uint64_t seen = 0, first;
    bool back = false;
    int64_t id;
    REQUIRE(service_start(&service) == MO_OK);
    REQUIRE(fixture_bodies(31, DESIGNS, &forms, &genotypes) == MO_OK);
    fake_plan.delay_us = 10000;
    request = service_request(genotypes, DESIGNS);
    request.verify = kind == 1;
    request.record_com = kind == 2;
    id = service_submit(&service, &request);
    for (int i = 0; i < ROUNDS; i++) {
      CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
      if (i % 3 == 0)
        usleep(30000);
      CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
      for (int k = 0; k < 10; k++) {
        usleep(2500);
        REQUIRE(mo_store_job(service.fixture.store, id, &job) == MO_OK);
        back = back || job.rollouts_done < seen;
        seen = job.rollouts_done;
      }
    }
    CHECK(!back);
    CHECK(!mo_job_state_is_final(job.state));
    /* Paused for good: what was in flight lands and is counted. */
    CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
    usleep(400000);
    first = computed(&service);
    REQUIRE(mo_store_job(service.fixture.store, id, &job) == MO_OK);
    CHECK_INT(job.state, MO_JOB_PAUSED);
    CHECK_INT(job.rollouts_done, first);
    CHECK_INT(job.rollouts_cached, 0);
    /* And by another process. */
    service_close(&service);
    REQUIRE(service_open(&service) == MO_OK);
    REQUIRE(mo_store_job(service.fixture.store, id, &job) == MO_OK);
    CHECK_INT(job.rollouts_done, first);
    CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
    CHECK(await_state(&service, id, MO_JOB_RUNNING, 5));
    REQUIRE(mo_store_job(service.fixture.store, id, &job) == MO_OK);
    CHECK(job.rollouts_done >= first);
    fake_plan.delay_us = 0;
    REQUIRE(mo_jobs_wait(service.jobs, id, 20000, &job) == MO_OK);
    CHECK_INT(job.state, MO_JOB_SUCCEEDED);
    CHECK_INT(job.rollouts_done, ROLLOUTS);
    CHECK_INT(job.rollouts_cached, 0);
    CHECK_INT(first + computed(&service), ROLLOUTS);
    CHECK(right(&service, id, genotypes));
    free(forms);
    free(genotypes);
    service_end(&service);
  }
}

/* One client pauses, another resumes before the first's call has told the scheduler: the wish finds a job that runs. */
static void survives_a_late_wish(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_wish *wish = calloc(1, sizeof(*wish));
  struct mo_job job;
  int64_t id;
  REQUIRE(wish != NULL);
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(16, 60, &forms, &genotypes) == MO_OK);
  fake_plan.delay_us = 5000;
  request = service_request(genotypes, 60);
  id = service_submit(&service, &request);
  CHECK(await_state(&service, id, MO_JOB_RUNNING, 5));
  usleep(20000);
  wish->id = id;
  pthread_mutex_lock(&service.jobs->mutex);
  wish->next = service.jobs->wishes;
  service.jobs->wishes = wish;
  pthread_cond_signal(&service.jobs->news);
  pthread_mutex_unlock(&service.jobs->mutex);
  REQUIRE(mo_jobs_wait(service.jobs, id, 10000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK_INT(job.attempts, 0);
  CHECK(right(&service, id, genotypes));
  free(forms);
  free(genotypes);
  service_end(&service);
}

/* Another process holds the database: what is computed meanwhile has to stay in memory, so it must have an end. */
static void waits_for_a_slow_store(void)
{
  enum { DESIGNS = 4000, IN_MEMORY = 16384 + 5000 };
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_jobs_stats stats = {0};
  struct mo_job job;
  uint64_t before = 0;
  char path[512];
  sqlite3 *db = NULL;
  int64_t id;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(17, DESIGNS, &forms, &genotypes) == MO_OK);
  fake_plan.delay_us = 20000;
  request = service_request(genotypes, DESIGNS);
  id = service_submit(&service, &request);
  CHECK(await_state(&service, id, MO_JOB_RUNNING, 5));
  snprintf(path, sizeof(path), "%s/morphod.db", service.fixture.path);
  REQUIRE(sqlite3_open(path, &db) == SQLITE_OK);
  sqlite3_busy_timeout(db, 5000);
  REQUIRE(sqlite3_exec(db, "BEGIN IMMEDIATE", NULL, NULL, NULL) == SQLITE_OK);
  fake_plan.delay_us = 0;
  for (int i = 0; i < 300; i++) { /* until nothing is computed any more */
    usleep(100000);
    mo_jobs_get_stats(service.jobs, &stats);
    if (stats.rollouts_computed == before && stats.blocks_in_flight == 0)
      break;
    before = stats.rollouts_computed;
  }
  CHECK_INT(stats.blocks_in_flight, 0);
  CHECK(stats.rollouts_computed < IN_MEMORY);
  CHECK_INT(sqlite3_exec(db, "ROLLBACK", NULL, NULL, NULL), SQLITE_OK);
  sqlite3_close(db);
  REQUIRE(mo_jobs_wait(service.jobs, id, 60000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK_INT(job.attempts, 0);
  CHECK_INT(computed(&service), DESIGNS * 10);
  CHECK(right(&service, id, genotypes));
  free(forms);
  free(genotypes);
  service_end(&service);
}

static void parks_and_goes_on(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_job job;
  int64_t id;
  uint64_t first;
  double start;
  bool replayed;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(6, 100, &forms, &genotypes) == MO_OK);
  fake_plan.delay_us = 4000;
  request = service_request(genotypes, 100);
  id = service_submit(&service, &request);
  for (double end = now_s() + 10; computed(&service) == 0 && now_s() < end;)
    usleep(1000);
  fake_plan.delay_us = 60000000;
  usleep(20000);
  start = now_s();
  CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_OK);
  CHECK(now_s() - start < 2);
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &request, &id, &replayed, NULL), MO_ERR_CANCELLED);
  first = computed(&service);
  CHECK(first > 0 && first < 1000);
  REQUIRE(mo_store_job(service.fixture.store, id, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_QUEUED);
  CHECK_INT(job.rollouts_done, first);
  CHECK_INT(job.attempts, 0);
  service_close(&service);
  fake_plan.delay_us = 0;
  REQUIRE(service_open(&service) == MO_OK);
  REQUIRE(mo_jobs_wait(service.jobs, id, 10000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK_INT(computed(&service), 1000 - first);
  CHECK_INT(job.rollouts_cached, 0); /* its own earlier work is not "cached" */
  CHECK(right(&service, id, genotypes));
  free(forms);
  free(genotypes);
  service_end(&service);
}

static void verifies(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_evaluation_results *results = NULL;
  struct mo_job job;
  int64_t id;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(7, 8, &forms, &genotypes) == MO_OK);
  request = service_request(genotypes, 6);
  id = service_submit(&service, &request);
  REQUIRE(mo_jobs_wait(service.jobs, id, 10000, &job) == MO_OK);
  request = service_request(genotypes, 8);
  request.verify = true;
  id = service_submit(&service, &request);
  REQUIRE(mo_jobs_wait(service.jobs, id, 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
  CHECK_INT(computed(&service), 140);
  REQUIRE(mo_store_results(service.fixture.store, id, &results) == MO_OK);
  for (int i = 0; i < 8; i++)
    CHECK_INT(results->agrees[i], 1);
  CHECK(isnan(results->stored_losses[70]) && !isnan(results->losses[70]));
  mo_evaluation_results_free(results);
  CHECK(right(&service, id, genotypes));
  /* As if other code had computed them. */
  fake_plan.skew = 1;
  id = service_submit(&service, &request);
  REQUIRE(mo_jobs_wait(service.jobs, id, 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
  REQUIRE(mo_store_results(service.fixture.store, id, &results) == MO_OK);
  for (int i = 0; i < 8; i++)
    CHECK_INT(results->agrees[i], 0);
  CHECK(results->losses[0] == results->stored_losses[0] + 1 || isinf(results->losses[0]));
  mo_evaluation_results_free(results);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static void records(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_trajectory *trajectory = NULL;
  struct mo_job job;
  int64_t id = 0;
  bool replayed;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(8, 3, &forms, &genotypes) == MO_OK);
  for (int round = 0; round < 2; round++) { /* recorded even when the scores are known */
    request = service_request(genotypes, 3);
    request.record_com = request.record_masses = true;
    id = service_submit(&service, &request);
    REQUIRE(id > 0);
    REQUIRE(mo_jobs_wait(service.jobs, id, 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
    CHECK(right(&service, id, genotypes));
    REQUIRE(mo_store_trajectory(service.fixture.store, id, 2, 9, &trajectory) == MO_OK);
    CHECK_INT(trajectory->n_frames, 11);
    CHECK_INT(trajectory->stride, 100);
    CHECK(trajectory->com_m != NULL && trajectory->mass_m != NULL);
    CHECK(trajectory->com_m[5] == trajectory->com_m[0] + 5 || isinf(trajectory->com_m[0]));
    CHECK(trajectory->mass_m[7] == 7.0F);
    mo_trajectory_free(trajectory);
  }
  CHECK_INT(computed(&service), 60);
  request.record_stride = 1;
  free(forms);
  free(genotypes);
  REQUIRE(fixture_bodies(8, 200, &forms, &genotypes) == MO_OK);
  request.genotypes = genotypes;
  request.n_designs = 200;
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &request, &id, &replayed, &service.fixture.message), MO_ERR_LIMIT);
  CHECK(strstr(service.fixture.message.text, "67108864") != NULL);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static void refuses(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes, apart = {{0}};
  struct mo_evaluation_request request, bad;
  struct mo_environment environment;
  int64_t id = 0, again = 0;
  bool replayed = false;
  REQUIRE(service_start(&service) == MO_OK);
  service_close(&service);
  service.config.max_open_jobs = 2;
  service.config.max_open_rollouts = 300;
  REQUIRE(service_open(&service) == MO_OK);
  REQUIRE(fixture_bodies(9, 40, &forms, &genotypes) == MO_OK);
  fake_plan.delay_us = 20000;
  request = service_request(genotypes, 20);
  request.idempotency_key = "k";
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &request, &id, &replayed, NULL), MO_OK);
  bad = service_request(genotypes + 20, 20);
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, &service.fixture.message), MO_ERR_BUSY);
  bad.n_designs = 1;
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, NULL), MO_OK);
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, NULL), MO_ERR_BUSY);
  /* A known key is answered even now. */
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &request, &again, &replayed, NULL), MO_OK);
  CHECK(replayed && again == id);
  mo_sha256_of("x", 1, &request.body_sha256);
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &request, &again, &replayed, NULL), MO_ERR_CONFLICT);
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_OK);
  bad = service_request(genotypes, 1);
  bad.controller = "nobody";
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, &service.fixture.message),
            MO_ERR_NOT_FOUND);
  CHECK(strstr(service.fixture.message.text, "nobody") != NULL);
  bad = service_request(genotypes, 1);
  bad.environment_set = "elsewhere";
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, &service.fixture.message),
            MO_ERR_NOT_FOUND);
  bad = service_request(genotypes, 0);
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, NULL), MO_ERR_RANGE);
  bad = service_request(&apart, 1);
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, NULL), MO_ERR_INVALID);
  apart.words[0] = 0x8001;
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, NULL), MO_ERR_INVALID);
  bad = service_request(genotypes, 1);
  bad.environment_set = NULL;
  bad.environments = &environment;
  bad.n_environments = 1;
  mo_environment_training(1, 0, 0, &environment);
  environment.terrain_heights_m[5] = NAN;
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, NULL), MO_ERR_INVALID);
  bad = service_request(genotypes, 1);
  bad.physics.dt_s = -1;
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, NULL), MO_ERR_RANGE);
  bad = service_request(genotypes, 1);
  bad.record_com = true;
  bad.record_stride = 0;
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &bad, &again, &replayed, NULL), MO_ERR_RANGE);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static void parks_after_three_errors(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_jobs_stats stats;
  struct mo_job job;
  int64_t id;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(10, 10, &forms, &genotypes) == MO_OK);
  fake_plan.fail_word = genotypes[5].words[0];
  fake_plan.fail_times = 1;
  fake_plan.fail_status = MO_ERR_NO_MEMORY;
  request = service_request(genotypes, 10);
  id = service_submit(&service, &request);
  REQUIRE(mo_jobs_wait(service.jobs, id, 10000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED); /* once is forgiven */
  CHECK_INT(job.attempts, 1);
  CHECK(right(&service, id, genotypes));
  free(forms);
  free(genotypes);
  REQUIRE(fixture_bodies(11, 10, &forms, &genotypes) == MO_OK);
  fake_plan.fail_word = genotypes[5].words[0];
  fake_plan.fail_times = 1000;
  request = service_request(genotypes, 10);
  id = service_submit(&service, &request);
  REQUIRE(mo_jobs_wait(service.jobs, id, 20000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK_INT(job.attempts, 3);
  CHECK_INT(job.error, MO_ERR_NO_MEMORY);
  CHECK(strstr(job.error_text, "out of memory") != NULL);
  stats = settled(&service);
  CHECK_INT(stats.open_jobs, 0);
  CHECK_INT(stats.jobs_failed, 1);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static void refuses_nan(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(23, 4, &forms, &genotypes) == MO_OK);
  for (int recorded = 0; recorded < 2; recorded++) {
    struct mo_evaluation_request request = service_request(genotypes, 4);
    struct mo_evaluation_results *results = NULL;
    struct mo_job job;
    int64_t id;
    request.record_com = recorded != 0;
    fake_plan.poison = true;
    id = service_submit(&service, &request);
    REQUIRE(mo_jobs_wait(service.jobs, id, 15000, &job) == MO_OK);
    CHECK_INT(job.state, MO_JOB_FAILED);
    CHECK(strstr(job.error_text, "not a number") != NULL);
    CHECK_INT(job.rollouts_done, 0);
    REQUIRE(mo_store_results(service.fixture.store, id, &results) == MO_OK);
    CHECK(isnan(results->losses[0])); /* nothing there */
    mo_evaluation_results_free(results);
    fake_plan.poison = false;
  }
  CHECK_INT(computed(&service), 0);
  CHECK_INT(mo_store_check(service.fixture.store, &service.fixture.message), MO_OK);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static atomic_int warnings;

static void hear_warning(void *context, int64_t job, int error, const char *text)
{
  (void)context;
  (void)job;
  if (error == MO_ERR_CORRUPT && strstr(text, ".safetensors") != NULL)
    atomic_fetch_add(&warnings, 1);
}

static void names_a_damaged_controller(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_controller_record record;
  struct mo_job job;
  char digits[MO_SHA256_DIGITS + 1], path[512];
  int64_t id;
  REQUIRE(service_start(&service) == MO_OK);
  service_close(&service);
  service.config.warn = hear_warning;
  REQUIRE(service_open(&service) == MO_OK);
  REQUIRE(fixture_bodies(24, 2, &forms, &genotypes) == MO_OK);
  REQUIRE(mo_store_controller(service.fixture.store, "default", &record) == MO_OK);
  mo_sha256_to_hex(&record.sha256, digits);
  snprintf(path, sizeof(path), "%s/controllers/%s.safetensors", service.fixture.path, digits);
  CHECK_INT(truncate(path, 100), 0);
  atomic_store(&warnings, 0);
  request = service_request(genotypes, 2);
  id = service_submit(&service, &request);
  REQUIRE(mo_jobs_wait(service.jobs, id, 15000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK_INT(job.error, MO_ERR_CORRUPT);
  CHECK(strstr(job.error_text, digits) != NULL && strstr(job.error_text, "PUT") != NULL);
  CHECK(strstr(job.error_text, "submit again") != NULL); /* to its end */
  CHECK_INT(atomic_load(&warnings), 3);
  /* As it says: */
  REQUIRE(fixture_controller(service.fixture.store, "again", 1, &record) == MO_OK);
  id = service_submit(&service, &request);
  REQUIRE(mo_jobs_wait(service.jobs, id, 15000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  free(forms);
  free(genotypes);
  service_end(&service);
}

/* The save that fails holds the start of the job, or one of its errors, or neither. */
static void parks_what_cannot_be_saved(void)
{
  for (int round = 0; round < 3; round++) {
    struct service service;
    struct mo_bits *forms, *genotypes;
    struct mo_evaluation_request request;
    struct mo_jobs_stats stats;
    struct mo_job job;
    int64_t id, fingerprint;
    REQUIRE(service_start(&service) == MO_OK);
    REQUIRE(fixture_bodies(21, 4, &forms, &genotypes) == MO_OK);
    fingerprint = service.jobs->fingerprints[MO_FLOAT32];
    service.jobs->fingerprints[MO_FLOAT32] = 999; /* no such row: the store refuses the losses */
    fake_plan.delay_us = round == 0 ? 0 : 250000;
    fake_plan.fail_word = genotypes[1].words[0];
    fake_plan.fail_times = 1000;
    fake_plan.fail_status = round == 1 ? MO_ERR_NO_MEMORY : 0;
    request = service_request(genotypes, 4);
    request.priority = round == 0 ? MO_INTERACTIVE : MO_BATCH;
    id = service_submit(&service, &request);
    REQUIRE(mo_jobs_wait(service.jobs, id, 15000, &job) == MO_OK);
    CHECK_INT(job.state, MO_JOB_FAILED);
    CHECK_INT(job.attempts, 3);
    stats = settled(&service);
    CHECK_INT(stats.open_jobs, 0);
    /* The others go on. */
    service.jobs->fingerprints[MO_FLOAT32] = fingerprint;
    fake_plan.fail_status = 0;
    fake_plan.delay_us = 0;
    free(forms);
    free(genotypes);
    REQUIRE(fixture_bodies(19, 5, &forms, &genotypes) == MO_OK);
    request = service_request(genotypes, 5);
    id = service_submit(&service, &request);
    REQUIRE(mo_jobs_wait(service.jobs, id, 10000, &job) == MO_OK);
    CHECK_INT(job.state, MO_JOB_SUCCEEDED);
    CHECK(right(&service, id, genotypes));
    free(forms);
    free(genotypes);
    service_end(&service);
  }
}

static void blames_crashes_on_their_job(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_job job;
  char marker[512];
  int64_t id, other;
  int fd;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(12, 20, &forms, &genotypes) == MO_OK);
  snprintf(marker, sizeof(marker), "%s/crash", service.fixture.path);
  service.config.crash_marker = marker;
  fake_plan.delay_us = 60000000;
  request = service_request(genotypes, 10);
  id = service_submit(&service, &request);
  request = service_request(genotypes + 10, 10);
  other = service_submit(&service, &request);
  for (int round = 1; round <= 3; round++) {
    CHECK(await_state(&service, id, MO_JOB_RUNNING, 5));
    /* A thread that is in no block writes nothing. */
    fd = open(marker, O_WRONLY | O_CREAT | O_APPEND, 0600);
    REQUIRE(fd >= 0);
    mo_jobs_crash_note(fd, SIGSEGV);
    CHECK_INT(lseek(fd, 0, SEEK_END), 0);
    dprintf(fd, "%lld %d\n", (long long)id, SIGSEGV); /* what a worker's handler writes */
    close(fd);
    service_close(&service);
    {
      /* As if it had been killed: running in the file, or still queued: the start of a job is written some time after it. */
      char path[512], sql[128];
      sqlite3 *db = NULL;
      snprintf(path, sizeof(path), "%s/morphod.db", service.fixture.path);
      snprintf(sql, sizeof(sql), "UPDATE jobs SET state=%d WHERE id IN (%lld,%lld)", round == 2 ? 0 : 1, (long long)id,
               (long long)other);
      REQUIRE(sqlite3_open(path, &db) == SQLITE_OK);
      CHECK_INT(sqlite3_exec(db, sql, NULL, NULL, NULL), SQLITE_OK);
      sqlite3_close(db);
    }
    REQUIRE(service_open(&service) == MO_OK);
    REQUIRE(mo_store_job(service.fixture.store, id, &job) == MO_OK);
    CHECK_INT(job.attempts, round);
  }
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK(strstr(job.error_text, "signal 11") != NULL);
  fake_plan.delay_us = 0;
  service_close(&service);
  REQUIRE(service_open(&service) == MO_OK); /* the marker was emptied: nobody is blamed */
  REQUIRE(mo_jobs_wait(service.jobs, other, 10000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK_INT(job.attempts, 0);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static void waits_for_room(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_jobs_stats stats;
  struct mo_job job;
  int64_t id, other;
  bool replayed;
  REQUIRE(fault_vfs_register() == SQLITE_OK);
  REQUIRE(service_start(&service) == MO_OK);
  service_close(&service);
  service.vfs = "faults";
  REQUIRE(service_open(&service) == MO_OK);
  REQUIRE(fixture_bodies(13, 60, &forms, &genotypes) == MO_OK);
  fake_plan.delay_us = 10000;
  request = service_request(genotypes, 50);
  id = service_submit(&service, &request);
  CHECK(await_state(&service, id, MO_JOB_RUNNING, 5));
  atomic_store(&fault_plan.writes_left, 0);
  atomic_store(&fault_plan.write_error, SQLITE_FULL);
  for (int i = 0; i < 2000; i++) {
    mo_jobs_get_stats(service.jobs, &stats);
    if (stats.no_space)
      break;
    usleep(1000);
  }
  CHECK(stats.no_space);
  request = service_request(genotypes + 50, 10);
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &request, &other, &replayed, &service.fixture.message),
            MO_ERR_NO_SPACE);
  CHECK_INT(state_of(&service, id), MO_JOB_RUNNING); /* reading goes on */
  usleep(300000);
  mo_jobs_get_stats(service.jobs, &stats);
  CHECK_INT(stats.blocks_in_flight, 0); /* nothing is computed that cannot be kept */
  atomic_store(&fault_plan.write_error, 0);
  REQUIRE(mo_jobs_wait(service.jobs, id, 20000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK(right(&service, id, genotypes));
  CHECK_INT(computed(&service), 500);
  mo_jobs_get_stats(service.jobs, &stats);
  CHECK(!stats.no_space);
  other = service_submit(&service, &request);
  REQUIRE(mo_jobs_wait(service.jobs, other, 20000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK_INT(mo_store_check(service.fixture.store, &service.fixture.message), MO_OK);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static void answers_from_its_cache_of_controllers(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_controller_record record;
  struct mo_job job;
  char names[5][32];
  int64_t ids[5];
  REQUIRE(service_start(&service) == MO_OK);
  service_close(&service);
  service.config.controllers_kept = 2;
  REQUIRE(service_open(&service) == MO_OK);
  REQUIRE(fixture_bodies(14, 10, &forms, &genotypes) == MO_OK);
  for (int i = 0; i < 5; i++) {
    snprintf(names[i], sizeof(names[i]), "seed-%d", i);
    REQUIRE(fixture_controller(service.fixture.store, names[i], (uint64_t)(100 + i), &record) == MO_OK);
  }
  for (int i = 0; i < 5; i++) {
    request = service_request(genotypes, 10);
    request.controller = names[i];
    request.precision = MO_FLOAT64;
    ids[i] = service_submit(&service, &request);
    REQUIRE(ids[i] > 0);
  }
  for (int i = 0; i < 5; i++) {
    struct mo_controller *controller = NULL;
    struct mo_physics physics = mo_default_physics();
    REQUIRE(mo_jobs_wait(service.jobs, ids[i], 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
    REQUIRE(mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &controller) == MO_OK);
    mo_controller_randomize(controller, (uint64_t)(100 + i));
    CHECK(service_results_right(&service, ids[i], genotypes, &physics, MO_FLOAT64, controller));
    mo_controller_free(controller);
  }
  CHECK_INT(computed(&service), 500);
  free(forms);
  free(genotypes);
  service_end(&service);
}

/* ---- many clients at once ---- */

struct client {
  struct service *service;
  const struct mo_bits *genotypes;
  uint32_t seed;
  int failures;
};

static void *be_a_client(void *context)
{
  struct client *client = context;
  for (uint32_t i = 0; i < 12; i++) {
    struct mo_evaluation_request request = service_request(client->genotypes + (client->seed * 7 + i * 3) % 80, 10);
    struct mo_job job;
    int64_t id = 0;
    bool replayed = false;
    request.priority = (int)(i % 2);
    if (mo_jobs_submit_evaluation(client->service->jobs, &request, &id, &replayed, NULL) != MO_OK) {
      client->failures++;
      continue;
    }
    if (i % 5 == 4) {
      (void)mo_jobs_cancel(client->service->jobs, id);
      continue;
    }
    for (uint32_t k = 0; k < i % 3; k++) { /* perhaps before its start is written */
      (void)mo_jobs_pause(client->service->jobs, id);
      (void)mo_jobs_resume(client->service->jobs, id);
    }
    if (mo_jobs_wait(client->service->jobs, id, 20000, &job) != MO_OK || job.state != MO_JOB_SUCCEEDED ||
        !right(client->service, id, request.genotypes))
      client->failures++;
  }
  return NULL;
}

static void serves_many_clients(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct client clients[8];
  pthread_t threads[8];
  struct mo_jobs_stats stats;
  (void)default_weights();
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(15, 90, &forms, &genotypes) == MO_OK);
  fake_plan.delay_us = 400;
  for (uint32_t i = 0; i < 8; i++) {
    clients[i] = (struct client){&service, genotypes, i, 0};
    REQUIRE(pthread_create(&threads[i], NULL, be_a_client, &clients[i]) == 0);
  }
  for (uint32_t i = 0; i < 8; i++) {
    pthread_join(threads[i], NULL);
    CHECK_INT(clients[i].failures, 0);
  }
  stats = settled(&service);
  CHECK_INT(stats.open_jobs, 0);
  CHECK(stats.rollouts_computed <= 900);
  CHECK_INT(mo_store_check(service.fixture.store, &service.fixture.message), MO_OK);
  free(forms);
  free(genotypes);
  service_end(&service);
}

static const struct check_case cases[] = {
    {"evaluates", evaluates},
    {"computes nothing twice", computes_nothing_twice},
    {"puts interactive jobs first and shares among batch jobs", puts_interactive_first_and_shares},
    {"cancels, pauses and resumes", cancels_pauses_resumes},
    {"counts through pauses", counts_through_pauses},
    {"survives a wish that comes late", survives_a_late_wish},
    {"waits for a slow store", waits_for_a_slow_store},
    {"parks at a stop and goes on after it", parks_and_goes_on},
    {"verifies bits", verifies},
    {"records", records},
    {"refuses what it must", refuses},
    {"parks a job after three errors", parks_after_three_errors},
    {"names a damaged controller", names_a_damaged_controller},
    {"refuses losses that are not numbers", refuses_nan},
    {"parks a job whose losses cannot be saved", parks_what_cannot_be_saved},
    {"blames crashes on their job", blames_crashes_on_their_job},
    {"waits for room on the disk", waits_for_room},
    {"keeps few controllers ready", answers_from_its_cache_of_controllers},
    {"serves many clients at once", serves_many_clients},
};
CHECK_MAIN(cases)
