/* lane.cuh: rollout/lane_physics.inc, lane_split.inc and their adjoints for one lane of a device: a
 * vector of one float.
 *
 * This file adds the parts that they leave to the kernels: choosing the terrain cell of a lane,
 * cutting segments at the borders of their cell, and complete moves of a mass, forward and
 * backward. Scoring and the gradient include the same lines, and so does a test without a device:
 * this file is also valid C17.
 *
 * Operations are fused only where v_fma is written: this file must be compiled without contraction
 * (nvcc -fmad=false), so that the backward pass sees every strike of the forward pass. */
#ifndef MORPHO_COMPUTE_CUDA_LANE_CUH
#define MORPHO_COMPUTE_CUDA_LANE_CUH

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __CUDACC__
#define MO_INLINE static __host__ __device__ __forceinline__
extern "C" {
#include "rollout/fast.h"
}
#else
#define MO_INLINE static inline __attribute__((unused))
#include "rollout/fast.h"
#endif

typedef float REAL, V;
typedef bool M;

#define v_set(x)         ((float)(x))
#define v_fma(a, b, c)   fmaf(a, b, c)
#define v_fnma(a, b, c)  fmaf(-(a), b, c)
#define v_min(a, b)      fminf(a, b)
#define v_max(a, b)      fmaxf(a, b)
#define v_abs(a)         fabsf(a)
#define v_copysign(a, b) copysignf(a, b)
#define v_floor(a)       floorf(a)
#define v_lt(a, b)       ((a) < (b))
#define v_le(a, b)       ((a) <= (b))
#define v_eq(a, b)       ((a) == (b))
#define v_sel(m, a, b)   ((m) ? (a) : (b))
#define v_keep(m, a)     ((m) ? (a) : 0.0f)
#define v_not(m)         (!(m))

/* Divisions and roots are the device's own instructions, accurate to two units in the last place,
 * like the float32 arithmetic around them; their subnormal operands count as 0. */
MO_INLINE V v_div(V a, V b)
{
#ifdef __CUDA_ARCH__
  V quotient;
  asm("div.approx.ftz.f32 %0, %1, %2;" : "=f"(quotient) : "f"(a), "f"(b));
  return quotient;
#else
  return a / b;
#endif
}

MO_INLINE V v_sqrt(V a)
{
#ifdef __CUDA_ARCH__
  V root;
  asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(root) : "f"(a));
  return root;
#else
  return sqrtf(a);
#endif
}

#ifdef __CUDACC__
#pragma nv_diag_suppress 1675 /* their loops are unrolled without a request */
#endif
#define LANE_HEIGHT float
#include "rollout/lane_split_adjoint.inc"

/* ---- springs ---- */

/* Returns the rest length of a spring, without actuation: the device's tables know only which of
 * the lattice's two lengths it is. */
MO_INLINE V lane_rest(bool diagonal)
{
  return diagonal ? v_set(MO_DIAGONAL_M) : v_set(MO_VOXEL_M);
}

/* The work that new outputs do on a spring, k / 2 · max(after² − before², 0): how much longer it is
 * than it wants to be with the old outputs and with the new ones; as rollout/gradient_work.inc. */
struct lane_work {
  V before, after, gain; /* gain: after² − before² */
};

MO_INLINE struct lane_work lane_work_of(const struct lane_length *length, V rest, V actuation,
                                        V activation, V activation_before)
{
  struct lane_work w;
  w.before = length->length - lane_wanted(rest, actuation, activation_before);
  w.after = length->length - lane_wanted(rest, actuation, activation);
  w.gain = (w.after - w.before) * (w.after + w.before);
  return w;
}

/* ∂loss/∂ what the work depends on; `along` times the vector between the ends is that of the
 * vector. */
struct lane_work_adjoint {
  V activation, activation_before, along;
};

/* per_gain: ∂loss/∂ the work · k; 0: the spring does not count. */
MO_INLINE struct lane_work_adjoint lane_work_back(V per_gain, const struct lane_length *length,
                                                  V rest, V actuation, const struct lane_work *w)
{
  const bool gains = per_gain != 0 && w->gain > 0;
  const V reach = per_gain * rest * actuation;
  struct lane_work_adjoint adjoint = {0, 0, 0};
  if (gains) {
    adjoint.activation = -reach * w->after;
    adjoint.activation_before = reach * w->before;
    adjoint.along = per_gain * (w->after - w->before) * length->inverse;
  }
  return adjoint;
}

/* ---- terrain ---- */

/* A row's terrain. In kernels that compute only grids, the compiler knows that `cells` is NULL, and
 * what the cells of a grid are. */
struct lane_terrain {
  const float *heights;           /* (64), as in mo_environment */
  const struct lane_cells *cells; /* NULL: a grid */
};

MO_INLINE struct lane_terrain lane_grid(const float *heights)
{
  const struct lane_terrain terrain = {heights, NULL};
  return terrain;
}

MO_INLINE struct lane_cells lane_cells_in(struct lane_terrain terrain)
{
  return terrain.cells != NULL ? *terrain.cells : lane_cells_of_grid();
}

MO_INLINE struct lane_map lane_map_of(struct lane_terrain terrain)
{
  const struct lane_cells cells = lane_cells_in(terrain);
  return lane_map_alike(&cells);
}

/* i, j: whole numbers. */
MO_INLINE struct lane_cell lane_cell_at(struct lane_terrain terrain, V i, V j)
{
  const struct lane_cells cells = lane_cells_in(terrain);
  struct lane_cell g;
  float corners[4], polynomial[4];
  lane_corners(&cells, terrain.heights, (int)i, (int)j, corners);
  lane_polynomial(corners, polynomial);
  g.i = i;
  g.j = j;
  g.h = polynomial[0];
  g.a = polynomial[1];
  g.b = polynomial[2];
  g.c = polynomial[3];
  return g;
}

/* Finds the cell under a position in meters from the world's center, and returns the height
 * there. */
MO_INLINE V lane_ground(struct lane_terrain terrain, V x, V y, struct lane_cell *g)
{
  const struct lane_map map = lane_map_of(terrain);
  const V u = lane_coordinate(&map, 0, x), w = lane_coordinate(&map, 1, y);
  *g = lane_cell_at(terrain, lane_cell_number(&map, 0, u), lane_cell_number(&map, 1, w));
  return lane_height(g, u - g->i, w - g->j);
}

/* Computes the gradient of g's polynomial at that position. */
MO_INLINE void lane_slope(struct lane_terrain terrain, const struct lane_cell *g, V x, V y,
                          V slope[2])
{
  const struct lane_map map = lane_map_of(terrain);
  slope[0] = lane_slope_x(&map, g, lane_coordinate(&map, 1, y) - g->j);
  slope[1] = lane_slope_y(&map, g, lane_coordinate(&map, 0, x) - g->i);
}

/* ---- time of impact ---- */

/* Returns when a segment from `start` with `speed`, in cells, leaves cell `cell` of an axis with
 * the last cell `last`. */
MO_INLINE V lane_leave_time(V start, V speed, V cell, V last)
{
  if (speed > 0 && cell < last)
    return v_div(cell + 1 - start, speed);
  if (speed < 0 && cell >= 0)
    return v_div(cell - start, speed);
  return INFINITY;
}

/* When a segment strikes the ground, and in which cell. */
struct lane_impact {
  V time, i, j;
};

/* Finds the impact from p with velocity v in closed form, for a segment that leaves its cell. */
MO_INLINE struct lane_impact lane_impact_across(struct lane_terrain terrain, V dt, const V p[3],
                                                const V v[3])
{
  const struct lane_map map = lane_map_of(terrain);
  const V x = lane_coordinate(&map, 0, p[0]), y = lane_coordinate(&map, 1, p[1]);
  const V dx = v[0] * map.scale[0], dy = v[1] * map.scale[1];
  struct lane_impact impact = {dt, lane_cell_number(&map, 0, x), lane_cell_number(&map, 1, y)};
  const struct lane_cells cells = lane_cells_in(terrain);
  const int most = 2 * (int)(cells.columns + cells.rows);
  V from = 0;
  for (int piece = 0; piece < most; piece++) {
    const V leave_x = lane_leave_time(x, dx, impact.i, map.last[0]),
            leave_y = lane_leave_time(y, dy, impact.j, map.last[1]);
    const V to = v_min(v_min(leave_x, leave_y), dt);
    if (to > from) {
      const struct lane_cell g = lane_cell_at(terrain, impact.i, impact.j);
      const struct lane_descent d = lane_descend(
          &map, &g, v_fma(from, dx, x) - g.i, v_fma(from, dy, y) - g.j, v_fma(from, v[2], p[2]), v);
      if (d.comes && from + d.time <= to) {
        impact.time = from + d.time;
        return impact;
      }
      from = to;
    }
    if (!(to < dt))
      break; /* below the ground by rounding only */
    if (leave_x <= leave_y)
      impact.i += dx > 0 ? 1.0f : -1.0f;
    else
      impact.j += dy > 0 ? 1.0f : -1.0f;
  }
  return impact;
}

/* Finds it by n halvings of the step, for any segment. */
MO_INLINE struct lane_impact lane_impact_halving(struct lane_terrain terrain, V dt, uint32_t n,
                                                 const V p[3], const V v[3])
{
  const struct lane_map map = lane_map_of(terrain);
  struct lane_cell g;
  V low = 0, high = dt;
  for (uint32_t k = 0; k < n; k++) {
    const V middle = 0.5f * (low + high);
    if (v_fma(middle, v[2], p[2]) <
        lane_ground(terrain, v_fma(middle, v[0], p[0]), v_fma(middle, v[1], p[1]), &g))
      high = middle;
    else
      low = middle;
  }
  const struct lane_impact impact = {
      low, lane_cell_number(&map, 0, lane_coordinate(&map, 0, v_fma(low, v[0], p[0]))),
      lane_cell_number(&map, 1, lane_coordinate(&map, 1, v_fma(low, v[1], p[1])))};
  return impact;
}

/* ---- moves ---- */

/* Where a lane's mass strikes. */
struct lane_place {
  V time;
  struct lane_cell cell;
  bool crosses; /* the segment leaves its cell */
};

/* Finds the strike of a mass from p with velocity v. next: the ground under the end of the straight
 * segment. */
MO_INLINE struct lane_place lane_place_of(const struct lane_physics *k, struct lane_terrain terrain,
                                          const struct lane_cell *next, const V p[3], const V v[3])
{
  const struct lane_map map = lane_map_of(terrain);
  struct lane_place at;
  const V x = lane_coordinate(&map, 0, p[0]), y = lane_coordinate(&map, 1, p[1]);
  V time;
  at.cell = *next;
  at.crosses = !lane_within(&map, next, x, y);
  if (k->bisections > 0 || at.crosses) {
    const struct lane_impact impact = k->bisections > 0
                                          ? lane_impact_halving(terrain, k->dt, k->bisections, p, v)
                                          : lane_impact_across(terrain, k->dt, p, v);
    time = impact.time;
    at.cell = lane_cell_at(terrain, impact.i, impact.j);
  } else {
    const struct lane_descent d = lane_descend(&map, next, x - next->i, y - next->j, p[2], v);
    time = v_sel(d.comes, d.time, k->dt);
  }
  at.time = lane_in_step(k, time);
  return at;
}

/* The strike of a lane's mass with the paper's integrator. */
struct lane_hit {
  struct lane_place at;
  struct lane_strike strike;
  bool stays; /* the strike ends in the cell where it struck */
};

/* Computes the strike from p with velocity v; next: the ground under the end of the straight
 * segment. */
MO_INLINE struct lane_hit lane_hit_of(const struct lane_physics *k, struct lane_terrain terrain,
                                      const struct lane_cell *next, const V p[3], const V v[3])
{
  const struct lane_map map = lane_map_of(terrain);
  struct lane_hit hit;
  hit.at = lane_place_of(k, terrain, next, p, v);
  hit.strike = lane_strike_at(k, &map, &hit.at.cell, hit.at.time, p, v);
  hit.stays = lane_within(&map, &hit.at.cell, lane_coordinate(&map, 0, hit.strike.end[0]),
                          lane_coordinate(&map, 1, hit.strike.end[1]));
  return hit;
}

/* The same with `split`. A mass that rests on the ground strikes where it is. */
struct lane_glide {
  struct lane_place at;
  struct lane_slide slide;
  bool stays;
};

/* Computes the slide of a mass from p with velocity v, to which the springs have added push. a: set
 * to the acceleration. */
MO_INLINE struct lane_glide lane_glide_of(const struct lane_physics *k, const struct lane_split *c,
                                          struct lane_terrain terrain, const V push[3],
                                          const V p[3], const V v[3], V a[3])
{
  const struct lane_map map = lane_map_of(terrain);
  struct lane_glide glide;
  struct lane_cell next;
  const V x = lane_coordinate(&map, 0, p[0]), y = lane_coordinate(&map, 1, p[1]);
  for (int axis = 0; axis < 3; axis++)
    a[axis] = lane_acceleration(c, axis, push[axis]);
  lane_ground(terrain, lane_drift(k, p[0], v[0]), lane_drift(k, p[1], v[1]), &next);
  struct lane_cell own = next;
  const bool crosses = !lane_within(&map, &next, x, y);
  if (crosses)
    own = lane_cell_at(terrain, lane_cell_number(&map, 0, x), lane_cell_number(&map, 1, y));
  const bool lies = lane_lies(&own, x - own.i, y - own.j, p[2]);
  if (lies) {
    glide.at.time = 0;
    glide.at.cell = own;
    glide.at.crosses = crosses;
  } else {
    glide.at = lane_place_of(k, terrain, &next, p, v);
  }
  glide.slide = lane_slide_at(k, c, &map, &glide.at.cell, lies, glide.at.time, p, v, a);
  glide.stays = lane_within(&map, &glide.at.cell, lane_coordinate(&map, 0, glide.slide.end[0]),
                            lane_coordinate(&map, 1, glide.slide.end[1]));
  return glide;
}

/* Sets p to the place where a strike ends. rise: height above the cell's polynomial; used only if
 * the strike ends in the cell where it struck. */
MO_INLINE void lane_land(struct lane_terrain terrain, const struct lane_cell *cell, bool stays,
                         V rise, const V end[3], V p[3])
{
  const struct lane_map map = lane_map_of(terrain);
  struct lane_cell g = *cell;
  if (!stays)
    rise = end[2] - lane_ground(terrain, end[0], end[1], &g);
  p[0] = end[0];
  p[1] = end[1];
  p[2] = lane_landing(&g, lane_coordinate(&map, 0, p[0]) - g.i,
                      lane_coordinate(&map, 1, p[1]) - g.j, rise);
}

/* Returns whether the strike ended above the ground. slope: set to the ground's slope there. */
MO_INLINE bool lane_lands_above(struct lane_terrain terrain, const struct lane_cell *cell,
                                bool stays, V rise, const V end[3], V slope[2])
{
  struct lane_cell g = *cell;
  bool above = rise >= 0;
  if (!stays)
    above = lane_ground(terrain, end[0], end[1], &g) <= end[2];
  lane_slope(terrain, &g, end[0], end[1], slope);
  return above;
}

/* Computes the derivative for a mass that lies on the ground at p: sets dp and dv. gx, gy: gradient
 * of the ground where it struck. */
MO_INLINE void lane_lift(struct lane_terrain terrain, const struct lane_place *at, V gx, V gy,
                         const V p[3], const V v[3], struct lane_strike_back *b, V dp[3], V dv[3])
{
  const struct lane_map map = lane_map_of(terrain);
  struct lane_cell g;
  const bool lies = p[2] <= lane_ground(terrain, p[0], p[1], &g);
  lane_lies_back(&map, &at->cell, v, lies, b);
  if (lies && at->crosses) { /* the gradients at the impact and at p belong to two cells */
    V slope[2];
    lane_slope(terrain, &g, p[0], p[1], slope);
    b->dp[0] = b->hit[0] + b->push * (gx - slope[0]);
    b->dp[1] = b->hit[1] + b->push * (gy - slope[1]);
  }
  for (int axis = 0; axis < 3; axis++) {
    dp[axis] = b->dp[axis];
    dv[axis] = b->dv[axis];
  }
}

/* Returns whether a mass at p with velocity v strikes the ground, which is nowhere above `highest`.
 * next: the end of its straight segment; g: the ground there. */
MO_INLINE bool lane_strikes(const struct lane_physics *k, struct lane_terrain terrain, V highest,
                            const V p[3], const V v[3], V next[3], struct lane_cell *g)
{
  for (int axis = 0; axis < 3; axis++)
    next[axis] = lane_drift(k, p[axis], v[axis]);
  return next[2] < highest && next[2] < lane_ground(terrain, next[0], next[1], g);
}

/* Moves a mass from p with velocity v for one step, and updates p and v. Returns true if it struck
 * the ground. */
MO_INLINE bool lane_move(const struct lane_physics *k, struct lane_terrain terrain, V highest,
                         V p[3], V v[3])
{
  const struct lane_map map = lane_map_of(terrain);
  V next[3];
  struct lane_cell g;
  if (!lane_strikes(k, terrain, highest, p, v, next, &g)) {
    for (int axis = 0; axis < 3; axis++)
      p[axis] = next[axis];
    return false;
  }
  const struct lane_hit hit = lane_hit_of(k, terrain, &g, p, v);
  const struct lane_strike *s = &hit.strike;
  lane_land(terrain, &hit.at.cell, hit.stays, lane_rise(&map, &hit.at.cell, s), s->end, p);
  for (int axis = 0; axis < 3; axis++)
    v[axis] = s->slid[axis];
  return true;
}

/* Moves a mass that strikes, with `split`. push: what the springs have added to the velocity. */
MO_INLINE void lane_move_split(const struct lane_physics *k, const struct lane_split *c,
                               struct lane_terrain terrain, const V push[3], V p[3], V v[3])
{
  const struct lane_map map = lane_map_of(terrain);
  V a[3];
  const struct lane_glide glide = lane_glide_of(k, c, terrain, push, p, v, a);
  const struct lane_slide *s = &glide.slide;
  lane_land(terrain, &glide.at.cell, glide.stays, lane_slide_rise(&map, &glide.at.cell, s), s->end,
            p);
  for (int axis = 0; axis < 3; axis++)
    v[axis] = s->velocity[axis];
}

/* Computes the derivative of lane_move at its inputs p and v. dp, dv: ∂loss/∂(its outputs),
 * replaced by ∂loss/∂(its inputs). */
MO_INLINE void lane_move_back(const struct lane_physics *k, struct lane_terrain terrain, V highest,
                              const V p[3], const V v[3], V dp[3], V dv[3])
{
  const struct lane_map map = lane_map_of(terrain);
  V next[3], slope[2];
  struct lane_cell g;
  if (!lane_strikes(k, terrain, highest, p, v, next, &g)) {
    for (int axis = 0; axis < 3; axis++)
      dv[axis] = lane_drift_back(k, dp[axis], dv[axis]);
    return;
  }
  const struct lane_hit hit = lane_hit_of(k, terrain, &g, p, v);
  const struct lane_strike *s = &hit.strike;
  const struct lane_cell *cell = &hit.at.cell;
  const bool above =
      lane_lands_above(terrain, cell, hit.stays, lane_rise(&map, cell, s), s->end, slope);
  struct lane_strike_back b =
      lane_strike_back_of(k, &map, cell, s, v, above, slope[0], slope[1], dp, dv);
  lane_lift(terrain, &hit.at, s->gx, s->gy, p, v, &b, dp, dv);
}

/* Computes the derivative of lane_move_split. da: set to ∂loss/∂ the mass's acceleration. */
MO_INLINE void lane_move_split_back(const struct lane_physics *k, const struct lane_split *c,
                                    struct lane_terrain terrain, const V push[3], const V p[3],
                                    const V v[3], V dp[3], V dv[3], V da[3])
{
  const struct lane_map map = lane_map_of(terrain);
  V slope[2], a[3];
  const struct lane_glide glide = lane_glide_of(k, c, terrain, push, p, v, a);
  const struct lane_slide *s = &glide.slide;
  const struct lane_cell *cell = &glide.at.cell;
  const bool above =
      lane_lands_above(terrain, cell, glide.stays, lane_slide_rise(&map, cell, s), s->end, slope);
  struct lane_slide_back b =
      lane_slide_back_of(k, c, &map, cell, s, v, a, above, slope[0], slope[1], dp, dv);
  lane_lift(terrain, &glide.at, s->gx, s->gy, p, v, &b.strike, dp, dv);
  for (int axis = 0; axis < 3; axis++)
    da[axis] = b.da[axis];
}

#endif
