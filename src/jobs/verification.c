/* verification.c: see verification.h. */
#include "jobs/verification.h"

#include <stdlib.h>
#include <string.h>

#include "jobs/state.h"

#define STEPS_MAX ((uint64_t)1 << 20) /* for all rollouts of a call: about 4 s of a core */

/* Finds the back end that computes a class. Returns false if this host does not have it. */
static bool find_class(const struct mo_jobs *jobs, const struct mo_origin_row *row,
                       enum mo_back_end *back_end)
{
  const char *device = mo_compute_devices(jobs->compute) > 0
                           ? mo_compute_device_fingerprint(jobs->compute)
                           : NULL; /* not the class of workers */
  *back_end = device != NULL && strcmp(row->fingerprint, device) == 0 ? MO_ON_DEVICE : MO_ON_CPU;
  return *back_end == MO_ON_DEVICE ||
         strcmp(row->fingerprint, mo_compute_fingerprint(jobs->compute, row->precision)) == 0;
}

static void fill_block(const struct mo_jobs *jobs, const struct mo_origin_row *row,
                       const struct mo_loaded *controller, enum mo_back_end back_end,
                       const struct mo_measuring *measuring, struct mo_block *block)
{
  *block = (struct mo_block){.lattice = jobs->lattice,
                             .genotype = row->genotype.words,
                             .controller = controller->ready,
                             .n_environments = row->n,
                             .physics = row->physics,
                             .precision = row->precision,
                             .urgency = MO_INTERACTIVE,
                             .back_end = back_end,
                             .measuring = row->has_measures ? measuring : NULL,
                             .tag = -1};
  for (uint32_t k = 0; k < row->n; k++)
    block->environments[k] = &row->environments[k];
}

/* Takes the results of a block. Its measures are already in the row. */
static void compare(const struct mo_block *block, struct mo_origin_row *row)
{
  for (uint32_t k = 0; k < row->n && row->has_measures; k++)
    for (uint32_t m = 0; m < row->n_measures; m++)
      row->measures_differ =
          row->measures_differ ||
          !mo_measure_equal(row->again_measures.values[k][m], row->stored_measures.values[k][m]);
  for (uint32_t k = 0; k < row->n; k++) {
    row->again.losses[k] = block->outcomes[k].loss;
    row->again.diverged_steps[k] = (uint32_t)block->outcomes[k].diverged_step;
  }
  row->differs = row->has_losses && !mo_loss_rows_equal(&row->again, &row->stored, row->n);
}

struct batch {
  struct mo_block blocks[MO_VERIFIED_MAX];
  struct mo_measuring measuring[MO_VERIFIED_MAX];
  struct mo_loaded *controllers[MO_VERIFIED_MAX];
  struct mo_origin_row *rows[MO_VERIFIED_MAX];
  size_t n;
};

static int add(struct mo_jobs *jobs, struct mo_verification *verification, struct batch *batch,
               struct mo_origin_row *row)
{
  enum mo_back_end back_end;
  if (!find_class(jobs, row, &back_end)) {
    verification->skipped += row->n;
    return MO_OK;
  }
  struct mo_loaded **controller = &batch->controllers[batch->n];
  const int error = mo_loaded_acquire(&jobs->controllers, &row->controller_sha256, controller);
  if (error != MO_OK)
    return error;
  struct mo_measuring *measuring = &batch->measuring[batch->n];
  *measuring = (struct mo_measuring){MO_MEASURES_ALL, row->again_measures.values};
  fill_block(jobs, row, *controller, back_end, measuring, &batch->blocks[batch->n]);
  batch->rows[batch->n++] = row;
  verification->checked += row->n;
  return MO_OK;
}

static int compute(struct mo_jobs *jobs, struct mo_verification *verification, size_t n)
{
  struct batch *batch = calloc(1, sizeof(*batch));
  int error = batch != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  for (size_t i = 0; i < n && error == MO_OK; i++)
    error = add(jobs, verification, batch, &verification->rows[i]);
  if (error == MO_OK && batch->n > 0)
    error = mo_compute_run(jobs->compute, batch->blocks, batch->n);
  for (size_t i = 0; batch != NULL && i < batch->n; i++) {
    if (error == MO_OK)
      compare(&batch->blocks[i], batch->rows[i]);
    mo_loaded_release(&jobs->controllers, batch->controllers[i]);
  }
  free(batch);
  return error;
}

/* Drops rows from the end until the rest does not take too long, but always keeps the first. */
static size_t shorten(struct mo_verification *verification, size_t n)
{
  uint64_t steps = 0;
  for (size_t i = 0; i < n; i++) {
    const struct mo_origin_row *row = &verification->rows[i];
    steps += (uint64_t)row->n * row->physics.scheme.n_steps;
    if (i == 0 || steps <= STEPS_MAX)
      continue;
    verification->place = (struct mo_origin_place){row[-1].genotype_row, row[-1].condition};
    verification->is_last = false;
    return i;
  }
  return n;
}

int mo_jobs_verify(struct mo_jobs *jobs, struct mo_verification *verification)
{
  verification->n = 0;
  verification->checked = verification->skipped = 0;
  verification->rows = calloc(verification->limit, sizeof(*verification->rows));
  if (verification->rows == NULL)
    return MO_ERR_NO_MEMORY;
  if (atomic_load(&jobs->is_stopping))
    return MO_ERR_CANCELLED;
  const int64_t read =
      mo_store_origin_rows(jobs->store, verification->origin, &verification->place,
                           verification->rows, verification->limit, &verification->is_last);
  const size_t n = read > 0 ? shorten(verification, (size_t)read) : 0;
  const int error = read < 0 ? (int)read : compute(jobs, verification, n);
  for (size_t i = 0; i < verification->limit; i++)
    mo_environments_drop(verification->rows[i].environments, MO_BLOCK_LANES);
  for (size_t i = 0; i < n && error == MO_OK; i++)
    if (verification->rows[i].differs || verification->rows[i].measures_differ)
      verification->rows[verification->n++] = verification->rows[i];
  return error == MO_OK && verification->repair && verification->n > 0
             ? mo_store_origin_replace(jobs->store, verification->rows, verification->n)
             : error;
}
