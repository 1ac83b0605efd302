/* grids.c: rollouts on terrain grids of other sizes than 8 × 8: with that size they have the bits
 * of the usual grid; refined, they are the same ground; and the kernels follow the reference.
 * gradient-dual.c compares the reference's derivative with dual numbers, contact.c its times of
 * impact with a search. */
#include "lane-cases.h"
#include "task-cases.h"

static struct mo_lattice *lattice;
static struct mo_controller *controller;
static struct mo_robot *robots;
enum { BODIES = 6 };

static void setup(void)
{
  lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  controller = make_shipped_controller("phototaxis");
  robots = make_robots(lattice, 5, 5, BODIES);
}

/* ---- the same ground ---- */

/* The ground of an environment as a grid of 7 · times cells: with 1 that of the same heights. */
static void refine(const struct mo_environment *environment, uint32_t times,
                   struct mo_environment *refined)
{
  const uint32_t side = 7 * times + 1;
  const double spacing_m = MO_TERRAIN_SIZE_M / (side - 1);
  const struct mo_terrain_grid *made = NULL;
  double *heights_m = make_zeros((size_t)side * side, sizeof(double));
  for (uint32_t k = 0; k < side * side; k++)
    heights_m[k] =
        times == 1 ? environment->terrain_heights_m[k]
                   : mo_terrain_height(environment, k % side * spacing_m,
                                       k / side * spacing_m); // NOLINT(bugprone-integer-division)
  *refined = *environment;
  memset(refined->terrain_heights_m, 0, sizeof(refined->terrain_heights_m));
  make_check(mo_terrain_grid_create(side, side, spacing_m, heights_m, &made), "grid");
  refined->grid = check_keep((void *)(uintptr_t)made, drop_grid);
}

/* Losses and gradients, in the reference and in every kernel, bit for bit. */
static void usual_size(void)
{
  const struct mo_gradient_options options = {.weight = 1};
  const size_t n = controller->n_parameters;
  const uint32_t lanes[2] = {0, 1};
  for (uint32_t k = 0; k < 12; k++) {
    const size_t kept = check_n_kept;
    const struct mo_body *body = robots[k % BODIES].body;
    const struct mo_physics physics = ground_physics(k, 100);
    struct mo_environment both[2];
    struct mo_outcome outcomes[2];
    double *d[2] = {make_zeros(n, sizeof(double)), make_zeros(n, sizeof(double))};
    float *fast[2] = {make_zeros(n, sizeof(float)), make_zeros(n, sizeof(float))};
    mo_environment_training(35, 0, k, &both[0]);
    if (k % 3 == 2)
      both[0].task = task_case(k % TASK_CASES);
    refine(&both[0], 1, &both[1]);
    for (int i = 0; i < 2; i++)
      REQUIRE_OK(mo_gradient_reference(body, controller, &both[i], &physics, &options, &outcomes[i],
                                       d[i], NULL));
    CHECK(SAME(&outcomes[0], &outcomes[1], 1));
    CHECK(memcmp(d[0], d[1], n * sizeof(double)) == 0);
    for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
      for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++) {
        const struct mo_pack *pack =
            make_pack(controller, (enum mo_isa)isa, (enum mo_precision)precision);
        for (uint32_t i = 0; i < 2; i++) /* alone: the usual one from its table */
          block_of(pack, body, both, lanes + i, 1, &physics, &outcomes[i]);
        CHECK(SAME(&outcomes[0], &outcomes[1], 1));
        struct mo_outcome together[2];
        block_of(pack, body, both, lanes, 2, &physics, together);
        CHECK(SAME(&outcomes[0], &together[0], 1) && SAME(&outcomes[0], &together[1], 1));
      }
      const struct mo_pack *pack = make_gradient_pack(controller, (enum mo_isa)isa);
      struct mo_gradient_memory *memory = make_gradient_memory(MO_GRADIENT_DEFAULT_BYTES);
      for (int i = 0; i < 2; i++) {
        const struct mo_robot robot = {body, &both[i], NULL};
        REQUIRE_OK(mo_gradient_block(memory, pack, &robot, 1, &physics, &options, NULL,
                                     &outcomes[i], fast[i], NULL));
      }
      CHECK(SAME(&outcomes[0], &outcomes[1], 1));
      CHECK(memcmp(fast[0], fast[1], n * sizeof(float)) == 0);
    }
    check_drop_to(kept);
  }
}

/* The edges of finer cells are not edges of the ground, so only rounding differs. */
static void refined(void)
{
  const uint32_t lanes[2] = {0, 1};
  double worst[3] = {0, 0, 0};
  for (uint32_t k = 0; k < 12; k++) {
    const size_t kept = check_n_kept;
    const struct mo_body *body = robots[k % BODIES].body;
    const struct mo_physics physics = ground_physics(k, 100);
    struct mo_environment both[2];
    struct mo_outcome outcomes[2];
    mo_environment_training(36, 0, k, &both[0]);
    refine(&both[0], 2 + k, &both[1]);
    for (int i = 0; i < 2; i++)
      REQUIRE_OK(
          mo_rollout_reference(body, controller, &both[i], &physics, NULL, NULL, &outcomes[i]));
    worst[2] = fmax(worst[2], apart(&outcomes[0], &outcomes[1]));
    for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++) {
      block_of(make_pack(controller, mo_isa_best(), (enum mo_precision)precision), body, both,
               lanes, 2, &physics, outcomes);
      worst[precision] = fmax(worst[precision], apart(&outcomes[0], &outcomes[1]));
    }
    check_drop_to(kept);
  }
  printf("# refined grids: %.1e apart; float32 %.1e, float64 %.1e\n", worst[2], worst[MO_FLOAT32],
         worst[MO_FLOAT64]);
  CHECK(worst[2] < 1e-10);
  CHECK(worst[MO_FLOAT64] < 1e-10);
  CHECK(worst[MO_FLOAT32] < 1e-4);
}

/* ---- kernels ---- */

/* Grids of all sizes, profiles and usual grids, some with tasks; the largest grid, with the finest
 * spacing, is among them. */
static void make_environments(struct mo_environment environments[LANES])
{
  for (uint32_t k = 0; k < LANES; k++) {
    mo_environment_training(32, 0, k, &environments[k]);
    if (k % 4 == 1)
      set_profile(&environments[k], k, 0.03);
    else if (k % 4 != 0)
      set_grid(&environments[k], k / 2, 0.03);
    if (k == 6)
      environments[k].grid = make_grid(MO_GRID_SIDE_MAX, MO_GRID_SIDE_MAX, 0.02, 1, 0.005);
    if (k % 5 == 3)
      environments[k].task = task_case(k % TASK_CASES);
  }
}

/* As in the reference, and with the bits of each lane by itself. */
static void kernels(void)
{
  struct mo_environment environments[LANES];
  make_environments(environments);
  follow_lives(controller, robots, environments, ground_physics, 60);
}

static void divergence(void)
{
  follow_divergence(controller, lattice, set_grid);
}

/* ---- the gradient's kernel ---- */

static void gradients(void)
{
  struct mo_environment environments[LANES];
  struct mo_robot own[LANES];
  make_environments(environments);
  for (uint32_t k = 0; k < LANES; k++)
    own[k] = (struct mo_robot){robots[k % BODIES].body, &environments[k], NULL};
  follow_gradients(controller, own, ground_physics, 1e-3);
}

static const struct check_case cases[] = {
    {"a grid of the usual size has the usual bits", usual_size},
    {"a refined grid is the same ground", refined},
    {"kernels follow the reference, each lane by itself", kernels},
    {"divergence stays in its lane", divergence},
    {"the gradient's kernel follows the reference", gradients},
};
CHECK_MAIN_WITH(setup, cases)
