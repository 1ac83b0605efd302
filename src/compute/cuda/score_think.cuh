/* score_think.cuh: sensing and acting for both kernels: from positions to the first layer's inputs,
 * and from the last layer's sums to lengths. */
#ifndef MORPHO_COMPUTE_CUDA_SCORE_THINK_CUH
#define MORPHO_COMPUTE_CUDA_SCORE_THINK_CUH

#include "compute/cuda/score_group.cuh"

namespace {

__device__ __forceinline__ float light_at(mo_sensor sensor, const float *p, const float4 &light)
{
  const float d[3] = {p[0] - light.x, p[1] - light.y, p[2] - light.z};
  return lane_light(sensor, lane_squared(d));
}

/* Handles two rows per warp, with sixteen lanes each (bit 3 of the lane selects the row). A lane
 * computes the light at every sixteenth mass, and keeps it until the row's mean is known. Without
 * THINKS, it only finds the center of mass. */
template <bool THINKS>
__device__ __forceinline__ void sense(const mo_cuda_score &score, Shared &shared, mo_sensor sensor,
                                      const float *position, const mo_cuda_activations &x,
                                      uint32_t step)
{
  constexpr int kMost = (MO_DEFAULT_MASSES + 63) / 64 * 4;
  const uint32_t lane = threadIdx.x & 31, warp = threadIdx.x >> 5,
                 own = (lane & 7) | (lane >> 4) << 3;
  for (uint32_t pair = warp; 2 * pair < shared.plan.n_rows; pair += MO_CUDA_WARPS) {
    const uint32_t r = 2 * pair + (lane >> 3 & 1);
    const bool used = r < shared.plan.n_rows; /* if not, its place gets a copy of the other row */
    const Row row = shared.rows[used ? r : 2 * pair];
    const float4 light = shared.light[used ? r : 2 * pair];
    const uint4 inputs = THINKS ? __ldg(reinterpret_cast<const uint4 *>(
                                            score.inputs + (size_t)row.body * MO_PLAN_INPUTS) +
                                        own)
                                : make_uint4(0, 0, 0, 0);
    const uint32_t input[4] = {inputs.x, inputs.y, inputs.z, inputs.w};
    const uint32_t most = max(row.n_masses, __shfl_xor_sync(kAll, row.n_masses, 8));
    if (THINKS)
      mo_cuda_clear_row(x, r, own);
    /* Four masses at a time, without a branch: missing ones count as 0. */
    float sum[4] = {0.0f, 0.0f, 0.0f, 0.0f}, value[kMost];
#pragma unroll
    for (int first = 0; first < kMost; first += 4) {
      if (16 * first >= most)
        break;
#pragma unroll
      for (int i = first; i < first + 4; i++) {
        const uint32_t m = min(own + 16 * i, row.n_masses - 1);
        const float weight = own + 16 * i < row.n_masses ? 1.0f : 0.0f;
        const float *p = position + 3 * (row.first_place + m * row.stride);
        for (int axis = 0; axis < 3; axis++)
          sum[axis] = fmaf(weight, p[axis], sum[axis]);
        if (THINKS) {
          value[i] = light_at(sensor, p, light);
          sum[3] = fmaf(weight, value[i], sum[3]);
        }
      }
    }
#pragma unroll
    for (int k = 0; k < (THINKS ? 4 : 3); k++) {
      sum[k] += __shfl_xor_sync(kAll, sum[k], 1);
      sum[k] += __shfl_xor_sync(kAll, sum[k], 2);
      sum[k] += __shfl_xor_sync(kAll, sum[k], 4);
      sum[k] += __shfl_xor_sync(kAll, sum[k], 16);
    }
    const float n = (float)row.n_masses;
    if (used && own < 3)
      shared.com[step & 1][r][own] = __fdividef(own == 0 ? sum[0] : own == 1 ? sum[1] : sum[2], n);
    if (!THINKS)
      continue;
    const float mean = __fdividef(sum[3], n);
    __syncwarp(); /* the zeros have been written */
#pragma unroll
    for (int i = 0; i < kMost; i++) {
      if (16 * i >= most)
        break;
      if (own + 16 * i < row.n_masses)
        mo_cuda_put_input(x, r, input[i / 4] >> i % 4 * 8 & 0xffu, value[i] - mean);
    }
  }
}

/* The initial value of the first layer's sum for this thread's output, from bias and generators.
 * Loaded before sensing, computed after it. */
struct Start {
  float bias, generator[MO_CPG_INPUTS], weight[MO_CPG_INPUTS];
};

__device__ __forceinline__ Start load_start(const mo_cuda_score &score, uint32_t step)
{
  const uint32_t o = threadIdx.x;
  Start start;
  start.bias = __ldg(reinterpret_cast<const float *>(score.weights + score.layout.bias[0]) + o);
#pragma unroll
  for (int i = 0; i < MO_CPG_INPUTS; i++) {
    start.generator[i] = __ldg(score.generators + (size_t)step * MO_CPG_INPUTS + i);
    start.weight[i] =
        __ldg(reinterpret_cast<const float *>(score.weights + score.layout.generators) +
              i * MO_HIDDEN + o);
  }
  return start;
}

__device__ __forceinline__ float start_of_first_layer(const Start &start)
{
  float sum = start.bias;
#pragma unroll
  for (int i = 0; i < MO_CPG_INPUTS; i++)
    sum = fmaf(start.generator[i], start.weight[i], sum);
  return sum;
}

/* The inputs of a hidden layer. */
struct Layer {
  const char *matrix;
  const float *start; /* initial values of its sums */
  const float *gain, *shift;
  float epsilon;
};

__device__ __forceinline__ Layer layer_of(const mo_cuda_score &score, const Shared &shared, int l)
{
  Layer layer;
  layer.matrix = score.weights + score.layout.hidden[l];
  layer.start =
      l == 0 ? shared.first : reinterpret_cast<const float *>(score.weights + score.layout.bias[l]);
  layer.gain = reinterpret_cast<const float *>(score.weights + score.layout.gain[l]);
  layer.shift = reinterpret_cast<const float *>(score.weights + score.layout.shift[l]);
  layer.epsilon = shared.scalars.epsilon[l];
  return layer;
}

/* The inputs of the last layer, and the destination of its lengths. */
struct Output {
  const char *matrix;
  const float2 *bias;
  float scale;
  const float *actuation; /* of each row */
  const Home *homes;
  const mo_plan_pairs *pairs;
  float *lengths;
};

/* The place of a row's length of a pair's first spring; kNowhere if the row's body lacks the
 * pair. */
constexpr uint32_t kNowhere = UINT32_MAX;

__device__ __forceinline__ uint32_t length_of(const mo_plan_pairs *pairs, const Home &home,
                                              uint32_t pair)
{
  const uint32_t word = pairs[home.part].has[pair / 32],
                 before = pairs[home.part].before[pair / 32];
  const uint32_t bit = 1u << pair % 32;
  const uint32_t slot = 2 * (before + (uint32_t)__popc((int)(word & (bit - 1))));
  return (word & bit) != 0 ? home.first_length + slot * home.stride : kNowhere;
}

/* Stores the lengths of a pair's springs in rows 2t and 2t + 1 of a column. */
__device__ __forceinline__ void put_lengths(const Output &output, const Home (&home)[2],
                                            uint32_t pair, const float (&wanted)[4])
{
  const uint32_t first = length_of(output.pairs, home[0], pair);
  uint32_t second = first + (first != kNowhere ? 1 : 0);
  if (home[1].part != home[0].part) /* rare */
    second = length_of(output.pairs, home[1], pair);
  if (first != kNowhere) {
    output.lengths[first] = wanted[0];
    output.lengths[first + home[0].stride] = wanted[2];
  }
  if (second != kNowhere) {
    output.lengths[second] = wanted[1];
    output.lengths[second + home[1].stride] = wanted[3];
  }
}

__device__ __forceinline__ Output output_of(const mo_cuda_score &score, const Shared &shared,
                                            const Memory &memory)
{
  return Output{score.weights + score.layout.output,
                reinterpret_cast<const float2 *>(score.weights + score.layout.output_bias),
                shared.scalars.output,
                shared.actuation,
                shared.homes,
                memory.pairs,
                memory.lengths};
}

/* Converts a pair's sums in rows 2t and 2t + 1 of a column, the first of which is `row`, to
 * lengths. */
__device__ __forceinline__ void put_sums(const Output &output, const Home (&home)[2], uint32_t row,
                                         uint32_t pair, const float2 &bias, const float (&sum)[4])
{
  const float rest = lane_rest(2 * pair >= MO_PLAN_EDGES);
  const float2 actuation = *reinterpret_cast<const float2 *>(output.actuation + row);
  float wanted[4];
#pragma unroll
  for (int k = 0; k < 4; k++)
    wanted[k] = lane_wanted(rest, k % 2 == 0 ? actuation.x : actuation.y,
                            mo_cuda_tanh(fmaf(sum[k], output.scale, k < 2 ? bias.x : bias.y)));
  put_lengths(output, home, pair, wanted);
}

} // namespace

#endif
