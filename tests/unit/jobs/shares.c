/* shares.c: a training beside an evaluation on the real back end: the workers' time is divided by
 * weight, and small evaluations do not wait for either. */
#include "service.h"

/* The training's part of the worker seconds from now on: once there were 4 of them, within a tenth
 * of what is wanted. Its blocks take 0.1 s, more on a busy machine: four times as long is waited
 * until that evens out. */
static bool training_gets(double wanted)
{
  const struct mo_jobs_stats before = stats_of();
  struct mo_jobs_stats now;
  double learned_s = 0, sum = 0, end = now_s() + 60;
  bool right = false;
  while ((sum < 4 || (!right && sum < 16)) && now_s() < end) {
    usleep(2000);
    now = stats_of();
    learned_s = now.worker_s[MO_JOB_TRAINING] - before.worker_s[MO_JOB_TRAINING];
    sum = learned_s + now.worker_s[MO_JOB_EVALUATION] - before.worker_s[MO_JOB_EVALUATION];
    right = fabs(learned_s - wanted * sum) <= 0.1 * wanted * sum;
  }
  printf("# %.1f worker seconds, of the training %.3f (%.3f)\n", sum, sum > 0 ? learned_s / sum : 0,
         wanted);
  return right;
}

static void a_training_beside_evaluations(void)
{
  enum { BODIES = 2000 };
  struct mo_evaluation_request evaluation;
  struct mo_training_request training = {
      .record = {.settings = mo_training_defaults(MO_TRAINING_PRETRAIN),
                 .checkpoint_every_s = 60,
                 .checkpoints_kept = 1}};
  struct mo_job job;
  double parts, slowest_s = 0;
  int64_t batch[2], learns;
  REQUIRE_OK(service_start(0));
  const struct mo_bits *genotypes = bodies(3, BODIES);
  training.record.settings.physics.n_steps =
      60; /* blocks of about 0.1 s: long beside those of evaluations, short beside the test */
  training.record.settings.batch = 256;
  learns = submit_training(&training);
  for (int i = 0; i < 2; i++) { /* both together weigh as much as the training */
    evaluation = service_request(genotypes + 10 + 990 * i, 990);
    evaluation.physics.n_steps = 800;
    evaluation.priority = MO_BATCH;
    evaluation.weight = i == 0 ? 0.75 : 0.25;
    batch[i] = submit_evaluation(&evaluation);
  }
  CHECK(AWAIT(live_of(learns).position >= 2));
  CHECK(training_gets(0.5));
  parts = (double)job_of(batch[0]).rollouts_done / (double)job_of(batch[1]).rollouts_done;
  printf("# the evaluations' parts are as %.2f to 1 (3)\n", parts);
  CHECK(parts > 1.8 && parts < 5); /* counts follow by a save, and the heavier one began first */
  REQUIRE_OK(mo_jobs_set_weight(service.jobs, learns, 0.25));
  CHECK(training_gets(0.2));
  for (int i = 0; i < 10; i++) {
    const double begin = now_s();
    evaluation = service_request(genotypes + i, 1);
    evaluation.physics.n_steps = 100;
    CHECK(succeeds(submit_evaluation(&evaluation), &job));
    CHECK_INT(job.priority, MO_INTERACTIVE);
    slowest_s = fmax(slowest_s, now_s() - begin);
  }
  printf("# slowest of 10 small evaluations beside them: %.0f ms\n", 1e3 * slowest_s);
  CHECK(slowest_s < 1.5);
  for (int i = 0; i < 2; i++)
    CHECK_OK(mo_jobs_cancel(service.jobs, batch[i]));
  CHECK_OK(mo_jobs_cancel(service.jobs, learns));
}

static const struct check_case cases[] = {
    {"a training beside evaluations", a_training_beside_evaluations}};
CHECK_MAIN(cases)
