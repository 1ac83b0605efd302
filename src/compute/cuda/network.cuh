/* network.cuh: the part of the network that is shared by the kernels for all devices
 * (network_narrow.cuh) and for those with wgmma (network_wide.cuh), one of which is included first.
 * Activations are pairs of float16: values g and g + 8 of a tile are adjacent (weights.h). */
#ifndef MORPHO_COMPUTE_CUDA_NETWORK_CUH
#define MORPHO_COMPUTE_CUDA_NETWORK_CUH

#include "compute/cuda/plan_block.h"
#include "compute/cuda/weights.h"

#include <cuda_fp16.h>
#include <stdint.h>

#define MO_CUDA_UNIT_BYTES   512 /* per column */
#define MO_CUDA_COLUMN_BYTES (MO_WEIGHTS_UNITS * MO_CUDA_UNIT_BYTES)

/* Stores two values of the activations, and the remainders of rounding them `low` bytes after
 * them. */
__device__ __forceinline__ void mo_cuda_store_pair(char *place, uint32_t low, float first,
                                                   float second)
{
  const __half2 high = __floats2half2_rn(first, second);
  *reinterpret_cast<__half2 *>(place) = high;
  const float2 back = __half22float2(high);
  *reinterpret_cast<__half2 *>(place + low) = __floats2half2_rn(first - back.x, second - back.y);
}

/* Stores one value. */
__device__ __forceinline__ void mo_cuda_store_one(char *place, uint32_t low, float value)
{
  const __half high = __float2half_rn(value);
  *reinterpret_cast<__half *>(place) = high;
  *reinterpret_cast<__half *>(place + low) = __float2half_rn(value - __half2float(high));
}

__device__ __forceinline__ uint4 mo_cuda_load_weights(const char *address)
{
  uint4 v;
  asm volatile("ld.global.nc.L1::no_allocate.v4.u32 {%0, %1, %2, %3}, [%4];"
               : "=r"(v.x), "=r"(v.y), "=r"(v.z), "=r"(v.w)
               : "l"(address));
  return v;
}

/* Returns tanh with an error of at most 3e-7. */
__device__ __forceinline__ float mo_cuda_tanh(float x)
{
  return fmaf(-2.0f, __fdividef(1.0f, 1.0f + __expf(2.0f * x)), 1.0f);
}

#endif
