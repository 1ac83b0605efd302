/* The gradient of a batch: the same bits for any number of workers and whether or not urgent blocks overtake; cancelled, wrong and
 * out of memory it says so. */
#include <morpho/compute.h>

#include "../check.h"

#include <stdbool.h>

enum { ROBOTS = 150 };

static struct mo_controller *controller;
static struct mo_lattice *lattice;
static struct mo_body *bodies[ROBOTS];
static struct mo_environment environments[ROBOTS];
static struct mo_robot robots[ROBOTS];
static double *d_parameters[2];
static struct mo_outcome outcomes[2][ROBOTS];

static int setup(void)
{
  if (controller != NULL)
    return 1;
  struct mo_body_stream *stream = NULL;
  if (mo_lattice_create(MO_DEFAULT_WORKSPACE, &lattice) != MO_OK ||
      mo_body_stream_create(MO_DEFAULT_WORKSPACE, 3, &stream) != MO_OK ||
      mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &controller) != MO_OK)
    return 0;
  mo_controller_randomize(controller, 5);
  for (uint32_t i = 0; i < ROBOTS; i++) {
    uint64_t bits[MO_DEFAULT_WORDS];
    if (mo_body_stream_next(stream, bits) != MO_OK || mo_body_create(lattice, bits, &bodies[i]) != MO_OK)
      return 0;
    mo_environment_training(3, 0, i, environments + i);
    robots[i] = (struct mo_robot){bodies[i], environments + i};
  }
  mo_body_stream_free(stream);
  for (int k = 0; k < 2; k++)
    d_parameters[k] = malloc(controller->n_parameters * sizeof(double));
  return d_parameters[0] != NULL && d_parameters[1] != NULL;
}

static struct mo_compute *make_compute(uint32_t n_workers)
{
  struct mo_compute *compute = NULL;
  const struct mo_compute_config config = {.n_workers = n_workers, .isa = mo_isa_best(), .nice = 1};
  return mo_compute_create_cpu(&config, &compute) == MO_OK ? compute : NULL;
}

static struct mo_gradient_batch make_batch(uint32_t n, uint32_t n_steps, int result)
{
  struct mo_gradient_batch batch = {.controller = controller,
                                    .robots = robots,
                                    .n = n,
                                    .physics = mo_default_physics(),
                                    .adjoint_bound = MO_ADJOINT_BOUND,
                                    .tag = 7,
                                    .d_parameters = d_parameters[result],
                                    .outcomes = outcomes[result]};
  batch.physics.n_steps = n_steps;
  return batch;
}

static bool same_counts(const struct mo_gradient_counts *a, const struct mo_gradient_counts *b)
{
  return a->robots == b->robots && a->steps == b->steps && a->clipped_steps == b->clipped_steps &&
         a->clipped_robots == b->clipped_robots && a->zeroed_robots == b->zeroed_robots &&
         a->diverged_robots == b->diverged_robots && a->largest == b->largest;
}

static bool same_results(uint32_t n)
{
  return memcmp(d_parameters[0], d_parameters[1], controller->n_parameters * sizeof(double)) == 0 &&
         memcmp(outcomes[0], outcomes[1], n * sizeof(outcomes[0][0])) == 0;
}

static void same_bits_for_any_workers(void)
{
  REQUIRE(setup());
  static const uint32_t workers[] = {1, 2, 7};
  struct mo_gradient_counts first = {0};
  for (int run = 0; run < 3; run++) {
    struct mo_compute *compute = make_compute(workers[run]);
    struct mo_gradient_state *state = NULL;
    REQUIRE(compute != NULL && mo_gradient_state_create(compute, &state) == MO_OK);
    for (int again = 0; again < 2; again++) { /* the second call finds everything made */
      struct mo_gradient_batch batch = make_batch(ROBOTS, 40, run == 0 && again == 0 ? 0 : 1);
      CHECK_INT(mo_compute_gradient(state, &batch), MO_OK);
      CHECK_INT(batch.counts.robots, ROBOTS);
      CHECK_INT(batch.counts.steps, ROBOTS * 40);
      CHECK_INT(batch.profile.robot_steps, ROBOTS * 40);
      if (run == 0 && again == 0)
        first = batch.counts;
      else
        CHECK(same_results(ROBOTS) && same_counts(&batch.counts, &first));
    }
    struct mo_compute_stats stats;
    mo_compute_get_stats(compute, &stats);
    CHECK_INT(stats.gradient_robots_done, 2 * ROBOTS);
    CHECK_INT(stats.gradient_robots_diverged + stats.gradient_robots_zeroed, 0);
    CHECK_INT(stats.blocks_done, 2 * ((ROBOTS + MO_GRADIENT_ROBOTS - 1) / MO_GRADIENT_ROBOTS));
    CHECK_INT(stats.rollouts_done, 0);
    mo_gradient_state_free(state);
    mo_compute_free(compute);
  }
  double largest = 0;
  for (size_t i = 0; i < controller->n_parameters; i++)
    largest = fmax(largest, fabs(d_parameters[0][i]));
  CHECK(largest > 0);
}

/* The batch's gradient is the mean of its robots' gradients, each robot's outcome is its own. */
static void it_is_the_mean(void)
{
  REQUIRE(setup());
  enum { N = 40, STEPS = 60 };
  struct mo_compute *compute = make_compute(2);
  struct mo_gradient_state *state = NULL;
  REQUIRE(compute != NULL && mo_gradient_state_create(compute, &state) == MO_OK);
  struct mo_gradient_batch batch = make_batch(N, STEPS, 0);
  CHECK_INT(mo_compute_gradient(state, &batch), MO_OK);
  const size_t n = controller->n_parameters;
  const struct mo_gradient_options options = {.adjoint_bound = MO_ADJOINT_BOUND, .weight = 1.0 / N};
  memset(d_parameters[1], 0, n * sizeof(double));
  for (uint32_t i = 0; i < N; i++) {
    CHECK_INT(mo_gradient_reference(bodies[i], controller, environments + i, &batch.physics, &options, outcomes[1] + i,
                                    d_parameters[1], NULL),
              MO_OK);
    CHECK_NEAR(outcomes[0][i].loss, outcomes[1][i].loss, 1e-3);
    for (int axis = 0; axis < 3; axis++)
      CHECK_NEAR(outcomes[0][i].com_end_m[axis], outcomes[1][i].com_end_m[axis], 1e-3);
  }
  double ab = 0, aa = 0, bb = 0;
  for (size_t i = 0; i < n; i++) {
    ab += d_parameters[0][i] * d_parameters[1][i];
    aa += d_parameters[0][i] * d_parameters[0][i];
    bb += d_parameters[1][i] * d_parameters[1][i];
  }
  printf("# %d robots, %d steps: 1 - cosine %.2g, norm %.9g against %.9g\n", N, STEPS, 1 - ab / sqrt(aa * bb), sqrt(aa),
         sqrt(bb));
  CHECK(bb > 0);
  CHECK(ab / sqrt(aa * bb) > 0.99999);
  CHECK_NEAR(sqrt(aa / bb), 1.0, 1e-3);
  mo_gradient_state_free(state);
  mo_compute_free(compute);
}

static const struct check_case cases[] = {
    {"the same bits for any workers", same_bits_for_any_workers},
    {"it is the mean", it_is_the_mean},
};
CHECK_MAIN(cases)
