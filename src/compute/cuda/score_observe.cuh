/* score_observe.cuh: what is observed of rows that are measured (observe.h).
 *
 * At the start of each control period, when the new lengths are known, one warp per row observes
 * poses, springs and voxels: lanes take masses and voxels in turn, and their float32 sums are added
 * in a fixed order. Contacts are counted where masses move, for the step in the upper bits of the
 * row's `insane`: the kernel has no shared memory to spare, and integers have the same sum in any
 * order. */
#ifndef MORPHO_COMPUTE_CUDA_SCORE_OBSERVE_CUH
#define MORPHO_COMPUTE_CUDA_SCORE_OBSERVE_CUH

#include "compute/cuda/score_guide.cuh"
#include "compute/cuda/score_move.cuh"

namespace {

/* The bits of `insane` in which a step's contacts are counted: a row has at most 245 masses, and a
 * mass counts as two halves. */
constexpr uint32_t kContacts = 2, kFront = 10, kLeft = 19;
constexpr uint32_t kContactsMask = 0xff, kHalvesMask = 0x1ff;
static_assert(MO_DEFAULT_MASSES <= kContactsMask && 2 * MO_DEFAULT_MASSES <= kHalvesMask,
              "the counts of a step fit in their bits");
static_assert(kRows <= MO_PLAN_ROWS_MAX, "rows of mo_cuda_measures.inverted");

__device__ __forceinline__ float sum_of_warp(float x)
{
#pragma unroll
  for (int step = 16; step > 0; step /= 2)
    x += __shfl_xor_sync(kAll, x, step);
  return x;
}

__device__ __forceinline__ float largest_of_warp(float x)
{
#pragma unroll
  for (int step = 16; step > 0; step /= 2)
    x = fmaxf(x, __shfl_xor_sync(kAll, x, step));
  return x;
}

/* A row, as its warp reads it. */
struct Observed {
  Row row;
  const Part &part;
  Home home;
  const float *position; /* of the row's first mass */
  uint32_t lane;

  __device__ __forceinline__ const float *at(uint32_t mass) const
  {
    return position + 3 * (mass * row.stride);
  }
};

__device__ __forceinline__ Observed observed_row(const Shared &shared, const Memory &memory,
                                                 uint32_t r)
{
  const Row row = shared.rows[r];
  return Observed{row, shared.parts[row.part], shared.homes[r],
                  memory.position + 3 * row.first_place, threadIdx.x & 31};
}

/* Positions are relative to the first mass, and therefore so small that float32 sums lose nothing
 * that matters. up: only at the end of a rollout. */
template <bool UP>
__device__ __forceinline__ void pose_of(const mo_cuda_measures &k, const Observed &o,
                                        float (&turn)[2], float (&up)[3])
{
  const float first[3] = {o.position[0], o.position[1], o.position[2]};
  turn[0] = turn[1] = up[0] = up[1] = up[2] = 0.0f;
  for (uint32_t m = o.lane; m < o.row.n_masses; m += 32) {
    const float4 rest = __ldg(reinterpret_cast<const float4 *>(k.rest + o.part.first_mass + m));
    const float *p = o.at(m);
    const float d[3] = {p[0] - first[0], p[1] - first[1], p[2] - first[2]};
    turn[0] = fmaf(rest.y, d[1], fmaf(rest.x, d[0], turn[0]));
    turn[1] = fmaf(-rest.y, d[0], fmaf(rest.x, d[1], turn[1]));
    if (UP)
      for (int axis = 0; axis < 3; axis++)
        up[axis] = fmaf(rest.z, d[axis], up[axis]);
  }
  for (int i = 0; i < 2; i++)
    turn[i] = sum_of_warp(turn[i]);
  if (UP)
    for (int i = 0; i < 3; i++)
      up[i] = sum_of_warp(up[i]);
}

/* The state of a row's springs at an instant. */
struct Stretch {
  float strain, energy;
};

/* Visits each spring from the end with the smaller number; links that fill up a set of four lead
 * from a mass to itself. before: the lengths of the previous period, or NULL. */
__device__ __forceinline__ Stretch stretch_of(const mo_cuda_score &score, const Memory &memory,
                                              const float *before, const Observed &o, uint32_t cut)
{
  const uint32_t n_edges = score.bodies[o.row.body].n_edges;
  Stretch sum = {0.0f, 0.0f};
  for (uint32_t m = o.lane; m < o.row.n_masses; m += 32) {
    const uint32_t mass = __ldg(score.masses + o.part.first_mass + m);
    const uint32_t *links =
        score.links + MO_PLAN_LINKS * (size_t)(o.part.first_quad + MO_PLAN_MASS_QUAD(mass));
    const float *p = o.at(m);
    for (uint32_t i = 0; i < MO_PLAN_LINKS * MO_PLAN_MASS_QUADS(mass); i++) {
      const uint32_t link = __ldg(links + i), other = MO_PLAN_LINK_MASS(link),
                     slot = MO_PLAN_LINK_SLOT_OF(link);
      if (other <= m || MO_PLAN_LINK_PART_OF(link) == cut)
        continue;
      const float *q = o.at(other);
      const float d[3] = {q[0] - p[0], q[1] - p[1], q[2] - p[2]};
      const float length = __fsqrt_rn(lane_squared(d)), rest = lane_rest(slot >= n_edges);
      sum.strain = fmaxf(sum.strain, fabsf(__fdiv_rn(length, rest) - 1.0f));
      if (before == nullptr)
        continue;
      const uint32_t place = o.home.first_length + slot * o.home.stride;
      const float now = memory.lengths[place], then = __ldcg(before + place);
      sum.energy += fmaxf((then - now) * (2.0f * length - then - now), 0.0f);
    }
  }
  return Stretch{largest_of_warp(sum.strain), sum_of_warp(sum.energy)};
}

/* Returns whether a voxel's mean edges along x, y and z are left-handed. Four times a mean edge is
 * a sum of the four diagonals of the box with signs. */
__device__ __forceinline__ bool is_inverted(const Observed &o, const mo_plan_corners &corners)
{
  float e[3][3];
  for (int axis = 0; axis < 3; axis++) {
    const float a = o.at(corners.mass[7])[axis] - o.at(corners.mass[0])[axis],
                b = o.at(corners.mass[6])[axis] - o.at(corners.mass[1])[axis],
                c = o.at(corners.mass[5])[axis] - o.at(corners.mass[2])[axis],
                d = o.at(corners.mass[4])[axis] - o.at(corners.mass[3])[axis];
    e[0][axis] = (a + b) + (c + d);
    e[1][axis] = (a + b) - (c + d);
    e[2][axis] = (a - b) + (c - d);
  }
  return e[0][0] * (e[1][1] * e[2][2] - e[1][2] * e[2][1]) +
             e[0][1] * (e[1][2] * e[2][0] - e[1][0] * e[2][2]) +
             e[0][2] * (e[1][0] * e[2][1] - e[1][1] * e[2][0]) <
         0.0f;
}

/* Returns the number of voxels that are inverted now and were at the previous instant. */
__device__ __forceinline__ uint32_t count_inverted(const mo_cuda_measures &k, const Observed &o,
                                                   uint32_t r, bool is_first)
{
  const mo_plan_voxels voxels = k.voxels[o.row.body];
  uint32_t *bits = k.inverted + ((size_t)blockIdx.x * MO_PLAN_ROWS_MAX + r) * MO_PLAN_VOXEL_WORDS;
  uint32_t count = 0;
  for (uint32_t first = 0; first < voxels.n; first += 32) {
    const uint32_t v = first + o.lane;
    const uint32_t now =
        __ballot_sync(kAll, v < voxels.n && is_inverted(o, k.corners[voxels.first + v]));
    const uint32_t before = is_first ? 0 : bits[first / 32];
    __syncwarp();
    count += (uint32_t)__popc((int)(now & before));
    if (o.lane == 0)
      bits[first / 32] = now;
  }
  return count;
}

__device__ __noinline__ void begin_measures(const mo_cuda_tasks &tasks, const mo_cuda_measures &k)
{
  const Shared &shared = shared_of_block();
  if (threadIdx.x < shared.plan.n_rows) {
    const mo_plan_row row = shared.score.rows[shared.plan.first_row + threadIdx.x];
    const double *start_m = shared.score.outcomes[row.row].com_start_m;
    const double com_m[3] = {start_m[0], start_m[1], start_m[2]};
    mo_observed_row observed;
    observe_begin(&observed, tasks.environments + row.environment, com_m);
    k.observed[row.row] = observed;
  }
  __syncthreads();
}

/* Observes the rows at the start of a control period. */
__device__ __noinline__ void observe_rows(const mo_cuda_tasks &tasks, const mo_cuda_measures &k,
                                          uint32_t step)
{
  const Shared &shared = shared_of_block();
  const mo_cuda_score &score = shared.score;
  const Memory memory = memory_of(score);
  const float *before = step > 0 && score.weights != nullptr
                            ? k.lengths + (size_t)blockIdx.x * k.max_lengths
                            : nullptr;
  __syncthreads(); /* all centers of mass have been written */
  for (uint32_t r = threadIdx.x >> 5; r < shared.plan.n_rows; r += MO_CUDA_WARPS) {
    if (shared.diverged[r] != 0)
      continue;
    const Observed o = observed_row(shared, memory, r);
    float turn[2], up[3];
    pose_of<false>(k, o, turn, up);
    const Stretch stretch = stretch_of(score, memory, before, o, cut_of(shared, r, step));
    const uint32_t inverted = count_inverted(k, o, r, step == 0);
    if (o.lane != 0)
      continue;
    const mo_plan_row plan = score.rows[shared.plan.first_row + r];
    mo_observed_row &row = k.observed[plan.row];
    const float *com = shared.com[step & 1][r];
    const double com_m[3] = {(double)com[0] + MO_WORLD_CENTER_M, (double)com[1] + MO_WORLD_CENTER_M,
                             (double)com[2]};
    const double turned[2] = {(double)turn[0], (double)turn[1]};
    if (step > 0)
      observe_pose(&row, tasks.environments + plan.environment, com_m, turned);
    row.strain = fmaxf(row.strain, stretch.strain);
    row.energy_m2 += (double)stretch.energy;
    row.inverted = max(row.inverted, inverted);
  }
}

/* Ends the measures, after end_group. */
__device__ __noinline__ void end_measures(const mo_cuda_tasks &tasks, const mo_cuda_measures &k)
{
  const Shared &shared = shared_of_block();
  const Memory memory = memory_of(shared.score);
  __syncthreads();
  for (uint32_t r = threadIdx.x >> 5; r < shared.plan.n_rows; r += MO_CUDA_WARPS) {
    if (shared.diverged[r] != 0)
      continue;
    const Observed o = observed_row(shared, memory, r);
    float turn[2], up[3];
    pose_of<true>(k, o, turn, up);
    if (o.lane != 0)
      continue;
    const mo_plan_row plan = shared.score.rows[shared.plan.first_row + r];
    const double *end_m = shared.score.outcomes[plan.row].com_end_m;
    const double com_m[3] = {end_m[0], end_m[1], end_m[2]};
    const double turned[2] = {(double)turn[0], (double)turn[1]};
    mo_observed_row &row = k.observed[plan.row];
    observe_pose(&row, tasks.environments + plan.environment, com_m, turned);
    for (int axis = 0; axis < 3; axis++)
      row.up[axis] = (double)up[axis];
  }
}

struct Measured : Tasks {
  const mo_cuda_measures &m;

  __device__ __forceinline__ Measured(const mo_cuda_tasks &tasks, const mo_cuda_measures &measures)
      : Tasks(tasks), m(measures)
  {
  }
  __device__ __forceinline__ void begin() const
  {
    Tasks::begin();
    begin_measures(k, m);
  }
  /* Keeps the lengths before the network overwrites them. */
  __device__ __forceinline__ void keep_lengths(const Memory &memory, uint32_t step) const
  {
    float *lengths = m.lengths + (size_t)blockIdx.x * m.max_lengths;
    const uint32_t n = step > 0 ? shared_of_block().plan.n_lengths : 0;
    for (uint32_t i = threadIdx.x; i < n; i += MO_CUDA_THREADS)
      __stcg(lengths + i, memory.lengths[i]);
  }
  __device__ __forceinline__ void observe(const mo_cuda_score &score, uint32_t step) const
  {
    if (step % score.control_steps == 0)
      observe_rows(k, m, step);
  }
  /* mass: among those of all bodies. */
  __device__ __forceinline__ void touches(Shared &shared, uint32_t row, uint32_t mass) const
  {
    const uint32_t halves = __ldg(&m.rest[mass].halves);
    atomicAdd(shared.insane + row,
              (int)(1u << kContacts | (halves & 3) << kFront | (halves >> 2) << kLeft));
  }
  __device__ __forceinline__ bool end_step(const mo_cuda_score &score, Shared &shared,
                                           uint32_t step) const
  {
    if (threadIdx.x >= shared.plan.n_rows)
      return false;
    const uint32_t word = (uint32_t)shared.insane[threadIdx.x];
    const uint32_t contacts = word >> kContacts & kContactsMask;
    mo_observed_row &row = m.observed[score.rows[shared.plan.first_row + threadIdx.x].row];
    shared.insane[threadIdx.x] = (int)(word & 1);
    if (contacts == 0) {
      row.air_steps++;
      row.hops += row.touches;
    }
    row.touches = contacts > 0;
    if (step % score.control_steps == 0) {
      row.contacts += contacts;
      row.front_2 += word >> kFront & kHalvesMask;
      row.left_2 += word >> kLeft & kHalvesMask;
    }
    return (word & 1) != 0;
  }
  __device__ __forceinline__ void end() const
  {
    Tasks::end();
    end_measures(k, m);
  }
};

} // namespace

#endif
