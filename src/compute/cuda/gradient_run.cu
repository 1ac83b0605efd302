/* gradient_run.cu: computes a laid-out batch, from rows to the sums of shards.
 *
 * The batch is divided into passes of whole shards that fit the device's memory; nearly always, one
 * pass suffices. A pass runs forward over all steps, then backward, which replaces the tape by the
 * operands of the products, and then computes the products. If a row's adjoint turns out not to be
 * finite, the row has already contributed by then, so both directions are rerun without it. This is
 * rare. */
#include "compute/cuda/device.cuh"
#include "compute/cuda/gradient_pass.h"
extern "C" {
#include "rollout/scene.h"
}

#include <math.h>
#include <stdio.h>
#include <string.h>

#include <algorithm>
#include <thread>
#include <vector>

namespace {

/* Steps of a forward or backward task, and passes of the network of a launch of products: shorter
 * ones would take longer in total. */
enum { PART_STEPS = 50, PRODUCT_PASSES = 1000, RESERVE_BYTES = 768 << 20 };

struct work {
  mo_device *device;
  mo_cuda_gradient_state *s; /* the device's */
  mo_device_gradient *call;
  const mo_gradient_plan *plan;
  mo_gradient_pass p;
  mo_gk k;
  uint32_t n_jobs, n_halved;
  bool told;             /* whether the device has been notified that the call is cancelled */
  mo_gk_result *results; /* (n_rows) in pinned memory */
  mo_gk_ending *endings; /* the same; not used if no row is special */
};

int check(work &w, int status, const char *what)
{
  return mo_cuda_check(w.device, (cudaError_t)status, what);
}

/* Returns how many of the wide groups, starting with the most expensive, are computed by two blocks
 * each. loads: in descending order of cost. */
uint32_t count_halved(const mo_device *device, const std::vector<mo_gradient_load> &loads)
{
  const uint32_t n_wide = (uint32_t)std::count_if(
      loads.begin(), loads.end(), [](const mo_gradient_load &load) { return load.wide; });
  const mo_cuda_halves halves = device->gradient.halves;
  return halves == MO_CUDA_HALVES_NEVER    ? 0
         : halves == MO_CUDA_HALVES_ALWAYS ? n_wide
         : halves == MO_CUDA_HALVES_SOME   ? (n_wide + 1) / 2
                                         : mo_gradient_halved(loads.data(), (uint32_t)loads.size(),
                                                              (uint32_t)device->multiprocessors);
}

/* Returns the bytes of the ticket counter, and of the counts of finished parts for each half of
 * each group. */
uint64_t tickets_bytes(const mo_gradient_plan &plan)
{
  return (1 + 2 * (uint64_t)plan.n_groups) * 4;
}

uint64_t endings_bytes(const mo_gradient_plan &plan)
{
  return plan.courses != nullptr ? plan.n_rows * sizeof(mo_gk_ending) : 0;
}

int upload_pass(work &w)
{
  mo_cuda_gradient_state *s = w.s;
  const mo_gradient_plan &plan = *w.plan;
  std::vector<uint32_t> walks, jobs, shards;
  std::vector<mo_gradient_load> loads;
  for (uint32_t i = w.p.first; i < w.p.end; i++) {
    const mo_gp_group &g = plan.groups[i];
    loads.push_back({mo_gradient_cost(&g), i, g.n_rows == MO_GP_ROWS_MAX});
    while (shards.size() <= g.shard - w.p.first_shard)
      shards.push_back(i);
  }
  shards.push_back(w.p.end);
  std::stable_sort(
      loads.begin(), loads.end(),
      [](const mo_gradient_load &a, const mo_gradient_load &b) { return a.cost > b.cost; });
  const uint32_t most_halved = count_halved(w.device, loads);
  bool all_halved = true;
  w.n_halved = 0;
  for (const mo_gradient_load &load : loads) {
    const uint32_t i = load.group;
    if (load.wide && w.n_halved < most_halved) {
      walks.push_back(MO_GK_WALK(i, 0) | MO_GK_HALVED);
      walks.push_back(MO_GK_WALK(i, 1) | MO_GK_HALVED);
      w.n_halved++;
    } else {
      walks.push_back(MO_GK_WALK(i, 0));
      all_halved = all_halved && !load.wide;
    }
    const uint32_t blocks =
        (plan.groups[i].n_outputs * MO_GP_TILE + MO_GK_JOB_COLUMNS - 1) / MO_GK_JOB_COLUMNS;
    for (uint32_t b = 0; b < blocks; b++)
      jobs.push_back(MO_GK_JOB(i, MO_GK_JOB_OUTPUT, b));
    for (uint32_t b = 0; b < MO_HIDDEN / MO_GK_JOB_COLUMNS; b++) {
      jobs.push_back(MO_GK_JOB(i, MO_GK_JOB_HIDDEN_2, b));
      jobs.push_back(MO_GK_JOB(i, MO_GK_JOB_HIDDEN_1, b));
      jobs.push_back(MO_GK_JOB(i, MO_GK_JOB_INPUT, b));
    }
  }
  w.k.walked = w.n_halved == 0 ? MO_GK_WHOLE : all_halved ? MO_GK_HALVES : MO_GK_MIXED;
  w.n_jobs = (uint32_t)jobs.size();
  w.k.n_walks = (uint32_t)walks.size();
  const mo_controller *controller = w.call->controller;
  const uint64_t parameters_bytes = controller->n_parameters * 4,
                 results_bytes = plan.n_rows * sizeof(mo_gk_result);
  int r =
      in_turn([&] { return mo_cuda_reserve_pinned(w.device, &s->results, results_bytes); },
              [&] { return mo_cuda_reserve_pinned(w.device, &s->parameters, parameters_bytes); });
  if (r < 0)
    return r;
  const uint64_t courses_bytes = plan.courses != nullptr ? plan.n_rows * sizeof(*plan.courses) : 0,
                 cuts_bytes = plan.cuts != nullptr ? plan.n_chunks * sizeof(*plan.cuts) : 0;
  if (plan.courses != nullptr)
    r = mo_cuda_reserve_pinned(w.device, &s->endings, endings_bytes(plan));
  if (r < 0)
    return r;
  w.results = (mo_gk_result *)s->results.memory;
  w.endings = (mo_gk_ending *)s->endings.memory;
  memset(w.results, 0, results_bytes);
  memcpy(s->parameters.memory, controller->parameters, parameters_bytes);
  const struct {
    mo_gradient_place p;
    const void *from;
    uint64_t bytes;
  } parts[] = {{GROUPS, plan.groups, plan.n_groups * sizeof(*plan.groups)},
               {ROWS, plan.rows, plan.n_rows * sizeof(*plan.rows)},
               {POSITION, plan.position, plan.n_masses * 12},
               {INPUT, plan.input, plan.n_masses},
               {SPRINGS, plan.springs, plan.n_chunks * 128},
               {ORDER, walks.data(), walks.size() * 4},
               {JOBS, jobs.data(), jobs.size() * 4},
               {SHARDS, shards.data(), shards.size() * 4},
               {RESULTS, w.results, results_bytes},
               {COURSES, plan.courses, courses_bytes},
               {CUTS, plan.cuts, cuts_bytes},
               {PARAMETERS, s->parameters.memory, parameters_bytes}};
  for (const auto &part : parts)
    if (r == MO_OK && part.from != nullptr)
      r = mo_cuda_upload(w.device, &s->buffers[part.p], part.from, part.bytes);
  const struct {
    mo_gradient_place p;
    uint64_t bytes;
  } room[] = {{VELOCITY, plan.n_masses * 12},
              {TAPE, w.p.tape},
              {TICKETS, tickets_bytes(plan)},
              {SUMS, 4 * w.p.sums},
              {ENDINGS, endings_bytes(plan)},
              {D_PARAMETERS, (w.p.end_shard - w.p.first_shard) * parameters_bytes}};
  for (const auto &part : room)
    if (r == MO_OK)
      r = mo_cuda_reserve(w.device, &s->buffers[part.p], part.bytes);
  if (r == MO_OK)
    r = mo_cuda_generators(w.device, &w.call->physics);
  if (r < 0)
    return r;
  w.k.groups = s->buffers[GROUPS].of<mo_gp_group>();
  w.k.rows = s->buffers[ROWS].of<mo_gp_row>();
  w.k.order = s->buffers[ORDER].of<uint32_t>();
  w.k.input = s->buffers[INPUT].of<uint8_t>();
  w.k.springs = s->buffers[SPRINGS].of<uint32_t>();
  w.k.generators = w.device->generators.of<float>();
  w.k.tape = s->buffers[TAPE].of<unsigned char>();
  w.k.sums = s->buffers[SUMS].of<float>();
  w.k.position = s->buffers[POSITION].of<float>();
  w.k.velocity = s->buffers[VELOCITY].of<float>();
  w.k.results = s->buffers[RESULTS].of<mo_gk_result>();
  w.k.weights = s->tiles;
  w.k.tickets = s->buffers[TICKETS].of<uint32_t>();
  w.k.cancel = s->cancel;
  w.k.courses = plan.courses != nullptr ? s->buffers[COURSES].of<mo_gp_course>() : nullptr;
  w.k.endings = s->buffers[ENDINGS].of<mo_gk_ending>();
  w.k.cuts = plan.cuts != nullptr ? s->buffers[CUTS].of<uint32_t>() : nullptr;
  /* The vectors are freed here: copies from pageable memory are staged before cudaMemcpyAsync
   * returns. Pinned memory stays until the pass ends. */
  return check(w, mo_gk_pack(s->buffers[PARAMETERS].of<float>(), &s->tiles, w.device->stream),
               "weights");
}

bool cancelled(const work &w)
{
  return w.call->cancel != nullptr && *w.call->cancel != 0;
}

/* Passes the caller's flag on to the device, once. Returns whether it is set. */
bool pass_on(work &w)
{
  if (!w.told && cancelled(w)) {
    w.told = true;
    cudaMemsetAsync(w.s->cancel, 1, sizeof(*w.s->cancel), w.s->beside);
  }
  return w.told;
}

/* Waits for the work queued before `mark`. */
int wait_for(work &w, cudaEvent_t mark)
{
  cudaError_t status;
  while ((status = cudaEventQuery(mark)) == cudaErrorNotReady) {
    pass_on(w);
    std::this_thread::sleep_for(std::chrono::microseconds(50));
  }
  if (status != cudaSuccess)
    return check(w, status, "kernel");
  return pass_on(w) ? MO_ERR_CANCELLED : MO_OK;
}

/* Runs one direction through all steps, starting with no task handed out or done. */
int walk(work &w, int (*way)(const mo_gk *k, uint32_t shared_bytes, void *stream),
         cudaEvent_t after, const char *what)
{
  const cudaStream_t stream = w.device->stream;
  return check(w,
               in_turn(
                   [&] {
                     return (int)cudaMemsetAsync(w.s->buffers[TICKETS].memory, 0,
                                                 tickets_bytes(*w.plan), stream);
                   },
                   [&] { return way(&w.k, w.p.shared, stream); },
                   [&] { return (int)cudaEventRecord(after, stream); }),
               what);
}

int multiply(work &w, cudaEvent_t after)
{
  mo_cuda_gradient_state *s = w.s;
  int r = MO_OK;
  const uint32_t passes = mo_gp_passes(w.k.n_steps, w.k.control_steps);
  for (uint32_t first = 0; first < passes && r == MO_OK; first += PRODUCT_PASSES) {
    const uint32_t end = std::min<uint32_t>(first + PRODUCT_PASSES, passes);
    r = check(w,
              mo_gk_products(&w.k, s->buffers[JOBS].of<uint32_t>(), w.n_jobs, first, end,
                             w.device->stream),
              "products");
  }
  return r == MO_OK ? check(w, cudaEventRecord(after, w.device->stream), "products") : r;
}

/* Returns whether the device can write to this memory while the host does something else. */
bool is_pinned(const void *memory)
{
  cudaPointerAttributes attributes = {};
  const bool known = cudaPointerGetAttributes(&attributes, memory) == cudaSuccess;
  (void)cudaGetLastError();
  return known && attributes.type == cudaMemoryTypeHost;
}

/* Copies the results of the rows to the host, which reports them while the products are
 * computed. */
int copy_results(work &w, cudaEvent_t after)
{
  const uint64_t bytes = w.plan->n_rows * sizeof(mo_gk_result);
  const cudaStream_t stream = w.device->stream;
  return check(w,
               in_turn(
                   [&] {
                     return cudaMemcpyAsync(w.results, w.s->buffers[RESULTS].memory, bytes,
                                            cudaMemcpyDeviceToHost, stream);
                   },
                   [&] {
                     return w.plan->courses == nullptr
                                ? cudaSuccess
                                : cudaMemcpyAsync(w.endings, w.s->buffers[ENDINGS].memory,
                                                  endings_bytes(*w.plan), cudaMemcpyDeviceToHost,
                                                  stream);
                   },
                   [&] { return cudaEventRecord(after, stream); }),
               "copy from the device");
}

/* Copies the sums of the shards to the host. */
int collect(work &w, float *to, cudaEvent_t after)
{
  mo_cuda_gradient_state *s = w.s;
  const uint32_t n = w.p.end_shard - w.p.first_shard;
  const uint64_t bytes = n * w.call->controller->n_parameters * 4;
  float *sums = s->buffers[D_PARAMETERS].of<float>();
  const cudaStream_t stream = w.device->stream;
  return check(
      w,
      in_turn(
          [&] {
            return mo_gk_collect(&w.k, s->buffers[SHARDS].of<uint32_t>(), n, w.call->options.weight,
                                 sums, stream);
          },
          [&] { return (int)cudaMemcpyAsync(to, sums, bytes, cudaMemcpyDeviceToHost, stream); },
          [&] { return (int)cudaEventRecord(after, stream); }),
      "sums");
}

/* Queues a complete pass on the device, which never waits for the host. */
int ask_for_pass(work &w, float *to)
{
  const cudaEvent_t *marks = w.s->marks;
  w.s->profile.walks++;
  return in_turn([&] { return check(w, cudaEventRecord(marks[0], w.device->stream), "device"); },
                 [&] { return walk(w, mo_gk_forward, marks[1], "rollouts"); },
                 [&] { return walk(w, mo_gk_back, marks[2], "way back"); },
                 [&] { return copy_results(w, w.s->copied); },
                 [&] { return multiply(w, marks[3]); }, [&] { return collect(w, to, marks[4]); });
}

int finish_pass(work &w)
{
  mo_cuda_gradient_state *s = w.s;
  double *const parts[] = {&s->profile.forward_s, &s->profile.back_s, &s->profile.products_s,
                           &s->profile.collect_s};
  int r = wait_for(w, s->marks[4]);
  for (int i = 0; i < 4 && r == MO_OK; i++) {
    float ms = 0;
    r = check(w, cudaEventElapsedTime(&ms, s->marks[i], s->marks[i + 1]), "clock");
    *parts[i] += 1e-3 * (double)ms;
  }
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
        o.com_end_m[axis] = result.com_end[axis] + (axis < 2 ? MO_WORLD_CENTER_M : 0);
      if (w.plan->courses == nullptr || w.plan->courses[j].is_plain) {
        mo_scene_finish(&o, w.call->robots[row.robot].environment);
      } else {
        o.loss = w.endings[j].loss;
        o.value = w.endings[j].value;
      }
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

/* Repeats the pass until no more rows have to be excluded. The backward pass overwrites the tape,
 * so repeating it requires another forward pass. */
int run_until_finite(work &w, float *to)
{
  std::vector<mo_gk_result> before;
  for (;;) {
    int r = ask_for_pass(w, to);
    if (r == MO_OK)
      r = wait_for(w, w.s->copied);
    if (r < 0)
      return r;
    bool more = false;
    for (uint32_t i = 0; i < w.plan->n_rows; i++) {
      const bool known = !before.empty() && before[i].zeroed;
      if (known)
        w.results[i] = before[i]; /* counted when it was found */
      more |= w.results[i].zeroed && !known;
    }
    if (!more)
      report(w);
    r = finish_pass(w);
    if (r < 0 || !more)
      return r;
    before.assign(w.results, w.results + w.plan->n_rows);
    std::vector<mo_gk_result> again = before;
    for (mo_gk_result &x : again) {
      x.steps = x.clipped = 0;
      x.largest = 0;
      x.diverged = 0;
    }
    r = in_turn(
        [&] {
          return mo_cuda_upload(w.device, &w.s->buffers[RESULTS], again.data(),
                                again.size() * sizeof(again[0]));
        },
        [&] {
          return mo_cuda_upload(w.device, &w.s->buffers[POSITION], w.plan->position,
                                w.plan->n_masses * 12);
        });
    if (r < 0)
      return r;
  }
}

/* Copies the pass's sums to the caller's memory, by way of our own memory if that is not pinned. */
int compute(work &w)
{
  mo_cuda_gradient_state *s = w.s;
  const uint64_t n_parameters = w.call->controller->n_parameters;
  const uint64_t bytes = (w.p.end_shard - w.p.first_shard) * n_parameters * 4;
  float *const to = w.call->d_parameters + w.p.first_shard * n_parameters;
  if (is_pinned(to))
    return run_until_finite(w, to);
  int r = mo_cuda_reserve_pinned(w.device, &s->sums, bytes);
  if (r == MO_OK)
    r = run_until_finite(w, (float *)s->sums.memory);
  if (r == MO_OK)
    memcpy(to, s->sums.memory, bytes);
  return r;
}

/* Returns how many of `bytes` the buffers may use, since each is slightly larger than requested. */
uint64_t share_of(uint64_t bytes)
{
  return bytes > RESERVE_BYTES ? (bytes - RESERVE_BYTES) / 65 * 64 : 0;
}

uint64_t held(const mo_device *device)
{
  uint64_t sum = device->gradient.weights.bytes;
  for (const mo_cuda_buffer &b : device->gradient.buffers)
    sum += b.bytes;
  return sum;
}

/* Finds how much of the device's memory a pass may use. It queries the driver only if the buffers
 * may have to grow, because an answer occasionally takes ten milliseconds. */
int find_budget(mo_device *device, mo_gradient_plan &plan, const mo_gp_time &time, uint64_t most,
                uint64_t *budget)
{
  mo_gradient_pass all = {};
  *budget = share_of(held(device));
  if (most == 0 && mo_gradient_pass_next(&plan, 0, 0, time, *budget, &all) == MO_OK &&
      all.end == plan.n_groups)
    return MO_OK;
  size_t free_bytes = 0, total = 0;
  const int r = mo_cuda_check(device, cudaMemGetInfo(&free_bytes, &total), "device");
  *budget = share_of(free_bytes + held(device));
  if (most > 0)
    *budget = std::min(*budget, most);
  return r;
}

} // namespace

void mo_cuda_gradient_trim(struct mo_device *device)
{
  cudaSetDevice(device->index);
  for (mo_cuda_buffer &b : device->gradient.buffers)
    mo_cuda_release(&b);
}

int mo_gradient_run_plan(mo_device *device, mo_device_gradient *call, mo_gradient_plan &plan,
                         uint64_t memory_bytes)
{
  mo_cuda_gradient_state *s = &device->gradient;
  const mo_scheme &scheme = call->physics.scheme;
  const mo_gp_time time = {scheme.n_steps, mo_control_steps(&scheme),
                           scheme.integrator == MO_INTEGRATOR_SPLIT, plan.courses != nullptr,
                           plan.works};
  uint64_t budget = 0;
  if (!mo_gradient_can_be_held(&plan, time, share_of(device->total_bytes))) {
    snprintf(device->error, sizeof(device->error), "a tape of %u steps is too long for this device",
             (unsigned)time.n_steps);
    return MO_ERR_UNSUPPORTED;
  }
  int found = find_budget(device, plan, time, memory_bytes, &budget);
  if (found < 0)
    return found;
  for (uint32_t group = 0, shard = 0; group < plan.n_groups;) {
    work w = {};
    w.device = device;
    w.s = s;
    w.call = call;
    w.plan = &plan;
    int r = mo_gradient_pass_next(&plan, shard, group, time, budget, &w.p);
    if (r < 0)
      return r;
    w.k.dt = (float)scheme.dt_s;
    w.k.dt_s = scheme.dt_s;
    w.k.bisections = lane_bisections(&scheme);
    w.k.sensor = call->controller->sensor;
    w.k.bound = call->options.adjoint_bound;
    w.k.restarts = call->options.adjoint_rule == MO_ADJOINT_RESTART;
    w.k.restart_weight = call->options.restart_weight;
    w.k.n_steps = time.n_steps;
    w.k.control_steps = time.control_steps;
    w.k.splits = time.splits;
    w.k.works = time.works;
    w.k.part_steps = mo_gp_passes(PART_STEPS, time.control_steps) * time.control_steps;
    const double since = now_s();
    r = upload_pass(w);
    if (r == MO_ERR_NO_MEMORY) { /* larger buffers of earlier calls take the space: free all of them
                                  * and reallocate them */
      cudaStreamSynchronize(device->stream);
      mo_cuda_gradient_trim(device);
      r = upload_pass(w);
    }
    s->profile.upload_s += now_s() - since;
    if (r == MO_OK)
      r = compute(w);
    if (r < 0) {
      cudaStreamSynchronize(device->stream);
      return r;
    }
    s->profile.device_bytes = held(device);
    s->profile.passes++;
    s->profile.groups += w.p.end - w.p.first;
    s->profile.halved += w.n_halved;
    group = w.p.end;
    shard = w.p.end_shard;
  }
  return MO_OK;
}
