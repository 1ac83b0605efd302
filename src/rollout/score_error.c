/* score_error.c: see score_error.h.
 *
 * The discretization error of a loss is estimated from its change when the step is halved
 * (Richardson): the whole error is 2^p / (2^p − 1) times that for an integrator of order p. Where
 * contact makes a rollout chaotic, that change is just another sample, not an estimate. Errors that
 * happen to cancel in the mean over the environments must therefore not count as a small error: the
 * half-width of the interval combines the error of the mean, the scatter of the environments'
 * errors, and the sensitivity to rounding. */
#include <morpho/score_error.h>

#include <math.h>
#include <stdbool.h>
#include <stddef.h>

uint32_t mo_error_runs(uint32_t n_displaced)
{
  return n_displaced > 0 ? 2 + n_displaced : 1;
}

uint32_t mo_error_cost(uint32_t n_displaced)
{
  return n_displaced > 0 ? 3 + n_displaced : 1;
}

struct mo_physics mo_error_physics(const struct mo_physics *physics, uint32_t run)
{
  struct mo_physics of_run = *physics;
  struct mo_scheme *scheme = &of_run.scheme;
  if (run == 1) {
    if (scheme->control_period_s == 0)
      scheme->control_period_s = scheme->dt_s;
    scheme->dt_s /= 2;
    scheme->n_steps *= 2;
  } else if (run > 1) {
    of_run.drop_height_m += (run - 1) * MO_ERROR_DISPLACEMENT_M;
  }
  return of_run;
}

struct mo_score_error mo_score_error_unknown(void)
{
  return (struct mo_score_error){NAN, NAN, NAN, NAN, NAN, NAN, 0};
}

/* Returns the half-width of the interval in units of the three errors, calibrated with tools/bench
 * score-error (docs/performance.md). With fewer environments, the estimate of their scatter is less
 * accurate, so the factor is larger. */
static double factor_of(uint32_t n)
{
  return 1.5 + 1.5 / n;
}

/* Returns the mean of a row of n losses. */
static double mean_of(const double *losses, uint32_t n)
{
  double sum = 0;
  for (uint32_t k = 0; k < n; k++)
    sum += losses[k];
  return sum / n;
}

/* Returns the environments in which the losses of the request and of the displaced starts are
 * farther apart than MO_ERROR_BIFURCATION. */
static uint64_t find_bifurcations(const double *losses, uint32_t n_displaced, uint32_t n)
{
  uint64_t found = 0;
  for (uint32_t k = 0; k < n; k++) {
    double least = losses[k], most = losses[k];
    for (uint32_t run = 2; run < 2 + n_displaced; run++) {
      least = fmin(least, losses[(size_t)run * n + k]);
      most = fmax(most, losses[(size_t)run * n + k]);
    }
    if (most - least > MO_ERROR_BIFURCATION)
      found |= UINT64_C(1) << k;
  }
  return found;
}

struct mo_score_error mo_score_error_of(const double *losses, uint32_t n_displaced, uint32_t n,
                                        enum mo_integrator integrator)
{
  const double whole = integrator == MO_INTEGRATOR_SPLIT ? 4.0 / 3 : 2, *half = losses + n;
  const double score = mean_of(losses, n);
  struct mo_score_error error = {.discretization = whole * fabs(score - mean_of(half, n))};
  double scatter = 0, deviation = 0;
  for (size_t i = 0; i < (size_t)mo_error_runs(n_displaced) * n; i++)
    if (!isfinite(losses[i]))
      return mo_score_error_unknown();
  for (uint32_t k = 0; k < n; k++) {
    scatter += (losses[k] - half[k]) * (losses[k] - half[k]);
    deviation += (losses[k] - score) * (losses[k] - score);
  }
  for (uint32_t run = 2; run < 2 + n_displaced; run++)
    error.rounding = fmax(error.rounding, fabs(mean_of(losses + (size_t)run * n, n) - score));
  error.standard_error = n > 1 ? sqrt(deviation / (n - 1) / n) : NAN;
  error.bifurcates = find_bifurcations(losses, n_displaced, n);
  error.half_width =
      factor_of(n) * sqrt(error.discretization * error.discretization +
                          whole * whole * scatter / n / n + error.rounding * error.rounding);
  error.low = fmax(0, score - error.half_width);
  error.high = score + error.half_width;
  return error;
}
