/* jobs.c: the scheduler with a fake back end: what is computed, in which order, and what is not. */
#include <math.h>
#include <pthread.h>
#include <sqlite3.h>

#include "../check.h"
#include "jobs/state.h"
#include "service.h"
#include "watch.h"

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
  REQUIRE(await_end(service.jobs, id, 10000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK_INT(job.priority, MO_BATCH);
  CHECK_INT(job.rollouts_done, 500);
  CHECK_INT(job.rollouts_cached, 0);
  CHECK(job.rollouts_diverged > 0 && job.rollouts_diverged < 100);
  CHECK(job.started_us >= job.created_us && job.finished_us >= job.started_us);
  CHECK(right(&service, id, genotypes));
  stats = idle_stats(&service);
  CHECK_INT(stats.open_jobs, 0);
  CHECK_INT(stats.open_rollouts, 0);
  CHECK_INT(stats.jobs_succeeded, 1);
  CHECK_INT(await_end(service.jobs, 99, 1, &job), MO_ERR_NOT_FOUND);
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
  REQUIRE(await_end(service.jobs, first, 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
  REQUIRE(await_end(service.jobs, second, 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
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
  REQUIRE(await_end(service.jobs, third, 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
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
  REQUIRE(await_end(service.jobs, third, 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
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
  REQUIRE(await_end(service.jobs, urgent, 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
  CHECK_INT(job.priority, MO_INTERACTIVE);
  CHECK(now_s() - start < 0.2); /* the two others take 0.4 s more */
  CHECK(state_of(&service, a) == MO_JOB_RUNNING && state_of(&service, b) == MO_JOB_RUNNING);
  REQUIRE(await_end(service.jobs, a, 20000, &job) == MO_OK);
  REQUIRE(await_end(service.jobs, b, 20000, &job) == MO_OK);
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
  /* Paused: likewise. */
  id = service_submit(&service, &request);
  CHECK(await_state(&service, id, MO_JOB_RUNNING, 5));
  start = now_s();
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
  do {
    usleep(1000);
    mo_jobs_get_stats(service.jobs, &stats);
  } while (stats.blocks_in_flight > 0 && now_s() - start < 3);
  CHECK(now_s() - start < 1);
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_OK);
  /* Paused in the middle: what is done stays done. */
  fake_plan.delay_us = 20000;
  id = service_submit(&service, &request);
  for (double end = now_s() + 10; computed(&service) == 0 && now_s() < end;)
    usleep(1000);
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
  usleep(300000); /* what was in flight ends */
  before = computed(&service);
  CHECK(before > 0 && before < 500);
  usleep(50000);
  CHECK_INT(computed(&service), before);
  CHECK_INT(state_of(&service, id), MO_JOB_PAUSED);
  fake_plan.delay_us = 1000;
  CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
  CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
  REQUIRE(await_end(service.jobs, id, 20000, &job) == MO_OK);
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
  REQUIRE(await_end(service.jobs, other, 20000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK(right(&service, other, genotypes));
  free(forms);
  free(genotypes);
  service_end(&service);
}

/* Whatever kind of job: nothing is computed twice, its own work is not "cached", and its counts
 * never go back. */
static void counts_through_pauses(void)
{
  enum { DESIGNS = 200, ROLLOUTS = DESIGNS * 10, ROUNDS = 12 };
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
    fake_plan.delay_us =
        10000; /* some blocks end between two pauses, which break off the others; it does not end */
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
    for (int k = 0; k < 4000 && computed(&service) == 0; k++)
      usleep(2500);
    /* Paused for good: what was in flight ends and is counted. */
    CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
    usleep(400000);
    first = computed(&service);
    CHECK(first > 0);
    REQUIRE(mo_store_job(service.fixture.store, id, &job) == MO_OK);
    CHECK_INT(job.state, MO_JOB_PAUSED);
    CHECK_INT(job.rollouts_done, first);
    CHECK_INT(job.rollouts_cached, 0);
    /* And by another process. */
    service_close(&service);
    REQUIRE(service_open(&service) == MO_OK);
    REQUIRE(mo_store_job(service.fixture.store, id, &job) == MO_OK);
    CHECK_INT(job.rollouts_done, first);
    fake_plan.delay_us = 300000;
    CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
    CHECK(await_state(&service, id, MO_JOB_RUNNING, 5));
    REQUIRE(mo_store_job(service.fixture.store, id, &job) == MO_OK);
    CHECK(job.rollouts_done >= first);
    fake_plan.delay_us = 0;
    REQUIRE(await_end(service.jobs, id, 20000, &job) == MO_OK);
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

/* One client pauses, another resumes before the scheduler has looked: the request finds a job that
 * is to run. */
static void survives_a_late_request(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_job job;
  int64_t id;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(16, 60, &forms, &genotypes) == MO_OK);
  fake_plan.delay_us = 5000;
  request = service_request(genotypes, 60);
  id = service_submit(&service, &request);
  CHECK(await_state(&service, id, MO_JOB_RUNNING, 5));
  usleep(20000);
  mo_runners_request(&service.jobs->runners[MO_JOB_EVALUATION], id, MO_REQUEST_PAUSE);
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
  CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
  REQUIRE(await_end(service.jobs, id, 10000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK_INT(job.attempts, 0);
  CHECK(right(&service, id, genotypes));
  free(forms);
  free(genotypes);
  service_end(&service);
}

/* Another process holds the database: what is computed meanwhile has to stay in memory, so it must
 * have an end. */
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
  REQUIRE(await_end(service.jobs, id, 60000, &job) == MO_OK);
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
  CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &request, &id, &replayed, NULL),
            MO_ERR_CANCELLED);
  first = computed(&service);
  CHECK(first > 0 && first < 1000);
  REQUIRE(mo_store_job(service.fixture.store, id, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_QUEUED);
  CHECK_INT(job.rollouts_done, first);
  CHECK_INT(job.attempts, 0);
  service_close(&service);
  fake_plan.delay_us = 0;
  REQUIRE(service_open(&service) == MO_OK);
  REQUIRE(await_end(service.jobs, id, 10000, &job) == MO_OK);
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
  REQUIRE(await_end(service.jobs, id, 10000, &job) == MO_OK);
  request = service_request(genotypes, 8);
  request.verify = true;
  id = service_submit(&service, &request);
  REQUIRE(await_end(service.jobs, id, 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
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
  REQUIRE(await_end(service.jobs, id, 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
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
    REQUIRE(await_end(service.jobs, id, 10000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
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
  CHECK_INT(
      mo_jobs_submit_evaluation(service.jobs, &request, &id, &replayed, &service.fixture.message),
      MO_ERR_LIMIT);
  CHECK(strstr(service.fixture.message.text, "67108864") != NULL);
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
    {"survives a request that comes late", survives_a_late_request},
    {"waits for a slow store", waits_for_a_slow_store},
    {"parks at a stop and goes on after it", parks_and_goes_on},
    {"verifies bits", verifies},
    {"records", records},
};
CHECK_MAIN(cases)
