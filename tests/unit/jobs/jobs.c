/* jobs.c: the scheduler with a fake back end: what is computed, in which order, and what is not
 * computed. */

#include "fakes.h"

SERVICE_CASE(evaluates, 0)
{
  struct mo_job job;
  const struct mo_bits *genotypes = bodies(1, 50);
  struct mo_evaluation_request request = service_request(genotypes, 50);
  request.job.label = "fifty";
  int64_t id = submit_evaluation(&request);
  REQUIRE(id > 0);
  CHECK(succeeds(id, &job));
  CHECK_INT(job.priority, MO_BATCH);
  CHECK_INT(job.rollouts_done, 500);
  CHECK_INT(job.rollouts_cached, 0);
  CHECK(job.rollouts_diverged > 0 && job.rollouts_diverged < 100);
  CHECK(job.started_us >= job.created_us && job.finished_us >= job.started_us);
  CHECK(right(id, genotypes));
  struct mo_jobs_stats stats = idle_stats();
  CHECK_INT(stats.open_jobs, 0);
  CHECK_INT(stats.open_rollouts, 0);
  CHECK_INT(stats.jobs_succeeded, 1);
}

SERVICE_CASE(computes_nothing_twice, 0)
{
  struct mo_bits twice[20];
  struct mo_job job;
  const struct mo_bits *genotypes = bodies(1, 40);
  fake_plan.delay_us = 3000;
  struct mo_evaluation_request request = service_request(genotypes, 30);
  request.job.priority = MO_BATCH;
  int64_t first = submit_evaluation(&request);
  request = service_request(genotypes + 10, 30); /* 20 of them with equal seeds, at the same time */
  request.job.priority = MO_BATCH;
  int64_t second = submit_evaluation(&request);
  CHECK(succeeds(first, &job));
  CHECK(succeeds(second, &job));
  CHECK_INT(computed(), 400);
  CHECK(right(first, genotypes));
  CHECK(right(second, genotypes + 10));
  /* The same design twice in one request, and again after a restart: losses come from the store. */
  for (int i = 0; i < 20; i++)
    twice[i] = genotypes[30 + i / 2];
  REQUIRE_OK(service_reopen());
  int64_t third = evaluate(twice, 20);
  CHECK(succeeds(third, &job));
  CHECK_INT(computed(), 0);
  CHECK_INT(job.rollouts_cached, 200);
  CHECK(right(third, twice));
  /* New designs, each twice in one request. */
  genotypes = bodies(77, 10);
  for (int i = 0; i < 20; i++)
    twice[i] = genotypes[i % 10];
  third = evaluate(twice, 20);
  CHECK(succeeds(third, &job));
  CHECK(computed() > 50 && computed() <= 100); /* some small bodies were seen before */
  CHECK_INT(job.rollouts_cached, 200 - computed());
  CHECK(right(third, twice));
}

SERVICE_CASE(puts_interactive_first_and_shares, 0)
{
  struct mo_job job;
  int64_t a, b, urgent, tags[400];
  size_t n, of_a = 0, of_b = 0;
  const struct mo_bits *genotypes = bodies(3, 201);
  fake_plan.delay_us = 4000;
  a = evaluate(genotypes, 100);
  b = evaluate(genotypes + 100, 100);
  usleep(50000);
  urgent = evaluate(genotypes + 200, 1);
  CHECK(succeeds(urgent, &job));
  CHECK_INT(job.priority, MO_INTERACTIVE);
  /* The two others take 0.4 s longer. */
  CHECK(state_of(a) == MO_JOB_RUNNING && state_of(b) == MO_JOB_RUNNING);
  (void)end_of(a);
  (void)end_of(b);
  n = fake_history(tags, 400);
  for (size_t i = 20; i < 60 && i < n; i++) { /* once both run, their blocks alternate */
    of_a += tags[i] == a;
    of_b += tags[i] == b;
  }
  CHECK(of_a >= 15 && of_b >= 15);
}

/* Ends a running job with long blocks, and returns whether they were interrupted at once. */
static bool breaks_off(const struct mo_bits *genotypes,
                       int (*request)(struct mo_jobs *jobs, int64_t id), int64_t *id)
{
  *id = evaluate(genotypes, 50);
  CHECK(await_state(*id, MO_JOB_RUNNING));
  double begin = now_s();
  CHECK_OK(request(service.jobs, *id));
  return AWAIT(stats_of().blocks_in_flight == 0) && is_soon_after(begin);
}

SERVICE_CASE(cancels_pauses_resumes, 0)
{
  int64_t id, other;
  const struct mo_bits *genotypes = bodies(4, 60);
  fake_plan.delay_us = LONG_US;
  CHECK(breaks_off(genotypes, mo_jobs_cancel, &id));
  CHECK_INT(state_of(id), MO_JOB_CANCELLED);
  CHECK_INT(stats_of().open_jobs, 0);
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_ERR_CONFLICT);
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_ERR_CONFLICT);
  CHECK_INT(mo_jobs_cancel(service.jobs, 1234), MO_ERR_NOT_FOUND);
  CHECK(breaks_off(genotypes, mo_jobs_pause, &id));
  CHECK_OK(mo_jobs_cancel(service.jobs, id));
  /* Paused in the middle: completed work is kept. */
  fake_plan.delay_us = 200000;
  id = evaluate(genotypes, 50);
  CHECK(AWAIT(computed() > 0));
  CHECK_OK(mo_jobs_pause(service.jobs, id));
  CHECK_OK(mo_jobs_pause(service.jobs, id));
  CHECK(AWAIT(stats_of().blocks_in_flight == 0));
  uint64_t before = computed();
  CHECK(before > 0 && before < 500);
  usleep(50000);
  CHECK_INT(computed(), before);
  CHECK_INT(state_of(id), MO_JOB_PAUSED);
  fake_plan.delay_us = 1000;
  CHECK_OK(mo_jobs_resume(service.jobs, id));
  CHECK_OK(mo_jobs_resume(service.jobs, id));
  CHECK(succeeds(id, NULL));
  CHECK_INT(computed(), 500);
  CHECK(right(id, genotypes));
  /* Paused and immediately resumed, many times. */
  genotypes = bodies(5, 60);
  fake_plan.delay_us = 50000;
  id = evaluate(genotypes, 60);
  for (int i = 0; i < 30; i++) {
    CHECK_OK(mo_jobs_pause(service.jobs, id));
    CHECK_OK(mo_jobs_resume(service.jobs, id));
    usleep((useconds_t)(i * 100));
  }
  /* A shared rollout survives the job that started it. */
  other = evaluate(genotypes, 60);
  usleep(5000);
  CHECK_OK(mo_jobs_cancel(service.jobs, id));
  fake_plan.delay_us = 1000;
  CHECK(right(other, genotypes));
}

/* For any kind of job: nothing is computed twice, a job's own work is not "cached", and its counts
 * never decrease. */
static void counts_through_pauses(void)
{
  enum { DESIGNS = 200, ROLLOUTS = DESIGNS * 10, ROUNDS = 12 };
  for (int kind = 0; kind < 3; kind++) {
    struct mo_job job = {.state = MO_JOB_QUEUED};
    uint64_t seen = 0, first;
    bool back = false;
    REQUIRE_OK(service_start(0));
    const struct mo_bits *genotypes = bodies(31, DESIGNS);
    fake_plan.delay_us = 10000; /* some blocks end between two pauses, which interrupt the others;
                                   the job does not end */
    struct mo_evaluation_request request = service_request(genotypes, DESIGNS);
    request.verify = kind == 1;
    request.record = kind == 2 ? MO_RECORD_COM : 0;
    int64_t id = submit_evaluation(&request);
    for (int i = 0; i < ROUNDS; i++) {
      CHECK_OK(mo_jobs_pause(service.jobs, id));
      if (i % 3 == 0)
        usleep(30000);
      CHECK_OK(mo_jobs_resume(service.jobs, id));
      for (int k = 0; k < 10; k++) {
        usleep(2500);
        job = job_of(id);
        back = back || job.rollouts_done < seen;
        seen = job.rollouts_done;
      }
    }
    CHECK(!back);
    CHECK(!mo_job_state_is_final(job.state));
    CHECK(AWAIT(computed() > 0));
    /* Paused for a long time: work in flight ends and is counted. */
    CHECK_OK(mo_jobs_pause(service.jobs, id));
    usleep(400000);
    first = computed();
    CHECK(first > 0);
    job = job_of(id);
    CHECK_INT(job.state, MO_JOB_PAUSED);
    CHECK_INT(job.rollouts_done, first);
    CHECK_INT(job.rollouts_cached, 0);
    /* Resumed by another process. */
    REQUIRE_OK(service_reopen());
    CHECK_INT(job_of(id).rollouts_done, first);
    fake_plan.delay_us = 300000;
    CHECK_OK(mo_jobs_resume(service.jobs, id));
    CHECK(await_state(id, MO_JOB_RUNNING));
    CHECK(job_of(id).rollouts_done >= first);
    fake_plan.delay_us = 0;
    CHECK(succeeds(id, &job));
    CHECK_INT(job.rollouts_done, ROLLOUTS);
    CHECK_INT(job.rollouts_cached, 0);
    CHECK_INT(first + computed(), ROLLOUTS);
    CHECK(right(id, genotypes));
  }
}

/* One client pauses and another resumes before the scheduler has reacted: by then the job is
 * supposed to run again. */
SERVICE_CASE(survives_a_late_request, 0)
{
  struct mo_job job;
  const struct mo_bits *genotypes = bodies(16, 60);
  fake_plan.delay_us = 5000;
  int64_t id = evaluate(genotypes, 60);
  CHECK(await_state(id, MO_JOB_RUNNING));
  usleep(20000);
  mo_runners_request(&service.jobs->runners[MO_JOB_EVALUATION], id, MO_REQUEST_PAUSE);
  CHECK_OK(mo_jobs_pause(service.jobs, id));
  CHECK_OK(mo_jobs_resume(service.jobs, id));
  CHECK(succeeds(id, &job));
  CHECK_INT(job.attempts, 0);
  CHECK(right(id, genotypes));
}

/* Another process holds the database. Results have to stay in memory in the meantime, so their
 * number must be bounded. */
SERVICE_CASE(waits_for_a_slow_store, 0)
{
  enum { DESIGNS = 4000, IN_MEMORY = 16384 + 5000 };
  struct mo_jobs_stats stats = {0};
  struct mo_job job;
  uint64_t before = 0;
  const struct mo_bits *genotypes = bodies(17, DESIGNS);
  fake_plan.delay_us = 20000;
  int64_t id = evaluate(genotypes, DESIGNS);
  CHECK(await_state(id, MO_JOB_RUNNING));
  sqlite3 *db = open_outside();
  sqlite3_busy_timeout(db, 5000);
  REQUIRE(sqlite3_exec(db, "BEGIN IMMEDIATE", NULL, NULL, NULL) == SQLITE_OK);
  fake_plan.delay_us = 0;
  for (int i = 0; i < 300; i++) { /* until nothing more is computed */
    usleep(100000);
    stats = stats_of();
    if (stats.rollouts_computed == before && stats.blocks_in_flight == 0)
      break;
    before = stats.rollouts_computed;
  }
  CHECK_INT(stats.blocks_in_flight, 0);
  CHECK(stats.rollouts_computed < IN_MEMORY);
  CHECK_INT(sqlite3_exec(db, "ROLLBACK", NULL, NULL, NULL), SQLITE_OK);
  sqlite3_close(db);
  CHECK(succeeds(id, &job));
  CHECK_INT(job.attempts, 0);
  CHECK_INT(computed(), DESIGNS * 10);
  CHECK(right(id, genotypes));
}

SERVICE_CASE(parks_and_goes_on, 0)
{
  const struct mo_bits *genotypes = bodies(6, 100);
  fake_plan.delay_us = 10000;
  int64_t id = evaluate(genotypes, 100);
  CHECK(AWAIT(computed() > 0));
  fake_plan.delay_us = LONG_US;
  usleep(20000);
  double begin = now_s();
  CHECK_OK(mo_jobs_stop(service.jobs, STOP_MS));
  CHECK(is_soon_after(begin));
  CHECK_INT(evaluate(genotypes, 1), MO_ERR_CANCELLED);
  uint64_t first = computed();
  CHECK(first > 0 && first < 1000);
  struct mo_job job = job_of(id);
  CHECK_INT(job.state, MO_JOB_QUEUED);
  CHECK_INT(job.rollouts_done, first);
  CHECK_INT(job.attempts, 0);
  service_close();
  fake_plan.delay_us = 0;
  REQUIRE_OK(service_open());
  CHECK(succeeds(id, &job));
  CHECK_INT(computed(), 1000 - first);
  CHECK_INT(job.rollouts_cached, 0); /* its own earlier work is not "cached" */
  CHECK(right(id, genotypes));
}

SERVICE_CASE(verifies, 0)
{
  struct mo_evaluation_results *results = NULL;
  struct mo_job job;
  const struct mo_bits *genotypes = bodies(7, 8);
  (void)end_of(evaluate(genotypes, 6));
  struct mo_evaluation_request request = service_request(genotypes, 8);
  request.verify = true;
  int64_t id = submit_evaluation(&request);
  CHECK(succeeds(id, &job));
  CHECK_INT(computed(), 140);
  REQUIRE_OK(mo_store_results(store, id, &results));
  for (int i = 0; i < 8; i++)
    CHECK_INT(results->agrees[i], 1);
  CHECK(isnan(results->stored_losses[70]) && !isnan(results->losses[70]));
  mo_evaluation_results_free(results);
  CHECK(right(id, genotypes));
  /* As if different code had computed them. */
  fake_plan.skew = 1;
  id = submit_evaluation(&request);
  CHECK(succeeds(id, &job));
  REQUIRE_OK(mo_store_results(store, id, &results));
  for (int i = 0; i < 8; i++)
    CHECK_INT(results->agrees[i], 0);
  CHECK(results->losses[0] == results->stored_losses[0] + 1 || isinf(results->losses[0]));
  mo_evaluation_results_free(results);
}

SERVICE_CASE(records, 0)
{
  struct mo_evaluation_request request;
  struct mo_trajectory *trajectory = NULL;
  int64_t id;
  const struct mo_bits *genotypes = bodies(8, 3);
  for (int round = 0; round < 2; round++) { /* recorded even if the scores are known */
    request = service_request(genotypes, 3);
    request.record = MO_RECORD_COM | MO_RECORD_MASSES;
    id = submit_evaluation(&request);
    CHECK(right(id, genotypes));
    REQUIRE_OK(mo_store_trajectory(store, id, 2, 9, &trajectory));
    CHECK_INT(trajectory->n_frames, 11);
    CHECK_INT(trajectory->recording.stride, 100);
    CHECK(trajectory->recording.com_m != NULL && trajectory->recording.mass_m != NULL);
    CHECK(trajectory->recording.com_m[5] == trajectory->recording.com_m[0] + 5 ||
          isinf(trajectory->recording.com_m[0]));
    CHECK(trajectory->recording.mass_m[7] == 7.0F);
    mo_trajectory_free(trajectory);
  }
  CHECK_INT(computed(), 60);
  request.record_stride = 1;
  request.genotypes = bodies(8, 200);
  request.n_designs = 200;
  CHECK_INT(submit_evaluation(&request), MO_ERR_LIMIT);
  CHECK_SAYS(fixture.message, "67108864");
}

static struct mo_evaluation_results *results_of(int64_t id)
{
  struct mo_evaluation_results *results = NULL;
  CHECK_OK(mo_store_results(store, id, &results));
  return results;
}

/* Returns whether two evaluations of the same designs have the same results. */
static bool same_results(const struct mo_evaluation_results *a,
                         const struct mo_evaluation_results *b)
{
  const size_t n = a->n_designs;
  bool same = b->n_designs == n;
  for (size_t i = 0; i < n && same; i++)
    same = same_number(a->scores[i], b->scores[i]) && a->is_bound[i] == b->is_bound[i];
  for (size_t i = 0; i < n * a->n_environments && same; i++)
    same = same_number(a->losses[i], b->losses[i]);
  return same;
}

/* Returns whether the best designs of `whole` (including ties with the last of them) have the same
 * scores in `raced`, and all others have a worse score or a worse lower bound. */
static bool has_best(const struct mo_evaluation_results *raced,
                     const struct mo_evaluation_results *whole, uint32_t k)
{
  bool is_right = true;
  for (uint32_t i = 0; i < whole->n_designs; i++) {
    uint32_t better = 0;
    for (uint32_t j = 0; j < whole->n_designs; j++)
      better += whole->scores[j] < whole->scores[i];
    is_right = is_right && (raced->is_bound[i] ? better >= k && raced->scores[i] <= whole->scores[i]
                                               : same_number(raced->scores[i], whole->scores[i]));
    better = 0; /* the bound itself shows that it is not among the best */
    for (uint32_t j = 0; j < whole->n_designs; j++)
      better += !raced->is_bound[j] && raced->scores[j] < raced->scores[i];
    is_right = is_right && (!raced->is_bound[i] || better >= k);
  }
  return is_right;
}

/* Pauses, restarts, more workers and known losses lead to the same result without an additional
 * rollout; a later evaluation of the rest does not change it. */
SERVICE_CASE(finds_the_best, 0)
{
  enum { DESIGNS = 300, BEST = 7 };
  struct mo_evaluation_results *first, *whole, *again;
  struct mo_job job;
  uint64_t needed, spent = 0;
  const struct mo_bits *genotypes = bodies(18, DESIGNS);
  struct mo_evaluation_request request = service_request(genotypes, DESIGNS);
  request.best = BEST;
  int64_t id = submit_evaluation(&request);
  CHECK(succeeds(id, &job));
  needed = computed();
  CHECK(needed < 10 * DESIGNS);
  CHECK_INT(job.best, BEST);
  CHECK_INT(job.rollouts_done, 10 * DESIGNS);
  CHECK_INT(job.rollouts_cut, 10 * DESIGNS - needed);
  first = results_of(id);
  int64_t all = evaluate(genotypes, DESIGNS);
  CHECK(right(all, genotypes));
  CHECK_INT(computed(), 10 * DESIGNS);
  whole = results_of(all);
  CHECK(has_best(first, whole, BEST));
  again = results_of(id);
  CHECK(same_results(first, again));
  mo_evaluation_results_free(again);
  all = submit_evaluation(&request); /* from the store */
  CHECK(succeeds(all, &job));
  CHECK_INT(job.rollouts_cached, needed);
  CHECK_INT(computed(), 10 * DESIGNS);
  again = results_of(all);
  CHECK(same_results(first, again));
  mo_evaluation_results_free(again);

  REQUIRE_OK(service_begin());
  service.n_workers = 7;
  REQUIRE_OK(service_open());
  fake_plan.delay_us = 2000;
  request.genotypes = bodies(18, DESIGNS);
  id = submit_evaluation(&request);
  for (uint64_t part = 1; part < 6; part++) {
    CHECK(AWAIT(spent + computed() >= part * needed / 6));
    if (part % 2 == 0) {
      CHECK_OK(mo_jobs_pause(service.jobs, id));
      CHECK(AWAIT(stats_of().blocks_in_flight == 0));
      CHECK_OK(mo_jobs_resume(service.jobs, id));
    } else {
      CHECK_OK(mo_jobs_stop(service.jobs, STOP_MS));
      spent += computed();
      REQUIRE_OK(service_reopen());
    }
  }
  CHECK(succeeds(id, &job));
  CHECK_INT(spent + computed(), needed);
  CHECK_INT(job.rollouts_cached, 0);
  CHECK_INT(job.rollouts_cut, 10 * DESIGNS - needed);
  again = results_of(id);
  CHECK(same_results(first, again));
  mo_evaluation_results_free(again);
  mo_evaluation_results_free(first);
  mo_evaluation_results_free(whole);
}

static const struct check_case cases[] = {
    {"evaluates", evaluates},
    {"computes nothing twice", computes_nothing_twice},
    {"puts interactive jobs first and shares among batch jobs", puts_interactive_first_and_shares},
    {"cancels, pauses and resumes", cancels_pauses_resumes},
    {"counts correctly across pauses", counts_through_pauses},
    {"survives a late request", survives_a_late_request},
    {"waits for a slow store", waits_for_a_slow_store},
    {"parks at a stop and continues after it", parks_and_goes_on},
    {"verifies bits", verifies},
    {"records", records},
    {"finds the best", finds_the_best},
};
CHECK_MAIN(cases)
