/* gradient_work.cuh: the work of the springs at the start of a control period (lane_work in
 * lane.cuh), for rows with tasks that need it: forward; gradient_back_work.cuh takes it back.
 *
 * Each is a pass of its own over a warp's chunks, because few tasks need it, and the loops over
 * springs have no registers to spare. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_WORK_CUH
#define MORPHO_COMPUTE_CUDA_GRADIENT_WORK_CUH

#include "compute/cuda/gradient_guide.cuh"

enum { MO_GK_WORK_AHEAD = 4 }; /* chunks loaded at a time */

/* Springs' gains are added as integers in this unit, so that the sum does not depend on the lanes
 * and chunks that a group gives a robot's springs: a robot has the same bits in every batch. Sums
 * below 2^17 m² are exact as doubles. */
#define MO_GK_WORK_UNIT_M2 (1.0f / 68719476736.0f) /* 2^-36 */
#define MO_GK_WORK_MOST_M2 1e4f /* of one spring; only diverging robots reach it */

template <class Walker>
static __device__ __forceinline__ const mo_gp_course &pair_task(const Walker &w, int i)
{
  return w.k.courses[w.first_row + w.group_row(w.pair_row(i))];
}

template <class Walker>
static __device__ __forceinline__ mo_gk_ending &pair_ending(const Walker &w, int i)
{
  return w.k.endings[w.first_row + w.group_row(w.pair_row(i))];
}

/* Returns bit i: the task of the pair's i-th row needs the work. */
template <class Walker> static __device__ __forceinline__ uint32_t works_of(const Walker &w)
{
  uint32_t bits = 0;
  if (w.k.works)
    for (int i = 0; i < Walker::ROWS / Walker::PAIRS; i++)
      bits |= (uint32_t)pair_task(w, i).works << i;
  return bits;
}

/* Chunks of a warp, and the activations of their springs in a control period and in the one
 * before. */
struct work_chunks {
  uint32_t spring[MO_GK_WORK_AHEAD];
  int16_t now[MO_GK_WORK_AHEAD], before[MO_GK_WORK_AHEAD];
  uint32_t cut; /* bit i: the spring of chunk i exerts no force in this step */

  /* Loads the chunks c … that are below n. NOW: also the activations of the period itself. */
  template <bool NOW, class Walker>
  __device__ __forceinline__ void load(const Walker &w, uint32_t pass, uint32_t broken, int c,
                                       int n)
  {
    const int16_t *kept =
        (const int16_t *)(w.tape + w.activation_at) + (size_t)pass * w.n_chunks * 32 + w.chunk_at;
    cut = broken != 0 ? w.template cut_springs<MO_GK_WORK_AHEAD>(c, n) : 0;
#pragma unroll
    for (int i = 0; i < MO_GK_WORK_AHEAD; i++) {
      const int at = 32 * min(c + i, n - 1);
      spring[i] = __ldg(w.list + at);
      before[i] = __ldcg(kept + at - w.n_chunks * 32);
      now[i] = NOW ? __ldcg(kept + at) : (int16_t)0;
    }
#pragma unroll
    for (int i = 0; i < MO_GK_WORK_AHEAD; i++)
      cut &= ~((broken >> MO_GP_SPRING_ROW(spring[i]) & 1u ? 0u : 1u) << i);
  }
};

/* Adds what the warp's springs gain in chunks `from` … n − 1. part: which of the row's sums. */
template <class Forward>
static __device__ __forceinline__ void add_gains(const Forward &w, uint32_t step, uint32_t works,
                                                 int from, int n, int part)
{
  const uint32_t broken = w.broken(step);
  long long sum[2] = {0, 0};
#pragma unroll 1
  for (int c = from; c < n; c += MO_GK_WORK_AHEAD) {
    work_chunks chunks;
    chunks.load<false>(w, w.pass_of(step), broken, c, n);
#pragma unroll
    for (int i = 0; i < MO_GK_WORK_AHEAD; i++) {
      const uint32_t s = chunks.spring[i], own = MO_GP_SPRING_OWN(s), other = MO_GP_SPRING_OTHER(s),
                     row = MO_GP_SPRING_ROW(s);
      /* Each spring counts at one of its ends; lanes without a mass have the largest number. */
      if (c + i >= n || own >= other || (works >> row & 1u) == 0 || (chunks.cut >> i & 1u) != 0)
        continue;
      const float4 p = w.x[w.first + own], q = w.x[w.first + other];
      const float d[3] = {p.x - q.x, p.y - q.y, p.z - q.z};
      const int16_t now = w.outputs[w.pair_row((int)row) * w.width + MO_GP_SPRING_OUTPUT(s)];
      const lane_length length = lane_length_of(lane_squared(d));
      const lane_work work =
          lane_work_of(&length, lane_rest(MO_GP_SPRING_DIAGONAL(s)), w.constants_of(s).actuation,
                       activation_of(now), activation_of(chunks.before[i]));
      const long long gain =
          __float2ll_rn(fminf(fmaxf(work.gain, 0.0f), MO_GK_WORK_MOST_M2) / MO_GK_WORK_UNIT_M2);
      sum[0] += row == 0 ? gain : 0;
      sum[1] += row == 0 ? 0 : gain;
    }
  }
#pragma unroll
  for (int i = 0; i < Forward::ROWS / Forward::PAIRS; i++) {
    const long long all = sum_lanes(sum[i]);
    if (w.lane == 0 && (works >> i & 1u) != 0)
      pair_ending(w, i).energy_m2[part] += (double)all * (double)MO_GK_WORK_UNIT_M2;
  }
}

/* At the start of a control period, when its outputs are known, and the springs have not yet
 * stored them. The springs of a pair are added in the parts that two warps have, so that the bits
 * are the same for one. */
template <class Forward>
static __device__ __forceinline__ void add_work(const Forward &w, uint32_t step)
{
  const uint32_t works = works_of(w);
  if (works == 0 || w.own_chunks == 0)
    return;
  if (Forward::PAIRS < MO_GP_WARPS) {
    add_gains(w, step, works, 0, w.own_chunks, w.has_second());
  } else {
    const int split = (int)w.g.pair[w.warp].split;
#pragma unroll 1
    for (int part = 0; part < 2; part++)
      add_gains(w, step, works, part == 0 ? 0 : split, part == 0 ? split : w.own_chunks, part);
  }
}

#endif
