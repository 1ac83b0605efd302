/* gradient_back.cu: the way back through physics, sensors and network, from a launch's last step to its first. Leaves ∂loss/∂ what each layer
 * sums for the products that give the parameters' gradient. A row whose adjoint is not finite becomes zeros from there on and is reported; the
 * host then walks back again without it, so that nothing of it is left in the sums. */
#include "compute/cuda/gradient_back.cuh"
#include "compute/cuda/gradient_back_physics.cuh"

/* ∂loss/∂ outputs to global memory, and their sums over rows: each thread has the same columns at every step. */
template <int MT> __device__ __forceinline__ void back<MT>::keep_outputs(uint32_t step, float2 (&bias)[2])
{
  const int words = n_outputs * 8;
  __nv_bfloat162 *to = (__nv_bfloat162 *)(tape + output_at) + (size_t)step * ROWS * words;
#pragma unroll
  for (int half = 0; half < 2; half++) {
    const int at = (int)threadIdx.x + half * MO_GK_THREADS;
    if (at >= words)
      continue;
#pragma unroll 8
    for (int row = 0; row < ROWS; row++) {
      const __nv_bfloat162 d = *(const __nv_bfloat162 *)(outputs + row * width + 2 * at);
      const float2 f = __bfloat1622float2(d);
      to[row * words + at] = d;
      bias[half].x += f.x;
      bias[half].y += f.y;
    }
  }
}

template <int MT>
__device__ __forceinline__ void back<MT>::load_normal(int layer, uint32_t step, __half2 (&n)[MT][2][2],
                                                      float (&factor)[MT][2])
{
  const int column = warp * 16 + 4 * (lane & 3);
  const uint2 *normal = (const uint2 *)(tape + normal_at + layer * layer_bytes) + (size_t)step * ROWS * (MO_HIDDEN / 4);
  const float *scale = (const float *)(tape + scale_at) + ((size_t)step * MO_HIDDEN_LAYERS + layer) * ROWS;
#pragma unroll
  for (int m = 0; m < MT; m++)
#pragma unroll
    for (int h = 0; h < 2; h++) {
      const int row = m * 16 + h * 8 + (lane >> 2);
      factor[m][h] = __ldg(scale + row);
      const uint2 two = __ldcg(normal + row * (MO_HIDDEN / 4) + (column >> 2));
      n[m][h][0] = *(const __half2 *)&two.x;
      n[m][h][1] = *(const __half2 *)&two.y;
    }
}

/* sums: ∂loss/∂ what ReLU gave. Leaves ∂loss/∂ what the layer summed in `left`, and on the tape where n was. */
template <int MT>
__device__ __forceinline__ void back<MT>::norm_relu_back(int layer, uint32_t step, warp_sums<MT> &sums,
                                                         const __half2 (&n)[MT][2][2], const float (&factors)[MT][2],
                                                         const norm_columns &columns)
{
  const int column = warp * 16 + 4 * (lane & 3);
  uint2 *dense = (uint2 *)(tape + normal_at + layer * layer_bytes) + (size_t)step * ROWS * (MO_HIDDEN / 4);
  float2 s[MT][2];
  float *bias = norms + layer * 3 * MO_HIDDEN + column, *gain_sum = bias + MO_HIDDEN, *shift_sum = gain_sum + MO_HIDDEN;
#pragma unroll
  for (int m = 0; m < MT; m++)
#pragma unroll
    for (int h = 0; h < 2; h++)
      s[m][h] = make_float2(0, 0);
#pragma unroll
  for (int j = 0; j < 2; j++) {
    const float2 gain = columns.gain[j], shift = columns.shift[j];
    float2 d_shift = {0, 0}, d_gain = {0, 0};
#pragma unroll
    for (int m = 0; m < MT; m++)
#pragma unroll
      for (int h = 0; h < 2; h++) {
        const float2 at = __half22float2(n[m][h][j]);
        const float d0 = fmaf(at.x, gain.x, shift.x) > 0 ? sums.c[m][j][2 * h] : 0.0f;
        const float d1 = fmaf(at.y, gain.y, shift.y) > 0 ? sums.c[m][j][2 * h + 1] : 0.0f;
        d_shift.x += d0;
        d_shift.y += d1;
        d_gain.x = fmaf(d0, at.x, d_gain.x);
        d_gain.y = fmaf(d1, at.y, d_gain.y);
        const float e0 = d0 * gain.x, e1 = d1 * gain.y;
        sums.c[m][j][2 * h] = e0;
        sums.c[m][j][2 * h + 1] = e1;
        s[m][h].x += e0 + e1;
        s[m][h].y += fmaf(e0, at.x, e1 * at.y);
      }
    add_columns(shift_sum + 2 * j, d_shift.x);
    add_columns(shift_sum + 2 * j + 1, d_shift.y);
    add_columns(gain_sum + 2 * j, d_gain.x);
    add_columns(gain_sum + 2 * j + 1, d_gain.y);
  }
  sum_rows<MT>(part, warp, lane, s);
  float2 d_bias[2] = {{0, 0}, {0, 0}};
#pragma unroll
  for (int m = 0; m < MT; m++)
#pragma unroll
    for (int h = 0; h < 2; h++) {
      const int row = m * 16 + h * 8 + (lane >> 2);
      const float factor = factors[m][h], mean = s[m][h].x * (1.0f / MO_HIDDEN), along = s[m][h].y * (1.0f / MO_HIDDEN);
      float2 d[2];
#pragma unroll
      for (int j = 0; j < 2; j++) {
        const float2 at = __half22float2(n[m][h][j]);
        d[j] = make_float2(factor * (sums.c[m][j][2 * h] - fmaf(at.x, along, mean)),
                           factor * (sums.c[m][j][2 * h + 1] - fmaf(at.y, along, mean)));
        if (!(fabsf(d[j].x) <= MO_GK_LARGE) || !(fabsf(d[j].y) <= MO_GK_LARGE))
          atomicOr(failed + row, 1);
        d_bias[j].x += d[j].x;
        d_bias[j].y += d[j].y;
      }
      const uint2 both = four(__float22bfloat162_rn(d[0]), __float22bfloat162_rn(d[1]));
      *(uint2 *)(left + row * MO_GK_ROW + column) = both;
      dense[row * (MO_HIDDEN / 4) + (column >> 2)] = both;
    }
#pragma unroll
  for (int j = 0; j < 2; j++) {
    add_columns(bias + 2 * j, d_bias[j].x);
    add_columns(bias + 2 * j + 1, d_bias[j].y);
  }
  __syncthreads();
}

/* Where the tiles are is known a round before they are asked for, so that nothing keeps a load from its place (see add_tiles). */
template <int MT>
__device__ __forceinline__ void back<MT>::add_last(warp_sums<MT> &sums, weights_ahead<MO_GK_AHEAD_BACK> &ahead)
{
  enum { N = MO_GK_AHEAD_BACK };
  const uint32_t left_at = left_address(outputs, width * 2, lane);
  const uint4 *hidden = hidden_tiles(2), *last = k.weights.back[3] + (uint32_t)warp * MO_GP_OUTPUT_TILES * 32 + lane;
  const int before = lead();
  int at = -before;
  uint32_t next[N];
#pragma unroll
  for (int i = 0; i < N; i++)
    next[i] = output_tile[max(at + N + i, 0)] * 32u;
  if (before > 0) {
#pragma unroll
    for (int i = 0; i < N; i++) {
      if (i >= before)
        add_tile<MT, true>(sums, left_at + (uint32_t)(at + i) * 32, width * 2, ahead.w[i]);
      ahead.w[i] = load_weights(at + N < n_outputs ? last + next[i] : hidden + i * 32);
      next[i] = output_tile[at + 2 * N + i] * 32u;
    }
    at += N;
  }
#pragma unroll 1
  for (; at + N < n_outputs; at += N) {
#pragma unroll
    for (int i = 0; i < N; i++) {
      add_tile<MT, true>(sums, left_at + (uint32_t)(at + i) * 32, width * 2, ahead.w[i]);
      ahead.w[i] = load_weights(last + next[i]);
      next[i] = output_tile[at + 2 * N + i] * 32u; /* beyond the last: not used */
    }
  }
  if (at < n_outputs) {
#pragma unroll
    for (int i = 0; i < N; i++) {
      add_tile<MT, true>(sums, left_at + (uint32_t)(at + i) * 32, width * 2, ahead.w[i]);
      ahead.w[i] = load_weights(hidden + i * 32);
    }
  }
}

/* `ahead` has the last layer's first weights. */
template <int MT>
__device__ __forceinline__ void back<MT>::control_back(uint32_t step, weights_ahead<MO_GK_AHEAD_BACK> &ahead)
{
  const uint32_t left_at = left_address(left, MO_GK_ROW * 2, lane);
  const int column = warp * 16 + 4 * (lane & 3);
  __half2 n[MT][2][2];
  float factors[MT][2];
  warp_sums<MT> sums;
  norm_columns columns;
  sums.clear();
  add_last(sums, ahead);
  columns.load(k.weights, 2, column);
  load_normal(2, step, n, factors);
  norm_relu_back(2, step, sums, n, factors, columns);
#pragma unroll 1
  for (int layer = 2; layer > 0; layer--) {
    columns.load(k.weights, layer - 1, column);
    load_normal(layer - 1, step, n, factors);
    sums.clear();
    add_tiles<MT, true, true>(sums, ahead, left_at, MO_GK_ROW * 2, hidden_tiles(layer), hidden_tiles(layer - 1));
    norm_relu_back(layer - 1, step, sums, n, factors, columns);
  }
  sums.clear();
  add_tiles<MT, true, false>(sums, ahead, left_at, MO_GK_ROW * 2, hidden_tiles(0), nullptr);
  __syncthreads();
#pragma unroll
  for (int m = 0; m < MT; m++)
#pragma unroll
    for (int h = 0; h < 2; h++)
      *(uint2 *)(left + (m * 16 + h * 8 + (lane >> 2)) * MO_GK_ROW + column) =
          four(__floats2bfloat162_rn(sums.c[m][0][2 * h], sums.c[m][0][2 * h + 1]),
               __floats2bfloat162_rn(sums.c[m][1][2 * h], sums.c[m][1][2 * h + 1]));
  __syncthreads();
}

/* What the step before this one will read. */
template <int MT> __device__ __forceinline__ void back<MT>::fetch_step(uint32_t step)
{
  fetch(tape + position_at + (size_t)step * n_masses * 12, (size_t)n_masses * 12);
  fetch(tape + velocity_at + (size_t)step * n_masses * 12, (size_t)n_masses * 12);
  fetch(tape + activation_at + (size_t)step * n_chunks * 64, (size_t)n_chunks * 64);
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++)
    fetch(tape + normal_at + l * layer_bytes + (size_t)step * ROWS * MO_HIDDEN * 2, ROWS * MO_HIDDEN * 2);
}

template <int MT> __device__ __forceinline__ void back<MT>::run()
{
  const int n = 3 * (n0 + n1);
  const uint64_t state = 3 * (g.first_mass + first);
  float *own_gx = gx + 3 * first;
  const bool is_first = end_step == k.n_steps;
  for (uint32_t i = threadIdx.x; i < ROWS * width / 2; i += MO_GK_THREADS)
    ((uint32_t *)outputs)[i] = 0;
  for (int i = threadIdx.x; i < 9 * MO_HIDDEN; i += MO_GK_THREADS)
    norms[i] = 0;
  if (threadIdx.x < ROWS)
    failed[threadIdx.x] = 0;
#pragma unroll
  for (int r = 0; r < MT; r++) {
    const mo_gk_result &before = k.results[first_row + warp + 16 * r];
    excluded[r] = before.diverged || before.excluded || before.zeroed;
    if (lane == 0) {
      const back_row now = {
          k.rows[first_row + warp + 16 * r].start_m, before.largest, before.steps, before.clipped, before.zeroed, 0};
      result[warp + 16 * r] = now;
    }
  }
  __syncthreads();
  if (is_first)
    start();
  else
    for (int i = lane; i < n; i += 32) {
      own_gx[i] = k.position[state + i];
      ((float *)(mass + first + i / 3))[3 + i % 3] = k.velocity[state + i];
    }
  __syncwarp();
  float2 bias[2] = {{0, 0}, {0, 0}};
  for (uint32_t step = end_step; step-- > first_step;) {
    const float *kept = (const float *)(tape + position_at) + (size_t)step * 3 * n_masses + first;
    for (int m = lane; m < n0 + n1; m += 32) {
      mass[first + m].xy = make_float2(__ldg(kept + m), __ldg(kept + n_masses + m));
      mass[first + m].z_gx.x = __ldg(kept + 2 * n_masses + m);
    }
    if (step > 0)
      fetch_step(step - 1);
    __syncwarp();
    move_back(step);
    springs_back(step);
    weights_ahead<MO_GK_AHEAD_BACK> ahead;
    start_ahead(ahead);
    __syncthreads();
    keep_outputs(step, bias);
    control_back(step, ahead);
    sense_back();
  }
  for (int i = lane; i < n; i += 32) {
    k.position[state + i] = own_gx[i];
    k.velocity[state + i] = ((const float *)(mass + first + i / 3))[3 + i % 3];
  }
  __syncthreads();
#pragma unroll
  for (int r = 0; r < MT; r++)
    if (lane == 0) {
      const int row = warp + 16 * r;
      mo_gk_result &after = k.results[first_row + row];
      after.largest = result[row].largest;
      after.steps = result[row].steps;
      after.clipped = result[row].clipped;
      after.zeroed = result[row].zeroed || (failed[row] && !excluded[r]);
    }
  const mo_gp_sum place = mo_gp_sum_of(&g);
  float *sums = k.sums + g.sum_at;
  __syncthreads();
  for (int i = threadIdx.x; i < 9 * MO_HIDDEN; i += MO_GK_THREADS)
    sums[place.bias[0] + i] = norms[i] + (is_first ? 0.0f : sums[place.bias[0] + i]);
#pragma unroll
  for (int half = 0; half < 2; half++) {
    const int at = (int)threadIdx.x + half * MO_GK_THREADS;
    if (at < (int)g.n_outputs * 8) {
      float2 *to = (float2 *)(sums + place.output_bias) + at;
      const float2 before = is_first ? make_float2(0, 0) : *to;
      *to = make_float2(before.x + bias[half].x, before.y + bias[half].y);
    }
  }
}

static __global__ void __launch_bounds__(MO_GK_THREADS, 1) back_kernel(const __grid_constant__ mo_gk k)
{
  extern __shared__ __align__(16) unsigned char shared[];
  mo_gk_task task;
  if (!take_task(k, (uint32_t *)shared, &task))
    return;
  const mo_gp_group &g = k.groups[task.group];
  if (g.n_rows == 32)
    back<2>(k, g, shared, task.part).run();
  else
    back<1>(k, g, shared, task.part).run();
  end_task(k, task);
}

extern "C" int mo_gk_open_back(uint32_t block_bytes, uint32_t *dynamic_bytes)
{
  return allow_shared(back_kernel, block_bytes, dynamic_bytes);
}

extern "C" int mo_gk_back(const struct mo_gk *k, uint32_t shared_bytes, void *stream)
{
  const uint32_t blocks = (k->n_steps + k->part_steps - 1) / k->part_steps * k->n_groups;
  back_kernel<<<blocks, MO_GK_THREADS, shared_bytes, (cudaStream_t)stream>>>(*k);
  return (int)cudaGetLastError();
}
