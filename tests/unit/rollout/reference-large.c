/* reference-large.c: a body of more than a million springs, passive and with a controller of its
 * size. */
#include "../check.h"

#include <sys/resource.h>

#include "bodies.h"

static const struct mo_workspace size = {64, 48, 40};

static double peak_mib(void)
{
  struct rusage usage;
  getrusage(RUSAGE_SELF, &usage);
  return (double)usage.ru_maxrss / 1024;
}

static void million_springs(void)
{
  struct mo_lattice *lattice = NULL;
  struct mo_body *body = full_body(size, &lattice);
  REQUIRE(body != NULL);
  CHECK_INT(body->n_masses, 65 * 49 * 41);
  CHECK(body->n_springs > 1100000);
  struct mo_environment environment;
  mo_environment_training(1, 0, 0, &environment);
  struct mo_physics physics = mo_default_physics();
  physics.n_steps = 20;
  struct mo_outcome passive, driven;
  CHECK_INT(mo_rollout_reference(body, NULL, &environment, &physics, NULL, &passive), MO_OK);
  CHECK_INT(passive.diverged_step, 0);
  CHECK_NEAR(passive.loss, 1, 0.01);
  CHECK(passive.com_end_m[2] < passive.com_start_m[2]);
  printf("# %u masses, %u springs; peak memory of a passive body %.0f MiB\n", body->n_masses,
         body->n_springs, peak_mib());
  CHECK(peak_mib() < 512);

  struct mo_controller *controller = NULL;
  REQUIRE(mo_controller_create(size, MO_SENSOR_INVERSE_SQRT, &controller) == MO_OK);
  for (uint32_t i = 0; i < controller->n_springs; i++)
    controller->bias[3][i] = i % 2 ? 1.0F : -1.0F;
  physics.n_steps = 2;
  CHECK_INT(mo_rollout_reference(body, NULL, &environment, &physics, NULL, &passive), MO_OK);
  CHECK_INT(mo_rollout_reference(body, controller, &environment, &physics, NULL, &driven), MO_OK);
  CHECK_INT(driven.diverged_step, 0);
  CHECK(driven.com_end_m[2] != passive.com_end_m[2]);
  printf("# with a controller of %zu parameters: %.0f MiB\n", controller->n_parameters, peak_mib());
  CHECK(peak_mib() < 512 + 1.1 * (double)controller->n_parameters * sizeof(float) / (1 << 20));
  mo_controller_free(controller);
  mo_body_free(body);
  mo_lattice_free(lattice);
}

static const struct check_case cases[] = {{"a body of a million springs", million_springs}};
CHECK_MAIN(cases)
