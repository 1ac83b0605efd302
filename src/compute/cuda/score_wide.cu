/* score_wide.cu: the kernel that runs entire rollouts, for devices with wgmma (score_live.cuh). It
 * is compiled only for these: sm_90a. */
#include "compute/cuda/score_think_wide.cuh"

#include "compute/cuda/score_live.cuh"

const mo_cuda_score_kernel mo_cuda_score_wide = kLive;
