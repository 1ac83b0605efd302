/* host.cu: buffers, errors, waiting: what all calls on a device share. */
#include "compute/cuda/device.cuh"

#include <math.h>
#include <stdio.h>
#include <time.h>

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

/* A little more than asked for, so that calls of nearly equal size do not each grow it. */
static size_t grown(size_t bytes)
{
  return (bytes + bytes / 8 + 0xffff) & ~(size_t)0xffff;
}

int mo_cuda_reserve(mo_device *device, mo_cuda_buffer *buffer, size_t bytes)
{
  if (bytes <= buffer->bytes)
    return MO_OK;
  mo_cuda_release(buffer);
  void *memory = nullptr;
  const int status = mo_cuda_check(device, cudaMalloc(&memory, grown(bytes)), "device memory");
  if (status == MO_OK)
    *buffer = mo_cuda_buffer{memory, grown(bytes)};
  return status;
}

int mo_cuda_reserve_pinned(mo_device *device, mo_cuda_buffer *buffer, size_t bytes)
{
  if (bytes <= buffer->bytes)
    return MO_OK;
  mo_cuda_release_pinned(buffer);
  void *memory = nullptr;
  const int status = mo_cuda_check(device, cudaHostAlloc(&memory, grown(bytes), cudaHostAllocDefault), "pinned memory");
  if (status == MO_OK)
    *buffer = mo_cuda_buffer{memory, grown(bytes)};
  return status;
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
    const timespec pause = {0, 100000};
    nanosleep(&pause, nullptr);
  }
  if (status == cudaSuccess || status == cudaErrorNotReady)
    status = cudaStreamSynchronize(device->stream);
  *(volatile int *)device->cancel = 0;
  const int code = mo_cuda_check(device, status, "device work");
  return code == MO_OK && cancelled ? MO_ERR_CANCELLED : code;
}

int mo_cuda_generators(mo_device *device, const mo_physics *physics)
{
  if (device->generators_dt_s == physics->dt_s && device->generators_steps >= physics->n_steps)
    return MO_OK;
  const size_t bytes = (size_t)physics->n_steps * MO_CPG_INPUTS * sizeof(float);
  device->generators_steps = 0;
  int status = mo_cuda_reserve(device, &device->generators, bytes);
  if (status == MO_OK)
    status = mo_cuda_reserve_pinned(device, &device->staged_generators, bytes);
  if (status != MO_OK)
    return status;
  float *out = (float *)device->staged_generators.memory;
  for (uint32_t step = 0; step < physics->n_steps; step++)
    for (int k = 0; k < MO_CPG_INPUTS; k++)
      *out++ = (float)sin(MO_CPG_RAD_PER_S * (step * physics->dt_s) + 2.0 * M_PI * k / MO_CPG_INPUTS);
  status = mo_cuda_check(device,
                         cudaMemcpyAsync(device->generators.memory, device->staged_generators.memory, bytes,
                                         cudaMemcpyHostToDevice, device->stream),
                         "upload of generators");
  if (status == MO_OK) {
    device->generators_dt_s = physics->dt_s;
    device->generators_steps = physics->n_steps;
  }
  return status;
}
