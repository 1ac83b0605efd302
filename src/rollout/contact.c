/* contact.c: one mass against the terrain.
 *
 * A mass moves on a straight segment p + τ v, 0 ≤ τ ≤ dt. Its gap is g(τ) = z(τ) − h(x(τ), y(τ)).
 * Within one terrain cell
 *   h = h00 + a u + b w + c u w,   a = h10 − h00,  b = h01 − h00,  c = h11 − h10 − h01 + h00,
 * with u, w the fractions of the cell, linear in τ; so g is a quadratic A τ² + B τ + C. Its first
 * root from ≥ 0 to < 0 is
 *   B < 0:  2C / (−B + sqrt(B² − 4AC))        (no cancellation; also right for A = 0)
 *   B ≥ 0:  (−B − sqrt(B² − 4AC)) / (2A)      (only A < 0 can turn down again)
 * A segment that leaves its cell is cut where it crosses a border, and the pieces are tried in
 * order. Beyond the map's edge, the height is constant along that axis, as if there were two more
 * rows of "cells" with a slope of 0. */
#include "rollout/contact.h"

#include <math.h>

#define CELLS       (MO_TERRAIN_SIDE - 1)
#define CELLS_PER_M (CELLS / MO_TERRAIN_SIZE_M)

/* One horizontal axis of a segment, in units of cells. `cell`: −1 before the map, 0 … CELLS − 1 in
 * it, CELLS beyond it. */
struct axis {
  double start, speed;
  int cell;
};

static struct axis make_axis(double position_m, double velocity_m_per_s)
{
  struct axis axis = {position_m * CELLS_PER_M, velocity_m_per_s * CELLS_PER_M, 0};
  if (axis.start < 0)
    axis.cell = -1;
  else if (axis.start > CELLS)
    axis.cell = CELLS;
  else
    axis.cell = axis.start < CELLS ? (int)axis.start : CELLS - 1;
  return axis;
}

/* Returns when the segment leaves the axis's current cell, or infinity if it never does. */
static double leave_time(const struct axis *axis)
{
  if (axis->speed > 0 && axis->cell < CELLS)
    return (axis->cell + 1 - axis->start) / axis->speed;
  if (axis->speed < 0 && axis->cell >= 0)
    return (axis->cell - axis->start) / axis->speed;
  return INFINITY;
}

/* Computes the fraction of the cell at time t, and its rate. Returns the cell of the map whose
 * heights apply. */
static int place(const struct axis *axis, double t, double *fraction, double *rate)
{
  *rate = 0;
  if (axis->cell < 0) {
    *fraction = 0;
    return 0;
  }
  if (axis->cell >= CELLS) {
    *fraction = 1;
    return CELLS - 1;
  }
  *fraction = axis->start + axis->speed * t - axis->cell;
  *rate = axis->speed;
  return axis->cell;
}

/* Returns the first time ≥ 0 when A t² + B t + C, C ≥ 0, becomes negative, or infinity if it never
 * does. */
static double first_descent(double a, double b, double c)
{
  const double discriminant = b * b - 4 * a * c;
  if (b < 0)
    return discriminant < 0 ? INFINITY : 2 * c / (-b + sqrt(discriminant));
  return a < 0 ? (-b - sqrt(discriminant)) / (2 * a)
               : INFINITY; /* A < 0, C ≥ 0: the discriminant is ≥ 0 */
}

double mo_impact_exact(const double heights_m[MO_TERRAIN_HEIGHTS], const double position_m[3],
                       const double velocity_m_per_s[3], double dt_s)
{
  struct axis x = make_axis(position_m[0], velocity_m_per_s[0]);
  struct axis y = make_axis(position_m[1], velocity_m_per_s[1]);
  double from = 0;
  for (;;) {
    const double leave_x = leave_time(&x), leave_y = leave_time(&y);
    const double to = fmin(fmin(leave_x, leave_y), dt_s);
    if (to > from) {
      double u, w, du, dw;
      const int i = place(&x, from, &u, &du), j = place(&y, from, &w, &dw);
      const double *h = heights_m + j * MO_TERRAIN_SIDE + i;
      const double a = h[1] - h[0], b = h[MO_TERRAIN_SIDE] - h[0];
      const double c = h[MO_TERRAIN_SIDE + 1] - h[1] - h[MO_TERRAIN_SIDE] + h[0];
      const double gap =
          position_m[2] + velocity_m_per_s[2] * from - (h[0] + a * u + b * w + c * u * w);
      const double descent =
          first_descent(-c * du * dw, velocity_m_per_s[2] - a * du - b * dw - c * (u * dw + w * du),
                        fmax(gap, 0));
      if (from + descent <= to)
        return from + descent;
      from = to;
    }
    /* Not `to >= dt_s`, because NaN must also end the loop: at a speed that is not finite, no
     * border is ever reached. */
    if (!(to < dt_s))
      return dt_s; /* below the terrain only by rounding */
    if (leave_x <= leave_y)
      x.cell += x.speed > 0 ? 1 : -1;
    else
      y.cell += y.speed > 0 ? 1 : -1;
  }
}

double mo_impact_bisection(const double heights_m[MO_TERRAIN_HEIGHTS], const double position_m[3],
                           const double velocity_m_per_s[3], double dt_s, uint32_t bisections)
{
  double low = 0, high = dt_s;
  for (uint32_t i = 0; i < bisections; i++) {
    const double middle = 0.5 * (low + high);
    const double height = mo_terrain_height(heights_m, position_m[0] + middle * velocity_m_per_s[0],
                                            position_m[1] + middle * velocity_m_per_s[1]);
    if (position_m[2] + middle * velocity_m_per_s[2] < height)
      high = middle;
    else
      low = middle;
  }
  return low;
}

/* Removes the part of the velocity along the terrain's normal, and slows the tangential part by
 * friction. */
static void strike(const struct mo_constants *constants, const double gradient[2], double v[3])
{
  const double length = sqrt(gradient[0] * gradient[0] + gradient[1] * gradient[1] + 1.0);
  const double normal[3] = {-gradient[0] / length, -gradient[1] / length, 1.0 / length};
  const double vn = v[0] * normal[0] + v[1] * normal[1] + v[2] * normal[2];
  for (int axis = 0; axis < 3; axis++)
    v[axis] -= vn * normal[axis];
  const double vt = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
  const double lost = fmin(constants->friction * fabs(vn), constants->friction_cap * vt);
  const double scale = vt > 0 ? 1.0 - lost / vt : 0.0;
  for (int axis = 0; axis < 3; axis++)
    v[axis] *= scale;
}

bool mo_contact_move(const struct mo_scheme *scheme, const struct mo_constants *constants,
                     const double heights_m[MO_TERRAIN_HEIGHTS], double highest_m,
                     double position_m[3], double velocity_m_per_s[3])
{
  const double dt = scheme->dt_s;
  double *p = position_m, *v = velocity_m_per_s;
  const double next[3] = {p[0] + dt * v[0], p[1] + dt * v[1], p[2] + dt * v[2]};
  if (next[2] >= highest_m || !(next[2] < mo_terrain_height(heights_m, next[0], next[1]))) {
    for (int axis = 0; axis < 3; axis++)
      p[axis] = next[axis];
    return false;
  }
  const double impact = scheme->impact == MO_IMPACT_EXACT
                            ? mo_impact_exact(heights_m, p, v, dt)
                            : mo_impact_bisection(heights_m, p, v, dt, scheme->bisections);
  p[0] += impact * v[0];
  p[1] += impact * v[1];
  p[2] = mo_terrain_height(heights_m, p[0], p[1]);
  double gradient[2];
  mo_terrain_gradient(heights_m, p[0], p[1], gradient);
  strike(constants, gradient, v);
  const double rest = dt - impact;
  for (int axis = 0; axis < 3; axis++)
    p[axis] += rest * v[axis];
  p[2] = fmax(p[2], mo_terrain_height(heights_m, p[0], p[1]));
  return true;
}

/* ---- the backward pass: dx is ∂loss/∂x; every contribution is added ---- */

/* Returns the second derivative ∂²h/∂x∂y of the patch; 0 where a coordinate is clamped. The other
 * two vanish: the patch is bilinear. */
static double twist(const double heights_m[MO_TERRAIN_HEIGHTS], double x_m, double y_m)
{
  if (!(x_m >= 0 && x_m <= MO_TERRAIN_SIZE_M && y_m >= 0 && y_m <= MO_TERRAIN_SIZE_M))
    return 0;
  const double u = x_m * CELLS_PER_M, w = y_m * CELLS_PER_M;
  const int i = u < CELLS ? (int)u : CELLS - 1, j = w < CELLS ? (int)w : CELLS - 1;
  const double *h = heights_m + j * MO_TERRAIN_SIDE + i;
  return (h[MO_TERRAIN_SIDE + 1] - h[MO_TERRAIN_SIDE] - (h[1] - h[0])) * CELLS_PER_M * CELLS_PER_M;
}

/* Differentiates strike() at velocity v; dw: ∂loss/∂ its result. Adds to dv and to the terrain
 * gradient's dg. */
static void strike_adjoint(const struct mo_constants *constants, const double g[2],
                           const double v[3], const double dw[3], double dv[3], double dg[2])
{
  const double length = sqrt(g[0] * g[0] + g[1] * g[1] + 1.0);
  const double normal[3] = {-g[0] / length, -g[1] / length, 1.0 / length};
  const double vn = v[0] * normal[0] + v[1] * normal[1] + v[2] * normal[2];
  const double u[3] = {v[0] - vn * normal[0], v[1] - vn * normal[1], v[2] - vn * normal[2]};
  const double vt = sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2]);
  const double slowed = constants->friction * fabs(vn), cap = constants->friction_cap * vt;
  double du[3] = {0, 0, 0}, dn[3] = {0, 0, 0}, dvn = 0;
  if (vt > 0) {
    const double scale = 1.0 - fmin(slowed, cap) / vt;
    /* v = scale · u */
    for (int k = 0; k < 3; k++)
      du[k] += scale * dw[k];
    if (slowed < cap) {
      /* scale = 1 − friction |vn| / vt; with the cap it is the constant 1 − friction_cap */
      const double d_scale = u[0] * dw[0] + u[1] * dw[1] + u[2] * dw[2];
      dvn -= d_scale * copysign(constants->friction, vn) / vt;
      /* vt = |u| */
      const double d_vt = d_scale * slowed / (vt * vt);
      for (int k = 0; k < 3; k++)
        du[k] += d_vt * u[k] / vt;
    }
  }
  /* u = v − vn · normal */
  for (int k = 0; k < 3; k++) {
    dv[k] += du[k];
    dvn -= du[k] * normal[k];
    dn[k] -= du[k] * vn;
  }
  /* vn = v · normal */
  for (int k = 0; k < 3; k++) {
    dv[k] += dvn * normal[k];
    dn[k] += dvn * v[k];
  }
  /* normal = (−g, 1) / length */
  const double along = dn[0] * normal[0] + dn[1] * normal[1] + dn[2] * normal[2];
  for (int k = 0; k < 2; k++)
    dg[k] -= (dn[k] - along * normal[k]) / length;
}

/* Differentiates the time of impact, which solves p[2] + τ v[2] = h(p + τ v). By the implicit
 * function theorem, with g the terrain's gradient there and rate = v[2] − g · v the speed at which
 * the gap opens, dτ = (g · dp − dp[2] + τ (g · dv − dv[2])) / rate. At τ = 0 and τ = dt it is
 * clamped, and therefore constant. A mass that lies on the ground starts without a gap at any
 * position, so ground · dp replaces dp[2], with `ground` the gradient there. This mass strikes only
 * where the ground rises toward it. The rate may then be close to 0, but so is g − ground. */
static void impact_adjoint(double impact, double dt, const double *ground, const double g[2],
                           const double v[3], double d_impact, double dp[3], double dv[3])
{
  if (!(impact > 0 && impact < dt))
    return;
  const double push = d_impact / (v[2] - g[0] * v[0] - g[1] * v[1]);
  const double along[3] = {push * g[0], push * g[1], -push};
  for (int k = 0; k < 3; k++)
    dv[k] += impact * along[k];
  for (int k = 0; k < 3; k++)
    dp[k] += ground == NULL ? along[k] : k < 2 ? push * (g[k] - ground[k]) : 0;
}

void mo_contact_move_adjoint(const struct mo_scheme *scheme, const struct mo_constants *constants,
                             const double heights_m[MO_TERRAIN_HEIGHTS], double highest_m,
                             const double position_m[3], const double velocity_m_per_s[3],
                             double d_position[3], double d_velocity[3])
{
  const double dt = scheme->dt_s;
  const double *p = position_m, *v = velocity_m_per_s;
  double *dp = d_position, *dv = d_velocity;
  const double next[3] = {p[0] + dt * v[0], p[1] + dt * v[1], p[2] + dt * v[2]};
  if (next[2] >= highest_m || !(next[2] < mo_terrain_height(heights_m, next[0], next[1]))) {
    /* p = p + dt · v */
    for (int k = 0; k < 3; k++)
      dv[k] += dt * dp[k];
    return;
  }
  /* Repeat the forward step: impact at `hit`, velocity `slid` after it, end of the step `end`. */
  const double impact = scheme->impact == MO_IMPACT_EXACT
                            ? mo_impact_exact(heights_m, p, v, dt)
                            : mo_impact_bisection(heights_m, p, v, dt, scheme->bisections);
  const double rest = dt - impact;
  double hit[3] = {p[0] + impact * v[0], p[1] + impact * v[1], 0}, slid[3] = {v[0], v[1], v[2]},
         g[2], end[3];
  hit[2] = mo_terrain_height(heights_m, hit[0], hit[1]);
  mo_terrain_gradient(heights_m, hit[0], hit[1], g);
  strike(constants, g, slid);
  for (int k = 0; k < 3; k++)
    end[k] = hit[k] + rest * slid[k];

  double d_end[3] = {dp[0], dp[1], 0}, d_slid[3] = {dv[0], dv[1], dv[2]};
  double d_hit[3] = {0, 0, 0}, dg[2] = {0, 0}, d_impact = 0;
  for (int k = 0; k < 3; k++)
    dv[k] = 0;
  /* p[2] = max(end[2], h(end)) */
  if (end[2] >= mo_terrain_height(heights_m, end[0], end[1])) {
    d_end[2] += dp[2];
  } else {
    double slope[2];
    mo_terrain_gradient(heights_m, end[0], end[1], slope);
    d_end[0] += dp[2] * slope[0];
    d_end[1] += dp[2] * slope[1];
  }
  for (int k = 0; k < 3; k++)
    dp[k] = 0;
  /* end = hit + (dt − impact) · slid */
  for (int k = 0; k < 3; k++) {
    d_hit[k] += d_end[k];
    d_slid[k] += rest * d_end[k];
    d_impact -= slid[k] * d_end[k];
  }
  /* slid = strike(g, v) */
  strike_adjoint(constants, g, v, d_slid, dv, dg);
  /* g = ∇h(hit) */
  const double bend = twist(heights_m, hit[0], hit[1]);
  d_hit[0] += bend * dg[1];
  d_hit[1] += bend * dg[0];
  /* hit[2] = h(hit) */
  d_hit[0] += d_hit[2] * g[0];
  d_hit[1] += d_hit[2] * g[1];
  /* hit[0, 1] = p + impact · v */
  for (int k = 0; k < 2; k++) {
    dp[k] += d_hit[k];
    dv[k] += impact * d_hit[k];
    d_impact += v[k] * d_hit[k];
  }
  /* impact = mo_impact_exact(p, v) */
  double ground[2];
  const bool lies = !(p[2] > mo_terrain_height(heights_m, p[0], p[1]));
  mo_terrain_gradient(heights_m, p[0], p[1], ground);
  if (scheme->impact == MO_IMPACT_EXACT)
    impact_adjoint(impact, dt, lies ? ground : NULL, g, v, d_impact, dp, dv);
}
