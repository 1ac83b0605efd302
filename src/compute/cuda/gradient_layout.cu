/* gradient_layout.cu: lays out batches before their weights are known, in memory that devices
 * access faster. Any thread may do this during a call on the device, because it reads only
 * constants of the device. */
#include "compute/cuda/device.cuh"

#include <stdlib.h>

#include <algorithm>
#include <thread>

/* The header before an allocation, which says how to free it. */
struct header {
  bool is_plain;
  int device;
};
enum { HEADER_BYTES = 256 };

void *mo_cuda_gradient_allocate(const struct mo_device *device, size_t bytes)
{
  void *memory = nullptr;
  cudaError_t status = cudaSetDevice(device->index);
  if (status == cudaSuccess)
    status = cudaHostAlloc(&memory, bytes + HEADER_BYTES, cudaHostAllocPortable);
  const bool is_plain = status != cudaSuccess;
  if (is_plain) {
    (void)cudaGetLastError();
    memory =
        aligned_alloc(HEADER_BYTES, (bytes + 2 * HEADER_BYTES - 1) / HEADER_BYTES * HEADER_BYTES);
  }
  if (memory == nullptr)
    return nullptr;
  *(header *)memory = header{is_plain, device->index};
  return (char *)memory + HEADER_BYTES;
}

void mo_cuda_gradient_release(void *memory)
{
  if (memory == nullptr)
    return;
  void *const all = (char *)memory - HEADER_BYTES;
  const header of = *(const header *)all;
  if (of.is_plain) {
    free(all);
    return;
  }
  cudaSetDevice(of.device); /* a thread that has not used a device yet would open the first, which
                               may not be ours */
  cudaFreeHost(all);
}

static void *allocate_table(void *device, size_t bytes)
{
  return mo_cuda_gradient_allocate((const mo_device *)device, bytes);
}

int mo_cuda_gradient_lay_out(const struct mo_device *device, const struct mo_robot *robots,
                             uint32_t n, const struct mo_physics *physics,
                             struct mo_device_layout **ret)
{
  mo_device_layout *layout = *ret;
  if (layout == nullptr) {
    layout = *ret = (mo_device_layout *)calloc(1, sizeof(*layout));
    if (layout == nullptr)
      return MO_ERR_NO_MEMORY;
    layout->plan.allocate = allocate_table;
    layout->plan.release = mo_cuda_gradient_release;
    layout->plan.context = (void *)device;
  }
  const mo_gp_options options = {MO_DEVICE_SHARD, device->gradient.shared_bytes,
                                 std::min(8u, std::max(1u, std::thread::hardware_concurrency()))};
  layout->robots = nullptr;
  const int r = mo_gradient_plan_make(robots, n, physics, &options, &layout->plan);
  if (r < 0)
    return r;
  layout->shared_bytes = device->gradient.shared_bytes;
  layout->robots = robots;
  layout->n = n;
  return MO_OK;
}

void mo_cuda_gradient_layout_free(struct mo_device_layout *layout)
{
  if (layout == nullptr)
    return;
  mo_gradient_plan_free(&layout->plan);
  free(layout);
}
