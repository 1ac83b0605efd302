/* cuda-measures.c: compares the measures of rollouts, and the objectives that are made of them,
 * with those of float64, and their bits with each other. */
#include "../tests/unit/rollout/objective-cases.h"
#include "../tests/unit/rollout/task-cases.h"
#include "cuda.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { BODIES = 4 * TASK_CASES, LIVES = 300 };

/* How far a measure of a short rollout may be from that in float64, by rounding alone: absolute,
 * and relative to the larger of the two. */
static const struct {
  double near, share;
} bound[MO_MEASURES] = {
    [MO_MEASURE_DISPLACEMENT] = {2e-5, 0},   [MO_MEASURE_PATH_LENGTH] = {1e-4, 0},
    [MO_MEASURE_MEAN_SPEED] = {1e-3, 0},     [MO_MEASURE_STRAIGHTNESS] = {2e-3, 0},
    [MO_MEASURE_HEADING_ERROR] = {5e-3, 0},  [MO_MEASURE_SIDEWAYS] = {2e-5, 0},
    [MO_MEASURE_PEAK_HEIGHT] = {2e-5, 0},    [MO_MEASURE_MEAN_HEIGHT] = {2e-5, 0},
    [MO_MEASURE_TILT] = {1e-3, 0},           [MO_MEASURE_YAW_RATE] = {1e-2, 0},
    [MO_MEASURE_AIR_SHARE] = {2e-6, 0},      [MO_MEASURE_CONTACT_FRONT] = {2e-6, 0},
    [MO_MEASURE_CONTACT_BACK] = {2e-6, 0},   [MO_MEASURE_CONTACT_LEFT] = {2e-6, 0},
    [MO_MEASURE_CONTACT_RIGHT] = {2e-6, 0},  [MO_MEASURE_HOPS] = {2e-6, 0},
    [MO_MEASURE_WORK] = {2e-3, 1e-3},        [MO_MEASURE_COST_OF_TRANSPORT] = {1e-3, 1e-2},
    [MO_MEASURE_PEAK_STRAIN] = {1e-4, 1e-4}, [MO_MEASURE_INVERTED_VOXELS] = {0, 0},
};

static double apart(double a, double b)
{
  return isnan(a) && isnan(b) ? 0 : isnan(a) || isnan(b) ? (double)INFINITY : fabs(a - b);
}

struct measured {
  struct guided g;
  double (*own)[MO_MEASURES], (*truth)[MO_MEASURES];
};

static struct measured make_measured(uint32_t n, uint64_t seed)
{
  return (struct measured){make_guided(n, seed), must_have(calloc(n, sizeof(double[MO_MEASURES]))),
                           must_have(calloc(n, sizeof(double[MO_MEASURES])))};
}

static void drop_measured(struct measured *m)
{
  drop_guided(&m->g);
  free(m->own);
  free(m->truth);
}

void check_measures_short(struct mo_device_controller *controller, uint32_t n_steps)
{
  static const struct {
    const char *name;
    int is_passive;
    uint32_t control_steps;
    enum mo_integrator integrator;
  } kinds[] = {{"every step", 0, 0, MO_INTEGRATOR_PAPER},
               {"periods of 4", 0, 4, MO_INTEGRATOR_PAPER},
               {"passive, periods of 4", 1, 4, MO_INTEGRATOR_PAPER},
               {"split, every step", 0, 0, MO_INTEGRATOR_SPLIT},
               {"split, periods of 7", 0, 7, MO_INTEGRATOR_SPLIT}};
  struct measured m = make_measured(BODIES, 20251108);
  for (size_t kind = 0; kind < sizeof(kinds) / sizeof(kinds[0]); kind++) {
    struct mo_physics physics = physics_with(kinds[kind].integrator, kinds[kind].control_steps);
    physics.scheme.n_steps = n_steps;
    run_measured(kinds[kind].is_passive ? NULL : controller, m.g.robots, m.g.n, &physics,
                 m.g.outcomes, m.own);
    compute_references(kinds[kind].is_passive ? NULL : golden.controller, m.g.robots, m.g.n,
                       &physics, m.g.truth, m.truth);
    for (int k = 0; k < MO_MEASURES; k++) {
      uint32_t parted = 0, first = 0;
      double most = 0;
      for (uint32_t i = 0; i < m.g.n; i++) {
        const double d = apart(m.own[i][k], m.truth[i][k]),
                     allowed = bound[k].near +
                               bound[k].share * fmax(fabs(m.own[i][k]), fabs(m.truth[i][k]));
        if (d == 0 || d <= allowed) {
          most = fmax(most, d);
          continue;
        }
        first = parted++ == 0 ? i : first;
      }
      expect(parted <= BODIES / 20,
             "%s, %u steps, %s: within %.1e; %u of %u rows are farther apart (row %u: %g, in "
             "float64 %g)",
             mo_measure_info[k].name, n_steps, kinds[kind].name, most, parted, m.g.n, first,
             m.own[first][k], m.truth[first][k]);
    }
  }
  drop_measured(&m);
}

/* Whole rollouts, which drift apart in the end: medians. */
static void check_lives(struct mo_device_controller *controller, const struct mo_physics *physics)
{
  struct measured m = make_measured(LIVES, 20251109);
  run_measured(controller, m.g.robots, m.g.n, physics, m.g.outcomes, m.own);
  compute_references(golden.controller, m.g.robots, m.g.n, physics, m.g.truth, m.truth);
  for (int k = 0; k < MO_MEASURES; k++) {
    double d[LIVES], size[LIVES], own_mean = 0, true_mean = 0;
    uint32_t n = 0, differ = 0;
    for (uint32_t i = 0; i < m.g.n; i++) {
      if (isnan(m.own[i][k]) || isnan(m.truth[i][k])) {
        differ += isnan(m.own[i][k]) != isnan(m.truth[i][k]);
        continue;
      }
      own_mean += m.own[i][k];
      true_mean += m.truth[i][k];
      d[n] = fabs(m.own[i][k] - m.truth[i][k]);
      size[n++] = fabs(m.truth[i][k]);
    }
    const double typical = quantile(size, n, 0.9), median = quantile(d, n, 0.5);
    expect(median <= 0.02 * typical + 2e-6 && differ <= LIVES / 50 &&
               fabs(own_mean - true_mean) <= 0.03 * n * typical + 2e-6 * n,
           "%s, %u lives: |d| median %.2e, 90 %% %.2e; mean %.6f, in float64 %.6f; without a value "
           "in only one %u",
           mo_measure_info[k].name, n, median, quantile(d, n, 0.9), own_mean / n, true_mean / n,
           differ);
  }
  drop_measured(&m);
}

/* The objectives of objective-cases.h, next to rows with other tasks: losses and values, which do
 * not depend on whether the measures are requested. */
static void check_objectives(struct mo_device_controller *controller, struct mo_physics physics,
                             const char *name)
{
  struct measured m = make_measured(4 * OBJECTIVE_CASES, 20251111);
  uint32_t parted = 0, worst = 0;
  double most = 0;
  physics.constants.friction = 0.5; /* bodies slide, so that `efficient` has distance to count */
  physics.constants.drag_per_s = 6;
  physics.scheme.n_steps =
      100; /* longer ones drift apart by chaos, most with long control periods */
  for (uint32_t i = 0; i < m.g.n; i++) {
    if (i % 8 < 6)
      set_objective(&m.g.environments[i], i % OBJECTIVE_CASES);
    m.g.environments[i].damage = (struct mo_damage){0};
  }
  run(controller, m.g.robots, m.g.n, &physics, m.g.outcomes);
  compute_references(golden.controller, m.g.robots, m.g.n, &physics, m.g.truth, NULL);
  for (uint32_t i = 0; i < m.g.n; i++) {
    const double own = m.g.outcomes[i].value, truth = m.g.truth[i].value,
                 d = fabs(own - truth) / (1 + fabs(truth));
    const int agrees = d <= 2e-3 && (m.g.outcomes[i].loss < 1) == (m.g.truth[i].loss < 1);
    most = agrees ? fmax(most, d) : most;
    worst = agrees ? worst : i;
    parted += !agrees;
  }
  expect(parted <= m.g.n / 8,
         "objectives with a tally, %s: values within %.1e of (1 + themselves); %u of %u rows are "
         "farther apart (case %u: %g, in float64 %g)",
         name, most, parted, m.g.n, worst % OBJECTIVE_CASES, m.g.outcomes[worst].value,
         m.g.truth[worst].value);
  run_measured(controller, m.g.robots, m.g.n, &physics, m.g.truth, m.own);
  expect(memcmp(m.g.truth, m.g.outcomes, m.g.n * sizeof(*m.g.outcomes)) == 0,
         "objectives with a tally, %s: the same bits with measures", name);
  drop_measured(&m);
}

/* Measures change no outcome, and depend on no neighbor. */
static void check_bits(struct mo_device_controller *controller, struct mo_physics physics)
{
  struct measured m = make_measured(BODIES, 20251110), other = make_measured(BODIES, 20251110);
  const uint32_t n = BODIES;
  int same = 1;
  physics.scheme.n_steps = 300;
  for (uint32_t i = 0; i < n; i += 3) /* plain rows, too */
    m.g.environments[i].task = other.g.environments[i].task = (struct mo_task){0};
  run(controller, m.g.robots, n, &physics, m.g.truth);
  run_measured(controller, m.g.robots, n, &physics, m.g.outcomes, m.own);
  expect(memcmp(m.g.truth, m.g.outcomes, n * sizeof(*m.g.outcomes)) == 0,
         "measures leave all bits of %u outcomes as they are", n);
  run_measured(controller, m.g.robots, n, &physics, m.g.outcomes, m.truth);
  expect(memcmp(m.own, m.truth, n * sizeof(*m.own)) == 0,
         "measures: two runs produce the same bits");
  for (uint32_t i = 0; i < n; i++)
    other.g.robots[n - 1 - i] = m.g.robots[i];
  run_measured(controller, other.g.robots, n, &physics, other.g.outcomes, other.own);
  for (uint32_t i = 0; i < n; i++)
    same &= memcmp(m.own[i], other.own[n - 1 - i], sizeof(*m.own)) == 0;
  expect(same, "measures: the reverse order produces the same bits");
  same = 1;
  for (uint32_t i = 0; i < n; i += 5) {
    run_measured(controller, m.g.robots + i, 1, &physics, other.g.outcomes, other.own);
    same &= memcmp(m.own[i], other.own[0], sizeof(*m.own)) == 0;
  }
  expect(same, "measures: a single row has the same bits");
  drop_measured(&m);
  drop_measured(&other);
}

void check_measures(struct mo_device_controller *controller)
{
  const struct mo_physics every = physics_with_period(0),
                          split = physics_with(MO_INTEGRATOR_SPLIT, 7);
  struct mo_physics usual = mo_default_physics();
  usual.scheme.control_period_s = MO_DEFAULT_CONTROL_PERIOD_S;
  check_measures_short(controller, 40);
  check_objectives(controller, split, "split, periods of 7");
  check_objectives(controller, every, "every step");
  check_bits(controller, every);
  check_bits(controller, split);
  check_lives(controller, &usual);
}
