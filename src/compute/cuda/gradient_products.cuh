/* gradient_products.cuh: the operands of a block of the products, and the kernel for devices of
 * compute capability 9.0.
 *
 * There a group of four warps multiplies 64 × 256 numbers by 16 rows in one instruction, which
 * reads both operands directly from shared memory; so a block of two such groups computes 128 × 256
 * numbers, as on other devices, with a quarter of the warps and no loads in between. The
 * instruction takes operands with consecutive columns, as they are on the tape: 64 columns (128
 * bytes) per line, lines by rows, the 16-byte pieces of a line in an order that depends on its row,
 * so that there are no bank conflicts. It adds rows sixteen at a time in order, like the other
 * kernel, and was found to produce the same bits. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_PRODUCTS_CUH
#define MORPHO_COMPUTE_CUDA_GRADIENT_PRODUCTS_CUH

#include "compute/cuda/gradient_kernels.cuh"

static __device__ __forceinline__ void copy_ahead(uint32_t to, const void *from, bool there)
{
  asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;" ::"r"(to), "l"(from),
               "r"(there ? 16 : 0));
}

struct operands {
  const __nv_bfloat16 *left, *right; /* (depth, left_row), (depth, 256) */
  int left_row, left_columns, depth;
  float *to;   /* (left_columns, 256) */
  float *bias; /* (left_columns) sums of the left operand over its rows */
};

static __device__ __forceinline__ operands operands_of(const mo_gk &k, uint32_t job, uint32_t first,
                                                       uint32_t end)
{
  const mo_gp_group &g = k.groups[job >> 8];
  const int kind = (int)(job >> 4 & 15), block = (int)(job & 15);
  const mo_gp_tape tape = mo_gp_tape_of(&g, mo_gp_time{k.n_steps, k.control_steps, k.splits});
  const mo_gp_sum sum = mo_gp_sum_of(&g);
  uint64_t left, right, to, bias;
  int m_all = MO_HIDDEN;
  if (kind == MO_GK_JOB_OUTPUT) {
    m_all = (int)g.n_outputs * MO_GP_TILE;
    left = tape.d_output;
    right = tape.hidden[2];
    to = sum.output;
    bias = sum.output_bias;
  } else if (kind == MO_GK_JOB_INPUT) {
    left = tape.normal[0];
    right = tape.input;
    to = sum.input;
    bias = sum.bias;
  } else {
    const int layer = kind == MO_GK_JOB_HIDDEN_2 ? 2 : 1;
    left = tape.normal[layer];
    right = tape.hidden[layer - 1];
    to = sum.hidden[layer - 1];
    bias = sum.bias + layer * MO_HIDDEN;
  }
  const unsigned char *base = k.tape + g.tape_at;
  operands o;
  o.left = (const __nv_bfloat16 *)(base + left) + (size_t)first * g.n_rows * m_all +
           block * MO_GK_JOB_COLUMNS;
  o.right = (const __nv_bfloat16 *)(base + right) + (size_t)first * g.n_rows * MO_HIDDEN;
  o.left_row = m_all;
  o.left_columns = m_all - block * MO_GK_JOB_COLUMNS;
  o.depth = (int)((end - first) * g.n_rows);
  o.to = k.sums + g.sum_at + to + (size_t)block * MO_GK_JOB_COLUMNS * MO_HIDDEN;
  o.bias = k.sums + g.sum_at + bias + block * MO_GK_JOB_COLUMNS;
  return o;
}

/* Adds two numbers of a sum to those of earlier launches. */
static __device__ __forceinline__ void add_pair(const operands &o, int row, int column,
                                                bool is_first, float x, float y)
{
  if (row >= o.left_columns)
    return;
  float2 *at = (float2 *)(o.to + (size_t)row * MO_HIDDEN + column);
  const float2 before = is_first ? make_float2(0, 0) : *at;
  *at = make_float2(before.x + x, before.y + y);
}

static __device__ __forceinline__ void add_bias(const operands &o, int row, bool is_first, float x)
{
  if (row < o.left_columns)
    o.bias[row] = (is_first ? 0.0f : o.bias[row]) + x;
}

/* Two bfloat16 ones. The left operand is multiplied by them for its sums. */
enum { ONES = 0x3f803f80 };

/* ---- compute capability 9.0 ---- */

enum {
  WIDE_DEPTH = 32, /* rows × passes at a time */
  WIDE_STAGES = 6,
  WIDE_LINES = WIDE_DEPTH * 128, /* bytes of 64 columns */
  WIDE_STAGE = WIDE_LINES * (MO_GK_JOB_COLUMNS + MO_HIDDEN) / 64,
  WIDE_THREADS = 256,
  WIDE_ONES = 256, /* bytes: eight columns of sixteen rows */
  WIDE_SHARED = WIDE_STAGES * WIDE_STAGE + WIDE_ONES + 1024 /* to align the first line */
};

#ifdef __CUDA_ARCH_FEAT_SM90_ALL

/* The copies of a thread, stage by stage. */
struct wide_copies {
  const __nv_bfloat16 *left, *right;
  uint32_t left_to, right_to;
  int left_row, left_rows, right_rows; /* rows: remaining ones */
  bool left_there;

  __device__ __forceinline__ explicit wide_copies(const operands &o)
  {
    const int row = (int)threadIdx.x / 16, piece = (int)threadIdx.x % 16;
    left_there = piece * 8 < o.left_columns;
    left = o.left + (size_t)row * o.left_row + (left_there ? piece * 8 : 0);
    left_row = o.left_row;
    left_rows = o.depth - row;
    left_to = place(piece, row);
    const int right_row = (int)threadIdx.x / 32, right_piece = (int)threadIdx.x % 32;
    right = o.right + (size_t)right_row * MO_HIDDEN + right_piece * 8;
    right_rows = o.depth - right_row;
    right_to = place(MO_GK_JOB_COLUMNS / 8 + right_piece, right_row);
  }

  /* Returns the place of eight columns in a row. */
  static __device__ __forceinline__ uint32_t place(int piece, int row)
  {
    return (uint32_t)(piece / 8 * WIDE_LINES + row * 128 + ((piece ^ row) & 7) * 16);
  }

  /* Rows beyond the last are filled with zeros, without reading anything. */
  __device__ __forceinline__ void next(uint32_t stage)
  {
#pragma unroll
    for (int i = 0; i < WIDE_DEPTH; i += 16)
      copy_ahead(stage + left_to + i * 128, left + (size_t)i * left_row,
                 left_there && left_rows > i);
#pragma unroll
    for (int i = 0; i < WIDE_DEPTH; i += 8)
      copy_ahead(stage + right_to + i * 128, right + i * MO_HIDDEN, right_rows > i);
    left += (size_t)WIDE_DEPTH * left_row;
    right += WIDE_DEPTH * MO_HIDDEN;
    left_rows -= WIDE_DEPTH;
    right_rows -= WIDE_DEPTH;
  }
};

/* The descriptor of an operand: its start, the distances between sets of 64 columns and of 8 rows,
 * and the order of pieces. */
static __device__ __forceinline__ uint64_t wide_operand(uint32_t address)
{
  return (uint64_t)(address >> 4) | (uint64_t)(WIDE_LINES >> 4) << 16 |
         (uint64_t)(1024 >> 4) << 32 | (uint64_t)1 << 62;
}

/* Returns the descriptor of the ones, in any order. */
static __device__ __forceinline__ uint64_t wide_ones(uint32_t address)
{
  return (uint64_t)(address >> 4) | (uint64_t)(128 >> 4) << 16 | (uint64_t)(128 >> 4) << 32;
}

/* Adds sixteen rows of the left operand to its sums: c[2 h] is row 16 (warp % 4) + 8 h + lane/4;
 * the other elements repeat it. */
static __device__ __forceinline__ void wide_sum(float (&c)[4], uint64_t left, uint64_t ones)
{
  asm volatile(
      "wgmma.mma_async.sync.aligned.m64n8k16.f32.bf16.bf16 {%0, %1, %2, %3}, %4, %5, 1, 1, 1, 1, 1;"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "l"(left), "l"(ones));
}

#define WIDE_8(c, i)                                                                               \
  "+f"((c)[i]), "+f"((c)[(i) + 1]), "+f"((c)[(i) + 2]), "+f"((c)[(i) + 3]), "+f"((c)[(i) + 4]),    \
      "+f"((c)[(i) + 5]), "+f"((c)[(i) + 6]), "+f"((c)[(i) + 7])
#define WIDE_32(c, i) WIDE_8(c, i), WIDE_8(c, (i) + 8), WIDE_8(c, (i) + 16), WIDE_8(c, (i) + 24)

/* Adds the product of sixteen rows of both operands. c[4 j + 2 h + e] is row 16 (warp % 4) + 8 h +
 * lane/4, column 8 j + 2 (lane % 4) + e. */
static __device__ __forceinline__ void wide_multiply(float (&c)[128], uint64_t left, uint64_t right)
{
  asm volatile("wgmma.mma_async.sync.aligned.m64n256k16.f32.bf16.bf16 {"
               "%0, %1, %2, %3, %4, %5, %6, %7, %8, %9, %10, %11, %12, %13, %14, %15, %16, %17, "
               "%18, %19, %20, %21, "
               "%22, %23, %24, %25, %26, %27, %28, %29, %30, %31, %32, %33, %34, %35, %36, %37, "
               "%38, %39, %40, %41, "
               "%42, %43, %44, %45, %46, %47, %48, %49, %50, %51, %52, %53, %54, %55, %56, %57, "
               "%58, %59, %60, %61, "
               "%62, %63, %64, %65, %66, %67, %68, %69, %70, %71, %72, %73, %74, %75, %76, %77, "
               "%78, %79, %80, %81, "
               "%82, %83, %84, %85, %86, %87, %88, %89, %90, %91, %92, %93, %94, %95, %96, %97, "
               "%98, %99, %100, %101, "
               "%102, %103, %104, %105, %106, %107, %108, %109, %110, %111, %112, %113, %114, "
               "%115, %116, %117, %118, "
               "%119, %120, %121, %122, %123, %124, %125, %126, %127}, %128, %129, 1, 1, 1, 1, 1;"
               : WIDE_32(c, 0), WIDE_32(c, 32), WIDE_32(c, 64), WIDE_32(c, 96)
               : "l"(left), "l"(right));
}

/* A stage is refilled two rounds after it was multiplied: by then all warps have seen its product
 * finish. */
static __device__ __forceinline__ void wide_products(const mo_gk &k, uint32_t job, uint32_t first,
                                                     uint32_t end, unsigned char *shared)
{
  const operands o = operands_of(k, job, first, end);
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32,
            half = __shfl_sync(0xffffffffu, warp / 4, 0);
  const bool idle = half * 64 >= o.left_columns;
  const uint32_t base = (shared_address(shared) + 1023) / 1024 * 1024,
                 last = base + WIDE_STAGES * WIDE_STAGE;
  float c[128], sums[4] = {0, 0, 0, 0};
#pragma unroll
  for (int i = 0; i < 128; i++)
    c[i] = 0;
  if (threadIdx.x < WIDE_ONES / 4)
    asm volatile("st.shared.u32 [%0], %1;" ::"r"(last + threadIdx.x * 4), "r"(ONES) : "memory");
  const int n = (o.depth + WIDE_DEPTH - 1) / WIDE_DEPTH;
  wide_copies ahead(o);
#pragma unroll
  for (int i = 0; i < WIDE_STAGES - 2; i++) {
    if (i < n)
      ahead.next(base + i * WIDE_STAGE);
    asm volatile("cp.async.commit_group;");
  }
  uint32_t stage = base, fill = base + (WIDE_STAGES - 2) * WIDE_STAGE;
  for (int i = 0; i < n; i++) {
    asm volatile("cp.async.wait_group %0;" ::"n"(WIDE_STAGES - 3));
    asm volatile("fence.proxy.async.shared::cta;" ::: "memory");
    __syncthreads();
    if (!idle) {
      asm volatile("wgmma.fence.sync.aligned;" ::: "memory");
      const uint64_t left = wide_operand(stage + half * WIDE_LINES),
                     right = wide_operand(stage + MO_GK_JOB_COLUMNS / 64 * WIDE_LINES);
#pragma unroll
      for (int row = 0; row < WIDE_DEPTH; row += 16) {
        wide_multiply(c, left + row * 128 / 16, right + row * 128 / 16);
        wide_sum(sums, left + row * 128 / 16, wide_ones(last));
      }
      asm volatile("wgmma.commit_group.sync.aligned;" ::: "memory");
    }
    if (i + WIDE_STAGES - 2 < n)
      ahead.next(fill);
    asm volatile("cp.async.commit_group;");
    asm volatile("wgmma.wait_group.sync.aligned 1;" ::: "memory");
    stage = stage + WIDE_STAGE == last ? base : stage + WIDE_STAGE;
    fill = fill + WIDE_STAGE == last ? base : fill + WIDE_STAGE;
  }
  asm volatile("wgmma.wait_group.sync.aligned 0;" ::: "memory");
  if (idle)
    return;
#pragma unroll
  for (int h = 0; h < 2; h++)
    if ((lane & 3) == 0)
      add_bias(o, warp * 16 + h * 8 + (lane >> 2), first == 0, sums[2 * h]);
#pragma unroll
  for (int j = 0; j < 32; j++)
#pragma unroll
    for (int h = 0; h < 2; h++)
      add_pair(o, warp * 16 + h * 8 + (lane >> 2), j * 8 + 2 * (lane & 3), first == 0,
               c[4 * j + 2 * h], c[4 * j + 2 * h + 1]);
}

#endif

static __global__ void __launch_bounds__(WIDE_THREADS, 1)
    wide_products_kernel(const __grid_constant__ mo_gk k, const uint32_t *jobs, uint32_t first,
                         uint32_t end)
{
#ifdef __CUDA_ARCH_FEAT_SM90_ALL
  extern __shared__ __align__(16) unsigned char shared[];
  if (*k.cancel == 0)
    wide_products(k, jobs[blockIdx.x], first, end, shared);
#else
  __trap(); /* for a different device: never called */
#endif
}

#endif
