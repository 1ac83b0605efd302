/* wait.h: waits for the end of a job. */
#ifndef MORPHO_TESTS_JOBS_WAIT_H
#define MORPHO_TESTS_JOBS_WAIT_H

#include <unistd.h>

#include "base/clock.h"
#include "jobs/state.h"

/* Waits until the job is final or `timeout_ms` has passed, and fills *job with its last state. */
static inline int await_end(struct mo_jobs *jobs, int64_t id, uint32_t timeout_ms,
                            struct mo_job *job)
{
  const int64_t end_us = mo_clock_us() + (int64_t)timeout_ms * 1000;
  int error;
  while ((error = mo_store_job(jobs->store, id, job)) == MO_OK &&
         !mo_job_state_is_final(job->state) && mo_clock_us() < end_us)
    usleep(500);
  return error;
}

#endif
