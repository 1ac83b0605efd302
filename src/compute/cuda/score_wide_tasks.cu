/* score_wide_tasks.cu: like score_wide.cu, but for launches in which some row is special. */
#define MO_CUDA_TASKS
#include "compute/cuda/score_think_wide.cuh"

#include "compute/cuda/score_live.cuh"

const mo_cuda_tasks_kernel mo_cuda_tasks_wide = kLive;
