/* shares.c: a training beside an evaluation on the real back end: the workers' time is divided by
 * weight, and small evaluations do not wait for either. */
#include <stdio.h>
#include <time.h>
#include <unistd.h>

#include "../check.h"
#include "../store/fixture.h"
#include "jobs/evaluations.h"
#include "jobs/trainings.h"
#include "wait.h"

enum { BODIES = 2000 };

static double now_s(void)
{
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

/* The training's part of the worker seconds from now on: once there were 4 of them, within a tenth
 * of what is wanted. Its blocks take 0.1 s, more on a busy machine: four times as long is waited
 * until that evens out. */
static bool training_gets(struct mo_jobs *jobs, double wanted)
{
  struct mo_jobs_stats before, now;
  double learned_s = 0, sum = 0, end = now_s() + 60;
  bool right = false;
  mo_jobs_get_stats(jobs, &before);
  while ((sum < 4 || (!right && sum < 16)) && now_s() < end) {
    usleep(2000);
    mo_jobs_get_stats(jobs, &now);
    learned_s = now.worker_s[MO_JOB_TRAINING] - before.worker_s[MO_JOB_TRAINING];
    sum = learned_s + now.worker_s[MO_JOB_EVALUATION] - before.worker_s[MO_JOB_EVALUATION];
    right = fabs(learned_s - wanted * sum) <= 0.1 * wanted * sum;
  }
  printf("# %.1f worker seconds, of the training %.3f (%.3f)\n", sum, sum > 0 ? learned_s / sum : 0,
         wanted);
  return right;
}

static void a_training_beside_an_evaluation(void)
{
  struct fixture fixture;
  struct mo_compute *compute = NULL;
  struct mo_jobs *jobs = NULL;
  struct mo_compute_config compute_config = {.n_workers = 2, .isa = mo_isa_best()};
  struct mo_jobs_config config = {0};
  struct mo_controller_record record;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request evaluation = {.environment_set = "paper-test", .priority = MO_BATCH};
  struct mo_training_request training = {
      .record = {.settings = mo_training_defaults(MO_TRAINING_PRETRAIN),
                 .checkpoint_every_s = 60,
                 .checkpoints_kept = 1}};
  struct mo_live live = {.position = 0};
  struct mo_job job;
  double end, slowest_s = 0;
  int64_t batch, learns, small;
  bool replayed;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_controller(fixture.store, "default", 1, &record) == MO_OK);
  REQUIRE(mo_compute_create_cpu(&compute_config, &compute) == MO_OK);
  REQUIRE(mo_jobs_create(fixture.store, compute, &config, &jobs, &fixture.message) == MO_OK);
  REQUIRE(fixture_bodies(3, BODIES, &forms, &genotypes) == MO_OK);
  evaluation.physics = mo_default_physics();
  evaluation.physics.n_steps = 800;
  evaluation.genotypes = genotypes + 10;
  evaluation.n_designs = BODIES - 10;
  training.record.settings.physics.n_steps =
      60; /* blocks of about 0.1 s: long beside those of the evaluation, short beside the test */
  training.record.settings.batch = 256;
  REQUIRE(mo_jobs_submit_evaluation(jobs, &evaluation, &batch, &replayed, &fixture.message) ==
          MO_OK);
  REQUIRE(mo_jobs_submit_training(jobs, &training, &learns, &replayed, &fixture.message) == MO_OK);
  for (end = now_s() + 60; live.position < 2 && now_s() < end; usleep(2000))
    mo_jobs_live(jobs, learns, &live);
  CHECK(training_gets(jobs, 0.5));
  REQUIRE(mo_jobs_set_weight(jobs, learns, 0.25) == MO_OK);
  CHECK(training_gets(jobs, 0.2));
  evaluation.n_designs = 1;
  evaluation.priority = -1;
  evaluation.physics.n_steps = 100;
  for (int i = 0; i < 10; i++) {
    double start = now_s();
    evaluation.genotypes = genotypes + i;
    REQUIRE(mo_jobs_submit_evaluation(jobs, &evaluation, &small, &replayed, &fixture.message) ==
            MO_OK);
    REQUIRE(await_end(jobs, small, 20000, &job) == MO_OK);
    CHECK(job.state == MO_JOB_SUCCEEDED && job.priority == MO_INTERACTIVE);
    slowest_s = fmax(slowest_s, now_s() - start);
  }
  printf("# slowest of 10 small evaluations beside them: %.0f ms\n", 1e3 * slowest_s);
  CHECK(slowest_s < 1.5);
  CHECK_INT(mo_jobs_cancel(jobs, learns), MO_OK);
  CHECK_INT(mo_jobs_cancel(jobs, batch), MO_OK);
  mo_jobs_free(jobs);
  mo_compute_free(compute);
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

static const struct check_case cases[] = {
    {"a training beside an evaluation", a_training_beside_an_evaluation}};
CHECK_MAIN(cases)
