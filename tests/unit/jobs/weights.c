/* weights.c: the weights of jobs in the shares of a fake back end, changed while jobs run, wait and
 * resume. */
#include "fakes.h"

static bool await_weight(int64_t id, double weight)
{
  return AWAIT(fake_weight(id) == weight);
}

/* Each job has its own share with its own weight in the back end. */
SERVICE_CASE(of_evaluations, 0)
{
  enum { BODIES = 160 };
  struct mo_job job;
  const struct mo_bits *genotypes = bodies(31, 2 * BODIES);
  fake_plan.delay_us = 2000;
  int64_t light = evaluate(genotypes, BODIES);
  struct mo_evaluation_request request = service_request(genotypes + BODIES, BODIES);
  request.job.weight = 3;
  int64_t heavy = submit_evaluation(&request);
  REQUIRE(light > 0 && heavy > 0);
  CHECK(await_weight(heavy, 3) && await_weight(light, 1));
  CHECK_INT(fake_shares(), 2);
  CHECK_OK(mo_jobs_set_weight(service.jobs, light, 27));
  CHECK(await_weight(light, 27));
  fake_plan.delay_us = 0;
  CHECK(succeeds(light, &job));
  CHECK(job.weight == 27);
  CHECK(succeeds(heavy, &job));
  CHECK(job.weight == 3);
  CHECK(right(light, genotypes) && right(heavy, genotypes + BODIES));
  CHECK_INT(mo_jobs_set_weight(service.jobs, light, 1), MO_ERR_CONFLICT);
  CHECK(AWAIT(fake_shares() == 0));
  CHECK(stats_of().worker_s[MO_JOB_EVALUATION] > 0);
}

/* Figures of a running evaluation: how much is done, how fast, and the remaining time. */
SERVICE_CASE(pace_of_an_evaluation, 0)
{
  enum { BODIES = 200, ROLLOUTS = BODIES * MO_PAPER_TEST_COUNT };
  const struct mo_bits *genotypes = bodies(32, BODIES);
  const double begin = now_s();
  struct mo_live live;
  fake_plan.delay_us = 20000;
  const int64_t id = evaluate(genotypes, BODIES);
  CHECK(live_of(id).rate == 0 && live_of(id).seconds_left < 0);
  REQUIRE(AWAIT((live = live_of(id)).rate > 0));
  CHECK(now_s() - begin >= 0.5);
  CHECK_INT(live.phase, MO_PHASE_SCORE);
  CHECK(live.done > 0 && live.done < ROLLOUTS);
  CHECK_INT(live.total, ROLLOUTS);
  CHECK(live.busy_s >= 0);
  CHECK(live.rate <= (double)(live.done + MO_BLOCK_LANES) / 0.5);
  CHECK(fabs(live.seconds_left * live.rate - (double)(ROLLOUTS - live.done)) < 1e-6 * ROLLOUTS);
  /* While paused: unknown. After resuming: earlier work does not count in the rate. */
  CHECK_OK(mo_jobs_pause(service.jobs, id));
  REQUIRE(AWAIT((live = live_of(id)).busy_s < 0));
  CHECK(live.phase == MO_PHASE_IDLE && live.rate == 0 && live.seconds_left < 0);
  const uint64_t before = job_of(id).rollouts_done;
  CHECK_OK(mo_jobs_resume(service.jobs, id));
  REQUIRE(AWAIT((live = live_of(id)).rate > 0));
  CHECK(live.done >= before);
  CHECK(live.rate <= (double)(live.done - before + MO_BLOCK_LANES) / 0.5);
  fake_plan.delay_us = 0;
  CHECK(succeeds(id, NULL));
  CHECK(await_phase(id, MO_PHASE_IDLE));
}

/* The list of running jobs: only those of batch priority, the largest weight first, then the
 * newest. */
SERVICE_CASE(what_runs, 0)
{
  enum { BODIES = 100, N = 4 };
  static const double weights[N] = {1, 0.5, 3, 1};
  static const int order[N] = {2, 3, 0, 1};
  const struct mo_bits *genotypes = bodies(33, (N + 1) * BODIES);
  struct mo_running rows[N + 1];
  int64_t ids[N];
  fake_plan.delay_us = 200000;
  CHECK_INT(mo_jobs_running(service.jobs, rows, N + 1), 0);
  for (int i = 0; i < N; i++) {
    struct mo_evaluation_request request = service_request(genotypes + (size_t)i * BODIES, BODIES);
    request.job.weight = weights[i];
    request.job.label = i == 2 ? "heavy" : NULL;
    ids[i] = submit_evaluation(&request);
  }
  const int64_t quick = evaluate(genotypes + (size_t)N * BODIES, 1);
  REQUIRE(AWAIT(live_of(quick).phase == MO_PHASE_SCORE));
  CHECK_INT(job_of(quick).priority, MO_INTERACTIVE);
  REQUIRE(AWAIT(mo_jobs_running(service.jobs, rows, N + 1) == N));
  for (int i = 0; i < N; i++) {
    CHECK_INT(rows[i].id, ids[order[i]]);
    CHECK_INT(rows[i].kind, MO_JOB_EVALUATION);
    CHECK(rows[i].weight == weights[order[i]]);
    CHECK_TEXT(rows[i].label, order[i] == 2 ? "heavy" : "");
    CHECK_INT(rows[i].live.total, BODIES * MO_PAPER_TEST_COUNT);
  }
  for (size_t limit = 0; limit <= N; limit++) {
    CHECK_INT(mo_jobs_running(service.jobs, rows, limit), limit);
    for (size_t i = 0; i < limit; i++)
      CHECK_INT(rows[i].id, ids[order[i]]);
  }
  CHECK_OK(mo_jobs_pause(service.jobs, ids[2]));
  CHECK(AWAIT(mo_jobs_running(service.jobs, rows, N + 1) == N - 1));
  CHECK_INT(rows[0].id, ids[3]);
}

SERVICE_CASE(of_a_training, 1)
{
  struct mo_training_request request = pretraining("weighed");
  struct mo_job job;
  fake_plan.gradient_delay_us = 4000;
  request.job.weight = 2.5;
  int64_t id = submit_training(&request);
  REQUIRE(id > 0 && await_step(id, 1));
  CHECK(fake_weight(id) == 2.5);
  CHECK_INT(fake_shares(), 1);
  CHECK(live_of(id).busy_s > 0);
  CHECK_OK(mo_jobs_set_weight(service.jobs, id, 7));
  CHECK_OK(mo_jobs_set_weight(service.jobs, id, 7));
  CHECK(await_weight(id, 7));
  CHECK_OK(mo_jobs_pause(service.jobs, id));
  REQUIRE(await_phase(id, MO_PHASE_IDLE));
  CHECK(live_of(id).busy_s < 0);
  CHECK_INT(fake_shares(), 0);
  CHECK(stats_of().worker_s[MO_JOB_TRAINING] > 0);
  CHECK_OK(mo_jobs_set_weight(service.jobs, id, 0.5)); /* while it waits */
  CHECK_OK(mo_jobs_resume(service.jobs, id));
  CHECK(await_weight(id, 0.5));
  service_close();
  CHECK_INT(fake_shares(), 0);
  REQUIRE_OK(service_open()); /* and after a restart */
  CHECK_OK(mo_jobs_set_weight(service.jobs, id, 4));
  fake_plan.gradient_delay_us = 0;
  CHECK(succeeds(id, &job));
  CHECK(job.weight == 4 && fake_weight(id) == 4);
  CHECK(learns_to(id, undisturbed()));
  CHECK_INT(mo_jobs_set_weight(service.jobs, id, 1), MO_ERR_CONFLICT);
  REQUIRE(await_phase(id, MO_PHASE_IDLE));
  struct mo_jobs_stats stats = stats_of();
  CHECK(stats.worker_s[MO_JOB_TRAINING] > 0 && stats.worker_s[MO_JOB_EVALUATION] == 0);
  CHECK_INT(count_events(id, "job.weight"), 3); /* setting the same weight again changes nothing */
}

/* ---- changed by many threads, while shares come and go ---- */

struct changer {
  struct mo_jobs *jobs;
  int64_t id;
  double first;
};

static void *change(void *context)
{
  const struct changer *changer = context;
  for (int i = 0; i < 20; i++) {
    struct mo_live live;
    mo_jobs_live(changer->jobs, changer->id, &live);
    if (mo_jobs_set_weight(changer->jobs, changer->id, changer->first + i) != MO_OK ||
        live.busy_s > 1e6)
      return context;
  }
  return NULL;
}

static void the_newest_weight_counts(void)
{
  struct mo_training_request request = pretraining("");
  pthread_t threads[3];
  struct changer changers[3];
  void *failed = NULL;
  REQUIRE_OK(service_start(1));
  fake_plan.gradient_delay_us = 2000;
  request.record.settings.n_steps = 100000;
  request.record.validate_every_steps = 0;
  int64_t id = submit_training(&request);
  for (int round = 0; round < 4; round++) {
    for (int i = 0; i < 3; i++) {
      changers[i] = (struct changer){service.jobs, id, 1 + 100 * i + 30 * round};
      REQUIRE(pthread_create(&threads[i], NULL, change, &changers[i]) == 0);
    }
    CHECK_OK(round % 2 == 0 ? mo_jobs_pause(service.jobs, id) : mo_jobs_resume(service.jobs, id));
    for (int i = 0; i < 3; i++) {
      pthread_join(threads[i], &failed);
      CHECK(failed == NULL);
    }
  }
  struct mo_job job = job_of(id);
  CHECK(job.weight > 91);
  CHECK(await_weight(id, job.weight));
  service_close();
  CHECK_INT(fake_shares(), 0);
}

static const struct check_case cases[] = {
    {"of evaluations", of_evaluations},
    {"the pace of an evaluation", pace_of_an_evaluation},
    {"what runs", what_runs},
    {"of a training", of_a_training},
    {"the newest weight counts", the_newest_weight_counts},
};
CHECK_MAIN(cases)
