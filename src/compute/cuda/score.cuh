/* score.cuh: the arguments of the kernel that runs entire rollouts, and its launch. */
#ifndef MORPHO_COMPUTE_CUDA_SCORE_CUH
#define MORPHO_COMPUTE_CUDA_SCORE_CUH

#include "compute/cuda/course.cuh"
#include "compute/cuda/lane.cuh"
#include "compute/cuda/observe.cuh"
#include "compute/cuda/plan_block.h"
#include "compute/cuda/weights.h"

#include <cuda_runtime.h>

/* The outcome of a row's rollout, from which the host computes the loss of a plain row. */
struct mo_cuda_outcome {
  double com_start_m[3], com_end_m[3];
  int32_t diverged_step, unused;
};

/* Everything a launch reads and writes; all pointers are the device's. */
struct mo_cuda_score {
  const mo_plan_environment *environments;
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
  float *velocities;         /* (blocks, max_places, 3); with `split` (blocks, 2, max_places, 3) */
  mo_cuda_outcome *outcomes; /* by the caller's row */
  uint32_t *next_group;      /* 0 before the launch */
  const volatile int *cancel;
  struct mo_weights_layout layout;
  float dt;
  uint32_t bisections; /* 0: exact */
  uint32_t n_groups, n_steps, max_places;
  uint32_t control_steps; /* in a control period */
  bool splits;            /* the integrator is `split` */
};

/* The state of a row with a task. */
struct mo_cuda_guided {
  mo_course course; /* its environment is one of mo_cuda_tasks.environments */
  mo_track track;   /* at the start of the current control period */
};

/* What a launch needs in addition if some row is special (plan.h): tasks, profiles, damage. It is
 * an argument of its own kernels, which leaves the kernels for all other rows as they are. */
struct mo_cuda_tasks {
  const mo_environment *environments; /* as in the plan's block */
  mo_cuda_guided *rows; /* by the caller's row, as the results; plain rows have none */
  course_result *results;
  double dt_s, end_s;
  uint32_t n_periods;
};

/* What a launch needs in addition to measure its rows. */
struct mo_cuda_measures {
  const mo_plan_rest *rest;
  const mo_plan_voxels *voxels;
  const mo_plan_corners *corners;
  mo_observed_row *observed; /* by the caller's row */
  float *lengths;            /* (blocks, max_lengths) of the previous period */
  uint32_t *inverted;        /* (blocks, MO_PLAN_ROWS_MAX, MO_PLAN_VOXEL_WORDS) voxels, as bits */
  uint32_t max_lengths;
};

/* A kernel: rows per group, blocks per multiprocessor, the memory of a group (mo_plan_options), and
 * how to launch it. */
struct mo_cuda_score_kernel {
  uint32_t rows, blocks;
  size_t group_bytes, column_bytes;
  cudaError_t (*prepare)(); /* once per device */
  cudaError_t (*launch)(const mo_cuda_score &score, uint32_t blocks, cudaStream_t stream);
};
/* The same kernel for special rows. measures: NULL, or for all rows. */
struct mo_cuda_tasks_kernel {
  cudaError_t (*prepare)();
  cudaError_t (*launch)(const mo_cuda_score &score, const mo_cuda_tasks &tasks,
                        const mo_cuda_measures *measures, uint32_t blocks, cudaStream_t stream);
};
/* Kernels for any device, and for devices of one capability. */
extern const mo_cuda_score_kernel mo_cuda_score_narrow, mo_cuda_score_wide;
extern const mo_cuda_tasks_kernel mo_cuda_tasks_narrow, mo_cuda_tasks_wide;

/* Dynamic shared memory of a block. */
#define MO_CUDA_SCORE_NARROW_BYTES (113 * 1024)
#define MO_CUDA_SCORE_WIDE_BYTES   (227 * 1024)
/* The capability that the wide kernel requires. */
#define MO_CUDA_SCORE_WIDE_CAPABILITY 90

#endif
