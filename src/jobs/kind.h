/* kind.h: the kinds of jobs: one table of functions per kind.
 *
 * A kind either has threads of its own, each of which runs one job after the other (runners.c), or
 * one thread that serves all its jobs at once (`serve`; evaluations). A new kind is one file with
 * its table, and a row in mo_kinds (jobs.c). */
#ifndef MORPHO_JOBS_KIND_H
#define MORPHO_JOBS_KIND_H

#include "jobs/live.h"

struct mo_runner;
struct mo_need;

struct mo_kind {
  enum mo_job_kind kind;
  /* Returns how many threads the configuration gives the kind. */
  uint32_t (*threads)(const struct mo_jobs_config *config);
  /* Creates and frees what the kind keeps while the service runs; nullable. */
  int (*open)(struct mo_jobs *jobs);
  void (*close)(struct mo_jobs *jobs);
  /* The thread's function if one thread serves all jobs; context: its struct mo_runner. The fields
   * below are then unused. */
  void *(*serve)(void *runner);

  /* Estimates the memory of a job, 0 for an unreadable one: its run will report the error. Returns
   * an error only for a shortage that passes. */
  int (*need)(struct mo_jobs *jobs, int64_t id, struct mo_need *need);
  enum mo_phase first; /* the phase of a job that has just started */
  /* Runs a started job to its end or until a request. `run` has run_bytes bytes, zero at first. */
  size_t run_bytes;
  int (*run)(struct mo_runner *runner, void *run);
  int (*save)(void *run);      /* saves computed results of a run that has stopped */
  void (*clean_up)(void *run); /* frees what `run` points to */
};
extern const struct mo_kind mo_evaluation_kind, mo_training_kind, mo_campaign_kind;
extern const struct mo_kind *const mo_kinds[MO_JOB_KINDS];

#endif
