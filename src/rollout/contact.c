/* contact.c: one mass against the terrain.
 *
 * A mass moves on a straight segment p + τ v, 0 ≤ τ ≤ dt. Its gap is g(τ) = z(τ) − h(x(τ), y(τ)).
 * Within one terrain cell
 *   h = h00 + a u + b w + c u w,   a = h10 − h00,  b = h01 − h00,  c = h11 − h10 − h01 + h00,
 * with u, w the fractions of the cell, linear in τ; so g is a quadratic A τ² + B τ + C. Its first
 * root from ≥ 0 to < 0 is
 *   B < 0:  2C / (−B + sqrt(B² − 4AC))        (no cancellation; also right for A = 0)
 *   B ≥ 0:  (−B − sqrt(B² − 4AC)) / (2A)      (only A < 0 can turn down again)
 * A segment that leaves its cell is cut at the edges of cells, and the pieces are tried in order.
 * Beyond the map's edge, the height is constant along that axis, as if there were two more rows of
 * "cells" with a slope of 0. */
#include "rollout/contact.h"

#include "rollout/fast.h"
#include "rollout/kick.h"
#include "world/terrain.h"

#include <math.h>
#include <string.h>

/* One horizontal axis of a segment, in units of cells. `cell`: −1 before the map, 0 … cells − 1 in
 * it, `cells` beyond it. */
struct axis {
  double start, speed;
  int cell, cells;
};

static struct axis make_axis(const struct mo_terrain_axis *of, double position_m,
                             double velocity_m_per_s)
{
  struct axis axis = {(position_m - of->from_m) * of->cells_per_m,
                      velocity_m_per_s * of->cells_per_m, 0, of->cells};
  if (axis.start < 0)
    axis.cell = -1;
  else if (axis.start > axis.cells)
    axis.cell = axis.cells;
  else
    axis.cell = axis.start < axis.cells ? (int)axis.start : axis.cells - 1;
  return axis;
}

/* Returns when the segment leaves the axis's current cell, or infinity if it never does. */
static double leave_time(const struct axis *axis)
{
  if (axis->speed > 0 && axis->cell < axis->cells)
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
  if (axis->cell >= axis->cells) {
    *fraction = 1;
    return axis->cells - 1;
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

double mo_impact_exact(const struct mo_environment *environment, const double position_m[3],
                       const double velocity_m_per_s[3], double dt_s)
{
  const struct mo_terrain_map map = mo_terrain_map_of(environment);
  struct axis x = make_axis(&map.axis[0], position_m[0], velocity_m_per_s[0]);
  struct axis y = make_axis(&map.axis[1], position_m[1], velocity_m_per_s[1]);
  double from = 0;
  for (;;) {
    const double leave_x = leave_time(&x), leave_y = leave_time(&y);
    const double to = fmin(fmin(leave_x, leave_y), dt_s);
    if (to > from) {
      double u, w, du, dw;
      const int i = place(&x, from, &u, &du), j = place(&y, from, &w, &dw);
      const double *h = map.heights_m + j * map.row + i;
      const double a = h[1] - h[0], b = h[map.row] - h[0];
      const double c = h[map.row + 1] - h[1] - h[map.row] + h[0];
      const double gap =
          position_m[2] + velocity_m_per_s[2] * from - (h[0] + a * u + b * w + c * u * w);
      const double descent =
          first_descent(-c * du * dw, velocity_m_per_s[2] - a * du - b * dw - c * (u * dw + w * du),
                        fmax(gap, 0));
      if (from + descent <= to)
        return from + descent;
      from = to;
    }
    /* Not `to >= dt_s`, because NaN must also end the loop: at a speed that is not finite, no cell
     * edge is ever reached. */
    if (!(to < dt_s))
      return dt_s; /* it is below the terrain only because of rounding */
    if (leave_x <= leave_y)
      x.cell += x.speed > 0 ? 1 : -1;
    else
      y.cell += y.speed > 0 ? 1 : -1;
  }
}

double mo_impact_bisection(const struct mo_environment *environment, const double position_m[3],
                           const double velocity_m_per_s[3], double dt_s, uint32_t bisections)
{
  double low = 0, high = dt_s;
  for (uint32_t i = 0; i < bisections; i++) {
    const double middle = 0.5 * (low + high);
    const double height =
        mo_terrain_height(environment, position_m[0] + middle * velocity_m_per_s[0],
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
                     const struct mo_environment *environment, double highest_m,
                     double position_m[3], double velocity_m_per_s[3])
{
  const double dt = scheme->dt_s;
  double *p = position_m, *v = velocity_m_per_s;
  const double next[3] = {p[0] + dt * v[0], p[1] + dt * v[1], p[2] + dt * v[2]};
  if (next[2] >= highest_m || !(next[2] < mo_terrain_height(environment, next[0], next[1]))) {
    for (int axis = 0; axis < 3; axis++)
      p[axis] = next[axis];
    return false;
  }
  const double impact = scheme->impact == MO_IMPACT_EXACT
                            ? mo_impact_exact(environment, p, v, dt)
                            : mo_impact_bisection(environment, p, v, dt, scheme->bisections);
  p[0] += impact * v[0];
  p[1] += impact * v[1];
  p[2] = mo_terrain_height(environment, p[0], p[1]);
  double gradient[2];
  mo_terrain_gradient(environment, p[0], p[1], gradient);
  strike(constants, gradient, v);
  const double rest = dt - impact;
  for (int axis = 0; axis < 3; axis++)
    p[axis] += rest * v[axis];
  p[2] = fmax(p[2], mo_terrain_height(environment, p[0], p[1]));
  return true;
}

/* ---- split ----
 *
 * The velocity v in the middle of the step and the acceleration a due to springs and gravity give
 * the velocity w at the impact. The ground cancels the part of w along its normal, and friction
 * reduces the tangential part as in an impact at that speed, unless the mass lies on the ground and
 * therefore strikes nothing. During the rest of the step, r = dt − τ, the mass slides: tangential
 * forces accelerate it, the normal force presses it to the ground, and friction takes friction ·
 * (normal force) · r from its momentum, or stops it. Forces that point away from the ground lift
 * it. Its velocity at the end of the step is then moved back to the middle of the step, where the
 * next kick starts.
 *
 * With a constant acceleration a, a velocity v becomes v + E (a − drag v) after t seconds, E = (1 −
 * exp(−drag t)) / drag. D = t (1 − bend t) is E to second order, and exactly E half a step back, so
 * that a mass at rest stays at rest. The exponential must have the same bits on all machines,
 * because kernels use these functions for rare moves. */

struct split {
  bool lies;                    /* on the ground when the step starts */
  double bend;                  /* of D, see above */
  double before, after, back;   /* D of the time from the middle of the step to the impact, of the
                                   time after it, and of half a step back */
  double impact, rest;          /* s */
  double hit[3], g[2], n[3];    /* place, the terrain's gradient, its unit normal */
  double w[3], wn, t[3], speed; /* velocity at impact; its normal part; the tangential; its size */
  double kept;                  /* fraction of t that remains after the impact */
  double y[3];                  /* tangential velocity after the impact */
  double b;                     /* normal velocity after the impact */
  double an, q[3], pace;        /* normal acceleration; tangential velocity without friction; |q| */
  double lift, press;           /* normal velocity at the end without the ground; the part that the
                                   ground takes */
  double held;                  /* fraction of q that friction leaves */
  double z[3];                  /* tangential velocity at the end */
  double end[3];                /* place */
};

static double dot(const double a[3], const double b[3])
{
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* Returns the fraction of a speed that friction leaves. */
static double left_by(double lost, double speed)
{
  return speed > 0 ? 1 - fmin(lost, speed) / speed : lost > 0 ? 0 : 1;
}

static struct split split_of(const struct mo_scheme *scheme, const struct mo_constants *constants,
                             const struct mo_environment *environment, const double a[3],
                             const double p[3], const double v[3])
{
  const double dt = scheme->dt_s, drag = constants->drag_per_s;
  struct split s;
  s.lies = p[2] - mo_terrain_height(environment, p[0], p[1]) < MO_LIES_M;
  s.bend = mo_kick_bend(scheme, constants, mo_fast_exp(-drag * dt));
  s.impact = s.lies ? 0
             : scheme->impact == MO_IMPACT_EXACT
                 ? mo_impact_exact(environment, p, v, dt)
                 : mo_impact_bisection(environment, p, v, dt, scheme->bisections);
  s.rest = dt - s.impact;
  for (int k = 0; k < 2; k++)
    s.hit[k] = p[k] + s.impact * v[k];
  s.hit[2] = mo_terrain_height(environment, s.hit[0], s.hit[1]);
  mo_terrain_gradient(environment, s.hit[0], s.hit[1], s.g);
  const double length = sqrt(s.g[0] * s.g[0] + s.g[1] * s.g[1] + 1.0);
  s.n[0] = -s.g[0] / length;
  s.n[1] = -s.g[1] / length;
  s.n[2] = 1.0 / length;
  s.before = (s.impact - 0.5 * dt) * (1 - s.bend * (s.impact - 0.5 * dt));
  s.after = s.rest * (1 - s.bend * s.rest);
  s.back = -0.5 * dt * (1 + s.bend * 0.5 * dt);
  for (int k = 0; k < 3; k++)
    s.w[k] = v[k] + s.before * (a[k] - drag * v[k]);
  s.wn = dot(s.w, s.n);
  for (int k = 0; k < 3; k++)
    s.t[k] = s.w[k] - s.wn * s.n[k];
  s.speed = sqrt(dot(s.t, s.t));
  s.b = s.lies ? s.wn : fmax(s.wn, 0);
  s.kept =
      s.lies
          ? 1
          : left_by(fmin(constants->friction * fmax(-s.wn, 0), constants->friction_cap * s.speed),
                    s.speed);
  s.an = dot(a, s.n);
  for (int k = 0; k < 3; k++) {
    s.y[k] = s.kept * s.t[k];
    s.q[k] = s.y[k] + s.after * (a[k] - s.an * s.n[k] - drag * s.y[k]);
  }
  s.pace = sqrt(dot(s.q, s.q));
  s.lift = s.b + s.after * (s.an - drag * s.b);
  s.press = fmax(-s.lift, 0);
  s.held = left_by(constants->friction * s.press, s.pace);
  for (int k = 0; k < 3; k++) {
    s.z[k] = s.held * s.q[k];
    s.end[k] = s.hit[k] + 0.5 * s.rest * (s.y[k] + s.z[k] + fmax(s.lift, 0) * s.n[k]);
  }
  return s;
}

bool mo_contact_split(const struct mo_scheme *scheme, const struct mo_constants *constants,
                      const struct mo_environment *environment, double highest_m,
                      const double acceleration[3], double position_m[3],
                      double velocity_m_per_s[3])
{
  const double dt = scheme->dt_s;
  double *p = position_m, *v = velocity_m_per_s;
  const double next[3] = {p[0] + dt * v[0], p[1] + dt * v[1], p[2] + dt * v[2]};
  if (next[2] >= highest_m || !(next[2] < mo_terrain_height(environment, next[0], next[1]))) {
    memcpy(p, next, sizeof(next));
    return false;
  }
  const struct split s = split_of(scheme, constants, environment, acceleration, p, v);
  for (int k = 0; k < 3; k++) {
    const double end = s.z[k] + fmax(s.lift, 0) * s.n[k];
    v[k] = end + s.back * (acceleration[k] - constants->drag_per_s * end);
    p[k] = s.end[k];
  }
  p[2] = fmax(p[2], mo_terrain_height(environment, p[0], p[1]));
  return true;
}

/* ---- the backward pass: dx is ∂loss/∂x; every contribution is added ---- */

/* Returns the second derivative ∂²h/∂x∂y of the patch; 0 where a coordinate is clamped. The other
 * second derivatives vanish, because the patch is bilinear. */
static double twist(const struct mo_environment *environment, double x_m, double y_m)
{
  const struct mo_terrain_map map = mo_terrain_map_of(environment);
  const struct mo_terrain_axis *x = &map.axis[0], *y = &map.axis[1];
  x_m -= x->from_m;
  y_m -= y->from_m;
  if (!(x_m >= 0 && x_m <= x->size_m && y_m >= 0 && y_m <= y->size_m))
    return 0;
  const double u = x_m * x->cells_per_m, w = y_m * y->cells_per_m;
  const int i = u < x->cells ? (int)u : x->cells - 1, j = w < y->cells ? (int)w : y->cells - 1;
  const double *h = map.heights_m + j * map.row + i;
  return (h[map.row + 1] - h[map.row] - (h[1] - h[0])) * x->cells_per_m * y->cells_per_m;
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
 * position, so ground · dp replaces dp[2], with `ground` the gradient there. A lying mass strikes
 * the ground only where it rises. The rate may then be close to 0, but so is g − ground. */
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

/* Differentiates the place and time of an impact, at p + impact · v in x and y, and the terrain's
 * gradient g there. */
static void place_adjoint(const struct mo_scheme *scheme, const struct mo_environment *environment,
                          double impact, const double hit[3], const double g[2], const double p[3],
                          const double v[3], double d_hit[3], const double dg[2], double d_impact,
                          double dp[3], double dv[3])
{
  /* g = ∇h(hit) */
  const double bend = twist(environment, hit[0], hit[1]);
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
  const bool lies = !(p[2] > mo_terrain_height(environment, p[0], p[1]));
  mo_terrain_gradient(environment, p[0], p[1], ground);
  if (scheme->impact == MO_IMPACT_EXACT)
    impact_adjoint(impact, scheme->dt_s, lies ? ground : NULL, g, v, d_impact, dp, dv);
}

void mo_contact_move_adjoint(const struct mo_scheme *scheme, const struct mo_constants *constants,
                             const struct mo_environment *environment, double highest_m,
                             const double position_m[3], const double velocity_m_per_s[3],
                             double d_position[3], double d_velocity[3])
{
  const double dt = scheme->dt_s;
  const double *p = position_m, *v = velocity_m_per_s;
  double *dp = d_position, *dv = d_velocity;
  const double next[3] = {p[0] + dt * v[0], p[1] + dt * v[1], p[2] + dt * v[2]};
  if (next[2] >= highest_m || !(next[2] < mo_terrain_height(environment, next[0], next[1]))) {
    /* p = p + dt · v */
    for (int k = 0; k < 3; k++)
      dv[k] += dt * dp[k];
    return;
  }
  /* Repeat the forward step: impact at `hit`, velocity `slid` after it, end of the step `end`. */
  const double impact = scheme->impact == MO_IMPACT_EXACT
                            ? mo_impact_exact(environment, p, v, dt)
                            : mo_impact_bisection(environment, p, v, dt, scheme->bisections);
  const double rest = dt - impact;
  double hit[3] = {p[0] + impact * v[0], p[1] + impact * v[1], 0}, slid[3] = {v[0], v[1], v[2]},
         g[2], end[3];
  hit[2] = mo_terrain_height(environment, hit[0], hit[1]);
  mo_terrain_gradient(environment, hit[0], hit[1], g);
  strike(constants, g, slid);
  for (int k = 0; k < 3; k++)
    end[k] = hit[k] + rest * slid[k];

  double d_end[3] = {dp[0], dp[1], 0}, d_slid[3] = {dv[0], dv[1], dv[2]};
  double d_hit[3] = {0, 0, 0}, dg[2] = {0, 0}, d_impact = 0;
  for (int k = 0; k < 3; k++)
    dv[k] = 0;
  /* p[2] = max(end[2], h(end)) */
  if (end[2] >= mo_terrain_height(environment, end[0], end[1])) {
    d_end[2] += dp[2];
  } else {
    double slope[2];
    mo_terrain_gradient(environment, end[0], end[1], slope);
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
  place_adjoint(scheme, environment, impact, hit, g, p, v, d_hit, dg, d_impact, dp, dv);
}

/* Differentiates z = (1 − min(lost, |q|)/|q|) · q with respect to q; returns ∂loss/∂lost. `speed`:
 * |q|. If friction stops the mass, the derivative is 0. */
static double slow_adjoint(double lost, double speed, const double q[3], const double dz[3],
                           double dq[3])
{
  if (!(speed > 0) || lost >= speed) {
    for (int k = 0; k < 3 && !(lost > 0); k++)
      dq[k] += dz[k];
    return 0;
  }
  const double along = dot(q, dz) / speed, share = lost / speed;
  for (int k = 0; k < 3; k++)
    dq[k] += (1 - share) * dz[k] + share / speed * along * q[k];
  return -along;
}

/* Converts ∂loss/∂ the place and velocity at the end, d_end and de, to ∂loss/∂ the place of impact,
 * the velocity then, the acceleration, and the time of impact, which is returned. dg: ∂loss/∂ the
 * terrain's gradient. */
static double slide_adjoint(const struct mo_constants *constants, const struct split *s,
                            const double a[3], const double d_end[3], const double de[3],
                            double d_hit[3], double dw[3], double da[3], double dg[2])
{
  const double drag = constants->drag_per_s, half = 0.5 * s->rest, up = fmax(s->lift, 0);
  double dz[3], dy[3], dq[3] = {0, 0, 0}, dt[3] = {0, 0, 0}, dn[3], d_rest = 0, d_an = 0, d_wn = 0;
  /* end = hit + rest/2 · (y + z + up · n),   e = z + up · n */
  for (int k = 0; k < 3; k++) {
    d_hit[k] = d_end[k];
    d_rest += 0.5 * (s->y[k] + s->z[k] + up * s->n[k]) * d_end[k];
    dy[k] = half * d_end[k];
    dz[k] = half * d_end[k] + de[k];
    dn[k] = up * dz[k];
  }
  /* up = max(lift, 0),   press = max(−lift, 0) */
  double d_lift = s->lift > 0 ? dot(dz, s->n) : 0;
  const double d_lost = slow_adjoint(constants->friction * s->press, s->pace, s->q, dz, dq);
  if (s->lift < 0)
    d_lift -= constants->friction * d_lost;
  /* lift = b + after · (an − drag · b),   b = wn, or max(wn, 0) */
  if (s->lies || s->wn > 0)
    d_wn += (1 - s->after * drag) * d_lift;
  double d_after = (s->an - drag * s->b) * d_lift;
  d_an += s->after * d_lift;
  /* q = y + after · (a − an · n − drag · y) */
  for (int k = 0; k < 3; k++) {
    dy[k] += (1 - s->after * drag) * dq[k];
    d_after += (a[k] - s->an * s->n[k] - drag * s->y[k]) * dq[k];
    da[k] += s->after * dq[k];
    d_an -= s->after * s->n[k] * dq[k];
    dn[k] -= s->after * s->an * dq[k];
  }
  /* after = rest · (1 − bend · rest) */
  d_rest += (1 - 2 * s->bend * s->rest) * d_after;
  /* y = kept · t */
  const double slowed = constants->friction * fmax(-s->wn, 0),
               cap = constants->friction_cap * s->speed;
  if (s->lies) {
    memcpy(dt, dy, sizeof(dt));
  } else if (slowed < cap) {
    const double d_slowed = slow_adjoint(slowed, s->speed, s->t, dy, dt);
    d_wn -= s->wn < 0 ? constants->friction * d_slowed : 0;
  } else if (s->speed > 0) {
    for (int k = 0; k < 3; k++)
      dt[k] += s->kept * dy[k];
  }
  /* t = w − wn · n,   wn = w · n,   an = a · n */
  d_wn -= dot(dt, s->n);
  for (int k = 0; k < 3; k++) {
    dw[k] = dt[k] + d_wn * s->n[k];
    da[k] += d_an * s->n[k];
    dn[k] += d_wn * s->w[k] + d_an * a[k] - s->wn * dt[k];
  }
  /* n = (−g, 1) / length */
  const double along = dot(dn, s->n);
  for (int k = 0; k < 2; k++)
    dg[k] = -(dn[k] - along * s->n[k]) * s->n[2];
  return -d_rest; /* rest = dt − impact */
}

void mo_contact_split_adjoint(const struct mo_scheme *scheme, const struct mo_constants *constants,
                              const struct mo_environment *environment, double highest_m,
                              const double acceleration[3], const double position_m[3],
                              const double velocity_m_per_s[3], double d_position[3],
                              double d_velocity[3], double d_acceleration[3])
{
  const double dt = scheme->dt_s, drag = constants->drag_per_s;
  const double *p = position_m, *v = velocity_m_per_s, *a = acceleration;
  double *dp = d_position, *dv = d_velocity, *da = d_acceleration;
  const double next[3] = {p[0] + dt * v[0], p[1] + dt * v[1], p[2] + dt * v[2]};
  memset(da, 0, 3 * sizeof(*da));
  if (next[2] >= highest_m || !(next[2] < mo_terrain_height(environment, next[0], next[1]))) {
    for (int k = 0; k < 3; k++)
      dv[k] += dt * dp[k];
    return;
  }
  const struct split s = split_of(scheme, constants, environment, a, p, v);
  double d_end[3] = {dp[0], dp[1], 0}, de[3], d_hit[3], dw[3], dg[2];
  /* p[2] = max(end[2], h(end)) */
  if (s.end[2] >= mo_terrain_height(environment, s.end[0], s.end[1])) {
    d_end[2] = dp[2];
  } else {
    double slope[2];
    mo_terrain_gradient(environment, s.end[0], s.end[1], slope);
    d_end[0] += dp[2] * slope[0];
    d_end[1] += dp[2] * slope[1];
  }
  /* v = e + back · (a − drag · e) */
  for (int k = 0; k < 3; k++) {
    de[k] = (1 - s.back * drag) * dv[k];
    da[k] += s.back * dv[k];
    dp[k] = dv[k] = 0;
  }
  double d_impact = slide_adjoint(constants, &s, a, d_end, de, d_hit, dw, da, dg);
  /* w = v + before · (a − drag · v),   before = s · (1 − bend · s),   s = impact − dt/2 */
  const double rate = 1 - 2 * s.bend * (s.impact - 0.5 * dt);
  for (int k = 0; k < 3; k++) {
    dv[k] += (1 - s.before * drag) * dw[k];
    da[k] += s.before * dw[k];
    d_impact += rate * (a[k] - drag * v[k]) * dw[k];
  }
  place_adjoint(scheme, environment, s.impact, s.hit, s.g, p, v, d_hit, dg, d_impact, dp, dv);
}
