/* memory.h: the memory that jobs with their own thread need while they run. */
#ifndef MORPHO_JOBS_MEMORY_H
#define MORPHO_JOBS_MEMORY_H

#include <pthread.h>

#include "jobs/runner.h"

struct mo_physics;

/* Measured, and rounded up. */
#define MO_DESIGN_BYTES ((uint64_t)24 << 10) /* the largest body of the default workspace */
#define MO_ROBOT_BYTES  ((uint64_t)1 << 10)  /* environment and outcome of a robot in a batch */

/* In bytes. */
struct mo_need {
  uint64_t own;
  uint64_t shared, shared_key; /* excluded bodies: one set for all jobs with the same key */
  uint64_t scratch; /* of the workers, for gradients: one for all jobs, as large as the largest
                       need */
};

struct mo_memory_user {
  int64_t id;
  const struct mo_kind *kind;
  struct mo_need need;
  bool is_proven;     /* it has saved something since it was admitted */
  uint32_t overtaken; /* later jobs that were admitted first */
  char reason[160];   /* why the job waits */
  struct mo_memory_user *next;
};

struct mo_memory {
  pthread_mutex_t mutex;
  struct mo_memory_user *users, *waiting; /* waiting: in order of arrival */
  /* Jobs that may have killed the process: jobs start one at a time until this many are proven or
   * have ended. */
  uint32_t n_suspects;
  uint32_t n_workers;
  uint64_t tape_bytes; /* limit of one worker's tape */
};

/* Initializes the accounting and limits the memory that the back end uses for gradients. */
void mo_memory_init(struct mo_jobs *jobs);
void mo_memory_free(struct mo_jobs *jobs);
/* Adds the memory that learning in batches takes, for any kind of job. */
void mo_memory_add_learning(const struct mo_jobs *jobs, uint32_t batch,
                            const struct mo_physics *physics, enum mo_back_end back_end,
                            struct mo_need *need);
/* MO_ERR_LIMIT: the job would not fit in memory even if it ran alone. */
int mo_memory_check(const struct mo_jobs *jobs, const struct mo_need *need,
                    struct mo_message *message);
/* Admits a queued job. Returns true if the caller should run the job and return its memory later,
 * or false if the job must wait or another thread has it. */
bool mo_memory_take(struct mo_jobs *jobs, const struct mo_kind *kind, int64_t id);
/* Returns the memory of a job, once the run has freed everything. */
void mo_memory_give(struct mo_jobs *jobs, int64_t id);
/* Forgets a waiting job that may no longer be queued. */
void mo_memory_forget(struct mo_jobs *jobs, int64_t id);
/* Forgets the waiting jobs of the kind that are not in `ids`, the list of queued jobs. */
void mo_memory_keep(struct mo_jobs *jobs, const struct mo_kind *kind, const int64_t *ids,
                    int64_t n);
/* Recomputes a job's need after a change to its settings. */
void mo_memory_renew(struct mo_jobs *jobs, enum mo_job_kind kind, int64_t id);
/* Records that a job has saved something. */
void mo_memory_prove(struct mo_jobs *jobs, int64_t id);
/* Stores why a job waits. Returns false if the job does not wait. */
bool mo_memory_reason(struct mo_jobs *jobs, int64_t id, char reason[160]);

#endif
