/* score_move.cuh: computes positions from lengths: springs, then motion and contact. */
#ifndef MORPHO_COMPUTE_CUDA_SCORE_MOVE_CUH
#define MORPHO_COMPUTE_CUDA_SCORE_MOVE_CUH

#include "compute/cuda/score_group.cuh"

namespace {

/* A thread's mass and row within a chunk. */
struct Item {
  uint32_t mass, row; /* row: within the part */
  uint32_t place;
  bool used;
};

__device__ __forceinline__ Item item_of(const Part &part, uint32_t chunk, uint32_t lane)
{
  const uint32_t q = (chunk & 0xffffu) * 32 + lane;
  Item item;
  item.mass = (uint32_t)(((float)q + 0.5f) * part.per_row);
  item.row = q - item.mass * part.n_rows;
  item.place = part.first_place + q;
  item.used = item.mass < part.n_masses;
  return item;
}

/* Loads a velocity: a block's own global memory bypasses the first-level cache, which is left to
 * links and terrain. */
__device__ __forceinline__ float3 load_velocity(const float *v)
{
  return make_float3(__ldcg(v), __ldcg(v + 1), __ldcg(v + 2));
}

constexpr uint32_t kNone = UINT32_MAX;

/* The bases of the links of a mass in a row, and the distances between masses and lengths, in
 * bytes. */
struct Reach {
  const char *masses, *lengths;
  uint32_t mass_stride, length_stride;
};

/* Loads the target lengths of the springs of four links. SPECIAL: rows may have damage. */
template <bool SPECIAL>
__device__ __forceinline__ void load_lengths(const uint4 &quad, const Reach &reach,
                                             float (&length)[MO_PLAN_LINKS])
{
  const uint32_t link[MO_PLAN_LINKS] = {quad.x, quad.y, quad.z, quad.w};
#pragma unroll
  for (int i = 0; i < MO_PLAN_LINKS; i++) {
    const uint32_t slot = SPECIAL ? MO_PLAN_LINK_SLOT_OF(link[i]) : MO_PLAN_LINK_SLOT(link[i]);
    length[i] = *reinterpret_cast<const float *>(reach.lengths + slot * reach.length_stride);
  }
}

/* Adds up the forces of four links of a mass at p. cut: with SPECIAL, which springs have none
 * (MO_PLAN_LINK_PART_OF), or kNone. */
template <bool SPECIAL>
__device__ __forceinline__ void pull_four(const uint4 &quad, const Reach &reach,
                                          const float (&length)[MO_PLAN_LINKS], const float (&p)[3],
                                          uint32_t cut, float (&j)[3])
{
  const uint32_t link[MO_PLAN_LINKS] = {quad.x, quad.y, quad.z, quad.w};
  float d[MO_PLAN_LINKS][3];
#pragma unroll
  for (int i = 0; i < MO_PLAN_LINKS; i++) {
    const float *other = reinterpret_cast<const float *>(reach.masses + MO_PLAN_LINK_MASS(link[i]) *
                                                                            reach.mass_stride);
    for (int axis = 0; axis < 3; axis++)
      d[i][axis] = other[axis] - p[axis];
  }
#pragma unroll
  for (int i = 0; i < MO_PLAN_LINKS; i++) {
    const struct lane_length along = lane_length_of(lane_squared(d[i]));
    float q = lane_spring(1.0f, &along, length[i]);
    if (SPECIAL && MO_PLAN_LINK_PART_OF(link[i]) == cut)
      q = 0.0f;
    for (int axis = 0; axis < 3; axis++)
      j[axis] = fmaf(q, d[i][axis], j[axis]);
  }
}

/* Returns a thread's item of a warp's chunk c; past the last chunk, and past the part's last place,
 * an existing item that is not used. */
__device__ __forceinline__ Item item_at(const Shared &shared, uint32_t c, uint32_t lane,
                                        const Part **part)
{
  const bool there = c < shared.n_chunks;
  const uint32_t chunk = shared.chunks[there ? c : 0];
  *part = shared.parts + (chunk >> 16);
  Item item = item_of(**part, chunk, lane);
  if (!item.used)
    item = Item{0, 0, (*part)->first_place, false};
  item.used &= there;
  return item;
}

/* Rereads a pointer of the call: otherwise it would be computed once and kept in local memory,
 * which is slower. */
template <typename T> __device__ __forceinline__ T read_again(T const &pointer)
{
  return *const_cast<T const volatile *>(&pointer);
}

/* All links of a mass, four at a time; missing ones repeat its last ones. */
constexpr int kTurns = (MO_PLAN_DEGREES_MAX + MO_PLAN_LINKS - 1) / MO_PLAN_LINKS;

__device__ __forceinline__ void load_links(const uint32_t *links, const Part &part, uint32_t mass,
                                           uint4 (&quad)[kTurns])
{
  const uint4 *quads =
      reinterpret_cast<const uint4 *>(links) + part.first_quad + MO_PLAN_MASS_QUAD(mass);
  const uint32_t last = MO_PLAN_MASS_QUADS(mass) - 1;
#pragma unroll
  for (uint32_t i = 0; i < kTurns; i++)
    quad[i] = __ldg(quads + min(i, last));
}

/* With `split`, a step reads the velocities that the previous step wrote, and writes its own to a
 * different buffer, so that contact can compute what the springs added. In a step with new outputs,
 * the springs pull with the mean of the old and the new lengths. Since the pull is linear in the
 * length, one half is added with the old lengths, and the other half with the new ones. */
struct Pull {
  const float *before; /* velocities (places, 3) to start from */
  float share;
  bool coasts; /* drag and gravity act on them first */
};

/* Returns which springs of a row exert no force in a step, as pull_four. */
__device__ __forceinline__ uint32_t cut_of(const Shared &shared, uint32_t row, uint32_t step)
{
  const mo_plan_special &of = shared.environments[row]->special;
  return step >= of.cut_step ? of.cut : kNone;
}

/* The loads for a chunk are hidden behind the computation of previous chunks: the links of the next
 * chunk, and the mass of the one after it, are in flight. how: read with SPLIT. */
template <bool SPLIT, bool SPECIAL>
__device__ __forceinline__ void pull(const Shared &shared, const float *position,
                                     const float *all_lengths, float *velocity, const Pull &how,
                                     uint32_t step)
{
  const mo_cuda_score &score = shared.score;
  const uint32_t lane = threadIdx.x & 31, warp = threadIdx.x >> 5, n = shared.n_chunks;
  const Part *part, *next_part;
  Item item = item_at(shared, warp, lane, &part),
       next = item_at(shared, warp + MO_CUDA_WARPS, lane, &next_part);
  uint32_t mass = __ldg(score.masses + part->first_mass + item.mass);
  uint32_t next_mass = __ldg(score.masses + next_part->first_mass + next.mass);
  uint4 quad[kTurns], next_quad[kTurns];
  load_links(score.links, *part, mass, quad);
#pragma unroll 1
  for (uint32_t c = warp; c < n; c += MO_CUDA_WARPS) {
    const uint32_t last = MO_PLAN_MASS_QUADS(mass) - 1, n_rows = part->n_rows;
    const float *own = position + 3 * item.place;
    Reach reach = {reinterpret_cast<const char *>(position + 3 * (part->first_place + item.row)),
                   reinterpret_cast<const char *>(all_lengths + part->first_length + item.row),
                   12 * n_rows, 4 * n_rows};
    asm(""
        : "+r"(reach.mass_stride), "+r"(reach.length_stride)); /* one multiplication per address */
    float *v = velocity + 3 * item.place;
    const float3 before = load_velocity(SPLIT ? how.before + 3 * item.place : v);
    load_links(read_again(score.links), *next_part, next_mass, next_quad);
    const Part *after_part;
    const Item after = item_at(shared, c + 2 * MO_CUDA_WARPS, lane, &after_part);
    const uint32_t after_mass =
        __ldg(read_again(score.masses) + after_part->first_mass + after.mass);
    const float p[3] = {own[0], own[1], own[2]};
    const uint32_t cut = SPECIAL ? cut_of(shared, part->first_row + item.row, step) : kNone;
    float j[3] = {0.0f, 0.0f, 0.0f};
#pragma unroll
    for (int i = 0; i < kTurns; i++) {
      if (i > 0 && (uint32_t)i > last)
        break;
      float length[MO_PLAN_LINKS];
      load_lengths<SPECIAL>(quad[i], reach, length);
      pull_four<SPECIAL>(quad[i], reach, length, p, cut, j);
    }
    if (item.used) {
      const float4 kick = shared.kicks[part->first_row + item.row];
      lane_physics k = {};
      k.pull = kick.x;
      k.keep = kick.y;
      k.fall = kick.z;
      if (SPLIT)
        k.pull *= how.share;
      const bool coasts = !SPLIT || how.coasts;
      v[0] = fmaf(j[0], k.pull, coasts ? lane_coast(&k, 0, before.x) : before.x);
      v[1] = fmaf(j[1], k.pull, coasts ? lane_coast(&k, 1, before.y) : before.y);
      v[2] = fmaf(j[2], k.pull, coasts ? lane_coast(&k, 2, before.z) : before.z);
    }
#pragma unroll
    for (int i = 0; i < kTurns; i++)
      quad[i] = next_quad[i];
    item = next;
    part = next_part;
    mass = next_mass;
    next = after;
    next_part = after_part;
    next_mass = after_mass;
  }
}

/* Moves a mass that strikes, with `split`. before: the velocity at the end of the previous step. */
__device__ __forceinline__ void move_split(const lane_physics &k, const mo_plan_environment &in,
                                           const lane_terrain &terrain, const float4 &kick,
                                           const float3 &before, float (&p)[3], float (&v)[3])
{
  lane_split split = lane_split_alike(&in.split.constants);
  split.per_push = kick.w;
  lane_physics of = k;
  of.fall = kick.z; /* the first step has its own */
  const float push[3] = {v[0] - lane_coast(&of, 0, before.x), v[1] - lane_coast(&of, 1, before.y),
                         v[2] - lane_coast(&of, 2, before.z)};
  lane_move_split(&k, &split, terrain, push, p, v);
}

/* before: read with SPLIT. TASKS: as live_of (score_live.cuh). */
template <bool SPLIT, class TASKS>
__device__ __forceinline__ void move(const mo_cuda_score &score, Shared &shared, const TASKS &tasks,
                                     float *position, float *velocity, const float *before)
{
  const uint32_t lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
  const Part *part, *next_part;
  Item item = item_at(shared, warp, lane, &part);
  float *speed = velocity + 3 * item.place;
  float3 ahead = load_velocity(speed);
  for (uint32_t c = warp; c < shared.n_chunks; c += MO_CUDA_WARPS) {
    const Item next = item_at(shared, c + MO_CUDA_WARPS, lane, &next_part);
    float *next_speed = velocity + 3 * next.place;
    float v[3] = {ahead.x, ahead.y, ahead.z};
    ahead = load_velocity(next_speed);
    if (item.used) {
      const uint32_t row = part->first_row + item.row;
      float *at = position + 3 * item.place;
      float p[3] = {at[0], at[1], at[2]};
      const mo_plan_environment &in = *shared.environments[row];
      const lane_physics k = physics_of(score, in.scene);
      const lane_terrain terrain = {in.scene.heights,
                                    TASKS::kSpecial ? &in.special.cells : nullptr};
      const float highest = shared.light[row].w;
      bool struck;
      if (SPLIT) {
        float next[3];
        lane_cell ground;
        struck = lane_strikes(&k, terrain, highest, p, v, next, &ground);
        if (struck)
          move_split(k, in, terrain, shared.kicks[row], load_velocity(before + 3 * item.place), p,
                     v);
        else
          for (int axis = 0; axis < 3; axis++)
            p[axis] = next[axis];
      } else {
        struck = lane_move(&k, terrain, highest, p, v);
      }
      if (struck) {
        speed[0] = v[0];
        speed[1] = v[1];
        speed[2] = v[2];
        tasks.touches(shared, row, part->first_mass + item.mass);
      }
      at[0] = p[0];
      at[1] = p[1];
      at[2] = p[2];
      if (!lane_is_sane(p, v))
        atomicOr(&shared.insane[row], 1);
    }
    item = next;
    part = next_part;
    speed = next_speed;
  }
}

} // namespace

#endif
