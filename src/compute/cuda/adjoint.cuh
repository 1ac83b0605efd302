/* adjoint.cuh: one mass against the ground, one spring, one sensor in float32, each with its derivative, for one lane of a device.
 *
 * Also valid C17, so that a test without a device compares all of it with rollout/contact.c and rollout/adjoint.c. The mathematics is that
 * of docs/numerics.md, and the care that float32 asks for is that of rollout/gradient_contact.inc: x and y count from the world's
 * centre; how far the ground bends away under a sliding mass is computed by itself and rounded up to one digit. Segments that leave
 * their terrain cell are cut at its borders, in float32 too.
 *
 * Operations are fused where fmaf says so and nowhere else: this file is to be compiled without contraction (nvcc -fmad=false), so that the
 * way back sees every strike that the way forward saw. */
#ifndef MORPHO_COMPUTE_CUDA_ADJOINT_CUH
#define MORPHO_COMPUTE_CUDA_ADJOINT_CUH

#include <morpho/world.h>

#include <math.h>

#ifdef __CUDACC__
#define MO_BOTH      static __host__ __device__ __forceinline__
#define MO_BOTH_RARE static __host__ __device__ __noinline__
#else
#define MO_BOTH      static inline
#define MO_BOTH_RARE static inline
#endif

/* What all lanes share. */
struct mo_lane_physics {
  float dt;
  float friction, friction_cap;
  int bisections;     /* 0: the closed form */
  float keep, fall;   /* v ← keep · v, then v[2] −= fall */
  float pull;         /* dt · k / m */
  float actuation;    /* of the rest length */
  int inverse_square; /* the sensor */
};

#define MO_LANE_CELLS_PER_M ((float)((MO_TERRAIN_SIDE - 1) / MO_TERRAIN_SIZE_M))
#define MO_LANE_ORIGIN      ((float)((MO_TERRAIN_SIDE - 1) / MO_TERRAIN_SIZE_M * MO_WORLD_CENTRE_M))

/* ---- the ground ---- */

/* h + u·a + w·b + u·w·c from the corner (i, j) of a cell; −1 and 7 are the cells beyond the map's edges. */
struct mo_ground {
  float i, j, h, a, b, c;
};

MO_BOTH float mo_cell_coordinate(float position)
{
  return fmaf(position, MO_LANE_CELLS_PER_M, MO_LANE_ORIGIN);
}

MO_BOTH float mo_cell_of(float coordinate)
{
  return floorf(fmaxf(fminf(coordinate, (float)(MO_TERRAIN_SIDE - 1)), -1.0f));
}

/* heights: (64), as in mo_environment. */
MO_BOTH struct mo_ground mo_ground_at(const float *heights, float i, float j)
{
  struct mo_ground g;
  const int column = (int)i, row = (int)j;
  const int left = column < 0 ? 0 : column, right = column < MO_TERRAIN_SIDE - 1 ? column + 1 : MO_TERRAIN_SIDE - 1;
  const int near = row < 0 ? 0 : row, far = row < MO_TERRAIN_SIDE - 1 ? row + 1 : MO_TERRAIN_SIDE - 1;
  const float h00 = heights[near * MO_TERRAIN_SIDE + left], h10 = heights[near * MO_TERRAIN_SIDE + right];
  const float h01 = heights[far * MO_TERRAIN_SIDE + left], h11 = heights[far * MO_TERRAIN_SIDE + right];
  g.i = i;
  g.j = j;
  g.h = h00;
  g.a = h10 - h00;
  g.b = h01 - h00;
  g.c = (h11 - h01) - g.a;
  return g;
}

MO_BOTH float mo_ground_height(const struct mo_ground *g, float u, float w)
{
  return fmaf(u, fmaf(w, g->c, g->a), fmaf(w, g->b, g->h));
}

/* Height at a place, with the ground there. */
MO_BOTH float mo_ground_find(const float *heights, float x, float y, struct mo_ground *g)
{
  const float u = mo_cell_coordinate(x), w = mo_cell_coordinate(y);
  *g = mo_ground_at(heights, mo_cell_of(u), mo_cell_of(w));
  return mo_ground_height(g, u - g->i, w - g->j);
}

/* ---- time of impact ---- */

/* Within one cell: see rollout/contact.c. Not falling, and no ground that rises to meet it: `never`. */
MO_BOTH float mo_descent(const struct mo_ground *g, float u, float w, float z, const float *v, float never)
{
  const float du = g->i < 0 || g->i >= MO_TERRAIN_SIDE - 1 ? 0.0f : v[0] * MO_LANE_CELLS_PER_M;
  const float dw = g->j < 0 || g->j >= MO_TERRAIN_SIDE - 1 ? 0.0f : v[1] * MO_LANE_CELLS_PER_M;
  const float gap = fmaxf(z - mo_ground_height(g, u, w), 0.0f);
  const float linear = v[2] - fmaf(g->a, du, fmaf(g->b, dw, g->c * fmaf(u, dw, w * du)));
  const float square = -(g->c * du * dw);
  const float discriminant = fmaf(linear, linear, -4.0f * square * gap);
  const float root = sqrtf(fmaxf(discriminant, 0.0f));
  if (linear < 0)
    return (gap + gap) / (root - linear);
  return square < 0 ? (linear + root) / (-2.0f * square) : never;
}

/* When a segment at `start` with `speed`, in cells, leaves cell `cell`. */
MO_BOTH float mo_leave_time(float start, float speed, float cell)
{
  if (speed > 0 && cell < MO_TERRAIN_SIDE - 1)
    return (cell + 1 - start) / speed;
  if (speed < 0 && cell >= 0)
    return (cell - start) / speed;
  return INFINITY;
}

/* When a segment strikes, and in which cell. By value: what has an address cannot stay in registers. */
struct mo_impact_place {
  float time, i, j;
};

/* A segment that leaves its cell. */
MO_BOTH_RARE struct mo_impact_place mo_impact_across(const float *heights, float dt, float px, float py, float pz,
                                                     float vx, float vy, float vz)
{
  const float x = mo_cell_coordinate(px), y = mo_cell_coordinate(py), v[3] = {vx, vy, vz};
  const float dx = vx * MO_LANE_CELLS_PER_M, dy = vy * MO_LANE_CELLS_PER_M;
  struct mo_impact_place place = {dt, mo_cell_of(x), mo_cell_of(y)};
  float from = 0;
  for (int piece = 0; piece < 4 * MO_TERRAIN_SIDE; piece++) {
    const float leave_x = mo_leave_time(x, dx, place.i), leave_y = mo_leave_time(y, dy, place.j);
    const float to = fminf(fminf(leave_x, leave_y), dt);
    if (to > from) {
      const struct mo_ground g = mo_ground_at(heights, place.i, place.j);
      const float time = from + mo_descent(&g, fmaf(from, dx, x) - place.i, fmaf(from, dy, y) - place.j,
                                           fmaf(from, vz, pz), v, INFINITY);
      if (time <= to) {
        place.time = time;
        return place;
      }
      from = to;
    }
    if (!(to < dt))
      break; /* below the ground by rounding alone */
    if (leave_x <= leave_y)
      place.i += dx > 0 ? 1.0f : -1.0f;
    else
      place.j += dy > 0 ? 1.0f : -1.0f;
  }
  return place;
}

MO_BOTH_RARE struct mo_impact_place mo_impact_halving(const float *heights, float dt, int bisections, float px,
                                                      float py, float pz, float vx, float vy, float vz)
{
  struct mo_ground g;
  float low = 0, high = dt;
  for (int k = 0; k < bisections; k++) {
    const float middle = 0.5f * (low + high);
    if (fmaf(middle, vz, pz) < mo_ground_find(heights, fmaf(middle, vx, px), fmaf(middle, vy, py), &g))
      high = middle;
    else
      low = middle;
  }
  const struct mo_impact_place place = {low, mo_cell_of(mo_cell_coordinate(fmaf(low, vx, px))),
                                        mo_cell_of(mo_cell_coordinate(fmaf(low, vy, py)))};
  return place;
}

/* ---- a strike ---- */

/* What happens to a mass that strikes the ground, from p with velocity v, as far as both ways need it. */
struct mo_strike {
  struct mo_ground ground;
  float impact, rest;
  float gx, gy;             /* gradient of the ground there */
  float norm;               /* 1 / (1 + gx² + gy²) */
  float along;              /* v·n, n not normalised: (−gx, −gy, 1) */
  float u[3];               /* the tangential part of v */
  float speed, slowed, cap; /* |u|; what friction takes, what it takes at most */
  float scale, slid[3];     /* v after impact: scale · u */
  float end[3];             /* where that leads */
  float rise;               /* how far `end` is above the patch: the ground bends away by its twist */
  int crosses;              /* the segment leaves its cell */
  int stays;                /* end is in the cell that was struck */
};

/* next: the ground under the end of the straight segment. */
MO_BOTH struct mo_strike mo_strike_of(const struct mo_lane_physics *l, const float *heights,
                                      const struct mo_ground *next, const float *p, const float *v)
{
  struct mo_strike s;
  const float x = mo_cell_coordinate(p[0]), y = mo_cell_coordinate(p[1]);
  s.crosses = mo_cell_of(x) != next->i || mo_cell_of(y) != next->j;
  s.ground = *next;
  if (l->bisections > 0 || s.crosses) {
    const struct mo_impact_place place =
        l->bisections > 0 ? mo_impact_halving(heights, l->dt, l->bisections, p[0], p[1], p[2], v[0], v[1], v[2])
                          : mo_impact_across(heights, l->dt, p[0], p[1], p[2], v[0], v[1], v[2]);
    s.impact = place.time;
    s.ground = mo_ground_at(heights, place.i, place.j);
  } else {
    s.impact = mo_descent(next, x - next->i, y - next->j, p[2], v, l->dt);
  }
  s.impact = fminf(fmaxf(s.impact, 0.0f), l->dt);
  s.rest = l->dt - s.impact;
  s.end[0] = fmaf(s.impact, v[0], p[0]);
  s.end[1] = fmaf(s.impact, v[1], p[1]);
  const float u = mo_cell_coordinate(s.end[0]) - s.ground.i, w = mo_cell_coordinate(s.end[1]) - s.ground.j;
  s.end[2] = mo_ground_height(&s.ground, u, w);
  s.gx = fmaf(w, s.ground.c, s.ground.a) * MO_LANE_CELLS_PER_M;
  s.gy = fmaf(u, s.ground.c, s.ground.b) * MO_LANE_CELLS_PER_M;
  s.norm = 1.0f / fmaf(s.gx, s.gx, fmaf(s.gy, s.gy, 1.0f));
  s.along = fmaf(-s.gx, v[0], fmaf(-s.gy, v[1], v[2]));
  const float part = s.along * s.norm;
  s.u[0] = fmaf(part, s.gx, v[0]);
  s.u[1] = fmaf(part, s.gy, v[1]);
  s.u[2] = v[2] - part;
  s.speed = sqrtf(fmaf(s.u[0], s.u[0], fmaf(s.u[1], s.u[1], s.u[2] * s.u[2])));
  s.slowed = fabsf(s.along) * sqrtf(s.norm) * l->friction;
  s.cap = s.speed * l->friction_cap;
  s.scale = 1.0f - fminf(s.slowed, s.cap) / fmaxf(s.speed, 1e-30f);
  for (int axis = 0; axis < 3; axis++) {
    s.slid[axis] = s.scale * s.u[axis];
    s.end[axis] = fmaf(s.rest, s.slid[axis], s.end[axis]);
  }
  s.rise = -(s.ground.c * (s.rest * s.slid[0] * MO_LANE_CELLS_PER_M) * (s.rest * s.slid[1] * MO_LANE_CELLS_PER_M));
  s.stays =
      mo_cell_of(mo_cell_coordinate(s.end[0])) == s.ground.i && mo_cell_of(mo_cell_coordinate(s.end[1])) == s.ground.j;
  return s;
}

/* Whether a mass at p with velocity v strikes the ground; next: where its straight segment ends, g: the ground there. */
MO_BOTH int mo_strikes(const struct mo_lane_physics *l, const float *heights, float highest, const float *p,
                       const float *v, float *next, struct mo_ground *g)
{
  for (int axis = 0; axis < 3; axis++)
    next[axis] = fmaf(l->dt, v[axis], p[axis]);
  return next[2] < highest && next[2] < mo_ground_find(heights, next[0], next[1], g);
}

/* A mass moves from p with velocity v for one step; p and v become those after it. 1: it struck the ground. */
MO_BOTH int mo_move(const struct mo_lane_physics *l, const float *heights, float highest, float *p, float *v)
{
  float next[3];
  struct mo_ground g;
  if (!mo_strikes(l, heights, highest, p, v, next, &g)) {
    for (int axis = 0; axis < 3; axis++)
      p[axis] = next[axis];
    return 0;
  }
  const struct mo_strike s = mo_strike_of(l, heights, &g, p, v);
  g = s.ground;
  float rise = s.rise;
  if (!s.stays)
    rise = s.end[2] - mo_ground_find(heights, s.end[0], s.end[1], &g);
  const float on_ground = mo_ground_height(&g, mo_cell_coordinate(s.end[0]) - g.i, mo_cell_coordinate(s.end[1]) - g.j);
  const float digit = fmaf(fabsf(on_ground), 0x1p-23f, 0x1p-100f);
  p[0] = s.end[0];
  p[1] = s.end[1];
  p[2] = rise > 0 ? on_ground + fmaxf(rise, digit) : on_ground;
  for (int axis = 0; axis < 3; axis++)
    v[axis] = s.slid[axis];
  return 1;
}

/* The derivative of mo_move at the p and v that it was given. dp, dv: ∂loss/∂ what it made of them; replaced by ∂loss/∂ what it was given. */
MO_BOTH void mo_move_back(const struct mo_lane_physics *l, const float *heights, float highest, const float *p,
                          const float *v, float *dp, float *dv)
{
  const float next[3] = {fmaf(l->dt, v[0], p[0]), fmaf(l->dt, v[1], p[1]), fmaf(l->dt, v[2], p[2])};
  struct mo_ground g;
  if (!(next[2] < highest) || !(next[2] < mo_ground_find(heights, next[0], next[1], &g))) {
    for (int k = 0; k < 3; k++)
      dv[k] = fmaf(l->dt, dp[k], dv[k]);
    return;
  }
  const struct mo_strike s = mo_strike_of(l, heights, &g, p, v);

  /* p[2] = max(end[2], ground): its slope where the ground won */
  float d_end[3] = {dp[0], dp[1], dp[2]};
  int above = s.stays && s.rise >= 0;
  float slope_x = fmaf(mo_cell_coordinate(s.end[1]) - s.ground.j, s.ground.c, s.ground.a) * MO_LANE_CELLS_PER_M;
  float slope_y = fmaf(mo_cell_coordinate(s.end[0]) - s.ground.i, s.ground.c, s.ground.b) * MO_LANE_CELLS_PER_M;
  if (!s.stays) {
    struct mo_ground there;
    above = mo_ground_find(heights, s.end[0], s.end[1], &there) <= s.end[2];
    slope_x = fmaf(mo_cell_coordinate(s.end[1]) - there.j, there.c, there.a) * MO_LANE_CELLS_PER_M;
    slope_y = fmaf(mo_cell_coordinate(s.end[0]) - there.i, there.c, there.b) * MO_LANE_CELLS_PER_M;
  }
  if (!above) {
    d_end[0] = fmaf(dp[2], slope_x, d_end[0]);
    d_end[1] = fmaf(dp[2], slope_y, d_end[1]);
    d_end[2] = 0;
  }

  /* end = hit + rest · slid */
  float d_hit[3], d_slid[3], d_impact = 0, d_scale = 0;
  for (int k = 0; k < 3; k++) {
    d_hit[k] = d_end[k];
    d_slid[k] = fmaf(s.rest, d_end[k], dv[k]);
    d_impact = fmaf(-s.slid[k], d_end[k], d_impact);
    d_scale = fmaf(s.u[k], d_slid[k], d_scale);
  }

  /* slid = scale · u, scale = 1 − slowed / speed below the cap; nothing flows through a speed of 0 */
  const float inverse = 1.0f / fmaxf(s.speed, 1e-30f);
  const float share = s.slowed < s.cap ? d_scale * inverse : 0.0f;
  const float length = sqrtf(s.norm), normal[3] = {-s.gx * length, -s.gy * length, length}, vn = s.along * length;
  float d_vn = -share * copysignf(l->friction, vn);
  float du[3], dn[3], out[3];
  const float d_speed = share * (s.slowed * inverse) * inverse;
  for (int k = 0; k < 3; k++)
    du[k] = s.speed > 0 ? fmaf(d_speed, s.u[k], s.scale * d_slid[k]) : 0.0f;

  /* u = v − vn · normal, vn = v · normal, normal = (−g, 1) · length */
  for (int k = 0; k < 3; k++)
    d_vn = fmaf(-du[k], normal[k], d_vn);
  float along = 0;
  for (int k = 0; k < 3; k++) {
    out[k] = fmaf(d_vn, normal[k], du[k]);
    dn[k] = fmaf(d_vn, v[k], -(du[k] * vn));
    along = fmaf(dn[k], normal[k], along);
  }
  const float dgx = fmaf(along, normal[0], -dn[0]) * length, dgy = fmaf(along, normal[1], -dn[1]) * length;

  /* g = ∇h(hit), hit[2] = h(hit) */
  const float bend = s.ground.c * (MO_LANE_CELLS_PER_M * MO_LANE_CELLS_PER_M);
  d_hit[0] = fmaf(bend, dgy, fmaf(d_hit[2], s.gx, d_hit[0]));
  d_hit[1] = fmaf(bend, dgx, fmaf(d_hit[2], s.gy, d_hit[1]));

  /* hit = p + impact · v in x and y; impact solves p[2] + impact · v[2] = h(hit) */
  d_impact = fmaf(v[0], d_hit[0], fmaf(v[1], d_hit[1], d_impact));
  const int solved = l->bisections == 0 && s.impact > 0 && s.impact < l->dt;
  const float push = solved ? d_impact / s.along : 0.0f;
  const float along_v[3] = {fmaf(push, s.gx, d_hit[0]), fmaf(push, s.gy, d_hit[1]), -push};
  for (int k = 0; k < 3; k++)
    dv[k] = fmaf(s.impact, along_v[k], out[k]);

  /* A mass that lies on the ground stays there wherever it lies: the difference of the gradients takes the gradient's place. */
  struct mo_ground below;
  if (p[2] <= mo_ground_find(heights, p[0], p[1], &below)) {
    float bent_x = push * s.impact * bend * v[1], bent_y = push * s.impact * bend * v[0];
    if (s.crosses) {
      bent_x = push * (s.gx - fmaf(mo_cell_coordinate(p[1]) - below.j, below.c, below.a) * MO_LANE_CELLS_PER_M);
      bent_y = push * (s.gy - fmaf(mo_cell_coordinate(p[0]) - below.i, below.c, below.b) * MO_LANE_CELLS_PER_M);
    }
    dp[0] = d_hit[0] + bent_x;
    dp[1] = d_hit[1] + bent_y;
    dp[2] = 0;
  } else {
    for (int k = 0; k < 3; k++)
      dp[k] = along_v[k];
  }
}

/* ---- springs ---- */

/* A spring between ends that are `d` apart, a its activation, rest its length without: what one end's velocity gets is −f · d, the other's f · d. */
MO_BOTH float mo_inverse_root(float x)
{
#ifdef __CUDA_ARCH__
  float root; /* x is no subnormal number, which rsqrtf would ask */
  asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(root) : "f"(x));
  return root;
#else
  return 1.0f / sqrtf(x);
#endif
}

MO_BOTH float mo_spring_pull(const struct mo_lane_physics *l, float rest, float a, const float *d)
{
  const float squared = fmaf(d[0], d[0], fmaf(d[1], d[1], d[2] * d[2]));
  const float inverse = mo_inverse_root(fmaxf(squared, 1e-30f));
  const float wanted = fmaf(rest * l->actuation, a, rest);
  return l->pull * fmaf(squared, inverse, -wanted) * inverse;
}

/* across: ∂loss/∂ velocity of the end that d points from, less that of the other: what w is in docs/numerics.md, not divided by the mass.
 * Gives ∂loss/∂ d and returns ∂loss/∂ a. */
MO_BOTH float mo_spring_pull_back(const struct mo_lane_physics *l, float rest, float a, const float *d,
                                  const float *across, float *dd)
{
  const float squared = fmaf(d[0], d[0], fmaf(d[1], d[1], d[2] * d[2]));
  const float inverse = mo_inverse_root(fmaxf(squared, 1e-30f));
  const float wanted = fmaf(rest * l->actuation, a, rest);
  const float pull = l->pull * fmaf(squared, inverse, -wanted) * inverse;
  const float d_pull = fmaf(across[0], d[0], fmaf(across[1], d[1], across[2] * d[2])) * l->pull * inverse;
  const float stretch = d_pull * wanted * inverse * inverse;
  for (int k = 0; k < 3; k++)
    dd[k] = fmaf(pull, across[k], stretch * d[k]);
  return -d_pull * rest * l->actuation;
}

/* ---- sensors ---- */

MO_BOTH float mo_light(const struct mo_lane_physics *l, const float *d)
{
  const float squared = fmaf(d[0], d[0], fmaf(d[1], d[1], d[2] * d[2]));
  return l->inverse_square ? 1.0f / (squared + 1e-4f) : 1.0f / (sqrtf(sqrtf(squared) + 1e-8f) + 1e-8f);
}

/* The factor f of ∂light/∂position = f · d. */
MO_BOTH float mo_light_slope(const struct mo_lane_physics *l, const float *d)
{
  const float squared = fmaf(d[0], d[0], fmaf(d[1], d[1], d[2] * d[2]));
  if (l->inverse_square) {
    const float light = 1.0f / (squared + 1e-4f);
    return -2.0f * light * light;
  }
  const float distance = sqrtf(squared), root = sqrtf(distance + 1e-8f), guarded = root + 1e-8f;
  return distance > 0 ? -0.5f / (guarded * guarded * root * distance) : 0.0f;
}

#endif
