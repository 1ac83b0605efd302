/* gradient_state.cuh: what lasts from one call for gradients to the next on a device: streams, buffers, which grow to what the calls need, and the
 * layout of calls that bring none. */
#ifndef MORPHO_COMPUTE_CUDA_GRADIENT_STATE_CUH
#define MORPHO_COMPUTE_CUDA_GRADIENT_STATE_CUH

#include "compute/cuda/gradient.h"
#include "compute/cuda/gradient_kernels.cuh"

#include <cuda_runtime.h>

#include <chrono>
#include <stdio.h>
#include <vector>

struct mo_gradient_buffer {
  void *at = nullptr;
  uint64_t bytes = 0;
};

enum mo_gradient_place {
  GROUPS,
  ROWS,
  ORDER,
  INPUT,
  SPRINGS,
  GENERATORS,
  TAPE,
  SUMS,
  POSITION,
  VELOCITY,
  RESULTS,
  TICKETS,
  JOBS,
  SHARDS,
  PARAMETERS,
  D_PARAMETERS,
  PLACES
};

static inline double now_s()
{
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

struct mo_device_layout {
  uint32_t shared_bytes;  /* of the devices that it is for */
  const mo_robot *robots; /* NULL: of none */
  uint32_t n;
  mo_gradient_plan plan;
};

struct mo_cuda_gradient_state {
  int device;
  cudaStream_t stream, beside;  /* beside: for the flag alone */
  cudaEvent_t marks[5], copied; /* before and after each part of a pass; when the host has what came of the rows */
  mo_gradient_buffer buffers[PLACES], weights;
  mo_gradient_buffer sums, results, parameters; /* pinned memory of the host */
  int *cancel;                                  /* on the device; read by the kernels */
  mo_device_layout *layout;                     /* of calls that bring none */
  std::vector<float> *generators;
  double generators_dt_s; /* of the steps that `generators` has */
  mo_gk_weights tiles;
  uint32_t shared_bytes;
  uint64_t total_bytes; /* of the device's memory */
  int multiprocessors;
  mo_cuda_halves halves;
  char error[256];
  mo_cuda_gradient_profile profile;

  int fail(cudaError_t status, const char *what)
  {
    snprintf(error, sizeof(error), "%s: %s", what, cudaGetErrorString(status));
    if (status == cudaErrorMemoryAllocation) {
      (void)cudaGetLastError();
      return MO_ERR_NO_MEMORY;
    }
    return MO_ERR_DEVICE;
  }

  int reserve(mo_gradient_place p, uint64_t bytes)
  {
    mo_gradient_buffer &b = buffers[p];
    if (b.bytes >= bytes)
      return MO_OK;
    cudaFree(b.at);
    b = mo_gradient_buffer();
    /* Bodies differ from step to step: so that the next batches fit, too. To give back and get a tape takes as long as a way through it. */
    const uint64_t wanted[] = {bytes + bytes / 8 + 4096, bytes + bytes / 64 + 4096};
    cudaError_t status = cudaErrorMemoryAllocation;
    for (int i = 0; i < 2 && status == cudaErrorMemoryAllocation; i++) {
      (void)cudaGetLastError();
      status = cudaMalloc(&b.at, wanted[i]);
      b.bytes = wanted[i];
    }
    if (status != cudaSuccess) {
      b = mo_gradient_buffer();
      return fail(status, "device memory");
    }
    return MO_OK;
  }

  int reserve_pinned(mo_gradient_buffer &b, uint64_t bytes)
  {
    if (b.bytes >= bytes)
      return MO_OK;
    cudaFreeHost(b.at);
    b = mo_gradient_buffer();
    const cudaError_t status = cudaHostAlloc(&b.at, bytes + bytes / 8, cudaHostAllocDefault);
    if (status != cudaSuccess) {
      b.at = nullptr;
      return fail(status, "pinned memory");
    }
    b.bytes = bytes + bytes / 8;
    return MO_OK;
  }

  int upload(mo_gradient_place p, const void *from, uint64_t bytes)
  {
    const int r = reserve(p, bytes);
    if (r < 0)
      return r;
    const cudaError_t status = cudaMemcpyAsync(buffers[p].at, from, bytes, cudaMemcpyHostToDevice, stream);
    return status == cudaSuccess ? MO_OK : fail(status, "copy to the device");
  }

  template <class T> T *of(mo_gradient_place p) const
  {
    return (T *)buffers[p].at;
  }

  uint64_t held() const
  {
    uint64_t sum = weights.bytes;
    for (const mo_gradient_buffer &b : buffers)
      sum += b.bytes;
    return sum;
  }
};

/* Whether it is of the robots of this call, and for its device. */
bool mo_gradient_layout_is_of(const mo_device_layout *layout, const mo_cuda_gradient_state *s,
                              const mo_device_gradient *call);
/* The gradient of what was laid out, whose weights are checked. memory_bytes: as of mo_cuda_gradient_run. */
int mo_gradient_run_plan(mo_cuda_gradient_state *s, mo_device_gradient *call, mo_gradient_plan &plan,
                         uint64_t memory_bytes);

#endif
