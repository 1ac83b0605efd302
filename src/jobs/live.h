/* live.h: state of a running job that exists only in the running process. */
#ifndef MORPHO_JOBS_LIVE_H
#define MORPHO_JOBS_LIVE_H

#include "jobs/jobs.h"

enum mo_phase {
  MO_PHASE_IDLE = 0, /* this process does not run the job */
  MO_PHASE_REPLAY,   /* training: redraws bodies of earlier steps */
  MO_PHASE_PREPARE,  /* campaign: loads or redraws the data that it needs */
  MO_PHASE_VARY,
  MO_PHASE_LEARN,
  MO_PHASE_SCORE,
  MO_PHASE_VALIDATE,
  MO_PHASE_SAVE,
  MO_PHASE_WAIT /* waits for disk space or memory */
};
/* "idle", "replaying", "preparing", "varying", "learning", "scoring", "validating", "saving",
 * "waiting" */
const char *mo_phase_name(enum mo_phase phase);

struct mo_live {
  enum mo_phase phase;
  uint32_t position;         /* training: steps applied; campaign: the current generation */
  uint32_t last;             /* training: total steps; campaign: the last generation; 0: unknown */
  uint64_t done, total;      /* training: redrawn bodies; campaign: depends on the phase: redrawn
                              * bodies, learning steps, or scored designs; evaluation: rollouts */
  double rate;               /* robots (training) or rollouts computed per second; 0: unknown */
  double seconds_left;       /* for the whole job; until the first generation of a campaign has been
                              * timed, only for drawing its bodies; < 0: unknown */
  double best_score;         /* in a campaign's newest population; ≤ 0: none */
  double busy_s;             /* worker seconds since the last start; < 0: the job has no share at
                                present */
  double worker_s, device_s; /* total; only for a job with a share, like back_end */
  enum mo_back_end back_end;
  char reason[160]; /* MO_PHASE_WAIT: the reason, and what to do; MO_PHASE_PREPARE: the campaign
                     * that is drawing the bodies for this one; for a job that computes: the workers
                     * on other machines that it waits for; else "" */
};
/* Idle if the job does not run. An evaluation that runs is in MO_PHASE_SCORE. */
void mo_jobs_live(struct mo_jobs *jobs, int64_t id, struct mo_live *live);

/* A running job of batch priority. Interactive jobs end within seconds. */
struct mo_running {
  int64_t id;
  enum mo_job_kind kind;
  double weight;
  char label[MO_LABEL_BYTES_MAX + 1];
  struct mo_live live;
};
/* Lists running jobs that are not waiting for space. Heavier jobs come first, then newer ones.
 * Returns their number, at most `limit`. Does not wait for computation or the store. */
size_t mo_jobs_running(struct mo_jobs *jobs, struct mo_running *rows, size_t limit);

/* Returns the name of the controller that a job makes: the requested name, or `made` from kind and
 * number. */
#define MO_MADE_BYTES 40
const char *mo_result_name(const struct mo_job *job, const char *asked, char made[MO_MADE_BYTES]);

#endif
