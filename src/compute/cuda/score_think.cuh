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

/* Two rows per warp, sixteen lanes each (lane bit 3 is the row's). A lane computes the light at every sixteenth mass, and keeps it until the
 * row's mean is known. */
template <bool EXACT>
__device__ __forceinline__ void sense(const mo_cuda_score &score, Shared &shared, mo_sensor sensor,
                                      const float *position, char *x, uint32_t step)
{
  constexpr int kMost = (MO_DEFAULT_MASSES + 15) / 16;
  const uint32_t lane = threadIdx.x & 31, warp = threadIdx.x >> 5, own = (lane & 7) | (lane >> 4) << 3;
  for (uint32_t pair = warp; 2 * pair < shared.plan.n_rows; pair += MO_CUDA_WARPS) {
    const uint32_t r = 2 * pair + (lane >> 3 & 1);
    const bool used = r < shared.plan.n_rows; /* if not, its place takes a copy of the other row */
    const Row row = shared.rows[used ? r : 2 * pair];
    const float4 light = shared.light[used ? r : 2 * pair];
    const uint8_t *inputs = score.inputs + shared.parts[row.part].first_mass;
    const uint32_t most = max(row.n_masses, __shfl_xor_sync(kAll, row.n_masses, 8));
    char *column = x + (r >> 3) * mo_cuda_network<EXACT>::COLUMN_BYTES;
    if (score.weights != nullptr)
#pragma unroll
      for (uint32_t unit = own >> 2; unit < mo_cuda_network<EXACT>::UNITS; unit += 4)
        *reinterpret_cast<uint4 *>(column + unit * MO_CUDA_UNIT_BYTES + mo_cuda_slot(r & 7, own & 3)) =
            make_uint4(0, 0, 0, 0);
    float sum[4] = {0.0f, 0.0f, 0.0f, 0.0f}, value[kMost];
#pragma unroll
    for (int i = 0; i < kMost; i++) {
      if (16 * i >= most)
        break;
      const uint32_t m = own + 16 * i;
      if (m < row.n_masses) {
        const float *p = position + 3 * (row.first_place + m * row.stride);
        for (int axis = 0; axis < 3; axis++)
          sum[axis] += p[axis];
        value[i] = light_at(sensor, p, light);
        sum[3] += value[i];
      }
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
    if (score.weights == nullptr)
      continue;
    const float mean = __fdividef(sum[3], n);
    __syncwarp(); /* the zeros are there */
#pragma unroll
    for (int i = 0; i < kMost; i++) {
      if (16 * i >= most)
        break;
      if (own + 16 * i < row.n_masses) {
        const uint32_t input = __ldg(inputs + own + 16 * i);
        char *place = column + mo_cuda_place<EXACT>(r & 7, input >> 4, input & 7) + (input >> 3 & 1) * 2;
        mo_cuda_store_one<EXACT>(place, value[i] - mean);
      }
    }
  }
}

/* What the first layer's sums start from, bias and generators, of this thread's output. Loaded before sensing, computed after it. */
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
        __ldg(reinterpret_cast<const float *>(score.weights + score.layout.generators) + i * MO_HIDDEN + o);
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
  const Home *homes;
  const mo_plan_pairs *pairs;
  float *lengths;
};

/* Where a row's length of a pair's first spring is put; kNowhere, if the row's body has none of the pair. */
constexpr uint32_t kNowhere = UINT32_MAX;

__device__ __forceinline__ uint32_t length_of(const mo_plan_pairs *pairs, const Home &home, uint32_t pair)
{
  const uint32_t word = pairs[home.part].has[pair / 32], before = pairs[home.part].before[pair / 32];
  const uint32_t bit = 1u << pair % 32;
  const uint32_t slot = 2 * (before + (uint32_t)__popc((int)(word & (bit - 1))));
  return (word & bit) != 0 ? home.first_length + slot * home.stride : kNowhere;
}

/* Lengths of a pair's springs in rows 2t and 2t + 1 of a column. */
__device__ __forceinline__ void put_lengths(const Output &output, const Home (&home)[2], uint32_t pair,
                                            const float (&wanted)[4])
{
  const uint32_t first = length_of(output.pairs, home[0], pair);
  uint32_t second = first + (first != kNowhere ? 1 : 0);
  if (home[1].part != home[0].part) /* seldom */
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
  for (int c = 0; c < COLUMNS; c++) {
    const uint32_t first = column[c] / (mo_cuda_network<EXACT>::COLUMN_BYTES / MO_PLAN_COLUMN);
    const Home home[2] = {output.homes[first + 2 * t], output.homes[first + 2 * t + 1]};
#pragma unroll
    for (int m = 0; m < TILES; m++) {
      const uint32_t pair = tiles.pair[m];
      if (pair == MO_PLAN_NO_PAIR)
        continue;
      const float2 bias = __ldg(output.bias + pair);
      const float rest = rest_length(2 * pair < MO_PLAN_EDGES), reach = rest * output.actuation;
      float wanted[4];
#pragma unroll
      for (int k = 0; k < 4; k++)
        wanted[k] = fmaf(reach, mo_cuda_tanh(fmaf(sum[m][c][k], output.scale, k < 2 ? bias.x : bias.y)), rest);
      put_lengths(output, home, pair, wanted);
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
__device__ __forceinline__ void act(const mo_cuda_score &score, const Shared &shared, float scale, const Memory &memory)
{
  const Output output = {score.weights + score.layout.output,
                         reinterpret_cast<const float2 *>(score.weights + score.layout.output_bias),
                         scale,
                         score.constants.actuation,
                         shared.homes,
                         memory.pairs,
                         memory.lengths};
  const char *x = memory.x;
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
