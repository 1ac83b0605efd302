/* held_out.c: the held-out designs of a training's validation, and their score.
 *
 * The score of a design is its mean loss over the environments. The mean over designs omits designs
 * of which a rollout diverged; diverged rollouts are counted. Sums run in the order of designs and
 * environments, so they have the same bits for any number of workers. */
#include "jobs/held_out.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define BLOCKS_AT_ONCE        64
#define DEVICE_BLOCKS_AT_ONCE 4096

void mo_held_out_free(struct mo_held_out *held_out)
{
  free(held_out->genotypes);
  free(held_out->environments);
  memset(held_out, 0, sizeof(*held_out));
}

int mo_held_out_load(struct mo_store *store, const struct mo_training_status *status,
                     struct mo_held_out *held_out)
{
  const struct mo_training_settings *settings = &status->record.settings;
  uint32_t n = 0;
  int error = MO_OK;
  memset(held_out, 0, sizeof(*held_out));
  held_out->n_designs = settings->held_out_designs;
  held_out->n_environments = settings->held_out_environments;
  if (settings->kind == MO_TRAINING_FINETUNE) {
    error = mo_store_training_designs(store, status->job.id, &held_out->genotypes, &n);
    if (n < held_out->n_designs)
      held_out->n_designs = n;
  } else {
    held_out->genotypes = calloc((size_t)held_out->n_designs + 1, sizeof(*held_out->genotypes));
    error = held_out->genotypes == NULL ? MO_ERR_NO_MEMORY
                                        : mo_held_out_designs(settings->seed, held_out->n_designs,
                                                              held_out->genotypes[0].words);
  }
  if (error == MO_OK) {
    held_out->environments =
        calloc((size_t)held_out->n_environments + 1, sizeof(*held_out->environments));
    if (held_out->environments == NULL)
      error = MO_ERR_NO_MEMORY;
    else
      mo_held_out_environments(settings->seed, held_out->n_environments, held_out->environments);
  }
  if (error != MO_OK)
    mo_held_out_free(held_out);
  return error;
}

/* ---- scores ---- */

/* Sums so far. */
struct tally {
  double sum, sum_of_squares;
  uint32_t n;
  /* Of the current design. */
  double losses;
  bool diverged;
};

static void end_design(struct tally *tally, uint32_t n_environments)
{
  double score = tally->losses / n_environments;
  if (!tally->diverged) {
    tally->sum += score;
    tally->sum_of_squares += score * score;
    tally->n++;
  }
  tally->losses = 0;
  tally->diverged = false;
}

static void take(struct tally *tally, const struct mo_block *block,
                 struct mo_training_validation_row *row)
{
  for (uint32_t i = 0; i < block->n_environments; i++) {
    bool diverged = block->outcomes[i].diverged_step != 0 || !isfinite(block->outcomes[i].loss);
    row->rollouts++;
    row->diverged += diverged;
    tally->diverged = tally->diverged || diverged;
    tally->losses += block->outcomes[i].loss;
  }
}

int mo_held_out_score(struct mo_runner *runner, const struct mo_held_out *held_out,
                      const struct mo_controller *controller,
                      const struct mo_training_status *status, struct mo_compute_share *share,
                      struct mo_training_validation_row *row)
{
  const enum mo_back_end back_end = status->job.back_end;
  struct mo_jobs *jobs = runner->jobs;
  uint32_t per_design = (held_out->n_environments + MO_BLOCK_LANES - 1) / MO_BLOCK_LANES;
  size_t total = (size_t)per_design * held_out->n_designs;
  size_t at_once = back_end == MO_ON_DEVICE ? DEVICE_BLOCKS_AT_ONCE : BLOCKS_AT_ONCE;
  struct mo_compute_controller *ready = NULL;
  struct mo_block *blocks = calloc(at_once, sizeof(*blocks));
  struct tally tally = {0};
  int error = blocks == NULL ? MO_ERR_NO_MEMORY
                             : mo_compute_controller_create(jobs->compute, controller, &ready);
  row->rollouts = row->diverged = 0;
  for (size_t first = 0; first < total && error == MO_OK; first += at_once) {
    size_t n = total - first < at_once ? total - first : at_once;
    for (size_t b = 0; b < n; b++) {
      uint32_t from = (uint32_t)((first + b) % per_design) * MO_BLOCK_LANES;
      uint32_t left = held_out->n_environments - from;
      blocks[b] = (struct mo_block){.lattice = jobs->lattice,
                                    .genotype = held_out->genotypes[(first + b) / per_design].words,
                                    .controller = ready,
                                    .n_environments = left < MO_BLOCK_LANES ? left : MO_BLOCK_LANES,
                                    .physics = status->record.settings.physics,
                                    .precision = MO_FLOAT32,
                                    .urgency = MO_BATCH,
                                    .back_end = back_end,
                                    .cancel = &runner->interrupt,
                                    .tag = runner->id,
                                    .share = share};
      for (uint32_t i = 0; i < blocks[b].n_environments; i++)
        blocks[b].environments[i] = &held_out->environments[from + i];
    }
    error = mo_back_end_error(back_end, mo_compute_run(jobs->compute, blocks, n));
    for (size_t b = 0; b < n && error == MO_OK; b++) {
      take(&tally, &blocks[b], row);
      if ((first + b) % per_design == per_design - 1)
        end_design(&tally, held_out->n_environments);
    }
  }
  mo_compute_controller_free(ready);
  free(blocks);
  row->mean_score = tally.n > 0 ? tally.sum / tally.n : NAN;
  row->standard_error = NAN;
  if (tally.n > 1) {
    double variance = (tally.sum_of_squares - tally.sum * row->mean_score) / (tally.n - 1);
    row->standard_error = sqrt(variance > 0 ? variance / tally.n : 0);
  }
  return error;
}
