/* runner.h: kinds of jobs, the threads that run them, requests to them, and the common parts of all
 * attempts. */
#ifndef MORPHO_JOBS_RUNNER_H
#define MORPHO_JOBS_RUNNER_H

#include <pthread.h>
#include <stdatomic.h>

#include "jobs/live.h"

struct mo_need;
struct mo_runner;

/* A kind of jobs, as a table of functions. A kind either has several threads, each of which runs
 * one job after another, or one thread that serves all its jobs at once (`serve`; evaluations). A
 * new kind is one file with its table, and a row in mo_kinds (jobs.c). */
struct mo_kind {
  enum mo_job_kind kind;
  /* Create and free the kind's data while the service runs; nullable. */
  int (*open)(struct mo_jobs *jobs);
  void (*close)(struct mo_jobs *jobs);
  /* The thread's function if one thread serves all jobs; context: its struct mo_runner. The fields
   * below are then unused. */
  void *(*serve)(void *runner);

  /* Estimates the memory of a job. An error leaves `need` unchanged (zeros); unless it is a
   * shortage, the run will report it. */
  int (*need)(struct mo_jobs *jobs, int64_t id, struct mo_need *need);
  enum mo_phase first; /* the phase of a job that has just started */
  /* Runs a started job to its end or until a request. `run` has run_bytes bytes, zero at first. */
  size_t run_bytes;
  int (*run)(struct mo_runner *runner, void *run);
  int (*save)(void *run);      /* saves computed results of a run that has stopped */
  void (*clean_up)(void *run); /* frees everything that `run` points to */
};
extern const struct mo_kind mo_evaluation_kind, mo_training_kind, mo_campaign_kind, mo_atlas_kind,
    mo_certificate_kind;
extern const struct mo_kind *const mo_kinds[MO_JOB_KINDS];

/* A request to a running job; the larger value wins. */
enum mo_job_request { MO_REQUEST_NONE = 0, MO_REQUEST_PAUSE, MO_REQUEST_STOP, MO_REQUEST_CANCEL };

/* A thread that runs one job after another, and its attempt at the current one. */
struct mo_runner {
  struct mo_jobs *jobs;
  struct mo_runners *runners;
  pthread_t thread;
  bool has_thread;
  /* Under the mutex of the runners. */
  int64_t id; /* 0: no job */
  enum mo_job_request request;
  bool waits; /* for disk space or memory */
  struct mo_live live;
  /* Shared with the back end. */
  volatile int interrupt;     /* set by every request */
  volatile uint64_t replayed; /* for a training run: bodies redrawn so far */
  /* For this thread only. */
  bool winding_down; /* a request arrived or the job failed: only computed results are saved */
  bool is_short;     /* memory is short: results that cannot be saved at once are recomputed
                        later */
  bool gives_up;     /* this attempt is the last one */
  int error;
  char text[256];        /* of the error */
  const char *busy_text; /* why a write has to wait; NULL: another program locked the database */
  struct mo_compute_share *share; /* of the job, while it runs */
};

/* All threads for one kind of job. */
struct mo_runners {
  const struct mo_kind *kind;
  pthread_mutex_t mutex;
  pthread_cond_t news;      /* requests, queued jobs, ends of threads */
  struct mo_runner *runner; /* (n) */
  uint32_t n;
  uint32_t alive;    /* running threads */
  uint64_t look;     /* incremented when there may be queued jobs, and at a stop */
  uint64_t requests; /* incremented with every request */
  bool stopping;
  atomic_bool unsaved; /* a stopped job could not be saved */
  atomic_uint_fast64_t active;
};

/* Returns whether the cause of an error can disappear without a request. */
static inline bool mo_is_shortage(int error)
{
  return error == MO_ERR_NO_MEMORY || error == MO_ERR_NO_SPACE || error == MO_ERR_BUSY;
}

/* ---- runner.c: requests ---- */
void mo_runners_wake(struct mo_runners *runners);
/* Passes a request to the runner of the job, if one runs it; the job's new state is already stored.
 * A thread that serves all jobs rereads their states. */
void mo_runners_request(struct mo_runners *runners, int64_t id, enum mo_job_request request);
/* Returns the runner of a job, or NULL; under the mutex. */
struct mo_runner *mo_runners_find(struct mo_runners *runners, int64_t id);
void mo_runner_put_request(struct mo_runner *runner, enum mo_job_request request); /* same, for the
                                                                                    * phase */
enum mo_job_request mo_runner_requested(struct mo_runner *runner);
bool mo_runner_is_interrupted(const struct mo_runner *runner);
/* Sets the phase that the live figures show. Returns the previous one. */
enum mo_phase mo_runner_enter(struct mo_runner *runner, enum mo_phase phase);
/* Shows whether the job waits, with the reason. Returns the previous phase. */
enum mo_phase mo_runner_set_waiting(struct mo_runner *runner, bool waits, enum mo_phase phase,
                                    const char *reason);
/* Sleeps until the time is over or a request of at least `least` has arrived. */
void mo_runner_sleep(struct mo_runner *runner, uint32_t ms, enum mo_job_request least);

/* Formats a number for an event; "null" if it is not finite. MO_FIGURE: as an argument for "%s". */
const char *mo_figure(double value, char text[32]);
#define MO_FIGURE(value) mo_figure((value), (char[32]){0})

/* ---- runner.c: attempts ---- */
/* Returns whether a checkpoint of learning is due. since_us: time of the last checkpoint, or of the
 * start; every_s: from the job's settings, 0: never by time. A job that counts attempts saves its
 * first checkpoint early, so that a healthy job makes progress no matter how often the process is
 * killed. */
bool mo_checkpoint_is_due(const struct mo_job *job, int64_t since_us, uint32_t every_s);
/* Stores the text for an error, and returns the error. */
int mo_runner_fail(struct mo_runner *runner, int error, const char *text);
/* Same, for a job that the store could not read. */
int mo_runner_fail_unreadable(struct mo_runner *runner, int error);
/* Same, for a job that fails now, because further attempts would end the same way. */
int mo_runner_give_up(struct mo_runner *runner, int error, const char *text);
/* Loads a controller's file. If it is unusable, stores the text of the error. */
int mo_runner_load(struct mo_runner *runner, const struct mo_sha256 *sha256,
                   struct mo_controller **controller);
void mo_runner_warn(const struct mo_runner *runner, int error, const char *text);
/* Repeats `write` until it succeeds or fails permanently: waits for disk space, memory or
 * descriptors, and reports that `what` cannot be written. MO_ERR_CANCELLED: a request arrived
 * first. */
int mo_runner_persist(struct mo_runner *runner, int (*write)(void *context), void *context,
                      const char *what);
/* Ends an attempt with `error`; `run` is passed to the kind's `save`. MO_ERR_CANCELLED: a request
 * arrived. MO_ERR_NO_MEMORY: the runner waits, then repeats the attempt. Returns whether the
 * attempt failed. */
bool mo_runner_end_attempt(struct mo_runner *runner, int error, void *run);

/* ---- runners.c ---- */
int mo_runners_start(struct mo_jobs *jobs, struct mo_runners *runners, uint32_t n);
void mo_runners_stop(struct mo_runners *runners); /* requests a stop without waiting */
/* Waits until a given time for all threads to end. Returns whether they have ended. */
bool mo_runners_wait(struct mo_runners *runners, int64_t until_us);
void mo_runners_free(struct mo_runners *runners); /* waits for the stopped threads, frees */

#endif
