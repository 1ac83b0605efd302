/* device.cuh: one opened device: its stream, its buffers, which grow and stay, and its last failure. */
#ifndef MORPHO_COMPUTE_CUDA_DEVICE_CUH
#define MORPHO_COMPUTE_CUDA_DEVICE_CUH

#include "compute/device.h"

#include "compute/cuda/weights.h"

#include <cuda_runtime.h>

struct mo_cuda_buffer {
  void *memory;
  size_t bytes;
};

struct mo_cuda_gradient_state; /* gradient.cu's own */

struct mo_device {
  int index, multiprocessors;
  bool lost;
  const struct mo_cuda_score_kernel *score; /* which scores rows */
  char error[256];
  cudaStream_t stream;
  cudaEvent_t begin, end;
  int *cancel; /* in pinned memory: read by kernels while they run */
  int *cancel_on_device;
  /* On the device. */
  mo_cuda_buffer plan, velocities, outcomes, generators, counter;
  /* Pinned memory of the host. */
  mo_cuda_buffer staged_plan, staged_outcomes, staged_generators;
  double generators_dt_s; /* for which `generators` holds `generators_steps` steps */
  uint32_t generators_steps;
  mo_cuda_gradient_state *gradient;
};

struct mo_device_controller {
  char *weights;
};

/* MO_OK, or the code for `status`, whose text and the name of what failed are kept. */
int mo_cuda_check(mo_device *device, cudaError_t status, const char *what);
/* Makes the buffer at least that large; its contents are lost if it grows. A buffer that cannot grow is empty. */
int mo_cuda_reserve(mo_device *device, mo_cuda_buffer *buffer, size_t bytes);
int mo_cuda_reserve_pinned(mo_device *device, mo_cuda_buffer *buffer, size_t bytes);
void mo_cuda_release(mo_cuda_buffer *buffer);
void mo_cuda_release_pinned(mo_cuda_buffer *buffer);

/* Waits for all work on the device's stream; looks at `cancel` (nullable) meanwhile, and passes it on to the kernels by
 * device->cancel. MO_ERR_CANCELLED; after any other error the device is lost. */
int mo_cuda_wait(mo_device *device, const volatile int *cancel);

/* sin(10 t + 2πk/5) of all steps, on the device: device->generators. */
int mo_cuda_generators(mo_device *device, const mo_physics *physics);

int mo_cuda_score_rows(mo_device *device, mo_device_score *score);

#endif
