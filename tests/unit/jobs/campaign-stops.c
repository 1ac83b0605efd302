/* campaign-stops.c: whatever people or ends of the process do to a campaign, it ends as it would
 * have without them. */
#include "blame.h"
#include "campaigns.h"

/* Slow enough to be met in every phase. */
static void slow_down(void)
{
  fake_plan.delay_us = 2500;
  fake_plan.gradient_delay_us = 5000;
}

/* A pause and a stop save all that is computed. */
static void check_counts(const struct origin *origin, const struct fake_count *count)
{
  uint64_t rollouts = 0, robots = 0;
  needs(origin, &rollouts, &robots);
  CHECK_INT(atomic_load(&count->rollouts), rollouts);
  CHECK_INT(atomic_load(&count->robots), robots);
}

static enum mo_phase phase_of(int mode, uint32_t round)
{
  return mode != MO_ZERO_SHOT && round % 2 == 1 ? MO_PHASE_LEARN : MO_PHASE_SCORE;
}

__attribute__((unused)) static void pauses_and_resumes(void)
{
  for (int mode = MO_ZERO_SHOT; mode <= MO_SIMULTANEOUS; mode++) {
    struct mo_campaign_request request = campaign((enum mo_campaign_mode)mode);
    struct origin origin = origin_of(&request);
    struct service service;
    struct fake_count count = {0};
    int64_t id;
    REQUIRE(start(&service, 1) == MO_OK);
    slow_down();
    fake_count = &count;
    id = submit(&service, &request);
    for (uint32_t round = 0; round < 3; round++) {
      double begin;
      REQUIRE(await_place(&service, id, round, phase_of(mode, round)));
      usleep(5000 * round);
      begin = now_s();
      CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
      CHECK(await_phase(&service, id, MO_PHASE_IDLE));
      CHECK(now_s() - begin < 3);
      CHECK_INT(state_of(&service, id), MO_JOB_PAUSED);
      CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
    }
    for (int i = 0; i < 3; i++) { /* at once */
      (void)mo_jobs_pause(service.jobs, id);
      (void)mo_jobs_resume(service.jobs, id);
      usleep(4000 * i);
    }
    CHECK(ends_as_plain(&service, id, &origin));
    fake_count = NULL;
    check_counts(&origin, &count);
    CHECK_INT(warnings, 0);
    service_end(&service);
  }
}

/* A stop, and another number of workers in the next life. */
static void stops_and_goes_on(void)
{
  static const uint32_t workers[] = {1, 7, 2};
  for (int mode = MO_ZERO_SHOT; mode <= MO_SIMULTANEOUS; mode++) {
    struct mo_campaign_request request = campaign((enum mo_campaign_mode)mode);
    struct origin origin = origin_of(&request);
    struct service service;
    struct fake_count count = {0};
    int64_t id;
    REQUIRE(start(&service, 1) == MO_OK);
    slow_down();
    fake_count = &count;
    id = submit(&service, &request);
    for (uint32_t round = 0; round < 3; round++) {
      double begin;
      REQUIRE(await_place(&service, id, round, phase_of(mode, round + 1)));
      begin = now_s();
      CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_OK);
      CHECK(now_s() - begin < 3);
      CHECK_INT(state_of(&service, id), MO_JOB_QUEUED);
      service_close(&service);
      service.n_workers = workers[round];
      REQUIRE(service_open(&service) == MO_OK);
    }
    CHECK(ends_as_plain(&service, id, &origin));
    fake_count = NULL;
    check_counts(&origin, &count);
    service_end(&service);
  }
}

static void cancels(void)
{
  struct mo_campaign_request request = campaign(MO_FEW_SHOT);
  struct mo_controller_record record;
  struct mo_jobs_stats stats;
  struct service service;
  int64_t learning, scoring, waiting;
  snprintf(request.record.name, sizeof(request.record.name), "never");
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_delay_us = 10000000;
  learning = submit(&service, &request);
  scoring = submit(&service, &request);
  waiting = submit(&service, &request);
  CHECK_INT(mo_jobs_cancel(service.jobs, waiting), MO_OK); /* before it starts */
  REQUIRE(await_phase(&service, learning, MO_PHASE_LEARN));
  CHECK_INT(state_of(&service, scoring), MO_JOB_QUEUED); /* one at a time */
  fake_plan.delay_us = 10000000;
  CHECK_INT(mo_jobs_cancel(service.jobs, learning), MO_OK);
  CHECK(await_phase(&service, learning, MO_PHASE_IDLE));
  fake_plan.gradient_delay_us = 0;
  REQUIRE(await_phase(&service, scoring, MO_PHASE_SCORE));
  CHECK_INT(mo_jobs_cancel(service.jobs, scoring), MO_OK);
  CHECK(await_phase(&service, scoring, MO_PHASE_IDLE));
  CHECK_INT(mo_jobs_cancel(service.jobs, scoring), MO_ERR_CONFLICT);
  CHECK_INT(mo_jobs_extend_campaign(service.jobs, scoring, 1, NULL, NULL), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_controller(service.fixture.store, "never", &record), MO_ERR_NOT_FOUND);
  stats = idle_stats(&service);
  CHECK_INT(stats.open_jobs, 0);
  CHECK_INT(stats.jobs_cancelled, 3);
  service_end(&service);
}

/* Extended while it waits, runs, is paused, and when it is over: each time as if it had been asked
 * for at once. */
__attribute__((unused)) static void extends(void)
{
  for (int mode = MO_ZERO_SHOT; mode <= MO_SIMULTANEOUS; mode++) {
    struct mo_campaign_request request = campaign((enum mo_campaign_mode)mode);
    struct mo_request_key key = {.text = "more"};
    struct origin origin;
    struct service service;
    struct mo_job job;
    int64_t id;
    request.record.settings.generations = 1;
    origin = origin_of(&request);
    origin.settings.generations = 5;
    REQUIRE(start(&service, 1) == MO_OK);
    slow_down();
    id = submit(&service, &request);
    REQUIRE(await_phase(&service, id, MO_PHASE_SCORE));
    CHECK_INT(mo_jobs_extend_campaign(service.jobs, id, 1, NULL, NULL), MO_OK); /* running */
    CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
    CHECK_INT(mo_jobs_extend_campaign(service.jobs, id, 1, NULL, NULL), MO_OK); /* paused */
    CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
    REQUIRE(await_end(service.jobs, id, 120000, &job) == MO_OK);
    CHECK_INT(job.state, MO_JOB_SUCCEEDED);
    CHECK_INT(idle_stats(&service).open_jobs, 0);
    CHECK_INT(status_of(&service, id).generation, 3);
    CHECK_INT(mo_jobs_extend_campaign(service.jobs, id, 1, &key, NULL), MO_OK); /* over */
    CHECK_INT(mo_jobs_extend_campaign(service.jobs, id, 1, &key, NULL), MO_OK); /* the same again */
    CHECK_INT(mo_jobs_extend_campaign(service.jobs, id, 1, NULL, NULL), MO_OK);
    REQUIRE(await_end(service.jobs, id, 120000, &job) == MO_OK);
    while (status_of(&service, id).generation < 5 &&
           job.state == MO_JOB_SUCCEEDED) /* the first was over before the second came */
      REQUIRE(await_end(service.jobs, id, 120000, &job) == MO_OK);
    CHECK(ends_as_plain(&service, id, &origin));
    CHECK_INT(idle_stats(&service).open_jobs, 0);
    CHECK_INT(mo_jobs_extend_campaign(service.jobs, id, 0, NULL, NULL), MO_ERR_INVALID);
    CHECK_INT(mo_jobs_extend_campaign(service.jobs, id, MO_GENERATIONS_MAX, NULL, NULL),
              MO_ERR_RANGE);
    CHECK_INT(mo_jobs_extend_campaign(service.jobs, 99, 1, NULL, NULL), MO_ERR_NOT_FOUND);
    service_end(&service);
  }
}

__attribute__((unused)) static void does_not_extend_one_cosine(void)
{
  struct mo_campaign_request request = campaign(MO_SIMULTANEOUS);
  struct service service;
  struct origin origin;
  int64_t id;
  request.record.settings.learning.schedule = mo_schedule_one_cosine();
  request.record.settings.learning.schedule.warmup_steps = 2;
  request.record.settings.generations = 2;
  origin = origin_of(&request);
  REQUIRE(start(&service, 1) == MO_OK);
  id = submit(&service, &request);
  CHECK_INT(mo_jobs_extend_campaign(service.jobs, id, 1, NULL, &service.fixture.message),
            MO_ERR_UNSUPPORTED);
  CHECK(strstr(service.fixture.message.text, "cosine") != NULL);
  CHECK(ends_as_plain(&service, id, &origin));
  service_end(&service);
}

/* Several at once, one of them heavier, and an evaluation beside them. */
static void runs_side_by_side(void)
{
  struct service service;
  struct mo_campaign_request requests[3];
  struct origin origins[3];
  struct mo_evaluation_request evaluation;
  struct mo_bits *forms = NULL, *genotypes = NULL;
  struct mo_job job;
  int64_t ids[3], other;
  REQUIRE(start(&service, 3) == MO_OK);
  REQUIRE(fixture_bodies(77, 20, &forms, &genotypes) == MO_OK);
  fake_plan.delay_us = 50000; /* so that the first is not over before its weight is set */
  for (int i = 0; i < 3; i++) {
    requests[i] = campaign((enum mo_campaign_mode)i);
    requests[i].record.settings.seed = 100 + (uint64_t)i;
    requests[i].weight = i + 1;
    origins[i] = origin_of(&requests[i]);
    ids[i] = submit(&service, &requests[i]);
    REQUIRE(ids[i] > 0);
  }
  evaluation = service_request(genotypes, 20);
  other = service_submit(&service, &evaluation);
  CHECK_INT(mo_jobs_set_weight(service.jobs, ids[0], 500), MO_OK);
  fake_plan.delay_us = 1000;
  REQUIRE(await_end(service.jobs, other, 120000, &job) == MO_OK);
  CHECK(right(&service, other, genotypes));
  for (int i = 0; i < 3; i++)
    CHECK(ends_as_plain(&service, ids[i], &origins[i]));
  free(forms);
  free(genotypes);
  service_end(&service);
}

__attribute__((unused)) static int64_t submit_one(struct service *service)
{
  struct mo_campaign_request request = campaign(MO_FEW_SHOT);
  return submit(service, &request);
}

__attribute__((unused)) static void blames_crashes_on_the_campaign(void)
{
  struct service service;
  REQUIRE(watch_start(&service) == MO_OK);
  check_blame(&service, submit_one);
}

static const struct check_case cases[] = {
    {"stops and goes on", stops_and_goes_on},
    {"cancels", cancels},
    {"runs side by side", runs_side_by_side},
#ifndef __SANITIZE_THREAD__ /* slow there, and nothing new about threads */
    {"pauses and resumes", pauses_and_resumes},
    {"extends", extends},
    {"does not extend one cosine", does_not_extend_one_cosine},
    {"blames crashes on the campaign", blames_crashes_on_the_campaign},
#endif
};
CHECK_MAIN(cases)
