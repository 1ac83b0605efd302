/* score.cu: the kernel that runs entire rollouts, for any device (score_live.cuh). */
#include "compute/cuda/score_think_narrow.cuh"

#include "compute/cuda/score_live.cuh"

const mo_cuda_score_kernel mo_cuda_score_narrow = kLive;
