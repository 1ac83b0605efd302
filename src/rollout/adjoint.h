/* adjoint.h: one backward step of the reference rollout, and a gradient that tests can observe. */
#ifndef MORPHO_ROLLOUT_ADJOINT_H
#define MORPHO_ROLLOUT_ADJOINT_H

#include "rollout/objective.inc"
#include "rollout/reference.h"

#include <morpho/gradient.h>

/* The adjoint of a state; dx is ∂loss/∂x. */
struct mo_adjoint {
  double *d_position; /* (n_masses, 3) per m */
  double *d_velocity; /* (n_masses, 3) per m/s */
  double *d_impulse;  /* (n_masses, 3) per N s */
  double *d_output;   /* (n_springs) summed over the steps in which the outputs act */
  double *d_previous; /* (n_springs) the step's share of ∂loss/∂ the previous outputs */
  double *d_input;    /* (n_inputs) */
  struct mo_course_adjoint course; /* unused by plain tasks */
};

/* Turns ∂loss/∂ the state after step number `step`, which is on the tape, into ∂loss/∂ the state
 * before it. Held outputs also act in later steps: the adjoint accumulates the contributions of
 * those steps until it reaches the step that computed the outputs. The tape of that step then
 * contains what mo_controller_accumulate needs. */
void mo_adjoint_step(const struct mo_reference *reference, uint32_t step, struct mo_step_tape *tape,
                     struct mo_adjoint *adjoint);

/* For a plain task, computes ∂loss/∂(the final state), times `weight`; com_m: the center of mass of
 * that state. */
void mo_adjoint_start(const struct mo_reference *reference, const double *com_m,
                      const struct mo_goal *goal, double weight, struct mo_adjoint *adjoint);

/* The same for other tasks, from ∂loss/∂ the center of mass. */
void mo_adjoint_start_at(const struct mo_reference *reference, const double d_com[3],
                         struct mo_adjoint *adjoint);

/* Callbacks, which may be NULL. They receive the adjoint of the state after `step` steps, before it
 * is measured and after it was clipped. */
struct mo_gradient_probe {
  void (*before)(void *context, uint32_t step, double *d_position, double *d_velocity);
  void (*after)(void *context, uint32_t step, double *d_position, double *d_velocity);
  void *context;
};
int mo_gradient_probed(const struct mo_body *body, const struct mo_controller *controller,
                       const struct mo_environment *environment, const struct mo_physics *physics,
                       const struct mo_gradient_options *options,
                       const struct mo_gradient_probe *probe, struct mo_outcome *outcome,
                       double *d_parameters, struct mo_gradient_counts *counts);

#endif
