/* module.cu: the table of functions that the service loads, with devices and controllers. */
#include "compute/cuda/device.cuh"
#include "compute/cuda/score.cuh"

#include <new>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

namespace {

constexpr int kMajor = 8; /* compute capability 8.0 or newer, with enough shared memory */

/* Finds a device that the kernels support, by its number among them. */
int find(uint32_t index, int *ordinal, uint32_t *n)
{
  int count = 0;
  *n = 0;
  if (cudaGetDeviceCount(&count) != cudaSuccess) {
    cudaGetLastError(); /* no driver, or no device */
    return MO_OK;
  }
  for (int i = 0; i < count; i++) {
    int major = 0, shared_bytes = 0;
    if (cudaDeviceGetAttribute(&major, cudaDevAttrComputeCapabilityMajor, i) != cudaSuccess ||
        cudaDeviceGetAttribute(&shared_bytes, cudaDevAttrMaxSharedMemoryPerBlockOptin, i) !=
            cudaSuccess) {
      cudaGetLastError();
      continue;
    }
    if (major < kMajor || shared_bytes < MO_CUDA_SCORE_NARROW_BYTES)
      continue;
    if (*n == index)
      *ordinal = i;
    (*n)++;
  }
  return MO_OK;
}

int count(uint32_t *n)
{
  int ordinal;
  return find(UINT32_MAX, &ordinal, n);
}

void close(mo_device *device)
{
  if (device == nullptr)
    return;
  cudaSetDevice(device->index);
  mo_cuda_gradient_close(device);
  mo_cuda_buffer *const buffers[] = {&device->plan,       &device->velocities, &device->outcomes,
                                     &device->generators, &device->counter,    &device->guided,
                                     &device->lengths,    &device->inverted};
  mo_cuda_buffer *const pinned[] = {&device->staged_plan, &device->staged_outcomes,
                                    &device->staged_generators};
  for (mo_cuda_buffer *buffer : buffers)
    mo_cuda_release(buffer);
  for (mo_cuda_buffer *buffer : pinned)
    mo_cuda_release_pinned(buffer);
  if (device->cancel != nullptr)
    cudaFreeHost(device->cancel);
  if (device->begin != nullptr)
    cudaEventDestroy(device->begin);
  if (device->end != nullptr)
    cudaEventDestroy(device->end);
  if (device->stream != nullptr)
    cudaStreamDestroy(device->stream);
  cudaGetLastError();
  delete device;
}

/* Returns whether the device can score rows with the wide kernel. */
bool can_wide(int index)
{
  int major = 0, minor = 0, bytes = 0;
  const cudaError_t status = in_turn(
      [&] { return cudaDeviceGetAttribute(&major, cudaDevAttrComputeCapabilityMajor, index); },
      [&] { return cudaDeviceGetAttribute(&minor, cudaDevAttrComputeCapabilityMinor, index); },
      [&] {
        return cudaDeviceGetAttribute(&bytes, cudaDevAttrMaxSharedMemoryPerBlockOptin, index);
      });
  if (status != cudaSuccess)
    cudaGetLastError(); /* opening will report the error */
  return status == cudaSuccess && 10 * major + minor == MO_CUDA_SCORE_WIDE_CAPABILITY &&
         bytes >= MO_CUDA_SCORE_WIDE_BYTES;
}

bool all_can_wide()
{
  uint32_t n = 0, again = 0;
  int ordinal = 0;
  bool all = true;
  find(UINT32_MAX, &ordinal, &n);
  for (uint32_t i = 0; i < n && all; i++) {
    find(i, &ordinal, &again);
    all = can_wide(ordinal);
  }
  return n > 0 && all;
}

/* The two kernels that score rows differ in the last digits. A score must not depend on the
 * device's number, so all devices of a machine use the same kernel. */
bool is_wide()
{
  static const bool wide = all_can_wide();
  return wide;
}

cudaError_t set_up(mo_device *device)
{
  size_t free_bytes = 0, total_bytes = 0;
  device->score = is_wide() ? &mo_cuda_score_wide : &mo_cuda_score_narrow;
  device->tasks = is_wide() ? &mo_cuda_tasks_wide : &mo_cuda_tasks_narrow;
  const cudaError_t status = in_turn(
      [&] { return cudaSetDevice(device->index); },
      [&] {
        return cudaDeviceGetAttribute(&device->multiprocessors, cudaDevAttrMultiProcessorCount,
                                      device->index);
      },
      [&] { return cudaMemGetInfo(&free_bytes, &total_bytes); },
      [&] { return cudaStreamCreateWithFlags(&device->stream, cudaStreamNonBlocking); },
      [&] { return cudaEventCreate(&device->begin); },
      [&] { return cudaEventCreate(&device->end); },
      [&] { return cudaHostAlloc((void **)&device->cancel, sizeof(int), cudaHostAllocMapped); },
      [&] {
        *device->cancel = 0;
        return cudaHostGetDevicePointer((void **)&device->cancel_on_device, device->cancel, 0);
      },
      [&] { return device->score->prepare(); }, [&] { return device->tasks->prepare(); });
  device->total_bytes = total_bytes;
  return status;
}

int open(uint32_t index, mo_device **ret)
{
  uint32_t n = 0;
  int ordinal = 0;
  find(index, &ordinal, &n);
  if (index >= n)
    return MO_ERR_NOT_FOUND;
  mo_device *device = new (std::nothrow) mo_device();
  if (device == nullptr)
    return MO_ERR_NO_MEMORY;
  device->index = ordinal;
  const int status = in_turn([=] { return mo_cuda_check(device, set_up(device), "opening"); },
                             [=] { return mo_cuda_gradient_open(device); });
  if (status != MO_OK)
    close(device);
  else
    *ret = device;
  return status;
}

int info(mo_device *device, mo_device_info *info)
{
  cudaDeviceProp properties;
  size_t free_bytes = 0, total_bytes = 0;
  const cudaError_t error =
      in_turn([&] { return cudaSetDevice(device->index); },
              [&] { return cudaGetDeviceProperties(&properties, device->index); },
              [&] { return cudaMemGetInfo(&free_bytes, &total_bytes); });
  const int status = mo_cuda_check(device, error, "properties");
  if (status != MO_OK)
    return status;
  *info = mo_device_info{};
  snprintf(info->name, sizeof(info->name), "%s", properties.name);
  char *out = info->id + snprintf(info->id, sizeof(info->id), "GPU");
  for (int i = 0; i < 16; i++)
    out += snprintf(out, sizeof(info->id) - (size_t)(out - info->id), "%s%02x",
                    i == 0 || i == 4 || i == 6 || i == 8 || i == 10 ? "-" : "",
                    (unsigned)(unsigned char)properties.uuid.bytes[i]);
  info->memory_bytes = total_bytes;
  info->free_bytes = free_bytes;
  info->multiprocessors = (uint32_t)properties.multiProcessorCount;
  info->capability = (uint32_t)(10 * properties.major + properties.minor);
  return MO_OK;
}

void controller_free(mo_device *device, mo_device_controller *controller)
{
  if (controller == nullptr)
    return;
  cudaSetDevice(device->index);
  cudaFree(controller->weights);
  cudaGetLastError();
  delete controller;
}

int upload(mo_device *device, const mo_controller *controller, char **weights)
{
  const size_t bytes = mo_weights_layout().bytes;
  void *packed = aligned_alloc(256, (bytes + 255) / 256 * 256);
  if (packed == nullptr)
    return MO_ERR_NO_MEMORY;
  int status = mo_weights_pack(controller, packed);
  if (status == MO_OK) {
    status = mo_cuda_check(device, cudaMalloc((void **)weights, bytes), "weights");
    if (status == MO_ERR_NO_MEMORY) {
      mo_cuda_gradient_trim(device);
      status = mo_cuda_check(device, cudaMalloc((void **)weights, bytes), "weights");
    }
  }
  if (status == MO_OK) /* in the stream of the kernels that read them, which wait for no other
                          stream */
    status = mo_cuda_check(
        device, cudaMemcpyAsync(*weights, packed, bytes, cudaMemcpyHostToDevice, device->stream),
        "upload of weights");
  if (status == MO_OK)
    status = mo_cuda_wait(device, nullptr);
  free(packed);
  return status;
}

int controller_create(mo_device *device, const mo_controller *controller,
                      mo_device_controller **ret)
{
  int status = mo_cuda_check(device, cudaSetDevice(device->index), "device");
  mo_device_controller *made = new (std::nothrow) mo_device_controller();
  if (made == nullptr)
    return MO_ERR_NO_MEMORY;
  if (status == MO_OK)
    status = upload(device, controller, &made->weights);
  if (status != MO_OK)
    controller_free(device, made);
  else
    *ret = made;
  return status;
}

int score(mo_device *device, mo_device_score *score)
{
  if (device->lost)
    return MO_ERR_DEVICE;
  int status = mo_cuda_check(device, cudaSetDevice(device->index), "device");
  if (status == MO_OK)
    status = mo_cuda_score_rows(device, score);
  if (status != MO_ERR_NO_MEMORY || device->lost)
    return status;
  mo_cuda_gradient_trim(device); /* its tape is most of the allocated memory */
  return mo_cuda_score_rows(device, score);
}

int gradient(mo_device *device, mo_device_gradient *gradient)
{
  return device->lost ? MO_ERR_DEVICE : mo_cuda_gradient_run(device, gradient, 0);
}

const char *error(const mo_device *device)
{
  return device->error;
}

} // namespace

extern "C" const struct mo_device_module *mo_device_module(void)
{
  static const struct mo_device_module module = {
      MO_DEVICE_ABI,
      "cuda",
      is_wide() ? "score 5 wide" : "score 5",
      MO_CUDA_GRADIENT_CODE,
      count,
      open,
      close,
      info,
      controller_create,
      controller_free,
      score,
      gradient,
      mo_cuda_gradient_lay_out,
      mo_cuda_gradient_layout_free,
      mo_cuda_gradient_allocate,
      mo_cuda_gradient_release,
      error,
  };
  return &module;
}
