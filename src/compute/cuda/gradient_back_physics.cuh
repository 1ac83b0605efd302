/* gradient_back_physics.cuh: the way back through a step's contact, springs and sensors, for the warp that has the two bodies. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_BACK_PHYSICS_CUH
#define MORPHO_COMPUTE_CUDA_GRADIENT_BACK_PHYSICS_CUH

#include "compute/cuda/gradient_back.cuh"

/* ∂loss/∂ the final state. */
template <int MT> __device__ __forceinline__ void back<MT>::start()
{
  int from = first;
#pragma unroll
  for (int r = 0; r < MT; r++) {
    const int n = own_masses(r);
    const mo_gp_row &own = k.rows[first_row + warp + 16 * r];
    const mo_gk_result &end = k.results[first_row + warp + 16 * r];
    const double dx = end.com_end[0] - own.light_m[0], dy = end.com_end[1] - own.light_m[1];
    const double far = sqrt(dx * dx + dy * dy);
    const double scale = far > 0 && !excluded[r] && n > 0 ? 1.0 / (far * own.start_m * n) : 0.0;
    for (int m = lane; m < n; m += 32) {
      float *p = gx + 3 * (from + m);
      p[0] = (float)(dx * scale);
      p[1] = (float)(dy * scale);
      p[2] = 0;
      mass[from + m].z_gx.y = 0;
      mass[from + m].gyz = make_float2(0, 0);
    }
    from += n;
  }
}

/* Measures the adjoint of the state after `step` steps, says by what to scale it. */
template <int MT> __device__ __forceinline__ float back<MT>::clip(int r, int from)
{
  const int n = own_masses(r);
  double sum_x = 0, sum_v = 0;
  for (int i = lane; i < 3 * n; i += 32) {
    const double a = gx[3 * from + i];
    sum_x += a * a;
  }
  for (int m = lane; m < n; m += 32) {
    const double a = mass[from + m].z_gx.y;
    const float2 yz = mass[from + m].gyz;
    const double b = yz.x, c = yz.y;
    sum_v += a * a + (b * b + c * c);
  }
  sum_x = sum_lanes(sum_x);
  sum_v = sum_lanes(sum_v);
  if (excluded[r] || n == 0)
    return 0;
  back_row &own = result[warp + 16 * r]; /* all lanes have the same to write: the first does */
  const double m = own.start_m * fmax(sqrt(sum_x), MO_ADJOINT_RATE_PER_S * sqrt(sum_v));
  const bool bad = !(sum_x < 1e300) || !(sum_v < 1e300) || failed[warp + 16 * r];
  const bool scaled = !bad && k.bound > 0 && m > k.bound;
  __syncwarp();
  if (lane == 0) {
    own.steps++;
    own.clipped += scaled;
    if (bad)
      own.zeroed = 1;
    else
      own.largest = fmax(own.largest, m);
  }
  if (bad) {
    excluded[r] = true;
    return 0;
  }
  if (scaled)
    return (float)(k.bound / m);
  return 1;
}

template <int MT> __device__ __forceinline__ void back<MT>::move_back(uint32_t step)
{
  const int n = n0 + n1;
  const float *velocity = (const float *)(tape + velocity_at) + (size_t)step * 3 * n_masses + first;
  const float scale[2] = {clip(0, first), MT > 1 ? clip(MT - 1, first + n0) : 0.0f};
  __syncwarp();
  for (int m = lane; m < n; m += 32) {
    const bool second = m >= n0;
    const lane_row &own = rows[warp + (second ? 16 : 0)];
    const int at = 3 * (first + m);
    const back_mass own_mass = mass[first + m];
    float dp[3] = {0, 0, 0}, dv[3] = {0, 0, 0};
    const float s = second ? scale[1] : scale[0];
    if (s > 0) {
      const float p[3] = {own_mass.xy.x, own_mass.xy.y, own_mass.z_gx.x};
      const float v[3] = {__ldg(velocity + m), __ldg(velocity + n_masses + m), __ldg(velocity + 2 * n_masses + m)};
      dv[0] = s * own_mass.z_gx.y;
      dv[1] = s * own_mass.gyz.x;
      dv[2] = s * own_mass.gyz.y;
      for (int axis = 0; axis < 3; axis++)
        dp[axis] = s * gx[at + axis];
      mo_move_back(&k.physics, own.heights, own.highest, p, v, dp, dv);
    }
    for (int axis = 0; axis < 3; axis++)
      gx[at + axis] = dp[axis];
    mass[first + m].z_gx.y = dv[0];
    mass[first + m].gyz = make_float2(dv[1], dv[2]);
  }
  __syncwarp();
}

/* As on the way forward. ∂loss/∂ a spring's output goes to its place from one of its ends. */
template <int MT> __device__ __forceinline__ void back<MT>::springs_back(uint32_t step)
{
  enum { N = MO_GK_SPRINGS_AHEAD };
  const int16_t *kept = (const int16_t *)(tape + activation_at) + (size_t)step * n_chunks * 32 + chunk_at;
  const int n = own_chunks;
  if (n == 0)
    return;
  uint32_t ahead[N];
  int16_t kept_ahead[N];
#pragma unroll
  for (int i = 0; i < N; i++) {
    ahead[i] = __ldg(list + 32 * i);
    kept_ahead[i] = __ldg(kept + 32 * i);
  }
  uint32_t s = ahead[0], own = MO_GP_SPRING_OWN(s);
  back_mass other = mass[first + MO_GP_SPRING_OTHER(s)], here = mass[first + (own == MO_GP_NO_MASS ? 0 : own)];
  float sum[3] = {0, 0, 0};
  for (int c = 0;; c += N) {
    const uint32_t *far = list + 32 * (c + N);
    const int16_t *kept_far = kept + 32 * (c + N);
#pragma unroll
    for (int i = 0; i < N; i++) {
      const uint32_t next = c + i + 1 < n ? ahead[(i + 1) % N] : s;
      const back_mass next_other = mass[first + MO_GP_SPRING_OTHER(next)];
      const float a = (float)kept_ahead[i] * (1.0f / 32767.0f);
      ahead[i] = __ldg(far + 32 * i);
      kept_ahead[i] = __ldg(kept_far + 32 * i);
      const float d[3] = {here.xy.x - other.xy.x, here.xy.y - other.xy.y, here.z_gx.x - other.z_gx.x};
      const float across[3] = {other.z_gx.y - here.z_gx.y, other.gyz.x - here.gyz.x, other.gyz.y - here.gyz.y};
      const float rest = MO_GP_SPRING_DIAGONAL(s) ? (float)(MO_VOXEL_M * 1.41421356237309504880) : (float)MO_VOXEL_M;
      float dd[3];
      const float d_sum = mo_spring_pull_back(&k.physics, rest, a, d, across, dd) * fmaf(-a, a, 1.0f);
      for (int axis = 0; axis < 3; axis++)
        sum[axis] += dd[axis];
      if (own < MO_GP_SPRING_OTHER(s)) {
        const int row = warp + 16 * (int)MO_GP_SPRING_ROW(s);
        if (!(fabsf(d_sum) <= MO_GK_LARGE))
          atomicOr(failed + row, 1);
        outputs[row * width + MO_GP_SPRING_OUTPUT(s)] = __float2bfloat16_rn(d_sum);
      }
      if (s & MO_GP_SPRING_LAST) {
        if (own != MO_GP_NO_MASS)
          for (int axis = 0; axis < 3; axis++)
            gx[3 * (first + own) + axis] += sum[axis];
        own = MO_GP_SPRING_OWN(next);
        here = mass[first + (own == MO_GP_NO_MASS ? 0 : own)];
        sum[0] = sum[1] = sum[2] = 0;
      }
      if (c + i + 1 == n) {
        __syncwarp();
        return;
      }
      s = next;
      other = next_other;
    }
  }
}

template <int MT> __device__ __forceinline__ void back<MT>::sense_back()
{
  int from = 0;
#pragma unroll
  for (int r = 0; r < MT; r++) {
    const int row = warp + 16 * r, n = own_masses(r);
    const lane_row &own = rows[row];
    float d[8], sum = 0;
#pragma unroll
    for (int j = 0; j < 8; j++) {
      const int m = lane + 32 * j;
      d[j] = m < n ? __bfloat162float(left[row * MO_GK_ROW + __ldg(input + from + m)]) : 0.0f;
      sum += d[j];
    }
    const float mean = sum_lanes(sum) / (float)max(n, 1);
#pragma unroll
    for (int j = 0; j < 8; j++) {
      const int m = lane + 32 * j;
      if (m < n) {
        const int at = 3 * (first + from + m);
        back_mass &own_mass = mass[first + from + m];
        const float2 z_gx = own_mass.z_gx, gyz = own_mass.gyz;
        const float away[3] = {own_mass.xy.x - own.light[0], own_mass.xy.y - own.light[1], z_gx.x - own.light[2]};
        const float push = (d[j] - mean) * mo_light_slope(&k.physics, away);
        for (int axis = 0; axis < 3; axis++)
          gx[at + axis] = fmaf(push, away[axis], gx[at + axis]);
        own_mass.z_gx.y = z_gx.y * k.physics.keep;
        own_mass.gyz = make_float2(gyz.x * k.physics.keep, gyz.y * k.physics.keep);
      }
    }
    from += n;
  }
  __syncwarp();
}

#endif
