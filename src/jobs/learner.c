/* learner.c: one step of learning on the back end, for training runs and for campaigns that learn.
 * A device computes the gradient of a thousand robots in the time that a CPU needs to draw them. */
#include "jobs/learner.h"

#include <stdlib.h>

#include "base/clock.h"
#include "base/thread.h"

#define THREADS_MAX 16

/* Draws and lays out the next robots. An error would recur when the step is due, and is reported
 * then. */
static void *draw_ahead(void *context)
{
  struct mo_learner *learner = context;
  const struct mo_training_settings *settings = mo_training_settings_of(learner->training);
  const struct mo_robot *robots = NULL;
  mo_thread_tag = learner->batch.tag;
  if (mo_training_draw_ahead(learner->training, learner->batch.cancel) == MO_OK)
    robots = mo_training_robots_ahead(learner->training);
  if (robots != NULL)
    (void)mo_compute_gradient_lay_out(learner->gradients, robots, settings->batch,
                                      &settings->physics);
  return NULL;
}

static void *compute(void *context)
{
  struct mo_learner *learner = context;
  mo_thread_tag = learner->batch.tag;
  learner->error = mo_compute_gradient(learner->gradients, &learner->batch);
  return NULL;
}

int mo_learner_prepare(struct mo_learner *learner, struct mo_runner *runner,
                       const struct mo_job *job, int (*write)(void *context), void *context)
{
  const size_t batch = mo_training_settings_of(learner->training)->batch;
  struct mo_compute_stats stats;
  mo_compute_get_stats(runner->jobs->compute, &stats);
  learner->runner = runner;
  learner->urgency = mo_back_end_urgency(runner->jobs, job);
  learner->back_end = job->back_end;
  learner->write = write;
  learner->context = context;
  if (learner->gradients != NULL)
    mo_compute_gradient_forget(learner->gradients);
  if (job->back_end == MO_ON_DEVICE)
    mo_training_set_threads(learner->training,
                            stats.n_workers < THREADS_MAX ? stats.n_workers : THREADS_MAX);
  if (learner->gradients != NULL)
    return MO_OK;
  learner->d_parameters =
      calloc(mo_training_controller(learner->training)->n_parameters, sizeof(double));
  learner->outcomes = calloc(batch, sizeof(*learner->outcomes));
  return learner->d_parameters == NULL || learner->outcomes == NULL
             ? MO_ERR_NO_MEMORY
             : mo_gradient_state_create(runner->jobs->compute, &learner->gradients);
}

int mo_learner_set_designs(struct mo_learner *learner, const uint64_t *designs, uint32_t n)
{
  mo_compute_gradient_forget(learner->gradients);
  return mo_training_set_designs(learner->training, designs, n);
}

static void begin(struct mo_learner *learner)
{
  learner->start_us = mo_clock_us();
  learner->computes = learner->draws = false;
  if (learner->back_end != MO_ON_DEVICE)
    return;
  learner->computes = mo_thread_create(&learner->computing, NULL, compute, learner) == 0;
  learner->draws = mo_thread_create(&learner->drawing, NULL, draw_ahead, learner) == 0;
}

static int wait_for_both(struct mo_learner *learner)
{
  if (learner->computes)
    pthread_join(learner->computing, NULL);
  else
    learner->error = mo_compute_gradient(learner->gradients, &learner->batch);
  if (learner->draws)
    pthread_join(learner->drawing, NULL);
  learner->computes = learner->draws = false;
  return mo_back_end_error(learner->back_end, learner->error);
}

int mo_learner_gradient(struct mo_learner *learner, const struct mo_robot *robots)
{
  const struct mo_training_settings *settings = mo_training_settings_of(learner->training);
  const bool beside = learner->back_end == MO_ON_DEVICE;
  int written = beside ? MO_OK : learner->write(learner->context), computed;
  if (written != MO_OK)
    return written;
  learner->batch =
      (struct mo_gradient_batch){.controller = mo_training_controller(learner->training),
                                 .robots = robots,
                                 .n = settings->batch,
                                 .physics = settings->physics,
                                 .options = settings->learning.gradient,
                                 .urgency = learner->urgency,
                                 .cancel = &learner->runner->interrupt,
                                 .tag = learner->runner->id,
                                 .share = learner->runner->share,
                                 .back_end = learner->back_end,
                                 .d_parameters = learner->d_parameters,
                                 .outcomes = learner->outcomes};
  begin(learner);
  if (beside)
    written = learner->write(learner->context);
  computed = wait_for_both(learner);
  return written != MO_OK ? written : computed;
}

int mo_learner_apply(struct mo_learner *learner, struct mo_training_report *report, double *seconds)
{
  int error = mo_training_apply(learner->training, learner->d_parameters, learner->outcomes,
                                &learner->batch.counts, report);
  *seconds = (double)(mo_clock_us() - learner->start_us) * 1e-6;
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

int mo_learned_create(const struct mo_jobs *jobs, const struct mo_job *job,
                      const struct mo_training *training, const struct mo_training_lineage *code,
                      struct mo_learned *learned)
{
  *learned = (struct mo_learned){.controller = NULL};
  int error = mo_training_export(
      training, job->has_controller ? MO_SHA256_HEX(&job->controller_sha256) : NULL,
      mo_jobs_code_version(jobs, job->back_end), code, &learned->controller);
  return error == MO_OK ? mo_controller_encode(learned->controller, &learned->bytes, &learned->size)
                        : error;
}

void mo_learned_free(struct mo_learned *learned)
{
  free(learned->bytes);
  mo_controller_free(learned->controller);
}
