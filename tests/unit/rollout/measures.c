/* Measures of rollouts. `oracle` computes them from recorded masses, contacts and actuation, by the
 * definitions of docs/model.md alone; it shares only the terrain's height with the library. */
#include "../make.h"
#include "rollout/measuring.h"
#include "task-cases.h"

enum { STEPS = CHECK_SANITIZED ? 120 : 400, ROBOTS = 6, LANES = 10 };
static struct mo_lattice *lattice;
static struct mo_controller *controller;
static struct mo_environment paper_test[MO_PAPER_TEST_COUNT];

static void setup(void)
{
  lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  controller = make_shipped_controller("phototaxis");
  mo_environment_paper_test(paper_test);
}

/* The default physics and the paper's, both with the controller's period; the paper's with a
 * control period of one step. */
static struct mo_physics physics_case(uint32_t number, uint32_t n_steps)
{
  struct mo_physics physics = number == 0 ? mo_default_physics() : mo_paper_physics();
  physics.scheme.n_steps = n_steps;
  if (number < 2)
    physics.scheme.control_period_s = 0.016;
  return physics;
}
enum { PHYSICS_CASES = 3 };

/* ---- the oracle ---- */

struct oracle {
  const struct mo_body *body;
  const struct mo_environment *environment;
  const struct mo_physics *physics;
  struct mo_recording recording; /* of every step */
  double rest_com[3], light[2];
};

static const float *mass_at(const struct oracle *o, uint32_t step, uint32_t mass)
{
  return o->recording.mass_m + 3 * ((size_t)step * o->body->n_masses + mass);
}

static void com_at(const struct oracle *o, uint32_t step, double com[3])
{
  com[0] = com[1] = com[2] = 0;
  for (uint32_t m = 0; m < o->body->n_masses; m++)
    for (int axis = 0; axis < 3; axis++)
      com[axis] += (double)mass_at(o, step, m)[axis] / o->body->n_masses;
}

static double rest_of(const struct oracle *o, uint32_t mass, int axis)
{
  return MO_VOXEL_M * o->body->mass_xyz[3 * mass + (uint32_t)axis] - o->rest_com[axis];
}

/* Solves m x = y by Cramer's rule. */
static void solve(const double m[3][3], const double y[3], double x[3])
{
  double with[3][3], whole = 0;
  for (int k = -1; k < 3; k++) {
    for (int i = 0; i < 3; i++)
      for (int j = 0; j < 3; j++)
        with[i][j] = j == k ? y[i] : m[i][j];
    const double d = with[0][0] * (with[1][1] * with[2][2] - with[1][2] * with[2][1]) -
                     with[0][1] * (with[1][0] * with[2][2] - with[1][2] * with[2][0]) +
                     with[0][2] * (with[1][0] * with[2][1] - with[1][1] * with[2][0]);
    if (k < 0)
      whole = d;
    else
      x[k] = d / whole;
  }
}

/* The linear map F that minimizes Σ |x − c − F (X − C)|². */
static void map_at(const struct oracle *o, uint32_t step, double f[3][3])
{
  double com[3], spread[3][3] = {{0}}, both[3][3] = {{0}};
  com_at(o, step, com);
  for (uint32_t m = 0; m < o->body->n_masses; m++)
    for (int i = 0; i < 3; i++)
      for (int j = 0; j < 3; j++) {
        spread[i][j] += rest_of(o, m, i) * rest_of(o, m, j);
        both[i][j] += ((double)mass_at(o, step, m)[i] - com[i]) * rest_of(o, m, j);
      }
  for (int i = 0; i < 3; i++)
    solve(spread, both[i], f[i]);
}

static void oracle_motion(const struct oracle *o, uint32_t hold, double *values)
{
  const uint32_t n_steps = o->physics->scheme.n_steps;
  const double end_s = n_steps * o->physics->scheme.dt_s;
  double start[3], at[3], f[3][3] = {{0}}, path = 0, heights = 0, peak, yaw = 0, yaw_sum = 0;
  uint32_t instants = 0;
  com_at(o, 0, start);
  memcpy(at, start, sizeof(at));
  peak = start[2] - mo_terrain_height(o->environment, start[0], start[1]);
  for (uint32_t step = hold; step < n_steps + hold; step += hold, instants++) {
    const uint32_t now = step < n_steps ? step : n_steps;
    double next[3];
    com_at(o, now, next);
    path += hypot(next[0] - at[0], next[1] - at[1]);
    const double height = next[2] - mo_terrain_height(o->environment, next[0], next[1]);
    heights += height;
    peak = fmax(peak, height);
    map_at(o, now, f);
    const double angle = atan2(f[1][0] - f[0][1], f[0][0] + f[1][1]);
    yaw_sum += remainder(angle - yaw, 2 * M_PI);
    yaw = angle;
    memcpy(at, next, sizeof(at));
  }
  const double dx = at[0] - start[0], dy = at[1] - start[1], way = hypot(dx, dy);
  double angle = atan2(dy, dx) - atan2(o->light[1] - start[1], o->light[0] - start[0]);
  angle = remainder(angle, 2 * M_PI);
  values[MO_MEASURE_DISPLACEMENT] = way;
  values[MO_MEASURE_PATH_LENGTH] = path;
  values[MO_MEASURE_MEAN_SPEED] = path / end_s;
  values[MO_MEASURE_STRAIGHTNESS] = path > 0 ? way / path : 0;
  values[MO_MEASURE_HEADING_ERROR] = way < 0.01 ? NAN : fabs(angle);
  values[MO_MEASURE_SIDEWAYS] = way * sin(angle);
  values[MO_MEASURE_PEAK_HEIGHT] = peak;
  values[MO_MEASURE_MEAN_HEIGHT] = heights / instants;
  const double up = f[2][2] / sqrt(f[0][2] * f[0][2] + f[1][2] * f[1][2] + f[2][2] * f[2][2]);
  values[MO_MEASURE_TILT] = acos(fmin(up, 1));
  values[MO_MEASURE_YAW_RATE] = yaw_sum / end_s;
}

static void oracle_contacts(const struct oracle *o, uint32_t hold, double *values)
{
  const uint32_t n_steps = o->physics->scheme.n_steps, n = o->body->n_masses;
  const double end_s = n_steps * o->physics->scheme.dt_s;
  double all = 0, front = 0, left = 0, air = 0, hops = 0;
  bool touched = false;
  for (uint32_t step = 0; step < n_steps; step++) {
    const uint8_t *contacts = o->recording.contacts + (size_t)(step + 1) * n;
    bool touches = false;
    for (uint32_t m = 0; m < n; m++) {
      touches = touches || contacts[m];
      if (step % hold != 0 || !contacts[m])
        continue;
      const double x = rest_of(o, m, 0), y = rest_of(o, m, 1);
      all += 1;
      front += fabs(x) < 1e-9 ? 0.5 : x > 0;
      left += fabs(y) < 1e-9 ? 0.5 : y > 0;
    }
    air += !touches;
    hops += touched && !touches;
    touched = touches;
  }
  values[MO_MEASURE_AIR_SHARE] = air / n_steps;
  values[MO_MEASURE_HOPS] = hops / end_s;
  values[MO_MEASURE_CONTACT_FRONT] = all > 0 ? front / all : 0;
  values[MO_MEASURE_CONTACT_BACK] = all > 0 ? 1 - front / all : 0;
  values[MO_MEASURE_CONTACT_LEFT] = all > 0 ? left / all : 0;
  values[MO_MEASURE_CONTACT_RIGHT] = all > 0 ? 1 - left / all : 0;
}

/* Six times the signed volume of the box of a voxel's mean edges. */
static double volume_of(const struct oracle *o, uint32_t step, uint32_t voxel)
{
  double e[3][3] = {{0}};
  for (uint32_t k = 0; k < 8; k++) {
    const uint32_t m = o->body->voxel_mass[8 * voxel + k];
    for (int edge = 0; edge < 3; edge++) {
      const uint16_t *xyz = o->body->mass_xyz + 3 * m,
                     *first = o->body->mass_xyz + 3 * o->body->voxel_mass[8 * voxel];
      for (int axis = 0; axis < 3; axis++)
        e[edge][axis] +=
            (xyz[edge] > first[edge] ? 0.25 : -0.25) * (double)mass_at(o, step, m)[axis];
    }
  }
  const double cross[3] = {e[1][1] * e[2][2] - e[1][2] * e[2][1],
                           e[1][2] * e[2][0] - e[1][0] * e[2][2],
                           e[1][0] * e[2][1] - e[1][1] * e[2][0]};
  return e[0][0] * cross[0] + e[0][1] * cross[1] + e[0][2] * cross[2];
}

static void oracle_springs(const struct oracle *o, uint32_t hold, double *values)
{
  const struct mo_constants *c = &o->physics->constants;
  const uint32_t n = o->body->n_springs;
  double strain = 0, work = 0, inverted = 0;
  for (uint32_t step = 0; step < o->physics->scheme.n_steps; step += hold) {
    const int8_t *new = o->recording.actuation + (size_t)(step + 1) * n,
                 *old = step > 0 ? new - (size_t)hold *n : new;
    for (uint32_t s = 0; s < n; s++) {
      const float *a = mass_at(o, step, o->body->spring_a[s]),
                  *b = mass_at(o, step, o->body->spring_b[s]);
      const double rest = o->body->spring_rest_m[s],
                   length = sqrt(pow((double)a[0] - (double)b[0], 2) +
                                 pow((double)a[1] - (double)b[1], 2) +
                                 pow((double)a[2] - (double)b[2], 2));
      strain = fmax(strain, fabs(length - rest) / rest);
      const double before = length - rest * (1 + c->actuation * old[s] / 127),
                   after = length - rest * (1 + c->actuation * new[s] / 127);
      work += fmax(0, c->stiffness_n_per_m / 2 * (after * after - before * before));
    }
    double count = 0;
    for (uint32_t v = 0; v < o->body->n_voxels && step > 0; v++)
      count += volume_of(o, step, v) < 0 && volume_of(o, step - hold, v) < 0;
    inverted = fmax(inverted, count);
  }
  values[MO_MEASURE_WORK] = work;
  const double path = values[MO_MEASURE_PATH_LENGTH];
  values[MO_MEASURE_COST_OF_TRANSPORT] =
      path < 0.01 ? NAN : work / (o->body->n_masses * c->mass_kg * c->gravity_m_per_s2 * path);
  values[MO_MEASURE_PEAK_STRAIN] = strain;
  values[MO_MEASURE_INVERTED_VOXELS] = inverted;
}

/* The light of a path at the start. */
static void light_on_path(const struct mo_guide *guide, const double *start, double light[2])
{
  const double *from = start, *to = guide->points_m[0];
  uint32_t leg = 0;
  while (leg + 1 < guide->n_points && hypot(start[0] - to[0], start[1] - to[1]) <= 0.2) {
    from = to;
    to = guide->points_m[++leg];
  }
  const double length = hypot(to[0] - from[0], to[1] - from[1]);
  const double e[2] = {(to[0] - from[0]) / length, (to[1] - from[1]) / length};
  const double along = fmax(0, (start[0] - from[0]) * e[0] + (start[1] - from[1]) * e[1]);
  for (int axis = 0; axis < 2; axis++)
    light[axis] = from[axis] + fmin(along + guide->distance_m, length) * e[axis];
}

static void oracle_run(struct oracle *o, double values[MO_MEASURES])
{
  const uint32_t hold = mo_control_steps(&o->physics->scheme);
  const struct mo_guide *guide = &o->environment->task.guide;
  double start[3];
  memset(o->rest_com, 0, sizeof(o->rest_com));
  for (uint32_t m = 0; m < o->body->n_masses; m++)
    for (uint32_t axis = 0; axis < 3; axis++)
      o->rest_com[axis] += MO_VOXEL_M * o->body->mass_xyz[3 * m + axis] / o->body->n_masses;
  com_at(o, 0, start);
  for (int axis = 0; axis < 2; axis++) {
    const double turned = guide->heading_rad - (axis == 0 ? 0 : M_PI / 2);
    o->light[axis] = guide->kind == MO_GUIDE_AHEAD || guide->kind == MO_GUIDE_TURNING
                         ? start[axis] + cos(turned)
                         : o->environment->light_xy_m[axis];
  }
  if (guide->kind == MO_GUIDE_PATH)
    light_on_path(guide, start, o->light);
  oracle_motion(o, hold, values);
  oracle_contacts(o, hold, values);
  oracle_springs(o, hold, values);
}

/* ---- the reference ---- */

static bool is_work(int measure)
{
  return measure == MO_MEASURE_WORK || measure == MO_MEASURE_COST_OF_TRANSPORT;
}

static double scale_of(int measure, double value)
{
  return is_work(measure) ? fmax(1, fabs(value)) : 1;
}

/* Random bodies in training environments with all tasks. Recorded masses are rounded to float32,
 * recorded outputs to 1/127. */
static void definitions(void)
{
  const struct mo_robot *robots = make_robots(lattice, 31, 31, TASK_CASES + 1);
  double worst[MO_MEASURES] = {0}, moved = 0, inverted = 0;
  for (uint32_t k = 0; k < PHYSICS_CASES * (TASK_CASES + 1); k++) {
    const struct mo_robot *robot = robots + k % (TASK_CASES + 1);
    struct mo_environment environment = *robot->environment;
    if (k % (TASK_CASES + 1) < TASK_CASES)
      environment.task = task_case(k % (TASK_CASES + 1));
    struct mo_physics physics = physics_case(k / (TASK_CASES + 1), k % 2 ? 203 : 200);
    if (k % 4 == 3)
      physics.constants.actuation = 0.5; /* turns voxels inside out */
    struct oracle o = {robot->body, &environment, &physics, {0}, {0}, {0}};
    double values[1][MO_MEASURES], expected[MO_MEASURES];
    const struct mo_measuring measuring = {MO_MEASURES_ALL, values};
    struct mo_outcome outcome;
    REQUIRE(mo_recording_create(&o.recording,
                                MO_RECORD_MASSES | MO_RECORD_ACTUATION | MO_RECORD_CONTACTS, 1,
                                physics.scheme.n_steps + 1, robot->body->n_masses,
                                robot->body->n_springs) == MO_OK);
    REQUIRE(mo_rollout_reference(robot->body, controller, &environment, &physics, &o.recording,
                                 &measuring, &outcome) == MO_OK);
    oracle_run(&o, expected);
    mo_recording_free(&o.recording);
    CHECK_INT(outcome.diverged_step, 0);
    moved = fmax(moved, values[0][MO_MEASURE_DISPLACEMENT]);
    inverted = fmax(inverted, values[0][MO_MEASURE_INVERTED_VOXELS]);
    for (int i = 0; i < MO_MEASURES; i++) {
      CHECK(isnan(values[0][i]) == isnan(expected[i]));
      if (isnan(expected[i]))
        continue;
      worst[i] = fmax(worst[i], fabs(values[0][i] - expected[i]) / scale_of(i, expected[i]));
      CHECK(values[0][i] ==
            rint(values[0][i] * mo_measure_info[i].steps_in_one) / mo_measure_info[i].steps_in_one);
    }
  }
  for (int i = 0; i < MO_MEASURES; i++) {
    printf("# %-20s within %.1e of its definition\n", mo_measure_info[i].name, worst[i]);
    CHECK(worst[i] < (is_work(i) ? 0.03 : i == MO_MEASURE_HEADING_ERROR ? 1e-4 : 2e-5));
  }
  CHECK(moved > 0.05 && inverted > 1);
}

/* ---- kernels ---- */

/* Rolls n lanes out, each in its environment. */
static void run_block(const struct mo_pack *pack, const struct mo_body *body,
                      const struct mo_environment *environments, const uint32_t *lanes, uint32_t n,
                      const struct mo_physics *physics, uint32_t set, double values[][MO_MEASURES],
                      struct mo_outcome *outcomes)
{
  const size_t kept = check_n_kept;
  const struct mo_environment *list[MO_BLOCK_LANES];
  const struct mo_measuring measuring = {set, values};
  for (uint32_t l = 0; l < n; l++)
    list[l] = environments + lanes[l];
  make_check(mo_rollout_block(make_workspace_memory(), pack, body, list, n, physics, NULL,
                              set != 0 ? &measuring : NULL, NULL, outcomes),
             "rollouts");
  check_drop_to(kept);
}

#define EACH_KERNEL(isa, precision)                                                                \
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)                                              \
    for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++)

static void fill_environments(struct mo_environment environments[LANES])
{
  memcpy(environments, paper_test, LANES * sizeof(*environments));
  for (uint32_t e = 1; e < LANES; e += 2)
    environments[e].task = task_case(e);
}

static bool same_bits(const double *a, const double *b, size_t n)
{
  return memcmp(a, b, n * sizeof(*a)) == 0;
}

/* The difference of a float64 kernel from the reference, and of a float32 one. Short rollouts:
 * later, rounding decides which masses strike the ground in which step. */
static double bound_of(int measure, int precision)
{
  if (precision == MO_FLOAT64)
    return 2.0 / mo_measure_info[measure].steps_in_one;
  switch (measure) {
  case MO_MEASURE_HEADING_ERROR:
  case MO_MEASURE_YAW_RATE: return 0.05;
  case MO_MEASURE_AIR_SHARE:
  case MO_MEASURE_CONTACT_FRONT:
  case MO_MEASURE_CONTACT_BACK:
  case MO_MEASURE_CONTACT_LEFT:
  case MO_MEASURE_CONTACT_RIGHT: return 0.03;
  case MO_MEASURE_HOPS: return 15;
  default: return 1e-3;
  }
}

static void kernels(void)
{
  struct mo_environment environments[LANES];
  uint32_t lanes[LANES];
  fill_environments(environments);
  for (uint32_t l = 0; l < LANES; l++)
    lanes[l] = l;
  const struct mo_robot *robots = make_robots(lattice, 32, 32, ROBOTS);
  static double expected[ROBOTS][LANES][MO_MEASURES];
  for (uint32_t k = 0; k < ROBOTS; k++)
    for (uint32_t l = 0; l < LANES; l++) {
      const struct mo_physics physics = physics_case(k % PHYSICS_CASES, 100);
      const struct mo_measuring measuring = {MO_MEASURES_ALL, &expected[k][l]};
      struct mo_outcome outcome;
      REQUIRE(mo_rollout_reference(robots[k].body, controller, environments + l, &physics, NULL,
                                   &measuring, &outcome) == MO_OK);
    }
  EACH_KERNEL(isa, precision)
  {
    const struct mo_pack *pack =
        make_pack(controller, (enum mo_isa)isa, (enum mo_precision)precision);
    double worst[MO_MEASURES] = {0};
    for (uint32_t k = 0; k < ROBOTS; k++) {
      const struct mo_physics physics = physics_case(k % PHYSICS_CASES, 100);
      double values[LANES][MO_MEASURES];
      struct mo_outcome outcomes[LANES];
      run_block(pack, robots[k].body, environments, lanes, LANES, &physics, MO_MEASURES_ALL, values,
                outcomes);
      for (uint32_t l = 0; l < LANES; l++)
        for (int i = 0; i < MO_MEASURES; i++) {
          const double should = expected[k][l][i];
          CHECK(isnan(values[l][i]) == isnan(should));
          if (!isnan(should))
            worst[i] = fmax(worst[i], fabs(values[l][i] - should) / scale_of(i, should));
        }
    }
    printf("# %s, precision %d, differences:", mo_isa_name((enum mo_isa)isa), precision);
    for (int i = 0; i < MO_MEASURES; i++) {
      printf(" %s %.1e", mo_measure_info[i].name, worst[i]);
      CHECK(worst[i] <= bound_of(i, precision));
    }
    printf("\n");
  }
}

/* A lane has the same bits next to any others, in vectors of any width; measures have them without
 * other measures; and a rollout's outcome has them with measures or without. */
static void bits(void)
{
  struct mo_environment environments[LANES];
  fill_environments(environments);
  const uint32_t all[LANES] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9},
                 turned[LANES] = {9, 8, 7, 6, 5, 4, 3, 2, 1, 0}, some[3] = {4, 4, 7};
  const struct mo_robot *robots = make_robots(lattice, 33, 33, PHYSICS_CASES);
  EACH_KERNEL(isa, precision)
  for (uint32_t k = 0; k < PHYSICS_CASES; k++) {
    const struct mo_physics physics = physics_case(k, STEPS);
    const struct mo_pack *pack =
        make_pack(controller, (enum mo_isa)isa, (enum mo_precision)precision);
    double values[LANES][MO_MEASURES], others[LANES][MO_MEASURES];
    struct mo_outcome with[LANES], without[LANES];
    const struct mo_body *body = robots[k].body;
    run_block(pack, body, environments, all, LANES, &physics, MO_MEASURES_ALL, values, with);
    run_block(pack, body, environments, all, LANES, &physics, 0, NULL, without);
    CHECK(SAME(with, without, LANES));
    run_block(pack, body, environments, turned, LANES, &physics, MO_MEASURES_ALL, others, with);
    for (uint32_t l = 0; l < LANES; l++)
      CHECK(same_bits(values[turned[l]], others[l], MO_MEASURES));
    for (uint32_t n = 1; n <= 3; n += 2) {
      run_block(pack, body, environments, some, n, &physics, MO_MEASURES_ALL, others, with);
      for (uint32_t l = 0; l < n; l++)
        CHECK(same_bits(values[some[l]], others[l], MO_MEASURES));
    }
    for (int i = 0; i < MO_MEASURES && isa == (int)mo_isa_best(); i++) {
      run_block(pack, body, environments, some, 1, &physics, UINT32_C(1) << i, others, with);
      CHECK(same_bits(&values[some[0]][i], &others[0][i], 1));
      for (int j = 0; j < MO_MEASURES; j++)
        CHECK(j == i || isnan(others[0][j]));
    }
  }
}

/* ---- known values ---- */

static const struct mo_body *box(uint32_t nx, uint32_t ny, uint32_t nz)
{
  uint64_t voxels[MO_DEFAULT_WORDS] = {0};
  for (uint32_t x = 0; x < nx; x++)
    for (uint32_t y = 0; y < ny; y++)
      for (uint32_t z = 0; z < nz; z++) {
        const uint32_t v = (x * 6 + y) * 4 + z;
        voxels[v / 64] |= UINT64_C(1) << v % 64;
      }
  mo_genotype_place(MO_DEFAULT_WORKSPACE, voxels);
  return make_body(lattice, voxels);
}

/* Without a controller on flat ground. */
static void passive(double drop_height_m, uint32_t n_steps, double values[1][MO_MEASURES])
{
  struct mo_environment flat = {.light_xy_m = {4, 2.5}};
  struct mo_physics physics = physics_case(0, n_steps);
  struct mo_outcome outcome;
  const uint32_t lane = 0;
  physics.drop_height_m = drop_height_m;
  run_block(make_pack(NULL, mo_isa_best(), MO_FLOAT32), box(2, 2, 2), &flat, &lane, 1, &physics,
            MO_MEASURES_ALL, values, &outcome);
}

static void at_rest(void)
{
  double values[1][MO_MEASURES];
  passive(0, 500, values);
  const double *v = values[0];
  CHECK_NEAR(v[MO_MEASURE_DISPLACEMENT], 0, 1e-5);
  CHECK_NEAR(v[MO_MEASURE_SIDEWAYS], 0, 1e-5);
  CHECK(isnan(v[MO_MEASURE_HEADING_ERROR]) && isnan(v[MO_MEASURE_COST_OF_TRANSPORT]));
  CHECK_NEAR(v[MO_MEASURE_PEAK_HEIGHT], 0.1, 1e-6);
  CHECK_NEAR(v[MO_MEASURE_MEAN_HEIGHT], 0.1, 2e-3);
  CHECK_NEAR(v[MO_MEASURE_TILT], 0, 1e-4);
  CHECK_NEAR(v[MO_MEASURE_YAW_RATE], 0, 1e-4);
  CHECK_NEAR(v[MO_MEASURE_AIR_SHARE], 0, 0.01);
  for (int half = MO_MEASURE_CONTACT_FRONT; half <= MO_MEASURE_CONTACT_RIGHT; half++)
    CHECK_NEAR(v[half], 0.5, 0.01);
  CHECK_NEAR(v[MO_MEASURE_HOPS], 0, 1);
  CHECK_NEAR(v[MO_MEASURE_WORK], 0, 0);
  CHECK(v[MO_MEASURE_PEAK_STRAIN] > 1e-4 && v[MO_MEASURE_PEAK_STRAIN] < 0.02);
  CHECK_NEAR(v[MO_MEASURE_INVERTED_VOXELS], 0, 0);
  CHECK_INT(mo_measures_flags(v), 0);
  /* 0.2 m take 0.2 s at least; then it stays down */
  double early[1][MO_MEASURES];
  passive(0.2, 90, early);
  CHECK_NEAR(early[0][MO_MEASURE_AIR_SHARE], 1, 0);
  CHECK_NEAR(early[0][MO_MEASURE_CONTACT_LEFT], 0, 0);
  passive(0.2, 1000, values);
  CHECK(v[MO_MEASURE_AIR_SHARE] > 0.1 && v[MO_MEASURE_AIR_SHARE] < 0.5);
  CHECK_NEAR(v[MO_MEASURE_PEAK_HEIGHT], 0.3, 1e-6);
}

/* Poses of a body that turns as it goes around a square: the yaw counts whole turns. */
static void turns(void)
{
  const struct mo_environment flat = {.light_xy_m = {2.5, 6}};
  const double start[3] = {2.5, 2.5, 0.3};
  const struct mo_body *body = box(1, 1, 1);
  for (int sign = -1; sign <= 1; sign += 2) {
    const uint32_t n = 125;
    struct mo_physics physics = physics_case(0, n * 8);
    struct mo_observer observer;
    double values[MO_MEASURES], up[3] = {0.3, 0.4, 0.5};
    mo_observer_begin(&observer, body, &flat, &physics, start, flat.light_xy_m);
    for (uint32_t k = 1; k <= n; k++) {
      const double angle = sign * 0.3 * k;
      const struct mo_pose pose = {
          {start[0] + (k <= 100 ? 0.01 * k : 2 - 0.01 * k), start[1], 0.3 + (k == 50 ? 0.2 : 0)},
          {2 * cos(angle), 2 * sin(angle)}};
      mo_observe(&observer, &pose);
    }
    mo_observer_finish(&observer, false, up, values);
    mo_measures_round(MO_MEASURES_ALL, values, values);
    CHECK_NEAR(values[MO_MEASURE_YAW_RATE], sign * 0.3 / 0.016, 1e-6);
    CHECK_NEAR(values[MO_MEASURE_DISPLACEMENT], 0.75, 1e-9);
    CHECK_NEAR(values[MO_MEASURE_PATH_LENGTH], 1.25, 1e-9);
    CHECK_NEAR(values[MO_MEASURE_STRAIGHTNESS], 0.6, 1e-9);
    CHECK_NEAR(values[MO_MEASURE_HEADING_ERROR], 1.570796, 1e-9);
    CHECK_NEAR(values[MO_MEASURE_SIDEWAYS], -0.75, 1e-9); /* the light is to the left of +x */
    CHECK_NEAR(values[MO_MEASURE_PEAK_HEIGHT], 0.5, 1e-9);
    CHECK_NEAR(values[MO_MEASURE_TILT], 0.785398, 1e-9);
  }
}

static void divergence(void)
{
  struct mo_physics physics = physics_case(1, STEPS);
  physics.constants.stiffness_n_per_m = 60000;
  double values[1][MO_MEASURES];
  const struct mo_measuring measuring = {MO_MEASURES_ALL, values};
  struct mo_outcome outcome;
  const uint32_t lane = 0;
  for (int kernel = 0; kernel < 2; kernel++) {
    memset(values, 0, sizeof(values));
    if (kernel == 1)
      run_block(make_pack(controller, mo_isa_best(), MO_FLOAT32), box(3, 3, 2), paper_test, &lane,
                1, &physics, MO_MEASURES_ALL, values, &outcome);
    else
      REQUIRE(mo_rollout_reference(box(3, 3, 2), controller, paper_test, &physics, NULL, &measuring,
                                   &outcome) == MO_OK);
    CHECK(outcome.diverged_step > 0);
    for (int i = 0; i < MO_MEASURES; i++)
      CHECK(isnan(values[0][i]));
    CHECK_INT(mo_measures_flags(values[0]), 0);
  }
}

static void names(void)
{
  CHECK_TEXT(mo_measure_info[MO_MEASURE_DISPLACEMENT].name, "displacement_m");
  CHECK_TEXT(mo_measure_info[MO_MEASURE_HOPS].name, "hops_per_s");
  CHECK_TEXT(mo_measure_info[MO_MEASURE_INVERTED_VOXELS].name, "inverted_voxels");
  for (int i = 0; i < MO_MEASURES; i++) {
    for (int j = 0; j < i; j++)
      CHECK(strcmp(mo_measure_info[i].name, mo_measure_info[j].name) != 0);
    CHECK(mo_measure_info[i].help[0] != '\0' && mo_measure_info[i].steps_in_one >= 1);
  }
}

/* ---- ordinary rollouts ---- */

enum { BODIES = CHECK_SANITIZED ? 4 : 20 };

/* Random bodies in the paper's test set, of the default length: the bound of strains is far from
 * them, and few turn voxels inside out. */
static void ordinary(void)
{
  const char *count = getenv("MORPHO_MEASURED_BODIES");
  const uint32_t bodies = count != NULL ? (uint32_t)strtoul(count, NULL, 10) : BODIES,
                 n = bodies * LANES;
  const struct mo_robot *robots = make_robots(lattice, 34, 34, bodies);
  const struct mo_pack *pack = make_pack(controller, mo_isa_best(), MO_FLOAT32);
  const uint32_t all[LANES] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9};
  const struct mo_physics physics = physics_case(0, 2000);
  double(*values)[MO_MEASURES] = make_zeros(n, sizeof(*values)), *sorted = make_zeros(n, 8);
  struct mo_outcome outcomes[LANES];
  for (uint32_t k = 0; k < bodies; k++)
    run_block(pack, robots[k].body, paper_test, all, LANES, &physics, MO_MEASURES_ALL,
              values + (size_t)k * LANES, outcomes);
  printf("# %u rollouts: least, 5 %%, median, 95 %%, largest\n", n);
  for (int i = 0; i < MO_MEASURES; i++) {
    uint32_t valid = 0;
    for (uint32_t k = 0; k < n; k++)
      if (!isnan(values[k][i]))
        sorted[valid++] = values[k][i];
    qsort(sorted, valid, sizeof(*sorted), ascending);
    CHECK(valid >= 0.95 * n);
    printf("# %-20s %10.4g %10.4g %10.4g %10.4g %10.4g\n", mo_measure_info[i].name, sorted[0],
           sorted[valid / 20], median_of(sorted, valid), sorted[valid - 1 - valid / 20],
           sorted[valid - 1]);
  }
  uint32_t inverted = 0;
  for (uint32_t k = 0; k < n; k++) {
    CHECK((mo_measures_flags(values[k]) & MO_FLAG_OVERSTRAINED) == 0);
    inverted += (mo_measures_flags(values[k]) & MO_FLAG_INVERTED) != 0;
  }
  printf("# %u with inverted voxels\n", inverted);
  CHECK(inverted > 0 && inverted < 0.2 * n);
}

static void flags(void)
{
  double values[MO_MEASURES] = {0};
  CHECK_INT(mo_measures_flags(values), 0);
  values[MO_MEASURE_PEAK_STRAIN] = MO_PEAK_STRAIN_BOUND * 1.01;
  CHECK_INT(mo_measures_flags(values), MO_FLAG_OVERSTRAINED);
  values[MO_MEASURE_INVERTED_VOXELS] = 1;
  CHECK_INT(mo_measures_flags(values), MO_FLAG_OVERSTRAINED | MO_FLAG_INVERTED);
}

static const struct check_case cases[] = {
    {"names", names},
    {"the reference has the measures of the definitions", definitions},
    {"kernels have those of the reference", kernels},
    {"bits do not depend on neighbors or other measures", bits},
    {"a body at rest", at_rest},
    {"turns and ways", turns},
    {"a divergence has no measures", divergence},
    {"ordinary rollouts raise few flags", ordinary},
    {"flags", flags},
};
CHECK_MAIN_WITH(setup, cases)
