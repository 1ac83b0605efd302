/* score_wide.cu: the kernel of whole rollouts for devices that have wgmma (score_live.cuh). Compiled for them alone: sm_90a. */
#include "compute/cuda/score_think_wide.cuh"

#include "compute/cuda/score_live.cuh"

mo_cuda_score_shape mo_cuda_score_wide_shape(bool exact)
{
  return shape_of_live(exact);
}

cudaError_t mo_cuda_score_wide_prepare()
{
  return prepare_live();
}

cudaError_t mo_cuda_score_wide_launch(const mo_cuda_score &score, bool exact, uint32_t blocks, cudaStream_t stream)
{
  return launch_live(score, exact, blocks, stream);
}
