/* training_run.h: the state of a running training job, and the parts that training one controller
 * and training each design separately have in common. */
#ifndef MORPHO_JOBS_TRAINING_RUN_H
#define MORPHO_JOBS_TRAINING_RUN_H

#include "jobs/held_out.h"
#include "jobs/learner.h"
#include "store/training_bodies.h"

#define MO_TRAINING_ROWS  256
#define MO_TRAINING_RATES 16 /* steps over which the speed is averaged */

struct mo_training_run {
  struct mo_runner *runner;
  struct mo_jobs *jobs;
  int64_t id;
  struct mo_training_status status; /* from the time of the claim */
  struct mo_learner learner;
  struct mo_held_out held_out; /* if each design is trained separately: all designs */
  struct mo_training_step_row rows[MO_TRAINING_ROWS]; /* not written yet */
  size_t n_rows;
  int64_t rows_us, checkpoint_us; /* times of the last writes */
  uint32_t checkpoint_step;       /* of the newest usable checkpoint, like run_step; 0: none */
  int64_t validated;              /* newest validated step; −1: none */
  struct {
    double seconds;
    int64_t end_us;
  } rates[MO_TRAINING_RATES];
  uint64_t n_rates;
  bool code_noted; /* the lineage contains the code of this run, for the back end `noted` */
  enum mo_back_end noted;
  /* If each design is trained separately: the controller that every design starts from; the one
   * that is learning now, and the code that computed its steps. */
  struct mo_controller *parent;
  struct mo_training_body body;
  struct mo_training_lineage body_code;
};

/* ---- training_run.c ---- */

/* Returns the steps that the current controller has learned. */
uint32_t mo_training_run_step(const struct mo_training_run *run);
/* Returns the steps of the designs before the current one. */
uint32_t mo_training_run_before(const struct mo_training_run *run);
enum mo_phase mo_training_run_enter(struct mo_training_run *run, enum mo_phase phase);
/* Writes the rows of steps. */
int mo_training_run_flush(struct mo_training_run *run);
/* Writes the rows, then a checkpoint, so that the curve has no gaps before a checkpoint. */
int mo_training_run_save(struct mo_training_run *run);
/* Makes learner.training: from the newest undamaged checkpoint, or from the beginning. */
int mo_training_run_begin(struct mo_training_run *run);

/* ---- training_submit.c ---- */

/* Estimates the memory of a training run. */
struct mo_need mo_training_need(const struct mo_jobs *jobs, const struct mo_training_record *record,
                                enum mo_back_end back_end);

/* ---- training_each.c ---- */

/* Loads what all designs share, and finds the first one that has not learned. */
int mo_each_prepare(struct mo_training_run *run);
/* Begins the current design: makes learner.training, and scores the design with the parent. */
int mo_each_begin(struct mo_training_run *run);
/* Adds the code of a step to the lineage of the current controller, before the step is applied. */
void mo_each_note_code(struct mo_training_run *run, const char *fingerprint);
/* Scores the design, stores it, and moves on to the next one. */
int mo_each_end(struct mo_training_run *run);

#endif
