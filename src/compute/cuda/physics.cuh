/* physics.cuh: one mass, one spring, one sensor in float32, as the device computes them.
 *
 * Valid C17 and CUDA C++ alike: the host compiles it too, and tests it against src/rollout. Every operation has a fixed order and
 * fused operations are asked for by name (the device code is compiled with -fmad=false), so that a mass's bits depend on what it
 * is given alone. Coordinates x, y count from the world's centre, where float32 is finest, as in rollout/kernel_physics.inc. */
#ifndef MORPHO_COMPUTE_CUDA_PHYSICS_CUH
#define MORPHO_COMPUTE_CUDA_PHYSICS_CUH

#include <morpho/controller.h>
#include <morpho/rollout.h>
#include <morpho/world.h>

#include <math.h>
#include <stdint.h>

#ifdef __CUDACC__
#define MO_CUDA_INLINE static __host__ __device__ __forceinline__
#else
#define MO_CUDA_INLINE static inline __attribute__((unused))
#endif

/* The device's own instructions where it is the device that computes: within 2 units of the last place, as is float32 arithmetic
 * around them. A root of 0 is taken of numbers kept above it. */
#ifdef __CUDA_ARCH__
#define MO_CUDA_RSQRT(x)     rsqrtf(x)
#define MO_CUDA_DIVIDE(x, y) __fdividef(x, y)
#else
#define MO_CUDA_RSQRT(x)     (1.0f / sqrtf(x))
#define MO_CUDA_DIVIDE(x, y) ((x) / (y))
#endif
#define MO_CUDA_SMALLEST 1e-30f

struct mo_cuda_constants {
  float dt, keep, fall;  /* step; exp(−drag · dt); gravity · dt */
  float pull, actuation; /* dt · stiffness / mass; share of the rest length */
  float friction, friction_cap;
  float fastest_squared;
  uint32_t bisections; /* 0: exact */
};

/* The terrain as polynomials: 7 × 7 cells and a rim of cells beyond the map, where the clamped coordinate has no effect. Cell
 * (i, j), −1 ≤ i, j ≤ 7, at (j + 1)·9 + (i + 1): h + u·a + w·b + u·w·c, u and w measured from the cell's corner, in cells. */
#define MO_CUDA_CELLS_SIDE  9
#define MO_CUDA_CELLS       (MO_CUDA_CELLS_SIDE * MO_CUDA_CELLS_SIDE)
#define MO_CUDA_CELLS_PER_M 1.4f /* 7 cells over 5 m */
#define MO_CUDA_ORIGIN      3.5f /* cell coordinate of the world's centre */

#ifdef __CUDACC__
struct __align__(16) mo_cuda_cell
{
#else
struct mo_cuda_cell {
#endif
  float h, a, b, c;
};

/* A patch of terrain with the number of its cell. */
struct mo_cuda_patch {
  int i, j;
  struct mo_cuda_cell cell;
};

/* Polynomials of all cells of a terrain. */
MO_CUDA_INLINE struct mo_cuda_cell mo_cuda_cell_of(const double heights_m[MO_TERRAIN_HEIGHTS], int i, int j)
{
  const int i0 = i < 0 ? 0 : i, i1 = i + 1 < MO_TERRAIN_SIDE ? i + 1 : i;
  const int j0 = j < 0 ? 0 : j, j1 = j + 1 < MO_TERRAIN_SIDE ? j + 1 : j;
  const double h00 = heights_m[j0 * MO_TERRAIN_SIDE + i0], h10 = heights_m[j0 * MO_TERRAIN_SIDE + i1];
  const double h01 = heights_m[j1 * MO_TERRAIN_SIDE + i0], h11 = heights_m[j1 * MO_TERRAIN_SIDE + i1];
  struct mo_cuda_cell cell;
  cell.h = (float)h00;
  cell.a = (float)(h10 - h00);
  cell.b = (float)(h01 - h00);
  cell.c = (float)(h11 - h10 - h01 + h00);
  return cell;
}

MO_CUDA_INLINE float mo_cuda_root(float x)
{
  return x * MO_CUDA_RSQRT(fmaxf(x, MO_CUDA_SMALLEST));
}

/* Light at a mass whose squared distance from the light is `squared`. */
MO_CUDA_INLINE float mo_cuda_light(enum mo_sensor sensor, float squared)
{
  if (sensor == MO_SENSOR_INVERSE_SQUARE)
    return MO_CUDA_DIVIDE(1.0f, squared + 1e-4f);
  const float inverse = MO_CUDA_RSQRT(mo_cuda_root(squared) + 1e-8f); /* at most 1e4 */
  return fmaf(-1e-8f * inverse, inverse, inverse);                    /* 1 / (1 / inverse + 1e-8) to first order */
}

/* Change of velocity per metre of (dx, dy, dz), the way from a mass to the other end of a spring that wants to be `wanted` long, over
 * constants' pull: (L − wanted)/(L + 1e-8), with 1/(L + 1e-8) to first order; 0 for ends within 1e-8 m. */
MO_CUDA_INLINE float mo_cuda_spring(float dx, float dy, float dz, float wanted)
{
  const float squared = fmaf(dx, dx, fmaf(dy, dy, dz * dz));
  const float inverse = MO_CUDA_RSQRT(fmaxf(squared, MO_CUDA_SMALLEST));
  const float length = squared * inverse;
  return (length - wanted) * (inverse * fmaxf(fmaf(-1e-8f, inverse, 1.0f), 0.0f));
}

/* ---- contact: rollout/contact.c has the algebra ---- */

/* The cell that a coordinate (in cells) lies in; −1 and 7 beyond the map. Not-a-number counts as 7. */
MO_CUDA_INLINE int mo_cuda_cell_number(float coordinate)
{
  return (int)floorf(fmaxf(fminf(coordinate, (float)(MO_TERRAIN_SIDE - 1)), -1.0f));
}

MO_CUDA_INLINE float mo_cuda_coordinate(float position_m)
{
  return fmaf(position_m, MO_CUDA_CELLS_PER_M, MO_CUDA_ORIGIN);
}

MO_CUDA_INLINE void mo_cuda_patch_load(const struct mo_cuda_cell *cells, int i, int j, struct mo_cuda_patch *patch)
{
  patch->i = i;
  patch->j = j;
  patch->cell = cells[(j + 1) * MO_CUDA_CELLS_SIDE + i + 1];
}

/* Makes `patch` the one under cell coordinates (x, y). */
MO_CUDA_INLINE void mo_cuda_patch_move(const struct mo_cuda_cell *cells, float x, float y, struct mo_cuda_patch *patch)
{
  const int i = mo_cuda_cell_number(x), j = mo_cuda_cell_number(y);
  if (i != patch->i || j != patch->j)
    mo_cuda_patch_load(cells, i, j, patch);
}

MO_CUDA_INLINE float mo_cuda_height(const struct mo_cuda_patch *patch, float x, float y)
{
  const float u = x - (float)patch->i, w = y - (float)patch->j;
  return fmaf(u, fmaf(w, patch->cell.c, patch->cell.a), fmaf(w, patch->cell.b, patch->cell.h));
}

/* The gradient, in metres per metre. */
MO_CUDA_INLINE void mo_cuda_slope(const struct mo_cuda_patch *patch, float x, float y, float gradient[2])
{
  const float u = x - (float)patch->i, w = y - (float)patch->j;
  gradient[0] = fmaf(w, patch->cell.c, patch->cell.a) * MO_CUDA_CELLS_PER_M;
  gradient[1] = fmaf(u, patch->cell.c, patch->cell.b) * MO_CUDA_CELLS_PER_M;
}

/* When the segment from `start` with `speed`, both in cells, leaves cell number `cell`; huge: never. */
MO_CUDA_INLINE float mo_cuda_leave_time(float start, float speed, int cell)
{
  if (speed > 0.0f && cell < MO_TERRAIN_SIDE - 1)
    return MO_CUDA_DIVIDE((float)(cell + 1) - start, speed);
  if (speed < 0.0f && cell >= 0)
    return MO_CUDA_DIVIDE((float)cell - start, speed);
  return 1e30f;
}

/* Time of impact of a mass that leaves p with v and is below the terrain after dt. The segment is cut where it crosses borders between
 * cells; nearly always it crosses none. */
MO_CUDA_INLINE float mo_cuda_impact_exact(const struct mo_cuda_constants *k, const struct mo_cuda_cell *cells,
                                          const float p[3], const float v[3], struct mo_cuda_patch *patch)
{
  const float x = mo_cuda_coordinate(p[0]), y = mo_cuda_coordinate(p[1]);
  const float dx = v[0] * MO_CUDA_CELLS_PER_M, dy = v[1] * MO_CUDA_CELLS_PER_M;
  int i = mo_cuda_cell_number(x), j = mo_cuda_cell_number(y);
  float from = 0.0f;
  for (int piece = 0; piece < 4 * MO_CUDA_CELLS_SIDE; piece++) {
    const float leave_x = mo_cuda_leave_time(x, dx, i), leave_y = mo_cuda_leave_time(y, dy, j);
    const float to = fminf(fminf(leave_x, leave_y), k->dt);
    if (to > from || piece == 0) {
      if (i != patch->i || j != patch->j)
        mo_cuda_patch_load(cells, i, j, patch);
      const float u = fmaf(dx, from, x) - (float)i, w = fmaf(dy, from, y) - (float)j;
      const float ground = fmaf(u, fmaf(w, patch->cell.c, patch->cell.a), fmaf(w, patch->cell.b, patch->cell.h));
      const float gap = fmaxf(fmaf(v[2], from, p[2]) - ground, 0.0f);
      const float twist = patch->cell.c;
      const float linear = v[2] - fmaf(patch->cell.a, dx, fmaf(patch->cell.b, dy, twist * fmaf(u, dy, w * dx)));
      const float square = -(twist * dx * dy);
      const float discriminant = fmaf(linear, linear, -4.0f * square * gap);
      const float root = mo_cuda_root(fmaxf(discriminant, 0.0f));
      float descent = 1e30f;
      if (linear < 0.0f) {
        if (discriminant >= 0.0f)
          descent = MO_CUDA_DIVIDE(gap + gap, root - linear);
      } else if (square < 0.0f) {
        descent = MO_CUDA_DIVIDE(-linear - root, 2.0f * square);
      }
      if (from + descent <= to)
        return from + descent;
      from = to;
    }
    if (!(to < k->dt))
      return k->dt; /* below the terrain by rounding alone */
    if (leave_x <= leave_y)
      i += dx > 0.0f ? 1 : -1;
    else
      j += dy > 0.0f ? 1 : -1;
  }
  return k->dt;
}

MO_CUDA_INLINE float mo_cuda_impact_bisection(const struct mo_cuda_constants *k, const struct mo_cuda_cell *cells,
                                              const float p[3], const float v[3], struct mo_cuda_patch *patch)
{
  float low = 0.0f, high = k->dt;
  for (uint32_t n = 0; n < k->bisections; n++) {
    const float middle = 0.5f * (low + high);
    const float x = mo_cuda_coordinate(fmaf(middle, v[0], p[0])), y = mo_cuda_coordinate(fmaf(middle, v[1], p[1]));
    mo_cuda_patch_move(cells, x, y, patch);
    if (fmaf(middle, v[2], p[2]) < mo_cuda_height(patch, x, y))
      high = middle;
    else
      low = middle;
  }
  return low;
}

/* Drops the part of v along the normal n ∝ (−g, 1) and slows the rest by friction. */
MO_CUDA_INLINE void mo_cuda_strike(const struct mo_cuda_constants *k, const float g[2], float v[3])
{
  const float norm = MO_CUDA_DIVIDE(1.0f, fmaf(g[0], g[0], fmaf(g[1], g[1], 1.0f))); /* 1 / |n|² */
  const float along = fmaf(-g[0], v[0], fmaf(-g[1], v[1], v[2])), part = along * norm;
  const float slid[3] = {fmaf(part, g[0], v[0]), fmaf(part, g[1], v[1]), v[2] - part};
  const float vt = mo_cuda_root(fmaf(slid[0], slid[0], fmaf(slid[1], slid[1], slid[2] * slid[2])));
  const float lost = fminf(fabsf(along) * mo_cuda_root(norm) * k->friction, vt * k->friction_cap);
  const float scale = 1.0f - MO_CUDA_DIVIDE(lost, fmaxf(vt, 1e-30f));
  v[0] = slid[0] * scale;
  v[1] = slid[1] * scale;
  v[2] = slid[2] * scale;
}

/* Contact of the mass at p, whose step with v would end at `next`, below the terrain of `patch`: `next` and v become what contact makes
 * of them. */
MO_CUDA_INLINE void mo_cuda_contact(const struct mo_cuda_constants *k, const struct mo_cuda_cell *cells,
                                    struct mo_cuda_patch *patch, const float p[3], float next[3], float v[3])
{
  const float impact = k->bisections == 0 ? mo_cuda_impact_exact(k, cells, p, v, patch)
                                          : mo_cuda_impact_bisection(k, cells, p, v, patch);
  float gradient[2];
  next[0] = fmaf(impact, v[0], p[0]);
  next[1] = fmaf(impact, v[1], p[1]);
  float x = mo_cuda_coordinate(next[0]), y = mo_cuda_coordinate(next[1]);
  mo_cuda_patch_move(cells, x, y, patch);
  next[2] = mo_cuda_height(patch, x, y);
  mo_cuda_slope(patch, x, y, gradient);
  mo_cuda_strike(k, gradient, v);
  const float rest = k->dt - impact;
  next[0] = fmaf(rest, v[0], next[0]);
  next[1] = fmaf(rest, v[1], next[1]);
  next[2] = fmaf(rest, v[2], next[2]);
  x = mo_cuda_coordinate(next[0]);
  y = mo_cuda_coordinate(next[1]);
  mo_cuda_patch_move(cells, x, y, patch);
  next[2] = fmaxf(next[2], mo_cuda_height(patch, x, y));
}

/* Moves a mass by one step with the velocity that springs, drag and gravity gave it. `highest`: no terrain is above it. Returns whether
 * the terrain was met. */
MO_CUDA_INLINE int mo_cuda_move(const struct mo_cuda_constants *k, const struct mo_cuda_cell *cells, float highest,
                                float p[3], float v[3])
{
  float next[3] = {fmaf(k->dt, v[0], p[0]), fmaf(k->dt, v[1], p[1]), fmaf(k->dt, v[2], p[2])};
  int met = 0;
  if (next[2] < highest) {
    struct mo_cuda_patch patch;
    const float x = mo_cuda_coordinate(next[0]), y = mo_cuda_coordinate(next[1]);
    mo_cuda_patch_load(cells, mo_cuda_cell_number(x), mo_cuda_cell_number(y), &patch);
    if (next[2] < mo_cuda_height(&patch, x, y)) {
      mo_cuda_contact(k, cells, &patch, p, next, v);
      met = 1;
    }
  }
  p[0] = next[0];
  p[1] = next[1];
  p[2] = next[2];
  return met;
}

/* Finite, and no faster than MO_DIVERGED_SPEED_M_PER_S. */
MO_CUDA_INLINE int mo_cuda_is_sane(const struct mo_cuda_constants *k, const float p[3], const float v[3])
{
  const float places = (p[0] + p[1] + p[2]) * 0.0f; /* not a number unless all are finite */
  return fmaf(v[0], v[0], fmaf(v[1], v[1], fmaf(v[2], v[2], places))) <= k->fastest_squared;
}

#endif
