/* device.cuh: one opened device: its stream, its buffers, which grow and stay, and its last
 * failure. */
#ifndef MORPHO_COMPUTE_CUDA_DEVICE_CUH
#define MORPHO_COMPUTE_CUDA_DEVICE_CUH

#include "compute/device.h"

#include "compute/cuda/gradient.h"
#include "compute/cuda/gradient_kernels.cuh"
#include "compute/cuda/gradient_plan.h"
#include "compute/cuda/weights.h"

#include <cuda_runtime.h>

#include <chrono>

/* Memory of the device, or pinned memory of the host. */
struct mo_cuda_buffer {
  void *memory;
  size_t bytes;

  template <class T> T *of() const
  {
    return (T *)memory;
  }
};

/* What the gradient has on the device. */
enum mo_gradient_place {
  GROUPS,
  ROWS,
  ORDER,
  INPUT,
  SPRINGS,
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

struct mo_device_layout {
  uint32_t shared_bytes;  /* of the devices that it is for */
  const mo_robot *robots; /* NULL: of none */
  uint32_t n;
  mo_gradient_plan plan;
};

/* What lasts from one call for gradients to the next. */
struct mo_cuda_gradient_state {
  cudaStream_t beside; /* for the flag only */
  cudaEvent_t marks[5],
      copied; /* before and after each part of a pass; when the host has what came of the rows */
  mo_cuda_buffer buffers[PLACES], weights;
  mo_cuda_buffer sums, results, parameters; /* pinned */
  int *cancel;                              /* on the device; read by the kernels */
  mo_device_layout *layout;                 /* of calls that bring none */
  mo_gk_weights tiles;
  uint32_t shared_bytes;
  mo_cuda_halves halves;
  mo_cuda_gradient_profile profile;
};

struct mo_device {
  int index, multiprocessors;
  uint64_t total_bytes; /* of the device's memory */
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
  mo_cuda_gradient_state gradient;
};

struct mo_device_controller {
  char *weights;
};

/* Calls in turn, until one gives another status than 0. */
template <class First, class... Rest> auto in_turn(First first, Rest... rest)
{
  auto status = first();
  ((status == 0 ? void(status = rest()) : void()), ...);
  return status;
}

static inline double now_s()
{
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

/* MO_OK, or the code for `status`, whose text and the name of what failed are kept; after any but a
 * lack of memory the device is lost. */
int mo_cuda_check(mo_device *device, cudaError_t status, const char *what);
/* Makes the buffer at least that large; its contents are lost if it grows. A buffer that cannot
 * grow is empty. */
int mo_cuda_reserve(mo_device *device, mo_cuda_buffer *buffer, size_t bytes);
int mo_cuda_reserve_pinned(mo_device *device, mo_cuda_buffer *buffer, size_t bytes);
void mo_cuda_release(mo_cuda_buffer *buffer);
void mo_cuda_release_pinned(mo_cuda_buffer *buffer);
/* Reserves, and copies in the device's stream. */
int mo_cuda_upload(mo_device *device, mo_cuda_buffer *buffer, const void *from, size_t bytes);

/* Waits for all work on the device's stream; looks at `cancel` (nullable) meanwhile, and passes it
 * on to the kernels by device->cancel. MO_ERR_CANCELLED; after any other error the device is lost.
 */
int mo_cuda_wait(mo_device *device, const volatile int *cancel);

/* sin(10 t + 2πk/5) of all steps, on the device: device->generators. */
int mo_cuda_generators(mo_device *device, const mo_physics *physics);

int mo_cuda_score_rows(mo_device *device, mo_device_score *score);

/* Of an opened device, and of one that may have been opened in part. */
int mo_cuda_gradient_open(mo_device *device);
void mo_cuda_gradient_close(mo_device *device);
/* The gradient of what was laid out, whose weights are checked. memory_bytes: as of
 * mo_cuda_gradient_run. */
int mo_gradient_run_plan(mo_device *device, mo_device_gradient *call, mo_gradient_plan &plan,
                         uint64_t memory_bytes);

#endif
