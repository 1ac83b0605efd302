/* gradient-physics-both.h: the float32 physics of the fast gradient next to the float64 reference,
 * for the tests that compare them. */
#ifndef MORPHO_TESTS_GRADIENT_PHYSICS_BOTH_H
#define MORPHO_TESTS_GRADIENT_PHYSICS_BOTH_H

#include "gradient-cases.h"
#include "gradient-physics.h"
#include "rollout/adjoint.h"
#include "rollout/scene.h"

static const struct physics_functions *const functions[MO_ISA_COUNT] = {
    &physics_baseline, &physics_avx2, &physics_avx512};

/* Reference and fast path side by side. All arrays are (n_masses, 3), except the last three. */
struct both {
  const struct gradient_case *c;
  struct physics_scene scene;
  struct mo_reference reference;
  struct mo_step_tape tape;
  struct mo_adjoint adjoint;
  double *position, *velocity, *d_position, *d_velocity;
  struct physics_step fast;
  double *d_sensors, *fast_sensors, *fast_d_activation;
  bool *at_kink;                   /* (n_masses) */
  double *shift_m, *shift_m_per_s; /* changes that make the reference's contact take float32's
                                      branch; 0 except at kinks */
};

static inline void drop_reference(void *reference)
{
  mo_reference_done(reference);
}

static inline struct both *make_both(const struct gradient_case *c)
{
  const size_t n = 3 * (size_t)c->body->n_masses, springs = c->body->n_springs,
               tape = mo_controller_tape_doubles(c->controller, c->body->n_springs);
  struct both *b = make_zeros(1, sizeof(*b));
  b->c = c;
  b->scene = (struct physics_scene){c->body, &c->environment, &c->physics, c->controller->sensor};
  make_check(mo_reference_init(&b->reference, c->body, c->controller, &c->environment, &c->physics),
             "reference");
  check_keep(&b->reference, drop_reference);
  double **vectors[] = {&b->position,          &b->velocity,           &b->d_position,
                        &b->d_velocity,        &b->adjoint.d_position, &b->adjoint.d_velocity,
                        &b->adjoint.d_impulse, &b->tape.position_m,    &b->tape.velocity_m_per_s,
                        &b->fast.next_m,       &b->fast.next_m_per_s,  &b->fast.d_position,
                        &b->fast.d_velocity,   &b->d_sensors,          &b->fast_sensors,
                        &b->shift_m,           &b->shift_m_per_s};
  for (size_t i = 0; i < COUNT(vectors); i++)
    *vectors[i] = make_zeros(n, sizeof(double));
  b->at_kink = make_zeros(c->body->n_masses, sizeof(bool));
  b->adjoint.d_output = make_zeros(springs, sizeof(double));
  b->adjoint.d_previous = make_zeros(springs, sizeof(double));
  b->tape.acceleration = make_zeros(n, sizeof(double));
  b->tape.activation = make_zeros(springs, sizeof(double));
  b->tape.previous = make_zeros(springs, sizeof(double));
  b->fast_d_activation = make_zeros(springs, sizeof(double));
  b->adjoint.d_input = make_zeros(c->controller->n_inputs, sizeof(double));
  b->tape.control =
      mo_controller_tape_place(c->controller, c->body->n_springs, make_zeros(tape, sizeof(double)));
  b->reference.tape = &b->tape;
  b->fast.position_m = b->position;
  b->fast.velocity_m_per_s = b->velocity;
  b->fast.activation = b->tape.control.output;
  b->fast.sensors = b->fast_sensors;
  b->fast.d_sensors = b->d_sensors;
  b->fast.d_activation = b->fast_d_activation;
  return b;
}

/* Rounds to what float32 can represent. */
static inline double rounded(double x)
{
  return (double)(float)x;
}

/* Largest magnitude. */
static inline double size_of(const double *x, size_t n)
{
  double most = 0;
  for (size_t i = 0; i < n; i++)
    most = fmax(most, fabs(x[i]));
  return most;
}

static inline double distance(const double *a, const double *b)
{
  return fmax(fmax(fabs(a[0] - b[0]), fabs(a[1] - b[1])), fabs(a[2] - b[2]));
}

#endif
