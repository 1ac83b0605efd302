/* score.cu: whole rollouts in one kernel.
 *
 * A block of 256 threads takes a group of rows and lives its lives from the first step to the last, then takes the next group. Positions,
 * activations and the springs' lengths stay in shared memory; velocities are the block's own in global memory, and seldom leave the
 * caches. Two blocks share a multiprocessor, so that one's physics runs beside the other's products. A step:
 *   sense    sixteen lanes per row: the light's mean, then the inputs of the first layer
 *   think    three hidden layers (network.cuh), then tiles of springs: the length that each wants to have
 *   pull     a thread per mass and row adds its springs up, each seen from both of its ends: no two threads write one number
 *   move     the same thread moves the mass
 * A row's numbers come from its own inputs in a fixed order, wherever it stands. */
#include "compute/cuda/score_move.cuh"
#include "compute/cuda/score_think.cuh"

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

template <bool EXACT>
__global__ void __launch_bounds__(MO_CUDA_THREADS, MO_CUDA_SCORE_BLOCKS_PER_MULTIPROCESSOR)
    live(const __grid_constant__ mo_cuda_score score)
{
  extern __shared__ __align__(128) char block[];
  Shared &shared = *reinterpret_cast<Shared *>(block);
  Memory memory;
  memory.x = block + kSharedBytes;
  memory.velocity = score.velocities + (size_t)blockIdx.x * 3 * score.max_places;
  const uint32_t thread = threadIdx.x;
  const mo_weights_scalars scalars =
      score.weights == nullptr ? mo_weights_scalars{}
                               : *reinterpret_cast<const mo_weights_scalars *>(score.weights + score.layout.scalars);
  const mo_sensor sensor = (mo_sensor)scalars.sensor;
  if (thread == 0)
    shared.cancelled = 0;
  for (;;) {
    __syncthreads();
    if (thread == 0)
      shared.group = atomicAdd(score.next_group, 1u);
    __syncthreads();
    if (shared.group >= score.n_groups || shared.cancelled)
      return;
    if (thread == 0)
      shared.plan = score.groups[shared.group];
    __syncthreads();
    const uint32_t n_rows = shared.plan.n_rows;
    memory.position = reinterpret_cast<float *>(memory.x + (n_rows + MO_PLAN_COLUMN - 1) / MO_PLAN_COLUMN *
                                                               mo_cuda_network<EXACT>::COLUMN_BYTES);
    memory.pairs = reinterpret_cast<mo_plan_pairs *>(memory.position + 3 * shared.plan.n_places);
    memory.lengths = reinterpret_cast<float *>(memory.pairs + shared.plan.n_parts + 1);
    begin_group(score, shared, mo_cuda_network<EXACT>::UNITS, memory);
    for (uint32_t step = 0; step < score.n_steps; step++) {
      const Start start = score.weights != nullptr ? load_start(score, step) : Start{};
      sense<EXACT>(score, shared, sensor, memory.position, memory.x, step);
      if (score.weights != nullptr) {
        shared.first[thread] = start_of_first_layer(start);
        __syncthreads();
        think<EXACT>(score, shared, scalars, memory.x);
        act<EXACT>(score, shared, scalars.output, memory);
        __syncthreads();
      }
      pull(score, shared, memory.position, memory.lengths, memory.velocity);
      if (thread == 0 && step % kCancelSteps == 0 && *score.cancel != 0)
        shared.cancelled = 1;
      if (!__syncthreads_or(thread < n_rows && shared.diverged[thread] == 0) || shared.cancelled)
        break;
      move(score, shared, memory.position, memory.velocity);
      __syncthreads();
      if (thread < n_rows && shared.insane[thread] != 0 && shared.diverged[thread] == 0) {
        shared.diverged[thread] = (int)(step + 1);
        mo_cuda_outcome *outcome = score.outcomes + score.rows[shared.plan.first_row + thread].row;
        for (int axis = 0; axis < 3; axis++)
          outcome->com_end_m[axis] = (double)shared.com[step & 1][thread][axis] + (axis < 2 ? MO_WORLD_CENTRE_M : 0.0);
      }
    }
    __syncthreads();
    end_group(score, shared, memory.position);
  }
}

} // namespace

size_t mo_cuda_score_group_bytes()
{
  return MO_CUDA_SCORE_SHARED_BYTES - kSharedBytes - sizeof(mo_plan_pairs);
}

size_t mo_cuda_score_column_bytes(bool exact)
{
  return exact ? mo_cuda_network<true>::COLUMN_BYTES : mo_cuda_network<false>::COLUMN_BYTES;
}

cudaError_t mo_cuda_score_prepare()
{
  cudaError_t status =
      cudaFuncSetAttribute(live<true>, cudaFuncAttributeMaxDynamicSharedMemorySize, MO_CUDA_SCORE_SHARED_BYTES);
  if (status == cudaSuccess)
    status = cudaFuncSetAttribute(live<false>, cudaFuncAttributeMaxDynamicSharedMemorySize, MO_CUDA_SCORE_SHARED_BYTES);
  return status;
}

cudaError_t mo_cuda_score_launch(const mo_cuda_score &score, bool exact, uint32_t blocks, cudaStream_t stream)
{
  prepare_environments<<<score.n_environments, 96, 0, stream>>>(score.heights, score.environments,
                                                                score.n_environments);
  cudaError_t status = cudaGetLastError();
  if (status != cudaSuccess)
    return status;
  if (exact)
    live<true><<<blocks, MO_CUDA_THREADS, MO_CUDA_SCORE_SHARED_BYTES, stream>>>(score);
  else
    live<false><<<blocks, MO_CUDA_THREADS, MO_CUDA_SCORE_SHARED_BYTES, stream>>>(score);
  return cudaGetLastError();
}
