/* contact.c: one mass against the terrain.
 *
 * A mass moves on a straight segment p + τ v, 0 ≤ τ ≤ dt. Its gap is g(τ) = z(τ) − h(x(τ), y(τ)). Within one terrain cell
 *   h = h00 + a u + b w + c u w,   a = h10 − h00,  b = h01 − h00,  c = h11 − h10 − h01 + h00,
 * with u, w the fractions of the cell, linear in τ; so g is a quadratic A τ² + B τ + C. Its first root from ≥ 0 to < 0 is
 *   B < 0:  2C / (−B + sqrt(B² − 4AC))        (no cancellation; also right for A = 0)
 *   B ≥ 0:  (−B − sqrt(B² − 4AC)) / (2A)      (only A < 0 can come down again).
 * A segment that leaves its cell is cut where it crosses a border, and the pieces are tried in order. Beyond the map's edge the
 * height is constant along that axis: two more rows of "cells" with a slope of 0. */
#include "rollout/contact.h"

#include <math.h>

#define CELLS       (MO_TERRAIN_SIDE - 1)
#define CELLS_PER_M (CELLS / MO_TERRAIN_SIZE_M)

/* One horizontal axis of a segment, in units of cells. `cell`: −1 before the map, 0 … CELLS − 1 in it, CELLS beyond it. */
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

/* When the segment leaves the axis's present cell; infinity: never. */
static double leave_time(const struct axis *axis)
{
  if (axis->speed > 0 && axis->cell < CELLS)
    return (axis->cell + 1 - axis->start) / axis->speed;
  if (axis->speed < 0 && axis->cell >= 0)
    return (axis->cell - axis->start) / axis->speed;
  return INFINITY;
}

/* Fraction of the cell at time t, its rate, and the cell of the map whose heights count. */
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

/* First time ≥ 0 at which A t² + B t + C, C ≥ 0, turns negative; infinity: never. */
static double first_descent(double a, double b, double c)
{
  const double discriminant = b * b - 4 * a * c;
  if (b < 0)
    return discriminant < 0 ? INFINITY : 2 * c / (-b + sqrt(discriminant));
  return a < 0 ? (-b - sqrt(discriminant)) / (2 * a) : INFINITY; /* A < 0, C ≥ 0: the discriminant is ≥ 0 */
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
      const double gap = position_m[2] + velocity_m_per_s[2] * from - (h[0] + a * u + b * w + c * u * w);
      const double descent =
          first_descent(-c * du * dw, velocity_m_per_s[2] - a * du - b * dw - c * (u * dw + w * du), fmax(gap, 0));
      if (from + descent <= to)
        return from + descent;
      from = to;
    }
    /* Not `to >= dt` alone: with a speed that is not finite, no border is ever reached. */
    if (!(to < dt_s))
      return dt_s; /* below the terrain by rounding alone */
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

/* Drops the part of the velocity along the terrain's normal and slows the tangential part by friction. */
static void strike(const struct mo_physics *physics, const double gradient[2], double v[3])
{
  const double length = sqrt(gradient[0] * gradient[0] + gradient[1] * gradient[1] + 1.0);
  const double normal[3] = {-gradient[0] / length, -gradient[1] / length, 1.0 / length};
  const double vn = v[0] * normal[0] + v[1] * normal[1] + v[2] * normal[2];
  for (int axis = 0; axis < 3; axis++)
    v[axis] -= vn * normal[axis];
  const double vt = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
  const double lost = fmin(physics->friction * fabs(vn), physics->friction_cap * vt);
  const double scale = vt > 0 ? 1.0 - lost / vt : 0.0;
  for (int axis = 0; axis < 3; axis++)
    v[axis] *= scale;
}

void mo_contact_move(const struct mo_physics *physics, const double heights_m[MO_TERRAIN_HEIGHTS], double highest_m,
                     double position_m[3], double velocity_m_per_s[3])
{
  const double dt = physics->dt_s;
  double *p = position_m, *v = velocity_m_per_s;
  const double next[3] = {p[0] + dt * v[0], p[1] + dt * v[1], p[2] + dt * v[2]};
  if (next[2] >= highest_m || !(next[2] < mo_terrain_height(heights_m, next[0], next[1]))) {
    for (int axis = 0; axis < 3; axis++)
      p[axis] = next[axis];
    return;
  }
  const double impact = physics->impact == MO_IMPACT_EXACT
                            ? mo_impact_exact(heights_m, p, v, dt)
                            : mo_impact_bisection(heights_m, p, v, dt, physics->bisections);
  p[0] += impact * v[0];
  p[1] += impact * v[1];
  p[2] = mo_terrain_height(heights_m, p[0], p[1]);
  double gradient[2];
  mo_terrain_gradient(heights_m, p[0], p[1], gradient);
  strike(physics, gradient, v);
  const double rest = dt - impact;
  for (int axis = 0; axis < 3; axis++)
    p[axis] += rest * v[axis];
  p[2] = fmax(p[2], mo_terrain_height(heights_m, p[0], p[1]));
}
