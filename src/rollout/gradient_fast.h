/* gradient_fast.h: data that gradient_block.c prepares and gradient_kernel.inc runs on. Internal to
 * this room. */
#ifndef MORPHO_ROLLOUT_GRADIENT_FAST_H
#define MORPHO_ROLLOUT_GRADIENT_FAST_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/gradient.h>

/* Every array is 64-byte aligned. */
struct mo_gradient_pack {
  enum mo_isa isa;
  struct mo_workspace workspace;
  enum mo_sensor sensor;
  uint32_t n_masses, n_springs, n_inputs;
  size_t n_parameters;
  uint32_t panel; /* two vectors of float32 */
  size_t bytes;
  float *input_weight;                          /* (256 / panel, n_masses, panel) */
  float *cpg_weight;                            /* (5, 256): transposed */
  float *forward_weight[MO_HIDDEN_LAYERS - 1];  /* (256 / panel, 256 inputs, panel outputs) */
  float *backward_weight[MO_HIDDEN_LAYERS - 1]; /* (256 / panel, 256 outputs, panel inputs) */
  float *output_weight, *output_bias;           /* (n_springs, 256), (n_springs): as in the file */
  float *bias[MO_HIDDEN_LAYERS];                /* (256) */
  float *gain[MO_HIDDEN_LAYERS], *shift[MO_HIDDEN_LAYERS];
};

/* Memory that grows and never shrinks. */
struct mo_gradient_buffer {
  char *base;
  size_t size;
  bool mapped; /* by mmap */
};

struct mo_gradient_memory {
  size_t budget_bytes;
  struct mo_gradient_buffer block, tiling, work;
};

/* Makes buffer->base point to at least `bytes`, 64-byte aligned; old content is lost.
 * MO_ERR_NO_MEMORY: the buffer did not change, or is empty. */
int mo_gradient_reserve(struct mo_gradient_buffer *buffer, size_t bytes);

struct mo_gradient_run {
  struct mo_gradient_memory *memory;
  const struct mo_gradient_pack *pack;
  const struct mo_robot *robots;
  uint32_t n;
  const struct mo_physics *physics;
  const struct mo_gradient_options *options;
  const struct mo_pause_point *pause;
  struct mo_outcome *outcomes;
  float *d_parameters;
  struct mo_gradient_counts *counts; /* of this block */
};

typedef int mo_gradient_function(struct mo_gradient_run *run);
mo_gradient_function mo_gradient_baseline, mo_gradient_avx2, mo_gradient_avx512;
mo_gradient_function *mo_gradient_find(enum mo_isa isa);

#endif
