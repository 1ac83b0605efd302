/* learner.c: one step of learning on the back end, for trainings and for campaigns that learn. */
#include <stdlib.h>

#include "jobs/internal.h"

int mo_learner_prepare(struct mo_jobs *jobs, enum mo_back_end back_end, struct mo_learner *learner)
{
  const size_t batch = mo_training_settings_of(learner->training)->batch;
  learner->back_end = back_end;
  learner->d_parameters = calloc(mo_training_controller(learner->training)->n_parameters, sizeof(double));
  learner->outcomes = calloc(batch, sizeof(*learner->outcomes));
  return learner->d_parameters == NULL || learner->outcomes == NULL
             ? MO_ERR_NO_MEMORY
             : mo_gradient_state_create(jobs->compute, &learner->gradients);
}

int mo_learner_step(struct mo_learner *learner, const struct mo_robot *robots, enum mo_urgency urgency, int64_t tag,
                    struct mo_compute_share *share, const volatile int *cancel, struct mo_training_report *report,
                    double *seconds)
{
  const struct mo_training_settings *settings = mo_training_settings_of(learner->training);
  int64_t start_us = mo_jobs_clock_us();
  struct mo_gradient_batch batch = {.controller = mo_training_controller(learner->training),
                                    .robots = robots,
                                    .n = settings->batch,
                                    .physics = settings->physics,
                                    .adjoint_bound = settings->adjoint_bound,
                                    .urgency = urgency,
                                    .cancel = cancel,
                                    .tag = tag,
                                    .share = share,
                                    .back_end = learner->back_end,
                                    .d_parameters = learner->d_parameters,
                                    .outcomes = learner->outcomes};
  int error = mo_compute_gradient(learner->gradients, &batch);
  if (error == MO_OK)
    error = mo_training_apply(learner->training, learner->d_parameters, learner->outcomes, &batch.counts, report);
  *seconds = (double)(mo_jobs_clock_us() - start_us) * 1e-6;
  return error;
}

void mo_learner_free(struct mo_learner *learner)
{
  mo_gradient_state_free(learner->gradients);
  mo_training_free(learner->training);
  free(learner->d_parameters);
  free(learner->outcomes);
  *learner = (struct mo_learner){.training = NULL};
}
