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

/* Four links of a mass at p: adds up what their springs pull. */
__device__ __forceinline__ void pull_four(const uint4 &quad, const float *first, uint32_t stride, const char *wanted,
                                          const float (&p)[3], float (&j)[3])
{
  const uint32_t link[MO_PLAN_LINKS] = {quad.x, quad.y, quad.z, quad.w};
  float length[MO_PLAN_LINKS];
#pragma unroll
  for (int i = 0; i < MO_PLAN_LINKS; i++)
    length[i] = *reinterpret_cast<const float *>(wanted + (uint64_t)MO_PLAN_LINK_SLOT(link[i]) * (kRows * 4));
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

__device__ __forceinline__ void pull(const mo_cuda_score &score, const Shared &shared, const float *position,
                                     const float *wanted, float *velocity)
{
  const uint32_t lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
  const mo_cuda_constants &k = score.constants;
  for (uint32_t c = warp; c < shared.n_chunks; c += MO_CUDA_WARPS) {
    const uint32_t chunk = shared.chunks[c];
    const Part &part = shared.parts[chunk >> 16];
    const Item item = item_of(part, chunk, lane);
    if (!item.used)
      continue;
    const uint32_t mass = __ldg(score.masses + part.first_mass + item.mass);
    float *v = velocity + 3 * item.place;
    const float before[3] = {v[0], v[1], v[2]};
    const uint4 *quads = reinterpret_cast<const uint4 *>(score.links) + part.first_quad + MO_PLAN_MASS_QUAD(mass);
    const float *own = position + 3 * item.place, *first = position + 3 * (part.first_place + item.row);
    const char *lengths = reinterpret_cast<const char *>(wanted + part.first_row + item.row);
    const float p[3] = {own[0], own[1], own[2]};
    const uint32_t stride = 3 * part.n_rows;
    float j[3] = {0.0f, 0.0f, 0.0f};
    uint4 quad = __ldg(quads);
    for (uint32_t left = MO_PLAN_MASS_QUADS(mass); left > 0; left--) {
      quads += left > 1;
      const uint4 next = __ldg(quads);
      pull_four(quad, first, stride, lengths, p, j);
      quad = next;
    }
    v[0] = fmaf(j[0], k.pull, before[0] * k.keep);
    v[1] = fmaf(j[1], k.pull, before[1] * k.keep);
    v[2] = fmaf(j[2], k.pull, fmaf(before[2], k.keep, -k.fall));
  }
}

__device__ __forceinline__ void move(const mo_cuda_score &score, Shared &shared, float *position, float *velocity)
{
  const uint32_t lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
  for (uint32_t c = warp; c < shared.n_chunks; c += MO_CUDA_WARPS) {
    const uint32_t chunk = shared.chunks[c];
    const Part &part = shared.parts[chunk >> 16];
    const Item item = item_of(part, chunk, lane);
    if (!item.used)
      continue;
    const uint32_t row = part.first_row + item.row;
    float *at = position + 3 * item.place, *speed = velocity + 3 * item.place;
    float v[3] = {speed[0], speed[1], speed[2]};
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
}

} // namespace

#endif
