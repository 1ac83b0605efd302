/* admission.c: counts the open jobs (queued, running, paused) and their rollouts, and enforces the
 * limits. */
#include "base/thread.h"
#include "jobs/submission.h"

uint64_t mo_job_admitted(const struct mo_job *job)
{
  return job->rollouts_total / mo_ladder_runs(job->n_displaced, job->tolerance) *
         mo_ladder_cost(job->n_displaced, job->tolerance);
}

int mo_jobs_admit(struct mo_jobs *jobs, uint32_t n_jobs, uint64_t rollouts,
                  struct mo_message *message)
{
  const uint64_t most = jobs->config.max_open_jobs;
  int error = MO_OK;
  MO_GUARD(&jobs->admission_mutex);
  if (jobs->open_jobs + n_jobs > most)
    error =
        mo_fail(message, MO_ERR_BUSY, "%llu jobs are open, which is the limit",
                (unsigned long long)(jobs->open_jobs > most ? (uint64_t)jobs->open_jobs : most));
  else if (jobs->open_rollouts > 0 &&
           jobs->open_rollouts + rollouts > jobs->config.max_open_rollouts)
    error = mo_fail(message, MO_ERR_BUSY,
                    "%llu rollouts are waiting; %llu more would exceed the limit of %llu",
                    (unsigned long long)jobs->open_rollouts, (unsigned long long)rollouts,
                    (unsigned long long)jobs->config.max_open_rollouts);
  if (error == MO_OK) {
    jobs->open_jobs += n_jobs;
    jobs->open_rollouts += rollouts;
  }
  return error;
}

void mo_jobs_closed(struct mo_jobs *jobs, uint32_t n_jobs, uint64_t rollouts)
{
  MO_GUARD(&jobs->admission_mutex);
  jobs->open_jobs -= n_jobs < jobs->open_jobs ? n_jobs : jobs->open_jobs;
  jobs->open_rollouts -= rollouts < jobs->open_rollouts ? rollouts : jobs->open_rollouts;
}

int mo_jobs_recount(struct mo_jobs *jobs)
{
  uint64_t open_jobs = 0, open_rollouts = 0;
  int error = mo_store_open_work(jobs->store, &open_jobs, &open_rollouts);
  if (error != MO_OK)
    return error;
  MO_GUARD(&jobs->admission_mutex);
  jobs->open_jobs = open_jobs;
  jobs->open_rollouts = open_rollouts;
  return MO_OK;
}
