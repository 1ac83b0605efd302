/* messages.h: random messages for tests of the room: leases of random bodies, and results. Every
 * fourth, starting with 2, is for a gradient. The caller frees them (mo_wire_free_…). */
#ifndef MORPHO_TESTS_FLEET_MESSAGES_H
#define MORPHO_TESTS_FLEET_MESSAGES_H

#include "../make.h"

#include "fleet/wire.h"

static inline struct mo_wire_lease lease_of(struct mo_workspace workspace, uint64_t number,
                                            uint32_t n_environments, uint32_t n_blocks)
{
  struct mo_random random = dice(number, 0, 0);
  struct mo_wire_lease lease = {.id = {7, number},
                                .physics = physics_of(100 + (uint32_t)number),
                                .back_end = number % 2 ? MO_ON_DEVICE : MO_ON_CPU,
                                .n_environments = n_environments,
                                .n_blocks = n_blocks,
                                .n_parameters = number % 4 == 2 ? 1000 : 0,
                                .gradient = mo_default_gradient_options()};
  lease.environments = calloc(n_environments, sizeof(*lease.environments));
  lease.blocks = calloc(n_blocks, sizeof(*lease.blocks));
  make_check(lease.environments && lease.blocks ? MO_OK : MO_ERR_NO_MEMORY, "a lease");
  lease.physics.scheme.impact = number % 2 ? MO_IMPACT_BISECTION : MO_IMPACT_EXACT;
  mo_sha256_of(&number, sizeof(number), &lease.controller);
  for (uint32_t e = 0; e < n_environments; e++)
    mo_environment_training(number, 0, e, &lease.environments[e]);
  for (uint32_t b = 0; b < n_blocks; b++) {
    struct mo_wire_block *block = &lease.blocks[b];
    make_check(mo_genotype_random(workspace, &random, block->genotype), "a body");
    mo_genotype_place(workspace, block->genotype);
    block->n_environments =
        lease.n_parameters > 0 ? 1 : 1 + mo_random_below(&random, MO_BLOCK_LANES);
    for (uint32_t k = 0; k < block->n_environments; k++)
      block->environments[k] = (uint16_t)mo_random_below(&random, n_environments);
    lease.n_rows += block->n_environments;
  }
  return lease;
}

static inline struct mo_wire_result result_of(struct mo_lease_id id, uint32_t n_rows)
{
  struct mo_wire_result result = {.id = id,
                                  .state = n_rows > 0 ? MO_RESULT_DONE : MO_RESULT_GIVEN_BACK,
                                  .n_rows = n_rows,
                                  .busy_s = 0.5,
                                  .wall_s = 0.25};
  if (n_rows == 0)
    return result;
  result.losses = calloc(n_rows, sizeof(*result.losses));
  result.diverged_steps = calloc(n_rows, sizeof(*result.diverged_steps));
  make_check(result.losses && result.diverged_steps ? MO_OK : MO_ERR_NO_MEMORY, "a result");
  for (uint32_t row = 0; row < n_rows; row++) {
    result.losses[row] = row % 5 == 4 ? INFINITY : 1.0 / (row + 3);
    result.diverged_steps[row] = row % 5 == 4 ? row : 0;
  }
  if (id.number % 4 != 2)
    return result;
  result.n_parameters = 5;
  result.d_parameters = calloc(result.n_parameters, sizeof(*result.d_parameters));
  make_check(result.d_parameters ? MO_OK : MO_ERR_NO_MEMORY, "a sum");
  for (uint32_t k = 0; k < result.n_parameters; k++)
    result.d_parameters[k] = k - 2.5;
  result.counts = (struct mo_gradient_counts){
      .robots = n_rows, .steps = 40, .clipped_steps = 3, .zeroed_robots = 1, .largest = 7};
  return result;
}

#endif
