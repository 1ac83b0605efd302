/* memory.c: jobs that do not fit into max_memory are refused, or wait with a reason; a job
 * that gets the process killed is found. */
#include "fakes.h"

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
  service->config.max_memory = max_memory;
  service->config.killed_us = was_killed ? 1 : 0;
  return service_reopen(service);
}

SERVICE_CASE(refuses_what_never_fits, 1)
{
  struct mo_training_request request = large();
  struct mo_campaign_request evolves = campaign(MO_ZERO_SHOT);
  int64_t id;
  fake_plan.gradient_delay_us = 1000;
  id = submit_training(service, &request); /* without a limit */
  REQUIRE(id > 0);
  REQUIRE(reopen(service, 200 * MIB, false) == MO_OK);
  CHECK_INT(submit_training(service, &request), MO_ERR_LIMIT);
  CHECK(strstr(service->fixture.message.text, "can have 136 MiB") != NULL);
  CHECK(strstr(service->fixture.message.text, "max_memory") != NULL);
  evolves.record.settings.population = MO_POPULATION_MAX;
  CHECK_INT(submit_campaign(service, &evolves), MO_ERR_LIMIT);
  /* The one that is stored waits, and is in nobody's way. */
  CHECK(await_reason(service, id, "jobs can have 136 MiB"));
  CHECK(succeeds(service, submit_one(service, TRAINING), NULL));
  CHECK_INT(state_of(service, id), MO_JOB_QUEUED);
  CHECK(await_reason(service, id, "raise max_memory"));
  CHECK_INT(mo_jobs_cancel(service->jobs, id), MO_OK);
}

SERVICE_CASE(waits_beside_others, 1)
{
  struct mo_training_request request = large();
  int64_t first, second, id;
  service->config.max_active_trainings = 3;
  REQUIRE(reopen(service, 300 * MIB, false) == MO_OK);
  fake_plan.gradient_delay_us = 2000;
  first = submit_training(service, &request);
  REQUIRE(await_state(service, first, MO_JOB_RUNNING));
  second = submit_training(service, &request);
  CHECK(await_reason(service, second, "free of the 236 MiB"));
  CHECK_INT(state_of(service, second), MO_JOB_QUEUED);
  /* Those that fit go first, but not without end. */
  for (int i = 0; i < 8; i++)
    CHECK(succeeds(service, submit_one(service, TRAINING), NULL));
  id = submit_one(service, TRAINING);
  CHECK(await_reason(service, id, "starts first"));
  CHECK_INT(state_of(service, id), MO_JOB_QUEUED);
  CHECK_INT(mo_jobs_cancel(service->jobs, first), MO_OK);
  CHECK(await_state(service, second, MO_JOB_RUNNING));
  CHECK(succeeds(service, id, NULL));
  CHECK(live_of(service, second).phase != MO_PHASE_WAIT);
  /* Who waits and is paused holds up nobody. */
  first = submit_training(service, &request);
  CHECK(await_reason(service, first, "MiB"));
  CHECK_INT(mo_jobs_pause(service->jobs, first), MO_OK);
  CHECK_INT(live_of(service, first).phase, MO_PHASE_IDLE);
  CHECK_INT(mo_jobs_cancel(service->jobs, second), MO_OK);
  CHECK_INT(mo_jobs_resume(service->jobs, first), MO_OK);
  CHECK(await_state(service, first, MO_JOB_RUNNING));
  CHECK_INT(mo_jobs_cancel(service->jobs, first), MO_OK);
}

/* As if the process had been killed while these ran. */
static int kill_with(struct service *service, int64_t first, int64_t second)
{
  service_close(service);
  service_set_states(service, first, second, MO_JOB_RUNNING);
  return reopen(service, 0, true);
}

SERVICE_CASE(finds_who_has_it_killed, 2)
{
  struct mo_job job;
  int64_t id, other;
  fake_plan.gradient_delay_us = 60000000; /* nothing is saved */
  id = submit_one(service, TRAINING);
  for (uint32_t attempts = 1; attempts <= 3; attempts++) {
    REQUIRE(await_state(service, id, MO_JOB_RUNNING));
    REQUIRE(kill_with(service, id, 0) == MO_OK);
    job = job_of(service, id);
    CHECK_INT(job.attempts, attempts);
  }
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK(strstr(job.error_text, "killed while it ran this job, which had saved nothing") != NULL);
  /* Of two nobody knows which it was: they run one after the other, until the first has saved
   * something. */
  id = submit_one(service, TRAINING);
  other = submit_one(service, TRAINING);
  REQUIRE(await_state(service, id, MO_JOB_RUNNING));
  REQUIRE(await_state(service, other, MO_JOB_RUNNING));
  REQUIRE(kill_with(service, id, other) == MO_OK);
  REQUIRE(await_state(service, id, MO_JOB_RUNNING));
  CHECK(await_reason(service, other, "one at a time"));
  CHECK_INT(state_of(service, other), MO_JOB_QUEUED);
  CHECK_INT(job_of(service, id).attempts, 0);
  REQUIRE(kill_with(service, id, 0) == MO_OK);
  CHECK_INT(job_of(service, id).attempts, 1);
  fake_plan.gradient_delay_us = 0;
  CHECK(ends_right(service, id, TRAINING)); /* the attempt is forgiven: it has gone on */
  CHECK(ends_right(service, other, TRAINING));
}

/* A job that has saved its work is not blamed for one that has not. */
SERVICE_CASE(blames_who_has_saved_nothing, 2)
{
  struct mo_training_request request = pretraining("");
  int64_t proven, other;
  fake_plan.gradient_delay_us = 20000;
  request.record.settings.n_steps = 100000;
  proven = submit_training(service, &request);
  REQUIRE(await_step(service, proven, 1));
  CHECK_INT(mo_jobs_pause(service->jobs, proven), MO_OK); /* writes a checkpoint */
  REQUIRE(await_state(service, proven, MO_JOB_PAUSED));
  CHECK_INT(mo_jobs_resume(service->jobs, proven), MO_OK);
  REQUIRE(await_state(service, proven, MO_JOB_RUNNING));
  fake_plan.gradient_delay_us = 60000000;
  other = submit_training(service, &request);
  REQUIRE(await_state(service, other, MO_JOB_RUNNING));
  REQUIRE(kill_with(service, proven, other) == MO_OK);
  CHECK_INT(job_of(service, other).attempts, 1);
  CHECK_INT(job_of(service, proven).attempts, 0);
  fake_plan.gradient_delay_us = 0;
  CHECK_INT(mo_jobs_cancel(service->jobs, other), MO_OK);
  CHECK_INT(mo_jobs_cancel(service->jobs, proven), MO_OK);
}

static const struct check_case cases[] = {
    {"refuses what never fits", refuses_what_never_fits},
    {"waits beside others", waits_beside_others},
    {"finds who has it killed", finds_who_has_it_killed},
    {"blames who has saved nothing", blames_who_has_saved_nothing},
};
CHECK_MAIN(cases)
