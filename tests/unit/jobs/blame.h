/* blame.h: a process that dies on the own thread of a job that learns, again and again: the job is
 * blamed, and parked. */
#ifndef MORPHO_TESTS_JOBS_BLAME_H
#define MORPHO_TESTS_JOBS_BLAME_H

#include <fcntl.h>
#include <signal.h>
#include <sys/wait.h>

#include "watch.h"

static int crash_fd;

static inline void on_fault(int number)
{
  mo_jobs_crash_note(crash_fd, number);
  _exit(99);
}

/* `service` is closed; `submit` submits the job. */
static inline void check_blame(struct service *service, int64_t (*submit)(struct service *service))
{
  struct mo_job job = {.id = 0};
  char marker[512];
  int64_t id;
  int status;
  snprintf(marker, sizeof(marker), "%s/crash", service->fixture.path);
  service->config.crash_marker = marker;
  fake_plan.gradient_delay_us = 60000000;
  REQUIRE(service_open(service) == MO_OK);
  id = submit(service);
  for (int round = 1; round <= 3; round++) {
    pid_t child;
    service_close(service);
    child = fork();
    REQUIRE(child >= 0);
    if (child == 0) {
      crash_fd = open(marker, O_WRONLY | O_CREAT | O_APPEND, 0600);
      signal(SIGSEGV, on_fault);
      fake_plan.gradient_delay_us = 0;
      fake_plan.gradient_crash = true;
      if (service_open(service) == MO_OK)
        sleep(20);
      _exit(0);
    }
    REQUIRE(waitpid(child, &status, 0) == child);
    CHECK(WIFEXITED(status) && WEXITSTATUS(status) == 99);
    REQUIRE(service_open(service) == MO_OK);
    REQUIRE(mo_store_job(service->fixture.store, id, &job) == MO_OK);
    CHECK_INT(job.attempts, round);
  }
  CHECK_INT(job.state, MO_JOB_FAILED);
  CHECK(strstr(job.error_text, "signal 11") != NULL);
  service_end(service);
}

#endif
