/* network_narrow.cuh: products and LayerNorm for at most 40 rows in one thread block of 256
 * threads, with mma.sync.
 *
 * Activations are in shared memory as right operands: (columns of 8 rows, units, 32 slots) of 16
 * bytes. Slot n·4 + t of a unit holds the operands of the lane (n, t): registers r0, r1 of the
 * unit's first half, then of its second (weights.h): the high and low parts of one tile. Slots are
 * swizzled, so that a warp's loads have no bank conflicts.
 *
 * A warp computes 32 outputs (two tiles of 16) of a hidden layer for all rows. Each output of each
 * row is a separate sum, in a fixed order over the units; units of inputs that no mass of the group
 * has are skipped, which changes no bit, because they would add products with 0. */
#ifndef MORPHO_COMPUTE_CUDA_NETWORK_NARROW_CUH
#define MORPHO_COMPUTE_CUDA_NETWORK_NARROW_CUH

#include "compute/cuda/network.cuh"

#define MO_CUDA_THREADS   256
#define MO_CUDA_WARPS     8
#define MO_CUDA_ROWS      40
#define MO_CUDA_BLOCKS    2   /* per multiprocessor */
#define MO_CUDA_CHUNKS    352 /* of 32 places: more than fit in shared memory */
#define MO_CUDA_BYTES     MO_CUDA_SCORE_NARROW_BYTES
#define MO_CUDA_PAD_BYTES 0 /* after the activations' columns */

/* Returns the byte offset within a unit of the operands of the lane (n, t). */
__device__ __forceinline__ uint32_t mo_cuda_slot(uint32_t n, uint32_t t)
{
  const uint32_t slot = n * 4 + t;
  return (slot ^ (slot >> 3 << 1)) * 16;
}

/* Returns the byte offset of the high parts of output pair (g, g + 8) of tile `tile` within a
 * column, for the column's row n. The low parts are 8 bytes after them. */
__device__ __forceinline__ uint32_t mo_cuda_place(uint32_t n, uint32_t tile, uint32_t g)
{
  return tile * MO_CUDA_UNIT_BYTES + mo_cuda_slot(n, g >> 1) + (g & 1) * 4;
}

/* A group's activations. */
struct mo_cuda_activations {
  char *memory;
};

__device__ __forceinline__ mo_cuda_activations mo_cuda_activations_of(char *memory, uint32_t)
{
  return mo_cuda_activations{memory};
}

__device__ __forceinline__ char *mo_cuda_column(const mo_cuda_activations &x, uint32_t r)
{
  return x.memory + (r >> 3) * MO_CUDA_COLUMN_BYTES;
}

/* Called by a thread after it has written activations, before the barrier after which others read
 * them. */
__device__ __forceinline__ void mo_cuda_activations_written()
{
}

/* Fills a row with zeros, using sixteen lanes; this lane is lane `own` of them. */
__device__ __forceinline__ void mo_cuda_clear_row(const mo_cuda_activations &x, uint32_t r,
                                                  uint32_t own)
{
#pragma unroll
  for (uint32_t unit = own >> 2; unit < MO_WEIGHTS_UNITS; unit += 4)
    *reinterpret_cast<uint4 *>(mo_cuda_column(x, r) + unit * MO_CUDA_UNIT_BYTES +
                               mo_cuda_slot(r & 7, own & 3)) = make_uint4(0, 0, 0, 0);
}

/* Stores an input of a row's first layer. */
__device__ __forceinline__ void mo_cuda_put_input(const mo_cuda_activations &x, uint32_t r,
                                                  uint32_t input, float value)
{
  char *place =
      mo_cuda_column(x, r) + mo_cuda_place(r & 7, input >> 4, input & 7) + (input >> 3 & 1) * 2;
  mo_cuda_store_one(place, 8, value);
}

__device__ __forceinline__ void mo_cuda_mma(float (&c)[4], const uint4 &a, uint32_t b0, uint32_t b1)
{
  asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, "
      "%9}, "
      "{%0, %1, %2, %3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(a.x), "r"(a.y), "r"(a.z), "r"(a.w), "r"(b0), "r"(b1));
}

/* Multiplies one unit: TILES tiles of outputs × COLUMNS columns. */
template <int TILES, int COLUMNS>
__device__ __forceinline__ void mo_cuda_multiply(float (&sum)[TILES][COLUMNS][4],
                                                 const uint4 (&a)[TILES][2], const char *x,
                                                 const uint32_t (&column)[COLUMNS])
{
  uint4 b[COLUMNS];
#pragma unroll
  for (int c = 0; c < COLUMNS; c++)
    b[c] = *reinterpret_cast<const uint4 *>(x + column[c]);
    /* High · low, low · high, high · high. Columns are taken in turn, so that no product waits for
     * another. */
#pragma unroll
  for (int turn = 0; turn < 3; turn++) {
    const int half = turn == 1;    /* of the weights */
    const bool second = turn == 0; /* half of the activations */
#pragma unroll
    for (int c = 0; c < COLUMNS; c++)
#pragma unroll
      for (int m = 0; m < TILES; m++)
        mo_cuda_mma(sum[m][c], a[m][half], second ? b[c].z : b[c].x, second ? b[c].w : b[c].y);
  }
}

/* HALF: bytes from a unit's first half to its second. */
template <int HALF, int TILES>
__device__ __forceinline__ void mo_cuda_load_unit(uint4 (&a)[TILES][2],
                                                  const char *const (&row)[TILES], uint32_t offset)
{
#pragma unroll
  for (int m = 0; m < TILES; m++) {
    a[m][0] = mo_cuda_load_weights(row[m] + offset);
    a[m][1] = mo_cuda_load_weights(row[m] + offset + HALF);
  }
}

/* How many units ahead weights are loaded: as many as registers allow. */
template <int SUMS> struct mo_cuda_ahead {
  static constexpr int UNITS = SUMS <= 8 ? 2 : 1;
};

/* Adds to `sum` over all units. row: this lane's weights of each tile; a unit is 2 · HALF bytes. x:
 * the activations, at this lane's slot; column: byte offsets of the columns. */
template <int HALF, int TILES, int COLUMNS>
__device__ __forceinline__ void mo_cuda_product(float (&sum)[TILES][COLUMNS][4],
                                                const char *const (&row)[TILES], const char *x,
                                                const uint32_t (&column)[COLUMNS])
{
  constexpr int UNITS = MO_WEIGHTS_UNITS;
  constexpr int AHEAD = mo_cuda_ahead<TILES * COLUMNS>::UNITS, STAGES = AHEAD + 1;
  uint4 a[STAGES][TILES][2];
#pragma unroll
  for (int i = 0; i < AHEAD; i++)
    mo_cuda_load_unit<HALF, TILES>(a[i], row, i * 2 * HALF);
#pragma unroll 1
  for (int u = 0; u < UNITS; u += STAGES)
#pragma unroll
    for (int i = 0; i < STAGES; i++) {
      if (u + i + AHEAD < UNITS)
        mo_cuda_load_unit<HALF, TILES>(a[(i + AHEAD) % STAGES], row,
                                       (uint32_t)(u + i + AHEAD) * 2 * HALF);
      if (u + i < UNITS)
        mo_cuda_multiply<TILES, COLUMNS>(sum, a[i], x + (u + i) * MO_CUDA_UNIT_BYTES, column);
    }
}

/* Does the same over the units with bits set in `units` (at least one). */
template <int HALF, int TILES, int COLUMNS>
__device__ __forceinline__ void
mo_cuda_product_of(float (&sum)[TILES][COLUMNS][4], const char *const (&row)[TILES], const char *x,
                   const uint32_t (&column)[COLUMNS], uint32_t units)
{
  uint4 a[2][TILES][2];
  int u = __ffs((int)units) - 1;
  mo_cuda_load_unit<HALF, TILES>(a[0], row, (uint32_t)u * 2 * HALF);
#pragma unroll 1
  while (units != 0)
#pragma unroll
    for (int i = 0; i < 2; i++)
      if (units != 0) {
        units &= units - 1;
        const int next = __ffs((int)units) - 1;
        if (units != 0)
          mo_cuda_load_unit<HALF, TILES>(a[1 - i], row, (uint32_t)next * 2 * HALF);
        mo_cuda_multiply<TILES, COLUMNS>(sum, a[i], x + u * MO_CUDA_UNIT_BYTES, column);
        u = next;
      }
}

/* Computes the sum and the sum of squared deviations from the mean of a warp's 32 outputs, for rows
 * 2t and 2t + 1 of each column, into partial (warps, MO_CUDA_ROWS). */
template <int COLUMNS>
__device__ __forceinline__ void mo_cuda_partial_moments(const float (&h)[2][COLUMNS][4],
                                                        float2 *partial, uint32_t warp,
                                                        uint32_t lane)
{
#pragma unroll
  for (int c = 0; c < COLUMNS; c++) {
    float2 moment[2];
#pragma unroll
    for (int n = 0; n < 2; n++) {
      float sum = (h[0][c][n] + h[0][c][n + 2]) + (h[1][c][n] + h[1][c][n + 2]);
      sum += __shfl_xor_sync(0xffffffffu, sum, 4);
      sum += __shfl_xor_sync(0xffffffffu, sum, 8);
      sum += __shfl_xor_sync(0xffffffffu, sum, 16);
      const float mean = sum * (1.0f / 32.0f);
      float square = 0.0f;
#pragma unroll
      for (int m = 0; m < 2; m++)
#pragma unroll
        for (int e = 0; e < 2; e++) {
          const float d = h[m][c][n + 2 * e] - mean;
          square = fmaf(d, d, square);
        }
      square += __shfl_xor_sync(0xffffffffu, square, 4);
      square += __shfl_xor_sync(0xffffffffu, square, 8);
      square += __shfl_xor_sync(0xffffffffu, square, 16);
      moment[n] = make_float2(sum, square);
    }
    if (lane < 4)
      *reinterpret_cast<float4 *>(partial + warp * MO_CUDA_ROWS + c * MO_PLAN_COLUMN + 2 * lane) =
          make_float4(moment[0].x, moment[0].y, moment[1].x, moment[1].y);
  }
}

/* Returns the mean and 1 / √(variance + epsilon) of one row from the warps' parts. */
__device__ __forceinline__ float2 mo_cuda_moments(const float2 (&part)[MO_CUDA_WARPS],
                                                  float epsilon)
{
  float sum = 0.0f, square = 0.0f;
#pragma unroll
  for (int w = 0; w < MO_CUDA_WARPS; w++)
    sum += part[w].x;
  const float mean = sum * (1.0f / MO_HIDDEN);
#pragma unroll
  for (int w = 0; w < MO_CUDA_WARPS; w++) {
    const float d = fmaf(part[w].x, 1.0f / 32.0f, -mean);
    square += fmaf(32.0f * d, d, part[w].y);
  }
  return make_float2(mean, rsqrtf(fmaf(square, 1.0f / MO_HIDDEN, epsilon)));
}

/* Applies LayerNorm and ReLU to a hidden layer's sums, into `x`. Has two barriers: after all warps
 * have read the old x, and after all have written the new. */
template <int COLUMNS>
__device__ __forceinline__ void
mo_cuda_normalize(float (&h)[2][COLUMNS][4], const float *gain, const float *shift, float epsilon,
                  float2 *partial, char *x, uint32_t warp, uint32_t lane)
{
  const uint32_t g = lane >> 2, t = lane & 3;
  float scale[2][2], offset[2][2];
#pragma unroll
  for (int m = 0; m < 2; m++)
#pragma unroll
    for (int e = 0; e < 2; e++) {
      scale[m][e] = __ldg(gain + warp * 32 + m * 16 + e * 8 + g);
      offset[m][e] = __ldg(shift + warp * 32 + m * 16 + e * 8 + g);
    }
  mo_cuda_partial_moments<COLUMNS>(h, partial, warp, lane);
  __syncthreads();
  /* Lane (c, t) finds the moments of rows 2t and 2t + 1 of column c. */
  float2 moment[2] = {make_float2(0.0f, 0.0f), make_float2(0.0f, 0.0f)};
  if (g < COLUMNS) {
    float2 part[2][MO_CUDA_WARPS];
#pragma unroll
    for (int w = 0; w < MO_CUDA_WARPS; w++) {
      const float4 two = *reinterpret_cast<const float4 *>(partial + w * MO_CUDA_ROWS +
                                                           g * MO_PLAN_COLUMN + 2 * t);
      part[0][w] = make_float2(two.x, two.y);
      part[1][w] = make_float2(two.z, two.w);
    }
    moment[0] = mo_cuda_moments(part[0], epsilon);
    moment[1] = mo_cuda_moments(part[1], epsilon);
  }
#pragma unroll
  for (int c = 0; c < COLUMNS; c++)
#pragma unroll
    for (int n = 0; n < 2; n++) {
      const float mean = __shfl_sync(0xffffffffu, moment[n].x, c * 4 + t);
      const float factor = __shfl_sync(0xffffffffu, moment[n].y, c * 4 + t);
      float y[2][2];
#pragma unroll
      for (int m = 0; m < 2; m++)
#pragma unroll
        for (int e = 0; e < 2; e++)
          y[m][e] =
              fmaxf(fmaf((h[m][c][n + 2 * e] - mean) * factor, scale[m][e], offset[m][e]), 0.0f);
      char *out = x + c * MO_CUDA_COLUMN_BYTES;
#pragma unroll
      for (int m = 0; m < 2; m++)
        mo_cuda_store_pair(out + mo_cuda_place(2 * t + n, 2 * warp + m, g), 8, y[m][0], y[m][1]);
    }
  __syncthreads();
}

#endif
