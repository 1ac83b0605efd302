/* training-stops.c: whatever people or ends of the process do to a training, it ends with the same
 * weights. */
#include "blame.h"
#include "learning.h"

static void pauses_and_resumes(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_training_status status;
  struct mo_live live;
  struct mo_job job;
  double begin;
  int64_t id;
  request.record.checkpoint_every_steps = 0; /* only the pauses save */
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_delay_us = 20000;
  id = submit(&service, &request);
  for (uint32_t step = 3; step <= 12; step += 3) {
    REQUIRE(await_step(&service, id, step));
    begin = now_s();
    CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
    CHECK(await_phase(&service, id, MO_PHASE_IDLE, &live));
    CHECK(now_s() - begin < 5);
    REQUIRE(mo_store_training(service.fixture.store, id, &status) == MO_OK);
    CHECK_INT(status.job.state, MO_JOB_PAUSED);
    CHECK(status.checkpoint_step >= step && status.checkpoint_step == status.step);
    CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
    usleep(30000);
    CHECK_INT(state_of(&service, id), MO_JOB_PAUSED);
    CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
  }
  /* Paused and resumed at once: it goes on. */
  for (int i = 0; i < 5; i++) {
    CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
    CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
    usleep(5000 * i);
  }
  REQUIRE(await_end(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.attempts, 0);
  CHECK(has_result(&service, id, &expected));
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_ERR_CONFLICT);
  service_end(&service);
}

static void stops_and_goes_on(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_training_status status;
  struct mo_job job;
  double begin;
  int64_t id;
  request.record.checkpoint_every_steps = 0;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_delay_us = 20000;
  id = submit(&service, &request);
  for (uint32_t step = 4; step <= 12; step += 4) {
    REQUIRE(await_step(&service, id, step));
    begin = now_s();
    CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_OK);
    CHECK(now_s() - begin < 3);
    REQUIRE(mo_store_training(service.fixture.store, id, &status) == MO_OK);
    CHECK_INT(status.job.state, MO_JOB_QUEUED);
    CHECK(status.checkpoint_step >= step && status.checkpoint_step == status.step);
    service_close(&service);
    REQUIRE(service_open(&service) == MO_OK);
  }
  REQUIRE(await_end(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.attempts, 0);
  CHECK(has_result(&service, id, &expected));
  CHECK_INT(warnings, 0);
  service_end(&service);
}

/* Stopped under one code and continued under another, at whatever step: it goes on, and the lineage
 * reports every change. */
static void reports_other_code(void)
{
  static const char *const codes[] = {"fake gradient", "fake gradient-2", "fake gradient"};
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_training_lineage lineage = {0};
  struct mo_training_status status;
  struct mo_sha256 expected;
  struct mo_event events[60];
  struct mo_job job;
  int64_t id, n;
  int changes = 0;
  request.record.checkpoint_every_steps = 0;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_delay_us = 20000;
  id = submit(&service, &request);
  for (uint32_t round = 0; round < 3; round++) {
    REQUIRE(await_step(&service, id, 4 * (round + 1)));
    CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_OK);
    REQUIRE(mo_store_training(service.fixture.store, id, &status) == MO_OK);
    CHECK_INT(status.code.n, round + 1);
    CHECK_TEXT(status.code.codes[status.code.n - 1].fingerprint, codes[round]);
    lineage = status.code;
    service_close(&service);
    atomic_store(&fake_plan.gradient_fingerprint, codes[round < 2 ? round + 1 : 2]);
    REQUIRE(service_open(&service) == MO_OK);
    if (round < 2) {
      REQUIRE(await_step(&service, id, status.checkpoint_step + 1));
      REQUIRE(mo_store_training(service.fixture.store, id, &status) == MO_OK);
      CHECK_INT(status.code.codes[status.code.n - 1].from_step, status.checkpoint_step);
    }
  }
  REQUIRE(await_end(service.jobs, id, 30000, &job) == MO_OK);
  REQUIRE(expect(&request, NULL, NULL, NULL, 0, &lineage, &expected));
  CHECK(has_result(&service, id, &expected));
  n = mo_store_events(service.fixture.store, 0, id, events, 60, NULL, NULL);
  for (int64_t i = 0; i < n; i++)
    changes += strcmp(events[i].type, "training.code_changed") == 0;
  CHECK_INT(changes, 2);
  service_end(&service);
}

static void cancels(void)
{
  struct service service;
  struct mo_training_request request = pretraining("never");
  struct mo_controller_record record;
  struct mo_live live;
  struct mo_jobs_stats stats;
  double begin;
  int64_t id, waiting;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_delay_us = 10000000;
  id = submit(&service, &request);
  waiting = submit(&service, &request);
  REQUIRE(await_state(&service, id, MO_JOB_RUNNING, 10));
  REQUIRE(await_phase(&service, id, MO_PHASE_LEARN, &live));
  CHECK_INT(mo_jobs_cancel(service.jobs, waiting), MO_OK); /* before it starts */
  begin = now_s();
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_OK); /* inside a gradient */
  CHECK(await_phase(&service, id, MO_PHASE_IDLE, &live));
  CHECK(now_s() - begin < 3);
  CHECK_INT(state_of(&service, id), MO_JOB_CANCELLED);
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_ERR_CONFLICT);
  CHECK_INT(mo_store_controller(service.fixture.store, "never", &record), MO_ERR_NOT_FOUND);
  stats = idle_stats(&service);
  CHECK_INT(stats.open_jobs, 0);
  CHECK_INT(stats.jobs_cancelled, 2);
  service_end(&service);
}

__attribute__((unused)) static int64_t submit_one(struct service *service)
{
  struct mo_training_request request = pretraining("");
  return submit(service, &request);
}

__attribute__((unused)) static void blames_crashes_on_the_training(void)
{
  struct service service;
  REQUIRE(watch_start(&service) == MO_OK);
  check_blame(&service, submit_one);
}

static const struct check_case cases[] = {
    {"pauses and resumes", pauses_and_resumes},
    {"stops and goes on", stops_and_goes_on},
    {"reports other code", reports_other_code},
    {"cancels", cancels},
#ifndef __SANITIZE_THREAD__ /* slow there, and nothing new about threads */
    {"blames crashes on the training", blames_crashes_on_the_training},
#endif
};
CHECK_MAIN(cases)
