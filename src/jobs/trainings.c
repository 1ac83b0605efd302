/* trainings.c: live figures of trainings. */
#include "jobs/trainings.h"

#include "jobs/internal.h"

const char *mo_training_phase_name(enum mo_training_phase phase)
{
  static const char *const names[] = {"idle",       "replaying", "learning",
                                      "validating", "saving",    "waiting"};
  return (unsigned)phase < sizeof(names) / sizeof(names[0]) ? names[phase] : "unknown";
}

int mo_jobs_training_live(struct mo_jobs *jobs, int64_t id, struct mo_training_live *live)
{
  struct mo_runner *runner;
  double busy_s = mo_jobs_busy_s(jobs, id);
  *live = (struct mo_training_live){.phase = MO_TRAINING_IDLE, .seconds_left = -1};
  pthread_mutex_lock(&jobs->trainings.mutex);
  runner = mo_runners_find(&jobs->trainings, id);
  if (runner != NULL) {
    *live = runner->live.training;
    live->replayed = __atomic_load_n(&runner->replayed, __ATOMIC_RELAXED);
  }
  pthread_mutex_unlock(&jobs->trainings.mutex);
  if (runner == NULL && mo_memory_reason(jobs, id, live->reason))
    live->phase = MO_TRAINING_WAIT;
  live->busy_s = busy_s;
  return MO_OK;
}

const char *mo_jobs_code_version(const struct mo_jobs *jobs, enum mo_back_end back_end)
{
  return jobs->code_versions[back_end];
}
