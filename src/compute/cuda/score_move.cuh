/* score_move.cuh: from lengths to positions: springs, then motion and contact. */
#ifndef MORPHO_COMPUTE_CUDA_SCORE_MOVE_CUH
#define MORPHO_COMPUTE_CUDA_SCORE_MOVE_CUH

#include "compute/cuda/score_group.cuh"

namespace {

/* A thread's mass and row within a chunk. */
struct Item {
  uint32_t mass, row; /* row: of the part */
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

/* What a block has in global memory is read past the first-level cache, which holds links and terrain. */
__device__ __forceinline__ float3 load_velocity(const float *v)
{
  return make_float3(__ldcg(v), __ldcg(v + 1), __ldcg(v + 2));
}

/* Lengths that the springs of four links want to have. */
__device__ __forceinline__ void load_lengths(const uint4 &quad, const float *lengths, uint32_t stride,
                                             float (&length)[MO_PLAN_LINKS])
{
  const uint32_t link[MO_PLAN_LINKS] = {quad.x, quad.y, quad.z, quad.w};
#pragma unroll
  for (int i = 0; i < MO_PLAN_LINKS; i++)
    length[i] = lengths[MO_PLAN_LINK_SLOT(link[i]) * stride];
}

/* Four links of a mass at p: adds up what their springs pull. */
__device__ __forceinline__ void pull_four(const uint4 &quad, const float *first, uint32_t stride,
                                          const float (&length)[MO_PLAN_LINKS], const float (&p)[3], float (&j)[3])
{
  const uint32_t link[MO_PLAN_LINKS] = {quad.x, quad.y, quad.z, quad.w};
#pragma unroll
  for (int i = 0; i < MO_PLAN_LINKS; i++) {
    const float *other = first + MO_PLAN_LINK_MASS(link[i]) * stride;
    const float d[3] = {other[0] - p[0], other[1] - p[1], other[2] - p[2]};
    const float q = mo_cuda_spring(d[0], d[1], d[2], length[i]);
    j[0] = fmaf(q, d[0], j[0]);
    j[1] = fmaf(q, d[1], j[1]);
    j[2] = fmaf(q, d[2], j[2]);
  }
}

/* A thread's item of a warp's chunk c; past the last chunk, and past the part's last place, one that exists and is not used. */
__device__ __forceinline__ Item item_at(const Shared &shared, uint32_t c, uint32_t lane, const Part **part)
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

/* What is loaded for one chunk hides behind the computing of another: of the next chunk, the mass, then its first links; of the next four
 * links, their lengths. */
__device__ __forceinline__ void pull(const mo_cuda_score &score, const Shared &shared, const float *position,
                                     const float *all_lengths, float *velocity)
{
  const uint32_t lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
  const mo_cuda_constants &k = score.constants;
  const uint4 *links = reinterpret_cast<const uint4 *>(score.links);
  const Part *part, *next_part;
  Item item = item_at(shared, warp, lane, &part);
  uint32_t mass = __ldg(score.masses + part->first_mass + item.mass);
  uint4 quad = __ldg(links + part->first_quad + MO_PLAN_MASS_QUAD(mass));
  for (uint32_t c = warp; c < shared.n_chunks; c += MO_CUDA_WARPS) {
    const uint4 *quads = links + part->first_quad + MO_PLAN_MASS_QUAD(mass);
    const float *lengths = all_lengths + part->first_length + item.row;
    const float *own = position + 3 * item.place, *first = position + 3 * (part->first_place + item.row);
    float *v = velocity + 3 * item.place;
    uint32_t left = MO_PLAN_MASS_QUADS(mass);
    const uint32_t n_rows = part->n_rows, stride = 3 * n_rows;
    float length[MO_PLAN_LINKS], ahead[MO_PLAN_LINKS];
    load_lengths(quad, lengths, n_rows, length);
    quads += left > 1;
    uint4 following = __ldg(quads);
    const Item next = item_at(shared, c + MO_CUDA_WARPS, lane, &next_part);
    mass = __ldg(score.masses + next_part->first_mass + next.mass);
    const float3 before = load_velocity(v);
    const float p[3] = {own[0], own[1], own[2]};
    float j[3] = {0.0f, 0.0f, 0.0f};
    while (left > 1) {
      load_lengths(following, lengths, n_rows, ahead);
      quads += left > 2;
      const uint4 after = __ldg(quads);
      pull_four(quad, first, stride, length, p, j);
      quad = following;
      following = after;
#pragma unroll
      for (int i = 0; i < MO_PLAN_LINKS; i++)
        length[i] = ahead[i];
      left--;
    }
    const uint4 next_quad = __ldg(links + next_part->first_quad + MO_PLAN_MASS_QUAD(mass));
    pull_four(quad, first, stride, length, p, j);
    if (item.used) {
      v[0] = fmaf(j[0], k.pull, before.x * k.keep);
      v[1] = fmaf(j[1], k.pull, before.y * k.keep);
      v[2] = fmaf(j[2], k.pull, fmaf(before.z, k.keep, -k.fall));
    }
    quad = next_quad;
    item = next;
    part = next_part;
  }
}

__device__ __forceinline__ void move(const mo_cuda_score &score, Shared &shared, float *position, float *velocity)
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
      if (mo_cuda_move(&score.constants, shared.cells[row], shared.light[row].w, p, v)) {
        speed[0] = v[0];
        speed[1] = v[1];
        speed[2] = v[2];
      }
      at[0] = p[0];
      at[1] = p[1];
      at[2] = p[2];
      if (!mo_cuda_is_sane(&score.constants, p, v))
        atomicOr(&shared.insane[row], 1);
    }
    item = next;
    part = next_part;
    speed = next_speed;
  }
}

} // namespace

#endif
