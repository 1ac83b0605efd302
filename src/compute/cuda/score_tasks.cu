/* score_tasks.cu: like score.cu, but for launches in which some row is special. */
#define MO_CUDA_TASKS
#include "compute/cuda/score_think_narrow.cuh"

#include "compute/cuda/score_live.cuh"

const mo_cuda_tasks_kernel mo_cuda_tasks_narrow = kLive;
