/* Tasks: where guides put the light, and what objectives measure. `oracle` computes both from the
 * equations of docs/model.md alone; it shares only the terrain's height with the library. */
#include "../make.h"
#include "rollout/reference.h"
#include "task-cases.h"

enum { FRAMES = 400 };
static struct mo_lattice *lattice;
static struct mo_controller *controller;

static void setup(void)
{
  lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  controller = make_shipped_controller("phototaxis");
}

static const char *name_of(const struct mo_task *task)
{
  static char name[64];
  snprintf(name, sizeof(name), "%s, %s", mo_guide_words[task->guide.kind],
           mo_objective_words[task->objective]);
  return name;
}

/* ---- the oracle ---- */

struct oracle {
  const struct mo_environment *environment;
  double start[3], before[2]; /* centers of mass: at the start, at the last instant */
  double heading_before;
  double corner[MO_GUIDE_POINTS_MAX + 1][2];
  uint32_t reached; /* waypoints */
  double along;     /* progress on the leg to the next one */
  double sum, distance_at_start, progress_at_start;
  uint32_t n; /* instants after the start */
  double light[3];
};

static double way(const double *a, const double *b)
{
  return sqrt((a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1]));
}

static double heading_at(const struct mo_guide *guide, double t)
{
  return guide->heading_rad + (guide->kind == MO_GUIDE_TURNING ? guide->turn_rad_per_s * t : 0);
}

/* Returns the nearest point of the current leg as a share of the leg. */
static double nearest_share(const struct oracle *o, const double *com)
{
  const double *a = o->corner[o->reached], *b = o->corner[o->reached + 1];
  const double dx = b[0] - a[0], dy = b[1] - a[1], square = dx * dx + dy * dy;
  const double share = square > 0 ? ((com[0] - a[0]) * dx + (com[1] - a[1]) * dy) / square : 0;
  return share < 0 ? 0 : share > 1 ? 1 : share;
}

static double progress(const struct oracle *o)
{
  double sum = o->along;
  for (uint32_t leg = 0; leg < o->reached; leg++)
    sum += way(o->corner[leg], o->corner[leg + 1]);
  return sum;
}

/* Places the light at time t for a center of mass. */
static void oracle_light(struct oracle *o, double t, const double *com)
{
  const struct mo_guide *guide = &o->environment->task.guide;
  const double *from = o->environment->light_xy_m;
  o->light[0] = from[0];
  o->light[1] = from[1];
  if (guide->kind == MO_GUIDE_AHEAD || guide->kind == MO_GUIDE_TURNING) {
    o->light[0] = com[0] + guide->distance_m * cos(heading_at(guide, t));
    o->light[1] = com[1] + guide->distance_m * sin(heading_at(guide, t));
  } else if (guide->kind == MO_GUIDE_MOVING) {
    const double angle = guide->turn_rad_per_s * t, *c = guide->center_m;
    for (int i = 0; i < 2; i++)
      o->light[i] = c[i] + guide->velocity_m_per_s[i] * t + cos(angle) * (from[i] - c[i]);
    o->light[0] -= sin(angle) * (from[1] - c[1]);
    o->light[1] += sin(angle) * (from[0] - c[0]);
  } else if (guide->kind == MO_GUIDE_PATH) {
    for (; o->reached + 1 < guide->n_points && way(com, o->corner[o->reached + 1]) <= 0.2;
         o->reached++)
      o->along = 0;
    const double *a = o->corner[o->reached], *b = o->corner[o->reached + 1], length = way(a, b);
    o->along = fmax(o->along, nearest_share(o, com) * length);
    const double ahead = fmin(o->along + guide->distance_m, length);
    for (int i = 0; i < 2; i++)
      o->light[i] = a[i] + (length > 0 ? (b[i] - a[i]) * ahead / length : 0);
  }
  o->light[2] = mo_terrain_height(o->environment, o->light[0], o->light[1]);
}

static void oracle_start(struct oracle *o, const struct mo_environment *environment,
                         const double *com)
{
  const struct mo_guide *guide = &environment->task.guide;
  *o = (struct oracle){.environment = environment, .heading_before = heading_at(guide, 0)};
  memcpy(o->start, com, sizeof(o->start));
  memcpy(o->before, com, sizeof(o->before));
  memcpy(o->corner[0], com, sizeof(o->corner[0]));
  memcpy(o->corner[1], guide->points_m, sizeof(guide->points_m));
  oracle_light(o, 0, com);
  o->distance_at_start = way(com, o->light);
  o->progress_at_start = progress(o);
}

/* The next instant: the start of a control period, or the end. */
static void oracle_next(struct oracle *o, double t, const double *com)
{
  const struct mo_task *task = &o->environment->task;
  oracle_light(o, t, com);
  if (task->objective == MO_OBJECTIVE_TRAVEL)
    o->sum += (com[0] - o->before[0]) * cos(o->heading_before) +
              (com[1] - o->before[1]) * sin(o->heading_before);
  else if (task->objective == MO_OBJECTIVE_FOLLOW) {
    const double *a = o->corner[o->reached], *b = o->corner[o->reached + 1],
                 share = nearest_share(o, com);
    const double near[2] = {a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])};
    o->sum += way(com, near);
  } else
    o->sum += way(com, o->light);
  o->heading_before = heading_at(&task->guide, t);
  memcpy(o->before, com, sizeof(o->before));
  o->n++;
}

/* The value, and the loss that belongs to it; com: at the end. */
static double oracle_value(const struct oracle *o, const double *com, double *loss)
{
  double value = 0;
  switch (o->environment->task.objective) {
  case MO_OBJECTIVE_REACH: value = 1 - way(com, o->light) / (o->distance_at_start + 1e-8); break;
  case MO_OBJECTIVE_APPROACH:
  case MO_OBJECTIVE_PURSUE: value = 1 - o->sum / o->n / (o->distance_at_start + 1e-8); break;
  case MO_OBJECTIVE_TRAVEL: value = o->sum; break;
  case MO_OBJECTIVE_FOLLOW: value = progress(o) - o->progress_at_start - o->sum / o->n; break;
  case MO_OBJECTIVE_CLIMB: value = com[2] - o->start[2]; break;
  default: break; /* objectives.c has the others */
  }
  const bool in_meters = *mo_objective_unit(o->environment->task.objective) == 'm';
  const double unit_m = o->environment->task.objective == MO_OBJECTIVE_CLIMB ? 0.1 : 1;
  *loss = in_meters ? exp(-value / unit_m) : 1 - value;
  return value;
}

/* ---- the reference ---- */

static struct mo_environment environment_of(uint32_t k)
{
  struct mo_environment environment;
  mo_environment_training(31, 0, k, &environment);
  environment.task = task_case(k % TASK_CASES);
  return environment;
}

static struct mo_physics variant_of(uint32_t variant, uint32_t n_steps)
{
  static const uint32_t held[] = {0, 4, 7};
  struct mo_physics physics = physics_of(n_steps);
  physics.scheme.integrator = variant % 2 == 0 ? MO_INTEGRATOR_PAPER : MO_INTEGRATOR_SPLIT;
  physics.scheme.control_period_s = held[variant % 3] * physics.scheme.dt_s;
  return physics;
}

/* Every light of a rollout, and its outcome. */
static void reference(void)
{
  const struct mo_robot *robots = make_robots(lattice, 3, 3, TASK_CASES);
  double worst_m = 0, worst = 0;
  uint32_t legs = 0;
  for (uint32_t k = 0; k < 3 * TASK_CASES; k++) {
    const struct mo_environment environment = environment_of(k);
    const struct mo_physics physics = variant_of(k / TASK_CASES, FRAMES - 1);
    const struct mo_body *body = robots[k % TASK_CASES].body;
    const uint32_t held = mo_control_steps(&physics.scheme);
    static double com_m[FRAMES][3];
    const struct mo_recording recording = {.stride = 1, .com_m = com_m[0]};
    struct mo_outcome outcome;
    struct mo_reference r;
    struct oracle o;
    REQUIRE_OK(
        mo_rollout_reference(body, controller, &environment, &physics, &recording, NULL, &outcome));
    REQUIRE_OK(mo_reference_init(&r, body, controller, &environment, &physics));
    oracle_start(&o, &environment, com_m[0]);
    for (uint32_t step = 0; step < physics.scheme.n_steps; step++) {
      if (step > 0 && step % held == 0)
        oracle_next(&o, step * physics.scheme.dt_s, com_m[step]);
      REQUIRE(mo_reference_step(&r, step));
      for (int axis = 0; axis < 3; axis++)
        worst_m = fmax(worst_m, fabs(r.light_m[axis] - o.light[axis]));
    }
    mo_reference_done(&r);
    oracle_next(&o, physics.scheme.n_steps * physics.scheme.dt_s, outcome.com_end_m);
    legs += o.reached;
    double loss, value = oracle_value(&o, outcome.com_end_m, &loss);
    worst = fmax(worst, fmax(fabs(loss - outcome.loss), fabs(value - outcome.value)));
    CHECK(fabs(outcome.value) > 1e-4 && outcome.loss > 0);
  }
  printf("# lights differ by at most %.1e m, losses and values by %.1e; %u waypoints reached\n",
         worst_m, worst, legs);
  CHECK(worst_m <= 1e-12);
  CHECK(worst <= 1e-12);
  CHECK(legs > 6);
}

/* A body without a controller stands still on flat ground: its loss is 1, unless the light comes
 * nearer, or the body is off the path at the start. It sags under its weight. */
static void nothing(void)
{
  const struct mo_robot *robots = make_robots(lattice, 4, 4, 1);
  for (uint32_t k = 0; k < TASK_CASES; k++) {
    struct mo_environment environment = environment_of(k);
    const struct mo_physics physics = physics_of(50);
    struct mo_outcome outcome;
    memset(environment.terrain_heights_m, 0, sizeof(environment.terrain_heights_m));
    if (environment.task.guide.kind == MO_GUIDE_MOVING || environment.task.guide.n_points > 1)
      continue;
    REQUIRE_OK(
        mo_rollout_reference(robots[0].body, NULL, &environment, &physics, NULL, NULL, &outcome));
    CHECK_NEAR(outcome.loss, 1, environment.task.objective == MO_OBJECTIVE_CLIMB ? 0.3 : 3e-3);
  }
}

/* ---- the kernels ---- */

static void block_of(const struct mo_pack *pack, const struct mo_body *body,
                     const struct mo_environment *environments, const uint32_t *lanes, uint32_t n,
                     const struct mo_physics *physics, struct mo_outcome *outcomes)
{
  const size_t kept = check_n_kept;
  const struct mo_environment *list[MO_BLOCK_LANES];
  for (uint32_t l = 0; l < n; l++)
    list[l] = environments + lanes[l];
  make_check(mo_rollout_block(make_workspace_memory(), pack, body, list, n, physics, NULL, NULL,
                              NULL, outcomes),
             "rollouts");
  check_drop_to(kept);
}

/* Tasks of all guides in one block, next to plain lanes: as in the reference, and with the bits of
 * each lane by itself. */
static void kernels(void)
{
  enum { N = TASK_CASES + 3 };
  static const uint32_t alone[N] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
  struct mo_environment environments[N];
  const struct mo_robot *robots = make_robots(lattice, 5, 5, 3);
  for (uint32_t k = 0; k < N; k++) {
    environments[k] = environment_of(k);
    if (k >= TASK_CASES)
      environments[k].task = (struct mo_task){0};
  }
  struct mo_outcome exact[3][N];
  for (uint32_t variant = 0; variant < 3; variant++) {
    const struct mo_physics physics = variant_of(variant, 60);
    for (uint32_t k = 0; k < N; k++)
      REQUIRE_OK(mo_rollout_reference(robots[variant].body, controller, &environments[k], &physics,
                                      NULL, NULL, &exact[variant][k]));
  }
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)
    for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++) {
      const size_t kept = check_n_kept;
      const struct mo_pack *pack =
          make_pack(controller, (enum mo_isa)isa, (enum mo_precision)precision);
      double worst = 0;
      for (uint32_t variant = 0; variant < 3; variant++) {
        const struct mo_body *body = robots[variant].body;
        const struct mo_physics physics = variant_of(variant, 60);
        struct mo_outcome outcomes[N], turned[N], one;
        uint32_t lanes[N];
        for (uint32_t l = 0; l < N; l++)
          lanes[l] = (5 * l + 3) % N;
        block_of(pack, body, environments, alone, N, &physics, outcomes);
        block_of(pack, body, environments, lanes, N, &physics, turned);
        for (uint32_t k = 0; k < N; k++) {
          block_of(pack, body, environments, alone + k, 1, &physics, &one);
          CHECK(memcmp(&one, &outcomes[k], sizeof(one)) == 0);
          worst = fmax(worst, fmax(fabs(exact[variant][k].loss - one.loss),
                                   fabs(exact[variant][k].value - one.value)));
        }
        for (uint32_t l = 0; l < N; l++)
          CHECK(memcmp(&turned[l], &outcomes[lanes[l]], sizeof(one)) == 0);
      }
      printf("# %s, %s: losses and values are within %.1e of the reference's\n",
             mo_isa_name((enum mo_isa)isa), precision == MO_FLOAT32 ? "float32" : "float64", worst);
      CHECK(worst <= (precision == MO_FLOAT32 ? 1e-3 : 1e-9));
      check_drop_to(kept);
    }
}

/* A rollout that diverges has no finite value. */
static void divergence(void)
{
  const struct mo_robot *robots = make_robots(lattice, 6, 6, 1);
  struct mo_physics physics = physics_of(200);
  physics.constants.stiffness_n_per_m = 60000;
  for (uint32_t k = 0; k < TASK_CASES; k++) {
    const struct mo_environment environment = environment_of(k);
    const uint32_t lane = 0;
    struct mo_outcome outcome;
    REQUIRE_OK(mo_rollout_reference(robots[0].body, controller, &environment, &physics, NULL, NULL,
                                    &outcome));
    CHECK(outcome.diverged_step > 0 && isinf(outcome.loss) && outcome.loss > 0);
    CHECK(isinf(outcome.value) && outcome.value < 0);
    block_of(make_pack(controller, MO_ISA_BASELINE, MO_FLOAT32), robots[0].body, &environment,
             &lane, 1, &physics, &outcome);
    CHECK(outcome.diverged_step > 0 && isinf(outcome.loss) && outcome.loss > 0);
    CHECK(isinf(outcome.value) && outcome.value < 0);
  }
}

/* A fall of 70 m and more would overflow the loss of `climb`. */
static void long_falls(void)
{
  struct mo_robot *robots = make_robots(lattice, 1, 1, 1);
  struct mo_environment environment = *robots[0].environment;
  struct mo_physics physics = physics_of(1000);
  struct mo_outcome outcome;
  environment.task = (struct mo_task){{.kind = MO_GUIDE_FIXED}, MO_OBJECTIVE_CLIMB};
  physics.constants.drag_per_s = 0;
  physics.drop_height_m = 200;
  REQUIRE_OK(
      mo_rollout_reference(robots[0].body, NULL, &environment, &physics, NULL, NULL, &outcome));
  CHECK_INT(outcome.diverged_step, 0);
  CHECK(outcome.value < -70 && isfinite(outcome.loss) && outcome.loss > 1e200);
}

/* ---- behavior ---- */

enum { WALKERS = 30 };

/* The shipped controller follows a light that leads it, although it was trained with fixed
 * lights. Bodies are the first of its pretraining run's stream. */
static void walks(void)
{
  struct mo_robot *robots = make_robots(lattice, 1, 1, WALKERS);
  const struct mo_pack *pack = make_pack(controller, mo_isa_best(), MO_FLOAT32);
  const struct mo_physics physics = physics_of(1000);
  struct mo_environment tasks[] = {
      {.task = {{.kind = MO_GUIDE_AHEAD, .distance_m = 1.5}, MO_OBJECTIVE_TRAVEL}},
      {.task = {{.kind = MO_GUIDE_AHEAD, .heading_rad = M_PI, .distance_m = 1.5},
                MO_OBJECTIVE_TRAVEL}},
      {.task = {{.kind = MO_GUIDE_TURNING, .turn_rad_per_s = M_PI / 2, .distance_m = 1.5},
                MO_OBJECTIVE_TRAVEL}},
      {.task = {{.kind = MO_GUIDE_PATH,
                 .n_points = 2,
                 .points_m = {{3.5, 2.5}, {2.5, 2.5}},
                 .distance_m = 1.5},
                MO_OBJECTIVE_FOLLOW}},
  };
  static const uint32_t lanes[] = {0, 1, 2, 3};
  double value[COUNT(tasks)][WALKERS];
  for (uint32_t i = 0; i < WALKERS; i++) {
    struct mo_outcome outcomes[COUNT(tasks)];
    for (size_t k = 0; k < COUNT(tasks); k++)
      memcpy(tasks[k].terrain_heights_m, robots[i].environment->terrain_heights_m,
             sizeof(tasks[k].terrain_heights_m));
    block_of(pack, robots[i].body, tasks, lanes, COUNT(tasks), &physics, outcomes);
    for (size_t k = 0; k < COUNT(tasks); k++)
      value[k][i] = outcomes[k].value;
  }
  for (size_t k = 0; k < COUNT(tasks); k++) {
    qsort(value[k], WALKERS, sizeof(double), ascending);
    const double median = median_of(value[k], WALKERS);
    printf("# %s: median %.2f m in 4 s, smallest %.2f m, largest %.2f m\n", name_of(&tasks[k].task),
           median, value[k][0], value[k][WALKERS - 1]);
    CHECK(median >= 1.2);
  }
}

static const struct check_case cases[] = {
    {"reference: lights, losses and values", reference},
    {"a body that does nothing", nothing},
    {"kernels: every task in one block", kernels},
    {"divergence", divergence},
    {"long falls", long_falls},
    {"the shipped controller follows guides", walks},
};
CHECK_MAIN_WITH(setup, cases)
