/* canary.c: the canary depends only on the class. */
#include <math.h>

#include "fleet/fleet.h"

#include "../check.h"

static struct mo_sha256 canary(enum mo_isa isa, uint32_t n_workers)
{
  struct mo_compute *compute = NULL;
  struct mo_sha256 hash = {{0}};
  const struct mo_compute_config config = {.n_workers = n_workers, .isa = isa};
  CHECK_INT(mo_compute_create_cpu(&config, &compute), MO_OK);
  CHECK_INT(mo_fleet_canary(compute, MO_ON_CPU, &hash), MO_OK);
  mo_compute_free(compute);
  return hash;
}

static void same_in_a_class(void)
{
  const struct mo_sha256 one = canary(mo_isa_best(), 1), three = canary(mo_isa_best(), 3);
  CHECK(mo_sha256_equal(&one, &three));
}

static void differs_between_classes(void)
{
  struct mo_sha256 hashes[MO_ISA_COUNT];
  for (int a = 0; a <= (int)mo_isa_best(); a++) {
    hashes[a] = canary((enum mo_isa)a, 2);
    for (int b = 0; b < a; b++)
      CHECK(!mo_sha256_equal(&hashes[a], &hashes[b]));
  }
}

/* Flips one bit of one parameter in the gradient of one block. */
typeof(mo_gradient_block) __real_mo_gradient_block, __wrap_mo_gradient_block;

static bool is_wrong;

int __wrap_mo_gradient_block(struct mo_gradient_memory *memory, const struct mo_pack *pack,
                             const struct mo_robot *robots, uint32_t n,
                             const struct mo_physics *physics,
                             const struct mo_gradient_options *options,
                             const struct mo_pause_point *pause, struct mo_outcome *outcomes,
                             float *d_parameters, struct mo_gradient_counts *counts)
{
  const int error = __real_mo_gradient_block(memory, pack, robots, n, physics, options, pause,
                                             outcomes, d_parameters, counts);
  CHECK(error == MO_OK && counts->diverged_robots == 0 && counts->zeroed_robots == 0);
  if (is_wrong && n < MO_GRADIENT_ROBOTS)
    d_parameters[7] = nextafterf(d_parameters[7], 1);
  return error;
}

static void differs_by_a_gradient(void)
{
  const struct mo_sha256 right = canary(mo_isa_best(), 2);
  is_wrong = true;
  const struct mo_sha256 wrong = canary(mo_isa_best(), 2);
  is_wrong = false;
  CHECK(!mo_sha256_equal(&right, &wrong));
}

static const struct check_case cases[] = {
    {"one hash for any number of workers", same_in_a_class},
    {"another hash for each instruction set", differs_between_classes},
    {"a wrong bit of a gradient changes the hash", differs_by_a_gradient},
};
CHECK_MAIN(cases)
