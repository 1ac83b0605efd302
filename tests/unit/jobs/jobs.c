/* jobs.c: the scheduler with a fake back end: what is computed, in which order, and what is not. */

#include "fakes.h"

SERVICE_CASE(evaluates, 0)
{
  const struct mo_bits *genotypes;
  struct mo_evaluation_request request;
  struct mo_job job;
  struct mo_jobs_stats stats;
  int64_t id;
  genotypes = bodies(service, 1, 50);
  request = service_request(genotypes, 50);
  request.label = "fifty";
  id = service_submit(service, &request);
  REQUIRE(id > 0);
  CHECK(succeeds(service, id, &job));
  CHECK_INT(job.priority, MO_BATCH);
  CHECK_INT(job.rollouts_done, 500);
  CHECK_INT(job.rollouts_cached, 0);
  CHECK(job.rollouts_diverged > 0 && job.rollouts_diverged < 100);
  CHECK(job.started_us >= job.created_us && job.finished_us >= job.started_us);
  CHECK(right(service, id, genotypes));
  stats = idle_stats(service);
  CHECK_INT(stats.open_jobs, 0);
  CHECK_INT(stats.open_rollouts, 0);
  CHECK_INT(stats.jobs_succeeded, 1);
}

SERVICE_CASE(computes_nothing_twice, 0)
{
  const struct mo_bits *genotypes;
  struct mo_bits twice[20];
  struct mo_evaluation_request request;
  struct mo_job job;
  int64_t first, second, third;
  genotypes = bodies(service, 1, 40);
  fake_plan.delay_us = 3000;
  request = service_request(genotypes, 30);
  request.priority = MO_BATCH;
  first = service_submit(service, &request);
  request = service_request(genotypes + 10, 30); /* 20 of them the same, at the same time */
  request.priority = MO_BATCH;
  second = service_submit(service, &request);
  CHECK(succeeds(service, first, &job));
  CHECK(succeeds(service, second, &job));
  CHECK_INT(computed(service), 400);
  CHECK(right(service, first, genotypes));
  CHECK(right(service, second, genotypes + 10));
  /* The same design twice in one request, and again after a restart: from the store. */
  for (int i = 0; i < 20; i++)
    twice[i] = genotypes[30 + i / 2];
  REQUIRE(service_reopen(service) == MO_OK);
  third = evaluate(service, twice, 20);
  CHECK(succeeds(service, third, &job));
  CHECK_INT(computed(service), 0);
  CHECK_INT(job.rollouts_cached, 200);
  CHECK(right(service, third, twice));
  /* New ones, doubled within one request. */
  genotypes = bodies(service, 77, 10);
  for (int i = 0; i < 20; i++)
    twice[i] = genotypes[i % 10];
  third = evaluate(service, twice, 20);
  CHECK(succeeds(service, third, &job));
  CHECK(computed(service) > 50 && computed(service) <= 100); /* some small bodies came before */
  CHECK_INT(job.rollouts_cached, 200 - computed(service));
  CHECK(right(service, third, twice));
}

SERVICE_CASE(puts_interactive_first_and_shares, 0)
{
  const struct mo_bits *genotypes;
  struct mo_job job;
  int64_t a, b, urgent, tags[400];
  size_t n, of_a = 0, of_b = 0;
  genotypes = bodies(service, 3, 201);
  fake_plan.delay_us = 4000;
  a = evaluate(service, genotypes, 100);
  b = evaluate(service, genotypes + 100, 100);
  usleep(50000);
  urgent = evaluate(service, genotypes + 200, 1);
  CHECK(succeeds(service, urgent, &job));
  CHECK_INT(job.priority, MO_INTERACTIVE);
  /* The two others take 0.4 s more. */
  CHECK(state_of(service, a) == MO_JOB_RUNNING && state_of(service, b) == MO_JOB_RUNNING);
  (void)end_of(service, a);
  (void)end_of(service, b);
  n = fake_history(tags, 400);
  for (size_t i = 20; i < 60 && i < n; i++) { /* once both run, their blocks alternate */
    of_a += tags[i] == a;
    of_b += tags[i] == b;
  }
  CHECK(of_a >= 15 && of_b >= 15);
}

/* Ends a running job of blocks of 5 s, and returns whether they were broken off at once. */
static bool breaks_off(struct service *service, const struct mo_bits *genotypes,
                       int (*request)(struct mo_jobs *jobs, int64_t id), int64_t *id)
{
  double begin;
  *id = evaluate(service, genotypes, 50);
  CHECK(await_state(service, *id, MO_JOB_RUNNING));
  begin = now_s();
  CHECK_INT(request(service->jobs, *id), MO_OK);
  return AWAIT(stats_of(service).blocks_in_flight == 0) && now_s() - begin < 1;
}

SERVICE_CASE(cancels_pauses_resumes, 0)
{
  const struct mo_bits *genotypes;
  int64_t id, other;
  uint64_t before;
  genotypes = bodies(service, 4, 60);
  fake_plan.delay_us = 5000000;
  CHECK(breaks_off(service, genotypes, mo_jobs_cancel, &id));
  CHECK_INT(state_of(service, id), MO_JOB_CANCELLED);
  CHECK_INT(stats_of(service).open_jobs, 0);
  CHECK_INT(mo_jobs_cancel(service->jobs, id), MO_ERR_CONFLICT);
  CHECK_INT(mo_jobs_pause(service->jobs, id), MO_ERR_CONFLICT);
  CHECK_INT(mo_jobs_cancel(service->jobs, 1234), MO_ERR_NOT_FOUND);
  CHECK(breaks_off(service, genotypes, mo_jobs_pause, &id));
  CHECK_INT(mo_jobs_cancel(service->jobs, id), MO_OK);
  /* Paused in the middle: what is done stays done. */
  fake_plan.delay_us = 20000;
  id = evaluate(service, genotypes, 50);
  CHECK(AWAIT(computed(service) > 0));
  CHECK_INT(mo_jobs_pause(service->jobs, id), MO_OK);
  CHECK_INT(mo_jobs_pause(service->jobs, id), MO_OK);
  usleep(300000); /* what was in flight ends */
  before = computed(service);
  CHECK(before > 0 && before < 500);
  usleep(50000);
  CHECK_INT(computed(service), before);
  CHECK_INT(state_of(service, id), MO_JOB_PAUSED);
  fake_plan.delay_us = 1000;
  CHECK_INT(mo_jobs_resume(service->jobs, id), MO_OK);
  CHECK_INT(mo_jobs_resume(service->jobs, id), MO_OK);
  CHECK(succeeds(service, id, NULL));
  CHECK_INT(computed(service), 500);
  CHECK(right(service, id, genotypes));
  /* Paused and resumed at once, many times. */
  genotypes = bodies(service, 5, 60);
  fake_plan.delay_us = 50000;
  id = evaluate(service, genotypes, 60);
  for (int i = 0; i < 30; i++) {
    CHECK_INT(mo_jobs_pause(service->jobs, id), MO_OK);
    CHECK_INT(mo_jobs_resume(service->jobs, id), MO_OK);
    usleep((useconds_t)(i * 100));
  }
  /* A shared rollout outlives the job that started it. */
  other = evaluate(service, genotypes, 60);
  usleep(5000);
  CHECK_INT(mo_jobs_cancel(service->jobs, id), MO_OK);
  fake_plan.delay_us = 1000;
  CHECK(succeeds(service, other, NULL));
  CHECK(right(service, other, genotypes));
}

/* Whatever kind of job: nothing is computed twice, its own work is not "cached", and its counts
 * never go back. */
static void counts_through_pauses(void)
{
  enum { DESIGNS = 200, ROLLOUTS = DESIGNS * 10, ROUNDS = 12 };
  for (int kind = 0; kind < 3; kind++) {
    struct service service;
    const struct mo_bits *genotypes;
    struct mo_evaluation_request request;
    struct mo_job job = {.state = MO_JOB_QUEUED};
    uint64_t seen = 0, first;
    bool back = false;
    int64_t id;
    REQUIRE(service_start(&service, 0) == MO_OK);
    genotypes = bodies(&service, 31, DESIGNS);
    fake_plan.delay_us =
        10000; /* some blocks end between two pauses, which break off the others; it does not end */
    request = service_request(genotypes, DESIGNS);
    request.verify = kind == 1;
    request.record = kind == 2 ? MO_RECORD_COM : 0;
    id = service_submit(&service, &request);
    for (int i = 0; i < ROUNDS; i++) {
      CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
      if (i % 3 == 0)
        usleep(30000);
      CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
      for (int k = 0; k < 10; k++) {
        usleep(2500);
        job = job_of(&service, id);
        back = back || job.rollouts_done < seen;
        seen = job.rollouts_done;
      }
    }
    CHECK(!back);
    CHECK(!mo_job_state_is_final(job.state));
    CHECK(AWAIT(computed(&service) > 0));
    /* Paused for good: what was in flight ends and is counted. */
    CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
    usleep(400000);
    first = computed(&service);
    CHECK(first > 0);
    job = job_of(&service, id);
    CHECK_INT(job.state, MO_JOB_PAUSED);
    CHECK_INT(job.rollouts_done, first);
    CHECK_INT(job.rollouts_cached, 0);
    /* And by another process. */
    REQUIRE(service_reopen(&service) == MO_OK);
    job = job_of(&service, id);
    CHECK_INT(job.rollouts_done, first);
    fake_plan.delay_us = 300000;
    CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
    CHECK(await_state(&service, id, MO_JOB_RUNNING));
    job = job_of(&service, id);
    CHECK(job.rollouts_done >= first);
    fake_plan.delay_us = 0;
    CHECK(succeeds(&service, id, &job));
    CHECK_INT(job.rollouts_done, ROLLOUTS);
    CHECK_INT(job.rollouts_cached, 0);
    CHECK_INT(first + computed(&service), ROLLOUTS);
    CHECK(right(&service, id, genotypes));
    service_end(&service);
  }
}

/* One client pauses, another resumes before the scheduler has looked: the request finds a job that
 * is to run. */
SERVICE_CASE(survives_a_late_request, 0)
{
  const struct mo_bits *genotypes;
  struct mo_job job;
  int64_t id;
  genotypes = bodies(service, 16, 60);
  fake_plan.delay_us = 5000;
  id = evaluate(service, genotypes, 60);
  CHECK(await_state(service, id, MO_JOB_RUNNING));
  usleep(20000);
  mo_runners_request(&service->jobs->runners[MO_JOB_EVALUATION], id, MO_REQUEST_PAUSE);
  CHECK_INT(mo_jobs_pause(service->jobs, id), MO_OK);
  CHECK_INT(mo_jobs_resume(service->jobs, id), MO_OK);
  CHECK(succeeds(service, id, &job));
  CHECK_INT(job.attempts, 0);
  CHECK(right(service, id, genotypes));
}

/* Another process holds the database: what is computed meanwhile has to stay in memory, so it must
 * have an end. */
SERVICE_CASE(waits_for_a_slow_store, 0)
{
  enum { DESIGNS = 4000, IN_MEMORY = 16384 + 5000 };
  const struct mo_bits *genotypes;
  struct mo_jobs_stats stats = {0};
  struct mo_job job;
  uint64_t before = 0;
  char path[512];
  sqlite3 *db = NULL;
  int64_t id;
  genotypes = bodies(service, 17, DESIGNS);
  fake_plan.delay_us = 20000;
  id = evaluate(service, genotypes, DESIGNS);
  CHECK(await_state(service, id, MO_JOB_RUNNING));
  snprintf(path, sizeof(path), "%s/morphod.db", service->fixture.path);
  REQUIRE(sqlite3_open(path, &db) == SQLITE_OK);
  sqlite3_busy_timeout(db, 5000);
  REQUIRE(sqlite3_exec(db, "BEGIN IMMEDIATE", NULL, NULL, NULL) == SQLITE_OK);
  fake_plan.delay_us = 0;
  for (int i = 0; i < 300; i++) { /* until nothing is computed any more */
    usleep(100000);
    stats = stats_of(service);
    if (stats.rollouts_computed == before && stats.blocks_in_flight == 0)
      break;
    before = stats.rollouts_computed;
  }
  CHECK_INT(stats.blocks_in_flight, 0);
  CHECK(stats.rollouts_computed < IN_MEMORY);
  CHECK_INT(sqlite3_exec(db, "ROLLBACK", NULL, NULL, NULL), SQLITE_OK);
  sqlite3_close(db);
  CHECK(succeeds(service, id, &job));
  CHECK_INT(job.attempts, 0);
  CHECK_INT(computed(service), DESIGNS * 10);
  CHECK(right(service, id, genotypes));
}

SERVICE_CASE(parks_and_goes_on, 0)
{
  const struct mo_bits *genotypes;
  struct mo_job job;
  int64_t id;
  uint64_t first;
  double begin;
  genotypes = bodies(service, 6, 100);
  fake_plan.delay_us = 4000;
  id = evaluate(service, genotypes, 100);
  CHECK(AWAIT(computed(service) > 0));
  fake_plan.delay_us = 60000000;
  usleep(20000);
  begin = now_s();
  CHECK_INT(mo_jobs_stop(service->jobs, 5000), MO_OK);
  CHECK(now_s() - begin < 2);
  CHECK_INT(evaluate(service, genotypes, 1), MO_ERR_CANCELLED);
  first = computed(service);
  CHECK(first > 0 && first < 1000);
  job = job_of(service, id);
  CHECK_INT(job.state, MO_JOB_QUEUED);
  CHECK_INT(job.rollouts_done, first);
  CHECK_INT(job.attempts, 0);
  service_close(service);
  fake_plan.delay_us = 0;
  REQUIRE(service_open(service) == MO_OK);
  CHECK(succeeds(service, id, &job));
  CHECK_INT(computed(service), 1000 - first);
  CHECK_INT(job.rollouts_cached, 0); /* its own earlier work is not "cached" */
  CHECK(right(service, id, genotypes));
}

SERVICE_CASE(verifies, 0)
{
  const struct mo_bits *genotypes;
  struct mo_evaluation_request request;
  struct mo_evaluation_results *results = NULL;
  struct mo_job job;
  int64_t id;
  genotypes = bodies(service, 7, 8);
  (void)end_of(service, evaluate(service, genotypes, 6));
  request = service_request(genotypes, 8);
  request.verify = true;
  id = service_submit(service, &request);
  CHECK(succeeds(service, id, &job));
  CHECK_INT(computed(service), 140);
  REQUIRE(mo_store_results(service->fixture.store, id, &results) == MO_OK);
  for (int i = 0; i < 8; i++)
    CHECK_INT(results->agrees[i], 1);
  CHECK(isnan(results->stored_losses[70]) && !isnan(results->losses[70]));
  mo_evaluation_results_free(results);
  CHECK(right(service, id, genotypes));
  /* As if other code had computed them. */
  fake_plan.skew = 1;
  id = service_submit(service, &request);
  CHECK(succeeds(service, id, &job));
  REQUIRE(mo_store_results(service->fixture.store, id, &results) == MO_OK);
  for (int i = 0; i < 8; i++)
    CHECK_INT(results->agrees[i], 0);
  CHECK(results->losses[0] == results->stored_losses[0] + 1 || isinf(results->losses[0]));
  mo_evaluation_results_free(results);
}

SERVICE_CASE(records, 0)
{
  const struct mo_bits *genotypes;
  struct mo_evaluation_request request;
  struct mo_trajectory *trajectory = NULL;
  int64_t id;
  genotypes = bodies(service, 8, 3);
  for (int round = 0; round < 2; round++) { /* recorded even when the scores are known */
    request = service_request(genotypes, 3);
    request.record = MO_RECORD_COM | MO_RECORD_MASSES;
    id = service_submit(service, &request);
    CHECK(succeeds(service, id, NULL));
    CHECK(right(service, id, genotypes));
    REQUIRE(mo_store_trajectory(service->fixture.store, id, 2, 9, &trajectory) == MO_OK);
    CHECK_INT(trajectory->n_frames, 11);
    CHECK_INT(trajectory->recording.stride, 100);
    CHECK(trajectory->recording.com_m != NULL && trajectory->recording.mass_m != NULL);
    CHECK(trajectory->recording.com_m[5] == trajectory->recording.com_m[0] + 5 ||
          isinf(trajectory->recording.com_m[0]));
    CHECK(trajectory->recording.mass_m[7] == 7.0F);
    mo_trajectory_free(trajectory);
  }
  CHECK_INT(computed(service), 60);
  request.record_stride = 1;
  request.genotypes = bodies(service, 8, 200);
  request.n_designs = 200;
  CHECK_INT(service_submit(service, &request), MO_ERR_LIMIT);
  CHECK(strstr(service->fixture.message.text, "67108864") != NULL);
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
