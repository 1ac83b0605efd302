/* score-error.c: the runs that estimate the error of a score, and the estimate from their losses.
 */
#include "../make.h"

#include <morpho/score_error.h>

#include "rollout/physics.h"

enum { N = 4, DISPLACED = 3, RUNS = 2 + DISPLACED };

/* Settings: the first displaced start is 1e-7 m higher; half of the step keeps duration and control
 * period. */
static void settings_of_the_runs(void)
{
  struct mo_physics physics = mo_paper_physics(), run;
  physics.drop_height_m = 0.5;
  CHECK_INT(mo_error_runs(0), 1);
  CHECK_INT(mo_error_cost(0), 1);
  CHECK_INT(mo_error_runs(DISPLACED), RUNS);
  CHECK_INT(mo_error_cost(DISPLACED), RUNS + 1);
  run = mo_error_physics(&physics, 0);
  CHECK(mo_physics_equal(&run, &physics));
  run = mo_error_physics(&physics, 1);
  CHECK_NEAR(run.scheme.dt_s, 0.002, 0);
  CHECK_INT(run.scheme.n_steps, 2000);
  CHECK_NEAR(run.scheme.control_period_s, 0.004, 0); /* it was one step */
  CHECK_INT(mo_control_steps(&run.scheme), 2);
  physics.scheme.control_period_s = 0.016;
  run = mo_error_physics(&physics, 1);
  CHECK_NEAR(run.scheme.control_period_s, 0.016, 0);
  CHECK_NEAR(run.drop_height_m, 0.5, 0);
  for (uint32_t i = 1; i <= DISPLACED; i++) {
    run = mo_error_physics(&physics, 1 + i);
    CHECK_NEAR(run.drop_height_m - 0.5, 1e-7 * i, 1e-15);
    run.drop_height_m = 0.5;
    CHECK(mo_physics_equal(&run, &physics));
  }
}

/* Fills in the losses of all runs of rollouts that do not bifurcate: limits + c dt^order. */
static void sequence(double losses[RUNS][N], const double limits[N], const double c[N], int order)
{
  for (int run = 0; run < RUNS; run++)
    for (int k = 0; k < N; k++)
      losses[run][k] = limits[k] + c[k] * (run == 1 ? pow(0.5, order) : 1);
}

/* The estimate of a known sequence of first and of second order is exact. */
static void known_orders(void)
{
  static const double limits[N] = {0.5, 0.7, 0.6, 0.2}, c[N] = {0.03, 0.01, 0.02, 0.02};
  double losses[RUNS][N];
  for (int order = 1; order <= 2; order++) {
    const enum mo_integrator integrator = order == 1 ? MO_INTEGRATOR_PAPER : MO_INTEGRATOR_SPLIT;
    sequence(losses, limits, c, order);
    const struct mo_score_error error = mo_score_error_of(losses[0], DISPLACED, N, integrator);
    CHECK_NEAR(error.discretization, 0.02, 1e-15);
    CHECK_NEAR(error.rounding, 0, 0);
    CHECK(error.low < 0.5 && 0.5 < error.high); /* the limit of the score */
    CHECK(error.low > 0.3 && error.high < 0.7);
    CHECK_INT(error.bifurcates, 0);
  }
}

/* Errors of the environments that cancel in the mean still widen the interval. */
static void canceled_errors(void)
{
  static const double limits[N] = {0.5, 0.5, 0.5, 0.5}, c[N] = {0.04, -0.04, 0.04, -0.04};
  double losses[RUNS][N];
  sequence(losses, limits, c, 1);
  const struct mo_score_error error =
      mo_score_error_of(losses[0], DISPLACED, N, MO_INTEGRATOR_PAPER);
  CHECK_NEAR(error.discretization, 0, 1e-15);
  CHECK(error.high - error.low > 0.04);
}

/* An environment bifurcates if its displaced starts, or one of them and the request, end farther
 * apart than the threshold; half of the step does not count. */
static void bifurcations(void)
{
  static const double limits[N] = {0.5, 0.5, 0.5, 0.5}, c[N] = {0.1, 0, 0, 0};
  const double t = MO_ERROR_BIFURCATION;
  double losses[RUNS][N];
  sequence(losses, limits, c, 1);
  losses[4][1] += 1.01 * t;
  losses[2][2] += 0.6 * t;
  losses[3][2] -= 0.6 * t;
  losses[2][3] += 0.99 * t;
  const struct mo_score_error error =
      mo_score_error_of(losses[0], DISPLACED, N, MO_INTEGRATOR_PAPER);
  CHECK_INT(error.bifurcates, 6);
  CHECK_NEAR(error.rounding, 1.59 * t / N, 1e-12);
}

static void standard_errors(void)
{
  double losses[RUNS][N] = {{0}};
  for (int run = 0; run < RUNS; run++)
    for (int k = 0; k < N; k++)
      losses[run][k] = k % 2 == 0 ? 0.4 : 0.6;
  CHECK_NEAR(mo_score_error_of(losses[0], DISPLACED, N, MO_INTEGRATOR_PAPER).standard_error,
             sqrt(0.04 / 3 / 4), 1e-15);
  CHECK(isnan(mo_score_error_of(losses[0], DISPLACED, 1, MO_INTEGRATOR_PAPER).standard_error));
}

/* If a rollout of any run diverges, the whole estimate is unknown. */
static void divergences(void)
{
  double losses[RUNS][N];
  for (int run = 0; run < RUNS; run++) {
    for (int i = 0; i < RUNS * N; i++)
      losses[i / N][i % N] = 0.5;
    losses[run][2] = INFINITY;
    const struct mo_score_error error =
        mo_score_error_of(losses[0], DISPLACED, N, MO_INTEGRATOR_PAPER);
    CHECK(isnan(error.low) && isnan(error.high) && isnan(error.discretization) &&
          isnan(error.rounding) && isnan(error.standard_error) && error.bifurcates == 0);
  }
}

static const struct check_case cases[] = {
    {"settings of the runs", settings_of_the_runs}, {"known orders", known_orders},
    {"errors that cancel", canceled_errors},        {"bifurcations", bifurcations},
    {"standard errors", standard_errors},           {"diverged rollouts", divergences}};
CHECK_MAIN(cases)
