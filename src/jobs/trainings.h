/* trainings.h: trainings as jobs: submission, steps on the compute back end, saving, resumption.
 *
 * Each running training has its own thread, which sleeps while the back end works. The thread draws
 * the robots of a step, waits for their gradient, applies and reports the gradient, and validates
 * and saves checkpoints when they are due. By default one training runs at a time
 * (max_active_trainings); the others wait in the order of their submission. A training that is
 * paused or stopped, or that ends, writes a checkpoint first. After a crash a training continues
 * from its newest checkpoint and ends with the same weights, bit for bit.
 *
 * When the disk is full, or memory or descriptors run out, the training waits (shown as paused,
 * with a reason in mo_training_live) and continues without a request. */
#ifndef MORPHO_JOBS_TRAININGS_H
#define MORPHO_JOBS_TRAININGS_H

#include "jobs/jobs.h"
#include "store/trainings.h"

struct mo_training_request {
  struct mo_training_record
      record;         /* settings checked here; parent fields are filled in by the store */
  const char *parent; /* as in mo_training_submission */
  const struct mo_bits
      *genotypes; /* (record.n_designs) valid, not yet placed. Finetuning without a population */
  int64_t population;          /* finetuning: a succeeded evaluation, or a campaign for its newest
                                  population; 0: genotypes */
  uint32_t population_best;    /* 0: all of them */
  int priority;                /* MO_BATCH */
  int back_end;                /* enum mo_back_end or MO_BACK_END_AUTO */
  double weight;               /* as in mo_evaluation_request */
  const char *label;           /* nullable */
  const char *idempotency_key; /* nullable */
  struct mo_sha256 body_sha256;
};
/* Submits a training as mo_jobs_submit_evaluation submits an evaluation; `message` has the details.
 * - MO_ERR_NOT_FOUND: no such controller or population
 * - MO_ERR_CONFLICT: the key was used with another body, or the population has not succeeded
 * - MO_ERR_UNSUPPORTED: the controller is for another workspace */
int mo_jobs_submit_training(struct mo_jobs *jobs, const struct mo_training_request *request,
                            int64_t *id, bool *replayed, struct mo_message *message);

/* mo_jobs_cancel, mo_jobs_pause, mo_jobs_resume and mo_jobs_wait work on trainings, too. */

/* State that exists only in the running process. */
enum mo_training_phase {
  MO_TRAINING_IDLE = 0, /* not running here */
  MO_TRAINING_REPLAY,   /* draws bodies of earlier steps again */
  MO_TRAINING_LEARN,
  MO_TRAINING_VALIDATE,
  MO_TRAINING_SAVE,
  MO_TRAINING_WAIT /* for disk space or memory */
};
const char *
mo_training_phase_name(enum mo_training_phase phase); /* "idle", "replaying", "learning",
                                                         "validating", "saving", "waiting" */
struct mo_training_live {
  enum mo_training_phase phase;
  uint32_t step;       /* steps applied */
  double robots_per_s; /* over the latest steps; 0: unknown */
  double seconds_left; /* estimate; < 0: unknown */
  double busy_s;       /* worker seconds since the last start; < 0: no share now */
  uint64_t replayed, replay_total;
  char reason[160]; /* MO_TRAINING_WAIT: why, and what to do */
};
int mo_jobs_training_live(struct mo_jobs *jobs, int64_t id,
                          struct mo_training_live *live); /* idle if the training does not run */

/* Returns the "morphod.version" that trained controllers record: the version in the configuration
 * with the fingerprint of the gradients. Lives as long as `jobs`. */
const char *mo_jobs_code_version(const struct mo_jobs *jobs, enum mo_back_end back_end);

/* The designs and environments of validation: every design is scored in every environment, with the
 * physics of the settings, in float32. A pretraining takes bodies of the held-out stream of its
 * seed. A finetuning takes the first of its designs, on which it also learns, but in other
 * environments. The caller frees both arrays (malloc) with mo_held_out_free. MO_ERR_NOT_FOUND,
 * MO_ERR_NO_MEMORY. */
struct mo_held_out {
  struct mo_bits *genotypes; /* (n_designs) placed */
  uint32_t n_designs;
  struct mo_environment *environments; /* (n_environments) */
  uint32_t n_environments;
};
int mo_jobs_training_held_out(struct mo_jobs *jobs, int64_t id, struct mo_held_out *held_out);
void mo_held_out_free(struct mo_held_out *held_out); /* frees the arrays; NULL-safe */

#endif
