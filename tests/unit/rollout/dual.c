/* dual.c: the second implementation, on dual numbers v + Σ t[k] ε_k, ε_j ε_k = 0: every operation
 * carries its derivatives along. */
#include "second.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

typedef struct dual num;

#define LANES(expression)                                                                          \
  for (int k = 0; k < SECOND_LANES; k++)                                                           \
    r.t[k] = (expression);                                                                         \
  return r

static inline num con(double x)
{
  return (num){.v = x};
}
static inline double val(num a)
{
  return a.v;
}
static inline num add(num a, num b)
{
  num r = {.v = a.v + b.v};
  LANES(a.t[k] + b.t[k]);
}
static inline num sub(num a, num b)
{
  num r = {.v = a.v - b.v};
  LANES(a.t[k] - b.t[k]);
}
static inline num mul(num a, num b)
{
  num r = {.v = a.v * b.v};
  LANES(a.t[k] * b.v + a.v * b.t[k]);
}
static inline num div_(num a, num b)
{
  num r = {.v = a.v / b.v};
  LANES((a.t[k] - r.v * b.t[k]) / b.v);
}
static inline num scaled(num a, double b)
{
  num r = {.v = a.v * b};
  LANES(a.t[k] * b);
}
static inline num root(num a)
{
  num r = {.v = sqrt(a.v)};
  LANES(a.t[k] / (2 * r.v));
}
static inline num exp_(num a)
{
  num r = {.v = exp(a.v)};
  LANES(a.t[k] * r.v);
}
static inline num tanh_(num a)
{
  num r = {.v = tanh(a.v)};
  LANES(a.t[k] * (1 - r.v * r.v));
}

static inline num log_(num a)
{
  num r = {.v = log(a.v)};
  LANES(a.t[k] / a.v);
}

static num parameter(const struct second_parameters *theta, size_t at, int lane)
{
  num r = con(theta->value[at]);
  r.t[lane] = theta->alone[at];
  for (int k = 0; k < SECOND_WHOLES; k++)
    r.t[SECOND_LANES - SECOND_WHOLES + k] = theta->whole[k][at];
  return r;
}

/* For each of two rows of weights: Σ_j weights[j] · in[j]: values in order, and for each lane
 * Σ_j weights[j] · in[j].t. Two rows at a time hide the latency of the sums. The compiler picks the
 * widest vectors of this machine at run time; lanes never mix, so the result is the same. */
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) &&                             \
    !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)
__attribute__((target_clones("avx512f", "avx2", "default")))
#endif
static void
weigh(const double *const weights[2], const num *in, uint32_t width, num sum[2])
{
  const double *const w0 = weights[0], *const w1 = weights[1];
  double v0 = 0, v1 = 0, t0[SECOND_LANES] = {0}, t1[SECOND_LANES] = {0};
  for (uint32_t j = 0; j < width; j++) {
    v0 += w0[j] * in[j].v;
    v1 += w1[j] * in[j].v;
    for (int k = 0; k < SECOND_LANES; k++) {
      t0[k] += w0[j] * in[j].t[k];
      t1[k] += w1[j] * in[j].t[k];
    }
  }
  sum[0].v = v0;
  sum[1].v = v1;
  memcpy(sum[0].t, t0, sizeof(t0));
  memcpy(sum[1].t, t1, sizeof(t1));
}

/* The matrix starts at parameter `at` and has `height` rows, followed by its biases. Only the n
 * `rows` (NULL: 0 …) are computed. Lane `lane` perturbs the matrix, lane + 1 its biases. */
static void dense(const struct second_parameters *theta, size_t at, int lane, uint32_t height,
                  const uint32_t *rows, uint32_t n, uint32_t width, const num *in, num *out)
{
  const size_t biases = at + (size_t)height * width;
  num sums[2];
  for (uint32_t i = 0; i < n; i++) {
    const uint32_t row = rows != NULL ? rows[i] : i;
    const uint32_t next = i + 1 == n ? row : rows != NULL ? rows[i + 1] : i + 1;
    const size_t begin = at + (size_t)row * width;
    if (i % 2 == 0)
      weigh(
          (const double *const[2]){theta->value + begin, theta->value + at + (size_t)next * width},
          in, width, sums);
    num sum = sums[i % 2];
    double alone = 0, whole[SECOND_WHOLES] = {0};
    for (uint32_t j = 0; j < width; j++) {
      alone += theta->alone[begin + j] * in[j].v;
      for (int k = 0; k < SECOND_WHOLES; k++)
        whole[k] += theta->whole[k][begin + j] * in[j].v;
    }
    sum.t[lane] += alone;
    for (int k = 0; k < SECOND_WHOLES; k++)
      sum.t[SECOND_LANES - SECOND_WHOLES + k] += whole[k];
    out[i] = add(sum, parameter(theta, biases + row, lane + 1));
  }
}

static num square_sum(const num d[3])
{
  return add(add(mul(d[0], d[0]), mul(d[1], d[1])), mul(d[2], d[2]));
}

static num dot3(const num a[3], const num b[3])
{
  return add(add(mul(a[0], b[0]), mul(a[1], b[1])), mul(a[2], b[2]));
}

#include "dual_ground.inc"

/* ---- the rollout ---- */

/* Where the task is at an instant. */
struct course {
  double start[3]; /* center of mass */
  num com[3];
  double facing[2];
  num along, last[2]; /* last: center of mass at the instant before */
  double before;      /* length of the finished legs */
  uint32_t leg, n;
  double distance;                        /* to the light at the start */
  num way, away, off, path, height, work; /* sums that the terms of a task need */
  num soft;    /* of exp((height − that at the start) / 0.02 m) where heights count */
  double peak; /* the largest of these heights */
  uint32_t n_heights;
};

struct second {
  const struct second_setup *setup;
  const struct second_parameters *theta;
  uint32_t n_inputs, n_springs; /* of the lattice */
  double highest;
  num light[3];
  struct course course;
  num *p, *v, *impulse, *input, *hidden, *activation;
  num *previous; /* activation before the last control; then its mean with the new one */
  const num *activation_now; /* that the springs use in this step */
};

static num light_at(const struct second *s, const num *p)
{
  const num d[3] = {sub(p[0], s->light[0]), sub(p[1], s->light[1]), sub(p[2], s->light[2])};
  const num distance = root(square_sum(d));
  if (s->setup->sensor == MO_SENSOR_INVERSE_SQUARE)
    return div_(con(1), add(mul(distance, distance), con(1e-4)));
  return div_(con(1), add(root(add(distance, con(1e-8))), con(1e-8)));
}

static void sense_all(struct second *s, uint32_t step)
{
  const struct mo_body *body = s->setup->body;
  num mean = con(0);
  for (uint32_t i = 0; i < body->n_masses; i++) {
    s->input[body->mass_lattice[i]] = light_at(s, s->p + 3 * i);
    mean = add(mean, s->input[body->mass_lattice[i]]);
  }
  mean = div_(mean, con(body->n_masses));
  for (uint32_t i = 0; i < body->n_masses; i++)
    s->input[body->mass_lattice[i]] = sub(s->input[body->mass_lattice[i]], mean);
  const double t = step * s->setup->physics->scheme.dt_s;
  for (int k = 0; k < 5; k++)
    s->input[s->n_inputs - 5 + (uint32_t)k] = con(sin(10.0 * t + 2.0 * M_PI * k / 5));
}

/* LayerNorm and ReLU of the 256 numbers in h; gain and shift start at parameter `at`, lanes `lane`
 * and lane + 1. */
static void normalize(const struct second *s, size_t at, int lane, num *h)
{
  num mean = con(0), variance = con(0);
  for (int i = 0; i < 256; i++)
    mean = add(mean, h[i]);
  mean = div_(mean, con(256));
  for (int i = 0; i < 256; i++) {
    const num d = sub(h[i], mean);
    variance = add(variance, mul(d, d));
  }
  variance = div_(variance, con(256));
  const num scale = div_(con(1), root(add(variance, con(1e-5))));
  for (size_t i = 0; i < 256; i++) {
    const num y = add(mul(mul(sub(h[i], mean), scale), parameter(s->theta, at + i, lane)),
                      parameter(s->theta, at + 256 + i, lane + 1));
    h[i] = val(y) > 0 ? y : con(0);
  }
}

static void control_all(struct second *s)
{
  const struct mo_body *body = s->setup->body;
  const num *in = s->input;
  uint32_t width = s->n_inputs;
  size_t at = 0;
  for (int l = 0; l < 3; l++) {
    num *h = s->hidden + (l % 2) * 256;
    dense(s->theta, at, 4 * l, 256, NULL, 256, width, in, h);
    at += 256 * (size_t)width + 256;
    normalize(s, at, 4 * l + 2, h);
    at += 512;
    in = h;
    width = 256;
  }
  dense(s->theta, at, 12, s->n_springs, body->spring_lattice, body->n_springs, 256, in,
        s->activation);
  for (uint32_t i = 0; i < body->n_springs; i++)
    s->activation[i] = tanh_(s->activation[i]);
}

/* Returns whether spring k is in an octant, by the middle of the spring and that of the body. */
static bool is_inside(const struct mo_body *body, uint32_t k, unsigned octant)
{
  for (int axis = 0; axis < 3; axis++) {
    double low = INFINITY, high = 0;
    for (uint32_t i = 0; i < body->n_masses; i++) {
      low = fmin(low, body->mass_xyz[3 * i + axis]);
      high = fmax(high, body->mass_xyz[3 * i + axis]);
    }
    const double middle = (body->mass_xyz[3 * body->spring_a[k] + axis] +
                           body->mass_xyz[3 * body->spring_b[k] + axis]) /
                          2.0;
    if ((middle >= (low + high) / 2) != (octant >> axis & 1))
      return false;
  }
  return true;
}

/* Work of the actuators: the energy that new outputs give to springs, where they give some. */
static void add_work(struct second *s, uint32_t step)
{
  const struct mo_body *body = s->setup->body;
  const struct mo_physics *physics = s->setup->physics;
  const struct mo_damage *damage = &s->setup->environment->damage;
  const bool broken = damage->cut != 0 && step * physics->scheme.dt_s > damage->time_s - 1e-9;
  for (uint32_t k = 0; k < body->n_springs; k++) {
    if (broken && is_inside(body, k, damage->cut - 1))
      continue;
    const num *a = s->p + 3 * body->spring_a[k], *b = s->p + 3 * body->spring_b[k];
    const num d[3] = {sub(a[0], b[0]), sub(a[1], b[1]), sub(a[2], b[2])};
    const num length = root(square_sum(d));
    const double rest = body->spring_rest_m[k], reach = rest * physics->constants.actuation;
    const num before = sub(sub(length, con(rest)), scaled(s->previous[k], reach));
    const num after = sub(sub(length, con(rest)), scaled(s->activation[k], reach));
    const num gain = sub(mul(after, after), mul(before, before));
    if (val(gain) > 0)
      s->course.work = add(s->course.work, scaled(gain, physics->constants.stiffness_n_per_m / 2));
  }
}

static void control_step(struct second *s, uint32_t step, bool computes)
{
  const uint32_t n = s->setup->body->n_springs;
  s->activation_now = s->activation;
  if (!computes)
    return;
  memcpy(s->previous, s->activation, n * sizeof(num));
  sense_all(s, step);
  control_all(s);
  if (step > 0)
    add_work(s, step);
  if (s->setup->physics->scheme.integrator != MO_INTEGRATOR_SPLIT || step == 0)
    return;
  for (uint32_t i = 0; i < n; i++)
    s->previous[i] = scaled(add(s->activation[i], s->previous[i]), 0.5);
  s->activation_now = s->previous;
}

static void pull_all(struct second *s, uint32_t step)
{
  const struct mo_body *body = s->setup->body;
  const struct mo_physics *physics = s->setup->physics;
  for (uint32_t k = 0; k < 3 * body->n_masses; k++)
    s->impulse[k] = con(0);
  const struct mo_damage *damage = &s->setup->environment->damage;
  const bool broken = damage->cut != 0 && step * physics->scheme.dt_s > damage->time_s - 1e-9;
  for (uint32_t k = 0; k < body->n_springs; k++) {
    if (broken && is_inside(body, k, damage->cut - 1))
      continue;
    const num *a = s->p + 3 * body->spring_a[k], *b = s->p + 3 * body->spring_b[k];
    const num d[3] = {sub(a[0], b[0]), sub(a[1], b[1]), sub(a[2], b[2])};
    const num length = root(square_sum(d));
    const num stretch = add(con(1), scaled(s->activation_now[k], physics->constants.actuation));
    const num rest = scaled(stretch, body->spring_rest_m[k]);
    const num pull =
        div_(scaled(sub(length, rest), physics->scheme.dt_s * physics->constants.stiffness_n_per_m),
             add(length, con(1e-8)));
    for (int axis = 0; axis < 3; axis++) {
      num *ja = s->impulse + 3 * body->spring_a[k] + axis,
          *jb = s->impulse + 3 * body->spring_b[k] + axis;
      *ja = sub(*ja, mul(pull, d[axis]));
      *jb = add(*jb, mul(pull, d[axis]));
    }
  }
}

static void move_all(struct second *s)
{
  const struct mo_physics *physics = s->setup->physics;
  const double keep = exp(-physics->constants.drag_per_s * physics->scheme.dt_s);
  for (uint32_t i = 0; i < s->setup->body->n_masses; i++) {
    num *v = s->v + 3 * i;
    for (int axis = 0; axis < 3; axis++)
      v[axis] = add(scaled(v[axis], keep),
                    div_(s->impulse[3 * i + axis], con(physics->constants.mass_kg)));
    v[2] = sub(v[2], con(physics->constants.gravity_m_per_s2 * physics->scheme.dt_s));
    (void)move(s->setup, s->highest, s->p + 3 * i, v);
  }
}

/* The first step starts from rest: v is 0. */
static void move_all_split(struct second *s, bool first)
{
  const struct mo_constants *constants = &s->setup->physics->constants;
  const double dt = s->setup->physics->scheme.dt_s, fade = constants->drag_per_s * dt;
  const double keep = exp(-fade), reach = first ? fade / 2 : fade;
  const double phi = fade > 0 ? -expm1(-reach) / fade : first ? 0.5 : 1;
  for (uint32_t i = 0; i < s->setup->body->n_masses; i++) {
    num *v = s->v + 3 * i, a[3];
    for (int axis = 0; axis < 3; axis++)
      a[axis] = div_(s->impulse[3 * i + axis], con(constants->mass_kg * dt));
    a[2] = sub(a[2], con(constants->gravity_m_per_s2));
    for (int axis = 0; axis < 3; axis++)
      v[axis] = add(scaled(v[axis], keep), scaled(a[axis], phi * dt));
    (void)move_split(s->setup, s->highest, a, s->p + 3 * i, v);
  }
}

/* ---- the task ---- */

static num length_of(num x, num y)
{
  return root(add(mul(x, x), mul(y, y)));
}

static num distance_to_light(const struct second *s)
{
  const num *com = s->course.com;
  return length_of(sub(com[0], s->light[0]), sub(com[1], s->light[1]));
}

static const double *corner(const struct second *s, uint32_t k)
{
  return k == 0 ? s->course.start : s->setup->environment->task.guide.points_m[k - 1];
}

/* Returns the length of the leg, and faces along it. */
static double face_leg(struct second *s)
{
  const double *a = corner(s, s->course.leg), *b = corner(s, s->course.leg + 1);
  const double length = hypot(b[0] - a[0], b[1] - a[1]);
  for (int k = 0; k < 2; k++)
    s->course.facing[k] = length > 0 ? (b[k] - a[k]) / length : 0;
  return length;
}

static num along_leg(const struct second *s)
{
  const double *a = corner(s, s->course.leg), *e = s->course.facing;
  return add(scaled(sub(s->course.com[0], con(a[0])), e[0]),
             scaled(sub(s->course.com[1], con(a[1])), e[1]));
}

/* Returns the distance from the leg. */
static num off_leg(const struct second *s, double length)
{
  const double *a = corner(s, s->course.leg), *e = s->course.facing;
  num near = along_leg(s);
  near = val(near) < 0 ? con(0) : val(near) > length ? con(length) : near;
  return length_of(sub(s->course.com[0], add(con(a[0]), scaled(near, e[0]))),
                   sub(s->course.com[1], add(con(a[1]), scaled(near, e[1]))));
}

static void place_on_path(struct second *s)
{
  const struct mo_guide *guide = &s->setup->environment->task.guide;
  struct course *c = &s->course;
  double length = face_leg(s);
  while (c->leg + 1 < guide->n_points && hypot(val(c->com[0]) - corner(s, c->leg + 1)[0],
                                               val(c->com[1]) - corner(s, c->leg + 1)[1]) <= 0.2) {
    c->before += length;
    c->along = con(0);
    c->leg++;
    length = face_leg(s);
  }
  num near = along_leg(s);
  near = val(near) > length ? con(length) : near;
  c->along = val(near) > val(c->along) ? near : c->along;
  num lead = add(c->along, con(guide->distance_m));
  lead = val(lead) < length ? lead : con(length);
  for (int k = 0; k < 2; k++)
    s->light[k] = add(con(corner(s, c->leg)[k]), scaled(lead, c->facing[k]));
}

static void place_light(struct second *s, double t)
{
  const struct mo_environment *environment = s->setup->environment;
  const struct mo_guide *guide = &environment->task.guide;
  struct course *c = &s->course;
  const double *l = environment->light_xy_m, *z = guide->center_m, *v = guide->velocity_m_per_s;
  const double turn = guide->turn_rad_per_s * t;
  if (guide->kind == MO_GUIDE_FIXED || guide->kind == MO_GUIDE_MOVING) {
    s->light[0] = con(l[0]);
    s->light[1] = con(l[1]);
  }
  if (guide->kind == MO_GUIDE_MOVING) {
    const double x = l[0] - z[0], y = l[1] - z[1];
    s->light[0] = con(z[0] + v[0] * t + x * cos(turn) - y * sin(turn));
    s->light[1] = con(z[1] + v[1] * t + x * sin(turn) + y * cos(turn));
  } else if (guide->kind == MO_GUIDE_AHEAD || guide->kind == MO_GUIDE_TURNING) {
    const double heading = guide->heading_rad + (guide->kind == MO_GUIDE_TURNING ? turn : 0);
    c->facing[0] = cos(heading);
    c->facing[1] = sin(heading);
    for (int k = 0; k < 2; k++)
      s->light[k] = add(c->com[k], con(guide->distance_m * c->facing[k]));
  } else if (guide->kind == MO_GUIDE_PATH) {
    place_on_path(s);
  }
  s->light[2] = terrain(environment, s->light[0], s->light[1], NULL, NULL);
}

static bool has_term(const struct mo_task *task, uint32_t term)
{
  for (uint32_t i = 0; i < task->n_terms; i++)
    if (task->terms[i] == term)
      return true;
  return (uint32_t)task->objective == term;
}

static num height_of(const struct second *s)
{
  const struct course *c = &s->course;
  return sub(c->com[2], terrain(s->setup->environment, c->com[0], c->com[1], NULL, NULL));
}

/* The roots of distances that are 0 have no derivative: only those that count are taken. */
static void add_distances(struct second *s)
{
  static const uint32_t paths[] = {MO_MEASURE_PATH_LENGTH, MO_MEASURE_MEAN_SPEED,
                                   MO_MEASURE_STRAIGHTNESS};
  const struct mo_task *task = &s->setup->environment->task;
  struct course *c = &s->course;
  if (has_term(task, MO_OBJECTIVE_APPROACH) || has_term(task, MO_OBJECTIVE_PURSUE))
    c->away = add(c->away, distance_to_light(s));
  if (has_term(task, MO_OBJECTIVE_FOLLOW))
    c->off = add(c->off, off_leg(s, face_leg(s)));
  for (int i = 0; i < 3; i++)
    if (has_term(task, MO_TERM_MEASURE + paths[i])) {
      c->path = add(c->path, length_of(sub(c->com[0], c->last[0]), sub(c->com[1], c->last[1])));
      break;
    }
}

/* An instant at time t: places the light, and adds to the sums. end: of the rollout. */
static void instant(struct second *s, double t, bool first, bool end)
{
  const uint32_t n = s->setup->body->n_masses;
  struct course *c = &s->course;
  const num before[2] = {c->com[0], c->com[1]};
  for (int axis = 0; axis < 3; axis++) {
    c->com[axis] = con(0);
    for (uint32_t i = 0; i < n; i++)
      c->com[axis] = add(c->com[axis], s->p[3 * i + axis]);
    c->com[axis] = div_(c->com[axis], con(n));
    if (first)
      c->start[axis] = val(c->com[axis]);
  }
  c->last[0] = before[0];
  c->last[1] = before[1];
  for (int k = 0; k < 2 && !first; k++)
    c->way = add(c->way, scaled(sub(c->com[k], before[k]), c->facing[k]));
  place_light(s, t);
  if (first) {
    c->before = -val(c->along);
    c->distance = val(distance_to_light(s)) + 1e-8;
    return;
  }
  c->n++;
  add_distances(s);
  c->height = add(c->height, height_of(s));
  if (t > 0.4 - 1e-9 || end) {
    const num height = sub(c->com[2], con(c->start[2]));
    c->peak = c->n_heights++ == 0 ? val(height) : fmax(c->peak, val(height));
    c->soft = add(c->soft, exp_(scaled(height, 1 / 0.02)));
  }
}

/* The value of a term at the end, with the smooth maximum of heights; *truth: with the true one. */
static num value_of(const struct second *s, double t, uint32_t term, double *truth)
{
  const struct course *c = &s->course;
  const double n = c->n;
  num value = con(NAN);
  num way = con(0);
  if (term == MO_OBJECTIVE_EFFICIENT || term == MO_OBJECTIVE_JUMP ||
      term == MO_TERM_MEASURE + MO_MEASURE_DISPLACEMENT ||
      term == MO_TERM_MEASURE + MO_MEASURE_STRAIGHTNESS)
    way = length_of(sub(c->com[0], con(c->start[0])), sub(c->com[1], con(c->start[1])));
  switch (term) {
  case MO_OBJECTIVE_REACH: value = sub(con(1), div_(distance_to_light(s), con(c->distance))); break;
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE: value = sub(con(1), scaled(c->away, 1 / (c->distance * n))); break;
  case MO_OBJECTIVE_TRAVEL: value = c->way; break;
  case MO_OBJECTIVE_FOLLOW:
    value = sub(add(c->along, con(c->before)), scaled(c->off, 1 / n));
    break;
  case MO_OBJECTIVE_CLIMB: value = sub(c->com[2], con(c->start[2])); break;
  case MO_OBJECTIVE_EFFICIENT: {
    const num kilo = scaled(val(c->work) > 1 ? c->work : con(1), 1e-3);
    value = val(way) > 0.2 ? div_(sub(way, con(0.2)), kilo) : con(0);
    break;
  }
  case MO_OBJECTIVE_JUMP:
    value = sub(scaled(log_(scaled(c->soft, 1.0 / c->n_heights)), 0.02), scaled(way, 0.5));
    *truth = c->peak - 0.5 * val(way);
    return value;
  case MO_TERM_MEASURE + MO_MEASURE_DISPLACEMENT: value = way; break;
  case MO_TERM_MEASURE + MO_MEASURE_PATH_LENGTH: value = c->path; break;
  case MO_TERM_MEASURE + MO_MEASURE_MEAN_SPEED: value = scaled(c->path, 1 / t); break;
  case MO_TERM_MEASURE + MO_MEASURE_STRAIGHTNESS: value = div_(way, c->path); break;
  case MO_TERM_MEASURE + MO_MEASURE_MEAN_HEIGHT: value = scaled(c->height, 1 / n); break;
  case MO_TERM_MEASURE + MO_MEASURE_WORK: value = c->work; break;
  }
  *truth = val(value);
  return value;
}

/* The loss if the rollout ends at time t: its value has the true maximum of heights, its
 * derivatives are those with the smooth one. */
static num loss_at(const struct second *s, double t)
{
  struct second end = *s;
  const struct mo_task *task = &s->setup->environment->task;
  double scale = 1, truth = 0, part;
  instant(&end, t, t == 0, true);
  switch (task->objective) {
  case MO_OBJECTIVE_REACH: return div_(distance_to_light(&end), con(end.course.distance));
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE:
    return scaled(end.course.away, 1 / (end.course.distance * end.course.n));
  case MO_OBJECTIVE_CLIMB:
  case MO_OBJECTIVE_JUMP:
  case MO_OBJECTIVE_EFFICIENT: scale = 0.1; break;
  case MO_OBJECTIVE_TRAVEL:
  case MO_OBJECTIVE_FOLLOW:
  case MO_OBJECTIVE_SUM: break;
  }
  num value = con(0);
  if (task->objective != MO_OBJECTIVE_SUM)
    value = value_of(&end, t, task->objective, &truth);
  for (uint32_t i = 0; i < task->n_terms; i++) {
    value = add(value, scaled(value_of(&end, t, task->terms[i], &part), task->weights[i]));
    truth += task->weights[i] * part;
  }
  num loss = exp_(scaled(value, -1 / scale));
  if (has_term(task, MO_OBJECTIVE_JUMP))
    loss.v = exp(-truth / scale);
  return loss;
}

/* ---- the start and the run ---- */

/* Lifted until every mass is on or above the ground. */
static void place_body(struct second *s)
{
  const struct mo_body *body = s->setup->body;
  int lowest = 65535;
  for (uint32_t i = 0; i < body->n_masses; i++)
    lowest = body->mass_xyz[3 * i + 2] < lowest ? body->mass_xyz[3 * i + 2] : lowest;
  double lift = -1e300;
  for (uint32_t i = 0; i < body->n_masses; i++) {
    const uint16_t *at = body->mass_xyz + 3 * i;
    num *p = s->p + 3 * i;
    p[0] = con(2.5 - 0.5 * 0.1 * body->workspace.nx + 0.1 * at[0]);
    p[1] = con(2.5 - 0.5 * 0.1 * body->workspace.ny + 0.1 * at[1]);
    p[2] = con(0.1 * (at[2] - lowest));
    lift = fmax(lift, val(sub(terrain(s->setup->environment, p[0], p[1], NULL, NULL), p[2])));
  }
  for (uint32_t i = 0; i < body->n_masses; i++)
    s->p[3 * i + 2] = add(s->p[3 * i + 2], con(lift + s->setup->physics->drop_height_m));
}

static double highest_of(const struct mo_environment *e)
{
  double highest = e->terrain_heights_m[0];
  for (uint32_t k = 0; e->grid != NULL && k < e->grid->columns * e->grid->rows; k++)
    highest = k == 0 ? e->grid->heights_m[0] : fmax(highest, e->grid->heights_m[k]);
  if (e->grid != NULL)
    return highest;
  for (uint32_t k = 1; k < (e->n_profile != 0 ? e->n_profile : 64); k++)
    highest = fmax(highest, e->terrain_heights_m[k]);
  return highest;
}

int dual_rollout(const struct second_setup *setup, const struct second_parameters *theta,
                 const uint32_t *at, uint32_t n, struct dual *losses)
{
  const struct mo_body *body = setup->body;
  struct second s = {.setup = setup, .theta = theta};
  s.n_inputs = mo_workspace_masses(body->workspace) + 5;
  s.n_springs = mo_workspace_springs(body->workspace);
  s.highest = highest_of(setup->environment);
  num *memory = calloc(9 * (size_t)body->n_masses + s.n_inputs + 512 + 2 * (size_t)body->n_springs,
                       sizeof(num));
  if (memory == NULL)
    return -1;
  s.p = memory;
  s.v = s.p + 3 * body->n_masses;
  s.impulse = s.v + 3 * body->n_masses;
  s.input = s.impulse + 3 * body->n_masses;
  s.hidden = s.input + s.n_inputs;
  s.activation = s.hidden + 512;
  s.previous = s.activation + body->n_springs;
  place_body(&s);
  instant(&s, 0, true, false);
  const struct mo_scheme *scheme = &setup->physics->scheme;
  const long held =
      scheme->control_period_s > 0 ? lround(scheme->control_period_s / scheme->dt_s) : 1;
  uint32_t reported = 0;
  for (uint32_t step = 0; step <= setup->physics->scheme.n_steps; step++) {
    while (reported < n && at[reported] == step)
      losses[reported++] = loss_at(&s, step * scheme->dt_s);
    if (step == setup->physics->scheme.n_steps)
      break;
    if (step > 0 && step % held == 0)
      instant(&s, step * scheme->dt_s, false, false);
    control_step(&s, step, step % held == 0);
    pull_all(&s, step);
    if (scheme->integrator == MO_INTEGRATOR_SPLIT)
      move_all_split(&s, step == 0);
    else
      move_all(&s);
  }
  free(memory);
  return 0;
}

uint64_t dual_move(const struct second_setup *setup, struct dual p[3], struct dual v[3],
                   const struct dual acceleration[3])
{
  const double highest = highest_of(setup->environment);
  return setup->physics->scheme.integrator == MO_INTEGRATOR_SPLIT
             ? move_split(setup, highest, acceleration, p, v)
             : move(setup, highest, p, v);
}
