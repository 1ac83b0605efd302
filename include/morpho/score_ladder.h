/* score_ladder.h: the settings with which a score reaches a requested accuracy.
 *
 * A ladder begins with the settings of a request. Each further rung halves the time step and keeps
 * duration and control period; starting with rung MO_LADDER_FLOAT64, numbers are float64. A design
 * climbs until its estimated error (score_error.h), the half-width of its interval, is at most the
 * tolerance. The rollouts of a rung are the runs of score_error.h with its settings. The run with
 * half the step is therefore also the first run of the next rung, if the precision is the same. */
#ifndef MORPHO_SCORE_LADDER_H
#define MORPHO_SCORE_LADDER_H

#include <stdbool.h>
#include <stdint.h>

#include <morpho/score_error.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MO_LADDER_RUNGS    5
#define MO_LADDER_FLOAT64  2 /* the first rung that is float64 even if the request is float32 */
#define MO_LADDER_RUNS_MAX (MO_LADDER_RUNGS * MO_ERROR_RUNS_MAX)

/* Tolerances of a mean loss. Below the lower bound, rounding in float64 and the displaced starts
 * would dominate the error. */
#define MO_TOLERANCE_MIN 1e-5
#define MO_TOLERANCE_MAX 1e3

/* Returns whether a tolerance is 0 (none), or is within the bounds and with displaced starts. */
bool mo_tolerance_is_sound(double tolerance, uint32_t n_displaced);

/* Settings of a rollout. */
struct mo_setting {
  struct mo_physics physics;
  enum mo_precision precision;
};
/* Returns the settings of a rung, 0 … MO_LADDER_RUNGS − 1; those of rung 0 are `first`. They may
 * exceed a bound: check them. */
struct mo_setting mo_ladder_rung(const struct mo_setting *first, uint32_t rung);
/* Returns the number of runs of a design; tolerance 0: those of rung 0 only. */
uint32_t mo_ladder_runs(uint32_t n_displaced, double tolerance);
/* Returns the settings of a run. The runs of a rung are consecutive: run i is run i % r of rung
 * i / r, where r is mo_error_runs(n_displaced). */
struct mo_setting mo_ladder_run(const struct mo_setting *first, uint32_t n_displaced, uint32_t run);
/* Returns the cost of all runs, in rollouts with the settings of rung 0. A float64 rollout counts
 * as much as a float32 one. */
uint32_t mo_ladder_cost(uint32_t n_displaced, double tolerance);

/* Where a design ended. */
struct mo_climb {
  uint32_t rung; /* the first one that reaches the tolerance; if none does, the one with the least
                    estimated error, or the last one if none has an estimate */
  bool reached;
  /* The tolerance is missed, and a smaller step does not help: in every rung, displaced starts
   * change the score by more than the tolerance, or the estimated error of the last rung is more
   * than half of that of two rungs before (a converging first-order error would be a quarter). */
  bool bifurcates;
};
/* Chooses the rung of a design from the errors of its first n ≥ 1 rungs. */
struct mo_climb mo_ladder_climb(const struct mo_score_error *errors, uint32_t n, double tolerance);

#ifdef __cplusplus
}
#endif
#endif
