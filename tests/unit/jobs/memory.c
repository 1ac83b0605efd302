/* memory.c: jobs that do not fit into max_memory are refused, or wait with a reason; a job
 * that gets the process killed is found. */
#include <sqlite3.h>

#include "jobs/campaigns.h"
#include "learning.h"

#define MIB ((uint64_t)1 << 20)

/* Learns for hours: the set of its bodies takes some 100 MiB. */
static struct mo_training_request large(void)
{
  struct mo_training_request request = pretraining("");
  request.record.settings.n_steps = 400000;
  return request;
}

static int reopen(struct service *service, uint64_t max_memory, bool was_killed)
{
  if (service->jobs != NULL)
    service_close(service);
  service->config.max_memory = max_memory;
  service->config.killed_us = was_killed ? 1 : 0;
  return service_open(service);
}

static bool await_reason(struct service *service, int64_t id, const char *words)
{
  struct mo_live live = {.reason = ""};
  for (double end = now_s() + 20; now_s() < end; usleep(1000)) {
    mo_jobs_live(service->jobs, id, &live);
    if (live.phase == MO_PHASE_WAIT && strstr(live.reason, words) != NULL)
      return true;
  }
  printf("# job %lld: %s\n", (long long)id, live.reason);
  return false;
}

static void refuses_what_never_fits(void)
{
  struct service service;
  struct mo_training_request request = large();
  struct mo_campaign_request campaign = {
      .record = {.settings = mo_campaign_preset(MO_ZERO_SHOT, MO_PRESET_DEMO)}};
  struct mo_job job;
  int64_t id, small;
  uint32_t fault;
  bool replayed;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_delay_us = 1000;
  id = submit(&service, &request); /* without a limit */
  REQUIRE(id > 0);
  REQUIRE(reopen(&service, 200 * MIB, false) == MO_OK);
  CHECK_INT(submit(&service, &request), MO_ERR_LIMIT);
  CHECK(strstr(service.fixture.message.text, "can have 136 MiB") != NULL);
  CHECK(strstr(service.fixture.message.text, "max_memory") != NULL);
  campaign.record.settings.population = MO_POPULATION_MAX;
  snprintf(campaign.record.environment_set, sizeof(campaign.record.environment_set), "paper-test");
  CHECK_INT(mo_jobs_submit_campaign(service.jobs, &campaign, &id, &replayed, &fault,
                                    &service.fixture.message),
            MO_ERR_LIMIT);
  /* The one that is stored waits, and is in nobody's way. */
  CHECK(await_reason(&service, id, "jobs can have 136 MiB"));
  request = pretraining("");
  small = submit(&service, &request);
  REQUIRE(await_end(service.jobs, small, 30000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  CHECK_INT(state_of(&service, id), MO_JOB_QUEUED);
  CHECK(await_reason(&service, id, "raise max_memory"));
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_OK);
  service_end(&service);
}

static void waits_beside_others(void)
{
  struct service service;
  struct mo_training_request request = large(), short_one = pretraining("");
  struct mo_live live;
  struct mo_job job;
  int64_t first, second, id = 0;
  REQUIRE(start(&service, 1) == MO_OK);
  service.config.max_active_trainings = 3;
  REQUIRE(reopen(&service, 300 * MIB, false) == MO_OK);
  fake_plan.gradient_delay_us = 2000;
  first = submit(&service, &request);
  REQUIRE(await_state(&service, first, MO_JOB_RUNNING, 10));
  second = submit(&service, &request);
  CHECK(await_reason(&service, second, "free of the 236 MiB"));
  CHECK_INT(state_of(&service, second), MO_JOB_QUEUED);
  /* Those that fit go first, but not without end. */
  for (int i = 0; i < 8; i++) {
    id = submit(&service, &short_one);
    REQUIRE(await_end(service.jobs, id, 30000, &job) == MO_OK);
    CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  }
  id = submit(&service, &short_one);
  CHECK(await_reason(&service, id, "starts first"));
  CHECK_INT(state_of(&service, id), MO_JOB_QUEUED);
  CHECK_INT(mo_jobs_cancel(service.jobs, first), MO_OK);
  CHECK(await_state(&service, second, MO_JOB_RUNNING, 10));
  REQUIRE(await_end(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_SUCCEEDED);
  mo_jobs_live(service.jobs, second, &live);
  CHECK(live.phase != MO_PHASE_WAIT);
  /* Who waits and is paused holds up nobody. */
  first = submit(&service, &request);
  CHECK(await_reason(&service, first, "MiB"));
  CHECK_INT(mo_jobs_pause(service.jobs, first), MO_OK);
  mo_jobs_live(service.jobs, first, &live);
  CHECK_INT(live.phase, MO_PHASE_IDLE);
  CHECK_INT(mo_jobs_cancel(service.jobs, second), MO_OK);
  CHECK_INT(mo_jobs_resume(service.jobs, first), MO_OK);
  CHECK(await_state(&service, first, MO_JOB_RUNNING, 10));
  CHECK_INT(mo_jobs_cancel(service.jobs, first), MO_OK);
  service_end(&service);
}

/* As if the process had been killed while these ran. */
static int kill_with(struct service *service, int64_t first, int64_t second)
{
  char path[512], sql[128];
  sqlite3 *db = NULL;
  int error;
  service_close(service);
  snprintf(path, sizeof(path), "%s/morphod.db", service->fixture.path);
  snprintf(sql, sizeof(sql), "UPDATE jobs SET state=1 WHERE id IN (%lld,%lld)", (long long)first,
           (long long)second);
  error =
      sqlite3_open(path, &db) != SQLITE_OK || sqlite3_exec(db, sql, NULL, NULL, NULL) != SQLITE_OK;
  sqlite3_close(db);
  return error != 0 ? -1 : reopen(service, 0, true);
}

static void finds_who_has_it_killed(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_job job;
  int64_t id, other;
  REQUIRE(start(&service, 2) == MO_OK);
  fake_plan.gradient_delay_us = 60000000; /* nothing is saved */
  id = submit(&service, &request);
  for (uint32_t attempts = 1; attempts <= 3; attempts++) {
    REQUIRE(await_state(&service, id, MO_JOB_RUNNING, 10));
    REQUIRE(kill_with(&service, id, 0) == MO_OK);
    REQUIRE(mo_store_job(service.fixture.store, id, &job) == MO_OK);
    CHECK_INT(job.attempts, attempts);
  }
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK(strstr(job.error_text, "killed while it ran this job, which had saved nothing") != NULL);
  /* Of two nobody knows which it was: they run one after the other, until the first has saved
   * something. */
  id = submit(&service, &request);
  other = submit(&service, &request);
  REQUIRE(await_state(&service, id, MO_JOB_RUNNING, 10));
  REQUIRE(await_state(&service, other, MO_JOB_RUNNING, 10));
  REQUIRE(kill_with(&service, id, other) == MO_OK);
  REQUIRE(await_state(&service, id, MO_JOB_RUNNING, 10));
  CHECK(await_reason(&service, other, "one at a time"));
  CHECK_INT(state_of(&service, other), MO_JOB_QUEUED);
  REQUIRE(mo_store_job(service.fixture.store, id, &job) == MO_OK);
  CHECK_INT(job.attempts, 0);
  REQUIRE(kill_with(&service, id, 0) == MO_OK);
  REQUIRE(mo_store_job(service.fixture.store, id, &job) == MO_OK);
  CHECK_INT(job.attempts, 1);
  fake_plan.gradient_delay_us = 0;
  REQUIRE(await_end(service.jobs, id, 90000, &job) == MO_OK);
  CHECK(has_result(&service, id, &expected));
  CHECK_INT(job.attempts, 0); /* forgiven: it has gone on */
  REQUIRE(await_end(service.jobs, other, 30000, &job) == MO_OK);
  CHECK(has_result(&service, other, &expected));
  service_end(&service);
}

/* A job that has saved its work is not blamed for one that has not. */
static void blames_who_has_saved_nothing(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_live live = {.position = 0};
  struct mo_job job;
  int64_t proven, other;
  REQUIRE(start(&service, 2) == MO_OK);
  fake_plan.gradient_delay_us = 20000;
  request.record.settings.n_steps = 100000;
  proven = submit(&service, &request);
  for (double end = now_s() + 20; live.position == 0 && now_s() < end; usleep(1000))
    mo_jobs_live(service.jobs, proven, &live);
  CHECK_INT(mo_jobs_pause(service.jobs, proven), MO_OK); /* writes a checkpoint */
  REQUIRE(await_state(&service, proven, MO_JOB_PAUSED, 10));
  CHECK_INT(mo_jobs_resume(service.jobs, proven), MO_OK);
  REQUIRE(await_state(&service, proven, MO_JOB_RUNNING, 10));
  fake_plan.gradient_delay_us = 60000000;
  other = submit(&service, &request);
  REQUIRE(await_state(&service, other, MO_JOB_RUNNING, 10));
  REQUIRE(kill_with(&service, proven, other) == MO_OK);
  REQUIRE(mo_store_job(service.fixture.store, other, &job) == MO_OK);
  CHECK_INT(job.attempts, 1);
  REQUIRE(mo_store_job(service.fixture.store, proven, &job) == MO_OK);
  CHECK_INT(job.attempts, 0);
  fake_plan.gradient_delay_us = 0;
  CHECK_INT(mo_jobs_cancel(service.jobs, other), MO_OK);
  CHECK_INT(mo_jobs_cancel(service.jobs, proven), MO_OK);
  service_end(&service);
}

static const struct check_case cases[] = {
    {"refuses what never fits", refuses_what_never_fits},
    {"waits beside others", waits_beside_others},
    {"finds who has it killed", finds_who_has_it_killed},
    {"blames who has saved nothing", blames_who_has_saved_nothing},
};
CHECK_MAIN(cases)
