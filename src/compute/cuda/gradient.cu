/* gradient.cu: entry points of gradients, and their state on a device. Calls are checked here, laid
 * out by gradient_layout.cu, and run by gradient_run.cu. */
#include "compute/cuda/device.cuh"

#include <math.h>
#include <stdio.h>

#include <algorithm>
#include <new>
#include <vector>

namespace {

int place_weights(mo_device *device)
{
  mo_cuda_gradient_state *s = &device->gradient;
  const size_t tile = 32 * sizeof(uint4), tiles = 3 * 256 + (size_t)MO_GP_OUTPUT_TILES * 16;
  const size_t floats = 3 * 3 * MO_HIDDEN + MO_GP_OUTPUT_TILES * MO_GP_TILE;
  const int r = mo_cuda_reserve(device, &s->weights, 2 * tiles * tile + floats * sizeof(float));
  if (r < 0)
    return r;
  uint4 *at = (uint4 *)s->weights.memory;
  for (int l = 0; l <= MO_HIDDEN_LAYERS; l++) {
    const size_t n = (l < MO_HIDDEN_LAYERS ? 256 : (size_t)MO_GP_OUTPUT_TILES * 16) * 32;
    s->tiles.forward[l] = at;
    s->tiles.back[l] = at + n;
    at += 2 * n;
  }
  float *f = (float *)at;
  for (int l = 0; l <= MO_HIDDEN_LAYERS; l++) {
    s->tiles.bias[l] = f;
    f += l < MO_HIDDEN_LAYERS ? MO_HIDDEN : MO_GP_OUTPUT_TILES * MO_GP_TILE;
    if (l < MO_HIDDEN_LAYERS) {
      s->tiles.gain[l] = f;
      s->tiles.shift[l] = f + MO_HIDDEN;
      f += 2 * MO_HIDDEN;
    }
  }
  return MO_OK;
}

/* Returns whether the weights and all possible values of the hidden layers fit in float16, and no
 * bias is so large that LayerNorm's squares exceed float32. */
bool fits_half(const mo_controller *c)
{
  const float limit = 6e4f;
  for (int l = 0; l <= MO_HIDDEN_LAYERS; l++) {
    const size_t n = (l < MO_HIDDEN_LAYERS ? MO_HIDDEN : (size_t)c->n_springs) *
                     (l == 0 ? c->n_inputs : MO_HIDDEN);
    unsigned larger = 0;
    for (size_t i = 0; i < n; i++)
      larger |= !(fabsf(c->weight[l][i]) <= limit);
    if (larger)
      return false;
    for (int i = 0; l < MO_HIDDEN_LAYERS && i < MO_HIDDEN; i++)
      if (!(16 * fabsf(c->norm_gain[l][i]) + fabsf(c->norm_shift[l][i]) <= limit) ||
          !(fabsf(c->bias[l][i]) <= limit))
        return false;
  }
  return true;
}

} // namespace

int mo_cuda_gradient_open(mo_device *device)
{
  mo_cuda_gradient_state *s = &device->gradient;
  uint32_t forward = 0, back = 0, products = 0;
  int block = 0;
  const int status = in_turn(
      [&] {
        return (int)cudaDeviceGetAttribute(&block, cudaDevAttrMaxSharedMemoryPerBlockOptin,
                                           device->index);
      },
      [&] { return mo_gk_open_forward((uint32_t)block, &forward); },
      [&] { return mo_gk_open_back((uint32_t)block, &back); },
      [&] { return mo_gk_open_products((uint32_t)block, &products); },
      [&] { return (int)cudaStreamCreateWithFlags(&s->beside, cudaStreamNonBlocking); },
      [&] {
        cudaError_t created = cudaEventCreate(&s->copied);
        for (cudaEvent_t &mark : s->marks)
          created = created == cudaSuccess ? cudaEventCreate(&mark) : created;
        return (int)created;
      },
      [&] { return (int)cudaMalloc((void **)&s->cancel, sizeof(*s->cancel)); });
  s->shared_bytes = std::min(forward, back); /* the limit of a launch in both directions */
  return mo_cuda_check(device, (cudaError_t)status, "opening: gradient");
}

void mo_cuda_gradient_set_halves(struct mo_device *device, enum mo_cuda_halves halves)
{
  device->gradient.halves = halves;
}

void mo_cuda_gradient_close(mo_device *device)
{
  mo_cuda_gradient_state *s = &device->gradient;
  mo_cuda_gradient_trim(device);
  mo_cuda_gradient_layout_free(s->layout);
  mo_cuda_release(&s->weights);
  for (mo_cuda_buffer *b : {&s->sums, &s->results, &s->parameters, &s->endings})
    mo_cuda_release_pinned(b);
  cudaFree(s->cancel);
  for (cudaEvent_t mark : s->marks)
    if (mark != nullptr)
      cudaEventDestroy(mark);
  if (s->copied != nullptr)
    cudaEventDestroy(s->copied);
  if (s->beside != nullptr)
    cudaStreamDestroy(s->beside);
}

int mo_cuda_gradient_run(struct mo_device *device, struct mo_device_gradient *call,
                         uint64_t memory_bytes)
{
  const double since = now_s();
  mo_cuda_gradient_state *s = &device->gradient;
  s->profile = mo_cuda_gradient_profile();
  call->counts = mo_gradient_counts();
  call->host_s = call->device_s = 0;
  if (mo_control_steps(&call->physics.scheme) == 0)
    return MO_ERR_INVALID;
  if (!mo_workspace_equal(call->controller->workspace, mo_workspace{6, 6, 4}) ||
      !fits_half(call->controller)) {
    snprintf(device->error, sizeof(device->error), "these kernels do not support this controller");
    return MO_ERR_UNSUPPORTED;
  }
  mo_device_layout *layout = call->layout;
  int r = in_turn(
      [&] {
        return mo_cuda_check(device,
                             in_turn([&] { return cudaSetDevice(device->index); },
                                     [&] { return cudaStreamSynchronize(s->beside); },
                                     [&] {
                                       return cudaMemsetAsync(s->cancel, 0, sizeof(*s->cancel),
                                                              device->stream);
                                     }),
                             "device");
      },
      [&] { return s->weights.memory == nullptr ? place_weights(device) : MO_OK; },
      [&] {
        /* The caller has compared the physics and guarantees that it is the same; a device with a
         * different size of shared memory forms different groups. */
        if (layout != nullptr && layout->robots == call->robots && layout->n == call->n &&
            layout->shared_bytes == s->shared_bytes)
          return (int)MO_OK;
        const int laid =
            mo_cuda_gradient_lay_out(device, call->robots, call->n, &call->physics, &s->layout);
        layout = s->layout;
        return laid;
      });
  if (r < 0)
    return r;
  s->profile.plan_s = now_s() - since;
  try {
    r = mo_gradient_run_plan(device, call, layout->plan, memory_bytes);
  } catch (const std::bad_alloc &) { /* out of host memory */
    cudaStreamSynchronize(device->stream);
    r = MO_ERR_NO_MEMORY;
  }
  call->device_s =
      s->profile.forward_s + s->profile.back_s + s->profile.products_s + s->profile.collect_s;
  call->host_s = now_s() - since - call->device_s;
  return r;
}

const struct mo_cuda_gradient_profile *mo_cuda_gradient_times(const struct mo_device *device)
{
  return &device->gradient.profile;
}
