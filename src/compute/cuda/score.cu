/* score.cu: environments made ready, and the kernel of whole rollouts for any device (score_live.cuh). */
#include "compute/cuda/score_think_narrow.cuh"

#include "compute/cuda/score_live.cuh"

namespace {

__global__ void prepare_environments(const double *heights, mo_cuda_environment *environments, uint32_t n)
{
  const uint32_t e = blockIdx.x;
  if (e >= n)
    return;
  const double *in = heights + (size_t)e * MO_PLAN_ENVIRONMENT_DOUBLES;
  mo_cuda_environment *out = environments + e;
  for (int k = (int)threadIdx.x; k < MO_CUDA_CELLS; k += (int)blockDim.x)
    out->cells[k] = mo_cuda_cell_of(in + 2, k % MO_CUDA_CELLS_SIDE - 1, k / MO_CUDA_CELLS_SIDE - 1);
  if (threadIdx.x == 0) {
    double top = in[2];
    for (int k = 1; k < MO_TERRAIN_HEIGHTS; k++)
      top = fmax(top, in[2 + k]);
    out->light[0] = (float)(in[0] - MO_WORLD_CENTRE_M);
    out->light[1] = (float)(in[1] - MO_WORLD_CENTRE_M);
    out->light[2] = (float)terrain_height(in + 2, in[0], in[1]);
    /* A little above, so that rounding in the polynomials never counts. */
    out->highest = (float)(top + 1e-6 * (1.0 + fabs(top)));
  }
}

} // namespace

mo_cuda_score_shape mo_cuda_score_shape_of(bool wide, bool exact)
{
  return wide ? mo_cuda_score_wide_shape(exact) : shape_of_live(exact);
}

cudaError_t mo_cuda_score_prepare(bool wide)
{
  return wide ? mo_cuda_score_wide_prepare() : prepare_live();
}

cudaError_t mo_cuda_score_launch(const mo_cuda_score &score, bool wide, bool exact, uint32_t blocks,
                                 cudaStream_t stream)
{
  prepare_environments<<<score.n_environments, 96, 0, stream>>>(score.heights, score.environments,
                                                                score.n_environments);
  const cudaError_t status = cudaGetLastError();
  if (status != cudaSuccess)
    return status;
  return wide ? mo_cuda_score_wide_launch(score, exact, blocks, stream) : launch_live(score, exact, blocks, stream);
}
