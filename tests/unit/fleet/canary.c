/* canary.c: the canary depends on the class and on nothing else. */
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

static const struct check_case cases[] = {
    {"one hash for any number of workers", same_in_a_class},
    {"another hash for each instruction set", differs_between_classes},
};
CHECK_MAIN(cases)
