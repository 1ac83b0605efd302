/* The kernels follow the float64 reference, forward and backward, whatever the settings are. */
#include "../make.h"

enum { STEPS = 60 };
static const struct mo_workspace workspace = {2, 2, 2};
static const struct mo_body *body;
static struct mo_controller *controller;
static struct mo_environment hilly;

static void setup(void)
{
  struct mo_lattice *lattice = make_lattice(workspace);
  body = make_full_body(lattice);
  controller = make_controller(workspace, MO_SENSOR_INVERSE_SQRT);
  mo_controller_randomize(controller, 3);
  mo_environment_training(4, 0, 0, &hilly);
}

/* Checks that an environment and settings have an effect, and that all kernels agree on it. */
static void follow(const struct mo_environment *environment, const struct mo_physics *physics)
{
  const struct mo_physics plain = physics_of(STEPS);
  const struct mo_gradient_options options = {.weight = 1};
  const struct mo_robot robot = {body, environment};
  const size_t n = controller->n_parameters;
  double *d = make_zeros(n, sizeof(double)), error = 0, size = 0;
  float *fast_d = make_zeros(n, sizeof(float));
  struct mo_outcome before, outcome, block[2], fast;
  REQUIRE_OK(mo_rollout_reference(body, controller, &hilly, &plain, NULL, NULL, &before));
  REQUIRE_OK(
      mo_gradient_reference(body, controller, environment, physics, &options, &outcome, d, NULL));
  CHECK(fabs(outcome.loss - before.loss) > 1e-5);
  const struct mo_environment *lanes[] = {&hilly, environment};
  REQUIRE_OK(mo_rollout_block(make_workspace_memory(),
                              make_pack(controller, MO_ISA_BASELINE, MO_FLOAT64), body, lanes, 2,
                              physics, NULL, NULL, NULL, block));
  CHECK_NEAR(block[1].loss, outcome.loss, 1e-9);
  struct mo_gradient_counts counts = {0};
  REQUIRE_OK(mo_gradient_block(make_gradient_memory(MO_GRADIENT_DEFAULT_BYTES),
                               make_gradient_pack(controller, MO_ISA_BASELINE), &robot, 1, physics,
                               &options, NULL, &fast, fast_d, &counts));
  CHECK_NEAR(fast.loss, outcome.loss, 1e-4);
  for (size_t i = 0; i < n; i++) {
    error += (fast_d[i] - d[i]) * (fast_d[i] - d[i]);
    size += d[i] * d[i];
  }
  printf("# loss %.6f, before %.6f; relative error of the gradient %.1e\n", outcome.loss,
         before.loss, sqrt(error / size));
  CHECK(error < 1e-4 * size);
}

static void constants(void)
{
  struct mo_physics physics = physics_of(STEPS);
  physics.constants.friction = 0.3;
  follow(&hilly, &physics);
  physics.constants.friction_cap = 0.5;
  follow(&hilly, &physics);
  physics.constants.drag_per_s = 5;
  physics.constants.mass_kg = 1.2;
  follow(&hilly, &physics);
}

static const struct check_case cases[] = {
    {"constants away from their defaults", constants},
};
CHECK_MAIN_WITH(setup, cases)
