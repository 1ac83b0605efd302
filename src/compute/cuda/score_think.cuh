/* score_think.cuh: from positions to the lengths that springs want to have: sensors, hidden layers, the last layer. */
#ifndef MORPHO_COMPUTE_CUDA_SCORE_THINK_CUH
#define MORPHO_COMPUTE_CUDA_SCORE_THINK_CUH

#include "compute/cuda/score_group.cuh"

namespace {

__device__ __forceinline__ float light_at(mo_sensor sensor, const float *p, const float4 &light)
{
  const float dx = p[0] - light.x, dy = p[1] - light.y, dz = p[2] - light.z;
  return mo_cuda_light(sensor, fmaf(dx, dx, fmaf(dy, dy, dz * dz)));
}

/* Two rows per warp, sixteen lanes each: lane bits 0 … 2 are a pair of inputs, bit 3 the row, bit 4 the tile. */
template <bool EXACT>
__device__ void sense(const mo_cuda_score &score, Shared &shared, mo_sensor sensor, const float *position, char *x,
                      uint32_t step)
{
  const uint32_t lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
  const uint32_t g = lane & 7, tile_bit = lane >> 4, own = g | tile_bit << 3;
  for (uint32_t pair = warp; 2 * pair < shared.plan.n_rows; pair += MO_CUDA_WARPS) {
    const uint32_t r = 2 * pair + (lane >> 3 & 1);
    const bool used = r < shared.plan.n_rows;
    const Row row = shared.rows[used ? r : 2 * pair];
    const float4 light = shared.light[used ? r : 2 * pair];
    float sum[4] = {0.0f, 0.0f, 0.0f, 0.0f};
    for (uint32_t m = own; m < row.n_masses; m += 16) {
      const float *p = position + 3 * (row.first_place + m * row.stride);
      for (int axis = 0; axis < 3; axis++)
        sum[axis] += p[axis];
      sum[3] += light_at(sensor, p, light);
    }
#pragma unroll
    for (int k = 0; k < 4; k++) {
      sum[k] += __shfl_xor_sync(kAll, sum[k], 1);
      sum[k] += __shfl_xor_sync(kAll, sum[k], 2);
      sum[k] += __shfl_xor_sync(kAll, sum[k], 4);
      sum[k] += __shfl_xor_sync(kAll, sum[k], 16);
    }
    const float n = (float)row.n_masses;
    if (used && own < 3)
      shared.com[step & 1][r][own] = __fdividef(own == 0 ? sum[0] : own == 1 ? sum[1] : sum[2], n);
    if (!used || score.weights == nullptr)
      continue;
    const float mean = __fdividef(sum[3], n);
    const uint4 inputs = __ldg(reinterpret_cast<const uint4 *>(score.inputs + (size_t)row.body * MO_PLAN_INPUTS) + own);
    const uint32_t listed[4] = {inputs.x, inputs.y, inputs.z, inputs.w};
    char *column = x + (r >> 3) * mo_cuda_network<EXACT>::COLUMN_BYTES;
#pragma unroll
    for (uint32_t two = 0; two < MO_WEIGHTS_TILES / 2; two++) {
      const uint32_t tile = 2 * two + tile_bit;
      if ((shared.input_units >> (EXACT ? tile : two) & 1u) == 0)
        continue;
      float value[2];
#pragma unroll
      for (uint32_t e = 0; e < 2; e++) {
        const uint32_t m = listed[two / 2] >> (two % 2 * 16 + e * 8) & 0xffu;
        value[e] = 0.0f;
        if (m != MO_PLAN_NONE)
          value[e] = light_at(sensor, position + 3 * (row.first_place + m * row.stride), light) - mean;
      }
      mo_cuda_store_pair<EXACT>(column + mo_cuda_place<EXACT>(r & 7, tile, g), value[0], value[1]);
    }
  }
}

/* What the first layer's sums start from: bias and generators. */
__device__ __forceinline__ void begin_first_layer(const mo_cuda_score &score, Shared &shared, uint32_t step)
{
  const uint32_t o = threadIdx.x;
  const float *generators = score.generators + (size_t)step * MO_CPG_INPUTS;
  const float *weights = reinterpret_cast<const float *>(score.weights + score.layout.generators) + o;
  float sum = __ldg(reinterpret_cast<const float *>(score.weights + score.layout.bias[0]) + o);
#pragma unroll
  for (int i = 0; i < MO_CPG_INPUTS; i++)
    sum = fmaf(__ldg(generators + i), __ldg(weights + i * MO_HIDDEN), sum);
  shared.first[o] = sum;
}

/* What a hidden layer is computed from. */
struct Layer {
  const char *matrix;
  const float *start; /* what its sums start from */
  const float *gain, *shift;
  float epsilon;
  uint32_t units; /* bits: those that may not be 0 */
};

/* One hidden layer for all rows, in place. */
template <bool EXACT, int COLUMNS>
__device__ __forceinline__ void hidden_layer(const Layer &layer, float2 *partial, char *x)
{
  const uint32_t lane = threadIdx.x & 31, warp = threadIdx.x >> 5, g = lane >> 2, t = lane & 3;
  constexpr uint32_t kUnits = mo_cuda_network<EXACT>::UNITS;
  constexpr int kHalf = 8 * MO_WEIGHTS_PAIR_BYTES / 2; /* of a tile's unit */
  const char *row[2];
  uint32_t column[COLUMNS];
  float sum[2][COLUMNS][4];
#pragma unroll
  for (int c = 0; c < COLUMNS; c++)
    column[c] = c * mo_cuda_network<EXACT>::COLUMN_BYTES;
#pragma unroll
  for (int m = 0; m < 2; m++) {
    row[m] = layer.matrix + (2 * warp + m) * kUnits * 2 * kHalf + lane * MO_WEIGHTS_LOAD_BYTES;
#pragma unroll
    for (int h = 0; h < 2; h++) {
      const float from = layer.start[warp * 32 + m * 16 + h * 8 + g];
#pragma unroll
      for (int c = 0; c < COLUMNS; c++)
        sum[m][c][2 * h] = sum[m][c][2 * h + 1] = from;
    }
  }
  const char *mine = x + mo_cuda_slot(g, t);
  if (layer.units == (1u << kUnits) - 1)
    mo_cuda_product<EXACT, kHalf, 2, COLUMNS>(sum, row, mine, column);
  else
    mo_cuda_product_of<EXACT, kHalf, 2, COLUMNS>(sum, row, mine, column, layer.units);
  mo_cuda_normalize<EXACT, COLUMNS>(sum, layer.gain, layer.shift, layer.epsilon, partial, x, warp, lane);
}

template <bool EXACT>
__device__ __forceinline__ void think(const mo_cuda_score &score, Shared &shared, const mo_weights_scalars &scalars,
                                      char *x)
{
  constexpr uint32_t kUnits = mo_cuda_network<EXACT>::UNITS;
#pragma unroll 1
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++) {
    Layer layer;
    layer.matrix = score.weights + score.layout.hidden[l];
    layer.start = l == 0 ? shared.first : reinterpret_cast<const float *>(score.weights + score.layout.bias[l]);
    layer.gain = reinterpret_cast<const float *>(score.weights + score.layout.gain[l]);
    layer.shift = reinterpret_cast<const float *>(score.weights + score.layout.shift[l]);
    layer.epsilon = l == 0 ? scalars.epsilon[0] : l == 1 ? scalars.epsilon[1] : scalars.epsilon[2];
    layer.units = l == 0 ? shared.input_units : (1u << kUnits) - 1;
    switch ((shared.plan.n_rows + MO_PLAN_COLUMN - 1) / MO_PLAN_COLUMN) {
    case 1: hidden_layer<EXACT, 1>(layer, shared.partial, x); break;
    case 2: hidden_layer<EXACT, 2>(layer, shared.partial, x); break;
    case 3: hidden_layer<EXACT, 3>(layer, shared.partial, x); break;
    case 4: hidden_layer<EXACT, 4>(layer, shared.partial, x); break;
    default: hidden_layer<EXACT, 5>(layer, shared.partial, x);
    }
  }
}

/* A lane's pairs of springs of up to two tiles, and the columns that have any of the tiles' springs. */
struct Tiles {
  uint32_t pair[2], columns;
};

/* The round-th tiles of a warp, and how many: rounds of two tiles per warp; the last round spreads what is left. */
__device__ __forceinline__ uint32_t tiles_of(const mo_cuda_score &score, const Shared &shared, uint32_t round,
                                             Tiles *ret)
{
  const uint32_t warp = threadIdx.x >> 5, g = (threadIdx.x & 31) >> 2, n = shared.plan.n_tiles;
  const uint32_t done = round * 2 * MO_CUDA_WARPS;
  if (done >= n)
    return 0;
  const uint32_t left = n - done;
  const uint32_t twos = left >= 2 * MO_CUDA_WARPS ? MO_CUDA_WARPS : left > MO_CUDA_WARPS ? left - MO_CUDA_WARPS : 0;
  const uint32_t count = warp < twos ? 2 : warp + twos < left ? 1 : 0;
  const uint32_t first = shared.plan.first_tile + done + (warp < twos ? 2 * warp : twos + warp);
  ret->columns = 0;
#pragma unroll
  for (uint32_t m = 0; m < 2; m++)
    if (m < count) {
      ret->columns |= __ldg(score.columns + first + m);
      ret->pair[m] = __ldg(&score.tiles[first + m].pair[g]);
    }
  return count;
}

/* What the last layer is computed from, and where its lengths go. */
struct Output {
  const char *matrix;
  const float2 *bias;
  float scale, actuation;
  float *wanted;
};

/* TILES tiles of springs for the columns that have them: COLUMNS of them. */
template <bool EXACT, int TILES, int COLUMNS>
__device__ __forceinline__ void act_tiles(const Output &output, const Tiles &tiles, const char *x)
{
  const uint32_t lane = threadIdx.x & 31, g = lane >> 2, t = lane & 3;
  const char *row[TILES];
  uint32_t column[COLUMNS], columns = tiles.columns;
  float sum[TILES][COLUMNS][4];
#pragma unroll
  for (int m = 0; m < TILES; m++)
    row[m] =
        output.matrix +
        (tiles.pair[m] == MO_PLAN_NO_PAIR ? 0 : tiles.pair[m]) * mo_cuda_network<EXACT>::UNITS * MO_WEIGHTS_PAIR_BYTES +
        t * MO_WEIGHTS_LOAD_BYTES;
#pragma unroll
  for (int c = 0; c < COLUMNS; c++) {
    column[c] = (uint32_t)(__ffs((int)columns) - 1) * mo_cuda_network<EXACT>::COLUMN_BYTES;
    columns &= columns - 1;
#pragma unroll
    for (int m = 0; m < TILES; m++)
#pragma unroll
      for (int k = 0; k < 4; k++)
        sum[m][c][k] = 0.0f;
  }
  mo_cuda_product<EXACT, MO_WEIGHTS_PAIR_BYTES / 2, TILES, COLUMNS>(sum, row, x + mo_cuda_slot(g, t), column);
#pragma unroll
  for (int m = 0; m < TILES; m++) {
    const uint32_t pair = tiles.pair[m];
    if (pair == MO_PLAN_NO_PAIR)
      continue;
    const float2 bias = __ldg(output.bias + pair);
    const float rest = rest_length(2 * pair), reach = rest * output.actuation;
    float *out = output.wanted + 2 * pair * kRows + 2 * t;
#pragma unroll
    for (int c = 0; c < COLUMNS; c++) {
      const uint32_t first = column[c] / (mo_cuda_network<EXACT>::COLUMN_BYTES / MO_PLAN_COLUMN);
#pragma unroll
      for (int h = 0; h < 2; h++) {
        const float from = h == 0 ? bias.x : bias.y;
        float2 wanted;
        wanted.x = fmaf(reach, mo_cuda_tanh(fmaf(sum[m][c][2 * h], output.scale, from)), rest);
        wanted.y = fmaf(reach, mo_cuda_tanh(fmaf(sum[m][c][2 * h + 1], output.scale, from)), rest);
        *reinterpret_cast<float2 *>(out + h * kRows + first) = wanted;
      }
    }
  }
}

template <bool EXACT, int TILES>
__device__ __forceinline__ void act_tiles_of(const Output &output, const Tiles &tiles, const char *x)
{
  switch (__popc(tiles.columns)) {
  case 1: act_tiles<EXACT, TILES, 1>(output, tiles, x); break;
  case 2: act_tiles<EXACT, TILES, 2>(output, tiles, x); break;
  case 3: act_tiles<EXACT, TILES, 3>(output, tiles, x); break;
  case 4: act_tiles<EXACT, TILES, 4>(output, tiles, x); break;
  default: act_tiles<EXACT, TILES, 5>(output, tiles, x);
  }
}

/* The last layer. */
template <bool EXACT>
__device__ __forceinline__ void act(const mo_cuda_score &score, const Shared &shared, float scale, const char *x,
                                    float *wanted)
{
  const Output output = {score.weights + score.layout.output,
                         reinterpret_cast<const float2 *>(score.weights + score.layout.output_bias), scale,
                         score.constants.actuation, wanted};
  Tiles now = {}, next = {};
  uint32_t count = tiles_of(score, shared, 0, &now);
  for (uint32_t round = 1; count > 0; round++) {
    const uint32_t after = tiles_of(score, shared, round, &next);
    if (count == 2)
      act_tiles_of<EXACT, 2>(output, now, x);
    else
      act_tiles_of<EXACT, 1>(output, now, x);
    now = next;
    count = after;
  }
}

} // namespace

#endif
