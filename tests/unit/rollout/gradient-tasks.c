/* The gradient of every guide with every objective: the reference compared with finite differences,
 * the kernels with the reference. gradient-dual.c compares the reference with dual numbers. */
#include "../make.h"
#include "task-cases.h"

static struct mo_controller *controller;
static struct mo_robot *robots; /* with the tasks of task-cases.h */

static void setup(void)
{
  controller = make_shipped_controller("phototaxis");
  robots = make_robots(make_lattice(MO_DEFAULT_WORKSPACE), 8, 8, TASK_CASES);
  struct mo_environment *environments = make_zeros(TASK_CASES, sizeof(*environments));
  for (uint32_t k = 0; k < TASK_CASES; k++) {
    environments[k] = *robots[k].environment;
    environments[k].task = task_case(k);
    robots[k].environment = &environments[k];
  }
}

static const char *name_of(uint32_t k)
{
  static char name[64];
  const struct mo_task task = task_case(k);
  snprintf(name, sizeof(name), "%s, %s", mo_guide_words[task.guide.kind],
           mo_objective_words[task.objective]);
  return name;
}

/* Along a random direction of all parameters. */
static void differences(void)
{
  const struct mo_gradient_options options = {.weight = 1};
  const struct mo_physics physics = physics_of(30);
  const size_t n = controller->n_parameters, bytes = n * sizeof(float);
  float *middle = make_zeros(n, sizeof(float));
  double *gradient = make_zeros(n, sizeof(double)), worst = 0;
  memcpy(middle, controller->parameters, bytes);
  for (uint32_t k = 0; k < TASK_CASES; k++) {
    struct mo_outcome outcome, ends[2];
    double along = 0, difference;
    memset(gradient, 0, n * sizeof(double));
    REQUIRE_OK(mo_gradient_reference(robots[k].body, controller, robots[k].environment, &physics,
                                     &options, &outcome, gradient, NULL));
    for (int end = 0; end < 2; end++) {
      struct mo_random random = dice(91, 0, k);
      const double size = end == 0 ? 1e-7 : -1e-7;
      for (size_t i = 0; i < n; i++) {
        controller->parameters[i] = (float)(middle[i] + size * mo_random_normal(&random));
        along += (end == 0 ? gradient[i] : -gradient[i]) * controller->parameters[i];
      }
      REQUIRE_OK(mo_rollout_reference(robots[k].body, controller, robots[k].environment, &physics,
                                      NULL, NULL, &ends[end]));
      memcpy(controller->parameters, middle, bytes);
    }
    difference = ends[0].loss - ends[1].loss;
    const double error = fabs(along - difference) / fabs(difference);
    printf("# %-18s loss %.4f, difference %.3e, error %.1e\n", name_of(k), outcome.loss, difference,
           error);
    worst = fmax(worst, error);
  }
  CHECK(worst <= 1e-3);
}

/* Compares every task on every instruction set, in blocks of one robot, with the reference. Writes
 * the least cosine of each set. */
static void compare(const struct mo_physics *physics, const struct mo_gradient_options *options,
                    double least[MO_ISA_COUNT])
{
  const size_t kept = check_n_kept, n = controller->n_parameters;
  struct mo_gradient_memory *memory = make_gradient_memory(MO_GRADIENT_DEFAULT_BYTES);
  double *exact = make_zeros(n, sizeof(double));
  float *fast = make_zeros(n, sizeof(float));
  const struct mo_pack *packs[MO_ISA_COUNT];
  uint64_t clipped = 0;
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    packs[isa] = make_gradient_pack(controller, (enum mo_isa)isa);
    least[isa] = 1;
  }
  for (uint32_t k = 0; k < TASK_CASES; k++) {
    struct mo_outcome expected, outcome;
    struct mo_gradient_counts counts = {0};
    memset(exact, 0, n * sizeof(double));
    REQUIRE_OK(mo_gradient_reference(robots[k].body, controller, robots[k].environment, physics,
                                     options, &expected, exact, &counts));
    clipped += counts.clipped_steps;
    for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
      double product = 0, exact_square = 0, fast_square = 0;
      REQUIRE_OK(mo_gradient_block(memory, packs[isa], &robots[k], 1, physics, options, NULL,
                                   &outcome, fast, NULL));
      for (size_t i = 0; i < n; i++) {
        product += exact[i] * (double)fast[i];
        exact_square += exact[i] * exact[i];
        fast_square += (double)fast[i] * (double)fast[i];
      }
      const double cosine = product / sqrt(exact_square * fast_square);
      if (!(cosine >= 0.999))
        printf("# %s: cosine %.6f\n", name_of(k), cosine);
      CHECK_NEAR(sqrt(fast_square / exact_square), 1, 0.03);
      CHECK_NEAR(outcome.loss, expected.loss, 2e-3 * expected.loss);
      CHECK_NEAR(outcome.value, expected.value, 2e-3);
      least[isa] = isnan(cosine) ? cosine : fmin(least[isa], cosine);
    }
  }
  CHECK((clipped > 0) == (options->adjoint_bound > 0));
  check_drop_to(kept);
}

static void kernels(void)
{
  static const struct mo_gradient_options options[] = {
      {.weight = 1},
      {.weight = 1, .adjoint_bound = 0.1},
      {.weight = 1, .adjoint_bound = 0.1, .adjoint_rule = MO_ADJOINT_RESTART, .restart_weight = 2},
  };
  static const uint32_t held[] = {0, 4, 7};
  for (size_t o = 0; o < COUNT(options); o++)
    for (size_t variant = 0; variant < 4; variant++) {
      struct mo_physics physics = physics_of(60);
      double least[MO_ISA_COUNT] = {0};
      physics.scheme.integrator = variant % 2 == 0 ? MO_INTEGRATOR_PAPER : MO_INTEGRATOR_SPLIT;
      physics.scheme.control_period_s = held[(variant + o) % 3] * physics.scheme.dt_s;
      compare(&physics, &options[o], least);
      for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
        printf("# %s, %s, period %g s, bound %g, %s: least cosine %.7f\n",
               mo_isa_name((enum mo_isa)isa), mo_integrator_words[physics.scheme.integrator],
               physics.scheme.control_period_s, options[o].adjoint_bound,
               mo_adjoint_words[options[o].adjoint_rule], least[isa]);
        CHECK(least[isa] >= 0.999);
      }
    }
}

/* All tasks in one block, with plain robots: as many as fit, and the same bits whether the tape has
 * all steps or segments are run again. */
static void blocks(void)
{
  enum { N = 2 * TASK_CASES };
  const size_t n = controller->n_parameters;
  const struct mo_gradient_options options = mo_default_gradient_options();
  struct mo_robot mixed[N];
  struct mo_environment plain[TASK_CASES];
  for (uint32_t k = 0; k < TASK_CASES; k++) {
    plain[k] = *robots[k].environment;
    plain[k].task = (struct mo_task){0};
    mixed[2 * k] = robots[k];
    mixed[2 * k + 1] = (struct mo_robot){robots[TASK_CASES - 1 - k].body, &plain[k], NULL};
  }
  struct mo_physics physics = physics_of(100);
  physics.scheme.control_period_s = 4 * physics.scheme.dt_s;
  float *whole = make_zeros(n, sizeof(float)), *cut = make_zeros(n, sizeof(float));
  const struct mo_pack *pack = make_gradient_pack(controller, mo_isa_best());
  struct mo_outcome outcomes[2][N];
  REQUIRE_OK(mo_gradient_block(make_gradient_memory(MO_GRADIENT_DEFAULT_BYTES), pack, mixed, N,
                               &physics, &options, NULL, outcomes[0], whole, NULL));
  REQUIRE_OK(mo_gradient_block(make_gradient_memory(0), pack, mixed, N, &physics, &options, NULL,
                               outcomes[1], cut, NULL));
  CHECK(SAME(whole, cut, n));
  CHECK(SAME(outcomes[0], outcomes[1], N));
  double sum = 0;
  for (size_t i = 0; i < n; i++)
    sum += fabs((double)whole[i]);
  CHECK(isfinite(sum) && sum > 0);
}

static const struct check_case cases[] = {
    {"reference: finite differences", differences},
    {"kernels: every task", kernels},
    {"kernels: tasks and plain robots in one block", blocks},
};
CHECK_MAIN_WITH(setup, cases)
