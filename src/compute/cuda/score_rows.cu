/* score_rows.cu: computes outcomes from rows: plan, upload, launch, losses. */
#include "compute/cuda/device.cuh"
#include "compute/cuda/plan.h"
#include "compute/cuda/score.cuh"

extern "C" {
#include "base/thread.h"
#include "rollout/measuring.h"
#include "rollout/scene.h"
}

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <algorithm>
#include <thread>

namespace {

constexpr uint32_t kThreadsMax = 8, kBodiesPerThread = 256;

/* Returns the rows per group: few enough that all blocks have work, and that the last of several
 * rounds of groups is full. */
uint32_t rows_wanted(uint32_t n, uint32_t blocks, uint32_t most)
{
  const uint64_t round = (uint64_t)blocks * most, rounds = (n + round - 1) / round;
  const uint64_t rows = (n + blocks * rounds - 1) / (blocks * rounds);
  return (uint32_t)((rows + MO_PLAN_COLUMN - 1) / MO_PLAN_COLUMN * MO_PLAN_COLUMN);
}

/* Returns the number of threads that are worthwhile for a plan. */
uint32_t threads_for(const mo_plan &plan)
{
  const uint32_t processors = std::max(1u, std::thread::hardware_concurrency());
  const uint32_t useful = (plan.n_bodies + kBodiesPerThread - 1) / kBodiesPerThread;
  return std::min({useful, processors, kThreadsMax});
}

/* Divides rows into groups. */
int make_plan(mo_plan *plan, const mo_device_score *score, const mo_plan_options &options)
{
  const int status =
      mo_plan_create(plan, score->robots, score->n, &score->physics, score->measures != nullptr);
  if (status != MO_OK)
    return status;
  mo_plan_measure(plan, threads_for(*plan));
  return mo_plan_cut(plan, &options);
}

uint32_t most_places(const mo_plan &plan)
{
  uint32_t most = 0;
  for (uint32_t g = 0; g < plan.n_groups; g++)
    most = plan.groups[g].n_places > most ? plan.groups[g].n_places : most;
  return (most + 31) / 32 * 32;
}

uint32_t most_lengths(const mo_plan &plan)
{
  uint32_t most = 0;
  for (uint32_t g = 0; g < plan.n_groups; g++)
    most = std::max(most, plan.groups[g].n_lengths);
  return (most + 31) / 32 * 32;
}

/* The bytes of all outcomes, after which come the results of rows with tasks, if there are any;
 * what was observed; and the states of rows whose tasks have a tally. */
size_t outcomes_bytes(const mo_plan &plan)
{
  return plan.n * sizeof(mo_cuda_outcome);
}

size_t results_bytes(const mo_plan &plan)
{
  return outcomes_bytes(plan) + (plan.is_special ? plan.n * sizeof(course_result) : 0);
}

size_t observed_bytes(const mo_plan &plan)
{
  return results_bytes(plan) + (plan.observes ? plan.n * sizeof(mo_observed_row) : 0);
}

size_t guided_bytes(const mo_plan &plan)
{
  return plan.has_tally ? plan.n * sizeof(mo_cuda_guided) : 0;
}

size_t inverted_bytes(uint32_t blocks)
{
  return (size_t)blocks * MO_PLAN_ROWS_MAX * MO_PLAN_VOXEL_WORDS * sizeof(uint32_t);
}

int reserve_measures(mo_device *device, const mo_plan &plan, uint32_t blocks)
{
  if (!plan.observes)
    return MO_OK;
  return in_turn(
      [&] {
        return mo_cuda_reserve(device, &device->lengths,
                               (size_t)blocks * most_lengths(plan) * sizeof(float));
      },
      [&] { return mo_cuda_reserve(device, &device->inverted, inverted_bytes(blocks)); });
}

/* per_place: bytes of velocities. */
int reserve(mo_device *device, const mo_plan &plan, uint32_t blocks, uint32_t places,
            size_t per_place)
{
  const size_t outcomes = observed_bytes(plan);
  return in_turn(
      [&] { return reserve_measures(device, plan, blocks); },
      [&] { return mo_cuda_reserve(device, &device->plan, plan.block.bytes); },
      [&] {
        return mo_cuda_reserve(device, &device->velocities, (size_t)blocks * places * per_place);
      },
      [&] { return mo_cuda_reserve(device, &device->outcomes, outcomes); },
      [&] { return mo_cuda_reserve(device, &device->counter, sizeof(uint32_t)); },
      [&] {
        return plan.is_special
                   ? mo_cuda_reserve(device, &device->guided, plan.n * sizeof(mo_cuda_guided))
                   : MO_OK;
      },
      [&] { return mo_cuda_reserve_pinned(device, &device->staged_plan, plan.block.bytes); },
      [&] {
        return mo_cuda_reserve_pinned(device, &device->staged_outcomes,
                                      outcomes + guided_bytes(plan));
      });
}

mo_cuda_score arguments_of(const mo_device *device, const mo_plan &plan,
                           const mo_device_score *score, uint32_t places)
{
  const char *base = (const char *)device->plan.memory;
  const mo_plan_block &block = plan.block;
  mo_cuda_score s = {};
  s.environments = (const mo_plan_environment *)(base + block.environments);
  s.bodies = (const mo_plan_body *)(base + block.bodies);
  s.pairs = (const mo_plan_pairs *)(base + block.pairs);
  s.links = (const uint32_t *)(base + block.links);
  s.masses = (const uint32_t *)(base + block.masses);
  s.ranks = (const uint8_t *)(base + block.ranks);
  s.inputs = (const uint8_t *)(base + block.inputs);
  s.groups = (const mo_plan_group *)(base + block.groups);
  s.parts = (const mo_plan_part *)(base + block.parts);
  s.rows = (const mo_plan_row *)(base + block.rows);
  s.tiles = (const mo_plan_tile *)(base + block.tiles);
  s.columns = (const uint16_t *)(base + block.columns);
  s.weights = score->controller == nullptr ? nullptr : score->controller->weights;
  s.generators = (const float *)device->generators.memory;
  s.velocities = (float *)device->velocities.memory;
  s.outcomes = (mo_cuda_outcome *)device->outcomes.memory;
  s.next_group = (uint32_t *)device->counter.memory;
  s.cancel = device->cancel_on_device;
  s.layout = mo_weights_layout();
  s.dt = (float)score->physics.scheme.dt_s;
  s.bisections = lane_bisections(&score->physics.scheme);
  s.n_groups = plan.n_groups;
  s.n_steps = score->physics.scheme.n_steps;
  s.max_places = places;
  s.control_steps = mo_control_steps(&score->physics.scheme);
  s.splits = score->physics.scheme.integrator == MO_INTEGRATOR_SPLIT;
  return s;
}

mo_cuda_tasks task_arguments(const mo_device *device, const mo_plan &plan,
                             const mo_device_score *score)
{
  const mo_scheme &scheme = score->physics.scheme;
  const uint32_t period = mo_control_steps(&scheme);
  mo_cuda_tasks t = {};
  t.environments = (const mo_environment *)((const char *)device->plan.memory + plan.block.tasks);
  t.rows = device->guided.of<mo_cuda_guided>();
  t.results = (course_result *)((char *)device->outcomes.memory + outcomes_bytes(plan));
  t.dt_s = scheme.dt_s;
  t.end_s = scheme.n_steps * scheme.dt_s;
  t.n_periods = (scheme.n_steps + period - 1) / period;
  return t;
}

mo_cuda_measures measure_arguments(const mo_device *device, const mo_plan &plan)
{
  const char *base = (const char *)device->plan.memory;
  mo_cuda_measures m = {};
  m.rest = (const mo_plan_rest *)(base + plan.block.rest);
  m.voxels = (const mo_plan_voxels *)(base + plan.block.voxels);
  m.corners = (const mo_plan_corners *)(base + plan.block.corners);
  m.observed = (mo_observed_row *)((char *)device->outcomes.memory + results_bytes(plan));
  m.lengths = device->lengths.of<float>();
  m.inverted = device->inverted.of<uint32_t>();
  m.max_lengths = most_lengths(plan);
  return m;
}

/* Launches the kernel for plain rows, or the one that also computes tasks and measures. */
cudaError_t launch(mo_device *device, const mo_plan &plan, const mo_device_score *score,
                   uint32_t places, uint32_t blocks)
{
  const mo_cuda_score arguments = arguments_of(device, plan, score, places);
  if (!plan.is_special)
    return device->score->launch(arguments, blocks, device->stream);
  const mo_cuda_tasks tasks = task_arguments(device, plan, score);
  const mo_cuda_measures measures = measure_arguments(device, plan);
  return device->tasks->launch(arguments, tasks, plan.observes ? &measures : nullptr, blocks,
                               device->stream);
}

/* What the device has written, in pinned memory; NULL: not for these rows. */
struct Written {
  const mo_cuda_outcome *outcomes;
  const course_result *results;
  const mo_observed_row *observed;
  const mo_cuda_guided *guided;
  const mo_device_score *score;
};

Written written_by(const mo_device *device, const mo_plan &plan, const mo_device_score *score)
{
  const char *staged = (const char *)device->staged_outcomes.memory;
  return Written{(const mo_cuda_outcome *)staged,
                 plan.is_special ? (const course_result *)(staged + outcomes_bytes(plan)) : nullptr,
                 plan.observes ? (const mo_observed_row *)(staged + results_bytes(plan)) : nullptr,
                 plan.has_tally ? (const mo_cuda_guided *)(staged + observed_bytes(plan)) : nullptr,
                 score};
}

void hand_over_row(const Written &from, size_t r)
{
  const mo_device_score *score = from.score;
  const mo_robot *robot = score->robots + r;
  const mo_task *task = &robot->environment->task;
  mo_outcome *to = score->outcomes + r;
  double observed[MO_MEASURES];
  memcpy(to->com_start_m, from.outcomes[r].com_start_m, sizeof(to->com_start_m));
  memcpy(to->com_end_m, from.outcomes[r].com_end_m, sizeof(to->com_end_m));
  to->diverged_step = from.outcomes[r].diverged_step;
  if (from.observed != nullptr)
    mo_observe_measures(from.observed + r, robot, &score->physics, to, observed);
  if (score->measures != nullptr)
    mo_measures_round(MO_MEASURES_ALL, observed, score->measures[r]);
  if (mo_task_is_plain(task)) {
    mo_scene_finish(to, robot->environment);
  } else if (course_has_tally(task)) {
    mo_observe_finish(&from.guided[r].track, from.observed != nullptr ? observed : nullptr, robot,
                      &score->physics, to);
  } else {
    to->loss = from.results[r].loss;
    to->value = from.results[r].value;
  }
}

void hand_over_some(void *context, size_t first, size_t end)
{
  for (size_t r = first; r < end; r++)
    hand_over_row(*(const Written *)context, r);
}

/* Copies the states of rows whose tasks have a tally. */
cudaError_t fetch_states(mo_device *device, const mo_plan &plan)
{
  char *staged = (char *)device->staged_outcomes.memory;
  return plan.has_tally
             ? cudaMemcpyAsync(staged + observed_bytes(plan), device->guided.memory,
                               guided_bytes(plan), cudaMemcpyDeviceToHost, device->stream)
             : cudaSuccess;
}

/* Computes outcomes, in pinned memory, from a plan. */
int run(mo_device *device, const mo_plan &plan, const mo_device_score *score, uint32_t blocks,
        float *device_ms)
{
  const uint32_t places = most_places(plan);
  if (plan.n_groups < blocks)
    blocks = plan.n_groups;
  const bool splits = score->physics.scheme.integrator == MO_INTEGRATOR_SPLIT;
  int status = reserve(device, plan, blocks, places, (splits ? 6 : 3) * sizeof(float));
  if (status != MO_OK)
    return status;
  void *block = device->staged_plan.memory;
  mo_plan_fill(&plan, block, threads_for(plan));
  if (score->cancel != nullptr && __atomic_load_n(score->cancel, __ATOMIC_RELAXED) != 0)
    return MO_ERR_CANCELLED;
  status =
      mo_cuda_generators(device, &score->physics); /* begins a copy, which must be waited for */
  if (status != MO_OK)
    return status;
  const cudaStream_t stream = device->stream;
  const cudaError_t error =
      in_turn([&] { return cudaEventRecord(device->begin, stream); },
              [&] {
                return cudaMemcpyAsync(device->plan.memory, block, plan.block.bytes,
                                       cudaMemcpyHostToDevice, stream);
              },
              [&] { return cudaMemsetAsync(device->counter.memory, 0, sizeof(uint32_t), stream); },
              [&] { return launch(device, plan, score, places, blocks); },
              [&] {
                return cudaMemcpyAsync(device->staged_outcomes.memory, device->outcomes.memory,
                                       observed_bytes(plan), cudaMemcpyDeviceToHost, stream);
              },
              [&] { return fetch_states(device, plan); },
              [&] { return cudaEventRecord(device->end, stream); });
  const int launched = mo_cuda_check(device, error, "launch");
  /* Launched work must have finished before its buffers are used again. */
  status = mo_cuda_wait(device, score->cancel);
  if (launched != MO_OK || status != MO_OK)
    return launched != MO_OK ? launched : status;
  return mo_cuda_check(device, cudaEventElapsedTime(device_ms, device->begin, device->end),
                       "timing");
}

} // namespace

int mo_cuda_score_rows(mo_device *device, mo_device_score *score)
{
  if (mo_control_steps(&score->physics.scheme) == 0)
    return MO_ERR_INVALID;
  const double start_s = now_s();
  const mo_cuda_score_kernel &kernel = *device->score;
  const uint32_t blocks = (uint32_t)device->multiprocessors * kernel.blocks;
  mo_plan_options options = {};
  options.rows = rows_wanted(score->n, blocks, kernel.rows);
  options.group_bytes = kernel.group_bytes;
  options.column_bytes = kernel.column_bytes;
  options.part_bytes = sizeof(mo_plan_pairs);
  options.place_bytes = 3 * sizeof(float);
  options.length_bytes = sizeof(float);
  mo_plan plan;
  float device_ms = 0;
  int status = make_plan(&plan, score, options);
  if (status == MO_OK)
    status = run(device, plan, score, blocks, &device_ms);
  if (status == MO_OK) {
    Written written = written_by(device, plan, score);
    mo_parallel(plan.observes || plan.has_tally ? threads_for(plan) : 1, score->n, hand_over_some,
                &written);
    score->device_s = 1e-3 * device_ms;
    score->host_s = fmax(0.0, now_s() - start_s - score->device_s);
  }
  mo_plan_free(&plan);
  return status;
}
