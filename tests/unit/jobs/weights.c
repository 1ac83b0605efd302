/* weights.c: what jobs weigh, with a fake back end: among evaluations, in the shares of the back
 * end, changed while they run, wait and come back. */
#include "learning.h"

enum { BODIES = 160 };

/* Blocks of `id` among those that were started so far, from the one numbered `from` on. */
static double part_of(int64_t id, size_t from, size_t *n)
{
  static int64_t tags[4 * BODIES];
  size_t of_id = 0;
  *n = fake_history(tags, 4 * BODIES);
  for (size_t i = from; i < *n; i++)
    of_id += tags[i] == id;
  return *n > from ? (double)of_id / (double)(*n - from) : 0;
}

static bool await_history(size_t n, double seconds)
{
  static int64_t tags[4 * BODIES];
  double end = now_s() + seconds;
  while (fake_history(tags, 4 * BODIES) < n && now_s() < end)
    usleep(1000);
  return fake_history(tags, 4 * BODIES) >= n;
}

static bool await_weight(int64_t id, double weight)
{
  double end = now_s() + 20;
  while (fake_weight(id) != weight && now_s() < end)
    usleep(500);
  return fake_weight(id) == weight;
}

static void among_evaluations(void)
{
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_job job;
  int64_t light, heavy;
  size_t n, before;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(31, 2 * BODIES, &forms, &genotypes) == MO_OK);
  fake_plan.delay_us = 2000;
  request = service_request(genotypes, BODIES);
  light = service_submit(&service, &request);
  request = service_request(genotypes + BODIES, BODIES);
  request.weight = 3;
  heavy = service_submit(&service, &request);
  REQUIRE(light > 0 && heavy > 0);
  REQUIRE(await_weight(heavy, 4)); /* both: the share of all evaluations */
  (void)part_of(light, 0, &before);
  REQUIRE(await_history(before + 60, 20));
  CHECK_NEAR(part_of(heavy, before, &n), 0.75, 0.08);
  CHECK_INT(mo_jobs_set_weight(service.jobs, light, 27), MO_OK);
  REQUIRE(await_weight(light, 30));
  (void)part_of(light, 0, &before);
  REQUIRE(await_history(before + 40, 20));
  CHECK_NEAR(part_of(light, before, &n), 0.9, 0.08);
  fake_plan.delay_us = 0;
  REQUIRE(await_end(service.jobs, light, 20000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
  CHECK(job.weight == 27);
  REQUIRE(await_end(service.jobs, heavy, 20000, &job) == MO_OK && job.state == MO_JOB_SUCCEEDED);
  CHECK(job.weight == 3);
  CHECK(right(&service, light, genotypes) && right(&service, heavy, genotypes + BODIES));
  CHECK_INT(mo_jobs_set_weight(service.jobs, light, 1), MO_ERR_CONFLICT);
  free(forms);
  free(genotypes);
  service_end(&service);
  CHECK_INT(fake_shares(), 0);
}

static void of_a_training(void)
{
  struct service service;
  struct mo_training_request request = pretraining("weighed");
  struct mo_sha256 expected = undisturbed();
  struct mo_live live;
  struct mo_jobs_stats stats;
  struct mo_event events[60];
  struct mo_job job;
  double seconds;
  int64_t id, n;
  int changes = 0;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_delay_us = 4000;
  request.weight = 2.5;
  id = submit(&service, &request);
  REQUIRE(id > 0 && await_step(&service, id, 1));
  CHECK(fake_weight(id) == 2.5);
  CHECK_INT(fake_shares(), 2);
  mo_jobs_live(service.jobs, id, &live);
  CHECK(live.busy_s > 0);
  CHECK_INT(mo_jobs_set_weight(service.jobs, id, 7), MO_OK);
  CHECK_INT(mo_jobs_set_weight(service.jobs, id, 7), MO_OK);
  CHECK(await_weight(id, 7));
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
  REQUIRE(await_phase(&service, id, MO_PHASE_IDLE, &live));
  CHECK(live.busy_s < 0);
  CHECK_INT(fake_shares(), 1);
  mo_jobs_get_stats(service.jobs, &stats);
  seconds = stats.worker_s[MO_JOB_TRAINING];
  CHECK(seconds > 0);
  CHECK_INT(mo_jobs_set_weight(service.jobs, id, 0.5), MO_OK); /* while it waits */
  CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
  CHECK(await_weight(id, 0.5));
  service_close(&service);
  CHECK_INT(fake_shares(), 0);
  REQUIRE(service_open(&service) == MO_OK); /* and after a restart */
  CHECK_INT(mo_jobs_set_weight(service.jobs, id, 4), MO_OK);
  fake_plan.gradient_delay_us = 0;
  REQUIRE(await_end(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK(job.weight == 4 && fake_weight(id) == 4);
  CHECK(has_result(&service, id, &expected));
  CHECK_INT(mo_jobs_set_weight(service.jobs, id, 1), MO_ERR_CONFLICT);
  REQUIRE(await_phase(&service, id, MO_PHASE_IDLE, &live));
  mo_jobs_get_stats(service.jobs, &stats);
  CHECK(stats.worker_s[MO_JOB_TRAINING] > 0 && stats.worker_s[MO_JOB_EVALUATION] == 0);
  n = mo_store_events(service.fixture.store, 0, id, events, 60, NULL, NULL);
  for (int64_t i = 0; i < n; i++)
    changes += strcmp(events[i].type, "job.weight") == 0;
  CHECK_INT(changes, 3); /* the same weight again is none */
  service_end(&service);
}

static void wrong_weights(void)
{
  static const double wrong[] = {-1, 0.0009, 1000.1, NAN, INFINITY};
  struct service service;
  struct mo_bits *forms, *genotypes;
  struct mo_evaluation_request request;
  struct mo_training_request training = pretraining("");
  struct mo_job job;
  int64_t id;
  bool replayed;
  REQUIRE(service_start(&service) == MO_OK);
  REQUIRE(fixture_bodies(8, 100, &forms, &genotypes) == MO_OK);
  request = service_request(genotypes, 100);
  fake_plan.delay_us = 5000;
  id = service_submit(&service, &request);
  for (int i = 0; i < 5; i++) {
    int64_t other = 0;
    request.weight = training.weight = wrong[i];
    CHECK_INT(mo_jobs_submit_evaluation(service.jobs, &request, &other, &replayed,
                                        &service.fixture.message),
              MO_ERR_RANGE);
    CHECK(strstr(service.fixture.message.text, "weight") != NULL);
    CHECK_INT(mo_jobs_submit_training(service.jobs, &training, &other, &replayed,
                                      &service.fixture.message),
              MO_ERR_RANGE);
    CHECK_INT(mo_jobs_set_weight(service.jobs, id, wrong[i]), MO_ERR_RANGE);
  }
  CHECK_INT(mo_jobs_set_weight(service.jobs, id, 0), MO_ERR_RANGE);
  CHECK_INT(mo_jobs_set_weight(service.jobs, id + 100, 1), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_job(service.fixture.store, id, &job), MO_OK);
  CHECK(job.weight == 1);
  free(forms);
  free(genotypes);
  service_end(&service);
}

/* ---- changed by many, while shares come and go ---- */

struct changer {
  struct mo_jobs *jobs;
  int64_t id;
  double first;
};

static void *change(void *context)
{
  const struct changer *changer = context;
  for (int i = 0; i < 20; i++) {
    double busy_s = mo_jobs_busy_s(changer->jobs, changer->id);
    if (mo_jobs_set_weight(changer->jobs, changer->id, changer->first + i) != MO_OK || busy_s > 1e6)
      return context;
  }
  return NULL;
}

static void the_newest_weight_counts(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_job job;
  pthread_t threads[3];
  struct changer changers[3];
  void *failed = NULL;
  int64_t id;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_delay_us = 2000;
  request.record.settings.n_steps = 100000;
  request.record.validate_every_steps = 0;
  id = submit(&service, &request);
  for (int round = 0; round < 4; round++) {
    for (int i = 0; i < 3; i++) {
      changers[i] = (struct changer){service.jobs, id, 1 + 100 * i + 30 * round};
      REQUIRE(pthread_create(&threads[i], NULL, change, &changers[i]) == 0);
    }
    CHECK_INT(round % 2 == 0 ? mo_jobs_pause(service.jobs, id) : mo_jobs_resume(service.jobs, id),
              MO_OK);
    for (int i = 0; i < 3; i++) {
      pthread_join(threads[i], &failed);
      CHECK(failed == NULL);
    }
  }
  CHECK_INT(mo_store_job(service.fixture.store, id, &job), MO_OK);
  CHECK(job.weight > 91);
  CHECK(await_weight(id, job.weight));
  service_end(&service);
  CHECK_INT(fake_shares(), 0);
}

static const struct check_case cases[] = {
    {"among evaluations", among_evaluations},
    {"of a training", of_a_training},
    {"wrong weights", wrong_weights},
    {"the newest weight counts", the_newest_weight_counts},
};
CHECK_MAIN(cases)
