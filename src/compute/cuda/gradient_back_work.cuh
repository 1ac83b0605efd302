/* gradient_back_work.cuh: the work of the springs (gradient_work.cuh) in the backward pass. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_BACK_WORK_CUH
#define MORPHO_COMPUTE_CUDA_GRADIENT_BACK_WORK_CUH

#include "compute/cuda/gradient_back_physics.cuh"
#include "compute/cuda/gradient_work.cuh"

/* Takes the work back: to the new outputs and the positions, before springs_back; or (BEFORE),
 * after it, to the outputs of the period before. ∂loss/∂activations go to the sums that
 * springs_back adds (d_activation on the tape), for all springs of the pair. adds: these sums have
 * something from later steps. */
template <bool BEFORE, class Back>
static __device__ __forceinline__ void work_back(Back &w, uint32_t step, uint32_t works, bool adds)
{
  const uint32_t broken = w.broken(step);
  const int n = w.own_chunks;
  float *const sums = (float *)(w.tape + w.d_activation_at) + w.chunk_at;
  float slope[2] = {0, 0}, sum[3] = {0, 0, 0};
  for (int i = 0; i < Back::ROWS / Back::PAIRS; i++)
    if ((works >> i & 1u) != 0)
      slope[i] = (float)(pair_ending(w, i).adjoint.d_work * pair_task(w, i).stiffness_n_per_m);
#pragma unroll 1
  for (int c = 0; c < n; c += MO_GK_WORK_AHEAD) {
    work_chunks chunks;
    float later[MO_GK_WORK_AHEAD];
    chunks.load<true>(w, w.pass_of(step), broken, c, n);
#pragma unroll
    for (int i = 0; i < MO_GK_WORK_AHEAD; i++)
      later[i] = load_if(adds && c + i < n, sums + 32 * (c + i));
#pragma unroll
    for (int i = 0; i < MO_GK_WORK_AHEAD; i++) {
      if (c + i >= n)
        break;
      const uint32_t s = chunks.spring[i], own = MO_GP_SPRING_OWN(s), other = MO_GP_SPRING_OTHER(s);
      const bool is_mass = own != MO_GP_NO_MASS;
      const back_mass here = w.mass[w.first + (is_mass ? own : 0)], there = w.mass[w.first + other];
      const float d[3] = {here.xy.x - there.xy.x, here.xy.y - there.xy.y,
                          here.z_gx.x - there.z_gx.x};
      const float rest = lane_rest(MO_GP_SPRING_DIAGONAL(s)),
                  actuation = w.constants_of(s).actuation,
                  per = MO_GP_SPRING_ROW(s) == 0 ? slope[0] : slope[1];
      const lane_length length = lane_length_of(lane_squared(d));
      const lane_work work = lane_work_of(&length, rest, actuation, activation_of(chunks.now[i]),
                                          activation_of(chunks.before[i]));
      const bool counts = is_mass && own != other && (chunks.cut >> i & 1u) == 0;
      const lane_work_adjoint adjoint =
          lane_work_back(counts ? per : 0.0f, &length, rest, actuation, &work);
      store(sums + 32 * (c + i),
            later[i] + (BEFORE ? adjoint.activation_before : adjoint.activation));
      if constexpr (!BEFORE) {
        for (int axis = 0; axis < 3; axis++)
          sum[axis] = fmaf(adjoint.along, d[axis], sum[axis]);
        if ((s & MO_GP_SPRING_LAST) != 0)
          for (int axis = 0; axis < 3; axis++) {
            if (is_mass)
              w.gx[3 * (w.first + own) + axis] += sum[axis];
            sum[axis] = 0;
          }
      }
    }
  }
  __syncwarp();
}

#endif
