/* training_run.c: the state of a running training job: its rows and checkpoints, and how it begins
 * or continues. */
#include "jobs/training_run.h"

#include <stdio.h>
#include <stdlib.h>

#include "base/clock.h"
#include "store/worlds.h"

uint32_t mo_training_run_step(const struct mo_training_run *run)
{
  return run->learner.training != NULL ? mo_training_step(run->learner.training) : 0;
}

uint32_t mo_training_run_before(const struct mo_training_run *run)
{
  return run->body.position * run->status.record.settings.n_steps;
}

enum mo_phase mo_training_run_enter(struct mo_training_run *run, enum mo_phase phase)
{
  struct mo_runner *runner = run->runner;
  pthread_mutex_lock(&runner->runners->mutex);
  runner->live.position = mo_training_run_before(run) + mo_training_run_step(run);
  runner->live.last = run->status.job.steps_total;
  pthread_mutex_unlock(&runner->runners->mutex);
  return mo_runner_enter(runner, phase);
}

/* ---- writes that wait for space ---- */

static int write_rows(void *context)
{
  struct mo_training_run *run = context;
  const struct mo_training_report *report = &run->rows[run->n_rows - 1].report;
  const struct mo_live *live = &run->runner->live; /* only this thread changes it */
  char data[480];
  snprintf(
      data, sizeof(data),
      "{\"id\":\"%lld\",\"step\":%u,\"steps\":%u,\"mean_loss\":%s,\"gradient_norm\":%s,\"rate\":%s,"
      "\"clipped_share\":%s,\"bodies_per_s\":%s,\"seconds_left\":%s}",
      (long long)run->id, (unsigned)report->step, (unsigned)run->status.job.steps_total,
      MO_FIGURE(report->mean_loss), MO_FIGURE(report->gradient_norm), MO_FIGURE(report->rate),
      MO_FIGURE(report->clipped_share), MO_FIGURE(live->rate), MO_FIGURE(live->seconds_left));
  int error =
      mo_store_training_progress(run->jobs->store, run->id, run->rows, run->n_rows, NULL, data);
  if (error == MO_OK) {
    run->n_rows = 0;
    run->rows_us = mo_clock_us();
  }
  return error;
}

int mo_training_run_flush(struct mo_training_run *run)
{
  return run->n_rows > 0 ? mo_runner_persist(run->runner, write_rows, run, "the learning curve")
                         : MO_OK;
}

static int write_checkpoint(void *context)
{
  struct mo_training_run *run = context;
  uint8_t *bytes = NULL;
  size_t size = 0;
  uint32_t step = mo_training_run_step(run);
  int error = mo_training_encode(run->learner.training, &bytes, &size);
  if (error == MO_OK)
    error =
        mo_store_training_checkpoint(run->jobs->store, run->id, mo_training_run_before(run) + step,
                                     bytes, size, run->status.record.checkpoints_kept);
  free(bytes);
  if (error == MO_OK) {
    run->checkpoint_step = step;
    run->checkpoint_us = mo_clock_us();
    run->status.job.attempts = 0;
    atomic_fetch_add(&run->jobs->training_checkpoints, 1);
    mo_memory_prove(run->jobs, run->id);
  }
  return error;
}

int mo_training_run_save(struct mo_training_run *run)
{
  char what[64];
  int error = mo_training_run_flush(run);
  if (error != MO_OK || mo_training_run_step(run) == run->checkpoint_step)
    return error;
  enum mo_phase phase = mo_training_run_enter(run, MO_PHASE_SAVE);
  snprintf(what, sizeof(what), "the checkpoint of step %u",
           (unsigned)(mo_training_run_before(run) + mo_training_run_step(run)));
  error = mo_runner_persist(run->runner, write_checkpoint, run, what);
  (void)mo_runner_enter(run->runner, phase);
  return error;
}

/* ---- resumption ---- */

/* Loads the newest undamaged checkpoint of the current controller. MO_ERR_NOT_FOUND: there is
 * none. */
static int load_checkpoint(struct mo_training_run *run)
{
  struct mo_checkpoint_row rows[MO_CHECKPOINTS_KEPT_MAX];
  int64_t n = mo_store_checkpoints(run->jobs->store, run->id, rows, MO_CHECKPOINTS_KEPT_MAX);
  if (n < 0)
    return (int)n;
  while (n > 0 && rows[n - 1].step <= mo_training_run_before(run))
    n--; /* of designs that have learned */
  for (int64_t i = 0; i < n; i++) {
    struct mo_message message = {.text = "its bytes have changed"};
    uint8_t *bytes = NULL;
    size_t size = 0;
    char text[256];
    int error =
        mo_store_training_checkpoint_bytes(run->jobs->store, run->id, rows[i].step, &bytes, &size);
    if (error == MO_OK)
      error = mo_training_decode(bytes, size, &run->learner.training, &message);
    free(bytes);
    if (error == MO_OK)
      run->checkpoint_step = mo_training_run_step(run);
    if (error != MO_ERR_CORRUPT && error != MO_ERR_FORMAT && error != MO_ERR_IO)
      return error;
    snprintf(text, sizeof(text), "the checkpoint of step %u cannot be used (%.120s): %s",
             (unsigned)rows[i].step, error == MO_ERR_IO ? "it cannot be read" : message.text,
             i + 1 < n ? "using the previous one" : "restarting the training run");
    mo_runner_warn(run->runner, error, text);
  }
  return MO_ERR_NOT_FOUND;
}

static int set_environments(struct mo_training_run *run)
{
  struct mo_environment *environments = NULL;
  uint32_t n = 0;
  int error =
      mo_store_job_environments(run->jobs->store, run->id, MO_JOB_TRAINING, &environments, &n);
  if (error == MO_OK)
    error = run->status.record.draws_worlds
                ? mo_training_set_tasks(run->learner.training, environments, n)
                : mo_training_set_environments(run->learner.training, environments, n);
  mo_environments_free(environments, n);
  return error;
}

static int start_each(struct mo_training_run *run)
{
  const struct mo_training_record *record = &run->status.record;
  const int error = mo_training_create(&record->settings, run->parent, run->body.genotype.words, 1,
                                       &run->learner.training);
  return error == MO_OK && record->n_environments > 0 ? set_environments(run) : error;
}

static int start_over(struct mo_training_run *run)
{
  const struct mo_training_record *record = &run->status.record;
  struct mo_controller *parent = NULL;
  struct mo_bits *genotypes = NULL;
  uint32_t n = 0;
  if (record->each)
    return start_each(run);
  int error = run->status.job.has_controller
                  ? mo_runner_load(run->runner, &run->status.job.controller_sha256, &parent)
                  : MO_OK;
  if (error == MO_OK && record->n_designs > 0)
    error = mo_store_job_designs(run->jobs->store, run->id, &genotypes, &n);
  if (error == MO_OK)
    error =
        mo_training_create(&record->settings, parent, genotypes != NULL ? genotypes[0].words : NULL,
                           n, &run->learner.training);
  if (error == MO_OK && record->n_environments > 0)
    error = set_environments(run);
  free(genotypes);
  mo_controller_free(parent);
  return error;
}

int mo_training_run_begin(struct mo_training_run *run)
{
  const int error = load_checkpoint(run);
  return error == MO_ERR_NOT_FOUND ? start_over(run) : error;
}
