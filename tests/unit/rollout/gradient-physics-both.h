/* gradient-physics-both.h: the float32 physics of the fast gradient beside the float64 reference,
 * for their tests. */
#ifndef MORPHO_TESTS_GRADIENT_PHYSICS_BOTH_H
#define MORPHO_TESTS_GRADIENT_PHYSICS_BOTH_H

#include <math.h>
#include <stdlib.h>

#include "gradient-cases.h"
#include "gradient-physics.h"
#include "rollout/adjoint.h"
#include "rollout/scene.h"

static const struct physics_functions *const functions[MO_ISA_COUNT] = {
    &physics_baseline, &physics_avx2, &physics_avx512};

/* Reference and fast path side by side. All arrays are (n_masses, 3) but the last three. */
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
  double *shift_m, *shift_m_per_s; /* where the reference's contact takes the branch that float32
                                      took; 0 but at kinks */
  double *memory;
};

static inline void both_free(struct both *b)
{
  mo_reference_done(&b->reference);
  free(b->memory);
  free(b->at_kink);
}

static inline bool both_create(const struct gradient_case *c, struct both *b)
{
  const size_t n = 3 * (size_t)c->body->n_masses, springs = c->body->n_springs;
  *b = (struct both){.c = c};
  b->scene = (struct physics_scene){c->body, &c->environment, &c->physics, c->controller->sensor};
  if (mo_reference_init(&b->reference, c->body, c->controller, &c->environment, &c->physics) < 0)
    return false;
  const size_t tape = mo_controller_tape_doubles(c->controller, c->body->n_springs);
  b->memory = calloc(19 * n + tape + 3 * springs + c->controller->n_inputs, sizeof(double));
  b->at_kink = calloc(c->body->n_masses, sizeof(bool));
  if (b->memory == NULL || b->at_kink == NULL) {
    both_free(b);
    return false;
  }
  double *at = b->memory;
  double **vectors[] = {&b->position,          &b->velocity,           &b->d_position,
                        &b->d_velocity,        &b->adjoint.d_position, &b->adjoint.d_velocity,
                        &b->adjoint.d_impulse, &b->tape.position_m,    &b->tape.velocity_m_per_s,
                        &b->fast.next_m,       &b->fast.next_m_per_s,  &b->fast.d_position,
                        &b->fast.d_velocity,   &b->d_sensors,          &b->fast_sensors,
                        &b->shift_m,           &b->shift_m_per_s};
  for (size_t i = 0; i < sizeof(vectors) / sizeof(vectors[0]); i++, at += n)
    *vectors[i] = at;
  b->adjoint.d_activation = at;
  b->fast_d_activation = at + springs;
  b->adjoint.d_input = at + 2 * springs;
  b->tape.control = mo_controller_tape_place(c->controller, c->body->n_springs,
                                             at + 2 * springs + c->controller->n_inputs);
  b->reference.tape = &b->tape;
  return true;
}

/* What float32 can hold. */
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
