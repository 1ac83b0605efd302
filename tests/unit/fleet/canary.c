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

/* Changes one result of one rollout. */
typeof(mo_rollout_block_window) __real_mo_rollout_block_window, __wrap_mo_rollout_block_window;

static struct {
  enum { NOTHING, A_MEASURE, A_LOSS } what;
  unsigned measure;
  enum mo_objective objective;
} spoilt;
static uint64_t objectives; /* that were computed, as bits */

static void spoil(const struct mo_environment *environment, double *measures,
                  struct mo_outcome *outcome)
{
  const enum mo_objective objective = environment->task.objective;
  objectives |= UINT64_C(1) << (objective == MO_OBJECTIVE_SUM ? 63 : objective);
  CHECK(measures != NULL);
  if (spoilt.what == A_MEASURE)
    measures[spoilt.measure] += 1 / mo_measure_info[spoilt.measure].steps_in_one;
  if (spoilt.what == A_LOSS && objective == spoilt.objective)
    outcome->loss = nextafter(outcome->loss, 2);
}

int __wrap_mo_rollout_block_window(struct mo_workspace_memory *memory, const struct mo_pack *pack,
                                   const struct mo_body *body,
                                   const struct mo_environment *const *environments,
                                   uint32_t n_environments, const struct mo_physics *physics,
                                   const struct mo_states *states,
                                   const struct mo_recording *recordings,
                                   const struct mo_measuring *measuring,
                                   const struct mo_pause_point *pause, struct mo_outcome *outcomes)
{
  const int error =
      __real_mo_rollout_block_window(memory, pack, body, environments, n_environments, physics,
                                     states, recordings, measuring, pause, outcomes);
  for (uint32_t i = 0; i < n_environments; i++)
    spoil(environments[i], measuring != NULL ? measuring->values[i] : NULL, &outcomes[i]);
  return error;
}

static void differs_by_a_measure(void)
{
  const struct mo_sha256 right = canary(mo_isa_best(), 1);
  for (unsigned m = 0; m < MO_MEASURES; m++) {
    spoilt.what = A_MEASURE;
    spoilt.measure = m;
    const struct mo_sha256 wrong = canary(mo_isa_best(), 1);
    CHECK(!mo_sha256_equal(&right, &wrong));
  }
  spoilt.what = NOTHING;
}

static void differs_by_an_objective(void)
{
  objectives = 0;
  const struct mo_sha256 right = canary(mo_isa_best(), 1);
  const uint64_t all = (UINT64_C(1) << (MO_OBJECTIVE_JUMP + 1)) - 1;
  CHECK(objectives == (all | UINT64_C(1) << 63));
  for (int k = 0; k <= MO_OBJECTIVE_JUMP + 1; k++) {
    spoilt.what = A_LOSS;
    spoilt.objective = k <= MO_OBJECTIVE_JUMP ? (enum mo_objective)k : MO_OBJECTIVE_SUM;
    const struct mo_sha256 wrong = canary(mo_isa_best(), 1);
    CHECK(!mo_sha256_equal(&right, &wrong));
  }
  spoilt.what = NOTHING;
}

static const struct check_case cases[] = {
    {"one hash for any number of workers", same_in_a_class},
    {"another hash for each instruction set", differs_between_classes},
    {"a wrong bit of a gradient changes the hash", differs_by_a_gradient},
    {"a wrong measure of any kind changes the hash", differs_by_a_measure},
    {"a wrong loss of any objective changes the hash", differs_by_an_objective},
};
CHECK_MAIN(cases)
