/* gradient_plan.h: lays out a batch of robots for the device that computes their gradient. Plain C,
 * no CUDA. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_PLAN_H
#define MORPHO_COMPUTE_CUDA_GRADIENT_PLAN_H

#include "compute/cuda/gradient_tables.h"

#include <stdbool.h>
#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

struct mo_gp_options {
  uint32_t shard;        /* robots per shard */
  uint32_t shared_bytes; /* of one thread block */
  uint32_t workers;      /* threads to use, 1 … 64 */
};

/* Memory that grows as calls need it. */
struct mo_gp_memory {
  void *at;
  size_t bytes;
};

enum { MO_GP_MEMORIES = 11 };

struct mo_gradient_plan {
  uint32_t n, n_shards, n_groups, n_rows;
  uint64_t n_masses, n_chunks;
  struct mo_gp_group *groups;   /* (n_groups) the groups of one shard are adjacent */
  struct mo_gp_row *rows;       /* (n_rows) */
  float *position;              /* (n_masses, 3) at the start; x, y from the world's center */
  uint8_t *input;               /* (n_masses) the mass's index among the inputs */
  uint32_t *springs;            /* (n_chunks, 32) */
  struct mo_gp_course *courses; /* (n_rows); NULL: no row is special */
  uint32_t *cuts; /* (n_chunks) bit l: the damage of its row cuts the spring of lane l; NULL: no row
                     has damage */
  bool works;     /* the task of some row needs the work of the springs */
  struct mo_outcome *starts; /* (n) only com_start_m is set */
  /* The memory of all these, and scratch memory. The next batch reuses it, because allocating 80 MB
   * takes longer than filling it. */
  struct mo_gp_memory memory[MO_GP_MEMORIES];
  /* The allocator of the tables; NULL: malloc and free. Set it once, while all other members are
   * zero.
   */
  void *(*allocate)(void *context, size_t bytes);
  void (*release)(void *memory);
  void *context;
};

/* Returns the bytes of shared memory that a group needs in the forward and backward passes:
 * positions and velocities with the inputs of LayerNorm, or with their adjoints. */
uint32_t mo_gp_shared_bytes(uint32_t n_rows, uint32_t n_masses, uint32_t n_outputs);

/* Makes a plan. plan: zeros, or the result of an earlier call. `robots` and everything they point
 * to are read only during this call. MO_ERR_UNSUPPORTED: a workspace other than the default, a
 * custom grid, a task without a gradient, or a single body that does not fit in shared_bytes;
 * MO_ERR_NO_MEMORY. The plan keeps its memory, even after an error, until mo_gradient_plan_free. */
int mo_gradient_plan_make(const struct mo_robot *robots, uint32_t n,
                          const struct mo_physics *physics, const struct mo_gp_options *options,
                          struct mo_gradient_plan *plan);
void mo_gradient_plan_free(struct mo_gradient_plan *plan);

#ifdef __cplusplus
}
#endif
#endif
