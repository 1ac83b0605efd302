/* source.c: see source.h. */
#include "fleet/source.h"

/* The block is marked as urgent, so that remote takers do not get it. */
static int run(struct mo_compute *compute, const struct mo_wire_lease *lease,
               const struct mo_lattice *lattice, struct mo_compute_controller *controller,
               const volatile int *cancel, double *losses, uint32_t *diverged_steps,
               double (*measures)[MO_MEASURES])
{
  const struct mo_measuring measuring = {.set = MO_MEASURES_ALL, .values = measures};
  const struct mo_wire_block *from = &lease->blocks[0];
  struct mo_block block = {.lattice = lattice,
                           .genotype = from->genotype,
                           .controller = controller,
                           .n_environments = from->n_environments,
                           .physics = lease->physics,
                           .precision = MO_FLOAT32,
                           .urgency = MO_INTERACTIVE,
                           .back_end = lease->back_end,
                           .measuring = lease->has_measures ? &measuring : NULL,
                           .cancel = cancel};
  for (uint32_t k = 0; k < from->n_environments; k++)
    block.environments[k] = &lease->environments[from->environments[k]];
  int error = mo_compute_run(compute, &block, 1);
  if (error == MO_OK && block.computed_on != lease->back_end)
    error = MO_ERR_UNSUPPORTED; /* the block was computed by a different class */
  for (uint32_t k = 0; k < from->n_environments && error == MO_OK; k++) {
    losses[k] = block.outcomes[k].loss;
    diverged_steps[k] = (uint32_t)block.outcomes[k].diverged_step;
  }
  return error;
}

static int recompute(struct mo_compute *compute, struct mo_workspace workspace,
                     const struct mo_wire_lease *lease, const uint8_t *weights,
                     size_t weights_bytes, const volatile int *cancel, double *losses,
                     uint32_t *diverged_steps, double (*measures)[MO_MEASURES])
{
  struct mo_lattice *lattice = NULL;
  struct mo_controller *controller = NULL;
  struct mo_compute_controller *prepared = NULL;
  int error = mo_lattice_create(workspace, &lattice);
  if (error == MO_OK && weights != NULL)
    error = mo_controller_decode(weights, weights_bytes, &controller, NULL);
  if (error == MO_OK)
    error = mo_compute_controller_create(compute, controller, &prepared);
  if (error == MO_OK)
    error = run(compute, lease, lattice, prepared, cancel, losses, diverged_steps, measures);
  mo_compute_controller_free(prepared);
  mo_controller_free(controller);
  mo_lattice_free(lattice);
  return error;
}

struct mo_fleet_source mo_fleet_source_of(struct mo_compute *compute)
{
  return (struct mo_fleet_source){.compute = compute,
                                  .take = mo_compute_take,
                                  .put_back = mo_compute_put_back,
                                  .keep = mo_compute_keep,
                                  .split = mo_compute_split,
                                  .is_cancelled = mo_taken_is_cancelled,
                                  .deliver = mo_compute_deliver,
                                  .want = mo_compute_want_remote,
                                  .waiting = mo_compute_remote_waiting,
                                  .recompute = recompute};
}
