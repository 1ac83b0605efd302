/* score_wide.cu: the kernel of whole rollouts for devices that have wgmma (score_live.cuh).
 * Compiled only for them: sm_90a. */
#include "compute/cuda/score_think_wide.cuh"

#include "compute/cuda/score_live.cuh"

const mo_cuda_score_kernel mo_cuda_score_wide = kLive;
