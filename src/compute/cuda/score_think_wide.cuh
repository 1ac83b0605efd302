/* score_think_wide.cuh: the network of a group with wgmma: a tile of sixteen outputs per warp, for
 * all rows. */
#ifndef MORPHO_COMPUTE_CUDA_SCORE_THINK_WIDE_CUH
#define MORPHO_COMPUTE_CUDA_SCORE_THINK_WIDE_CUH

#include "compute/cuda/network_wide.cuh"
#include "compute/cuda/score_think.cuh"

namespace {

/* A lane's pair of springs of its warp's tile, and the columns that have any of the tile's springs.
 */
struct Tile {
  uint32_t pair, columns;
};

__device__ __forceinline__ Tile tile_of(const mo_cuda_score &score, const Shared &shared,
                                        uint32_t round)
{
  const uint32_t number = round * MO_CUDA_WARPS + (threadIdx.x >> 5), g = (threadIdx.x & 31) >> 2;
  Tile tile = {MO_PLAN_NO_PAIR, 0};
  if (number < shared.plan.n_tiles) {
    tile.pair = __ldg(&score.tiles[shared.plan.first_tile + number].pair[g]);
    tile.columns = __ldg(score.columns + shared.plan.first_tile + number);
  }
  return tile;
}

/* Returns the weights of a hidden layer's tile, or of a tile of springs; without a pair, those of
 * the first pair. */
__device__ __forceinline__ mo_cuda_stream stream_of(const Layer &layer)
{
  constexpr uint32_t kHalf = 8 * MO_WEIGHTS_PAIR_BYTES / 2;
  const uint32_t lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
  return mo_cuda_stream{
      layer.matrix + warp * MO_WEIGHTS_UNITS * 2 * kHalf + lane * MO_WEIGHTS_LOAD_BYTES, kHalf};
}

__device__ __forceinline__ mo_cuda_stream stream_of(const Output &output, const Tile &tile)
{
  const uint32_t pair = tile.pair == MO_PLAN_NO_PAIR ? 0 : tile.pair;
  return mo_cuda_stream{output.matrix + pair * MO_WEIGHTS_UNITS * MO_WEIGHTS_PAIR_BYTES +
                            (threadIdx.x & 3) * MO_WEIGHTS_LOAD_BYTES,
                        MO_WEIGHTS_PAIR_BYTES / 2};
}

/* Computes the network for a group of COLUMNS columns. It reads the arguments and the group from
 * shared memory itself. If the rest of the kernel kept them in registers, too few would be left
 * here, and the compiler would wait for each product. */
template <int COLUMNS> __device__ __forceinline__ void think_of()
{
  const uint32_t lane = threadIdx.x & 31, warp = threadIdx.x >> 5, g = lane >> 2, t = lane & 3;
  const Shared &shared = shared_of_block();
  const mo_cuda_score &score = shared.score;
  const Memory memory = memory_of(score);
  const Output output = output_of(score, shared, memory);
  mo_cuda_ring<COLUMNS> ring;
  mo_cuda_stream stream = stream_of(layer_of(score, shared, 0));
  mo_cuda_begin_ring(ring, stream);
  float sum[COLUMNS][4];
  Tile tile = tile_of(score, shared, 0);
#pragma unroll
  for (int l = 0; l < MO_HIDDEN_LAYERS; l++) {
    const Layer layer = layer_of(score, shared, l);
    const mo_cuda_stream after = l + 1 < MO_HIDDEN_LAYERS
                                     ? stream_of(layer_of(score, shared, l + 1))
                                     : stream_of(output, tile);
    const float from[2] = {layer.start[warp * 16 + g], layer.start[warp * 16 + 8 + g]};
#pragma unroll
    for (int c = 0; c < COLUMNS; c++)
#pragma unroll
      for (int k = 0; k < 4; k++)
        sum[c][k] = from[k / 2];
    mo_cuda_product<COLUMNS>(sum, ring, stream, after, memory.x);
    mo_cuda_normalize<COLUMNS>(sum, layer.gain, layer.shift, layer.epsilon, memory.partial,
                               memory.x);
  }
  /* Rounds of sixteen tiles; a warpgroup stops when no tile is left for its first warp. */
  const uint32_t rounds = (shared.plan.n_tiles + MO_CUDA_WARPS - 1 - (warp & ~3u)) / MO_CUDA_WARPS;
#pragma unroll 1
  for (uint32_t round = 0; round < rounds; round++) {
    const Tile next = tile_of(score, shared, round + 1);
#pragma unroll
    for (int c = 0; c < COLUMNS; c++)
#pragma unroll
      for (int k = 0; k < 4; k++)
        sum[c][k] = 0.0f;
    mo_cuda_product<COLUMNS>(sum, ring, stream, stream_of(output, next), memory.x);
    if (tile.pair != MO_PLAN_NO_PAIR) {
      const float2 bias = __ldg(output.bias + tile.pair);
#pragma unroll
      for (int c = 0; c < COLUMNS; c++)
        if ((tile.columns >> c & 1) != 0) {
          const Home *homes = output.homes + c * MO_PLAN_COLUMN + 2 * t;
          const Home home[2] = {homes[0], homes[1]};
          put_sums(output, home, c * MO_PLAN_COLUMN + 2 * t, tile.pair, bias, sum[c]);
        }
    }
    tile = next;
  }
}

/* Computes the network, between two barriers, after sensing. */
__device__ __forceinline__ void think(const mo_cuda_score &, const Shared &shared, const Memory &)
{
  switch ((shared.plan.n_rows + MO_PLAN_COLUMN - 1) / MO_PLAN_COLUMN) {
  case 1: think_of<1>(); break;
  case 2: think_of<2>(); break;
  case 3: think_of<3>(); break;
  case 4: think_of<4>(); break;
  case 5: think_of<5>(); break;
  case 6: think_of<6>(); break;
  case 7: think_of<7>(); break;
  case 8: think_of<8>(); break;
  case 9: think_of<9>(); break;
  default: think_of<10>();
  }
}

} // namespace

#endif
