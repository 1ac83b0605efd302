/* save.h: saves the scheduler's results of many blocks and jobs in one transaction. */
#ifndef MORPHO_STORE_SAVE_H
#define MORPHO_STORE_SAVE_H

#include <morpho/measure.h>

#include "store/records.h"

struct mo_store;

/* The conditions of a loss, except for the genotype: a row of `conditions`. */
struct mo_condition {
  int64_t id, controller, physics, fingerprint; /* id: set by the store */
  uint32_t n;
  int64_t environments[MO_BLOCK_LANES];
};
/* The losses of one genotype, as computed by one block. */
struct mo_saved_block {
  int64_t genotype;
  struct mo_condition condition;
  double losses[MO_BLOCK_LANES];
  uint32_t diverged_steps[MO_BLOCK_LANES];
  int64_t origin;                  /* from mo_store_origin: who computed them; 0: this host */
  double (*measures)[MO_MEASURES]; /* (condition.n) all of them; NULL: not computed */
  /* The verify job that recomputed these losses, which are also stored for it; 0: none. */
  int64_t verify_job;
  uint32_t design_position;
  uint8_t places[MO_BLOCK_LANES]; /* places of the environments in the job */
};
/* A genotype with everything that its mean over a named set depends on. */
struct mo_saved_design {
  int64_t genotype, controller, physics, environment_set, fingerprint, workers;
};
struct mo_saved_trajectory {
  int64_t job;
  uint32_t design_position, environment_position;
  uint32_t frames, n_masses, n_springs;
  int32_t diverged_step;
  struct mo_recording recording;
};
enum mo_job_step {
  MO_STEP_START,    /* queued, or already running under this epoch → running under this epoch */
  MO_STEP_PROGRESS, /* counts */
  MO_STEP_SUCCEED,  /* running → succeeded, with counts */
  MO_STEP_RETRY, /* running (or queued, if its start was not written) → queued, attempts + 1; at
                    max_attempts → failed */
  MO_STEP_PARK,  /* running → queued */
  MO_STEP_HALT   /* running (or queued) → paused, with an error: no device can compute it */
};
struct mo_job_update {
  int64_t job;
  enum mo_job_step step;
  uint64_t total, done, cached, diverged, cut; /* total 0: the counts do not change */
  /* Succeed, in a race: the environments that count, as bits; NULL: all. */
  const uint64_t *counted;   /* (n_designs) */
  const uint32_t *positions; /* (n_designs) in the request */
  uint32_t n_designs, n_environments;
  int64_t started_us;           /* start */
  int64_t fingerprint, workers; /* start: the classes, as in struct mo_work */
  int error;                    /* retry */
  char error_text[256];
  uint32_t max_attempts;
  bool quiet;              /* no event */
  void *owner;             /* for the caller */
  bool applied;            /* result; false: the step could not start in the job's state */
  enum mo_job_state state; /* result, if applied: the new state */
};
struct mo_save {
  struct mo_saved_block *blocks;
  size_t n_blocks;
  struct mo_saved_trajectory *trajectories;
  size_t n_trajectories;
  struct mo_saved_design *designs;
  size_t n_designs;
  struct mo_job_update *updates; /* in order */
  size_t n_updates;
  void (*done)(struct mo_save *save,
               int status); /* on the writer's thread, after the commit or its failure */
  void *context;
  struct mo_store *store; /* set by mo_store_save */
};
/* Queues a save, which is stored completely or not at all. `save` and everything it points to must
 * stay valid until `done`. MO_ERR_NO_MEMORY: not queued. */
int mo_store_save(struct mo_store *store, struct mo_save *save);

#endif
