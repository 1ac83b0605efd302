/* An environment with factors and a drop has the bits of one without them under a physics that has
 * the constants and the drop: outcomes and measures of the reference and of every kernel, and
 * gradients; also where environments with different factors share a block. */
#include "lane-cases.h"

#include "rollout/scene.h"

enum { STEPS = 150, ROBOTS = 36 };
static const struct mo_lattice *lattice;
static struct mo_controller *controller;
static struct mo_robot *robots;
static struct mo_environment plain[ROBOTS], varied[ROBOTS];

static void setup(void)
{
  lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  controller = make_random_controller(MO_SENSOR_INVERSE_SQRT, 3);
  robots = make_robots(lattice, 5, 6, ROBOTS);
  for (uint32_t i = 0; i < ROBOTS; i++) {
    struct mo_random random = dice(63, 0, i);
    double by[6];
    for (int k = 0; k < 6; k++)
      by[k] = 0.7 + 0.6 * mo_random_uniform(&random);
    mo_environment_training(7, 0, i, &plain[i]);
    varied[i] = plain[i];
    if (i % 5 != 4) /* the others have no factors */
      varied[i].factors = (struct mo_factors){1, by[0], by[1], by[2], by[3], by[4], by[5]};
    if (i % 3 == 1)
      varied[i].drop_m = 0.2 * mo_random_uniform(&random);
    make_check(mo_environment_check(&varied[i], NULL), "an environment");
  }
}

static struct mo_physics settings(uint32_t variant)
{
  struct mo_physics physics = physics_of(STEPS);
  physics.scheme.integrator = variant % 2 == 0 ? MO_INTEGRATOR_PAPER : MO_INTEGRATOR_SPLIT;
  physics.scheme.control_period_s = variant < 2 ? 0 : 4 * physics.scheme.dt_s;
  physics.drop_height_m = variant == 3 ? 0.1 : 0;
  return physics;
}

/* The equations of the factors, once more. */
static struct mo_physics of(const struct mo_environment *environment, struct mo_physics physics)
{
  const struct mo_factors *f = &environment->factors;
  physics.drop_height_m += environment->drop_m;
  if (f->given == 0)
    return physics;
  physics.constants.stiffness_n_per_m *= f->stiffness;
  physics.constants.mass_kg *= f->mass;
  physics.constants.drag_per_s *= f->drag;
  physics.constants.gravity_m_per_s2 *= f->gravity;
  physics.constants.actuation *= f->actuation;
  physics.constants.friction *= f->friction;
  return physics;
}

static void reference(void)
{
  for (uint32_t k = 0; k < 12; k++) {
    const struct mo_physics physics = settings(k % 4), own = of(&varied[k], physics);
    struct mo_outcome a, b, before;
    REQUIRE_OK(
        mo_rollout_reference(robots[k].body, controller, &varied[k], &physics, NULL, NULL, &a));
    REQUIRE_OK(mo_rollout_reference(robots[k].body, controller, &plain[k], &own, NULL, NULL, &b));
    REQUIRE_OK(
        mo_rollout_reference(robots[k].body, controller, &plain[k], &physics, NULL, NULL, &before));
    CHECK(SAME(&a, &b, 1));
    CHECK((varied[k].factors.given == 0 && varied[k].drop_m == 0) == SAME(&a, &before, 1));
  }
}

/* The start of a drop is that of the physics' drop height, bit for bit, and a drop adds to it. */
static void starts(void)
{
  for (uint32_t k = 0; k < ROBOTS; k++) {
    const struct mo_body *body = robots[k].body;
    struct mo_environment dropped = plain[k];
    struct mo_physics physics = settings(0), own = physics;
    double *a = make_zeros(3 * (size_t)body->n_masses, sizeof(double));
    double *b = make_zeros(3 * (size_t)body->n_masses, sizeof(double));
    dropped.drop_m = 0.01 * (k + 1);
    own.drop_height_m = dropped.drop_m;
    mo_scene_start(body, &dropped, &physics, a);
    mo_scene_start(body, &plain[k], &own, b);
    CHECK(SAME(a, b, 3 * (size_t)body->n_masses));
    mo_scene_start(body, &dropped, &own, a);
    CHECK_NEAR(a[2], b[2] + dropped.drop_m, 1e-14);
  }
}

/* One factor at a time has an effect. */
static void each(void)
{
  const struct mo_physics physics = settings(3);
  struct mo_outcome before, after;
  REQUIRE_OK(
      mo_rollout_reference(robots[1].body, controller, &plain[1], &physics, NULL, NULL, &before));
  for (int k = 0; k < 6; k++) {
    struct mo_environment one = plain[1];
    double by[6] = {1, 1, 1, 1, 1, 1};
    by[k] = 0.8;
    one.factors = (struct mo_factors){1, by[0], by[1], by[2], by[3], by[4], by[5]};
    REQUIRE_OK(
        mo_rollout_reference(robots[1].body, controller, &one, &physics, NULL, NULL, &after));
    CHECK(fabs(after.loss - before.loss) > 1e-6);
  }
}

static void kernels(void)
{
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)
    for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++) {
      const size_t kept = check_n_kept;
      const struct mo_pack *pack =
          make_pack(controller, (enum mo_isa)isa, (enum mo_precision)precision);
      for (uint32_t variant = 0; variant < 4; variant++) {
        const struct mo_physics physics = settings(variant);
        const struct mo_environment *lanes[LANES], *one;
        struct mo_outcome outcomes[LANES], alone;
        double measures[LANES][MO_MEASURES], own_measures[MO_MEASURES];
        for (uint32_t l = 0; l < LANES; l++)
          lanes[l] = &varied[l];
        const struct mo_measuring all = {UINT32_MAX >> (32 - MO_MEASURES), measures};
        const struct mo_measuring its_own = {all.set, &own_measures};
        REQUIRE_OK(mo_rollout_block(make_workspace_memory(), pack, robots[variant].body, lanes,
                                    LANES, &physics, NULL, &all, NULL, outcomes));
        for (uint32_t l = 0; l < LANES; l++) {
          const struct mo_physics own = of(&varied[l], physics);
          one = &plain[l];
          REQUIRE_OK(mo_rollout_block(make_workspace_memory(), pack, robots[variant].body, &one, 1,
                                      &own, NULL, &its_own, NULL, &alone));
          CHECK(SAME(&alone, &outcomes[l], 1));
          CHECK(SAME(own_measures, measures[l], MO_MEASURES));
        }
      }
      check_drop_to(kept);
    }
}

static void gradients(void)
{
  const struct mo_gradient_options options = {.weight = 1};
  const size_t n = controller->n_parameters;
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)
    for (uint32_t variant = 0; variant < 4; variant++) {
      const size_t kept = check_n_kept;
      const struct mo_physics physics = settings(variant);
      const struct mo_pack *pack = make_gradient_pack(controller, (enum mo_isa)isa);
      struct mo_robot varying = robots[variant], own_robot = robots[variant];
      varying.environment = &varied[variant];
      own_robot.environment = &plain[variant];
      const struct mo_physics own = of(&varied[variant], physics);
      float *a = make_zeros(n, sizeof(float)), *b = make_zeros(n, sizeof(float));
      struct mo_outcome outcomes[2];
      struct mo_gradient_counts counts[2] = {{0}, {0}};
      REQUIRE_OK(mo_gradient_block(make_gradient_memory(MO_GRADIENT_DEFAULT_BYTES), pack, &varying,
                                   1, &physics, &options, NULL, &outcomes[0], a, &counts[0]));
      REQUIRE_OK(mo_gradient_block(make_gradient_memory(MO_GRADIENT_DEFAULT_BYTES), pack,
                                   &own_robot, 1, &own, &options, NULL, &outcomes[1], b,
                                   &counts[1]));
      CHECK(SAME(&outcomes[0], &outcomes[1], 1));
      CHECK(SAME(a, b, n));
      check_drop_to(kept);
    }
}

/* Robots with different factors share a block; its sum is that of the robots by themselves, within
 * rounding, because sums of float32 in another order differ. */
static void gradients_together(void)
{
  const struct mo_gradient_options options = {.weight = 1};
  const size_t n = controller->n_parameters;
  const struct mo_pack *pack = make_gradient_pack(controller, mo_isa_best());
  const struct mo_physics physics = settings(3);
  struct mo_robot group[ROBOTS];
  struct mo_outcome outcomes[ROBOTS], one;
  struct mo_gradient_counts counts = {0};
  float *sum = make_zeros(n, sizeof(float)), *own_d = make_zeros(n, sizeof(float));
  double *expected = make_zeros(n, sizeof(double)), error = 0, size = 0;
  for (uint32_t i = 0; i < 32; i++)
    group[i] = (struct mo_robot){robots[i].body, &varied[i]};
  REQUIRE_OK(mo_gradient_block(make_gradient_memory(MO_GRADIENT_DEFAULT_BYTES), pack, group, 32,
                               &physics, &options, NULL, outcomes, sum, &counts));
  for (uint32_t i = 0; i < 32; i++) {
    const struct mo_robot robot = {robots[i].body, &plain[i]};
    const struct mo_physics own = of(&varied[i], physics);
    memset(own_d, 0, n * sizeof(float));
    REQUIRE_OK(mo_gradient_block(make_gradient_memory(MO_GRADIENT_DEFAULT_BYTES), pack, &robot, 1,
                                 &own, &options, NULL, &one, own_d, &counts));
    CHECK(SAME(&one, &outcomes[i], 1));
    for (size_t k = 0; k < n; k++)
      expected[k] += own_d[k];
  }
  for (size_t k = 0; k < n; k++) {
    error += (sum[k] - expected[k]) * (sum[k] - expected[k]);
    size += expected[k] * expected[k];
  }
  printf("# relative error of the sum %.1e\n", sqrt(error / size));
  CHECK(size > 0 && error < 1e-10 * size);
}

static const struct check_case cases[] = {
    {"the reference", reference}, {"the start of a drop", starts},
    {"each factor", each},        {"kernels, with measures", kernels},
    {"gradients", gradients},     {"gradients of different worlds together", gradients_together},
};
CHECK_MAIN_WITH(setup, cases)
