/* gradient_pass.h: the parts in which a plan is gone through: as many whole shards as the device's
 * memory holds, nearly always all; and what of them two blocks walk together. Plain C. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_PASS_H
#define MORPHO_COMPUTE_CUDA_GRADIENT_PASS_H

#include "compute/cuda/gradient_plan.h"

#include <stdbool.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Groups first … end − 1 of the plan. */
struct mo_gradient_pass {
  uint32_t first, end, first_shard, end_shard;
  uint64_t tape, sums; /* bytes, floats */
  uint32_t shared;     /* bytes of a thread block */
};

/* Before any work: whether the kernels' offsets reach over each group's part of the tape, and
 * `most` bytes hold any shard by itself. */
bool mo_gradient_can_be_held(const struct mo_gradient_plan *plan, uint32_t n_steps, uint64_t most);

/* As many shards from `first_shard` on, whose first group is `first`, as fit `budget` bytes; places
 * their groups' parts of the tape and the sums. MO_ERR_NO_MEMORY: none fits. */
int mo_gradient_pass_next(struct mo_gradient_plan *plan, uint32_t first_shard, uint32_t first,
                          uint32_t n_steps, uint64_t budget, struct mo_gradient_pass *ret);

/* How long a group takes, compared with others. */
uint64_t mo_gradient_cost(const struct mo_gp_group *g);

struct mo_gradient_load {
  uint64_t cost;
  uint32_t group;
  bool wide; /* of 32 rows: it can be walked in halves */
};

/* How many of the wide groups should be walked in halves, those first that take longest, for all
 * groups to end soonest. loads: (n), by falling cost. */
uint32_t mo_gradient_halved(const struct mo_gradient_load *loads, uint32_t n,
                            uint32_t multiprocessors);

#ifdef __cplusplus
}
#endif
#endif
