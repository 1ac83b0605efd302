/* score.cuh: what the kernel of whole rollouts is given, and how it is launched. */
#ifndef MORPHO_COMPUTE_CUDA_SCORE_CUH
#define MORPHO_COMPUTE_CUDA_SCORE_CUH

#include "compute/cuda/physics.cuh"
#include "compute/cuda/plan.h"
#include "compute/cuda/weights.h"

#include <cuda_runtime.h>

/* An environment as rollouts read it, made on the device from its heights. */
struct mo_cuda_environment {
  float light[3]; /* x, y from the world's centre */
  float highest;
  mo_cuda_cell cells[MO_CUDA_CELLS];
};

/* What a row's life came to; the host makes the loss of it. */
struct mo_cuda_outcome {
  double com_start_m[3], com_end_m[3];
  int32_t diverged_step, unused;
};

/* Everything a launch reads and writes; all pointers are the device's. */
struct mo_cuda_score {
  const double *heights; /* (n_environments, MO_PLAN_ENVIRONMENT_DOUBLES) */
  mo_cuda_environment *environments;
  const mo_plan_body *bodies;
  const mo_plan_pairs *pairs;
  const uint32_t *links, *masses;
  const uint8_t *ranks, *inputs;
  const mo_plan_group *groups;
  const mo_plan_part *parts;
  const mo_plan_row *rows;
  const mo_plan_tile *tiles;
  const uint16_t *columns;
  const char *weights;       /* NULL: passive bodies */
  const float *generators;   /* (n_steps, MO_CPG_INPUTS) */
  float *velocities;         /* (blocks, max_places, 3) */
  mo_cuda_outcome *outcomes; /* by the caller's row */
  uint32_t *next_group;      /* 0 before the launch */
  const volatile int *cancel;
  struct mo_weights_layout layout;
  mo_cuda_constants constants;
  double dt_s, drop_height_m;
  uint32_t n_environments, n_groups, n_steps, max_places;
};

/* What a kernel takes: rows of a group, blocks on a multiprocessor, and what a plan is cut by (mo_plan_options). */
struct mo_cuda_score_shape {
  uint32_t rows, blocks;
  size_t group_bytes, column_bytes;
};
#define MO_CUDA_SCORE_PLACE_BYTES  12
#define MO_CUDA_SCORE_PART_BYTES   sizeof(mo_plan_pairs)
#define MO_CUDA_SCORE_LENGTH_BYTES 4

/* Dynamic shared memory of a block. */
#define MO_CUDA_SCORE_NARROW_BYTES (113 * 1024)
#define MO_CUDA_SCORE_WIDE_BYTES   (227 * 1024)
/* Of which capability the wide kernel is. */
#define MO_CUDA_SCORE_WIDE_CAPABILITY 90

mo_cuda_score_shape mo_cuda_score_shape_of(bool wide, bool exact);
/* Once per device. */
cudaError_t mo_cuda_score_prepare(bool wide);
cudaError_t mo_cuda_score_launch(const mo_cuda_score &score, bool wide, bool exact, uint32_t blocks,
                                 cudaStream_t stream);

/* The wide kernel's own. */
mo_cuda_score_shape mo_cuda_score_wide_shape(bool exact);
cudaError_t mo_cuda_score_wide_prepare();
cudaError_t mo_cuda_score_wide_launch(const mo_cuda_score &score, bool exact, uint32_t blocks, cudaStream_t stream);

#endif
