/* gradient_pass.h: the passes of a plan: as many whole shards as fit into the device's memory
 * (nearly always all of them); and the groups that two blocks compute together. Plain C. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_PASS_H
#define MORPHO_COMPUTE_CUDA_GRADIENT_PASS_H

#include "compute/cuda/gradient_plan.h"
#include "compute/cuda/gradient_tape.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Groups first … end − 1 of the plan. */
struct mo_gradient_pass {
  uint32_t first, end, first_shard, end_shard;
  uint64_t tape, sums; /* bytes, floats */
  uint32_t shared;     /* bytes of a thread block */
};

/* Returns, before any work, whether the kernels' offsets can address each group's part of the tape,
 * and whether any single shard fits in `most` bytes. */
bool mo_gradient_can_be_held(const struct mo_gradient_plan *plan, struct mo_gp_time time,
                             uint64_t most);

/* Makes a pass of as many shards, starting with `first_shard` and its first group `first`, as fit
 * in `budget` bytes; places their groups' parts of the tape and the sums. MO_ERR_NO_MEMORY: not
 * even one fits. */
int mo_gradient_pass_next(struct mo_gradient_plan *plan, uint32_t first_shard, uint32_t first,
                          struct mo_gp_time time, uint64_t budget, struct mo_gradient_pass *ret);

/* Returns the relative cost of a group. */
uint64_t mo_gradient_cost(const struct mo_gp_group *g);

struct mo_gradient_load {
  uint64_t cost;
  uint32_t group;
  bool wide; /* of 32 rows: it can be computed in halves */
};

/* Returns how many of the wide groups, starting with the most expensive, should be computed in
 * halves so that all groups finish as early as possible. loads: (n), in descending order of
 * cost. */
uint32_t mo_gradient_halved(const struct mo_gradient_load *loads, uint32_t n,
                            uint32_t multiprocessors);

#ifdef __cplusplus
}
#endif
#endif
