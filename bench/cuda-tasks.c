/* cuda-tasks.c: compares rollouts with guides and objectives, profiles and damage with float64, and
 * their bits with each other. */
#include "../tests/unit/rollout/task-cases.h"
#include "cuda.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define NEAR_M     2e-5
#define NEAR_VALUE 2e-5
#define NEAR_LOSS  2e-4 /* relative */

enum { BODIES = 4 * TASK_CASES, LIVES = 500, EACH = 3 };

static const char *name_of(uint32_t k)
{
  static char name[64];
  const struct mo_task task = task_case(k % TASK_CASES);
  snprintf(name, sizeof(name), "%s, %s", mo_guide_words[task.guide.kind],
           mo_objective_words[task.objective]);
  return name;
}

struct guided make_guided(uint32_t n, uint64_t seed)
{
  struct guided g = {n,
                     random_bodies(golden.lattice, n, seed),
                     must_have(calloc(n, sizeof(*g.environments))),
                     must_have(calloc(n, sizeof(*g.robots))),
                     must_have(calloc(n, sizeof(*g.outcomes))),
                     must_have(calloc(n, sizeof(*g.truth)))};
  for (uint32_t i = 0; i < n; i++) {
    mo_environment_held_out(seed, i, g.environments + i);
    g.environments[i].task = task_case(i % TASK_CASES);
    if (i / TASK_CASES % 2 == 1) {
      g.environments[i].n_profile = MO_TERRAIN_HEIGHTS; /* the grid's heights as a profile */
      g.environments[i].profile_spacing_m = 0.2;
    }
    if (i / TASK_CASES % 4 > 1)
      g.environments[i].damage = (struct mo_damage){1 + i % MO_OCTANTS, 0.03 * (i % 7)};
    g.robots[i] = (struct mo_robot){g.bodies[i], g.environments + i};
  }
  return g;
}

void drop_guided(struct guided *g)
{
  free_bodies(g->bodies, g->n);
  free(g->environments);
  free(g->robots);
  free(g->outcomes);
  free(g->truth);
}

/* Short rollouts: the center of mass, the value and the loss. Hardly any path has diverged yet,
 * which rounding can make it do where a mass sticks or slips. */
void check_tasks_short(struct mo_device_controller *controller, uint32_t n_steps)
{
  static const struct {
    const char *name;
    int is_passive;
    uint32_t control_steps;
    enum mo_integrator integrator;
  } kinds[] = {{"every step", 0, 0, MO_INTEGRATOR_PAPER},
               {"periods of 4", 0, 4, MO_INTEGRATOR_PAPER},
               {"periods of 7", 0, 7, MO_INTEGRATOR_PAPER},
               {"a period of 100", 0, 100, MO_INTEGRATOR_PAPER},
               {"passive, periods of 4", 1, 4, MO_INTEGRATOR_PAPER},
               {"split, every step", 0, 0, MO_INTEGRATOR_SPLIT},
               {"split, periods of 4", 0, 4, MO_INTEGRATOR_SPLIT},
               {"split, periods of 7", 0, 7, MO_INTEGRATOR_SPLIT},
               {"split, passive", 1, 0, MO_INTEGRATOR_SPLIT}};
  struct guided g = make_guided(BODIES, 20251103);
  for (size_t kind = 0; kind < sizeof(kinds) / sizeof(kinds[0]); kind++) {
    struct mo_physics physics = physics_with(kinds[kind].integrator, kinds[kind].control_steps);
    double place_m = 0, value = 0, loss = 0, most = 0;
    uint32_t worst = 0, parted = 0;
    physics.scheme.n_steps = n_steps;
    run(kinds[kind].is_passive ? NULL : controller, g.robots, g.n, &physics, g.outcomes);
    compute_references(kinds[kind].is_passive ? NULL : golden.controller, g.robots, g.n, &physics,
                       g.truth, NULL);
    for (uint32_t i = 0; i < g.n; i++) {
      const struct mo_outcome *own = g.outcomes + i, *truth = g.truth + i;
      const double own_place_m = fmax(fmax(fabs(own->com_end_m[0] - truth->com_end_m[0]),
                                           fabs(own->com_end_m[1] - truth->com_end_m[1])),
                                      fabs(own->com_end_m[2] - truth->com_end_m[2])),
                   own_value = fabs(own->value - truth->value),
                   own_loss = fabs(own->loss / truth->loss - 1);
      if (own_place_m <= NEAR_M && own_value <= NEAR_VALUE && own_loss <= NEAR_LOSS) {
        place_m = fmax(place_m, own_place_m);
        value = fmax(value, own_value);
        loss = fmax(loss, own_loss);
        continue;
      }
      parted++;
      worst = i;
      most = isnan(own_value) || own_value > most ? own_value : most;
    }
    expect(parted <= BODIES / 20 && most <= 0.01,
           "every task, %u steps, %s: center of mass within %.1e m, value within %.1e, loss within "
           "%.1e of itself; %u of %u rows are farther apart, the values up to %.1e (%s)",
           n_steps, kinds[kind].name, place_m, value, loss, parted, g.n, most,
           parted > 0 ? name_of(worst) : "none");
  }
  drop_guided(&g);
}

/* Whole rollouts, which drift apart in the end: medians, and the mean of the values. */
static void check_lives(struct mo_device_controller *controller, const char *name,
                        const struct mo_physics *physics)
{
  struct guided g = make_guided(LIVES, 20251104);
  double values[LIVES], losses[LIVES], mean = 0;
  uint32_t used = 0, differ = 0;
  run(controller, g.robots, g.n, physics, g.outcomes);
  compute_references(golden.controller, g.robots, g.n, physics, g.truth, NULL);
  for (uint32_t i = 0; i < g.n; i++) {
    const struct mo_outcome *own = g.outcomes + i, *truth = g.truth + i;
    if (!isfinite(own->loss) || !isfinite(truth->loss)) {
      differ += isfinite(own->loss) != isfinite(truth->loss);
      continue;
    }
    values[used] = fabs(own->value - truth->value);
    losses[used++] = fabs(own->loss / truth->loss - 1);
    mean += own->value - truth->value;
  }
  mean /= used;
  for (uint32_t k = 0; k < TASK_CASES; k++) {
    double apart[LIVES / TASK_CASES + 1];
    uint32_t n = 0;
    for (uint32_t i = k; i < g.n; i += TASK_CASES)
      apart[n++] = fabs(g.outcomes[i].value - g.truth[i].value);
    printf("  %-18s |d value| median %.1e, 90 %% %.1e\n", name_of(k), quantile(apart, n, 0.5),
           quantile(apart, n, 0.9));
  }
  const double median_value = quantile(values, used, 0.5),
               median_loss = quantile(losses, used, 0.5);
  expect(median_value <= 1e-3 && median_loss <= 2e-3 && fabs(mean) <= 0.003 && differ == 0,
         "tasks, %s: %u lives, |d value| median %.2e, 90 %% %.2e, max %.2e, mean d %+.2e; relative "
         "|d loss| median %.2e, 90 %% %.2e; diverged in only one %u",
         name, used, median_value, quantile(values, used, 0.9), values[used - 1], mean, median_loss,
         quantile(losses, used, 0.9), differ);
  drop_guided(&g);
}

/* A row with a task has the same bits in any group; a plain row has those of a call without
 * tasks. */
static void check_bits_of_tasks(struct mo_device_controller *controller, struct mo_physics physics)
{
  struct guided g = make_guided(BODIES, 20251105);
  const uint32_t n = EACH * BODIES;
  struct mo_environment *plain = must_have(calloc(BODIES, sizeof(*plain)));
  struct mo_robot *rows = must_have(calloc(n, sizeof(*rows))),
                  *turned = must_have(calloc(n, sizeof(*turned)));
  struct mo_outcome *outcomes = must_have(calloc(n, sizeof(*outcomes))),
                    *again = must_have(calloc(n, sizeof(*again)));
  int same = 1;
  physics.scheme.n_steps = 300;
  /* Each body with a task, with another one, and with none. */
  for (uint32_t i = 0; i < BODIES; i++) {
    plain[i] = g.environments[i];
    plain[i].task = (struct mo_task){0};
    plain[i].n_profile = 0;
    plain[i].profile_spacing_m = 0;
    plain[i].damage = (struct mo_damage){0};
    rows[EACH * i] = g.robots[i];
    rows[EACH * i + 1] = (struct mo_robot){g.bodies[i], &g.environments[(i + 1) % BODIES]};
    rows[EACH * i + 2] = (struct mo_robot){g.bodies[i], &plain[i]};
  }
  for (uint32_t i = 0; i < n; i++)
    turned[n - 1 - i] = rows[i];
  run(controller, rows, n, &physics, outcomes);
  run(controller, rows, n, &physics, again);
  expect(memcmp(outcomes, again, n * sizeof(*again)) == 0, "tasks: two runs produce the same bits");
  run(controller, turned, n, &physics, again);
  for (uint32_t i = 0; i < n; i++)
    same &= memcmp(outcomes + i, again + n - 1 - i, sizeof(*again)) == 0;
  expect(same, "tasks: the reverse order produces the same bits");
  same = 1;
  for (uint32_t i = 0; i < n; i += 10) {
    run(controller, rows + i, 1, &physics, again);
    same &= memcmp(outcomes + i, again, sizeof(*again)) == 0;
  }
  expect(same, "tasks: a single row has the same bits");
  for (uint32_t i = 0; i < BODIES; i++)
    turned[i] = rows[EACH * i + 2];
  run(controller, turned, BODIES, &physics, again);
  same = 1;
  for (uint32_t i = 0; i < BODIES; i++)
    same &= memcmp(outcomes + EACH * i + 2, again + i, sizeof(*again)) == 0;
  expect(same, "plain rows have the same bits with and without tasks beside them");
  free(plain);
  free(rows);
  free(turned);
  free(outcomes);
  free(again);
  drop_guided(&g);
}

/* Damage after the end of the rollout changes nothing; damage before its start does. */
static void check_time_of_damage(struct mo_device_controller *controller)
{
  struct guided g = make_guided(BODIES, 20251107), late = make_guided(BODIES, 20251107);
  struct mo_physics physics = physics_with(MO_INTEGRATOR_SPLIT, 7);
  uint32_t same = 0, differ = 0;
  physics.scheme.n_steps = 200;
  for (uint32_t i = 0; i < BODIES; i++) {
    g.environments[i].damage = (struct mo_damage){0};
    late.environments[i].damage = (struct mo_damage){1 + i % MO_OCTANTS, 1000};
  }
  run(controller, g.robots, BODIES, &physics, g.outcomes);
  run(controller, late.robots, BODIES, &physics, late.outcomes);
  for (uint32_t i = 0; i < BODIES; i++) {
    same += memcmp(&g.outcomes[i], &late.outcomes[i], sizeof(*g.outcomes)) == 0;
    late.environments[i].damage.time_s = 0;
  }
  run(controller, late.robots, BODIES, &physics, late.outcomes);
  for (uint32_t i = 0; i < BODIES; i++)
    differ += g.outcomes[i].loss != late.outcomes[i].loss;
  expect(same == BODIES && differ > BODIES / 2,
         "damage after the end leaves %u of %u rows as they are; from the start on it changes %u",
         same, (uint32_t)BODIES, differ);
  drop_guided(&g);
  drop_guided(&late);
}

/* Springs too stiff for the time step: a row that diverges has no finite loss or value, and does
 * not disturb the others of its group. */
static void check_divergence_of_tasks(struct mo_device_controller *controller)
{
  struct guided g = make_guided(BODIES, 20251106);
  struct mo_physics physics = physics_with_period(4);
  uint32_t diverged = 0;
  int agree = 1;
  physics.constants.stiffness_n_per_m *= 1.7;
  physics.scheme.n_steps = 200;
  run(controller, g.robots, g.n, &physics, g.outcomes);
  for (uint32_t i = 0; i < g.n; i++) {
    const struct mo_outcome *own = g.outcomes + i;
    struct mo_outcome alone;
    run(controller, g.robots + i, 1, &physics, &alone);
    agree &= memcmp(own, &alone, sizeof(alone)) == 0;
    agree &= own->diverged_step != 0 ? isinf(own->loss) && own->loss > 0 && isinf(own->value) &&
                                           own->value < 0 && isfinite(own->com_end_m[0])
                                     : isfinite(own->loss) && isfinite(own->value);
    diverged += own->diverged_step != 0;
  }
  expect(diverged > 0 && diverged < g.n && agree,
         "tasks, springs 1.7 times as stiff: %u of %u rows diverge, the others have the bits that "
         "they have alone",
         diverged, g.n);
  drop_guided(&g);
}

void check_tasks(struct mo_device_controller *controller)
{
  struct mo_physics usual = mo_default_physics();
  const struct mo_physics every = physics_with_period(0), fours = physics_with_period(4),
                          split = physics_with(MO_INTEGRATOR_SPLIT, 7);
  usual.scheme.control_period_s = MO_DEFAULT_CONTROL_PERIOD_S;
  check_tasks_short(controller, 40);
  check_bits_of_tasks(controller, every);
  check_bits_of_tasks(controller, fours);
  check_bits_of_tasks(controller, split);
  check_time_of_damage(controller);
  check_divergence_of_tasks(controller);
  check_lives(controller, "periods of 4 steps", &fours);
  check_lives(controller, "the default settings", &usual);
}
