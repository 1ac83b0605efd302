/* score_error.h: how far a score may be from its limit for small steps.
 *
 * A controller with held outputs makes the motion well defined as the step goes to 0, so a score
 * has a limit. Two sources of error separate the score from it, and a few more rollouts in the same
 * environments measure both. The step error is measured by rollouts with half the step,
 * extrapolated by the integrator's order. Rounding is measured by rollouts that start a little
 * higher. Contact amplifies small differences, so in some environments a rollout that starts a
 * little higher ends elsewhere (it bifurcates); rounding has the same effect. docs/performance.md
 * reports the measurements from which the constants in score_error.c were chosen. */
#ifndef MORPHO_SCORE_ERROR_H
#define MORPHO_SCORE_ERROR_H

#include <stdint.h>

#include <morpho/rollout.h>

#ifdef __cplusplus
extern "C" {
#endif

/* The runs of a design: 0 as requested, 1 with half of the step, then the displaced starts. */
#define MO_ERROR_DISPLACED      3
#define MO_ERROR_RUNS_MAX       (2 + MO_ERROR_DISPLACED)
#define MO_ERROR_DISPLACEMENT_M 1e-7 /* upward, of the first displaced start; then 2 ×, 3 × */
/* Above this height, starts this far apart are equal in float32, whose spacing is as large there
 * (6e-8 m below 1 m). */
#define MO_ERROR_FLOAT32_MAX_M 1.0

/* An environment bifurcates if its losses, as requested and with displaced starts, differ by more
 * than this. */
#define MO_ERROR_BIFURCATION 1e-3

/* Returns the number of runs; without displaced starts there is only run 0. */
uint32_t mo_error_runs(uint32_t n_displaced);
/* Returns their cost, in rollouts with the requested step: rollouts with half the step cost twice
 * as much. */
uint32_t mo_error_cost(uint32_t n_displaced);
/* Returns the settings of a run, with the same control period and duration. They may exceed a
 * bound: check them. */
struct mo_physics mo_error_physics(const struct mo_physics *physics, uint32_t run);

struct mo_score_error {
  double discretization; /* estimate of |score − limit| */
  double rounding;       /* largest change of the score by a displaced start */
  double standard_error; /* of the mean over the environments; NaN if there is only one */
  double half_width;     /* of the interval around the score; the estimated error */
  double low, high;      /* contains the limit for at least 90 % of designs */
  uint64_t bifurcates;   /* environments, as bits */
};
/* Estimates the error of the mean of n_environments ≤ 64 losses from the losses of all runs: losses
 * (2 + n_displaced, n_environments). It is unknown if a rollout diverged or was not computed. */
struct mo_score_error mo_score_error_of(const double *losses, uint32_t n_displaced,
                                        uint32_t n_environments, enum mo_integrator integrator);
struct mo_score_error mo_score_error_unknown(void); /* all numbers are NaN */

#ifdef __cplusplus
}
#endif
#endif
