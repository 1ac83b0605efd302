/* gradient_matrix.cuh: the matrix instructions of the gradient.
 *
 * In every product each of the sixteen warps of a block takes sixteen columns (neurons or springs),
 * for all rows. Activations are the left factor, in shared memory; weights are the right factor,
 * read directly from global memory in the order of the lanes' registers: 16 bytes per lane for a
 * tile of 16 × 16. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_MATRIX_CUH
#define MORPHO_COMPUTE_CUDA_GRADIENT_MATRIX_CUH

#include <cuda_bf16.h>
#include <cuda_fp16.h>
#include <stdint.h>

#ifdef __CUDACC__

static __device__ __forceinline__ uint32_t shared_address(const void *p)
{
  return (uint32_t)__cvta_generic_to_shared(p);
}

static __device__ __forceinline__ void load_matrices(uint32_t r[4], uint32_t address)
{
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0,%1,%2,%3}, [%4];"
               : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3])
               : "r"(address));
}

static __device__ __forceinline__ void load_matrices_transposed(uint32_t r[4], uint32_t address)
{
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0,%1,%2,%3}, [%4];"
               : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3])
               : "r"(address));
}

template <bool BF>
static __device__ __forceinline__ void multiply(float c[4], const uint32_t a[4], uint32_t b0,
                                                uint32_t b1)
{
  if (BF)
    asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0,%1,%2,%3}, "
                 "{%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
                 : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
                 : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
  else
    asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, "
                 "{%8,%9}, {%0,%1,%2,%3};"
                 : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
                 : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}

/* Every block reads the weights at every step: they stay in the second-level cache and leave the
 * first level to other data. */
static __device__ __forceinline__ uint4 load_weights(const uint4 *p)
{
  uint4 w;
  asm volatile("ld.global.nc.L1::no_allocate.v4.u32 {%0,%1,%2,%3}, [%4];"
               : "=r"(w.x), "=r"(w.y), "=r"(w.z), "=r"(w.w)
               : "l"(p));
  return w;
}

/* A warp's sums: c[m][j][2 h + e] is row 16 m + 8 h + lane/4, column 4 (lane % 4) + 2 j + e of its
 * sixteen: the columns of the instruction are distributed so that a lane has four consecutive ones
 * (pack_kernel). */
template <int MT> struct warp_sums {
  float c[MT][2][4];
  __device__ __forceinline__ void clear()
  {
#pragma unroll
    for (int m = 0; m < MT; m++)
#pragma unroll
      for (int j = 0; j < 2; j++)
#pragma unroll
        for (int k = 0; k < 4; k++)
          c[m][j][k] = 0;
  }
};

/* Four 16-bit numbers. */
template <class T> static __device__ __forceinline__ uint2 four(const T &a, const T &b)
{
  return make_uint2(*(const uint32_t *)&a, *(const uint32_t *)&b);
}

/* Weights in flight: a ring of N tiles, requested before they are needed, even before the other
 * factor is available. */
template <int N> struct weights_ahead {
  uint4 w[N];
  /* tile(k): this lane's part of the k-th tile. */
  template <class Tile> __device__ __forceinline__ void start(Tile tile)
  {
#pragma unroll
    for (int i = 0; i < N; i++)
      w[i] = load_weights(tile(i));
  }
};

/* Returns this lane's address of activations in rows of `row_bytes`. */
static __device__ __forceinline__ uint32_t left_address(const void *activations, uint32_t row_bytes,
                                                        int lane)
{
  return shared_address(activations) + (uint32_t)(lane & 15) * row_bytes +
         (uint32_t)(lane >> 4) * 16;
}

#endif
#endif
