/* host.cu: buffers, errors and waiting, for all calls on a device. */
#include "compute/cuda/device.cuh"

#include <math.h>
#include <stdio.h>

#include <thread>

int mo_cuda_check(mo_device *device, cudaError_t status, const char *what)
{
  if (status == cudaSuccess)
    return MO_OK;
  snprintf(device->error, sizeof(device->error), "%s: %s", what, cudaGetErrorString(status));
  cudaGetLastError(); /* clear it, so that the next call does not report an error that does not
                         persist */
  if (status == cudaErrorMemoryAllocation)
    return MO_ERR_NO_MEMORY;
  device->lost = true;
  return MO_ERR_DEVICE;
}

void mo_cuda_release(mo_cuda_buffer *buffer)
{
  cudaFree(buffer->memory);
  *buffer = mo_cuda_buffer{};
}

void mo_cuda_release_pinned(mo_cuda_buffer *buffer)
{
  cudaFreeHost(buffer->memory);
  *buffer = mo_cuda_buffer{};
}

/* Allocates slightly more than requested, so that calls of nearly equal size do not grow the buffer
 * each time: freeing and allocating the gradient's tape takes as long as a pass over it. If memory
 * does not suffice for that, allocates less. */
int mo_cuda_reserve(mo_device *device, mo_cuda_buffer *buffer, size_t bytes)
{
  if (bytes <= buffer->bytes)
    return MO_OK;
  mo_cuda_release(buffer);
  const size_t wanted[] = {bytes + bytes / 8 + 4096, bytes + bytes / 64 + 4096};
  int status = MO_ERR_NO_MEMORY;
  for (int i = 0; i < 2 && status == MO_ERR_NO_MEMORY; i++) {
    void *memory = nullptr;
    status = mo_cuda_check(device, cudaMalloc(&memory, wanted[i]), "device memory");
    if (status == MO_OK)
      *buffer = mo_cuda_buffer{memory, wanted[i]};
  }
  return status;
}

int mo_cuda_reserve_pinned(mo_device *device, mo_cuda_buffer *buffer, size_t bytes)
{
  if (bytes <= buffer->bytes)
    return MO_OK;
  mo_cuda_release_pinned(buffer);
  const size_t wanted = bytes + bytes / 8 + 4096;
  void *memory = nullptr;
  const int status =
      mo_cuda_check(device, cudaHostAlloc(&memory, wanted, cudaHostAllocDefault), "pinned memory");
  if (status == MO_OK)
    *buffer = mo_cuda_buffer{memory, wanted};
  return status;
}

int mo_cuda_upload(mo_device *device, mo_cuda_buffer *buffer, const void *from, size_t bytes)
{
  return in_turn([=] { return mo_cuda_reserve(device, buffer, bytes); },
                 [=] {
                   return mo_cuda_check(device,
                                        cudaMemcpyAsync(buffer->memory, from, bytes,
                                                        cudaMemcpyHostToDevice, device->stream),
                                        "copy to the device");
                 });
}

int mo_cuda_wait(mo_device *device, const volatile int *cancel)
{
  bool cancelled = false;
  cudaError_t status = cudaErrorNotReady;
  while (cancel != nullptr && (status = cudaStreamQuery(device->stream)) == cudaErrorNotReady) {
    if (!cancelled && __atomic_load_n(cancel, __ATOMIC_RELAXED) != 0) {
      cancelled = true;
      *(volatile int *)device->cancel = 1;
    }
    std::this_thread::sleep_for(std::chrono::microseconds(100));
  }
  if (status == cudaSuccess || status == cudaErrorNotReady)
    status = cudaStreamSynchronize(device->stream);
  *(volatile int *)device->cancel = 0;
  const int code = mo_cuda_check(device, status, "device work");
  return code == MO_OK && cancelled ? MO_ERR_CANCELLED : code;
}

int mo_cuda_generators(mo_device *device, const mo_physics *physics)
{
  if (device->generators_dt_s == physics->scheme.dt_s &&
      device->generators_steps >= physics->scheme.n_steps)
    return MO_OK;
  const size_t bytes = (size_t)physics->scheme.n_steps * MO_CPG_INPUTS * sizeof(float);
  device->generators_steps = 0;
  int status = mo_cuda_reserve_pinned(device, &device->staged_generators, bytes);
  if (status != MO_OK)
    return status;
  float *out = (float *)device->staged_generators.memory;
  for (uint32_t step = 0; step < physics->scheme.n_steps; step++)
    for (int k = 0; k < MO_CPG_INPUTS; k++)
      *out++ = (float)sin(MO_CPG_RAD_PER_S * (step * physics->scheme.dt_s) +
                          2.0 * M_PI * k / MO_CPG_INPUTS);
  status = mo_cuda_upload(device, &device->generators, device->staged_generators.memory, bytes);
  if (status == MO_OK) {
    device->generators_dt_s = physics->scheme.dt_s;
    device->generators_steps = physics->scheme.n_steps;
  }
  return status;
}
