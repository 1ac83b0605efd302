/* gradient.cu: a call for gradients, from rows to shards' sums.
 *
 * The call is cut into passes of whole shards that fit the device's memory; nearly always it is one. A pass runs forward over all steps, back
 * again, which leaves what the products need where the tape was, and takes the products. A row whose adjoint turns out not to be finite was added
 * until then: both ways are walked again without it. That is rare. */
#include "compute/cuda/gradient.h"
#include "compute/cuda/gradient_kernels.cuh"
#include "compute/cuda/gradient_pass.h"
extern "C" {
#include "rollout/scene.h"
}

#include <cuda_runtime.h>

#include <chrono>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <algorithm>
#include <new>
#include <thread>
#include <vector>

namespace {

/* Of a task on the way forward or back; of a launch of products: shorter ones take longer. */
enum { PART_STEPS = 50, PRODUCT_STEPS = 1000, RESERVE_BYTES = 768 << 20 };

struct buffer {
  void *at = nullptr;
  uint64_t bytes = 0;
};

enum place {
  GROUPS,
  ROWS,
  ORDER,
  INPUT,
  SPRINGS,
  GENERATORS,
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

double now_s()
{
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

} // namespace

struct mo_cuda_gradient_state {
  int device;
  cudaStream_t stream, beside; /* beside: for the flag alone */
  buffer buffers[PLACES], weights, pinned;
  int *cancel; /* on the device; read by the kernels */
  mo_gradient_plan plan;
  mo_gk_weights tiles;
  uint32_t shared_bytes;
  char error[256];
  mo_cuda_gradient_profile profile;

  int fail(cudaError_t status, const char *what)
  {
    snprintf(error, sizeof(error), "%s: %s", what, cudaGetErrorString(status));
    if (status == cudaErrorMemoryAllocation) {
      (void)cudaGetLastError();
      return MO_ERR_NO_MEMORY;
    }
    return MO_ERR_DEVICE;
  }

  int reserve(place p, uint64_t bytes)
  {
    buffer &b = buffers[p];
    if (b.bytes >= bytes)
      return MO_OK;
    cudaFree(b.at);
    b = buffer();
    const uint64_t wanted =
        bytes + bytes / 64 + 4096; /* bodies differ from step to step: so that the next batch fits, too */
    const cudaError_t status = cudaMalloc(&b.at, wanted);
    if (status != cudaSuccess) {
      b.at = nullptr;
      return fail(status, "device memory");
    }
    b.bytes = wanted;
    return MO_OK;
  }

  int upload(place p, const void *from, uint64_t bytes)
  {
    const int r = reserve(p, bytes);
    if (r < 0)
      return r;
    const cudaError_t status = cudaMemcpyAsync(buffers[p].at, from, bytes, cudaMemcpyHostToDevice, stream);
    return status == cudaSuccess ? MO_OK : fail(status, "copy to the device");
  }

  template <class T> T *of(place p) const
  {
    return (T *)buffers[p].at;
  }

  uint64_t held() const
  {
    uint64_t sum = weights.bytes;
    for (const buffer &b : buffers)
      sum += b.bytes;
    return sum;
  }
};

namespace {

int place_weights(mo_cuda_gradient_state *s)
{
  const size_t tile = 32 * sizeof(uint4), tiles = 3 * 256 + (size_t)MO_GP_OUTPUT_TILES * 16;
  const size_t floats = 3 * 3 * MO_HIDDEN + MO_GP_OUTPUT_TILES * MO_GP_TILE;
  s->weights.bytes = 2 * tiles * tile + floats * sizeof(float);
  const cudaError_t status = cudaMalloc(&s->weights.at, s->weights.bytes);
  if (status != cudaSuccess) {
    s->weights = buffer();
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

struct work {
  mo_cuda_gradient_state *s;
  mo_device_gradient *call;
  const mo_gradient_plan *plan;
  mo_gradient_pass p;
  mo_gk k;
  uint32_t n_jobs;
  std::vector<mo_gk_result> results;
};

int upload_pass(work &w, const std::vector<float> &generators)
{
  mo_cuda_gradient_state *s = w.s;
  const mo_gradient_plan &plan = *w.plan;
  const uint32_t n = w.p.end - w.p.first;
  std::vector<uint32_t> order(n), jobs, shards;
  for (uint32_t i = 0; i < n; i++) {
    const mo_gp_group &g = plan.groups[w.p.first + i];
    order[i] = w.p.first + i;
    while (shards.size() <= g.shard - w.p.first_shard)
      shards.push_back(w.p.first + i);
  }
  shards.push_back(w.p.end);
  std::stable_sort(order.begin(), order.end(), [&](uint32_t a, uint32_t b) {
    return mo_gradient_cost(&plan.groups[a]) > mo_gradient_cost(&plan.groups[b]);
  });
  for (uint32_t i : order) {
    const uint32_t blocks = (plan.groups[i].n_outputs * MO_GP_TILE + MO_GK_JOB_COLUMNS - 1) / MO_GK_JOB_COLUMNS;
    for (uint32_t b = 0; b < blocks; b++)
      jobs.push_back(MO_GK_JOB(i, MO_GK_JOB_OUTPUT, b));
    for (uint32_t b = 0; b < MO_HIDDEN / MO_GK_JOB_COLUMNS; b++) {
      jobs.push_back(MO_GK_JOB(i, MO_GK_JOB_HIDDEN_2, b));
      jobs.push_back(MO_GK_JOB(i, MO_GK_JOB_HIDDEN_1, b));
      jobs.push_back(MO_GK_JOB(i, MO_GK_JOB_INPUT, b));
    }
  }
  w.n_jobs = (uint32_t)jobs.size();
  w.results.assign(plan.n_rows, mo_gk_result());
  int r = MO_OK;
  const struct {
    place p;
    const void *from;
    uint64_t bytes;
  } parts[] = {{GROUPS, plan.groups, plan.n_groups * sizeof(*plan.groups)},
               {ROWS, plan.rows, plan.n_rows * sizeof(*plan.rows)},
               {POSITION, plan.position, plan.n_masses * 12},
               {INPUT, plan.input, plan.n_masses},
               {SPRINGS, plan.springs, plan.n_chunks * 128},
               {ORDER, order.data(), order.size() * 4},
               {JOBS, jobs.data(), jobs.size() * 4},
               {SHARDS, shards.data(), shards.size() * 4},
               {GENERATORS, generators.data(), generators.size() * 4},
               {RESULTS, w.results.data(), plan.n_rows * sizeof(mo_gk_result)},
               {PARAMETERS, w.call->controller->parameters, w.call->controller->n_parameters * 4}};
  for (const auto &part : parts)
    if (r == MO_OK)
      r = s->upload(part.p, part.from, part.bytes);
  if (r == MO_OK)
    r = s->reserve(VELOCITY, plan.n_masses * 12);
  if (r == MO_OK)
    r = s->reserve(TAPE, w.p.tape);
  if (r == MO_OK)
    r = s->reserve(TICKETS, (plan.n_groups + (uint64_t)1) * 4);
  if (r == MO_OK)
    r = s->reserve(SUMS, 4 * w.p.sums);
  if (r == MO_OK)
    r = s->reserve(D_PARAMETERS, (uint64_t)(w.p.end_shard - w.p.first_shard) * w.call->controller->n_parameters * 4);
  if (r < 0)
    return r;
  w.k.groups = s->of<mo_gp_group>(GROUPS);
  w.k.rows = s->of<mo_gp_row>(ROWS);
  w.k.order = s->of<uint32_t>(ORDER);
  w.k.input = s->of<uint8_t>(INPUT);
  w.k.springs = s->of<uint32_t>(SPRINGS);
  w.k.generators = s->of<float>(GENERATORS);
  w.k.tape = s->of<unsigned char>(TAPE);
  w.k.sums = s->of<float>(SUMS);
  w.k.position = s->of<float>(POSITION);
  w.k.velocity = s->of<float>(VELOCITY);
  w.k.results = s->of<mo_gk_result>(RESULTS);
  w.k.weights = s->tiles;
  w.k.n_groups = n;
  w.k.tickets = s->of<uint32_t>(TICKETS);
  w.k.cancel = s->cancel;
  /* The vectors end here: copies from pageable memory are staged before cudaMemcpyAsync returns. */
  const int status = mo_gk_pack(s->of<float>(PARAMETERS), &s->tiles, s->stream);
  return status == 0 ? MO_OK : s->fail((cudaError_t)status, "weights");
}

bool cancelled(const work &w)
{
  return w.call->cancel != nullptr && *w.call->cancel != 0;
}

/* Waits for the device; passes the caller's flag on to it. */
int finish(work &w, double &sum_s, double since)
{
  mo_cuda_gradient_state *s = w.s;
  bool told = false;
  cudaError_t status;
  while ((status = cudaStreamQuery(s->stream)) == cudaErrorNotReady) {
    if (!told && cancelled(w)) {
      told = true;
      cudaMemsetAsync(s->cancel, 1, sizeof(*s->cancel), s->beside);
    }
    std::this_thread::sleep_for(std::chrono::microseconds(50));
  }
  sum_s += now_s() - since;
  if (status != cudaSuccess)
    return s->fail(status, "kernel");
  return told || cancelled(w) ? MO_ERR_CANCELLED : MO_OK;
}

/* No task has been handed out, and none is done. */
int reset_tickets(work &w)
{
  mo_cuda_gradient_state *s = w.s;
  const cudaError_t status = cudaMemsetAsync(s->buffers[TICKETS].at, 0, (w.plan->n_groups + (size_t)1) * 4, s->stream);
  return status == cudaSuccess ? MO_OK : s->fail(status, "tickets");
}

int forward(work &w)
{
  mo_cuda_gradient_state *s = w.s;
  const double since = now_s();
  const int r = reset_tickets(w);
  if (r < 0)
    return r;
  const int status = mo_gk_forward(&w.k, w.p.shared, s->stream);
  if (status != 0)
    return s->fail((cudaError_t)status, "rollouts");
  return finish(w, s->profile.forward_s, since);
}

int walk_back(work &w)
{
  mo_cuda_gradient_state *s = w.s;
  double since = now_s();
  s->profile.walks++;
  int r = reset_tickets(w);
  if (r < 0)
    return r;
  int status = mo_gk_back(&w.k, w.p.shared, s->stream);
  if (status != 0)
    return s->fail((cudaError_t)status, "way back");
  r = finish(w, s->profile.back_s, since);
  if (r < 0)
    return r;
  since = now_s();
  for (uint32_t first = 0; first < w.k.n_steps; first += PRODUCT_STEPS) {
    const uint32_t end = std::min<uint32_t>(first + PRODUCT_STEPS, w.k.n_steps);
    status = mo_gk_products(&w.k, s->of<uint32_t>(JOBS), w.n_jobs, first, end, s->stream);
    if (status != 0)
      return s->fail((cudaError_t)status, "products");
  }
  return finish(w, s->profile.products_s, since);
}

int fetch_results(work &w)
{
  const cudaError_t status = cudaMemcpy(w.results.data(), w.s->buffers[RESULTS].at,
                                        w.results.size() * sizeof(mo_gk_result), cudaMemcpyDeviceToHost);
  return status == cudaSuccess ? MO_OK : w.s->fail(status, "copy from the device");
}

/* Back until no more rows turn out to be left out. The way back leaves no tape: before another one, there is another way forward. */
int walk_until_finite(work &w)
{
  std::vector<mo_gk_result> before;
  for (;;) {
    int r = walk_back(w);
    if (r == MO_OK)
      r = fetch_results(w);
    if (r < 0)
      return r;
    bool more = false;
    for (size_t i = 0; i < w.results.size(); i++) {
      const bool known = !before.empty() && before[i].zeroed;
      if (known)
        w.results[i] = before[i]; /* counted when it was found */
      more |= w.results[i].zeroed && !known;
    }
    if (!more)
      return MO_OK;
    before = w.results;
    std::vector<mo_gk_result> again = w.results;
    for (mo_gk_result &x : again) {
      x.steps = x.clipped = 0;
      x.largest = 0;
      x.diverged = 0;
    }
    r = w.s->upload(RESULTS, again.data(), again.size() * sizeof(again[0]));
    if (r == MO_OK)
      r = w.s->upload(POSITION, w.plan->position, w.plan->n_masses * 12);
    if (r == MO_OK)
      r = forward(w);
    if (r < 0)
      return r;
  }
}

int collect(work &w)
{
  mo_cuda_gradient_state *s = w.s;
  const uint32_t n = w.p.end_shard - w.p.first_shard;
  const uint64_t n_parameters = w.call->controller->n_parameters;
  const double since = now_s();
  const int status =
      mo_gk_collect(&w.k, s->of<uint32_t>(SHARDS), n, w.call->weight, s->of<float>(D_PARAMETERS), s->stream);
  if (status != 0)
    return s->fail((cudaError_t)status, "sums");
  const uint64_t bytes = n * n_parameters * 4;
  cudaError_t copied = cudaSuccess;
  if (s->pinned.bytes < bytes) {
    cudaFreeHost(s->pinned.at);
    s->pinned = buffer();
    copied = cudaMallocHost(&s->pinned.at, bytes);
    if (copied != cudaSuccess)
      return s->fail(copied, "pinned memory");
    s->pinned.bytes = bytes;
  }
  copied = cudaMemcpyAsync(s->pinned.at, s->buffers[D_PARAMETERS].at, bytes, cudaMemcpyDeviceToHost, s->stream);
  if (copied != cudaSuccess)
    return s->fail(copied, "copy from the device");
  const int r = finish(w, s->profile.collect_s, since);
  if (r == MO_OK)
    memcpy(w.call->d_parameters + w.p.first_shard * n_parameters, s->pinned.at, bytes);
  return r;
}

void report(work &w)
{
  mo_gradient_counts counts = {};
  for (uint32_t i = w.p.first; i < w.p.end; i++) {
    const mo_gp_group &g = w.plan->groups[i];
    for (uint32_t j = g.first_row; j < g.first_row + g.n_rows; j++) {
      const mo_gp_row &row = w.plan->rows[j];
      const mo_gk_result &result = w.results[j];
      if (row.robot == MO_GP_NO_ROBOT)
        continue;
      mo_outcome &o = w.call->outcomes[row.robot];
      o = w.plan->starts[row.robot];
      o.diverged_step = result.diverged;
      for (int axis = 0; axis < 3; axis++)
        o.com_end_m[axis] = result.com_end[axis] + (axis < 2 ? MO_WORLD_CENTRE_M : 0);
      o.loss = result.diverged
                   ? (double)INFINITY
                   : mo_scene_loss(o.com_start_m, o.com_end_m, w.call->robots[row.robot].environment->light_xy_m);
      counts.robots++;
      counts.steps += result.steps;
      counts.clipped_steps += result.clipped;
      counts.clipped_robots += result.clipped > 0;
      counts.diverged_robots += result.diverged != 0;
      counts.zeroed_robots += result.zeroed != 0;
      counts.largest = fmax(counts.largest, result.largest);
    }
  }
  mo_gradient_counts_add(&w.call->counts, &counts);
}

/* float16 holds the weights, and what the hidden layers can come to; no bias is so large that LayerNorm's squares leave float32. */
bool fits_half(const mo_controller *c)
{
  const float limit = 6e4f;
  for (int l = 0; l <= MO_HIDDEN_LAYERS; l++) {
    const size_t n = (l < MO_HIDDEN_LAYERS ? MO_HIDDEN : (size_t)c->n_springs) * (l == 0 ? c->n_inputs : MO_HIDDEN);
    for (size_t i = 0; i < n; i++)
      if (!(fabsf(c->weight[l][i]) <= limit))
        return false;
    for (int i = 0; l < MO_HIDDEN_LAYERS && i < MO_HIDDEN; i++)
      if (!(16 * fabsf(c->norm_gain[l][i]) + fabsf(c->norm_shift[l][i]) <= limit) || !(fabsf(c->bias[l][i]) <= limit))
        return false;
  }
  return true;
}

bool is_valid(const mo_device_gradient *call)
{
  if (call->controller == nullptr || call->robots == nullptr || call->n == 0 || call->d_parameters == nullptr ||
      call->outcomes == nullptr || !isfinite(call->adjoint_bound) || call->adjoint_bound < 0 || !isfinite(call->weight))
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

mo_lane_physics lane_physics(const mo_physics &p, mo_sensor sensor)
{
  mo_lane_physics l = {};
  l.dt = (float)p.dt_s;
  l.friction = (float)p.friction;
  l.friction_cap = (float)p.friction_cap;
  l.bisections = p.impact == MO_IMPACT_BISECTION ? (int)p.bisections : 0;
  l.keep = (float)exp(-p.drag_per_s * p.dt_s);
  l.fall = (float)(p.gravity_m_per_s2 * p.dt_s);
  l.pull = (float)(p.dt_s * p.stiffness_n_per_m / p.mass_kg);
  l.actuation = (float)p.actuation;
  l.inverse_square = sensor == MO_SENSOR_INVERSE_SQUARE;
  return l;
}

/* What of `bytes` the buffers may take, each a little larger than it is asked to be. */
uint64_t share_of(uint64_t bytes)
{
  return bytes > RESERVE_BYTES ? (bytes - RESERVE_BYTES) / 65 * 64 : 0;
}

int run(mo_cuda_gradient_state *s, mo_device_gradient *call, mo_gradient_plan &plan, uint64_t memory_bytes)
{
  const uint32_t n_steps = call->physics.n_steps;
  size_t free_bytes = 0, total = 0;
  cudaError_t status = cudaMemGetInfo(&free_bytes, &total);
  if (status != cudaSuccess)
    return s->fail(status, "device");
  if (!mo_gradient_can_be_held(&plan, n_steps, share_of(total))) {
    snprintf(s->error, sizeof(s->error), "a tape of %u steps is too long for this device", (unsigned)n_steps);
    return MO_ERR_UNSUPPORTED;
  }
  uint64_t budget = share_of(free_bytes + s->held());
  if (memory_bytes > 0)
    budget = std::min(budget, memory_bytes);
  std::vector<float> generators((size_t)n_steps * MO_CPG_INPUTS);
  for (uint32_t step = 0; step < n_steps; step++)
    for (int i = 0; i < MO_CPG_INPUTS; i++)
      generators[(size_t)step * MO_CPG_INPUTS + i] =
          (float)sin(MO_CPG_RAD_PER_S * (step * call->physics.dt_s) + 2.0 * M_PI * i / MO_CPG_INPUTS);
  for (uint32_t group = 0, shard = 0; group < plan.n_groups;) {
    work w = {};
    w.s = s;
    w.call = call;
    w.plan = &plan;
    int r = mo_gradient_pass_next(&plan, shard, group, n_steps, budget, &w.p);
    if (r < 0)
      return r;
    w.k.physics = lane_physics(call->physics, call->controller->sensor);
    w.k.bound = call->adjoint_bound;
    w.k.n_steps = n_steps;
    w.k.part_steps = PART_STEPS;
    const double since = now_s();
    r = upload_pass(w, generators);
    if (r == MO_ERR_NO_MEMORY) { /* larger buffers of earlier calls are in the way: all go, and are asked for again */
      cudaStreamSynchronize(s->stream);
      mo_cuda_gradient_trim(s);
      r = upload_pass(w, generators);
    }
    s->profile.upload_s += now_s() - since;
    if (r == MO_OK)
      r = forward(w);
    if (r == MO_OK)
      r = walk_until_finite(w);
    if (r == MO_OK)
      r = collect(w);
    if (r < 0) {
      cudaStreamSynchronize(s->stream);
      return r;
    }
    report(w);
    s->profile.passes++;
    s->profile.groups += w.p.end - w.p.first;
    group = w.p.end;
    shard = w.p.end_shard;
  }
  return MO_OK;
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
  cudaError_t status = cudaSetDevice(device);
  if (status == cudaSuccess)
    status = open_kernels(device, &s->shared_bytes);
  if (status == cudaSuccess)
    status = cudaStreamCreateWithFlags(&s->stream, cudaStreamNonBlocking);
  if (status == cudaSuccess)
    status = cudaStreamCreateWithFlags(&s->beside, cudaStreamNonBlocking);
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

void mo_cuda_gradient_trim(struct mo_cuda_gradient_state *s)
{
  cudaSetDevice(s->device);
  for (buffer &b : s->buffers) {
    cudaFree(b.at);
    b = buffer();
  }
}

void mo_cuda_gradient_free(struct mo_cuda_gradient_state *s)
{
  if (s == nullptr)
    return;
  mo_cuda_gradient_trim(s);
  mo_gradient_plan_free(&s->plan);
  cudaFree(s->weights.at);
  cudaFreeHost(s->pinned.at);
  cudaFree(s->cancel);
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
  mo_gp_options options = {MO_DEVICE_SHARD, s->shared_bytes,
                           std::min(8u, std::max(1u, std::thread::hardware_concurrency()))};
  mo_gradient_plan &plan = s->plan;
  int r = mo_gradient_plan_make(call->robots, call->n, &call->physics, &options, &plan);
  if (r < 0)
    return r;
  s->profile.plan_s = now_s() - since;
  try {
    r = run(s, call, plan, memory_bytes);
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
