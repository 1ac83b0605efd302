/* training-trouble.c: errors, damage and want of room: a training waits, tries again, and ends with
 * the same weights. */
#include <fcntl.h>
#include <signal.h>
#include <sys/resource.h>

#include "../store/fault_vfs.h"
#include "learning.h"

/* No file may grow beyond so many bytes: the database can, checkpoints cannot. */
static void limit_files(rlim_t bytes)
{
  struct rlimit limit;
  signal(SIGXFSZ, SIG_IGN);
  getrlimit(RLIMIT_FSIZE, &limit);
  limit.rlim_cur = bytes;
  setrlimit(RLIMIT_FSIZE, &limit);
}

static void waits_for_room(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_live live;
  struct mo_jobs_stats stats;
  struct mo_job job;
  double begin;
  int64_t id, waiting[MO_WAITING_MAX] = {0};
  REQUIRE(start(&service, 1) == MO_OK);
  CHECK_INT(mo_jobs_waiting(service.jobs, waiting), 0);
  limit_files(8 << 20);
  id = submit(&service, &request);
  REQUIRE(await_phase(&service, id, MO_PHASE_WAIT, &live));
  CHECK(strstr(live.reason, "no space") != NULL &&
        strstr(live.reason, "checkpoint of step 6") != NULL &&
        strstr(live.reason, "by itself") != NULL);
  CHECK_INT(live.position, 6);
  CHECK_INT(mo_jobs_waiting(service.jobs, waiting), 1);
  CHECK_INT(waiting[0], id);
  usleep(350000); /* it has tried again */
  mo_jobs_live(service.jobs, id, &live);
  CHECK_INT(live.phase, MO_PHASE_WAIT);
  CHECK_INT(warnings, 1);
  /* Somebody pauses it: it has nowhere to save to, and waits on; resumed, it goes on when there is
   * room. */
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
  CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
  limit_files(RLIM_INFINITY);
  REQUIRE(await_end(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.attempts, 0);
  CHECK(has_result(&service, id, &expected));
  /* Cancelled while it waits. */
  limit_files(8 << 20);
  id = submit(&service, &request);
  REQUIRE(await_phase(&service, id, MO_PHASE_WAIT, &live));
  begin = now_s();
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_OK);
  CHECK(await_phase(&service, id, MO_PHASE_IDLE, &live));
  CHECK(now_s() - begin < 1);
  /* Stopped while it waits: at once, without its last steps, which come again. */
  id = submit(&service, &request);
  REQUIRE(await_phase(&service, id, MO_PHASE_WAIT, &live));
  begin = now_s();
  CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_ERR_BUSY);
  CHECK(now_s() - begin < 2);
  mo_jobs_get_stats(service.jobs, &stats);
  CHECK_INT(stats.active_trainings, 0);
  service_close(&service);
  limit_files(RLIM_INFINITY);
  REQUIRE(service_open(&service) == MO_OK);
  REQUIRE(await_end(service.jobs, id, 30000, &job) == MO_OK);
  CHECK(has_result(&service, id, &expected));
  service_end(&service);
}

/* Want of memory is no fault of a training: it waits, as often as it takes, can be paused and
 * cancelled meanwhile, and loses nothing. */
static void waits_for_memory(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_live live;
  struct mo_job job;
  double begin;
  int64_t id, waiting[MO_WAITING_MAX] = {0};
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_fails = 1000;
  fake_plan.gradient_status = MO_ERR_NO_MEMORY;
  id = submit(&service, &request);
  for (int fails = 1000; fails > 995;
       fails = fake_plan.gradient_fails) { /* more often than there are attempts */
    REQUIRE(await_phase(&service, id, MO_PHASE_WAIT, &live));
    usleep(10000);
  }
  REQUIRE(await_phase(&service, id, MO_PHASE_WAIT, &live));
  CHECK(strstr(live.reason, "no memory") != NULL && strstr(live.reason, "by itself") != NULL);
  CHECK_INT(mo_jobs_waiting(service.jobs, waiting), 1);
  CHECK_INT(waiting[0], id);
  CHECK_INT(warnings, 1);
  CHECK_INT(mo_jobs_pause(service.jobs, id), MO_OK);
  CHECK(await_phase(&service, id, MO_PHASE_IDLE, &live));
  CHECK_INT(state_of(&service, id), MO_JOB_PAUSED);
  fake_plan.gradient_fails = 0;
  CHECK_INT(mo_jobs_resume(service.jobs, id), MO_OK);
  REQUIRE(await_end(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.attempts, 0);
  CHECK(has_result(&service, id, &expected));
  fake_plan.gradient_fails = 1000;
  id = submit(&service, &request);
  REQUIRE(await_phase(&service, id, MO_PHASE_WAIT, &live));
  begin = now_s();
  CHECK_INT(mo_jobs_cancel(service.jobs, id), MO_OK);
  CHECK(await_phase(&service, id, MO_PHASE_IDLE, &live));
  CHECK(now_s() - begin < 5);
  /* Stopped: the next start goes on. */
  id = submit(&service, &request);
  REQUIRE(await_phase(&service, id, MO_PHASE_WAIT, &live));
  CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_OK);
  service_close(&service);
  fake_plan.gradient_fails = 0;
  REQUIRE(service_open(&service) == MO_OK);
  REQUIRE(await_end(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.attempts, 0);
  CHECK(has_result(&service, id, &expected));
  service_end(&service);
}

static void waits_for_descriptors(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_live live;
  struct rlimit before, none;
  struct mo_job job;
  int64_t id;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_delay_us = 20000;
  id = submit(&service, &request);
  REQUIRE(await_step(&service, id, 1));
  REQUIRE(getrlimit(RLIMIT_NOFILE, &before) == 0);
  none = before;
  none.rlim_cur = 3;
  REQUIRE(setrlimit(RLIMIT_NOFILE, &none) == 0);
  CHECK(await_phase(&service, id, MO_PHASE_WAIT, &live));
  CHECK(strstr(live.reason, "file descriptor") != NULL && strstr(live.reason, "by itself") != NULL);
  usleep(500000); /* it has tried again */
  CHECK_INT(state_of(&service, id), MO_JOB_RUNNING);
  REQUIRE(setrlimit(RLIMIT_NOFILE, &before) == 0);
  REQUIRE(await_end(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.attempts, 0);
  CHECK(has_result(&service, id, &expected));
  service_end(&service);
}

__attribute__((unused)) static void tries_three_times(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_job job;
  int64_t id;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_fails = 1;
  fake_plan.gradient_status = MO_ERR_IO;
  id = submit(&service, &request);
  REQUIRE(await_end(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.attempts, 0); /* one, forgiven by the checkpoint that came after it */
  CHECK_INT(job.error, MO_OK);
  CHECK(has_result(&service, id, &expected));
  fake_plan.gradient_fails = 1000;
  id = submit(&service, &request);
  REQUIRE(await_end(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK_INT(job.attempts, 3);
  CHECK_INT(job.error, MO_ERR_IO);
  CHECK(strstr(job.error_text, "input or output failed") != NULL);
  CHECK_INT(warnings, 4);
  CHECK_INT(idle_stats(&service).jobs_failed, 1);
  service_end(&service);
}

static int damage(struct service *service, int64_t id, uint32_t step)
{
  char path[512];
  int fd, error = -1;
  snprintf(path, sizeof(path), "%s/trainings/%lld/%u.checkpoint", service->fixture.path,
           (long long)id, step);
  fd = open(path, O_WRONLY);
  if (fd >= 0) {
    error = pwrite(fd, "damage", 6, 5000) == 6 ? 0 : -1;
    close(fd);
  }
  return error;
}

__attribute__((unused)) static void passes_over_damaged_checkpoints(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_checkpoint_row rows[5];
  struct mo_job job;
  int64_t id;
  REQUIRE(start(&service, 1) == MO_OK);
  fake_plan.gradient_delay_us = 20000;
  id = submit(&service, &request);
  /* The newest, then all of them. */
  for (int round = 1; round <= 2; round++) {
    REQUIRE(await_step(&service, id, 12));
    CHECK_INT(mo_jobs_stop(service.jobs, 5000), MO_OK);
    REQUIRE(mo_store_checkpoints(service.fixture.store, id, rows, 5) == 2);
    service_close(&service);
    for (int i = 0; i < round; i++)
      REQUIRE(damage(&service, id, rows[i].step) == 0);
    warnings = 0;
    REQUIRE(service_open(&service) == MO_OK);
    REQUIRE(await_step(&service, id, 2));
    pthread_mutex_lock(&warned_mutex);
    CHECK_INT(warnings, round);
    CHECK(strstr(warned, round == 1 ? "the one before it is taken" : "starts over") != NULL);
    pthread_mutex_unlock(&warned_mutex);
  }
  REQUIRE(await_end(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.attempts, 0);
  CHECK(has_result(&service, id, &expected));
  service_end(&service);
}

__attribute__((unused)) static void waits_for_the_database(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_live live;
  struct mo_job job;
  int64_t id;
  REQUIRE(fault_vfs_register() == SQLITE_OK);
  memset(&fault_plan, 0, sizeof(fault_plan));
  REQUIRE(start(&service, 1) == MO_OK);
  service_close(&service);
  service.vfs = "faults";
  REQUIRE(service_open(&service) == MO_OK);
  fake_plan.gradient_delay_us = 20000;
  id = submit(&service, &request);
  REQUIRE(await_step(&service, id, 2));
  for (int i = 0; i < 2; i++) {
    fault_plan.writes_left = 0;
    fault_plan.write_error = i == 0 ? SQLITE_FULL : SQLITE_BUSY;
    REQUIRE(await_phase(&service, id, MO_PHASE_WAIT, &live));
    CHECK(strstr(live.reason, i == 0 ? "no space" : "locked") != NULL);
    fault_plan.write_error = 0;
    REQUIRE(await_phase(&service, id, MO_PHASE_LEARN, &live));
  }
  REQUIRE(await_end(service.jobs, id, 30000, &job) == MO_OK);
  CHECK(has_result(&service, id, &expected));
  service_end(&service);
}

/* No memory, not even for the note that there was none: it is written when there is. */
__attribute__((unused)) static void notes_a_failure_when_it_can(void)
{
  struct service service;
  struct mo_training_request request = pretraining("");
  struct mo_sha256 expected = undisturbed();
  struct mo_live live;
  struct mo_job job;
  int64_t id;
  request.record.validate_every_steps = 0;
  REQUIRE(fault_vfs_register() == SQLITE_OK);
  memset(&fault_plan, 0, sizeof(fault_plan));
  REQUIRE(start(&service, 1) == MO_OK);
  service_close(&service);
  service.vfs = "faults";
  REQUIRE(service_open(&service) == MO_OK);
  fake_plan.gradient_delay_us = 300000;
  fake_plan.gradient_fails = 1;
  fake_plan.gradient_status = MO_ERR_NO_MEMORY;
  id = submit(&service, &request);
  REQUIRE(await_state(&service, id, MO_JOB_RUNNING, 10));
  fault_plan.writes_left = 0;
  fault_plan.write_error = SQLITE_NOMEM;
  CHECK(await_phase(&service, id, MO_PHASE_WAIT, &live));
  CHECK(strstr(live.reason, "no memory") != NULL);
  CHECK_INT(state_of(&service, id), MO_JOB_RUNNING);
  fake_plan.gradient_delay_us = 0;
  fault_plan.write_error = 0;
  REQUIRE(await_end(service.jobs, id, 30000, &job) == MO_OK);
  CHECK_INT(job.attempts, 0); /* one, forgiven by the checkpoint that came after it */
  CHECK(has_result(&service, id, &expected));
  service_end(&service);
}

static const struct check_case cases[] = {
    {"waits for room", waits_for_room},
    {"waits for memory", waits_for_memory},
    {"waits for descriptors", waits_for_descriptors},
#ifndef __SANITIZE_THREAD__ /* slow there, and nothing new about threads */
    {"tries three times", tries_three_times},
    {"passes over damaged checkpoints", passes_over_damaged_checkpoints},
    {"waits for the database", waits_for_the_database},
    {"notes a failure when it can", notes_a_failure_when_it_can},
#endif
};
CHECK_MAIN(cases)
