/* reference-invariants.c: what holds for any body on any ground: random bodies and environments,
 * step by step. */
#include "../image.h"
#include "../make.h"

#include "rollout/reference.h"

#define BODIES 60

static struct mo_lattice *lattice;
static struct mo_controller *bootstrap;

static void setup(void)
{
  lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  bootstrap = make_shipped_controller("bootstrap");
}

static struct mo_body *random_body(uint64_t index)
{
  struct mo_random random = dice(77, 0, index);
  uint64_t bits[MO_DEFAULT_WORDS];
  make_check(mo_genotype_random(MO_DEFAULT_WORKSPACE, &random, bits), "a body");
  return make_body(lattice, bits);
}

static struct mo_environment environment_of(uint64_t seed, uint64_t index)
{
  struct mo_environment environment;
  mo_environment_training(seed, 0, index, &environment);
  return environment;
}

static struct mo_outcome outcome_of(const struct mo_body *body, const struct mo_controller *brain,
                                    const struct mo_environment *environment,
                                    const struct mo_physics *physics,
                                    const struct mo_recording *recording)
{
  struct mo_outcome outcome;
  make_check(mo_rollout_reference(body, brain, environment, physics, recording, &outcome),
             "rollout");
  return outcome;
}

/* Every step, every mass: on or above the ground. Rough terrain, some of it far rougher than in
 * training. */
static void never_below_ground(void)
{
  uint64_t checked = 0, touching = 0;
  for (uint64_t i = 0; i < BODIES; i++) {
    struct mo_body *body = random_body(i);
    struct mo_environment environment = environment_of(77, i);
    if (i % 4 == 3)
      for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
        environment.terrain_heights_m[k] *= 5;
    struct mo_physics physics = mo_default_physics();
    physics.impact = i % 2 ? MO_IMPACT_EXACT : MO_IMPACT_BISECTION;
    struct mo_reference r;
    REQUIRE(mo_reference_init(&r, body, i % 3 ? bootstrap : NULL, &environment, &physics) == MO_OK);
    for (uint32_t step = 0; step < 500; step++) {
      REQUIRE(mo_reference_step(&r, step));
      for (uint32_t m = 0; m < body->n_masses; m++) {
        const double *p = r.position_m + 3 * m;
        const double above = p[2] - mo_terrain_height(environment.terrain_heights_m, p[0], p[1]);
        REQUIRE(above >= 0);
        touching += above == 0;
        checked++;
      }
    }
    mo_reference_done(&r);
  }
  printf("# %llu masses looked at, %.1f %% on the ground\n", (unsigned long long)checked,
         100 * (double)touching / (double)checked);
  CHECK(touching > checked / 100);
}

struct energy {
  double kinetic, weight, spring;
};

static struct energy measure(const struct mo_reference *r)
{
  struct energy e = {0};
  const double *x = r->position_m, *v = r->velocity_m_per_s;
  for (uint32_t i = 0; i < r->body->n_masses; i++) {
    e.kinetic += 0.5 * r->physics->mass_kg *
                 (v[3 * i] * v[3 * i] + v[3 * i + 1] * v[3 * i + 1] + v[3 * i + 2] * v[3 * i + 2]);
    e.weight += r->physics->mass_kg * r->physics->gravity_m_per_s2 * x[3 * i + 2];
  }
  for (uint32_t s = 0; s < r->body->n_springs; s++) {
    const double *a = x + 3 * r->body->spring_a[s], *b = x + 3 * r->body->spring_b[s];
    const double length = sqrt((a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1]) +
                               (a[2] - b[2]) * (a[2] - b[2]));
    const double rest = r->body->spring_diagonal[s] ? MO_VOXEL_M * sqrt(2) : MO_VOXEL_M;
    e.spring += 0.5 * r->physics->stiffness_n_per_m * (length - rest) * (length - rest);
  }
  return e;
}

/* With the actuators off a body falls, comes to rest: its energy never exceeds what it began
 * with, and in the end next to nothing moves. (From step to step the energy of a symplectic
 * integrator swings, so single steps say nothing.) */
static void no_energy_gain(void)
{
  double highest = -INFINITY, fastest = 0;
  for (uint64_t i = 0; i < BODIES; i++) {
    struct mo_body *body = random_body(1000 + i);
    struct mo_environment environment = environment_of(78, i);
    struct mo_physics physics = mo_default_physics();
    physics.impact = i % 2 ? MO_IMPACT_EXACT : MO_IMPACT_BISECTION;
    physics.drop_height_m = i % 3 ? 0 : 0.5;
    struct mo_reference r;
    REQUIRE(mo_reference_init(&r, body, NULL, &environment, &physics) == MO_OK);
    const double start = measure(&r).weight;
    double floor_m = INFINITY;
    for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
      floor_m = fmin(floor_m, environment.terrain_heights_m[k]);
    const double scale = start - floor_m * 9.8 * body->n_masses; /* all that there is to lose */
    for (uint32_t step = 0; step < 1000; step++) {
      REQUIRE(mo_reference_step(&r, step));
      const struct energy e = measure(&r);
      highest = fmax(highest, (e.kinetic + e.weight + e.spring - start) / scale);
    }
    fastest = fmax(fastest, measure(&r).kinetic / (double)body->n_masses);
    mo_reference_done(&r);
  }
  printf("# highest energy above the start: %.2e of all that can be lost; at most %.1e J per mass "
         "move in the end\n",
         highest, fastest);
  CHECK(highest <= 1e-9);
  CHECK(fastest < 1e-4);
}

/* On flat ground a passive body does the same wherever it stands. */
static void translation(void)
{
  struct mo_environment environment = {.light_xy_m = {4, 4}};
  struct mo_physics physics = physics_of(300);
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
    environment.terrain_heights_m[k] = 0.1;
  physics.drop_height_m = 0.3;
  for (uint64_t i = 0; i < 20; i++) {
    struct mo_random random = dice(79, 0, i);
    uint64_t bits[MO_DEFAULT_WORDS], aligned[MO_DEFAULT_WORDS], moved[MO_DEFAULT_WORDS] = {0};
    REQUIRE(mo_genotype_random(MO_DEFAULT_WORKSPACE, &random, bits) == MO_OK);
    REQUIRE(make_image(MO_DEFAULT_WORKSPACE, bits, 0, aligned) == MO_OK);
    int fits = 1;
    for (uint32_t v = 0; v < MO_DEFAULT_VOXELS; v++)
      if (aligned[v >> 6] >> (v & 63) & 1) {
        fits = fits && v / 24 + 1 < 6;
        const uint32_t w = v + 24; /* one voxel along x */
        if (w < MO_DEFAULT_VOXELS)
          moved[w >> 6] |= UINT64_C(1) << (w & 63);
      }
    if (!fits)
      continue;
    const struct mo_outcome here = outcome_of(make_body(lattice, aligned), NULL, &environment,
                                              &physics, NULL),
                            there = outcome_of(make_body(lattice, moved), NULL, &environment,
                                               &physics, NULL);
    for (int axis = 0; axis < 3; axis++)
      CHECK_NEAR(there.com_end_m[axis], here.com_end_m[axis] + (axis == 0 ? 0.1 : 0), 1e-9);
    CHECK(here.com_end_m[2] < here.com_start_m[2] - 0.25); /* it did fall */
  }
}

/* A stiffness a hundred times too large for the step: reported with its step, and nothing that is
 * not finite gets out. */
static void divergence(void)
{
  struct mo_physics physics = mo_default_physics();
  physics.stiffness_n_per_m *= 100;
  physics.n_steps = 200;
  struct mo_environment environment = environment_of(80, 0);
  double *com = make_zeros(201 * 3, sizeof(double));
  for (uint64_t i = 0; i < 20; i++) {
    struct mo_body *body = random_body(2000 + i);
    const size_t n = (size_t)body->n_masses * 3;
    float *masses = make_zeros(201 * n, sizeof(float));
    int8_t *actuation = make_zeros(201 * (size_t)body->n_springs, 1);
    uint8_t *contacts = make_zeros(201 * (size_t)body->n_masses, 1);
    const struct mo_recording recording = {1, com, masses, actuation, contacts};
    const struct mo_outcome outcome =
        outcome_of(body, bootstrap, &environment, &physics, &recording);
    REQUIRE(outcome.diverged_step > 0 && outcome.diverged_step <= 200);
    CHECK(isinf(outcome.loss) && outcome.loss > 0);
    for (size_t k = 0; k < (size_t)201 * 3; k++)
      CHECK(isfinite(com[k]));
    for (size_t k = 0; k < 201 * n; k++)
      CHECK(isfinite(masses[k]));
    /* From the step before on, the record stands still, and the outcome agrees with it. */
    const size_t last = (size_t)outcome.diverged_step - 1;
    for (size_t frame = last; frame <= 200; frame++)
      CHECK(SAME(com + 3 * frame, com + 3 * last, 3));
    for (size_t s = (last + 1) * body->n_springs; s < 201 * (size_t)body->n_springs; s++)
      CHECK_INT(actuation[s], 0);
    for (size_t m = (last + 1) * body->n_masses; m < 201 * (size_t)body->n_masses; m++)
      CHECK_INT(contacts[m], 0);
    CHECK(SAME(outcome.com_end_m, com + 3 * last, 3));
    CHECK(SAME(outcome.com_start_m, com, 3));
  }
}

/* The whole workspace, a fall from 10 m, and a light in the middle of the body. */
static void extremes(void)
{
  const struct mo_body *body = make_full_body(lattice);
  struct mo_environment environment = environment_of(81, 0);
  environment.light_xy_m[0] = environment.light_xy_m[1] = MO_WORLD_CENTRE_M;
  struct mo_physics physics = mo_default_physics();
  struct mo_outcome outcome = outcome_of(body, bootstrap, &environment, &physics, NULL);
  CHECK_INT(outcome.diverged_step, 0);
  CHECK(isfinite(outcome.loss)); /* large: the body starts where it should end */
  environment.light_xy_m[0] = 3.5;
  outcome = outcome_of(body, bootstrap, &environment, &physics, NULL);
  CHECK(outcome.diverged_step == 0 && outcome.loss < 1);
  printf("# 144 voxels: loss %.4f\n", outcome.loss);
  physics.drop_height_m = 10;
  physics.n_steps = 6000;
  outcome = outcome_of(body, NULL, &environment, &physics, NULL);
  CHECK_INT(outcome.diverged_step, 0);
  CHECK_NEAR(outcome.com_start_m[2], 10 + 0.2 + mo_terrain_highest(environment.terrain_heights_m),
             0.3);
  CHECK(outcome.com_end_m[2] < 1);
  CHECK_NEAR(outcome.loss, 1, 0.2);
}

/* Recording at a stride looks at the same rollout. */
static void recordings(void)
{
  struct mo_body *body = random_body(3000);
  struct mo_environment environment = environment_of(82, 0);
  struct mo_physics physics = physics_of(100);
  const size_t n = (size_t)body->n_masses * 3;
  double every[101 * 3], seventh[15 * 3];
  float *masses = make_zeros(101 * n, sizeof(float));
  const struct mo_recording all = {1, every, masses, NULL, NULL},
                            some = {7, seventh, NULL, NULL, NULL};
  const struct mo_outcome a = outcome_of(body, bootstrap, &environment, &physics, &all),
                          b = outcome_of(body, bootstrap, &environment, &physics, &some),
                          c = outcome_of(body, bootstrap, &environment, &physics, NULL);
  CHECK(SAME(&a, &b, 1) && SAME(&a, &c, 1));
  for (size_t frame = 0; frame < 15; frame++)
    CHECK(SAME(every + 21 * frame, seventh + 3 * frame, 3));
  CHECK(SAME(every + 300, a.com_end_m, 3));
  double mean = 0;
  for (size_t i = 0; i < body->n_masses; i++)
    mean += (double)masses[100 * n + 3 * i] / body->n_masses;
  CHECK_NEAR(mean, a.com_end_m[0], 1e-6);
}

static void wrong_workspace(void)
{
  const struct mo_body *body = make_full_body(make_lattice((struct mo_workspace){6, 6, 3}));
  const struct mo_environment environment = {.light_xy_m = {1, 1}};
  const struct mo_physics physics = mo_default_physics();
  struct mo_outcome outcome = {.loss = 7};
  CHECK_INT(mo_rollout_reference(body, bootstrap, &environment, &physics, NULL, &outcome),
            MO_ERR_INVALID);
  CHECK_NEAR(outcome.loss, 7, 0);
}

static const struct check_case cases[] = {{"no mass below the ground", never_below_ground},
                                          {"no energy gain", no_energy_gain},
                                          {"translation", translation},
                                          {"divergence", divergence},
                                          {"extremes", extremes},
                                          {"recordings", recordings},
                                          {"another workspace's controller", wrong_workspace}};
CHECK_MAIN_WITH(setup, cases)
