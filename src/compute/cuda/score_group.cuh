/* score_group.cuh: a group of rows in the memory of its block, and the start and end of its
 * rollouts. The network for one kind of device, network_narrow.cuh or network_wide.cuh, is included
 * first. */
#ifndef MORPHO_COMPUTE_CUDA_SCORE_GROUP_CUH
#define MORPHO_COMPUTE_CUDA_SCORE_GROUP_CUH

#include "compute/cuda/network.cuh"
#include "compute/cuda/score.cuh"
#include "compute/cuda/terrain.cuh"

namespace {

constexpr uint32_t kRows = MO_CUDA_ROWS;
constexpr uint32_t kChunks = MO_CUDA_CHUNKS;
constexpr uint32_t kCancelSteps = 16;
constexpr unsigned kAll = 0xffffffffu;

/* A part of the group, as read by the physics. */
struct Part {
  uint32_t first_place, n_rows, n_masses, first_quad, first_mass, first_row, first_length;
  float per_row; /* 1 / n_rows */
};

struct Row {
  uint32_t first_place, stride; /* place of mass m: first_place + m · stride */
  uint32_t n_masses, body, part;
};

/* A row for the last layer: its pairs, and the place of its lengths. */
struct __align__(8) Home
{
  uint32_t first_length; /* length of own slot s: first_length + s · stride */
  uint16_t part, stride;
};

struct Shared {
  float first[MO_HIDDEN]; /* initial values of the first layer's sums */
  float4 light[kRows];    /* and the terrain's highest point */
  float com[2][kRows][3]; /* at the start of even and odd steps */
  Part parts[kRows];
  Row rows[kRows];
  __align__(16) Home homes[kRows]; /* unused rows refer to the empty pairs after the last part */
  const mo_plan_environment *environments[kRows];
  float4 kicks[kRows]; /* the constants that every mass needs in every step: pull, keep, fall; and
                          for `split` per_push. Reading them from the scene took 2 % of a rollout */
  __align__(8) float actuation[kRows];
  uint32_t chunks[kChunks]; /* part << 16 | number */
  int insane[kRows], diverged[kRows];
  uint32_t n_chunks, group;
  int cancelled;
  mo_plan_group plan;
  mo_weights_scalars scalars;
  mo_cuda_score
      score; /* a copy, so that its readers hold no registers for it (score_think_wide.cuh) */
};

constexpr size_t kSharedBytes = (sizeof(Shared) + 127) / 128 * 128;

/* ---- the start of a rollout, in float64 as in rollout/scene.c ---- */

/* Returns where along an axis a mass starts. */
__device__ double start_of(uint32_t cell, int side)
{
  return MO_WORLD_CENTER_M - 0.5 * MO_VOXEL_M * side + MO_VOXEL_M * cell;
}

/* Places one row, with one warp. */
template <class TASKS>
__device__ void place_row(const mo_cuda_score &score, const Shared &shared, const TASKS &tasks,
                          uint32_t r, float *position, uint32_t lane)
{
  const Row row = shared.rows[r];
  const Part &part = shared.parts[row.part];
  const mo_plan_row plan = score.rows[shared.plan.first_row + r];
  const uint32_t *masses = score.masses + part.first_mass;
  const double *heights = score.environments[plan.environment].heights_m;
  const terrain_map map = tasks.map_of(plan.environment);
  uint32_t lowest = 255;
  for (uint32_t m = lane; m < row.n_masses; m += 32)
    lowest = min(lowest, MO_PLAN_MASS_Z(masses[m]));
  lowest = __reduce_min_sync(kAll, lowest);
  double lift = -INFINITY;
  for (uint32_t m = lane; m < row.n_masses; m += 32) {
    const uint32_t mass = masses[m];
    lift = fmax(lift, terrain_height(&map, heights, start_of(MO_PLAN_MASS_X(mass), 6),
                                     start_of(MO_PLAN_MASS_Y(mass), 6)) -
                          MO_VOXEL_M * (MO_PLAN_MASS_Z(mass) - lowest));
  }
  for (int step = 16; step > 0; step /= 2)
    lift = fmax(lift, __shfl_xor_sync(kAll, lift, step));
  lift += score.environments[plan.environment].drop_m;
  for (uint32_t m = lane; m < row.n_masses; m += 32) {
    const uint32_t mass = masses[m];
    float *p = position + 3 * (size_t)(row.first_place + m * row.stride);
    p[0] = (float)(start_of(MO_PLAN_MASS_X(mass), 6) - MO_WORLD_CENTER_M);
    p[1] = (float)(start_of(MO_PLAN_MASS_Y(mass), 6) - MO_WORLD_CENTER_M);
    p[2] = (float)(MO_VOXEL_M * (MO_PLAN_MASS_Z(mass) - lowest) + lift);
  }
  if (lane < 3) {
    const uint8_t *ranks = score.ranks + part.first_mass;
    double sum = 0;
    for (uint32_t i = 0; i < row.n_masses; i++) {
      const uint32_t mass = masses[ranks[i]];
      sum += lane == 0   ? start_of(MO_PLAN_MASS_X(mass), 6)
             : lane == 1 ? start_of(MO_PLAN_MASS_Y(mass), 6)
                         : MO_VOXEL_M * (MO_PLAN_MASS_Z(mass) - lowest) + lift;
    }
    score.outcomes[plan.row].com_start_m[lane] = sum / row.n_masses;
  }
}

/* The memory after the block's Shared. */
struct Memory {
  mo_cuda_activations x;
  float *position;      /* (places, 3) */
  mo_plan_pairs *pairs; /* (parts + 1): the last is empty */
  float *lengths;       /* (lengths) the target lengths of springs */
  float2 *partial;      /* partial sums of LayerNorm, in the memory of lengths before these exist */
  float *velocity;      /* (places, 3), in global memory; with `split` (2, max_places, 3) */
};

extern __shared__ __align__(128) char block_memory[];

__device__ __forceinline__ Shared &shared_of_block()
{
  return *reinterpret_cast<Shared *>(block_memory);
}

/* Returns the memory of the block's group. */
__device__ __forceinline__ Memory memory_of(const mo_cuda_score &score)
{
  const mo_plan_group &plan = shared_of_block().plan;
  const uint32_t columns = (plan.n_rows + MO_PLAN_COLUMN - 1) / MO_PLAN_COLUMN;
  Memory memory;
  memory.x = mo_cuda_activations_of(block_memory + kSharedBytes, columns);
  memory.position = reinterpret_cast<float *>(memory.x.memory + columns * MO_CUDA_COLUMN_BYTES +
                                              MO_CUDA_PAD_BYTES);
  memory.pairs = reinterpret_cast<mo_plan_pairs *>(memory.position + 3 * plan.n_places);
  memory.lengths = reinterpret_cast<float *>(memory.pairs + plan.n_parts + 1);
  /* The space suffices: a group that fills the memory has at least as many bytes of lengths as of
   * positions. */
  const uint32_t behind = (uint32_t)(reinterpret_cast<char *>(memory.lengths) - block_memory);
  memory.partial = reinterpret_cast<float2 *>(block_memory + (behind + 15) / 16 * 16);
  memory.velocity = score.velocities + (size_t)blockIdx.x * 3 * score.max_places;
  return memory;
}

/* Returns the physics of a row. */
__device__ __forceinline__ lane_physics physics_of(const mo_cuda_score &score,
                                                   const mo_plan_scene &scene)
{
  return lane_physics_alike(score.dt, score.bisections, &scene.constants);
}

/* Sets the rows' kicks for `split`: those of the first step or of the others. */
__device__ void set_kicks(Shared &shared, bool is_first)
{
  const uint32_t row = threadIdx.x;
  if (row < shared.plan.n_rows) {
    const lane_constants &of = shared.environments[row]->scene.constants;
    const mo_plan_split &split = shared.environments[row]->split;
    shared.kicks[row] =
        is_first ? make_float4(split.first_pull, of.keep, split.first_fall, split.first_per_push)
                 : make_float4(of.pull, of.keep, of.fall, split.constants.per_push);
  }
  __syncthreads();
}

/* Sorts the chunks in descending order of their number of links, then arranges them in alternating
 * direction, so that the warps, which take them in turn, have about the same number of links. */
__device__ void deal_chunks(const mo_cuda_score &score, Shared &shared)
{
  constexpr uint32_t kCost = 24, kTurns = (MO_CUDA_CHUNKS + MO_CUDA_THREADS - 1) / MO_CUDA_THREADS;
  const uint32_t n = shared.n_chunks;
  uint32_t chunk[kTurns], place[kTurns];
  for (uint32_t c = threadIdx.x; c < n; c += MO_CUDA_THREADS) {
    const Part &part = shared.parts[shared.chunks[c] >> 16];
    const uint32_t mass =
        (shared.chunks[c] & 0xffffu) * 32 / part.n_rows; /* the ones after it do not have more */
    shared.chunks[c] |= MO_PLAN_MASS_QUADS(__ldg(score.masses + part.first_mass + mass)) << kCost;
  }
  __syncthreads();
#pragma unroll
  for (uint32_t i = 0; i < kTurns; i++) {
    const uint32_t c = threadIdx.x + i * MO_CUDA_THREADS;
    uint32_t before = 0;
    chunk[i] = c < n ? shared.chunks[c] : 0;
    for (uint32_t k = 0; c < n && k < n; k++) {
      const uint32_t cost = shared.chunks[k] >> kCost, own = chunk[i] >> kCost;
      before += cost > own || (cost == own && k < c);
    }
    const uint32_t turn = before / MO_CUDA_WARPS, last = turn * MO_CUDA_WARPS + MO_CUDA_WARPS - 1;
    place[i] = turn % 2 == 1 && last < n ? last - before % MO_CUDA_WARPS : before;
  }
  __syncthreads();
#pragma unroll
  for (uint32_t i = 0; i < kTurns; i++)
    if (threadIdx.x + i * MO_CUDA_THREADS < n)
      shared.chunks[place[i]] = chunk[i] & ((1u << kCost) - 1);
}

/* Sets up the group's rows and parts, once per group. TASKS: as live_of (score_live.cuh). */
template <class TASKS>
__device__ void begin_group(const mo_cuda_score &score, Shared &shared, const TASKS &tasks,
                            const Memory &memory)
{
  const uint32_t thread = threadIdx.x, lane = thread & 31, warp = thread >> 5;
  const mo_plan_group &plan = shared.plan;
  if (thread < plan.n_parts) {
    const mo_plan_part in = score.parts[plan.first_part + thread];
    const mo_plan_body &body = score.bodies[in.body];
    Part &part = shared.parts[thread];
    part.first_place = in.first_place;
    part.n_rows = in.n_rows;
    part.n_masses = body.n_masses;
    part.first_quad = body.first_quad;
    part.first_mass = body.first_mass;
    part.first_row = in.first_row;
    part.first_length = in.first_length;
    part.per_row = 1.0f / (float)in.n_rows;
    for (uint32_t r = 0; r < in.n_rows; r++) {
      shared.rows[in.first_row + r] =
          Row{in.first_place + r, in.n_rows, body.n_masses, in.body, thread};
      shared.homes[in.first_row + r] =
          Home{in.first_length + r, (uint16_t)thread, (uint16_t)in.n_rows};
    }
  }
  if (thread < kRows) {
    shared.insane[thread] = 0;
    shared.diverged[thread] = 0;
    if (thread < plan.n_rows) {
      const mo_plan_environment &environment =
          score.environments[score.rows[plan.first_row + thread].environment];
      const mo_plan_scene &scene = environment.scene;
      shared.light[thread] =
          make_float4(scene.light[0], scene.light[1], scene.light[2], scene.highest);
      shared.environments[thread] = &environment;
      shared.actuation[thread] = scene.constants.actuation;
      shared.kicks[thread] =
          make_float4(scene.constants.pull, scene.constants.keep, scene.constants.fall, 0.0f);
    } else {
      shared.homes[thread] = Home{0, (uint16_t)plan.n_parts, 0};
    }
  }
  __syncthreads();
  if (thread == 0) {
    uint32_t n = 0;
    for (uint32_t p = 0; p < plan.n_parts; p++)
      for (uint32_t c = 0; c * 32 < shared.parts[p].n_masses * shared.parts[p].n_rows; c++)
        shared.chunks[n++] = p << 16 | c;
    shared.n_chunks = n;
  }
  __syncthreads();
  deal_chunks(score, shared);
  for (uint32_t r = warp; r < plan.n_rows; r += MO_CUDA_WARPS)
    place_row(score, shared, tasks, r, memory.position, lane);
  for (uint32_t k = thread; k < 3 * plan.n_places; k += MO_CUDA_THREADS)
    memory.velocity[k] = 0.0f;
  constexpr uint32_t kWords = sizeof(mo_plan_pairs) / sizeof(uint32_t);
  for (uint32_t p = 0; p <= plan.n_parts; p++)
    if (thread < kWords)
      reinterpret_cast<uint32_t *>(memory.pairs + p)[thread] =
          p < plan.n_parts ? __ldg(reinterpret_cast<const uint32_t *>(
                                       score.pairs + score.parts[plan.first_part + p].body) +
                                   thread)
                           : 0;
  if (score.weights == nullptr) {
    for (uint32_t p = 0; p < plan.n_parts; p++) {
      const Part &part = shared.parts[p];
      const mo_plan_body &body = score.bodies[score.parts[plan.first_part + p].body];
      for (uint32_t k = thread; k < body.n_slots * part.n_rows; k += MO_CUDA_THREADS)
        memory.lengths[part.first_length + k] = lane_rest(k >= body.n_edges * part.n_rows);
    }
  }
  __syncthreads();
}

__device__ void end_group(const mo_cuda_score &score, const Shared &shared, const float *position)
{
  for (uint32_t k = threadIdx.x; k < 3 * shared.plan.n_rows; k += MO_CUDA_THREADS) {
    const uint32_t r = k / 3, axis = k % 3;
    const Row row = shared.rows[r];
    mo_cuda_outcome *outcome = score.outcomes + score.rows[shared.plan.first_row + r].row;
    if (axis == 0)
      outcome->diverged_step = shared.diverged[r];
    if (shared.diverged[r] != 0)
      continue; /* com_end was written at that time */
    const uint8_t *ranks = score.ranks + shared.parts[row.part].first_mass;
    double sum = 0;
    for (uint32_t i = 0; i < row.n_masses; i++)
      sum += position[3 * (row.first_place + ranks[i] * row.stride) + axis];
    outcome->com_end_m[axis] = sum / row.n_masses + (axis < 2 ? MO_WORLD_CENTER_M : 0.0);
  }
}

} // namespace

#endif
