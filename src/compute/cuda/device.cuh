/* device.cuh: an opened device: its stream, its buffers (which grow and are kept), and its last
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

/* The gradient's buffers on the device. */
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
  COURSES,
  CUTS,
  ENDINGS,
  PARAMETERS,
  D_PARAMETERS,
  PLACES
};

struct mo_device_layout {
  uint32_t shared_bytes;  /* of the devices that it was made for */
  const mo_robot *robots; /* NULL: none */
  uint32_t n;
  mo_gradient_plan plan;
};

/* State between calls for gradients. */
struct mo_cuda_gradient_state {
  cudaStream_t beside;          /* for the flag only */
  cudaEvent_t marks[5], copied; /* before and after each part of a pass; copied: when the host has
                                   the results of the rows */
  mo_cuda_buffer buffers[PLACES], weights;
  mo_cuda_buffer sums, results, parameters, endings; /* pinned */
  int *cancel;                                       /* on the device; read by the kernels */
  mo_device_layout *layout;                          /* for calls without a layout */
  mo_gk_weights tiles;
  uint32_t shared_bytes;
  mo_cuda_halves halves;
  mo_cuda_gradient_profile profile;
};

struct mo_device {
  int index, multiprocessors;
  uint64_t total_bytes; /* of the device's memory */
  bool lost;
  const struct mo_cuda_score_kernel *score; /* the kernel that scores rows */
  const struct mo_cuda_tasks_kernel *tasks; /* the same with tasks */
  char error[256];
  cudaStream_t stream;
  cudaEvent_t begin, end;
  int *cancel; /* in pinned memory; read by running kernels */
  int *cancel_on_device;
  /* On the device. */
  mo_cuda_buffer plan, velocities, outcomes, generators, counter, guided, lengths, inverted;
  /* Pinned memory of the host. */
  mo_cuda_buffer staged_plan, staged_outcomes, staged_generators;
  double generators_dt_s; /* the dt of the `generators_steps` steps in `generators` */
  uint32_t generators_steps;
  mo_cuda_gradient_state gradient;
};

struct mo_device_controller {
  char *weights;
};

/* Calls functions in turn until one returns a status other than 0. */
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

/* Returns MO_OK, or the code for `status`, and keeps its text and the name of the failed operation;
 * after any failure other than lack of memory, the device is lost. */
int mo_cuda_check(mo_device *device, cudaError_t status, const char *what);
/* Makes the buffer at least `bytes` large; its contents are lost if it grows. A buffer that cannot
 * grow becomes empty. */
int mo_cuda_reserve(mo_device *device, mo_cuda_buffer *buffer, size_t bytes);
int mo_cuda_reserve_pinned(mo_device *device, mo_cuda_buffer *buffer, size_t bytes);
void mo_cuda_release(mo_cuda_buffer *buffer);
void mo_cuda_release_pinned(mo_cuda_buffer *buffer);
/* Reserves memory and copies data in the device's stream. */
int mo_cuda_upload(mo_device *device, mo_cuda_buffer *buffer, const void *from, size_t bytes);

/* Waits for all work on the device's stream. While waiting, checks `cancel` (nullable) and passes
 * it on to the kernels through device->cancel. MO_ERR_CANCELLED; after any other error the device
 * is lost. */
int mo_cuda_wait(mo_device *device, const volatile int *cancel);

/* Computes sin(10 t + 2πk/5) for all steps on the device: device->generators. */
int mo_cuda_generators(mo_device *device, const mo_physics *physics);

int mo_cuda_score_rows(mo_device *device, mo_device_score *score);

/* The first takes an opened device, the second may take a partly opened one. */
int mo_cuda_gradient_open(mo_device *device);
void mo_cuda_gradient_close(mo_device *device);
/* Computes the gradient of a plan; the weights have been checked. memory_bytes: as in
 * mo_cuda_gradient_run. */
int mo_gradient_run_plan(mo_device *device, mo_device_gradient *call, mo_gradient_plan &plan,
                         uint64_t memory_bytes);

#endif
