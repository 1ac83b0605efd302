/* The float32 gradient of blocks against the float64 reference, and what does not change it. */
#include <morpho/gradient.h>

#include "../check.h"
#include "bodies.h"

#include <stdbool.h>

enum { ROBOTS = MO_GRADIENT_ROBOTS };

static struct mo_lattice *lattice;
static struct mo_controller *shipped, *fresh;
static struct mo_environment environments[ROBOTS];
static struct mo_robot robots[ROBOTS]; /* random distinct bodies; the first has one voxel, the last all of them */

static int setup(void)
{
  if (shipped != NULL)
    return 1;
  char path[4096];
  const char *root = getenv("MORPHO_SOURCE_DIR");
  snprintf(path, sizeof(path), "%s/data/controllers/bootstrap.safetensors", root != NULL ? root : ".");
  struct mo_body_stream *stream = NULL;
  if (mo_lattice_create(MO_DEFAULT_WORKSPACE, &lattice) != MO_OK || mo_controller_read(path, &shipped, NULL) != MO_OK ||
      mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQUARE, &fresh) != MO_OK ||
      mo_body_stream_create(MO_DEFAULT_WORKSPACE, 4, &stream) != MO_OK)
    return 0;
  mo_controller_randomize(fresh, 8);
  /* A norm's parameters that are not 1 and 0, biases that are not 0. */
  struct mo_random random;
  mo_random_init(&random, 9, MO_PURPOSE_CHECK, 0, 0);
  for (int l = 0; l <= MO_HIDDEN_LAYERS; l++) {
    for (uint32_t i = 0; i < (l < MO_HIDDEN_LAYERS ? MO_HIDDEN : fresh->n_springs); i++)
      fresh->bias[l][i] = (float)(0.2 * mo_random_uniform(&random) - 0.1);
    for (uint32_t i = 0; l < MO_HIDDEN_LAYERS && i < MO_HIDDEN; i++) {
      fresh->norm_gain[l][i] = (float)(0.5 + mo_random_uniform(&random));
      fresh->norm_shift[l][i] = (float)(0.4 * mo_random_uniform(&random) - 0.2);
    }
  }
  for (uint32_t i = 0; i < ROBOTS; i++) {
    uint64_t bits[MO_DEFAULT_WORDS] = {1};
    struct mo_body *body = NULL;
    mo_environment_training(6, 0, i, environments + i);
    if (i == ROBOTS - 1)
      for (uint32_t v = 0; v < MO_DEFAULT_VOXELS; v++)
        bits[v >> 6] |= UINT64_C(1) << (v & 63);
    else if (i > 0 && mo_body_stream_next(stream, bits) != MO_OK)
      return 0;
    mo_genotype_place(MO_DEFAULT_WORKSPACE, bits);
    if (mo_body_create(lattice, bits, &body) != MO_OK)
      return 0;
    robots[i] = (struct mo_robot){body, environments + i};
  }
  mo_body_stream_free(stream);
  return 1;
}

/* One call with everything that it needs. */
struct result {
  float *d;
  struct mo_outcome outcomes[ROBOTS];
  struct mo_gradient_counts counts;
  struct mo_gradient_profile profile;
  int status;
};

static struct result block(const struct mo_controller *controller, enum mo_isa isa, const struct mo_robot *list,
                           uint32_t n, const struct mo_physics *physics, const struct mo_gradient_options *options,
                           size_t budget, const struct mo_pause_point *pause)
{
  struct result result = {.status = MO_ERR_NO_MEMORY};
  struct mo_gradient_pack *pack = NULL;
  struct mo_gradient_memory *memory = NULL;
  result.d = calloc(controller->n_parameters, sizeof(float));
  if (result.d != NULL && mo_gradient_pack_create(controller, isa, &pack) == MO_OK &&
      mo_gradient_memory_create(budget, &memory) == MO_OK)
    result.status = mo_gradient_block(memory, pack, list, n, physics, options, pause, &result.profile, result.outcomes,
                                      result.d, &result.counts);
  mo_gradient_memory_free(memory);
  mo_gradient_pack_free(pack);
  return result;
}

static struct mo_physics physics_of(uint32_t n_steps)
{
  struct mo_physics physics = mo_default_physics();
  physics.n_steps = n_steps;
  return physics;
}

struct tensor {
  size_t first, count;
};

/* In the order of the file. */
static void tensors(const struct mo_controller *c, struct tensor *list)
{
  struct tensor *t = list;
  for (int l = 0; l <= MO_HIDDEN_LAYERS; l++) {
    const size_t rows = l < MO_HIDDEN_LAYERS ? MO_HIDDEN : c->n_springs, width = l == 0 ? c->n_inputs : MO_HIDDEN;
    *t++ = (struct tensor){(size_t)(c->weight[l] - c->parameters), rows * width};
    *t++ = (struct tensor){(size_t)(c->bias[l] - c->parameters), rows};
    if (l == MO_HIDDEN_LAYERS)
      break;
    *t++ = (struct tensor){(size_t)(c->norm_gain[l] - c->parameters), rows};
    *t++ = (struct tensor){(size_t)(c->norm_shift[l] - c->parameters), rows};
  }
}

/* |a − b| / |b| of one tensor. */
static double difference(const float *a, const double *b, struct tensor t)
{
  double error = 0, size = 0;
  for (size_t i = t.first; i < t.first + t.count; i++) {
    error += (a[i] - b[i]) * (a[i] - b[i]);
    size += b[i] * b[i];
  }
  return sqrt(error / size);
}

/* Each tensor of the block's gradient against the sum of the robots' references. */
static void compare(const char *name, const struct mo_controller *controller, enum mo_isa isa,
                    const struct mo_robot *list, uint32_t n, const struct mo_physics *physics, double bound,
                    double tolerance)
{
  const struct mo_gradient_options options = {.adjoint_bound = bound, .weight = 0.25};
  struct mo_gradient_counts counts = {0};
  struct tensor list_of[MO_CONTROLLER_TENSORS];
  double *reference = calloc(controller->n_parameters, sizeof(double));
  REQUIRE(reference != NULL);
  struct result fast = block(controller, isa, list, n, physics, &options, MO_GRADIENT_DEFAULT_BYTES, NULL);
  CHECK_INT(fast.status, MO_OK);
  for (uint32_t i = 0; i < n; i++) {
    struct mo_outcome outcome;
    REQUIRE(mo_gradient_reference(list[i].body, controller, list[i].environment, physics, &options, &outcome, reference,
                                  &counts) == MO_OK);
    CHECK_INT(fast.outcomes[i].diverged_step, outcome.diverged_step);
    CHECK_NEAR(fast.outcomes[i].loss, outcome.loss, tolerance);
  }
  tensors(controller, list_of);
  double worst = 0;
  for (int t = 0; t < MO_CONTROLLER_TENSORS; t++) {
    const double error = difference(fast.d, reference, list_of[t]);
    if (!(error <= tolerance))
      printf("# %s, tensor %d: %.3g\n", name, t, error);
    CHECK(error <= tolerance);
    worst = fmax(worst, error);
  }
  printf("# %-40s %-7s worst tensor's relative error %.2e\n", name, mo_isa_name(isa), worst);
  CHECK_INT(fast.counts.robots, counts.robots);
  CHECK_INT(fast.counts.steps, counts.steps);
  CHECK_INT(fast.counts.diverged_robots, counts.diverged_robots);
  CHECK_INT(fast.counts.zeroed_robots, counts.zeroed_robots);
  CHECK_INT(fast.profile.robot_steps, (uint64_t)n * physics->n_steps);
  free(fast.d);
  free(reference);
}

static void agrees_on_few_steps(void)
{
  REQUIRE(setup());
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    struct mo_physics physics = physics_of(13); /* a chunk and a part of one */
    compare("32 robots, random weights", fresh, (enum mo_isa)isa, robots, ROBOTS, &physics, MO_ADJOINT_BOUND, 2e-4);
    compare("32 robots, trained", shipped, (enum mo_isa)isa, robots, ROBOTS, &physics, 0, 2e-4);
    compare("one voxel", fresh, (enum mo_isa)isa, robots, 1, &physics, MO_ADJOINT_BOUND, 2e-4);
    compare("all voxels", fresh, (enum mo_isa)isa, robots + ROBOTS - 1, 1, &physics, MO_ADJOINT_BOUND, 2e-4);
    compare("5 robots", shipped, (enum mo_isa)isa, robots + 7, 5, &physics, MO_ADJOINT_BOUND, 2e-4);
    physics.n_steps = 1;
    compare("1 step", fresh, (enum mo_isa)isa, robots, 17, &physics, MO_ADJOINT_BOUND, 2e-4);
    physics.n_steps = 40;
    physics.impact = MO_IMPACT_BISECTION;
    compare("bisection", shipped, (enum mo_isa)isa, robots + 3, 4, &physics, MO_ADJOINT_BOUND, 2e-2);
  }
}

static const struct check_case cases[] = {
    {"a few steps agree with the reference, tensor by tensor", agrees_on_few_steps},
};
CHECK_MAIN(cases)
