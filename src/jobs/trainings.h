/* trainings.h: trainings as jobs: accepted, run one step after the other on the compute back end,
 * saved, resumed.
 *
 * Each running training has a thread of its own, which sleeps while the back end works: it draws
 * the robots of a step, waits for their gradient, applies it, tells of it, validates and saves
 * checkpoints when they are due. One training runs at a time by default (max_active); the others
 * wait in the order in which they came. Pausing, stopping and ending write a checkpoint first.
 * After a crash a training goes on from its newest checkpoint and ends with the same weights, bit
 * for bit.
 *
 * A full disk: the training waits (paused, with its reason in `live`) and goes on by itself when
 * there is room. */
#ifndef MORPHO_JOBS_TRAININGS_H
#define MORPHO_JOBS_TRAININGS_H

#include "jobs/jobs.h"
#include "store/trainings.h"

struct mo_training_request {
  struct mo_training_record
      record;         /* settings checked here; parent fields are filled in by the store */
  const char *parent; /* as in mo_training_submission */
  const struct mo_bits *genotypes; /* (record.n_designs) as asked for: valid; placed here. Finetune
                                      without population */
  int64_t population; /* finetune: a succeeded evaluation, or a campaign: its newest population; 0:
                         genotypes */
  uint32_t population_best;    /* 0: all of them */
  int priority;                /* MO_BATCH */
  int back_end;                /* enum mo_back_end or MO_BACK_END_AUTO */
  double weight;               /* as in mo_evaluation_request */
  const char *label;           /* nullable */
  const char *idempotency_key; /* nullable */
  struct mo_sha256 body_sha256;
};
/* As mo_jobs_submit_evaluation. MO_ERR_NOT_FOUND: message says whether controller or population.
 * MO_ERR_CONFLICT: the key; or the population has not succeeded (message says which).
 * MO_ERR_UNSUPPORTED: the controller is of another workspace. */
int mo_jobs_submit_training(struct mo_jobs *jobs, const struct mo_training_request *request,
                            int64_t *id, bool *replayed, struct mo_message *message);

/* mo_jobs_cancel, mo_jobs_pause, mo_jobs_resume and mo_jobs_wait work on trainings, too. */

/* What only the running process knows. */
enum mo_training_phase {
  MO_TRAINING_IDLE = 0, /* not running here */
  MO_TRAINING_REPLAY,   /* draws the bodies of earlier steps again */
  MO_TRAINING_LEARN,
  MO_TRAINING_VALIDATE,
  MO_TRAINING_SAVE,
  MO_TRAINING_WAIT /* for room on the disk */
};
const char *
mo_training_phase_name(enum mo_training_phase phase); /* "idle", "replaying", "learning",
                                                         "validating", "saving", "waiting" */
struct mo_training_live {
  enum mo_training_phase phase;
  uint32_t step;       /* applied */
  double robots_per_s; /* over the last steps; 0: not known yet */
  double seconds_left; /* estimate; < 0: not known yet */
  double busy_s; /* worker seconds that it has had since it was last started; < 0: it has no share
                    now */
  uint64_t replayed, replay_total;
  char reason[160]; /* MO_TRAINING_WAIT: why, and what to do */
};
int mo_jobs_training_live(struct mo_jobs *jobs, int64_t id,
                          struct mo_training_live *live); /* idle if it does not run */

/* What trained controllers say of the code that made them ("morphod.version"): as given in the
 * configuration, with the fingerprint of the gradients. Lives as long as `jobs`. */
const char *mo_jobs_code_version(const struct mo_jobs *jobs, enum mo_back_end back_end);

/* What validation scores: every design in every environment, with the settings' physics, in
 * float32. A pretraining: bodies of the held-out stream of its seed; a finetuning: the first of its
 * designs, which it learns on, too, but in other environments. Both arrays belong to the caller
 * (malloc). MO_ERR_NOT_FOUND, MO_ERR_NO_MEMORY. */
struct mo_held_out {
  struct mo_bits *genotypes; /* (n_designs) placed */
  uint32_t n_designs;
  struct mo_environment *environments; /* (n_environments) */
  uint32_t n_environments;
};
int mo_jobs_training_held_out(struct mo_jobs *jobs, int64_t id, struct mo_held_out *held_out);
void mo_held_out_free(struct mo_held_out *held_out); /* what it holds; NULL-safe */

#endif
