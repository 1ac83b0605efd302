/* network_wide.cuh: products and LayerNorm for at most 80 rows in one thread block of 512 threads,
 * with wgmma.
 *
 * A warp computes sixteen outputs of a layer for all rows; four warps, a warpgroup, multiply
 * together. Weights go from the L2 cache to registers, in the same order as for mma.sync
 * (weights.h), two to four units ahead of their use, across the end of one matrix into the next.
 * The matrix unit reads activations directly: shared memory holds, for each unit and each half of a
 * unit, two *chunks* of eight inputs: for each column, eight rows of sixteen bytes. Sixteen bytes
 * between chunks prevent bank conflicts among a warp's stores. */
#ifndef MORPHO_COMPUTE_CUDA_NETWORK_WIDE_CUH
#define MORPHO_COMPUTE_CUDA_NETWORK_WIDE_CUH

#include "compute/cuda/network.cuh"

#define MO_CUDA_THREADS   512
#define MO_CUDA_WARPS     16
#define MO_CUDA_ROWS      80
#define MO_CUDA_BLOCKS    1   /* per multiprocessor */
#define MO_CUDA_CHUNKS    672 /* of 32 places: more than fit in shared memory */
#define MO_CUDA_BYTES     MO_CUDA_SCORE_WIDE_BYTES
#define MO_CUDA_PAD_BYTES (MO_WEIGHTS_UNITS * 4 * 16) /* after the activations' columns */
#define MO_CUDA_MOMENTS   17                          /* float2 from row to row: sixteen warps' */

/* A group's activations. */
struct mo_cuda_activations {
  char *memory;
  uint32_t chunk; /* bytes from chunk to chunk */
};

__device__ __forceinline__ mo_cuda_activations mo_cuda_activations_of(char *memory,
                                                                      uint32_t columns)
{
  return mo_cuda_activations{memory, columns * 128 + 16};
}

/* Returns the place of values g and g + 8 of tile `tile` of a row: of the high parts; the low parts
 * are two chunks after them. */
__device__ __forceinline__ char *mo_cuda_place(const mo_cuda_activations &x, uint32_t r,
                                               uint32_t tile, uint32_t g)
{
  return x.memory + (tile * 4 + (g & 1)) * x.chunk + r * 16 + (g >> 1) * 4;
}

/* Called by a thread after it has written activations, before the barrier after which the matrix
 * unit reads them. */
__device__ __forceinline__ void mo_cuda_activations_written()
{
  asm volatile("fence.proxy.async.shared::cta;" ::: "memory");
}

/* Fills a row with zeros, using sixteen lanes; this lane is lane `own` of them. */
__device__ __forceinline__ void mo_cuda_clear_row(const mo_cuda_activations &x, uint32_t r,
                                                  uint32_t own)
{
#pragma unroll
  for (uint32_t i = 0; i < MO_WEIGHTS_UNITS / 4; i++)
    *reinterpret_cast<uint4 *>(x.memory + (own + 16 * i) * x.chunk + r * 16) =
        make_uint4(0, 0, 0, 0);
}

/* Stores an input of a row's first layer. */
__device__ __forceinline__ void mo_cuda_put_input(const mo_cuda_activations &x, uint32_t r,
                                                  uint32_t input, float value)
{
  mo_cuda_store_one(mo_cuda_place(x, r, input >> 4, input & 7) + (input >> 3 & 1) * 2, 2 * x.chunk,
                    value);
}

/* ---- products ---- */

/* sum (64 outputs of four warps × 8 · COLUMNS rows) += a · b; b: sixteen inputs of all rows, as a
 * descriptor. */
template <int COLUMNS>
__device__ __forceinline__ void mo_cuda_wgmma(float (&sum)[COLUMNS][4], const uint4 &a, uint64_t b);

#define MO_CUDA_SUM(c) "+f"(sum[c][0]), "+f"(sum[c][1]), "+f"(sum[c][2]), "+f"(sum[c][3])
#define MO_CUDA_WGMMA(columns, rows, sums, a0, a1, a2, a3, b, ...)                                 \
  template <>                                                                                      \
  __device__ __forceinline__ void mo_cuda_wgmma<columns>(float(&sum)[columns][4], const uint4 &a,  \
                                                         uint64_t x)                               \
  {                                                                                                \
    asm volatile("wgmma.mma_async.sync.aligned.m64n" rows "k16.f32.f16.f16 {" sums "}, {" a0       \
                 ", " a1 ", " a2 ", " a3 "}, " b ", 1, 1, 1, 0;"                                   \
                 : __VA_ARGS__                                                                     \
                 : "r"(a.x), "r"(a.y), "r"(a.z), "r"(a.w), "l"(x));                                \
  }
#define MO_CUDA_S1  "%0, %1, %2, %3"
#define MO_CUDA_S2  MO_CUDA_S1 ", %4, %5, %6, %7"
#define MO_CUDA_S3  MO_CUDA_S2 ", %8, %9, %10, %11"
#define MO_CUDA_S4  MO_CUDA_S3 ", %12, %13, %14, %15"
#define MO_CUDA_S5  MO_CUDA_S4 ", %16, %17, %18, %19"
#define MO_CUDA_S6  MO_CUDA_S5 ", %20, %21, %22, %23"
#define MO_CUDA_S7  MO_CUDA_S6 ", %24, %25, %26, %27"
#define MO_CUDA_S8  MO_CUDA_S7 ", %28, %29, %30, %31"
#define MO_CUDA_S9  MO_CUDA_S8 ", %32, %33, %34, %35"
#define MO_CUDA_S10 MO_CUDA_S9 ", %36, %37, %38, %39"
MO_CUDA_WGMMA(1, "8", MO_CUDA_S1, "%4", "%5", "%6", "%7", "%8", MO_CUDA_SUM(0))
MO_CUDA_WGMMA(2, "16", MO_CUDA_S2, "%8", "%9", "%10", "%11", "%12", MO_CUDA_SUM(0), MO_CUDA_SUM(1))
MO_CUDA_WGMMA(3, "24", MO_CUDA_S3, "%12", "%13", "%14", "%15", "%16", MO_CUDA_SUM(0),
              MO_CUDA_SUM(1), MO_CUDA_SUM(2))
MO_CUDA_WGMMA(4, "32", MO_CUDA_S4, "%16", "%17", "%18", "%19", "%20", MO_CUDA_SUM(0),
              MO_CUDA_SUM(1), MO_CUDA_SUM(2), MO_CUDA_SUM(3))
MO_CUDA_WGMMA(5, "40", MO_CUDA_S5, "%20", "%21", "%22", "%23", "%24", MO_CUDA_SUM(0),
              MO_CUDA_SUM(1), MO_CUDA_SUM(2), MO_CUDA_SUM(3), MO_CUDA_SUM(4))
MO_CUDA_WGMMA(6, "48", MO_CUDA_S6, "%24", "%25", "%26", "%27", "%28", MO_CUDA_SUM(0),
              MO_CUDA_SUM(1), MO_CUDA_SUM(2), MO_CUDA_SUM(3), MO_CUDA_SUM(4), MO_CUDA_SUM(5))
MO_CUDA_WGMMA(7, "56", MO_CUDA_S7, "%28", "%29", "%30", "%31", "%32", MO_CUDA_SUM(0),
              MO_CUDA_SUM(1), MO_CUDA_SUM(2), MO_CUDA_SUM(3), MO_CUDA_SUM(4), MO_CUDA_SUM(5),
              MO_CUDA_SUM(6))
MO_CUDA_WGMMA(8, "64", MO_CUDA_S8, "%32", "%33", "%34", "%35", "%36", MO_CUDA_SUM(0),
              MO_CUDA_SUM(1), MO_CUDA_SUM(2), MO_CUDA_SUM(3), MO_CUDA_SUM(4), MO_CUDA_SUM(5),
              MO_CUDA_SUM(6), MO_CUDA_SUM(7))
MO_CUDA_WGMMA(9, "72", MO_CUDA_S9, "%36", "%37", "%38", "%39", "%40", MO_CUDA_SUM(0),
              MO_CUDA_SUM(1), MO_CUDA_SUM(2), MO_CUDA_SUM(3), MO_CUDA_SUM(4), MO_CUDA_SUM(5),
              MO_CUDA_SUM(6), MO_CUDA_SUM(7), MO_CUDA_SUM(8))
MO_CUDA_WGMMA(10, "80", MO_CUDA_S10, "%40", "%41", "%42", "%43", "%44", MO_CUDA_SUM(0),
              MO_CUDA_SUM(1), MO_CUDA_SUM(2), MO_CUDA_SUM(3), MO_CUDA_SUM(4), MO_CUDA_SUM(5),
              MO_CUDA_SUM(6), MO_CUDA_SUM(7), MO_CUDA_SUM(8), MO_CUDA_SUM(9))

/* The matrix unit's descriptor of two chunks of the activations: their start, and the distances
 * from chunk to chunk and from column to column. */
struct mo_cuda_descriptor {
  uint32_t low, high;
};

__device__ __forceinline__ mo_cuda_descriptor mo_cuda_descriptor_of(const mo_cuda_activations &x)
{
  const uint32_t start = (uint32_t)__cvta_generic_to_shared(x.memory);
  return mo_cuda_descriptor{start >> 4 | x.chunk >> 4 << 16, 128 >> 4};
}

/* Returns the descriptor of data 16 · offset bytes after it. */
__device__ __forceinline__ uint64_t mo_cuda_descriptor_at(const mo_cuda_descriptor &d,
                                                          uint32_t offset)
{
  return (uint64_t)d.high << 32 | (d.low + offset);
}

/* This lane's weights of an output or a pair of springs, 2 · half bytes from unit to unit. */
struct mo_cuda_stream {
  const char *next;
  uint32_t half;
};

/* The ring of units that weights are loaded into: one unit that is being multiplied, and others
 * ahead of it. It is shorter for more sums: all must be in registers, or the compiler waits for
 * each product. */
template <int COLUMNS> struct mo_cuda_ring {
  static constexpr int SLOTS = COLUMNS <= 5 ? 5 : COLUMNS <= 8 ? 4 : 3;
  static constexpr int AHEAD = SLOTS - 1;
  static constexpr int TURN =
      MO_WEIGHTS_UNITS %
      SLOTS; /* where the previous product ended, and this one finds its first unit */
  uint4 slot[SLOTS][2];
};

__device__ __forceinline__ uint4 mo_cuda_load_ahead(const char *address)
{
  uint4 v;
  asm volatile("ld.global.L1::no_allocate.v4.u32 {%0, %1, %2, %3}, [%4];"
               : "=r"(v.x), "=r"(v.y), "=r"(v.z), "=r"(v.w)
               : "l"(address)
               : "memory");
  return v;
}

/* The warp barrier, which is not an instruction, keeps the loads where they are written: the
 * assembler would move them after the products that should hide their latency. */
__device__ __forceinline__ void mo_cuda_load_unit(uint4 (&slot)[2], mo_cuda_stream &stream)
{
  slot[0] = mo_cuda_load_ahead(stream.next);
  slot[1] = mo_cuda_load_ahead(stream.next + stream.half);
  stream.next += 2 * stream.half;
  __syncwarp();
}

template <int COLUMNS>
__device__ __forceinline__ void mo_cuda_begin_ring(mo_cuda_ring<COLUMNS> &ring,
                                                   mo_cuda_stream &stream)
{
  using Ring = mo_cuda_ring<COLUMNS>;
#pragma unroll
  for (int i = 0; i < Ring::AHEAD; i++)
    mo_cuda_load_unit(ring.slot[(i + Ring::TURN) % Ring::SLOTS], stream);
}

/* Adds to `sum` over all units, loads the first units of the next matrix, and sets `stream` to it.
 * It is unrolled, because the end of a loop would wait for all loads. */
template <int COLUMNS>
__device__ __forceinline__ void
mo_cuda_product(float (&sum)[COLUMNS][4], mo_cuda_ring<COLUMNS> &ring, mo_cuda_stream &stream,
                const mo_cuda_stream &after, const mo_cuda_activations &x)
{
  using Ring = mo_cuda_ring<COLUMNS>;
  mo_cuda_descriptor b = mo_cuda_descriptor_of(x);
  const uint32_t half = 2 * x.chunk >> 4;
  uint4 ahead[Ring::AHEAD][2];
#pragma unroll
  for (int i = 0; i < 2 * Ring::AHEAD; i++)
    ahead[i / 2][i % 2] = ring.slot[(i / 2 + Ring::TURN) % Ring::SLOTS][i % 2];
#pragma unroll
  for (int i = 0; i < 2 * Ring::AHEAD; i++)
    ring.slot[i / 2][i % 2] = ahead[i / 2][i % 2];
#pragma unroll
  for (int u = 0; u < MO_WEIGHTS_UNITS; u++) {
    const uint4(&a)[2] = ring.slot[u % Ring::SLOTS];
    /* Otherwise the compiler would compute the descriptors of all units in advance, and lack
     * registers for them. */
    asm volatile("" : "+r"(b.low));
    const uint64_t first = mo_cuda_descriptor_at(b, 0), second = mo_cuda_descriptor_at(b, half);
    asm volatile("wgmma.fence.sync.aligned;" ::: "memory");
    mo_cuda_wgmma<COLUMNS>(sum, a[0], second);
    mo_cuda_wgmma<COLUMNS>(sum, a[1], first);
    mo_cuda_wgmma<COLUMNS>(sum, a[0], first);
    asm volatile("wgmma.commit_group.sync.aligned;" ::: "memory");
    b.low += 2 * half;
    /* The previous unit has been multiplied: its slot is free. */
    asm volatile("wgmma.wait_group.sync.aligned 1;" ::: "memory");
    if (u + Ring::AHEAD == MO_WEIGHTS_UNITS)
      stream = after;
    mo_cuda_load_unit(ring.slot[(u + Ring::AHEAD) % Ring::SLOTS], stream);
  }
  asm volatile("wgmma.wait_group.sync.aligned 0;" ::: "memory");
}

/* ---- LayerNorm ---- */

/* A lane passes half of its sums and sums of squares to the lane `MASK` away, and adds the values
 * that it receives to the other half: sums of COUNT values become sums of twice as many. */
template <int HALF, int MASK, int COUNT, int ROOM>
__device__ __forceinline__ void mo_cuda_halve(float (&sum)[ROOM], float (&square)[ROOM], bool upper)
{
#pragma unroll
  for (int v = 0; v < HALF; v++) {
    const float keep = upper ? sum[v + HALF] : sum[v], give = upper ? sum[v] : sum[v + HALF];
    const float kept = upper ? square[v + HALF] : square[v],
                given = upper ? square[v] : square[v + HALF];
    const float other = __shfl_xor_sync(0xffffffffu, give, MASK);
    const float its = __shfl_xor_sync(0xffffffffu, given, MASK);
    const float d = keep - other;
    sum[v] = keep + other;
    square[v] = fmaf(d * (0.5f / COUNT), d, kept + its);
  }
}

/* Computes the sum and the sum of squared deviations from the mean of a warp's sixteen outputs, for
 * each row of columns FIRST … END − 1, into `partial`, (rows, MO_CUDA_MOMENTS). The lanes g share
 * the rows: at the end each has the sums of an eighth of them. */
template <int FIRST, int END, int COLUMNS>
__device__ __forceinline__ void
mo_cuda_partial_moments(const float (&h)[COLUMNS][4], float2 *partial, uint32_t warp, uint32_t lane)
{
  constexpr int kUsed = 2 * (END - FIRST), kValues = (kUsed + 7) / 8 * 8;
  const uint32_t g = lane >> 2, t = lane & 3;
  float sum[kValues], square[kValues];
#pragma unroll
  for (int v = 0; v < kValues; v++) {
    const float a = v < kUsed ? h[FIRST + v / 2][v % 2] : 0.0f,
                b = v < kUsed ? h[FIRST + v / 2][v % 2 + 2] : 0.0f;
    sum[v] = a + b;
    square[v] = 0.5f * (a - b) * (a - b);
  }
  mo_cuda_halve<kValues / 2, 4, 2>(sum, square, (g & 1) != 0);
  mo_cuda_halve<kValues / 4, 8, 4>(sum, square, (g & 2) != 0);
  mo_cuda_halve<kValues / 8, 16, 8>(sum, square, (g & 4) != 0);
  const uint32_t first =
      (g & 1) * (kValues / 2) + (g >> 1 & 1) * (kValues / 4) + (g >> 2) * (kValues / 8);
#pragma unroll
  for (int v = 0; v < kValues / 8; v++)
    if (first + v < kUsed)
      partial[((FIRST + (first + v) / 2) * MO_PLAN_COLUMN + 2 * t + (first + v) % 2) *
                  MO_CUDA_MOMENTS +
              warp] = make_float2(sum[v], square[v]);
}

/* Computes the mean and 1 / √(variance + epsilon) of each row from the warps' parts, with four
 * lanes per row, into `moments` (rows). */
__device__ __forceinline__ void mo_cuda_moments(const float2 *partial, float2 *moments,
                                                uint32_t n_rows, float epsilon)
{
  const uint32_t r = threadIdx.x >> 2, quarter = threadIdx.x & 3;
  if (r >= n_rows) /* entire warps, because rows are counted in columns */
    return;
  float2 part[4];
#pragma unroll
  for (int w = 0; w < 4; w++)
    part[w] = partial[r * MO_CUDA_MOMENTS + 4 * quarter + w];
  float sum = (part[0].x + part[1].x) + (part[2].x + part[3].x);
  sum += __shfl_xor_sync(0xffffffffu, sum, 1);
  sum += __shfl_xor_sync(0xffffffffu, sum, 2);
  const float mean = sum * (1.0f / MO_HIDDEN);
  float square = 0.0f;
#pragma unroll
  for (int w = 0; w < 4; w++) {
    const float d = fmaf(part[w].x, 1.0f / 16.0f, -mean);
    square += fmaf(16.0f * d, d, part[w].y);
  }
  square += __shfl_xor_sync(0xffffffffu, square, 1);
  square += __shfl_xor_sync(0xffffffffu, square, 2);
  if (quarter == 0)
    moments[r] = make_float2(mean, rsqrtf(fmaf(square, 1.0f / MO_HIDDEN, epsilon)));
}

/* Applies LayerNorm and ReLU to a hidden layer's sums, into the activations. Has three barriers:
 * after all warps have read the old activations and written their moments; after the rows' moments
 * are available; after all have written the new activations. */
template <int COLUMNS>
__device__ __forceinline__ void mo_cuda_normalize(float (&h)[COLUMNS][4], const float *gain,
                                                  const float *shift, float epsilon,
                                                  float2 *partial, const mo_cuda_activations &x)
{
  const uint32_t warp = threadIdx.x >> 5, lane = threadIdx.x & 31, g = lane >> 2, t = lane & 3;
  float scale[2], offset[2];
  float2 *moments = partial + MO_CUDA_MOMENTS * MO_CUDA_ROWS;
#pragma unroll
  for (int e = 0; e < 2; e++) {
    scale[e] = __ldg(gain + warp * 16 + e * 8 + g);
    offset[e] = __ldg(shift + warp * 16 + e * 8 + g);
  }
  constexpr int kFirst = COLUMNS < 8 ? COLUMNS : 8;
  mo_cuda_partial_moments<0, kFirst>(h, partial, warp, lane);
  if constexpr (kFirst < COLUMNS)
    mo_cuda_partial_moments<kFirst, COLUMNS>(h, partial, warp, lane);
  __syncthreads();
  mo_cuda_moments(partial, moments, COLUMNS * MO_PLAN_COLUMN, epsilon);
  __syncthreads();
  char *place = mo_cuda_place(x, 2 * t, warp, g);
#pragma unroll
  for (int c = 0; c < COLUMNS; c++) {
    const float4 two = *reinterpret_cast<const float4 *>(moments + c * MO_PLAN_COLUMN + 2 * t);
#pragma unroll
    for (int n = 0; n < 2; n++) {
      const float mean = n == 0 ? two.x : two.z, factor = n == 0 ? two.y : two.w;
      float y[2];
#pragma unroll
      for (int e = 0; e < 2; e++)
        y[e] = fmaxf(fmaf((h[c][n + 2 * e] - mean) * factor, scale[e], offset[e]), 0.0f);
      mo_cuda_store_pair(place + c * 128 + n * 16, 2 * x.chunk, y[0], y[1]);
    }
  }
  mo_cuda_activations_written();
  __syncthreads();
}

#endif
