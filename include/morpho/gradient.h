/* gradient.h: how the loss of a rollout changes with every parameter of its controller, by backpropagation through all steps
 * (docs/numerics.md derives it). float64, plain C, one rollout: the yardstick for faster paths.
 *
 * A rollout is a long chain of contacts, along which the adjoint (∂loss/∂state) can grow exponentially. The bound tames it:
 * at every step of the way back, with the adjoint of all masses' positions and velocities,
 *   m = d0 · max(‖∂loss/∂x‖₂, 15 s⁻¹ · ‖∂loss/∂v‖₂),   d0 = distance in x, y to the light at the start + 1e-8 m,
 * both are scaled by bound/m where m > bound. m has no unit. */
#ifndef MORPHO_GRADIENT_H
#define MORPHO_GRADIENT_H

#include <stdint.h>

#include <morpho/controller.h>
#include <morpho/morphospace.h>
#include <morpho/rollout.h>
#include <morpho/world.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MO_ADJOINT_BOUND      2.0
#define MO_ADJOINT_RATE_PER_S 15.0

struct mo_gradient_options {
  double adjoint_bound; /* ≥ 0; 0: off */
  double weight;        /* finite; factor of this rollout's gradient in the sum: 1/B for the mean over a batch of B */
};
struct mo_gradient_options mo_default_gradient_options(void); /* MO_ADJOINT_BOUND, 1 */

/* What happened, added up over calls; start from {0}. */
struct mo_gradient_counts {
  uint64_t robots;          /* calls that returned MO_OK */
  uint64_t steps;           /* of the way back, over all robots */
  uint64_t clipped_steps;   /* of these, those that were scaled */
  uint64_t clipped_robots;  /* robots with at least one of them */
  uint64_t zeroed_robots;   /* contributed nothing: an adjoint, or a parameter's gradient, was not finite */
  uint64_t diverged_robots; /* contributed nothing: the rollout itself diverged */
  double largest;           /* m before scaling; where it was not finite it is not counted here */
};

/* Runs the rollout exactly as mo_rollout_reference does (same outcome, bit for bit) and adds weight · ∂loss/∂parameters to
 * d_parameters (controller->n_parameters, in file order; the float32 parameters count as real numbers). Springs and masses
 * that the body does not have get a gradient of 0. A robot whose rollout diverged, or whose gradient is not finite, leaves
 * d_parameters as it is. With MO_IMPACT_EXACT the time of impact is differentiated too; with MO_IMPACT_BISECTION it counts as
 * a constant. At the points where the loss has a kink, one of the two one-sided derivatives is taken (docs/numerics.md).
 *
 * physics must have passed mo_physics_check. d_parameters and outcome belong to the caller; counts nullable. Everything else is
 * borrowed for the call. Memory, freed on return: n_parameters doubles and about sqrt(n_steps) steps: 7.5 MB for the full
 * default workspace and 1000 steps. Costs about three rollouts.
 *
 * MO_ERR_INVALID: no controller, one of another workspace, or an option that is not finite; MO_ERR_RANGE: a bound below 0;
 * MO_ERR_NO_MEMORY. On error nothing is written. */
int mo_gradient_reference(const struct mo_body *body, const struct mo_controller *controller,
                          const struct mo_environment *environment, const struct mo_physics *physics,
                          const struct mo_gradient_options *options, struct mo_outcome *outcome, double *d_parameters,
                          struct mo_gradient_counts *counts);

#ifdef __cplusplus
}
#endif
#endif
