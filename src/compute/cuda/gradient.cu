/* gradient.cu: calls for gradients, and what they need of a device: checked here, laid out by gradient_layout.cu, run by gradient_run.cu. */
#include "compute/cuda/gradient_state.cuh"

#include <math.h>
#include <stdlib.h>

#include <algorithm>
#include <new>
#include <vector>

namespace {

int place_weights(mo_cuda_gradient_state *s)
{
  const size_t tile = 32 * sizeof(uint4), tiles = 3 * 256 + (size_t)MO_GP_OUTPUT_TILES * 16;
  const size_t floats = 3 * 3 * MO_HIDDEN + MO_GP_OUTPUT_TILES * MO_GP_TILE;
  s->weights.bytes = 2 * tiles * tile + floats * sizeof(float);
  const cudaError_t status = cudaMalloc(&s->weights.at, s->weights.bytes);
  if (status != cudaSuccess) {
    s->weights = mo_gradient_buffer();
    return s->fail(status, "device memory");
  }
  uint4 *at = (uint4 *)s->weights.at;
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

/* float16 holds the weights, and what the hidden layers can come to; no bias is so large that LayerNorm's squares leave float32. */
bool fits_half(const mo_controller *c)
{
  const float limit = 6e4f;
  for (int l = 0; l <= MO_HIDDEN_LAYERS; l++) {
    const size_t n = (l < MO_HIDDEN_LAYERS ? MO_HIDDEN : (size_t)c->n_springs) * (l == 0 ? c->n_inputs : MO_HIDDEN);
    unsigned larger = 0;
    for (size_t i = 0; i < n; i++)
      larger |= !(fabsf(c->weight[l][i]) <= limit);
    if (larger)
      return false;
    for (int i = 0; l < MO_HIDDEN_LAYERS && i < MO_HIDDEN; i++)
      if (!(16 * fabsf(c->norm_gain[l][i]) + fabsf(c->norm_shift[l][i]) <= limit) || !(fabsf(c->bias[l][i]) <= limit))
        return false;
  }
  return true;
}

bool is_valid(const mo_device_gradient *call)
{
  const mo_gradient_options options = {call->adjoint_bound, call->weight, call->adjoint_rule, call->restart_weight};
  if (call->controller == nullptr || call->robots == nullptr || call->n == 0 || call->d_parameters == nullptr ||
      call->outcomes == nullptr || mo_gradient_options_check(&options) != MO_OK)
    return false;
  for (uint32_t i = 0; i < call->n; i++)
    if (call->robots[i].body == nullptr || call->robots[i].environment == nullptr)
      return false;
  return mo_physics_check(&call->physics, nullptr) == MO_OK;
}

bool is_default(mo_workspace w)
{
  return w.nx == 6 && w.ny == 6 && w.nz == 4;
}

} // namespace

/* What a launch of either way can have of shared memory. */
static cudaError_t open_kernels(int device, uint32_t *shared_bytes)
{
  uint32_t forward = 0, back = 0, products = 0;
  int block = 0;
  cudaError_t status = cudaDeviceGetAttribute(&block, cudaDevAttrMaxSharedMemoryPerBlockOptin, device);
  if (status == cudaSuccess)
    status = (cudaError_t)mo_gk_open_forward((uint32_t)block, &forward);
  if (status == cudaSuccess)
    status = (cudaError_t)mo_gk_open_back((uint32_t)block, &back);
  if (status == cudaSuccess)
    status = (cudaError_t)mo_gk_open_products((uint32_t)block, &products);
  *shared_bytes = std::min(forward, back);
  return status;
}

int mo_cuda_gradient_create(int device, struct mo_cuda_gradient_state **ret)
{
  mo_cuda_gradient_state *s = (mo_cuda_gradient_state *)calloc(1, sizeof(*s));
  if (s == nullptr)
    return MO_ERR_NO_MEMORY;
  s->device = device;
  s->generators = new (std::nothrow) std::vector<float>();
  if (s->generators == nullptr) {
    free(s);
    return MO_ERR_NO_MEMORY;
  }
  cudaError_t status = cudaSetDevice(device);
  if (status == cudaSuccess)
    status = open_kernels(device, &s->shared_bytes);
  size_t free_bytes = 0, total_bytes = 0;
  if (status == cudaSuccess)
    status = cudaMemGetInfo(&free_bytes, &total_bytes);
  s->total_bytes = total_bytes;
  if (status == cudaSuccess)
    status = cudaDeviceGetAttribute(&s->multiprocessors, cudaDevAttrMultiProcessorCount, device);
  if (status == cudaSuccess)
    status = cudaStreamCreateWithFlags(&s->stream, cudaStreamNonBlocking);
  if (status == cudaSuccess)
    status = cudaStreamCreateWithFlags(&s->beside, cudaStreamNonBlocking);
  for (cudaEvent_t &mark : s->marks)
    if (status == cudaSuccess)
      status = cudaEventCreate(&mark);
  if (status == cudaSuccess)
    status = cudaEventCreate(&s->copied);
  if (status == cudaSuccess)
    status = cudaMalloc((void **)&s->cancel, sizeof(*s->cancel));
  if (status != cudaSuccess) {
    mo_cuda_gradient_free(s);
    (void)cudaGetLastError();
    return status == cudaErrorMemoryAllocation ? MO_ERR_NO_MEMORY : MO_ERR_DEVICE;
  }
  *ret = s;
  return MO_OK;
}

void mo_cuda_gradient_set_halves(struct mo_cuda_gradient_state *s, enum mo_cuda_halves halves)
{
  s->halves = halves;
}

void mo_cuda_gradient_trim(struct mo_cuda_gradient_state *s)
{
  cudaSetDevice(s->device);
  for (mo_gradient_buffer &b : s->buffers) {
    cudaFree(b.at);
    b = mo_gradient_buffer();
  }
}

void mo_cuda_gradient_free(struct mo_cuda_gradient_state *s)
{
  if (s == nullptr)
    return;
  mo_cuda_gradient_trim(s);
  mo_cuda_gradient_layout_free(s->layout);
  delete s->generators;
  cudaFree(s->weights.at);
  cudaFreeHost(s->sums.at);
  cudaFreeHost(s->results.at);
  cudaFreeHost(s->parameters.at);
  cudaFree(s->cancel);
  for (cudaEvent_t mark : s->marks)
    if (mark != nullptr)
      cudaEventDestroy(mark);
  if (s->copied != nullptr)
    cudaEventDestroy(s->copied);
  if (s->beside != nullptr)
    cudaStreamDestroy(s->beside);
  if (s->stream != nullptr)
    cudaStreamDestroy(s->stream);
  free(s);
}

int mo_cuda_gradient_run(struct mo_cuda_gradient_state *s, struct mo_device_gradient *call, uint64_t memory_bytes)
{
  const double since = now_s();
  s->profile = mo_cuda_gradient_profile();
  s->error[0] = 0;
  call->counts = mo_gradient_counts();
  call->host_s = call->device_s = 0;
  if (!is_valid(call))
    return MO_ERR_INVALID;
  if (!is_default(call->controller->workspace) || !fits_half(call->controller)) {
    snprintf(s->error, sizeof(s->error), "not a controller that these kernels do");
    return MO_ERR_UNSUPPORTED;
  }
  cudaError_t status = cudaSetDevice(s->device);
  if (status == cudaSuccess)
    status = cudaStreamSynchronize(s->beside);
  if (status == cudaSuccess)
    status = cudaMemsetAsync(s->cancel, 0, sizeof(*s->cancel), s->stream);
  if (status != cudaSuccess)
    return s->fail(status, "device");
  if (s->weights.at == nullptr) {
    const int r = place_weights(s);
    if (r < 0)
      return r;
  }
  mo_device_layout *layout = call->layout;
  int r = MO_OK;
  if (layout == nullptr || !mo_gradient_layout_is_of(layout, s, call)) {
    r = mo_cuda_gradient_lay_out(s, call->robots, call->n, &call->physics, &s->layout);
    layout = s->layout;
  }
  if (r < 0)
    return r;
  s->profile.plan_s = now_s() - since;
  try {
    r = mo_gradient_run_plan(s, call, layout->plan, memory_bytes);
  } catch (const std::bad_alloc &) { /* of the host */
    cudaStreamSynchronize(s->stream);
    r = MO_ERR_NO_MEMORY;
  }
  s->profile.device_bytes = s->held();
  call->device_s = s->profile.forward_s + s->profile.back_s + s->profile.products_s + s->profile.collect_s;
  call->host_s = now_s() - since - call->device_s;
  return r;
}

const char *mo_cuda_gradient_error(const struct mo_cuda_gradient_state *s)
{
  return s->error;
}

const struct mo_cuda_gradient_profile *mo_cuda_gradient_times(const struct mo_cuda_gradient_state *s)
{
  return &s->profile;
}
