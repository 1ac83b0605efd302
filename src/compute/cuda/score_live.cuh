/* score_live.cuh: entire rollouts in one kernel.
 *
 * A block takes a group of rows and simulates it from the first step to the last, then takes the
 * next group. Positions, activations and the springs' lengths stay in shared memory; velocities are
 * in the block's own global memory, and rarely leave the caches. A step:
 *   sense    sixteen lanes per row: the light's mean, then the inputs of the first layer
 *   think    three hidden layers, then tiles of springs: the target length of each. In a
 *            step that starts no control period, sense finds the center of mass; think is skipped
 *   pull     a thread per mass and row adds its springs up, each seen from both of its ends: no two
 *            threads write the same number
 *   move     the same thread moves the mass
 * A row's numbers are computed from its own inputs in a fixed order, regardless of its place.
 *
 * The kernel has two versions. For any device: 256 threads and at most 40 rows, two blocks per
 * multiprocessor, so that the physics of one runs alongside the products of the other
 * (score_think_narrow.cuh, which is included first). For capability 9.0: 512 threads and at most 80
 * rows, for which the weights are loaded once, not twice (score_think_wide.cuh). Launches in which
 * some row is special, with a task, a profile or damage, or in which all rows are measured, have
 * their own kernels (MO_CUDA_TASKS, score_guide.cuh, score_observe.cuh). */
#ifndef MORPHO_COMPUTE_CUDA_SCORE_LIVE_CUH
#define MORPHO_COMPUTE_CUDA_SCORE_LIVE_CUH

#include "compute/cuda/score_guide.cuh"
#include "compute/cuda/score_move.cuh"
#include "compute/cuda/score_observe.cuh"

namespace {

/* TASKS: Plain; Tasks if some row is special; Measured if all rows are measured. */
template <bool SPLIT, class TASKS>
__device__ __forceinline__ void live_of(const mo_cuda_score &score, const TASKS &tasks)
{
  Shared &shared = shared_of_block();
  const uint32_t thread = threadIdx.x;
  if (thread == 0) {
    shared.cancelled = 0;
    shared.score = score;
    shared.scalars =
        score.weights == nullptr
            ? mo_weights_scalars{}
            : *reinterpret_cast<const mo_weights_scalars *>(score.weights + score.layout.scalars);
  }
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
    Memory memory = memory_of(score);
    if (SPLIT)
      memory.velocity = score.velocities + (size_t)blockIdx.x * 6 * score.max_places;
    const mo_sensor sensor = (mo_sensor)shared.scalars.sensor;
    begin_group(score, shared, tasks, memory);
    tasks.begin();
    if (SPLIT)
      set_kicks(shared, true);
    for (uint32_t step = 0; step < score.n_steps; step++) {
      tasks.guide(score, step);
      float *velocity = memory.velocity;
      Pull how = {velocity, 1.0f, true};
      if (SPLIT) {
        velocity += (step + 1) % 2 * 3 * score.max_places;
        how.before += step % 2 * 3 * score.max_places;
      }
      const float *const before = how.before;
      if (score.weights != nullptr && step % score.control_steps == 0) {
        if (SPLIT && step > 0) {
          how.share = 0.5f;
          pull<SPLIT, TASKS::kSpecial>(shared, memory.position, memory.lengths, velocity, how,
                                       step);
          how.before = velocity;
          how.coasts = false;
        }
        tasks.keep_lengths(memory, step);
        const Start start = thread < MO_HIDDEN ? load_start(score, step) : Start{};
        sense<true>(score, shared, sensor, memory.position, memory.x, step);
        if (thread < MO_HIDDEN)
          shared.first[thread] = start_of_first_layer(start);
        mo_cuda_activations_written();
        __syncthreads();
        think(score, shared, memory);
        __syncthreads();
      } else {
        sense<false>(score, shared, sensor, memory.position, memory.x, step);
      }
      tasks.observe(score, step);
      pull<SPLIT, TASKS::kSpecial>(shared, memory.position, memory.lengths, velocity, how, step);
      if (thread == 0 && step % kCancelSteps == 0 && *score.cancel != 0)
        shared.cancelled = 1;
      if (!__syncthreads_or(thread < n_rows && shared.diverged[thread] == 0) || shared.cancelled)
        break;
      move<SPLIT>(score, shared, tasks, memory.position, velocity, before);
      __syncthreads();
      if (SPLIT && step == 0)
        set_kicks(shared, false);
      if (tasks.end_step(score, shared, step) && shared.diverged[thread] == 0) {
        shared.diverged[thread] = (int)(step + 1);
        mo_cuda_outcome *outcome = score.outcomes + score.rows[shared.plan.first_row + thread].row;
        for (int axis = 0; axis < 3; axis++)
          outcome->com_end_m[axis] =
              (double)shared.com[step & 1][thread][axis] + (axis < 2 ? MO_WORLD_CENTER_M : 0.0);
      }
    }
    __syncthreads();
    end_group(score, shared, memory.position);
    tasks.end();
  }
}

/* Lets kernels use the memory of a block. */
template <class... Kernels> cudaError_t prepare(Kernels... kernels)
{
  cudaError_t status = cudaSuccess;
  ((status = status != cudaSuccess
                 ? status
                 : cudaFuncSetAttribute(kernels, cudaFuncAttributeMaxDynamicSharedMemorySize,
                                        MO_CUDA_BYTES)),
   ...);
  return status;
}

#ifdef MO_CUDA_TASKS

template <bool SPLIT>
__global__ void __launch_bounds__(MO_CUDA_THREADS, MO_CUDA_BLOCKS)
    live_with_tasks(const __grid_constant__ mo_cuda_score score,
                    const __grid_constant__ mo_cuda_tasks tasks)
{
  live_of<SPLIT>(score, Tasks(tasks));
}

template <bool SPLIT>
__global__ void __launch_bounds__(MO_CUDA_THREADS, MO_CUDA_BLOCKS)
    live_measured(const __grid_constant__ mo_cuda_score score,
                  const __grid_constant__ mo_cuda_tasks tasks,
                  const __grid_constant__ mo_cuda_measures measures)
{
  live_of<SPLIT>(score, Measured(tasks, measures));
}

cudaError_t prepare_live()
{
  return prepare(live_with_tasks<false>, live_with_tasks<true>, live_measured<false>,
                 live_measured<true>);
}

cudaError_t launch_live(const mo_cuda_score &score, const mo_cuda_tasks &tasks,
                        const mo_cuda_measures *measures, uint32_t blocks, cudaStream_t stream)
{
  if (measures != nullptr) {
    const auto kernel = score.splits ? live_measured<true> : live_measured<false>;
    kernel<<<blocks, MO_CUDA_THREADS, MO_CUDA_BYTES, stream>>>(score, tasks, *measures);
  } else {
    const auto kernel = score.splits ? live_with_tasks<true> : live_with_tasks<false>;
    kernel<<<blocks, MO_CUDA_THREADS, MO_CUDA_BYTES, stream>>>(score, tasks);
  }
  return cudaGetLastError();
}

/* The kernel that score_tasks.cu or score_wide_tasks.cu compiles from this file. */
constexpr mo_cuda_tasks_kernel kLive = {prepare_live, launch_live};

#else

template <bool SPLIT>
__global__ void __launch_bounds__(MO_CUDA_THREADS, MO_CUDA_BLOCKS)
    live(const __grid_constant__ mo_cuda_score score)
{
  live_of<SPLIT>(score, Plain());
}

cudaError_t prepare_live()
{
  return prepare(live<false>, live<true>);
}

cudaError_t launch_live(const mo_cuda_score &score, uint32_t blocks, cudaStream_t stream)
{
  const auto kernel = score.splits ? live<true> : live<false>;
  kernel<<<blocks, MO_CUDA_THREADS, MO_CUDA_BYTES, stream>>>(score);
  return cudaGetLastError();
}

/* The kernel that score.cu or score_wide.cu compiles from this file. */
constexpr mo_cuda_score_kernel kLive = {MO_CUDA_ROWS,
                                        MO_CUDA_BLOCKS,
                                        MO_CUDA_BYTES - kSharedBytes - sizeof(mo_plan_pairs) -
                                            MO_CUDA_PAD_BYTES,
                                        MO_CUDA_COLUMN_BYTES,
                                        prepare_live,
                                        launch_live};

#endif

} // namespace

#endif
