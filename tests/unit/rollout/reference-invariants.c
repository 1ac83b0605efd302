/* reference-invariants.c: properties of any body on any ground, for random bodies and environments,
 * step by step. */
#include "../image.h"
#include "../make.h"

#include "rollout/reference.h"
#include "rollout/scene.h"

enum { BODIES = CHECK_SANITIZED ? 12 : 60 };

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
  make_check(mo_rollout_reference(body, brain, environment, physics, recording, NULL, &outcome),
             "rollout");
  return outcome;
}

/* At every step, every mass is on or above the ground. Rough terrain, some of it far rougher than
 * in training. */
static void never_below_ground(void)
{
  uint64_t checked = 0, touching = 0;
  for (uint64_t i = 0; i < BODIES; i++) {
    struct mo_body *body = random_body(i);
    struct mo_environment environment = environment_of(77, i);
    if (i % 4 == 3)
      for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
        environment.terrain_heights_m[k] *= 5;
    struct mo_physics physics = mo_paper_physics();
    physics.scheme.impact = i % 2 ? MO_IMPACT_EXACT : MO_IMPACT_BISECTION;
    struct mo_reference r;
    REQUIRE(mo_reference_init(&r, body, i % 3 ? bootstrap : NULL, &environment, &physics) == MO_OK);
    for (uint32_t step = 0; step < 500; step++) {
      REQUIRE(mo_reference_step(&r, step));
      for (uint32_t m = 0; m < body->n_masses; m++) {
        const double *p = r.position_m + 3 * m;
        const double above = p[2] - mo_terrain_height(&environment, p[0], p[1]);
        REQUIRE(above >= 0);
        touching += above == 0;
        checked++;
      }
    }
    mo_reference_done(&r);
  }
  printf("# %llu masses checked, %.1f %% on the ground\n", (unsigned long long)checked,
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
    e.kinetic += 0.5 * r->physics->constants.mass_kg *
                 (v[3 * i] * v[3 * i] + v[3 * i + 1] * v[3 * i + 1] + v[3 * i + 2] * v[3 * i + 2]);
    e.weight +=
        r->physics->constants.mass_kg * r->physics->constants.gravity_m_per_s2 * x[3 * i + 2];
  }
  for (uint32_t s = 0; s < r->body->n_springs; s++) {
    const double *a = x + 3 * r->body->spring_a[s], *b = x + 3 * r->body->spring_b[s];
    const double length = sqrt((a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1]) +
                               (a[2] - b[2]) * (a[2] - b[2]));
    const double rest = r->body->spring_rest_m[s];
    e.spring += 0.5 * r->physics->constants.stiffness_n_per_m * (length - rest) * (length - rest);
  }
  return e;
}

/* Runs a body without a controller for n steps. Returns the largest energy above the initial one,
 * as a fraction of all that it can lose; *moves: kinetic energy per mass at the end. */
static double energy_gain(const struct mo_body *body, const struct mo_environment *environment,
                          const struct mo_physics *physics, double *moves)
{
  struct mo_reference r;
  make_check(mo_reference_init(&r, body, NULL, environment, physics), "a rollout");
  const double start = measure(&r).weight;
  double floor_m = INFINITY, highest = -INFINITY;
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
    floor_m = fmin(floor_m, environment->terrain_heights_m[k]);
  const double scale = start - floor_m * 9.8 * body->n_masses;
  for (uint32_t step = 0; step < physics->scheme.n_steps; step++) {
    CHECK(mo_reference_step(&r, step));
    const struct energy e = measure(&r);
    highest = fmax(highest, (e.kinetic + e.weight + e.spring - start) / scale);
  }
  *moves = measure(&r).kinetic / (double)body->n_masses;
  mo_reference_done(&r);
  return highest;
}

/* Without actuation, a body falls and comes to rest: its energy never exceeds the initial energy,
 * and in the end almost nothing moves. (The energy of a symplectic integrator oscillates from step
 * to step, so single steps prove nothing.) */
static void no_energy_gain(void)
{
  double highest = -INFINITY, fastest = 0;
  for (uint64_t i = 0; i < BODIES; i++) {
    const struct mo_environment environment = environment_of(78, i);
    struct mo_physics physics = mo_paper_physics();
    physics.scheme.impact = i % 2 ? MO_IMPACT_EXACT : MO_IMPACT_BISECTION;
    physics.drop_height_m = i % 3 ? 0 : 0.5;
    double moves;
    highest = fmax(highest, energy_gain(random_body(1000 + i), &environment, &physics, &moves));
    fastest = fmax(fastest, moves);
  }
  printf("# highest energy above the start: %.2e of all that can be lost; at most %.1e J per mass "
         "move in the end\n",
         highest, fastest);
  CHECK(highest <= 1e-9);
  CHECK(fastest < 1e-4);
}

/* ---- the start ---- */

/* One foot, and an arm above ground that rises toward it: an L of 7 voxels along x, or its image
 * along y. */
static struct mo_body *overhanging_body(int axis)
{
  uint64_t bits[MO_DEFAULT_WORDS] = {0};
  for (uint32_t i = 0; i < 7; i++) {
    const uint32_t along = i < 1 ? 0 : i - 1, z = i < 1 ? 0 : 1;
    const uint32_t v = (axis == 0 ? (along * 6 + 2) : (2 * 6 + along)) * 4 + z;
    bits[v >> 6] |= UINT64_C(1) << (v & 63);
  }
  return make_body(lattice, bits);
}

static struct mo_environment slope_of(int axis, double slope)
{
  struct mo_environment environment = {.light_xy_m = {4.5, 2.5}};
  for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
    environment.terrain_heights_m[k] = slope * MO_TERRAIN_SIZE_M / (MO_TERRAIN_SIDE - 1) *
                                       (axis == 0 ? k % MO_TERRAIN_SIDE : k / MO_TERRAIN_SIDE);
  return environment;
}

/* Computes where a body would start if only its lowest layer had to be above the ground; returns
 * whether another mass would then be below it. */
static bool start_by_feet(const struct mo_body *body, const struct mo_environment *environment,
                          double *position_m)
{
  double lift = -INFINITY;
  uint16_t lowest = UINT16_MAX;
  bool below = false;
  for (uint32_t i = 0; i < body->n_masses; i++)
    lowest = body->mass_xyz[3 * i + 2] < lowest ? body->mass_xyz[3 * i + 2] : lowest;
  for (uint32_t i = 0; i < body->n_masses; i++) {
    const uint16_t *cell = body->mass_xyz + 3 * i;
    double *p = position_m + 3 * i;
    p[0] = MO_WORLD_CENTER_M - 0.5 * MO_VOXEL_M * body->workspace.nx + MO_VOXEL_M * cell[0];
    p[1] = MO_WORLD_CENTER_M - 0.5 * MO_VOXEL_M * body->workspace.ny + MO_VOXEL_M * cell[1];
    p[2] = MO_VOXEL_M * (cell[2] - lowest);
    if (cell[2] == lowest)
      lift = fmax(lift, mo_terrain_height(environment, p[0], p[1]));
  }
  for (uint32_t i = 0; i < body->n_masses; i++) {
    double *p = position_m + 3 * i;
    p[2] += lift;
    below |= p[2] < mo_terrain_height(environment, p[0], p[1]) - 1e-12;
  }
  return below;
}

/* Checks the start of a body in an environment; returns whether a start that considers only the
 * feet would leave a mass below the ground. */
static bool check_start(const struct mo_body *body, const struct mo_environment *environment)
{
  const struct mo_physics physics = mo_paper_physics();
  double position_m[MO_DEFAULT_MASSES * 3], by_feet_m[MO_DEFAULT_MASSES * 3];
  double nearest = INFINITY;
  mo_scene_start(body, environment, &physics, position_m);
  for (uint32_t i = 0; i < body->n_masses; i++) {
    const double *p = position_m + 3 * i;
    nearest = fmin(nearest, p[2] - mo_terrain_height(environment, p[0], p[1]));
  }
  CHECK(fabs(nearest) < 1e-14); /* it touches the ground, and nothing is below it */
  const bool below = start_by_feet(body, environment, by_feet_m);
  if (!below)
    CHECK(SAME(position_m, by_feet_m, 3 * body->n_masses));
  return below;
}

/* Does the same for the random body `index`. */
static bool check_random_start(uint64_t index, const struct mo_environment *environment)
{
  const size_t kept = check_n_kept;
  const bool below = check_start(random_body(index), environment);
  check_drop_to(kept);
  return below;
}

/* No body starts in the ground. If its lowest layer is what touches, the start has the same bits as
 * when only that layer was considered. Prints how often another layer touches, by the roughness of
 * the ground. */
static void starts(void)
{
  struct mo_environment test_set[MO_PAPER_TEST_COUNT];
  mo_environment_paper_test(test_set);
  uint32_t lifted = 0;
  for (uint64_t i = 0; i < 2000; i++)
    lifted +=
        check_random_start(4000 + i / MO_PAPER_TEST_COUNT, test_set + i % MO_PAPER_TEST_COUNT);
  printf("# the paper's test set: %u of 2000 starts are higher than the lowest layer needs\n",
         lifted);
  CHECK_INT(lifted, 0);
  lifted = 0;
  for (uint64_t i = 0; i < 20000; i++) {
    const struct mo_environment environment = environment_of(84, i);
    lifted += check_random_start(6000 + i, &environment);
  }
  printf("# training environments: %u of 20000\n", lifted);
  static const double sigma_m[] = {0.1, 0.2, 0.5};
  uint32_t before = 0;
  for (int s = 0; s < 3; s++) {
    lifted = 0;
    for (uint64_t i = 0; i < 5000; i++) {
      struct mo_environment environment = {.light_xy_m = {4.5, 2.5}};
      mo_terrain_random(83, 0, i, sigma_m[s], environment.terrain_heights_m);
      lifted += check_random_start(4000 + i, &environment);
    }
    printf("# terrain of %.1f m: %u of 5000\n", sigma_m[s], lifted);
    CHECK(lifted >= before);
    before = lifted;
  }
  CHECK(before > 250 && before < 1000);
}

/* On slopes a body starts outside the ground, and therefore gains no energy, even with an overhang
 * or on rough ground. In every kernel the center of mass, and hence the potential energy, never
 * exceeds that of the start. */
static void no_energy_of_overhangs(void)
{
  static const double slopes[] = {-1.0, -0.4, 0.4, 0.56, 1.0};
  struct mo_workspace_memory *memory = make_workspace_memory();
  struct mo_physics physics = physics_of(300);
  physics.constants.actuation = 0;
  double highest = -INFINITY, rise_m = -INFINITY, moves;
  for (int axis = 0; axis < 2; axis++)
    for (int s = 0; s < 5; s++) {
      const struct mo_body *body = overhanging_body(axis);
      const struct mo_environment environment = slope_of(axis, slopes[s]), *list = &environment;
      CHECK(check_start(body, &environment) == (slopes[s] > 0.2));
      highest = fmax(highest, energy_gain(body, &environment, &physics, &moves));
      for (int isa = 0; isa <= (int)mo_isa_best(); isa++)
        for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++) {
          double com_m[301 * 3];
          struct mo_recording recording = {.stride = 1, .com_m = com_m};
          struct mo_outcome outcome;
          const struct mo_pack *pack =
              make_pack(bootstrap, (enum mo_isa)isa, (enum mo_precision)precision);
          REQUIRE(mo_rollout_block(memory, pack, body, &list, 1, &physics, &recording, NULL, NULL,
                                   &outcome) == MO_OK);
          CHECK_INT(outcome.diverged_step, 0);
          for (uint32_t frame = 1; frame <= 300; frame++)
            rise_m = fmax(rise_m, com_m[3 * frame + 2] - com_m[2]);
        }
    }
  for (uint64_t i = 0; i < BODIES; i++) {
    struct mo_environment environment = {.light_xy_m = {4.5, 2.5}};
    mo_terrain_random(85, 0, i, 0.5, environment.terrain_heights_m);
    highest = fmax(highest, energy_gain(random_body(5000 + i), &environment, &physics, &moves));
  }
  printf("# overhangs: highest energy above the start: %.2e of all that can be lost; the kernels' "
         "centers of mass rise by at most %.1e m\n",
         highest, rise_m);
  CHECK(highest <= 1e-9);
  CHECK(rise_m <= 1e-6);
}

/* On flat ground a passive body behaves the same wherever it stands. */
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

/* A stiffness a hundred times too large for the step: the divergence is reported with its step, and
 * no non-finite value appears in the results. */
static void divergence(void)
{
  struct mo_physics physics = mo_paper_physics();
  physics.constants.stiffness_n_per_m *= 100;
  physics.scheme.n_steps = 200;
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
    /* From the previous step on, the recording stays constant, and the outcome agrees with it. */
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
  environment.light_xy_m[0] = environment.light_xy_m[1] = MO_WORLD_CENTER_M;
  struct mo_physics physics = mo_paper_physics();
  struct mo_outcome outcome = outcome_of(body, bootstrap, &environment, &physics, NULL);
  CHECK_INT(outcome.diverged_step, 0);
  CHECK(isfinite(outcome.loss)); /* large: the body starts where it should end */
  environment.light_xy_m[0] = 3.5;
  outcome = outcome_of(body, bootstrap, &environment, &physics, NULL);
  CHECK(outcome.diverged_step == 0 && outcome.loss < 1);
  printf("# 144 voxels: loss %.4f\n", outcome.loss);
  physics.drop_height_m = 10;
  physics.scheme.n_steps = 6000;
  outcome = outcome_of(body, NULL, &environment, &physics, NULL);
  CHECK_INT(outcome.diverged_step, 0);
  CHECK_NEAR(outcome.com_start_m[2], 10 + 0.2 + mo_terrain_highest(&environment), 0.3);
  CHECK(outcome.com_end_m[2] < 1);
  CHECK_NEAR(outcome.loss, 1, 0.2);
}

/* Recording with a stride shows the same rollout. */
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
  const struct mo_physics physics = mo_paper_physics();
  struct mo_outcome outcome = {.loss = 7};
  CHECK_INT(mo_rollout_reference(body, bootstrap, &environment, &physics, NULL, NULL, &outcome),
            MO_ERR_INVALID);
  CHECK_NEAR(outcome.loss, 7, 0);
}

static const struct check_case cases[] = {{"no mass below the ground", never_below_ground},
                                          {"bodies gain no energy", no_energy_gain},
                                          {"starts", starts},
                                          {"overhangs gain no energy", no_energy_of_overhangs},
                                          {"translation", translation},
                                          {"divergence", divergence},
                                          {"extremes", extremes},
                                          {"recordings", recordings},
                                          {"another workspace's controller", wrong_workspace}};
CHECK_MAIN_WITH(setup, cases)
