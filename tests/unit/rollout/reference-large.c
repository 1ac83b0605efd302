/* reference-large.c: a body of more than a million springs, passive and with a controller of its
 * size. */
#include "../make.h"

#include <sys/resource.h>

static const struct mo_workspace size = {64, 48, 40};

static double peak_mib(void)
{
  struct rusage usage;
  getrusage(RUSAGE_SELF, &usage);
  return (double)usage.ru_maxrss / 1024;
}

static void million_springs(void)
{
  const struct mo_body *body = make_full_body(make_lattice(size));
  CHECK_INT(body->n_masses, 65 * 49 * 41);
  CHECK(body->n_springs > 1100000);
  struct mo_environment environment;
  mo_environment_training(1, 0, 0, &environment);
  struct mo_physics physics = physics_of(20);
  struct mo_outcome passive, driven;
  CHECK_INT(mo_rollout_reference(body, NULL, &environment, &physics, NULL, NULL, &passive), MO_OK);
  CHECK_INT(passive.diverged_step, 0);
  CHECK_NEAR(passive.loss, 1, 0.01);
  CHECK(passive.com_end_m[2] < passive.com_start_m[2]);
  printf("# %u masses, %u springs; peak memory of a passive body %.0f MiB\n", body->n_masses,
         body->n_springs, peak_mib());
  CHECK(peak_mib() < 512);

  struct mo_controller *controller = make_controller(size, MO_SENSOR_INVERSE_SQRT);
  for (uint32_t i = 0; i < controller->n_springs; i++)
    controller->bias[3][i] = i % 2 ? 1.0F : -1.0F;
  physics.scheme.n_steps = 2;
  CHECK_INT(mo_rollout_reference(body, NULL, &environment, &physics, NULL, NULL, &passive), MO_OK);
  CHECK_INT(mo_rollout_reference(body, controller, &environment, &physics, NULL, NULL, &driven),
            MO_OK);
  CHECK_INT(driven.diverged_step, 0);
  CHECK(driven.com_end_m[2] != passive.com_end_m[2]);
  printf("# with a controller of %zu parameters: %.0f MiB\n", controller->n_parameters, peak_mib());
  CHECK(peak_mib() < 512 + 1.1 * (double)controller->n_parameters * sizeof(float) / (1 << 20));
}

static const struct check_case cases[] = {{"a body of a million springs", million_springs}};
CHECK_MAIN(cases)
