/* score_think_narrow.cuh: the network of a group with mma.sync: two tiles of sixteen outputs per
 * warp. */
#ifndef MORPHO_COMPUTE_CUDA_SCORE_THINK_NARROW_CUH
#define MORPHO_COMPUTE_CUDA_SCORE_THINK_NARROW_CUH

#include "compute/cuda/network_narrow.cuh"
#include "compute/cuda/score_think.cuh"

namespace {

/* Computes one hidden layer for all rows, in place. */
template <int COLUMNS>
__device__ __forceinline__ void hidden_layer(const Layer &layer, uint32_t units, float2 *partial,
                                             char *x)
{
  const uint32_t lane = threadIdx.x & 31, warp = threadIdx.x >> 5, g = lane >> 2, t = lane & 3;
  constexpr uint32_t kUnits = MO_WEIGHTS_UNITS;
  constexpr int kHalf = 8 * MO_WEIGHTS_PAIR_BYTES / 2; /* of a tile's unit */
  const char *row[2];
  uint32_t column[COLUMNS];
  float sum[2][COLUMNS][4];
#pragma unroll
  for (int c = 0; c < COLUMNS; c++)
    column[c] = c * MO_CUDA_COLUMN_BYTES;
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
  if (units == (1u << kUnits) - 1)
    mo_cuda_product<kHalf, 2, COLUMNS>(sum, row, mine, column);
  else
    mo_cuda_product_of<kHalf, 2, COLUMNS>(sum, row, mine, column, units);
  mo_cuda_normalize<COLUMNS>(sum, layer.gain, layer.shift, layer.epsilon, partial, x, warp, lane);
}

__device__ __forceinline__ void hidden_layers(const mo_cuda_score &score, Shared &shared,
                                              const Memory &memory)
{
  char *x = memory.x.memory;
  constexpr uint32_t kUnits = MO_WEIGHTS_UNITS;
#pragma unroll 1
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++) {
    const Layer layer = layer_of(score, shared, l);
    const uint32_t units = l == 0 ? shared.plan.input_tiles : (1u << kUnits) - 1;
    switch ((shared.plan.n_rows + MO_PLAN_COLUMN - 1) / MO_PLAN_COLUMN) {
    case 1: hidden_layer<1>(layer, units, memory.partial, x); break;
    case 2: hidden_layer<2>(layer, units, memory.partial, x); break;
    case 3: hidden_layer<3>(layer, units, memory.partial, x); break;
    case 4: hidden_layer<4>(layer, units, memory.partial, x); break;
    default: hidden_layer<5>(layer, units, memory.partial, x);
    }
  }
}

/* A lane's pairs of springs of up to two tiles, and the columns that have any of the tiles'
 * springs. */
struct Tiles {
  uint32_t pair[2], columns;
};

/* Finds the tiles of a warp in a round, and returns how many: rounds have two tiles per warp; the
 * last round distributes the remaining ones. */
__device__ __forceinline__ uint32_t tiles_of(const mo_cuda_score &score, const Shared &shared,
                                             uint32_t round, Tiles *ret)
{
  const uint32_t warp = threadIdx.x >> 5, g = (threadIdx.x & 31) >> 2, n = shared.plan.n_tiles;
  const uint32_t done = round * 2 * MO_CUDA_WARPS;
  if (done >= n)
    return 0;
  const uint32_t left = n - done;
  const uint32_t twos = left >= 2 * MO_CUDA_WARPS ? MO_CUDA_WARPS
                        : left > MO_CUDA_WARPS    ? left - MO_CUDA_WARPS
                                                  : 0;
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

/* Computes TILES tiles of springs for the COLUMNS columns that have them. */
template <int TILES, int COLUMNS>
__device__ __forceinline__ void act_tiles(const Output &output, const Tiles &tiles, const char *x)
{
  const uint32_t lane = threadIdx.x & 31, g = lane >> 2, t = lane & 3;
  const char *row[TILES];
  uint32_t column[COLUMNS], columns = tiles.columns;
  float sum[TILES][COLUMNS][4];
#pragma unroll
  for (int m = 0; m < TILES; m++)
    row[m] = output.matrix +
             (tiles.pair[m] == MO_PLAN_NO_PAIR ? 0 : tiles.pair[m]) * MO_WEIGHTS_UNITS *
                 MO_WEIGHTS_PAIR_BYTES +
             t * MO_WEIGHTS_LOAD_BYTES;
#pragma unroll
  for (int c = 0; c < COLUMNS; c++) {
    column[c] = (uint32_t)(__ffs((int)columns) - 1) * MO_CUDA_COLUMN_BYTES;
    columns &= columns - 1;
#pragma unroll
    for (int m = 0; m < TILES; m++)
#pragma unroll
      for (int k = 0; k < 4; k++)
        sum[m][c][k] = 0.0f;
  }
  mo_cuda_product<MO_WEIGHTS_PAIR_BYTES / 2, TILES, COLUMNS>(sum, row, x + mo_cuda_slot(g, t),
                                                             column);
#pragma unroll
  for (int c = 0; c < COLUMNS; c++) {
    const uint32_t first = column[c] / (MO_CUDA_COLUMN_BYTES / MO_PLAN_COLUMN);
    const Home home[2] = {output.homes[first + 2 * t], output.homes[first + 2 * t + 1]};
#pragma unroll
    for (int m = 0; m < TILES; m++) {
      const uint32_t pair = tiles.pair[m];
      if (pair == MO_PLAN_NO_PAIR)
        continue;
      const float2 bias = __ldg(output.bias + pair);
      put_sums(output, home, first + 2 * t, pair, bias, sum[m][c]);
    }
  }
}

template <int TILES>
__device__ __forceinline__ void act_tiles_of(const Output &output, const Tiles &tiles,
                                             const char *x)
{
  switch (__popc(tiles.columns)) {
  case 1: act_tiles<TILES, 1>(output, tiles, x); break;
  case 2: act_tiles<TILES, 2>(output, tiles, x); break;
  case 3: act_tiles<TILES, 3>(output, tiles, x); break;
  case 4: act_tiles<TILES, 4>(output, tiles, x); break;
  default: act_tiles<TILES, 5>(output, tiles, x);
  }
}

/* Computes the last layer. */
__device__ __forceinline__ void act(const mo_cuda_score &score, const Shared &shared,
                                    const Memory &memory)
{
  const Output output = output_of(score, shared, memory);
  const char *x = memory.x.memory;
  Tiles now = {}, next = {};
  uint32_t count = tiles_of(score, shared, 0, &now);
  for (uint32_t round = 1; count > 0; round++) {
    const uint32_t after = tiles_of(score, shared, round, &next);
    if (count == 2)
      act_tiles_of<2>(output, now, x);
    else
      act_tiles_of<1>(output, now, x);
    now = next;
    count = after;
  }
}

/* Computes the network, between two barriers, after sensing. */
__device__ __forceinline__ void think(const mo_cuda_score &score, Shared &shared,
                                      const Memory &memory)
{
  hidden_layers(score, shared, memory);
  act(score, shared, memory);
}

} // namespace

#endif
