/* Objectives `efficient` and `jump`, and sums: what they measure, in the kernels as in the
 * reference, and their gradients. gradient-dual.c compares the reference's gradient with dual
 * numbers. */
#include "../make.h"
#include "objective-cases.h"
#include "rollout/reference.h"

enum { LANES = MO_BLOCK_LANES, FRAMES = 401 };
static struct mo_lattice *lattice;
static struct mo_controller *controller;
static struct mo_robot *robots; /* with the tasks of objective-cases.h */

static void setup(void)
{
  lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  controller = make_shipped_controller("phototaxis");
  robots = make_robots(lattice, 8, 8, OBJECTIVE_CASES + 1);
  robots[3].body = robots[OBJECTIVE_CASES].body; /* its motion amplifies rounding errors less */
  struct mo_environment *environments = make_zeros(OBJECTIVE_CASES, sizeof(*environments));
  for (uint32_t k = 0; k < OBJECTIVE_CASES; k++) {
    environments[k] = *robots[k].environment;
    set_objective(&environments[k], k);
    robots[k].environment = &environments[k];
  }
}

static struct mo_physics physics_number(uint32_t k, uint32_t n_steps)
{
  static const uint32_t held[] = {0, 4, 7};
  struct mo_physics physics = physics_of(n_steps);
  physics.scheme.integrator = k % 2 == 0 ? MO_INTEGRATOR_PAPER : MO_INTEGRATOR_SPLIT;
  physics.scheme.control_period_s = held[k % 3] * physics.scheme.dt_s;
  return physics;
}

/* ---- what they measure ---- */

/* The value of an objective on its own: the motion is the same, whatever is measured. */
static double value_of(uint32_t k, enum mo_objective objective, const struct mo_physics *physics)
{
  struct mo_environment environment = *robots[k].environment;
  struct mo_outcome outcome;
  environment.task = (struct mo_task){environment.task.guide, objective, 0, {0}, {0}};
  make_check(
      mo_rollout_reference(robots[k].body, controller, &environment, physics, NULL, NULL, &outcome),
      "rollout");
  return outcome.value;
}

/* Of `jump` and `efficient`, from recorded centers of mass and the measures. */
static double plainly(const struct mo_physics *physics, enum mo_objective objective,
                      const double (*com_m)[3], const double *measures)
{
  const uint32_t n = physics->scheme.n_steps, held = mo_control_steps(&physics->scheme);
  const double way = hypot(com_m[n][0] - com_m[0][0], com_m[n][1] - com_m[0][1]);
  double peak = com_m[n][2];
  if (objective == MO_OBJECTIVE_EFFICIENT)
    return way > 0.2 ? (way - 0.2) / (fmax(measures[MO_MEASURE_WORK], 1) / 1000) : 0;
  for (uint32_t step = 0; step < n; step += held)
    if (step * physics->scheme.dt_s >= 0.4 - 1e-9)
      peak = fmax(peak, com_m[step][2]);
  return peak - com_m[0][2] - 0.5 * way;
}

static void reference(void)
{
  uint32_t above = 0, jumps = 0;
  for (uint32_t k = 0; k < 3 * OBJECTIVE_CASES; k++) {
    const struct mo_robot *robot = &robots[k % OBJECTIVE_CASES];
    const struct mo_task *task = &robot->environment->task;
    static double com_m[FRAMES][3];
    struct mo_physics physics = physics_number(k / OBJECTIVE_CASES, k % 5 == 4 ? 60 : FRAMES - 1);
    double measures[1][MO_MEASURES], expected = 0;
    const struct mo_recording recording = {.stride = 1, .com_m = com_m[0]};
    const struct mo_measuring measuring = {MO_MEASURES_ALL, measures};
    struct mo_outcome outcome;
    make_slippery(robot->environment, &physics);
    REQUIRE_OK(mo_rollout_reference(robot->body, controller, robot->environment, &physics,
                                    &recording, &measuring, &outcome));
    if (task->objective != MO_OBJECTIVE_SUM)
      expected = plainly(&physics, task->objective, com_m, measures[0]);
    for (uint32_t i = 0; i < task->n_terms; i++)
      expected +=
          task->weights[i] * (task->terms[i] >= MO_TERM_MEASURE
                                  ? measures[0][task->terms[i] - MO_TERM_MEASURE]
                                  : value_of(k % OBJECTIVE_CASES, task->terms[i], &physics));
    const double scale = task->objective == MO_OBJECTIVE_SUM ? 1 : 0.1;
    CHECK_NEAR(outcome.value, expected, 1e-5 * (1 + fabs(expected))); /* measures are rounded */
    CHECK(outcome.loss >= 0);                                         /* races rest on it */
    CHECK_NEAR(outcome.loss / exp(-outcome.value / scale), 1, 1e-12);
    CHECK_NEAR(mo_objective_value(task->objective, outcome.loss), outcome.value, 1e-9);
    above += task->objective == MO_OBJECTIVE_EFFICIENT && outcome.value > 0;
    jumps += task->objective == MO_OBJECTIVE_JUMP;
    /* The same without measures. */
    struct mo_outcome other;
    REQUIRE_OK(mo_rollout_reference(robot->body, controller, robot->environment, &physics, NULL,
                                    NULL, &other));
    CHECK(SAME(&outcome, &other, 1));
  }
  printf("# %u of 9 bodies came farther than the floor of `efficient`\n", above);
  CHECK(above >= 5 && jumps == 6);
}

/* A body without a controller. */
static void nothing(void)
{
  struct mo_environment environment = {.task = {.objective = MO_OBJECTIVE_JUMP}};
  const struct mo_physics physics = physics_of(300);
  struct mo_outcome outcome;
  environment.light_xy_m[0] = 4;
  REQUIRE_OK(
      mo_rollout_reference(robots[0].body, NULL, &environment, &physics, NULL, NULL, &outcome));
  CHECK(outcome.value <= 0 && outcome.value > -0.03); /* it sags under its weight */
  environment.task.objective = MO_OBJECTIVE_EFFICIENT;
  REQUIRE_OK(
      mo_rollout_reference(robots[0].body, NULL, &environment, &physics, NULL, NULL, &outcome));
  CHECK(outcome.loss == 1 && outcome.value == 0);
  environment.task = (struct mo_task){.objective = MO_OBJECTIVE_SUM,
                                      .n_terms = 2,
                                      .terms = {MO_OBJECTIVE_EFFICIENT, OF(WORK)},
                                      .weights = {1, 1}};
  REQUIRE_OK(
      mo_rollout_reference(robots[0].body, NULL, &environment, &physics, NULL, NULL, &outcome));
  CHECK(outcome.loss == 1 && outcome.value == 0);
}

/* ---- the kernels ---- */

static void block_of(const struct mo_pack *pack, const struct mo_body *body,
                     const struct mo_environment *const *list, uint32_t n,
                     const struct mo_physics *physics, const struct mo_measuring *measuring,
                     struct mo_outcome *outcomes)
{
  const size_t kept = check_n_kept;
  make_check(mo_rollout_block(make_workspace_memory(), pack, body, list, n, physics, NULL,
                              measuring, NULL, outcomes),
             "block");
  check_drop_to(kept);
}

static struct mo_physics kernel_physics(uint32_t variant)
{
  return physics_number(variant, variant == 3 ? 130 : 60);
}

/* All tasks in one block, next to plain lanes, some of them with damage: as in the reference, and
 * with the bits of each lane by itself, with or without measures. */
static void kernels(void)
{
  struct mo_environment environments[LANES];
  const struct mo_environment *list[LANES];
  for (uint32_t l = 0; l < LANES; l++) {
    environments[l] = *robots[l % OBJECTIVE_CASES].environment;
    if (l >= OBJECTIVE_CASES)
      environments[l].task = (struct mo_task){.objective = l % 2 == 0 ? MO_OBJECTIVE_APPROACH : 0};
    if (l % 4 == 1)
      environments[l].damage = (struct mo_damage){1 + l % MO_OCTANTS, 0.1};
    list[l] = &environments[l];
  }
  struct mo_outcome exact[4][LANES];
  for (uint32_t variant = 0; variant < 4; variant++) {
    const struct mo_physics physics = kernel_physics(variant);
    for (uint32_t l = 0; l < LANES; l++)
      REQUIRE_OK(mo_rollout_reference(robots[variant].body, controller, list[l], &physics, NULL,
                                      NULL, &exact[variant][l]));
  }
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)
    for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++) {
      const size_t kept = check_n_kept;
      const struct mo_pack *pack =
          make_pack(controller, (enum mo_isa)isa, (enum mo_precision)precision);
      double worst = 0;
      for (uint32_t variant = 0; variant < 4; variant++) {
        const struct mo_body *body = robots[variant].body;
        const struct mo_physics physics = kernel_physics(variant);
        struct mo_outcome outcomes[LANES], measured[LANES], one;
        double values[LANES][MO_MEASURES];
        const struct mo_measuring measuring = {MO_MEASURES_ALL, values};
        block_of(pack, body, list, LANES, &physics, NULL, outcomes);
        block_of(pack, body, list, LANES, &physics, &measuring, measured);
        CHECK(SAME(outcomes, measured, LANES));
        for (uint32_t l = 0; l < LANES; l++) {
          block_of(pack, body, list + l, 1, &physics, NULL, &one);
          CHECK(SAME(&one, &outcomes[l], 1));
          CHECK(isfinite(one.loss) && isfinite(one.value)); /* fmax ignores NaN */
          worst = fmax(worst, fmax(fabs(exact[variant][l].loss - one.loss),
                                   fabs(exact[variant][l].value - one.value)));
        }
      }
      printf("# %s, %s: losses and values are within %.1e of the reference's\n",
             mo_isa_name((enum mo_isa)isa), precision == MO_FLOAT32 ? "float32" : "float64", worst);
      CHECK(worst <= (precision == MO_FLOAT32 ? 1e-3 : 1e-9));
      check_drop_to(kept);
    }
}

/* The whole default rollout: efficiencies above the floor. */
static void walkers(void)
{
  const struct mo_pack *pack = make_pack(controller, mo_isa_best(), MO_FLOAT64);
  const struct mo_physics physics = physics_number(1, 500);
  struct mo_environment environment = {
      .task = {.guide = {.kind = MO_GUIDE_AHEAD, .distance_m = 1.5},
               .objective = MO_OBJECTIVE_EFFICIENT}};
  const struct mo_environment *list[] = {&environment};
  uint32_t above = 0;
  for (uint32_t k = 0; k < OBJECTIVE_CASES; k++) {
    struct mo_outcome outcome, exact;
    block_of(pack, robots[k].body, list, 1, &physics, NULL, &outcome);
    REQUIRE_OK(mo_rollout_reference(robots[k].body, controller, &environment, &physics, NULL, NULL,
                                    &exact));
    CHECK_NEAR(outcome.value, exact.value, 1e-6);
    above += exact.value > 0;
  }
  printf("# %u of %d walk farther than the floor\n", above, OBJECTIVE_CASES);
  CHECK(above > OBJECTIVE_CASES / 2);
}

static void divergence(void)
{
  struct mo_physics physics = physics_of(200);
  const struct mo_pack *pack = make_pack(controller, MO_ISA_BASELINE, MO_FLOAT32);
  physics.constants.stiffness_n_per_m = 60000;
  for (uint32_t k = 0; k < OBJECTIVE_CASES; k++) {
    struct mo_outcome outcomes[2];
    REQUIRE_OK(mo_rollout_reference(robots[0].body, controller, robots[k].environment, &physics,
                                    NULL, NULL, &outcomes[0]));
    block_of(pack, robots[0].body, &robots[k].environment, 1, &physics, NULL, &outcomes[1]);
    for (int i = 0; i < 2; i++)
      CHECK(outcomes[i].diverged_step > 0 && isinf(outcomes[i].loss) && outcomes[i].loss > 0 &&
            isinf(outcomes[i].value) && outcomes[i].value < 0);
  }
}

/* ---- gradients ---- */

/* Few steps, so that rounding errors stay small. Bodies with the task `efficient` slide past its
 * floor under a strong gravity. */
static struct mo_physics physics_for(const struct mo_environment *environment, uint32_t variant,
                                     uint32_t n_steps)
{
  struct mo_physics physics = physics_number(variant, n_steps);
  if (is_efficient(&environment->task)) {
    physics.scheme.n_steps = 44;
    physics.constants.gravity_m_per_s2 = 60;
    physics.constants.friction = 0;
    physics.constants.drag_per_s = 1;
  }
  return physics;
}

static void keep_nothing(void *context, uint32_t step)
{
  (void)context;
  (void)step;
}

/* The loss that gradients are of. */
static double soft_loss(const struct mo_robot *robot, const struct mo_physics *physics)
{
  struct mo_reference r;
  struct mo_outcome outcome;
  make_check(mo_reference_init(&r, robot->body, controller, robot->environment, physics),
             "reference");
  mo_reference_run(&r, keep_nothing, NULL, &outcome);
  const struct mo_observed observed = {.work_j = r.work_j};
  const double loss = mo_course_soft_loss(&r.course, r.tracks + r.course.n_periods, &observed);
  mo_reference_finish(&r, NULL, &outcome);
  bool jumps = robot->environment->task.objective == MO_OBJECTIVE_JUMP;
  for (uint32_t i = 0; i < robot->environment->task.n_terms; i++)
    jumps = jumps || robot->environment->task.terms[i] == MO_OBJECTIVE_JUMP;
  CHECK(jumps ? loss > outcome.loss : loss == outcome.loss); /* below the largest height */
  mo_reference_done(&r);
  return loss;
}

/* Along a random direction of all parameters. */
static void differences(void)
{
  const struct mo_gradient_options options = {.weight = 1};
  const size_t n = controller->n_parameters, bytes = n * sizeof(float);
  float *middle = make_zeros(n, sizeof(float));
  double *gradient = make_zeros(n, sizeof(double)), worst = 0;
  memcpy(middle, controller->parameters, bytes);
  for (uint32_t k = 0; k < SMOOTH_CASES; k++) {
    struct mo_outcome outcome;
    const struct mo_physics physics = physics_for(robots[k].environment, 2 * k, 110);
    double along = 0, losses[2];
    memset(gradient, 0, n * sizeof(double));
    REQUIRE_OK(mo_gradient_reference(robots[k].body, controller, robots[k].environment, &physics,
                                     &options, &outcome, gradient, NULL));
    for (int end = 0; end < 2; end++) {
      struct mo_random random = dice(92, 0, k);
      const double size = end == 0 ? 1e-7 : -1e-7;
      for (size_t i = 0; i < n; i++) {
        controller->parameters[i] = (float)(middle[i] + size * mo_random_normal(&random));
        along += (end == 0 ? gradient[i] : -gradient[i]) * controller->parameters[i];
      }
      losses[end] = soft_loss(&robots[k], &physics);
      memcpy(controller->parameters, middle, bytes);
    }
    const double difference = losses[0] - losses[1], error = fabs(along - difference);
    printf("# %2u: loss %.4f, difference %.3e, error %.1e of it\n", k, outcome.loss, difference,
           error / fabs(difference));
    worst = fmax(worst, error / fabs(difference));
  }
  CHECK(worst <= 1e-3);
}

/* Compares a block of robot k on every instruction set with the reference. Lowers least[isa] to the
 * cosine of the two gradients. */
static void compare_gradients(uint32_t k, uint32_t variant,
                              const struct mo_gradient_options *options, double *least)
{
  const size_t kept = check_n_kept, n = controller->n_parameters;
  const struct mo_physics physics = physics_for(robots[k].environment, variant, 60);
  double *exact = make_zeros(n, sizeof(double));
  float *fast = make_zeros(n, sizeof(float));
  struct mo_outcome expected, outcome;
  struct mo_environment environment = *robots[k].environment;
  const struct mo_robot robot = {robots[k].body, &environment, NULL};
  if (k % 2 == 1)
    environment.damage = (struct mo_damage){1 + k % MO_OCTANTS, 0.1};
  make_check(mo_gradient_reference(robot.body, controller, &environment, &physics, options,
                                   &expected, exact, NULL),
             "reference");
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    double product = 0, exact_square = 0, fast_square = 0;
    make_check(mo_gradient_block(make_gradient_memory(MO_GRADIENT_DEFAULT_BYTES),
                                 make_gradient_pack(controller, (enum mo_isa)isa), &robot, 1,
                                 &physics, options, NULL, &outcome, fast, NULL),
               "block");
    for (size_t i = 0; i < n; i++) {
      product += exact[i] * (double)fast[i];
      exact_square += exact[i] * exact[i];
      fast_square += (double)fast[i] * (double)fast[i];
    }
    CHECK_NEAR(outcome.loss, expected.loss, 5e-3 * expected.loss);
    CHECK_NEAR(outcome.value, expected.value, 5e-3 * (1 + fabs(expected.value)));
    const double cosine = product / sqrt(exact_square * fast_square);
    if (!(cosine >= 0.999))
      printf("# %s, case %u: cosine %.6f\n", mo_isa_name((enum mo_isa)isa), k, cosine);
    CHECK_NEAR(sqrt(fast_square / exact_square), 1,
               options->adjoint_rule == MO_ADJOINT_RESTART ? 0.1 : 0.03);
    least[isa] = isnan(cosine) ? cosine : fmin(least[isa], cosine);
  }
  check_drop_to(kept);
}

static void gradients(void)
{
  static const struct mo_gradient_options options[] = {
      {.weight = 1},
      {.weight = 1, .adjoint_bound = 0.1},
      {.weight = 1, .adjoint_bound = 0.1, .adjoint_rule = MO_ADJOINT_RESTART, .restart_weight = 2},
  };
  for (uint32_t o = 0; o < COUNT(options); o++)
    for (uint32_t variant = 0; variant < 4; variant += CHECK_SANITIZED ? 3 : 1) {
      double least[] = {1, 1, 1}; /* of an instruction set */
      for (uint32_t k = 0; k < SMOOTH_CASES; k++)
        compare_gradients(k, variant + o, &options[o], least);
      for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
        printf("# %s, variant %u, bound %g, %s: least cosine %.7f\n", mo_isa_name((enum mo_isa)isa),
               variant + o, options[o].adjoint_bound, mo_adjoint_words[options[o].adjoint_rule],
               least[isa]);
        /* A restart where rounding puts an adjoint above the bound in only one of the two counts.
         */
        CHECK(least[isa] >= (options[o].adjoint_rule == MO_ADJOINT_RESTART ? 0.99 : 0.999));
      }
    }
}

/* All tasks in one block, with plain robots: the same bits whether the tape has all steps or
 * segments are run again. */
static void blocks(void)
{
  enum { N = 2 * SMOOTH_CASES };
  const size_t n = controller->n_parameters;
  const struct mo_gradient_options options = mo_default_gradient_options();
  struct mo_robot mixed[N];
  struct mo_environment plain[SMOOTH_CASES];
  for (uint32_t k = 0; k < SMOOTH_CASES; k++) {
    plain[k] = *robots[k].environment;
    plain[k].task = (struct mo_task){0};
    mixed[2 * k] = robots[k];
    mixed[2 * k + 1] = (struct mo_robot){robots[SMOOTH_CASES - 1 - k].body, &plain[k], NULL};
  }
  for (uint32_t variant = 0; variant < 3; variant++) {
    const size_t kept = check_n_kept;
    const struct mo_physics physics = physics_number(variant, 120);
    float *whole = make_zeros(n, sizeof(float)), *cut = make_zeros(n, sizeof(float));
    const struct mo_pack *pack = make_gradient_pack(controller, mo_isa_best());
    struct mo_outcome outcomes[2][N];
    REQUIRE_OK(mo_gradient_block(make_gradient_memory(MO_GRADIENT_DEFAULT_BYTES), pack, mixed, N,
                                 &physics, &options, NULL, outcomes[0], whole, NULL));
    REQUIRE_OK(mo_gradient_block(make_gradient_memory(0), pack, mixed, N, &physics, &options, NULL,
                                 outcomes[1], cut, NULL));
    CHECK(SAME(whole, cut, n));
    CHECK(SAME(outcomes[0], outcomes[1], N));
    check_drop_to(kept);
  }
}

static void refused(void)
{
  const uint32_t last = OBJECTIVE_CASES - 1;
  const struct mo_gradient_options options = {.weight = 1};
  const struct mo_physics physics = physics_of(10);
  struct mo_message message;
  struct mo_outcome outcome;
  double *exact = make_zeros(controller->n_parameters, sizeof(double));
  float *fast = make_zeros(controller->n_parameters, sizeof(float));
  for (uint32_t k = 0; k < last; k++)
    CHECK_INT(mo_task_check_gradient(&robots[k].environment->task, NULL), MO_OK);
  CHECK_INT(mo_task_check_gradient(&robots[last].environment->task, &message), MO_ERR_UNSUPPORTED);
  CHECK(strstr(message.text, "peak_height_m has no derivative") != NULL);
  CHECK(strstr(message.text, "jump, displacement_m, path_length_m, mean_speed_m_per_s, "
                             "straightness, mean_height_m, work_j") != NULL);
  CHECK_INT(mo_gradient_reference(robots[0].body, controller, robots[last].environment, &physics,
                                  &options, &outcome, exact, NULL),
            MO_ERR_UNSUPPORTED);
  CHECK_INT(mo_gradient_block(make_gradient_memory(MO_GRADIENT_DEFAULT_BYTES),
                              make_gradient_pack(controller, MO_ISA_BASELINE), &robots[last], 1,
                              &physics, &options, NULL, &outcome, fast, NULL),
            MO_ERR_UNSUPPORTED);
}

static const struct check_case cases[] = {
    {"the reference has the values of the definitions", reference},
    {"a body that does nothing", nothing},
    {"kernels follow the reference, each lane by itself", kernels},
    {"kernels: walkers", walkers},
    {"divergence", divergence},
    {"gradient: finite differences", differences},
    {"gradient: kernels follow the reference", gradients},
    {"gradient: all tasks in one block", blocks},
    {"gradient: measures without a derivative", refused},
};
CHECK_MAIN_WITH(setup, cases)
