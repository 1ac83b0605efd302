/* ledger.h: scenes for tests that compare the reference with closed forms of the continuous motion,
 * for both integrators, and the orders of their errors.
 *
 * Errors of order p shrink by 2^p if the step is halved. Each row of the tables shows the errors at
 * a step and at two halves of it, and the order that the last two give. What a scheme keeps
 * exactly, up to rounding, has no order, and is checked with a fixed tolerance.
 *
 * Velocities: `paper` has them at the end of a step. `split` has them in the middle; at the start
 * of a step they are the mean of the middles before and after, to second order. The first step of
 * `split` expects velocities at the start of the step; drag must be 0 unless they are 0.
 *
 * A body without stiffness is eight separate masses: the closed forms of one mass then hold
 * exactly, and each mass meets the ground in another part of a step. */
#ifndef MORPHO_TESTS_LEDGER_H
#define MORPHO_TESTS_LEDGER_H

#include "../make.h"

#include "rollout/reference.h"

#define GRAVITY_M_PER_S2 9.8
#define POINTS           8

static const struct mo_workspace one = {1, 1, 1};

struct scene {
  const struct mo_body *body;
  struct mo_environment environment;
  struct mo_physics physics;
  struct mo_reference r;
  uint32_t step;
  double *before_m_per_s; /* (n_masses, 3) velocities before the last step */
  double *start_m_per_s;  /* (n_masses, 3) velocities at the time when the last step started */
};

static inline void drop_reference(void *reference)
{
  mo_reference_done(reference);
}

/* Heights z = slope · (x − 2.5 m). */
static inline struct mo_environment plane_of(double slope)
{
  struct mo_environment environment = {.light_xy_m = {4.5, 2.5}};
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
    environment.terrain_heights_m[k] =
        slope *
        (MO_TERRAIN_SIZE_M / (MO_TERRAIN_SIDE - 1) * (k % MO_TERRAIN_SIDE) - MO_WORLD_CENTER_M);
  return environment;
}

/* Without drag. */
static inline struct mo_physics scheme_of(enum mo_integrator integrator, double dt_s)
{
  struct mo_physics physics = mo_paper_physics();
  physics.scheme.integrator = integrator;
  physics.scheme.dt_s = dt_s;
  physics.constants.drag_per_s = 0;
  return physics;
}

static inline struct scene *make_scene(const struct mo_body *body,
                                       struct mo_environment environment, struct mo_physics physics)
{
  struct scene *s = make_zeros(1, sizeof(*s));
  s->body = body;
  s->environment = environment;
  s->physics = physics;
  s->before_m_per_s = make_zeros(3 * (size_t)s->body->n_masses, sizeof(double));
  s->start_m_per_s = make_zeros(3 * (size_t)s->body->n_masses, sizeof(double));
  make_check(mo_reference_init(&s->r, s->body, NULL, &s->environment, &s->physics), "reference");
  check_keep(&s->r, drop_reference);
  return s;
}

/* A full workspace 100 m above flat ground. */
static inline struct scene *make_flight(struct mo_workspace workspace, struct mo_physics physics)
{
  physics.drop_height_m = 100;
  return make_scene(make_full_body(make_lattice(workspace)), plane_of(0), physics);
}

/* Eight separate masses. */
static inline struct scene *make_points(double slope, struct mo_physics physics)
{
  physics.constants.stiffness_n_per_m = 0;
  return make_scene(make_full_body(make_lattice(one)), plane_of(slope), physics);
}

static inline void advance(struct scene *s)
{
  const size_t n = 3 * (size_t)s->body->n_masses;
  memcpy(s->before_m_per_s, s->r.velocity_m_per_s, n * sizeof(double));
  make_check(mo_reference_step(&s->r, s->step) ? MO_OK : MO_ERR_RANGE, "a step diverged");
  const bool is_mean = s->physics.scheme.integrator == MO_INTEGRATOR_SPLIT && s->step > 0;
  for (size_t k = 0; k < n; k++)
    s->start_m_per_s[k] = is_mean ? 0.5 * (s->before_m_per_s[k] + s->r.tape->velocity_m_per_s[k])
                                  : s->before_m_per_s[k];
  s->step++;
}

static inline uint32_t steps_in(const struct scene *s, double time_s)
{
  return (uint32_t)lrint(time_s / s->physics.scheme.dt_s);
}

static inline void advance_for(struct scene *s, double time_s)
{
  for (uint32_t n = steps_in(s, time_s); n > 0; n--)
    advance(s);
}

/* Returns the mean of all masses along an axis of an array (n_masses, 3). */
static inline double mean_of(const struct scene *s, const double *values, int axis)
{
  double sum = 0;
  for (uint32_t i = 0; i < s->body->n_masses; i++)
    sum += values[3 * i + axis];
  return sum / s->body->n_masses;
}

static inline void shake(const struct scene *s, double *values, double size, uint64_t seed)
{
  struct mo_random random = dice(seed, 0, 0);
  for (uint32_t k = 0; k < 3 * s->body->n_masses; k++)
    values[k] += size * mo_random_normal(&random);
}

/* Moves each corner of a voxel by q along all three axes, away from the middle. */
static inline void inflate(struct scene *s, double q_m)
{
  for (uint32_t k = 0; k < 3 * s->body->n_masses; k++)
    s->r.position_m[k] += s->body->mass_xyz[k] ? q_m : -q_m;
}

/* ---- orders ---- */

typedef double (*measure)(enum mo_integrator integrator, double dt_s);

struct expected {
  double order, largest; /* observed order; error at the largest step */
};

static inline double measure_order(const char *what, const char *scheme, const double error[3],
                                   double dt_s)
{
  const double order = log2(error[1] / error[2]);
  printf("# %-34s %-5s %5.2f ms  %8.1e %8.1e %8.1e  order %5.2f\n", what, scheme, 1e3 * dt_s,
         error[0], error[1], error[2], order);
  return order;
}

/* slack: of the order. Where masses meet the ground, errors depend on the part of a step in which
 * they do. */
static inline void compare(const char *what, measure error_of, double dt_s, double slack,
                           struct expected paper, struct expected split)
{
  static const char *const names[] = {"paper", "split"};
  const struct expected expected[] = {paper, split};
  for (int i = 0; i < 2; i++) {
    double error[3];
    for (int k = 0; k < 3; k++)
      error[k] = error_of((enum mo_integrator)i, ldexp(dt_s, -k));
    const double order = measure_order(what, names[i], error, dt_s);
    CHECK(order >= expected[i].order - slack);
    CHECK(error[0] <= expected[i].largest);
  }
}

#endif
