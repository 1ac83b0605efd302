/* gradient-dual.c: the adjoint compared with forward-mode dual numbers in a separate implementation
 * (second.h). Every case has 16 random directions: one in each of the 14 tensors, and two in all
 * parameters. */
#include <stdbool.h>

#include "gradient-cases.h"
#include "objective-cases.h"
#include "rollout/contact.h"
#include "task-cases.h"

#define TOLERANCE 1e-10
#define STEEP                                                                                      \
  1e-9 /* for `split` on profiles and fine grids, whose many edges amplify rounding errors */
#define NO_TOUCH 1e-15 /* before the first contact: rounding errors of a sum that cancels */

static struct second_parameters make_directions(const struct gradient_case *c, uint32_t k)
{
  const size_t n = c->controller->n_parameters;
  double *memory = make_zeros((1 + SECOND_WHOLES) * n, sizeof(double));
  struct mo_random random = dice(77, 3, k);
  for (size_t i = 0; i < (1 + SECOND_WHOLES) * n; i++)
    memory[i] = mo_random_normal(&random);
  return (struct second_parameters){c->theta, memory, {memory + n, memory + 2 * n}};
}

/* gradient · each of the directions */
static void project(const struct gradient_case *c, const struct second_parameters *d,
                    const double *gradient, double along[SECOND_LANES])
{
  size_t first[MO_CONTROLLER_TENSORS], count[MO_CONTROLLER_TENSORS];
  gradient_tensors(c->controller, first, count);
  for (int lane = 0; lane < SECOND_LANES; lane++) {
    const int whole = lane - MO_CONTROLLER_TENSORS;
    const double *direction = whole < 0 ? d->alone : d->whole[whole];
    const size_t begin = whole < 0 ? first[lane] : 0;
    const size_t n = whole < 0 ? count[lane] : c->controller->n_parameters;
    along[lane] = 0;
    for (size_t i = begin; i < begin + n; i++)
      along[lane] += gradient[i] * direction[i];
  }
}

/* Tests one length of one case: returns the largest relative error over the directions, or −1 if no
 * mass has hit anything yet. Zero tensors are counted. */
static double compare(struct gradient_case *c, const struct second_parameters *d, uint32_t steps,
                      const struct dual *dual, double *gradient, uint32_t *zeros)
{
  const struct mo_gradient_options options = {.adjoint_bound = 0, .weight = 1};
  struct mo_physics physics = c->physics;
  struct mo_outcome outcome;
  struct mo_gradient_counts counts = {0};
  physics.scheme.n_steps = steps;
  memset(gradient, 0, c->controller->n_parameters * sizeof(double));
  const int r = mo_gradient_reference(c->body, c->controller, &c->environment, &physics, &options,
                                      &outcome, gradient, &counts);
  if (r < 0 || counts.zeroed_robots != 0 || counts.diverged_robots != 0)
    return (double)INFINITY;
  if (!(fabs(outcome.loss - dual->v) <= 1e-13 * fmax(1, outcome.loss))) {
    printf("# %u steps: loss %.17g, on dual numbers %.17g\n", steps, outcome.loss, dual->v);
    return (double)INFINITY;
  }
  double along[SECOND_LANES], worst = 0, largest = 0;
  project(c, d, gradient, along);
  for (int lane = 0; lane < SECOND_LANES; lane++)
    largest = fmax(largest, fmax(fabs(along[lane]), fabs(dual->t[lane])));
  if (largest < NO_TOUCH)
    return -1;
  for (int lane = 0; lane < SECOND_LANES; lane++) {
    if (along[lane] == 0 && lane < MO_CONTROLLER_TENSORS)
      (*zeros)++;
    const double error = fabs(along[lane] - dual->t[lane]);
    const double relative = error > 0 ? error / fabs(dual->t[lane]) : 0;
    worst = relative > worst || isnan(relative) ? relative : worst;
  }
  return worst;
}

enum scenes {
  PLAIN = 0,
  TASKS = 1,
  PROFILES = 2,
  OBJECTIVES = 4,
  GRIDS = 8,
  FACTORS = 16,
  DROPS = 32
};

/* Gives an environment factors, and returns the physics that they make of `physics`. */
static struct mo_physics vary(struct mo_environment *environment, struct mo_physics physics,
                              uint32_t k)
{
  const struct mo_factors f = {1, 0.7 + 0.1 * (k % 4), 1.3, 0.9, 1.1, 0.8 + 0.2 * (k % 3), 0.8};
  struct mo_constants *c = &physics.constants;
  c->stiffness_n_per_m *= f.stiffness;
  c->mass_kg *= f.mass;
  c->drag_per_s *= f.drag;
  c->gravity_m_per_s2 *= f.gravity;
  c->actuation *= f.actuation;
  c->friction *= f.friction;
  environment->factors = f;
  return physics;
}

/* Gives an environment a drop and a slope, and returns the physics with the drop. */
static struct mo_physics drop(struct mo_environment *environment, struct mo_physics physics,
                              uint32_t k)
{
  const struct mo_variation by = {
      .drop_m = 0.01 + 0.002 * (k % 5), .slope_degrees = 4 + k % 12, .toward_rad = 0.7 * (k % 9)};
  make_check(mo_environment_vary(&by, environment), "a variation");
  physics.drop_height_m += environment->drop_m;
  return physics;
}

/* held: the steps of a control period in each case; NULL: the controller computes its outputs in
 * every step. scenes: with the tasks of task-cases.h or objective-cases.h, and on profiles, of
 * which half have damage, and with factors, or drops and slopes, or not. */
static void run_scenes(enum mo_integrator integrator, const uint32_t *at, uint32_t n_at,
                       const uint32_t *held, uint32_t n_cases, unsigned scenes)
{
  const bool steep =
      (scenes & (PROFILES | GRIDS | DROPS)) != 0 && integrator == MO_INTEGRATOR_SPLIT;
  double worst_of_all = 0;
  uint32_t untouched = 0;
  printf("# case masses springs sigma_m sensor         impact    | largest relative error (largest "
         "|derivative|) after");
  for (uint32_t a = 0; a < n_at; a++)
    printf(" %u", at[a]);
  printf(" steps\n");
  for (uint32_t k = 0; k < n_cases; k++) {
    struct gradient_case c = make_gradient_case(k);
    if (scenes & TASKS)
      c.environment.task = task_case(k);
    if (scenes & OBJECTIVES) {
      set_objective(&c.environment, k);
      make_slippery(&c.environment, &c.physics);
      if (is_efficient(&c.environment.task) && integrator == MO_INTEGRATOR_SPLIT)
        continue; /* bodies that slide amplify rounding errors too much */
    }
    if (scenes & PROFILES)
      set_profile(&c.environment, k, fmin(c.sigma_m, 0.03));
    if (scenes & GRIDS)
      set_grid(&c.environment, k, fmin(c.sigma_m, 0.03));
    if ((scenes & PROFILES) && k % 2 == 1) /* in the middle of a control period, or before it */
      c.environment.damage = (struct mo_damage){1 + (k + 5) % MO_OCTANTS, 0.07 * (k % 4)};
    const struct second_parameters d = make_directions(&c, k);
    double *gradient = make_zeros(c.controller->n_parameters, sizeof(double));
    c.physics.scheme.n_steps = at[n_at - 1];
    c.physics.scheme.integrator = integrator;
    if (held != NULL)
      c.physics.scheme.control_period_s = held[k] * c.physics.scheme.dt_s;
    /* The dual numbers have the constants themselves. */
    const struct mo_physics physics = scenes & FACTORS ? vary(&c.environment, c.physics, k)
                                      : scenes & DROPS ? drop(&c.environment, c.physics, k)
                                                       : c.physics;
    const struct second_setup setup = {c.body, &c.environment, &physics, c.controller->sensor};
    struct dual losses[4];
    REQUIRE(dual_rollout(&setup, &d, at, n_at, losses) == 0);
    printf("# %4u %6u %7u %7.2f %-14s %-9s |", k, c.body->n_masses, c.body->n_springs, c.sigma_m,
           mo_sensor_name(c.controller->sensor),
           c.physics.scheme.impact == MO_IMPACT_EXACT ? "exact" : "bisection");
    for (uint32_t a = 0; a < n_at; a++) {
      uint32_t zeros = 0;
      const double worst = compare(&c, &d, at[a], &losses[a], gradient, &zeros);
      double largest = 0;
      for (int lane = 0; lane < SECOND_LANES; lane++)
        largest = fmax(largest, fabs(losses[a].t[lane]));
      CHECK(worst <= (steep ? STEEP : TOLERANCE));
      CHECK(zeros == 0); /* every tensor has a gradient, not orthogonal to its direction */
      if (worst < 0) {
        printf(" - (no contact)");
        CHECK(at[a] <= 10);
        untouched++;
      } else {
        printf(" %.1e (%.1e)", worst, largest);
      }
      worst_of_all = fmax(worst_of_all, worst);
    }
    printf("\n");
    check_drop_to(0);
  }
  CHECK(untouched <= 5);
  printf("# largest relative error of %u directional derivatives: %.2e\n",
         (n_cases * n_at - untouched) * SECOND_LANES, worst_of_all);
}

static void run_cases(enum mo_integrator integrator, const uint32_t *at, uint32_t n_at,
                      const uint32_t *held, uint32_t n_cases)
{
  run_scenes(integrator, at, n_at, held, n_cases, PLAIN);
}

static void short_runs(void)
{
  static const uint32_t at[] = {10, 50, 200};
  run_cases(MO_INTEGRATOR_PAPER, at, 3, NULL, GRADIENT_CASES);
}

static void varied_runs(void)
{
  static const uint32_t at[] = {10, 50, 200}, held[] = {4, 1, 3, 8, 1, 16, 5, 2};
  run_scenes(MO_INTEGRATOR_PAPER, at, 3, held, COUNT(held), FACTORS);
  run_scenes(MO_INTEGRATOR_SPLIT, at, 2, held, COUNT(held), FACTORS);
}

static void dropped_runs(void)
{
  static const uint32_t at[] = {50, 200}, held[] = {4, 1, 3, 8, 1, 16, 5, 2};
  run_scenes(MO_INTEGRATOR_PAPER, at, 2, held, COUNT(held), DROPS);
  run_scenes(MO_INTEGRATOR_SPLIT, at, 1, held, COUNT(held), DROPS);
}

/* Periods that divide the rollout, and periods that the end of the rollout cuts short. */
static void held_runs(void)
{
  static const uint32_t at[] = {10, 50, 200, 1000}, held[] = {4, 2, 3, 8, 5, 16, 7, 64};
  run_cases(MO_INTEGRATOR_PAPER, at, COUNT(at), held, COUNT(held));
}

static void long_runs(void)
{
  static const uint32_t at[] = {1000};
  run_cases(MO_INTEGRATOR_PAPER, at, 1, NULL, GRADIENT_CASES);
}

/* With outputs of every step, and with held ones. Over 1000 steps, cases from 4 on amplify the
 * rounding errors of a step by more than the tolerance allows. */
static void split_runs(void)
{
  static const uint32_t at[] = {10, 50, 200, 1000}, held[] = {4, 1, 3, 8, 1, 16, 1, 64};
  run_cases(MO_INTEGRATOR_SPLIT, at, 3, held, COUNT(held));
  run_cases(MO_INTEGRATOR_SPLIT, at + 3, 1, held, 4);
}

/* Every guide with every objective. Outputs of every step differ from held ones early on. */
static void task_runs(void)
{
  static const uint32_t at[] = {10, 50, 200}, held[] = {4, 1, 3, 8, 1, 16, 5, 1, 2, 64, 4, 7, 1};
  _Static_assert(COUNT(held) == TASK_CASES && TASK_CASES <= GRADIENT_CASES, "one period each");
  run_scenes(MO_INTEGRATOR_PAPER, at, COUNT(at), held, TASK_CASES, TASKS);
  run_scenes(MO_INTEGRATOR_SPLIT, at, COUNT(at), held, TASK_CASES, TASKS);
  run_scenes(MO_INTEGRATOR_PAPER, at, 2, NULL, TASK_CASES, TASKS);
}

/* Work, jumps and sums; with damage, work of broken bodies. */
static void objective_runs(void)
{
  static const uint32_t at[] = {140, 150}, held[] = {4, 1, 3, 8, 1, 16, 5, 1, 2, 7, 4};
  _Static_assert(COUNT(held) == SMOOTH_CASES && SMOOTH_CASES <= GRADIENT_CASES, "one period each");
  run_scenes(MO_INTEGRATOR_PAPER, at, COUNT(at), held, SMOOTH_CASES, OBJECTIVES);
  run_scenes(MO_INTEGRATOR_SPLIT, at, 1, held, SMOOTH_CASES, OBJECTIVES);
}

/* Also with a light that moves over them. */
static void profile_runs(void)
{
  static const uint32_t at[] = {10, 50, 200}, held[] = {4, 1, 3, 8, 1, 16, 5, 1};
  run_scenes(MO_INTEGRATOR_PAPER, at, COUNT(at), held, COUNT(held), PROFILES);
  run_scenes(MO_INTEGRATOR_SPLIT, at, COUNT(at), held, COUNT(held), PROFILES);
  run_scenes(MO_INTEGRATOR_SPLIT, at, COUNT(at), held, COUNT(held), PROFILES | TASKS);
}

static void grid_runs(void)
{
  static const uint32_t at[] = {10, 50, 200}, held[] = {4, 1, 3, 8, 1, 16, 5, 1};
  run_scenes(MO_INTEGRATOR_PAPER, at, COUNT(at), held, COUNT(held), GRIDS);
  run_scenes(MO_INTEGRATOR_SPLIT, at, COUNT(at), held, COUNT(held), GRIDS);
  run_scenes(MO_INTEGRATOR_SPLIT, at, COUNT(at), held, COUNT(held), GRIDS | TASKS);
}

/* One mass and the transposed derivative of its step, compared with dual numbers input by input. */
struct mass {
  const struct mo_physics *physics;
  struct mo_environment environment;
  double p[3], v[3], a[3], back_p[3], back_v[3];
};

enum { INPUTS = 9 };

/* Returns the branches taken (0 = no contact); relative: to the largest of the derivatives. Those
 * by the acceleration count as much as those by the velocity that it causes in a step. */
static uint64_t step_back(struct mass *m, double *error)
{
  const struct second_setup setup = {NULL, &m->environment, m->physics, MO_SENSOR_INVERSE_SQRT};
  const struct mo_scheme *scheme = &m->physics->scheme;
  const struct mo_constants *constants = &m->physics->constants;
  const double highest_m = mo_terrain_highest(&m->environment);
  struct dual dp[3] = {{0}}, dv[3] = {{0}}, da[3] = {{0}};
  double forward[INPUTS] = {0}, back[INPUTS] = {0}, size = 0;
  for (int i = 0; i < 3; i++) {
    dp[i].v = m->p[i];
    dv[i].v = m->v[i];
    da[i].v = m->a[i];
    dp[i].t[i] = 1;
    dv[i].t[3 + i] = 1;
    da[i].t[6 + i] = 1 / scheme->dt_s;
  }
  const uint64_t branch = dual_move(&setup, dp, dv, da);
  for (int lane = 0; lane < INPUTS; lane++) {
    for (int i = 0; i < 3; i++)
      forward[lane] += m->back_p[i] * dp[i].t[lane] + m->back_v[i] * dv[i].t[lane];
    size = fmax(size, fabs(forward[lane]));
  }
  if (scheme->integrator == MO_INTEGRATOR_SPLIT)
    mo_contact_split_adjoint(scheme, constants, &m->environment, highest_m, m->a, m->p, m->v,
                             m->back_p, m->back_v, back + 6);
  else
    mo_contact_move_adjoint(scheme, constants, &m->environment, highest_m, m->p, m->v, m->back_p,
                            m->back_v);
  *error = 0;
  for (int i = 0; i < 3; i++) {
    back[i] = m->back_p[i];
    back[3 + i] = m->back_v[i];
    back[6 + i] /= scheme->dt_s;
  }
  for (int i = 0; i < INPUTS; i++)
    *error = fmax(*error, fabs(back[i] - forward[i]) / size);
  return branch;
}

/* Anywhere on, above and beyond the map; on grids of 8 × 8, profiles, or other grids. */
static void contact_of(enum mo_integrator integrator, enum scenes scene)
{
  struct mo_random random = dice(77, 4, 0);
  uint32_t struck = 0, capped = 0, crossed = 0, outside = 0;
  double worst = 0, error;
  for (uint32_t k = 0; k < 20000; k++) {
    struct mo_physics physics = mo_paper_physics();
    struct mass m = {.physics = &physics};
    physics.scheme.integrator = integrator;
    physics.scheme.impact = k % 4 == 0 ? MO_IMPACT_BISECTION : MO_IMPACT_EXACT;
    physics.scheme.dt_s = k % 3 == 0 ? 0.1 : 0.004; /* long enough to cross cells */
    mo_terrain_random(77, 5, k % 50, 0.1, m.environment.terrain_heights_m);
    const size_t kept = check_n_kept;
    if (scene == PROFILES)
      set_profile(&m.environment, k % 50, 0.03);
    if (scene == GRIDS)
      set_grid(&m.environment, k % 50, 0.03);
    for (int i = 0; i < 3; i++) {
      m.p[i] = -0.5 + 6 * mo_random_uniform(&random);
      m.v[i] = (k % 5 == 0 ? 20 : 2) * mo_random_normal(&random);
      m.back_p[i] = mo_random_normal(&random);
      m.back_v[i] = mo_random_normal(&random);
    }
    m.v[2] = -2 * fabs(m.v[2]);
    if (integrator == MO_INTEGRATOR_SPLIT) {
      static const double drags_per_s[] = {15, 0, 250}, frictions[] = {0.9, 0, 2};
      for (int i = 0; i < 3; i++)
        m.a[i] = 200 * mo_random_normal(&random);
      physics.constants.drag_per_s = drags_per_s[k / 7 % 3] * 0.004 / physics.scheme.dt_s;
      physics.constants.friction = frictions[k / 21 % 3];
      physics.constants.friction_cap = k / 63 % 2 == 0 ? 0.95 : 1;
    }
    m.p[2] = mo_terrain_height(&m.environment, m.p[0], m.p[1]) +
             0.5 * physics.scheme.dt_s * fabs(m.v[2]) * mo_random_uniform(&random);
    const uint64_t branch = step_back(&m, &error);
    worst = fmax(worst, error);
    struck += branch != 0;
    capped += branch != 0 && (branch & 2) == 0;
    crossed += branch != 0 && (branch >> 16 & 4095) != (branch >> 4 & 4095);
    outside += branch != 0 && (branch >> 4 & 3) != 0;
    check_drop_to(kept);
  }
  printf("# 20000 states: %u struck, %u of them at the friction cap, %u changed cells, %u beyond "
         "the map; error %.1e\n",
         struck, capped, crossed, outside, worst);
  CHECK(worst <= 1e-9); /* a grazing impact divides by a small closing speed */
  CHECK(struck > 5000 && capped > 300 && struck - capped > 300 && crossed > 100 && outside > 100);
}

static void contact(void)
{
  static const enum scenes grounds[] = {PLAIN, PROFILES, GRIDS};
  for (size_t k = 0; k < COUNT(grounds); k++) {
    contact_of(MO_INTEGRATOR_PAPER, grounds[k]);
    contact_of(MO_INTEGRATOR_SPLIT, grounds[k]);
  }
}

/* A mass that lies on the ground and leaves it so slowly that the ground soon rises to meet it. The
 * closing speed is almost 0, but no derivative becomes large, because the mass lies on the ground
 * wherever it is. */
static void lying(void)
{
  const double cell_m = MO_TERRAIN_SIZE_M / (MO_TERRAIN_SIDE - 1);
  const struct mo_physics physics = mo_paper_physics();
  struct mo_random random = dice(78, 4, 0);
  uint32_t met = 0;
  double worst = 0, largest = 0, error;
  for (uint32_t k = 0; k < 20000; k++) {
    struct mass m = {.physics = &physics};
    double slope[2];
    mo_terrain_random(78, 5, k % 50, 0.1, m.environment.terrain_heights_m);
    for (int i = 0; i < 3; i++) {
      m.p[i] = 0.5 + 4 * mo_random_uniform(&random);
      m.v[i] = mo_random_normal(&random);
      m.back_p[i] = 2 * mo_random_uniform(&random) - 1;
      m.back_v[i] = physics.scheme.dt_s * (2 * mo_random_uniform(&random) - 1);
    }
    mo_terrain_gradient(&m.environment, m.p[0], m.p[1], slope);
    m.p[2] = mo_terrain_height(&m.environment, m.p[0], m.p[1]) - 1e-12;
    m.v[2] = slope[0] * m.v[0] + slope[1] * m.v[1] + 1e-5 * mo_random_uniform(&random);
    const double impact_s = mo_impact_exact(&m.environment, m.p, m.v, physics.scheme.dt_s);
    bool same_cell = step_back(&m, &error) != 0 && impact_s > 0;
    for (int i = 0; i < 2; i++) /* dual.c lifts the mass off the ground at the border of a cell */
      same_cell =
          same_cell && floor(m.p[i] / cell_m) == floor((m.p[i] + impact_s * m.v[i]) / cell_m);
    if (!same_cell)
      continue;
    met++;
    worst = fmax(worst, error);
    for (int i = 0; i < 3; i++)
      largest = fmax(largest, fabs(m.back_p[i]));
  }
  printf("# %u masses met the ground again within a cell; error %.1e, largest adjoint %.2f of "
         "inputs up to 1\n",
         met, worst, largest);
  CHECK(met > 1000);
  CHECK(worst <= 1e-9);
  CHECK(largest < 10);
}

static const struct check_case cases[] = {
    {"one mass: every branch of contact", contact},
    {"one mass: lying on the ground", lying},
    {"whole rollouts: 10, 50 and 200 steps", short_runs},
    {"whole rollouts: 1000 steps", long_runs},
    {"held outputs: 10 to 1000 steps", held_runs},
    {"split: 10 to 1000 steps", split_runs},
    {"tasks: every guide and objective", task_runs},
    {"objectives: work, heights and sums", objective_runs},
    {"profiles: 10 to 200 steps", profile_runs},
    {"grids of other sizes: 10 to 200 steps", grid_runs},
    {"factors: 10 to 200 steps", varied_runs},
    {"drops and slopes: 50 and 200 steps", dropped_runs},
};
CHECK_MAIN(cases)
