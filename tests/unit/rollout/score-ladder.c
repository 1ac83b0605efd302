/* score-ladder.c: the rungs of a tolerance, and the choice among them. */
#include "../make.h"

#include <morpho/score_ladder.h>

#include "rollout/physics.h"

enum { RUNS = 2 + MO_ERROR_DISPLACED };

/* Each rung halves the step, and keeps duration and control period. */
static void settings_of_the_rungs(void)
{
  struct mo_setting first = {mo_default_physics(), MO_FLOAT32};
  for (int held = 0; held < 2; held++) {
    first.physics.scheme.control_period_s = held ? 0.016 : 0;
    double dt_s = 0.002;
    uint32_t n_steps = 2000;
    for (uint32_t rung = 0; rung < MO_LADDER_RUNGS; rung++, dt_s /= 2, n_steps *= 2) {
      const struct mo_setting setting = mo_ladder_rung(&first, rung);
      const struct mo_scheme *scheme = &setting.physics.scheme;
      CHECK_NEAR(scheme->dt_s, dt_s, 0);
      CHECK_INT(scheme->n_steps, n_steps);
      CHECK_INT(setting.precision, rung < 2 ? MO_FLOAT32 : MO_FLOAT64);
      CHECK_INT(mo_control_steps(scheme), (held ? 8U : 1U) << rung);
    }
  }
  first.precision = MO_FLOAT64;
  CHECK_INT(mo_ladder_rung(&first, 0).precision, MO_FLOAT64);
  CHECK_INT(mo_ladder_rung(&first, 1).precision, MO_FLOAT64);
}

/* The runs of each rung are those that estimate its error. The run with half of the step is the
 * next rung's first one, where the precision stays. */
static void runs_of_the_rungs(void)
{
  const struct mo_setting first = {mo_paper_physics(), MO_FLOAT32};
  CHECK_INT(mo_ladder_runs(0, 0), 1);
  CHECK_INT(mo_ladder_runs(MO_ERROR_DISPLACED, 0), RUNS);
  CHECK_INT(mo_ladder_runs(MO_ERROR_DISPLACED, 0.01), MO_LADDER_RUNS_MAX);
  CHECK_INT(mo_ladder_cost(0, 0), 1);
  CHECK_INT(mo_ladder_cost(MO_ERROR_DISPLACED, 0), RUNS + 1);
  CHECK_INT(mo_ladder_cost(MO_ERROR_DISPLACED, 0.01), (RUNS + 1) * (1 + 2 + 4 + 8 + 16));
  for (uint32_t rung = 0; rung < MO_LADDER_RUNGS; rung++) {
    const struct mo_setting base = mo_ladder_rung(&first, rung);
    for (uint32_t run = 0; run < RUNS; run++) {
      const struct mo_setting setting =
          mo_ladder_run(&first, MO_ERROR_DISPLACED, rung * RUNS + run);
      const struct mo_physics physics = mo_error_physics(&base.physics, run);
      CHECK(mo_physics_equal(&setting.physics, &physics));
      CHECK_INT(setting.precision, base.precision);
    }
    if (rung + 1 < MO_LADDER_RUNGS) {
      const struct mo_setting half = mo_ladder_run(&first, MO_ERROR_DISPLACED, rung * RUNS + 1),
                              next = mo_ladder_rung(&first, rung + 1);
      CHECK(mo_physics_equal(&half.physics, &next.physics));
      CHECK((half.precision == next.precision) == (rung + 1 != MO_LADDER_FLOAT64));
    }
  }
}

static struct mo_score_error error_of(double half_width, double rounding)
{
  struct mo_score_error error = mo_score_error_unknown();
  error.half_width = half_width;
  error.rounding = rounding;
  return error;
}

/* The first rung that reaches the tolerance ends the climb. */
static void reached(void)
{
  const struct mo_score_error errors[] = {error_of(0.02, 0.015), error_of(NAN, NAN),
                                          error_of(0.01, 0), error_of(0.001, 0)};
  struct mo_climb climb = mo_ladder_climb(errors, 4, 0.01);
  CHECK(climb.reached && climb.rung == 2 && !climb.bifurcates);
  climb = mo_ladder_climb(errors, 2, 0.01);
  CHECK(!climb.reached && climb.rung == 0);
  climb = mo_ladder_climb(errors, 4, 0.0001);
  CHECK(!climb.reached && climb.rung == 3 && !climb.bifurcates);
}

/* If the error does not fall as the error of a step does, a smaller step does not help. */
static void stalled(void)
{
  struct mo_score_error errors[MO_LADDER_RUNGS];
  for (uint32_t rung = 0; rung < MO_LADDER_RUNGS; rung++)
    errors[rung] = error_of(0.16 / (1 << rung), 0); /* first order */
  CHECK(!mo_ladder_climb(errors, MO_LADDER_RUNGS, 0.001).bifurcates);
  errors[4].half_width = 0.021; /* more than half of 0.04 */
  CHECK(mo_ladder_climb(errors, MO_LADDER_RUNGS, 0.001).bifurcates);
  CHECK(!mo_ladder_climb(errors, 4, 0.001).bifurcates); /* it has not ended */
  CHECK(!mo_ladder_climb(errors, MO_LADDER_RUNGS, 0.03).bifurcates);
  errors[2].half_width = NAN;
  CHECK(!mo_ladder_climb(errors, MO_LADDER_RUNGS, 0.001).bifurcates);
}

/* Otherwise the rung with the least error is chosen; one with an unknown error only if there is no
 * other. Rounding alone must miss the tolerance in every rung to bifurcate. */
static void missed(void)
{
  const struct mo_score_error errors[] = {error_of(NAN, NAN), error_of(0.05, 0.04),
                                          error_of(0.03, 0.02), error_of(0.04, 0.03)};
  struct mo_climb climb = mo_ladder_climb(errors + 1, 3, 0.01);
  CHECK(!climb.reached && climb.rung == 1 && climb.bifurcates);
  climb = mo_ladder_climb(errors + 1, 3, 0.025);
  CHECK(!climb.reached && climb.rung == 1 && !climb.bifurcates);
  climb = mo_ladder_climb(errors, 4, 0.01);
  CHECK(!climb.reached && climb.rung == 2 && !climb.bifurcates);
  const struct mo_score_error unknown[] = {error_of(NAN, NAN), error_of(NAN, NAN)};
  climb = mo_ladder_climb(unknown, 2, 0.01);
  CHECK(!climb.reached && climb.rung == 1 && !climb.bifurcates);
}

static const struct check_case cases[] = {{"settings of the rungs", settings_of_the_rungs},
                                          {"runs of the rungs", runs_of_the_rungs},
                                          {"tolerances that are reached", reached},
                                          {"tolerances that are missed", missed},
                                          {"errors that stop falling", stalled}};
CHECK_MAIN(cases)
