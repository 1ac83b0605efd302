/* held_out.c: the held-out designs of a training run's validation, and their score.
 *
 * The score of a design is its mean loss over the environments. The mean over designs omits designs
 * with a diverged rollout; diverged rollouts are counted. Numbers are added in the order of designs
 * and environments, so the sums have the same bits for any number of workers. */
#include "jobs/held_out.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "jobs/scoring.h"
#include "store/worlds.h"

void mo_held_out_free(struct mo_held_out *held_out)
{
  free(held_out->genotypes);
  mo_environments_free(held_out->environments, held_out->n_environments);
  memset(held_out, 0, sizeof(*held_out));
}

int mo_held_out_worlds(struct mo_store *store, const struct mo_training_status *status,
                       struct mo_environment **environments, uint32_t *n)
{
  const struct mo_training_record *record = &status->record;
  struct mo_environment *own = NULL;
  uint32_t n_own = 0;
  int error = record->n_environments > 0
                  ? mo_store_job_environments(store, status->job.id, MO_JOB_TRAINING, &own, &n_own)
                  : MO_OK;
  if (error == MO_OK && record->n_environments > 0 && !record->draws_worlds) {
    *environments = own;
    *n = n_own;
    return MO_OK;
  }
  *n = record->settings.held_out_environments;
  *environments = calloc((size_t)*n + 1, sizeof(**environments));
  if (error == MO_OK && *environments == NULL)
    error = MO_ERR_NO_MEMORY;
  if (error == MO_OK)
    mo_held_out_tasks(record->settings.seed, *n, own, n_own, *environments);
  mo_environments_free(own, n_own);
  return error;
}

int mo_held_out_load(struct mo_store *store, const struct mo_training_status *status,
                     struct mo_held_out *held_out)
{
  const struct mo_training_settings *settings = &status->record.settings;
  uint32_t n = 0;
  int error = MO_OK;
  memset(held_out, 0, sizeof(*held_out));
  held_out->n_designs = settings->held_out_designs;
  if (settings->kind == MO_TRAINING_FINETUNE) {
    error = mo_store_job_designs(store, status->job.id, &held_out->genotypes, &n);
    if (n < held_out->n_designs)
      held_out->n_designs = n;
  } else {
    held_out->genotypes = calloc((size_t)held_out->n_designs + 1, sizeof(*held_out->genotypes));
    error = held_out->genotypes == NULL ? MO_ERR_NO_MEMORY
                                        : mo_held_out_designs(settings->seed, held_out->n_designs,
                                                              held_out->genotypes[0].words);
  }
  if (error == MO_OK)
    error = mo_held_out_worlds(store, status, &held_out->environments, &held_out->n_environments);
  if (error != MO_OK)
    mo_held_out_free(held_out);
  return error;
}

/* ---- scores ---- */

static void take(void *context, const struct mo_flight *flight, bool is_done)
{
  struct mo_outcome *outcomes = context;
  (void)is_done;
  for (uint32_t i = 0; i < flight->block.n_environments; i++)
    outcomes[(size_t)flight->design * flight->window->grid->n_environments + flight->places[i]] =
        flight->block.outcomes[i];
}

static void summarize(const struct mo_held_out *held_out, const struct mo_outcome *outcomes,
                      struct mo_training_validation_row *row)
{
  double sum = 0, sum_of_squares = 0;
  uint32_t n = 0;
  row->rollouts = held_out->n_designs * held_out->n_environments;
  row->diverged = 0;
  for (uint32_t design = 0; design < held_out->n_designs; design++) {
    const uint32_t before = row->diverged;
    double score = 0;
    for (uint32_t k = 0; k < held_out->n_environments; k++, outcomes++) {
      row->diverged += outcomes->diverged_step != 0 || !isfinite(outcomes->loss);
      score += outcomes->loss;
    }
    score /= held_out->n_environments;
    if (row->diverged > before)
      continue;
    sum += score;
    sum_of_squares += score * score;
    n++;
  }
  row->mean_score = n > 0 ? sum / n : NAN;
  row->standard_error = NAN;
  if (n > 1) {
    double variance = (sum_of_squares - sum * row->mean_score) / (n - 1);
    row->standard_error = sqrt(variance > 0 ? variance / n : 0);
  }
}

int mo_held_out_score(struct mo_runner *runner, const struct mo_held_out *held_out,
                      const struct mo_controller *controller,
                      const struct mo_training_status *status,
                      struct mo_training_validation_row *row)
{
  const size_t n = (size_t)held_out->n_designs * held_out->n_environments;
  struct mo_outcome *outcomes = calloc(n + 1, sizeof(*outcomes));
  struct mo_compute_controller *ready = NULL;
  struct mo_scoring scoring = {.runner = runner,
                               .grid = {.block = mo_block_of(runner->jobs, &status->job),
                                        .genotypes = held_out->genotypes,
                                        .environments = held_out->environments,
                                        .n_designs = held_out->n_designs,
                                        .n_environments = held_out->n_environments},
                               .context = outcomes,
                               .take = take};
  int error = outcomes == NULL ? MO_ERR_NO_MEMORY : mo_grid_create(&scoring.grid);
  if (error == MO_OK)
    error = mo_compute_controller_create(runner->jobs->compute, controller, &ready);
  scoring.grid.block.controller = ready;
  scoring.grid.block.urgency = MO_BATCH;
  if (error == MO_OK)
    error = mo_score(&scoring);
  if (error == MO_OK)
    summarize(held_out, outcomes, row);
  mo_compute_controller_free(ready);
  mo_grid_free(&scoring.grid);
  free(outcomes);
  return error;
}
