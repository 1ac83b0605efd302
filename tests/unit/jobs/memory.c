/* memory.c: jobs that do not fit into max_memory are refused, or wait with a reason; a job that
 * causes the process to be killed is identified. */
#include "fakes.h"

#define MIB ((uint64_t)1 << 20)

/* A request that learns for hours; the set of its bodies takes about 100 MiB. */
static struct mo_training_request large(void)
{
  struct mo_training_request request = pretraining("");
  request.record.settings.n_steps = 400000;
  return request;
}

static int reopen_in(uint64_t max_memory, bool was_killed)
{
  service.config.max_memory = max_memory;
  service.config.killed_us = was_killed ? 1 : 0;
  return service_reopen();
}

SERVICE_CASE(refuses_what_never_fits, 1)
{
  struct mo_training_request request = large();
  struct mo_campaign_request evolves = campaign(MO_ZERO_SHOT);
  fake_plan.gradient_delay_us = 1000;
  int64_t id = submit_training(&request); /* without a limit */
  REQUIRE(id > 0);
  REQUIRE_OK(reopen_in(224 * MIB, false));
  CHECK_INT(submit_training(&request), MO_ERR_LIMIT);
  CHECK_SAYS(fixture.message, "can use only 136 MiB");
  CHECK_SAYS(fixture.message, "max_memory");
  evolves.record.settings.population = MO_POPULATION_MAX;
  CHECK_INT(submit_campaign(&evolves), MO_ERR_LIMIT);
  /* The job that is already stored waits, and does not block other jobs. */
  CHECK(await_reason(id, "jobs can use only 136 MiB"));
  CHECK(succeeds(submit_one(TRAINING), NULL));
  CHECK_INT(state_of(id), MO_JOB_QUEUED);
  CHECK(await_reason(id, "raise max_memory"));
  CHECK_OK(mo_jobs_cancel(service.jobs, id));
}

SERVICE_CASE(waits_beside_others, 1)
{
  struct mo_training_request request = large();
  service.config.max_active_trainings = 3;
  REQUIRE_OK(reopen_in(324 * MIB, false));
  fake_plan.gradient_delay_us = 2000;
  int64_t first = submit_training(&request);
  REQUIRE(await_state(first, MO_JOB_RUNNING));
  int64_t second = submit_training(&request);
  CHECK(await_reason(second, "of the 236 MiB for jobs are free"));
  CHECK_INT(state_of(second), MO_JOB_QUEUED);
  /* Jobs that fit may go first, but not indefinitely. */
  for (int i = 0; i < 8; i++)
    CHECK(succeeds(submit_one(TRAINING), NULL));
  int64_t id = submit_one(TRAINING);
  CHECK(await_reason(id, "starts first"));
  CHECK_INT(state_of(id), MO_JOB_QUEUED);
  CHECK_OK(mo_jobs_cancel(service.jobs, first));
  CHECK(await_state(second, MO_JOB_RUNNING));
  CHECK(succeeds(id, NULL));
  CHECK(live_of(second).phase != MO_PHASE_WAIT);
  /* A waiting job that is paused does not hold up others. */
  first = submit_training(&request);
  CHECK(await_reason(first, "MiB"));
  CHECK_OK(mo_jobs_pause(service.jobs, first));
  CHECK_INT(live_of(first).phase, MO_PHASE_IDLE);
  CHECK_OK(mo_jobs_cancel(service.jobs, second));
  CHECK_OK(mo_jobs_resume(service.jobs, first));
  CHECK(await_state(first, MO_JOB_RUNNING));
  CHECK_OK(mo_jobs_cancel(service.jobs, first));
}

/* As if the process had been killed while these jobs ran. */
static int kill_with(int64_t first, int64_t second)
{
  service_close();
  service_set_states(first, second, MO_JOB_RUNNING);
  return reopen_in(0, true);
}

SERVICE_CASE(finds_who_has_it_killed, 2)
{
  struct mo_job job;
  fake_plan.gradient_delay_us = 60000000; /* nothing is saved */
  int64_t id = submit_one(TRAINING);
  for (uint32_t attempts = 1; attempts <= 3; attempts++) {
    REQUIRE(await_state(id, MO_JOB_RUNNING));
    REQUIRE_OK(kill_with(id, 0));
    job = job_of(id);
    CHECK_INT(job.attempts, attempts);
  }
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK_HAS(job.error_text, "killed while it ran this job, before the job had saved");
  /* With two jobs, it is unknown which one caused the kill: they run one after the other until the
   * first has saved something. */
  id = submit_one(TRAINING);
  int64_t other = submit_one(TRAINING);
  REQUIRE(await_state(id, MO_JOB_RUNNING));
  REQUIRE(await_state(other, MO_JOB_RUNNING));
  REQUIRE_OK(kill_with(id, other));
  REQUIRE(await_state(id, MO_JOB_RUNNING));
  CHECK(await_reason(other, "one at a time"));
  CHECK_INT(state_of(other), MO_JOB_QUEUED);
  CHECK_INT(job_of(id).attempts, 0);
  REQUIRE_OK(kill_with(id, 0));
  CHECK_INT(job_of(id).attempts, 1);
  fake_plan.gradient_delay_us = 0;
  CHECK(ends_right(id, TRAINING)); /* the attempt is forgiven: the job has made progress */
  CHECK(ends_right(other, TRAINING));
}

/* A job that has saved its work is not blamed instead of one that has not. */
SERVICE_CASE(blames_who_has_saved_nothing, 2)
{
  struct mo_training_request request = pretraining("");
  fake_plan.gradient_delay_us = 20000;
  request.record.settings.n_steps = 100000;
  int64_t proven = submit_training(&request);
  REQUIRE(await_step(proven, 1));
  CHECK_OK(mo_jobs_pause(service.jobs, proven)); /* writes a checkpoint */
  REQUIRE(await_state(proven, MO_JOB_PAUSED));
  CHECK_OK(mo_jobs_resume(service.jobs, proven));
  REQUIRE(await_state(proven, MO_JOB_RUNNING));
  fake_plan.gradient_delay_us = 60000000;
  int64_t other = submit_training(&request);
  REQUIRE(await_state(other, MO_JOB_RUNNING));
  REQUIRE_OK(kill_with(proven, other));
  CHECK_INT(job_of(other).attempts, 1);
  CHECK_INT(job_of(proven).attempts, 0);
  fake_plan.gradient_delay_us = 0;
  CHECK_OK(mo_jobs_cancel(service.jobs, other));
  CHECK_OK(mo_jobs_cancel(service.jobs, proven));
}

/* Scores saved since the process started count as progress, even if no generation is complete. */
SERVICE_CASE(counts_scores_as_work, 2)
{
  struct mo_campaign_request request = campaign(MO_ZERO_SHOT);
  request.record.settings.population = 2000;
  fake_plan.delay_us = 50000; /* the generation takes longer than a busy machine takes for this */
  const int64_t id = submit_campaign(&request);
  for (int kill = 0; kill < 4; kill++) {
    const int before = count_events(id, "campaign.progress");
    REQUIRE(AWAIT(count_events(id, "campaign.progress") > before));
    CHECK_INT(count_events(id, "campaign.generation"), 0);
    service.config.killed_us = mo_clock_wall_us();
    REQUIRE(AWAIT(count_events(id, "campaign.progress") > before + 1));
    service_close();
    service_set_states(id, 0, MO_JOB_RUNNING);
    REQUIRE_OK(service_open());
    CHECK_INT(job_of(id).attempts, 0);
  }
  CHECK_OK(mo_jobs_cancel(service.jobs, id));
}

/* After a kill that counts, a training run saves its first checkpoint early, regardless of its
 * settings. */
SERVICE_CASE(saves_early_after_a_kill, 1)
{
  struct mo_training_request request = pretraining("");
  struct mo_checkpoint_row row;
  request.record.settings.n_steps = 100000;
  request.record.checkpoint_every_steps = 0;
  request.record.checkpoint_every_s = 3600;
  fake_plan.gradient_delay_us = 60000000;
  const int64_t id = submit_training(&request);
  REQUIRE(await_state(id, MO_JOB_RUNNING));
  REQUIRE_OK(kill_with(id, 0));
  CHECK_INT(job_of(id).attempts, 1);
  fake_plan.gradient_delay_us = 20000;
  const double begin = now_s();
  REQUIRE(AWAIT(mo_store_checkpoints(store, id, &row, 1) > 0));
  CHECK(now_s() - begin > 1);
  CHECK_INT(job_of(id).attempts, 0);
  const uint32_t step = row.step;
  REQUIRE(await_step(id, step + 200)); /* after 4 s: later checkpoints follow the settings */
  REQUIRE(mo_store_checkpoints(store, id, &row, 1) > 0);
  CHECK_INT(row.step, step);
  CHECK_OK(mo_jobs_cancel(service.jobs, id));
}

static const struct check_case cases[] = {
    {"refuses jobs that can never fit", refuses_what_never_fits},
    {"waits without blocking others", waits_beside_others},
    {"identifies the job that gets the process killed", finds_who_has_it_killed},
    {"blames the job that has saved nothing", blames_who_has_saved_nothing},
    {"counts scores as work", counts_scores_as_work},
    {"saves early after a kill", saves_early_after_a_kill},
};
CHECK_MAIN(cases)
