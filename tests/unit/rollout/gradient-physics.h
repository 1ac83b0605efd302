/* gradient-physics.h: src/rollout/gradient_physics.inc, compiled once per instruction set for its
 * test, with an interface of plain doubles in the order of the body's masses and springs. */
#ifndef MORPHO_TESTS_GRADIENT_PHYSICS_H
#define MORPHO_TESTS_GRADIENT_PHYSICS_H

#include <stdbool.h>

#include <morpho/gradient.h>

struct physics_scene {
  const struct mo_body *body;
  const struct mo_environment *environment;
  const struct mo_physics *physics;
  enum mo_sensor sensor;
};

/* One step from a given state, and its backward pass. Vectors are (n_masses, 3). */
struct physics_step {
  const double *position_m, *velocity_m_per_s,
      *activation; /* before the step; rounded to float32 */
  double *sensors; /* (n_masses) */
  double *next_m, *next_m_per_s;
  bool sane;
  uint32_t hits;
  /* In: ∂loss/∂ the state after the step, and ∂loss/∂ the sensors (n_masses). Out: ∂loss/∂ the
   * state before the step. */
  double *d_position, *d_velocity;
  const double *d_sensors;
  double *d_activation; /* (n_springs) out */
};

struct physics_functions {
  bool (*step)(const struct physics_scene *scene,
               struct physics_step *step); /* returns false if out of memory */
  bool (*clip)(const struct physics_scene *scene, double bound, double *d_position,
               double *d_velocity, double *m, bool *clipped, bool *finite);
  bool (*start)(const struct physics_scene *scene, struct mo_outcome *outcome, double *position_m,
                double *d_position);
};
extern const struct physics_functions physics_baseline, physics_avx2, physics_avx512;

#endif
