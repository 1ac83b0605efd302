/* state.h: shared by all files of this room: the service's state, and small parts of it without
 * their own header. */
#ifndef MORPHO_JOBS_STATE_H
#define MORPHO_JOBS_STATE_H

#include <stdio.h>

#include "jobs/controllers.h"
#include "jobs/memory.h"
#include "jobs/runner.h"
#include "store/runner.h"

/* A running job's share of the back end. */
struct mo_job_share {
  int64_t id;
  enum mo_job_kind kind;
  struct mo_compute_share *share;
  bool is_batch;
  double weight;
  enum mo_back_end back_end;
  double before_s, before_device_s; /* seconds used by earlier attempts */
  char label[MO_LABEL_BYTES_MAX + 1];
  struct mo_live live; /* of an evaluation, as last shown; other kinds: idle */
  struct mo_job_share *next;
};

struct mo_jobs {
  struct mo_store *store;
  struct mo_compute *compute;
  struct mo_jobs_config config;
  struct mo_lattice *lattice;
  /* classes.device and code_versions[MO_ON_DEVICE] are set when devices are served: see
   * back_end.c. */
  struct mo_classes classes;
  char *code_versions[2];               /* by back end */
  pthread_mutex_t class_mutex;          /* held while the class of devices is set */
  struct mo_device_memory known_device; /* the class of an earlier process; "": none */
  struct mo_runners runners[MO_JOB_KINDS];
  struct mo_memory memory;

  pthread_mutex_t admission_mutex; /* guards open_jobs and open_rollouts */

  /* Shares. */
  pthread_mutex_t weigh_mutex; /* taken before shares_mutex, so that reading a weight from the store
                                  and setting it is one operation */
  pthread_mutex_t shares_mutex; /* held briefly */
  struct mo_job_share *shares;
  double ended_s[MO_JOB_KINDS];        /* worker seconds of closed shares */
  double ended_device_s[MO_JOB_KINDS]; /* device seconds of closed shares */

  struct mo_evaluations *evaluations; /* evaluation.h */
  struct mo_controller_cache controllers;
  pthread_mutex_t exclusions_mutex;
  struct mo_exclusion *exclusions; /* bodies of pretraining runs, shared by campaigns */

  /* Statistics. */
#define MO_JOBS_COUNT(name) atomic_uint_fast64_t name;
  MO_JOBS_COUNTS(MO_JOBS_COUNT)
#undef MO_JOBS_COUNT
  atomic_uint_fast64_t training_ns;
  atomic_int_fast64_t heartbeat_us;
  atomic_bool no_space, is_stopping;
  atomic_bool abandon; /* stop waiting for failing saves */
};

/* ---- shares.c ---- */
/* Opens a share for a job that starts. The share follows the job's weight until it is closed. Set
 * it in every block and batch of the job. MO_ERR_NO_MEMORY, and errors of reading the job. */
int mo_share_open(struct mo_jobs *jobs, int64_t id, enum mo_job_kind kind,
                  struct mo_compute_share **share);
/* Closes the job's share, if any. None of its blocks may be queued or in flight. */
void mo_share_close(struct mo_jobs *jobs, int64_t id);
int mo_share_reweigh(struct mo_jobs *jobs, int64_t id); /* applies the weight in the store */
/* Shows the progress of an evaluation. */
void mo_share_show(struct mo_jobs *jobs, int64_t id, const struct mo_live *live);
/* Reads the values in the job's share: busy_s, and the other figures of an evaluation. */
void mo_share_live(struct mo_jobs *jobs, int64_t id, struct mo_live *live);
/* A meter for the store (mo_store_meter); context: struct mo_jobs. */
bool mo_share_used(void *context, int64_t id, double *worker_s, double *device_s);
/* Lists the batch jobs that have a share, as mo_jobs_running does, without their live figures. */
size_t mo_shares_heaviest(struct mo_jobs *jobs, struct mo_running *rows, size_t limit);
void mo_shares_seconds(struct mo_jobs *jobs, double worker_s[MO_JOB_KINDS],
                       double device_s[MO_JOB_KINDS]);

/* ---- back_end.c ---- */
/* Chooses the back end if the request does not specify it. unsuited: why devices cannot compute the
 * job, and what to do; NULL: they can. is_large: devices are worthwhile. MO_ERR_DEVICE. */
int mo_back_end_choose(struct mo_jobs *jobs, struct mo_submission *request, const char *unsuited,
                       bool is_large, struct mo_message *message);
/* Returns why devices cannot compute these environments, and what to do; NULL: they can, as they
 * can with the named sets. environments: NULL for a set. */
const char *mo_back_end_unsuited(const struct mo_environment *environments, uint32_t n);
/* MO_ERR_DEVICE: the job needs devices, none works, and no worker with devices has joined. Check
 * this before a job starts, because redrawing its bodies can take minutes. */
int mo_back_end_check(struct mo_jobs *jobs, enum mo_back_end back_end);
/* Returns the urgency of a job's blocks and gradients. Workers on other machines get only batch
 * urgency, so there is no other urgency on devices that only they have. */
enum mo_urgency mo_back_end_urgency(const struct mo_jobs *jobs, const struct mo_job *job);
/* Sets the classes of this process, in the store and for lineages. */
int mo_back_end_prepare(struct mo_jobs *jobs);
/* Shows that a running job is waiting for workers on other machines. "": it is not waiting. */
void mo_back_end_describe_wait(const struct mo_jobs *jobs, enum mo_back_end back_end, char *text,
                               size_t size);
/* Maps an error of a block or gradient to the error of its job. A lack of device memory pauses the
 * job, as a lost device does, because it may last. */
int mo_back_end_error(enum mo_back_end back_end, int error);
/* Describes why a job on devices is paused (lost devices or lack of memory), and what to do. */
void mo_back_end_describe_loss(struct mo_jobs *jobs, char *text, size_t size);
/* Returns the row of the fingerprint that float32 scores are stored under. */
int64_t mo_back_end_fingerprint(const struct mo_jobs *jobs, enum mo_back_end back_end);
/* Returns how many blocks one job keeps submitted. */
uint32_t mo_back_end_window(const struct mo_jobs *jobs, enum mo_back_end back_end);

#endif
