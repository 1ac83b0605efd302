/* profiles.c: rollouts on terrain profiles: in the reference compared with a grid of the same
 * shape, in the kernels with the reference. gradient-dual.c compares the reference's derivative
 * with dual numbers, contact.c its times of impact with a search. */
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

/* ---- the same plane twice ---- */

/* h = 0.5 + slope · x for 0 ≤ x ≤ 5 m, as a grid and as a profile. */
static void make_plane(double slope, struct mo_environment *grid, struct mo_environment *profile)
{
  mo_environment_training(3, 0, 0, grid);
  *profile = *grid;
  profile->n_profile = MO_TERRAIN_HEIGHTS;
  profile->profile_spacing_m = MO_TERRAIN_SIZE_M / (MO_TERRAIN_HEIGHTS - 1);
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++) {
    grid->terrain_heights_m[k] =
        0.5 + slope * (k % MO_TERRAIN_SIDE * MO_TERRAIN_SIZE_M / (MO_TERRAIN_SIDE - 1));
    profile->terrain_heights_m[k] = 0.5 + slope * k * profile->profile_spacing_m;
  }
}

static void planes(void)
{
  static const double slopes[] = {0, 0.3, -0.5};
  const struct mo_gradient_options options = {.weight = 1};
  const size_t n = controller->n_parameters;
  const uint32_t lanes[2] = {0, 1};
  double worst = 0, worst_gradient = 0, worst_kernel[2] = {0, 0};
  for (uint32_t k = 0; k < 12; k++) {
    const size_t kept = check_n_kept;
    const struct mo_body *body = robots[k % BODIES].body;
    const struct mo_physics physics = ground_physics(k, 60);
    struct mo_environment both[2];
    struct mo_outcome reference[2], outcomes[2];
    double *d[2] = {make_zeros(n, sizeof(double)), make_zeros(n, sizeof(double))}, error = 0,
           size = 0;
    make_plane(slopes[k % COUNT(slopes)], &both[0], &both[1]);
    for (int i = 0; i < 2; i++)
      REQUIRE_OK(mo_gradient_reference(body, controller, &both[i], &physics, &options,
                                       &reference[i], d[i], NULL));
    for (size_t i = 0; i < n; i++) {
      error += (d[0][i] - d[1][i]) * (d[0][i] - d[1][i]);
      size += d[0][i] * d[0][i];
    }
    CHECK(size > 0);
    worst = fmax(worst, apart(&reference[0], &reference[1]));
    worst_gradient = fmax(worst_gradient, sqrt(error / size));
    for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++) {
      block_of(make_pack(controller, mo_isa_best(), (enum mo_precision)precision), body, both,
               lanes, 2, &physics, outcomes);
      worst_kernel[precision] = fmax(worst_kernel[precision], apart(&outcomes[0], &outcomes[1]));
    }
    check_drop_to(kept);
  }
  printf("# a plane as a grid and as a profile: %.1e apart, gradients %.1e; float32 %.1e, float64 "
         "%.1e\n",
         worst, worst_gradient, worst_kernel[MO_FLOAT32], worst_kernel[MO_FLOAT64]);
  CHECK(worst < 1e-10);
  CHECK(worst_gradient < 1e-8);
  CHECK(worst_kernel[MO_FLOAT64] < 1e-10);
  CHECK(worst_kernel[MO_FLOAT32] < 1e-4);
}

/* ---- kernels ---- */

/* Profiles, families and grids, some with tasks. */
static void make_environments(struct mo_environment environments[LANES])
{
  for (uint32_t k = 0; k < LANES; k++) {
    struct mo_terrain_recipe recipe =
        mo_terrain_recipe_default((enum mo_terrain_family)(k % (MO_TERRAIN_STEPS + 1)));
    recipe.seed = k;
    mo_environment_training(32, 0, k, &environments[k]);
    if (k % 3 == 1)
      make_check(mo_terrain_draw(&recipe, &environments[k], NULL), "terrain");
    else if (k % 3 == 2)
      set_profile(&environments[k], k, 0.03);
    if (k % 4 == 3)
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

/* Recorded masses are on the profile or above it, at every step, and none leaves the world. */
static void never_below(void)
{
  enum { STEPS = CHECK_SANITIZED ? 100 : 300 };
  struct mo_environment environments[LANES];
  const struct mo_environment *list[LANES];
  const struct mo_body *body = robots[1].body;
  const size_t n = (size_t)(STEPS + 1) * body->n_masses;
  float *mass = make_zeros(LANES * n * 3, sizeof(float));
  for (uint32_t l = 0; l < LANES; l++) {
    mo_environment_training(33, 0, l, &environments[l]);
    set_profile(&environments[l], l, 0.03);
    list[l] = &environments[l];
  }
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)
    for (uint32_t variant = 0; variant < 4; variant++) {
      const struct mo_physics physics = ground_physics(variant, STEPS);
      const struct mo_pack *pack =
          make_pack(controller, (enum mo_isa)isa, variant < 2 ? MO_FLOAT32 : MO_FLOAT64);
      struct mo_recording recordings[LANES];
      struct mo_outcome outcomes[LANES];
      for (uint32_t l = 0; l < LANES; l++)
        recordings[l] = (struct mo_recording){.stride = 1, .mass_m = mass + l * n * 3};
      REQUIRE_OK(mo_rollout_block(make_workspace_memory(), pack, body, list, LANES, &physics,
                                  recordings, NULL, NULL, outcomes));
      double deepest = 0;
      for (uint32_t l = 0; l < LANES; l++)
        for (size_t i = 0; i < n; i++) {
          const float *p = mass + (l * n + i) * 3;
          deepest = fmax(deepest, mo_terrain_height(&environments[l], p[0], p[1]) - p[2]);
        }
      CHECK(deepest <= 1e-6); /* recordings are float32, whatever the precision of the rollout */
    }
}

static void divergence(void)
{
  follow_divergence(controller, lattice, set_profile);
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

/* ---- behavior ---- */

/* Robots that follow a light ahead get less far uphill, and farther downhill, than on level
 * ground. */
static void slopes(void)
{
  enum { WALKERS = CHECK_SANITIZED ? 4 : 12, N = 3 };
  static const double degrees[N] = {-8, 0, 8};
  const struct mo_pack *pack = make_pack(controller, mo_isa_best(), MO_FLOAT32);
  const struct mo_robot *walkers = make_robots(lattice, 1, 1, WALKERS);
  const uint32_t lanes[N] = {0, 1, 2};
  struct mo_environment environments[N];
  double way_m[N] = {0, 0, 0};
  for (int k = 0; k < N; k++) {
    struct mo_terrain_recipe recipe = mo_terrain_recipe_default(MO_TERRAIN_SLOPE);
    recipe.degrees = degrees[k];
    environments[k] = (struct mo_environment){
        .light_xy_m = {4, 2.5},
        .task = {{.kind = MO_GUIDE_AHEAD, .distance_m = MO_GUIDE_DISTANCE_M}, MO_OBJECTIVE_TRAVEL}};
    REQUIRE_OK(mo_terrain_draw(&recipe, &environments[k], NULL));
  }
  for (uint32_t i = 0; i < WALKERS; i++) {
    const struct mo_physics physics = physics_of(1000);
    struct mo_outcome outcomes[N];
    block_of(pack, walkers[i].body, environments, lanes, N, &physics, outcomes);
    for (int k = 0; k < N; k++)
      way_m[k] += outcomes[k].value / WALKERS;
  }
  printf("# way in 4 s, mean of %d bodies: %.2f m down 8 degrees, %.2f m on level ground, %.2f m "
         "up\n",
         WALKERS, way_m[0], way_m[1], way_m[2]);
  CHECK(way_m[1] > 0.3);
  CHECK(way_m[0] > 1.05 * way_m[1] && way_m[2] < 0.95 * way_m[1]);
}

static const struct check_case cases[] = {
    {"a plane is the same as a grid and as a profile", planes},
    {"kernels follow the reference, each lane by itself", kernels},
    {"no mass is below a profile", never_below},
    {"divergence stays in its lane", divergence},
    {"the gradient's kernel follows the reference", gradients},
    {"uphill is slower than downhill", slopes},
};
CHECK_MAIN_WITH(setup, cases)
