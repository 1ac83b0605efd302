/* gradient_plan.h: a batch of robots laid out for the device that differentiates them. Plain C, no
 * CUDA. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_PLAN_H
#define MORPHO_COMPUTE_CUDA_GRADIENT_PLAN_H

#include "compute/cuda/gradient_tables.h"

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

struct mo_gp_options {
  uint32_t shard;        /* robots of a shard */
  uint32_t shared_bytes; /* of one thread block */
  uint32_t workers;      /* threads to use, 1 … 64 */
};

/* Memory that grows to what the calls need. */
struct mo_gp_memory {
  void *at;
  size_t bytes;
};

enum { MO_GP_MEMORIES = 9 };

struct mo_gradient_plan {
  uint32_t n, n_shards, n_groups, n_rows;
  uint64_t n_masses, n_chunks;
  struct mo_gp_group *groups; /* (n_groups) those of one shard adjacent */
  struct mo_gp_row *rows;     /* (n_rows) */
  float *position;            /* (n_masses, 3) at the start; x, y from the world's center */
  uint8_t *input;             /* (n_masses) the mass's place among the inputs */
  uint32_t *springs;          /* (n_chunks, 32) */
  struct mo_outcome *starts;  /* (n) com_start_m alone */
  /* What holds all that, and what making it takes: used again by the next batch, since new memory
   * of 80 MB takes longer to be had than to be filled. */
  struct mo_gp_memory memory[MO_GP_MEMORIES];
  /* Where the tables' memory comes from; NULL: malloc and free. Set once, while the rest is zeros.
   */
  void *(*allocate)(void *context, size_t bytes);
  void (*release)(void *memory);
  void *context;
};

/* Shared memory of a group, in bytes, on the way forward and back: places and velocities with what
 * LayerNorm is given, or with their adjoints. */
uint32_t mo_gp_shared_bytes(uint32_t n_rows, uint32_t n_masses, uint32_t n_outputs);

/* plan: zeros, or what an earlier call left. `robots` and what they point to are read only here.
 * MO_ERR_UNSUPPORTED: another workspace than the default, or a body that shared_bytes do not hold
 * by itself; MO_ERR_NO_MEMORY. The memory of the plan stays with it, after an error too, until
 * mo_gradient_plan_free. */
int mo_gradient_plan_make(const struct mo_robot *robots, uint32_t n,
                          const struct mo_physics *physics, const struct mo_gp_options *options,
                          struct mo_gradient_plan *plan);
void mo_gradient_plan_free(struct mo_gradient_plan *plan);

#ifdef __cplusplus
}
#endif
#endif
