/* learner.h: learning on the back end, for training runs and for campaigns that learn. */
#ifndef MORPHO_JOBS_LEARNER_H
#define MORPHO_JOBS_LEARNER_H

#include <morpho/learning.h>

#include "jobs/state.h"
#include "jobs/trainings.h"

/* A training run, and the state that the back end needs for its gradients. */
struct mo_learner {
  struct mo_training *training;
  /* Set by mo_learner_prepare. */
  struct mo_runner *runner;
  enum mo_urgency urgency;
  enum mo_back_end back_end;
  int (*write)(void *context);
  void *context;
  struct mo_gradient_state *gradients;
  /* The current gradient; batch.computed_on is the back end that computed it. */
  struct mo_gradient_batch batch;
  int error;
  bool computes, draws; /* threads of this step */
  pthread_t computing, drawing;
  int64_t start_us;
  double *d_parameters;
  struct mo_outcome *outcomes;
};
/* Prepares the learner for its training run. Call it again when another run with the same
 * controller and batch replaces it. `write` writes the due data of earlier steps, and may read the
 * state of the run. MO_ERR_NO_MEMORY. */
int mo_learner_prepare(struct mo_learner *learner, struct mo_runner *runner,
                       const struct mo_job *job, int (*write)(void *context), void *context);
/* Sets the designs of the run and discards the batch that was laid out ahead. */
int mo_learner_set_designs(struct mo_learner *learner, const uint64_t *designs, uint32_t n);
/* Runs one step: the gradient of the drawn robots, then its application. On devices, `write` and
 * the drawing of the next robots run during the gradient. On workers, where a gradient takes a
 * hundred times as long, this would save nothing, so the gradient starts only after `write`
 * succeeds. An error of `write` takes precedence over an error of the gradient. seconds: the time
 * of the whole step. */
int mo_learner_gradient(struct mo_learner *learner, const struct mo_robot *robots);
int mo_learner_apply(struct mo_learner *learner, struct mo_training_report *report,
                     double *seconds);
void mo_learner_free(struct mo_learner *learner); /* also frees the training run */

#endif
