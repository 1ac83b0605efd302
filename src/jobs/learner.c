/* learner.c: one step of learning on the back end, for trainings and for campaigns that learn.
 *
 * A device computes the gradient of a thousand robots in the time that a processor needs to draw them. So while it does, a thread of this
 * step draws the robots of the next one. On the workers, where a gradient takes a hundred times as long, that would gain nothing. */
#include <pthread.h>
#include <signal.h>
#include <stdlib.h>

#include "jobs/internal.h"

#define DRAW_THREADS_MAX 8

struct ahead {
  struct mo_training *training;
  const volatile int *cancel;
  pthread_t thread;
  bool runs;
};

/* What fails here fails again, and is told, when the step is due. */
static void *draw_ahead(void *context)
{
  const struct ahead *ahead = context;
  (void)mo_training_draw_ahead(ahead->training, ahead->cancel);
  return NULL;
}

static void begin_ahead(struct mo_learner *learner, struct ahead *ahead)
{
  sigset_t all, before;
  if (learner->back_end != MO_ON_DEVICE)
    return;
  sigfillset(&all);
  pthread_sigmask(SIG_SETMASK, &all, &before);
  ahead->runs = pthread_create(&ahead->thread, NULL, draw_ahead, ahead) == 0;
  pthread_sigmask(SIG_SETMASK, &before, NULL);
}

int mo_learner_prepare(struct mo_jobs *jobs, enum mo_back_end back_end, struct mo_learner *learner)
{
  const size_t batch = mo_training_settings_of(learner->training)->batch;
  struct mo_compute_stats stats;
  mo_compute_get_stats(jobs->compute, &stats);
  learner->back_end = back_end;
  if (back_end == MO_ON_DEVICE)
    mo_training_set_threads(learner->training, stats.n_workers < DRAW_THREADS_MAX ? stats.n_workers : DRAW_THREADS_MAX);
  if (learner->gradients != NULL)
    return MO_OK;
  learner->d_parameters = calloc(mo_training_controller(learner->training)->n_parameters, sizeof(double));
  learner->outcomes = calloc(batch, sizeof(*learner->outcomes));
  return learner->d_parameters == NULL || learner->outcomes == NULL
             ? MO_ERR_NO_MEMORY
             : mo_gradient_state_create(jobs->compute, &learner->gradients);
}

int mo_learner_gradient(struct mo_learner *learner, const struct mo_robot *robots, enum mo_urgency urgency, int64_t tag,
                        struct mo_compute_share *share, const volatile int *cancel)
{
  const struct mo_training_settings *settings = mo_training_settings_of(learner->training);
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
  struct ahead ahead = {.training = learner->training, .cancel = cancel};
  int error;
  learner->start_us = mo_jobs_clock_us();
  begin_ahead(learner, &ahead);
  error = mo_back_end_error(learner->back_end, mo_compute_gradient(learner->gradients, &batch));
  if (ahead.runs)
    pthread_join(ahead.thread, NULL);
  learner->counts = batch.counts;
  learner->computed_on = batch.computed_on;
  return error;
}

int mo_learner_apply(struct mo_learner *learner, struct mo_training_report *report, double *seconds)
{
  int error = mo_training_apply(learner->training, learner->d_parameters, learner->outcomes, &learner->counts, report);
  *seconds = (double)(mo_jobs_clock_us() - learner->start_us) * 1e-6;
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
