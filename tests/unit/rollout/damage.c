/* damage.c: springs that break: which, when, and in the kernels as in the reference.
 * gradient-dual.c compares the reference's derivative with dual numbers. */
#include "rollout/damage.h"
#include "lane-cases.h"

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

static struct mo_physics physics_number(uint32_t k, uint32_t n_steps)
{
  struct mo_physics physics = physics_of(n_steps);
  physics.scheme.integrator = k % 2 == 0 ? MO_INTEGRATOR_PAPER : MO_INTEGRATOR_SPLIT;
  physics.scheme.control_period_s = k % 4 >= 2 ? 4 * physics.scheme.dt_s : 0;
  return physics;
}

/* Every octant, at different times, beside whole bodies; some from the start, one never. */
static void make_environments(struct mo_environment environments[LANES])
{
  for (uint32_t k = 0; k < LANES; k++) {
    mo_environment_training(32, 0, k, &environments[k]);
    if (k % 3 != 2)
      environments[k].damage = (struct mo_damage){1 + k % MO_OCTANTS, k < 13 ? 0.02 * k : 1000};
  }
}

/* Each spring is in one octant; mirrored octants of a full body have as many springs, but for those
 * in the middle. */
static void octants(void)
{
  for (uint32_t b = 0; b <= BODIES; b++) {
    const struct mo_body *body = b < BODIES ? robots[b].body : make_full_body(lattice);
    uint8_t *cut = make_zeros(body->n_springs, 1), *sum = make_zeros(body->n_springs, 1);
    uint32_t n[MO_OCTANTS] = {0};
    for (uint32_t octant = 0; octant < MO_OCTANTS; octant++) {
      const struct mo_environment environment = {.damage = {1 + octant, 0}};
      mo_damage_mark(&environment, body, cut);
      for (uint32_t s = 0; s < body->n_springs; s++) {
        sum[s] += cut[s];
        n[octant] += cut[s];
      }
    }
    for (uint32_t s = 0; s < body->n_springs; s++)
      CHECK_INT(sum[s], 1);
    if (b == BODIES)
      for (uint32_t octant = 1; octant < MO_OCTANTS; octant++)
        CHECK(n[octant] > n[0] && n[octant] <= n[MO_OCTANTS - 1]);
  }
}

static void times(void)
{
  static const struct {
    double time_s, dt_s;
    uint32_t step;
  } tries[] = {{0, 0.002, 0},      {2, 0.002, 1000}, {2, 0.004, 500},    {0.0019, 0.002, 1},
               {0.3, 0.1, 3},      {0.7, 0.1, 7},    {0.0021, 0.002, 2}, {3600, 1e-9, UINT32_MAX},
               {1.2, 0.0004, 3000}};
  for (size_t i = 0; i < COUNT(tries); i++) {
    struct mo_environment environment = {.damage = {1, tries[i].time_s}};
    const struct mo_scheme scheme = {.dt_s = tries[i].dt_s};
    CHECK_INT(mo_damage_step(&environment, &scheme), tries[i].step);
    environment.damage = (struct mo_damage){0, 0};
    CHECK_INT(mo_damage_step(&environment, &scheme), UINT32_MAX);
  }
}

/* As in the reference, and with the bits of each lane by itself: so whole bodies, and bodies that
 * break later, have the bits that they have without damage beside them. */
static void kernels(void)
{
  static const uint32_t alone[LANES] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
  struct mo_environment environments[LANES], whole;
  struct mo_outcome exact[4][LANES];
  make_environments(environments);
  reference_lives(controller, robots, environments, physics_number, 60, exact);
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)
    for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++) {
      const size_t kept = check_n_kept;
      const struct mo_pack *pack =
          make_pack(controller, (enum mo_isa)isa, (enum mo_precision)precision);
      double worst = 0;
      uint32_t changed = 0;
      for (uint32_t variant = 0; variant < 4; variant++) {
        const struct mo_body *body = robots[variant].body;
        const struct mo_physics physics = physics_number(variant, 60);
        struct mo_outcome outcomes[LANES], one, other;
        block_of(pack, body, environments, alone, LANES, &physics, outcomes);
        for (uint32_t k = 0; k < LANES; k++) {
          block_of(pack, body, environments, alone + k, 1, &physics, &one);
          CHECK(SAME(&one, &outcomes[k], 1));
          CHECK(isfinite(apart(&exact[variant][k], &one))); /* fmax ignores NaN */
          worst = fmax(worst, apart(&exact[variant][k], &one));
          whole = environments[k];
          whole.damage = (struct mo_damage){0, 0};
          block_of(pack, body, &whole, alone, 1, &physics, &other);
          if (k % 3 == 2 || k >= 13)
            CHECK(SAME(&one, &other, 1));
          else
            changed += !SAME(&one, &other, 1); /* not all octants have springs */
        }
      }
      printf("# %s, %s: within %.1e of the reference; damage changed %u outcomes\n",
             mo_isa_name((enum mo_isa)isa), precision == MO_FLOAT32 ? "float32" : "float64", worst,
             changed);
      CHECK(changed >= 16);
      CHECK(worst <= (precision == MO_FLOAT32 ? 1e-4 : 1e-10));
      check_drop_to(kept);
    }
}

/* Measures of a broken body: in the kernels as in the reference, in float64. */
static void measures(void)
{
  struct mo_environment environments[LANES];
  make_environments(environments);
  const struct mo_pack *pack = make_pack(controller, mo_isa_best(), MO_FLOAT64);
  for (uint32_t variant = 0; variant < 4; variant++) {
    const struct mo_body *body = robots[variant].body;
    const struct mo_physics physics = physics_number(variant, 60);
    const struct mo_environment *list[LANES];
    double values[LANES][MO_MEASURES], exact[1][MO_MEASURES];
    struct mo_outcome outcomes[LANES], outcome;
    for (uint32_t l = 0; l < LANES; l++)
      list[l] = &environments[l];
    const struct mo_measuring fast = {.set = MO_MEASURES_ALL, .values = values};
    REQUIRE_OK(mo_rollout_block(make_workspace_memory(), pack, body, list, LANES, &physics, NULL,
                                &fast, NULL, outcomes));
    for (uint32_t k = 0; k < LANES; k++) {
      const struct mo_measuring one = {.set = MO_MEASURES_ALL, .values = exact};
      REQUIRE_OK(
          mo_rollout_reference(body, controller, &environments[k], &physics, NULL, &one, &outcome));
      for (uint32_t m = 0; m < MO_MEASURES; m++)
        CHECK(isnan(exact[0][m])
                  ? isnan(values[k][m])
                  : fabs(values[k][m] - exact[0][m]) <= 1e-9 * (1 + fabs(exact[0][m])));
    }
  }
}

static void gradients(void)
{
  struct mo_environment environments[LANES];
  struct mo_robot own[LANES];
  make_environments(environments);
  for (uint32_t k = 0; k < LANES; k++)
    own[k] = (struct mo_robot){robots[k % BODIES].body, &environments[k], NULL};
  follow_gradients(controller, own, physics_number, 1e-3);
}

static const struct check_case cases[] = {
    {"each spring is in one octant", octants},
    {"the first step without the springs", times},
    {"kernels follow the reference, each lane by itself", kernels},
    {"measures of broken bodies", measures},
    {"the gradient's kernel follows the reference", gradients},
};
CHECK_MAIN_WITH(setup, cases)
