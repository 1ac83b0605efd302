/* canary.c: the canary depends only on the class. */
#include <math.h>

#include "fleet/fleet.h"
#include "rollout/fast.h"

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

static bool is_wrong, is_skipped;

int __wrap_mo_gradient_block(struct mo_gradient_memory *memory, const struct mo_pack *pack,
                             const struct mo_robot *robots, uint32_t n,
                             const struct mo_physics *physics,
                             const struct mo_gradient_options *options,
                             const struct mo_pause_point *pause, struct mo_outcome *outcomes,
                             float *d_parameters, struct mo_gradient_counts *counts)
{
  if (is_skipped) {
    *counts = (struct mo_gradient_counts){.robots = n};
    memset(outcomes, 0, n * sizeof(*outcomes));
    memset(d_parameters, 0, pack->n_parameters * sizeof(*d_parameters));
    return MO_OK;
  }
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

/* The results of the first canary, in the order of its rollouts: the others need only be spoilt. */
static struct {
  struct mo_outcome outcomes[MO_BLOCK_LANES];
  double measures[MO_BLOCK_LANES][MO_MEASURES];
} kept[32];
static unsigned at; /* the next of them */
static enum { COMPUTE, KEEP, REPEAT } mode;

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
  int error = MO_OK;
  CHECK(measuring != NULL && at < COUNT(kept));
  if (mode == REPEAT) {
    memcpy(outcomes, kept[at].outcomes, n_environments * sizeof(*outcomes));
    memcpy(measuring->values, kept[at].measures, n_environments * sizeof(*kept[at].measures));
  } else {
    error = __real_mo_rollout_block_window(memory, pack, body, environments, n_environments,
                                           physics, states, recordings, measuring, pause, outcomes);
  }
  if (mode == KEEP) {
    memcpy(kept[at].outcomes, outcomes, n_environments * sizeof(*outcomes));
    memcpy(kept[at].measures, measuring->values, n_environments * sizeof(*kept[at].measures));
  }
  at += mode != COMPUTE;
  for (uint32_t i = 0; i < n_environments; i++)
    spoil(environments[i], measuring->values[i], &outcomes[i]);
  return error;
}

/* The canary of one worker, without gradients: computed, or from the results of the one before. */
static struct mo_sha256 rollouts_only(bool repeats)
{
  mode = repeats ? REPEAT : KEEP;
  at = 0;
  is_skipped = true;
  const struct mo_sha256 hash = canary(mo_isa_best(), 1);
  is_skipped = false;
  mode = COMPUTE;
  return hash;
}

/* Returns the hash of the right results, which are then kept. */
static struct mo_sha256 right_rollouts(void)
{
  spoilt.what = NOTHING;
  const struct mo_sha256 right = rollouts_only(false), again = rollouts_only(true);
  CHECK(mo_sha256_equal(&right, &again));
  return right;
}

static void differs_by_a_measure(void)
{
  const struct mo_sha256 right = right_rollouts();
  for (unsigned m = 0; m < MO_MEASURES; m++) {
    spoilt.what = A_MEASURE;
    spoilt.measure = m;
    const struct mo_sha256 wrong = rollouts_only(true);
    CHECK(!mo_sha256_equal(&right, &wrong));
  }
  spoilt.what = NOTHING;
}

static void differs_by_an_objective(void)
{
  objectives = 0;
  const struct mo_sha256 right = right_rollouts();
  const uint64_t all = (UINT64_C(1) << (MO_OBJECTIVE_JUMP + 1)) - 1;
  CHECK(objectives == (all | UINT64_C(1) << 63));
  for (int k = 0; k <= MO_OBJECTIVE_JUMP + 1; k++) {
    spoilt.what = A_LOSS;
    spoilt.objective = k <= MO_OBJECTIVE_JUMP ? (enum mo_objective)k : MO_OBJECTIVE_SUM;
    const struct mo_sha256 wrong = rollouts_only(true);
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
