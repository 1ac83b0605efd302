/* score_ladder.c: see score_ladder.h. */
#include <morpho/score_ladder.h>

#include <math.h>

bool mo_tolerance_is_sound(double tolerance, uint32_t n_displaced)
{
  return tolerance == 0 ||
         (n_displaced > 0 && tolerance >= MO_TOLERANCE_MIN && tolerance <= MO_TOLERANCE_MAX);
}

uint32_t mo_ladder_runs(uint32_t n_displaced, double tolerance)
{
  return mo_error_runs(n_displaced) * (tolerance > 0 ? MO_LADDER_RUNGS : 1);
}

uint32_t mo_ladder_cost(uint32_t n_displaced, double tolerance)
{
  return mo_error_cost(n_displaced) * (tolerance > 0 ? (1U << MO_LADDER_RUNGS) - 1 : 1);
}

struct mo_setting mo_ladder_rung(const struct mo_setting *first, uint32_t rung)
{
  struct mo_setting of_rung = *first;
  for (uint32_t k = 0; k < rung; k++)
    of_rung.physics = mo_error_physics(&of_rung.physics, 1);
  if (rung >= MO_LADDER_FLOAT64)
    of_rung.precision = MO_FLOAT64;
  return of_rung;
}

struct mo_setting mo_ladder_run(const struct mo_setting *first, uint32_t n_displaced, uint32_t run)
{
  const uint32_t n = mo_error_runs(n_displaced);
  struct mo_setting of_run = mo_ladder_rung(first, run / n);
  of_run.physics = mo_error_physics(&of_run.physics, run % n);
  return of_run;
}

/* Returns whether the error of the last rung has not decreased as a step error would; false if that
 * is unknown. */
static bool has_stalled(const struct mo_score_error *errors, uint32_t n)
{
  return n == MO_LADDER_RUNGS && errors[n - 1].half_width > 0.5 * errors[n - 3].half_width;
}

struct mo_climb mo_ladder_climb(const struct mo_score_error *errors, uint32_t n, double tolerance)
{
  struct mo_climb climb = {.rung = n - 1, .bifurcates = true};
  double least = INFINITY;
  for (uint32_t rung = 0; rung < n; rung++) {
    const struct mo_score_error *error = &errors[rung];
    climb.bifurcates = climb.bifurcates && error->rounding > tolerance;
    if (error->half_width <= tolerance)
      return (struct mo_climb){.rung = rung, .reached = true};
    if (error->half_width < least) { /* false without an estimate */
      least = error->half_width;
      climb.rung = rung;
    }
  }
  climb.bifurcates = climb.bifurcates || has_stalled(errors, n);
  return climb;
}
