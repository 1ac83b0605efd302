/* host.cu: buffers, errors, waiting: what all calls on a device share. */
#include "compute/cuda/device.cuh"

#include <math.h>
#include <stdio.h>

#include <thread>

int mo_cuda_check(mo_device *device, cudaError_t status, const char *what)
{
  if (status == cudaSuccess)
    return MO_OK;
  snprintf(device->error, sizeof(device->error), "%s: %s", what, cudaGetErrorString(status));
  cudaGetLastError(); /* an error that does not stick is not to be found again by the next call */
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

/* A little more than asked for, so that calls of nearly equal size do not each grow it: to give
 * back and get the gradient's tape takes as long as a way through it. Where there is no room for
 * that, less. */
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
