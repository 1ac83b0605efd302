/* cuda-check.c: compares the module with float64, and its results with each other. */
#include "cuda.h"

#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { RANDOM = 1000 };

/* Compares the losses of rows with a finite reference. */
static void compare(const char *name, const struct mo_outcome *outcomes, const double *truth,
                    uint32_t n)
{
  double *error = must_have(malloc(n * sizeof(*error))), mean = 0;
  uint32_t used = 0, apart = 0;
  for (uint32_t i = 0; i < n; i++) {
    if (isfinite(truth[i]) && isfinite(outcomes[i].loss)) {
      error[used++] = fabs(outcomes[i].loss - truth[i]);
      mean += outcomes[i].loss - truth[i];
    } else if (isfinite(truth[i]) != isfinite(outcomes[i].loss)) {
      apart++;
    }
  }
  mean /= used;
  const double median = quantile(error, used, 0.5);
  expect(median <= 1e-3 && fabs(mean) <= 0.003 && apart == 0,
         "%s: %u rollouts, |d loss| median %.2e, 90 %% %.2e, max %.2e, mean d %+.2e, diverged in "
         "only one %u",
         name, used, median, quantile(error, used, 0.9), error[used - 1], mean, apart);
  free(error);
}

static void check_golden(struct mo_device_controller *controller)
{
  static const char *const names[GOLDEN_MODES] = {"golden, exact impact", "golden, bisection8"};
  const uint32_t n = (uint32_t)golden.n;
  struct mo_robot *robots = must_have(calloc(n, sizeof(*robots)));
  struct mo_outcome *outcomes = must_have(calloc(n, sizeof(*outcomes)));
  double *truth = must_have(calloc(n, sizeof(*truth)));
  for (int mode = 0; mode < GOLDEN_MODES; mode++) {
    struct mo_physics physics = mo_paper_physics();
    physics.scheme.impact = mode == 0 ? MO_IMPACT_EXACT : MO_IMPACT_BISECTION;
    for (uint32_t i = 0; i < n; i++) {
      robots[i] = (struct mo_robot){golden.cases[i].body, &golden.cases[i].environment};
      truth[i] = golden.cases[i].loss[mode];
    }
    run(controller, robots, n, &physics, outcomes);
    compare(names[mode], outcomes, truth, n);
  }
  free(truth);
  free(outcomes);
  free(robots);
}

struct references {
  const struct mo_controller *controller;
  const struct mo_robot *robots;
  uint32_t n;
  const struct mo_physics *physics;
  struct mo_outcome *outcomes;
  double (*measures)[MO_MEASURES]; /* NULL or (n) */
  uint32_t next;
};

static void *compute_some(void *context)
{
  struct references *references = context;
  for (;;) {
    const uint32_t i = __atomic_fetch_add(&references->next, 1, __ATOMIC_RELAXED);
    if (i >= references->n)
      return NULL;
    const struct mo_measuring measuring = {
        .set = MO_MEASURES_ALL,
        .values = references->measures != NULL ? references->measures + i : NULL};
    must(mo_rollout_reference(references->robots[i].body, references->controller,
                              references->robots[i].environment, references->physics, NULL,
                              references->measures != NULL ? &measuring : NULL,
                              references->outcomes + i),
         "reference");
  }
}

void compute_references(const struct mo_controller *controller, const struct mo_robot *robots,
                        uint32_t n, const struct mo_physics *physics, struct mo_outcome *outcomes,
                        double (*measures)[MO_MEASURES])
{
  struct references references = {controller, robots, n, physics, outcomes, measures, 0};
  on_threads(sysconf(_SC_NPROCESSORS_ONLN), compute_some, &references);
}

static void load_references(const char *path, const struct mo_robot *robots, uint32_t n,
                            const struct mo_physics *physics, double *loss)
{
  FILE *file = path != NULL ? fopen(path, "rb") : NULL;
  if (file != NULL) {
    const size_t read = fread(loss, sizeof(*loss), n, file);
    fclose(file);
    if (read == n)
      return;
  }
  struct mo_outcome *outcomes = must_have(calloc(n, sizeof(*outcomes)));
  compute_references(golden.controller, robots, n, physics, outcomes, NULL);
  for (uint32_t i = 0; i < n; i++)
    loss[i] = outcomes[i].loss;
  free(outcomes);
  file = path != NULL ? fopen(path, "wb") : NULL;
  if (file != NULL) {
    fwrite(loss, sizeof(*loss), n, file);
    fclose(file);
  }
}

static void check_random(struct mo_device_controller *controller, const char *name, uint32_t n,
                         const struct mo_physics *physics, const char *path)
{
  struct mo_body **bodies = random_bodies(golden.lattice, RANDOM, 20251101);
  static struct mo_environment environments[RANDOM];
  static struct mo_robot robots[RANDOM];
  static struct mo_outcome outcomes[RANDOM];
  static double truth[RANDOM];
  for (uint32_t i = 0; i < n; i++) {
    mo_environment_held_out(20251101, i, environments + i);
    robots[i] = (struct mo_robot){bodies[i], environments + i};
  }
  load_references(path, robots, n, physics, truth);
  run(controller, robots, n, physics, outcomes);
  compare(name, outcomes, truth, n);
  free_bodies(bodies, RANDOM);
}

/* Starts on rough ground, which some bodies touch with more than their lowest layer, must be the
 * same as on the processors, and above the ground, so that the first step moves nothing far. */
static void check_starts(struct mo_device_controller *controller)
{
  struct mo_body **bodies = random_bodies(golden.lattice, RANDOM, 20251102);
  static struct mo_environment environments[RANDOM];
  static struct mo_robot robots[RANDOM];
  static struct mo_outcome outcomes[RANDOM];
  struct mo_physics physics = mo_paper_physics();
  double start = 0, worst = 0;
  for (uint32_t i = 0; i < RANDOM; i++) {
    environments[i] = (struct mo_environment){.light_xy_m = {4.5, 2.5}};
    mo_terrain_random(20251102, 0, i, 0.5, environments[i].terrain_heights_m);
    robots[i] = (struct mo_robot){bodies[i], environments + i};
  }
  physics.scheme.n_steps = 1;
  run(controller, robots, RANDOM, &physics, outcomes);
  for (uint32_t i = 0; i < RANDOM; i++) {
    struct mo_outcome truth;
    must(mo_rollout_reference(bodies[i], golden.controller, environments + i, &physics, NULL, NULL,
                              &truth),
         "reference");
    for (int axis = 0; axis < 3; axis++) {
      start = fmax(start, fabs(outcomes[i].com_start_m[axis] - truth.com_start_m[axis]));
      worst = fmax(worst, fabs(outcomes[i].com_end_m[axis] - truth.com_end_m[axis]));
    }
  }
  expect(start == 0 && worst <= 2e-5,
         "%d starts on rough ground: center of mass differs by %.1e m, after a step by %.1e m",
         RANDOM, start, worst);
  free_bodies(bodies, RANDOM);
}

/* A box of voxels on the floor. */
static struct mo_body *box(const int size[3])
{
  int64_t cells[MO_DEFAULT_VOXELS][3];
  size_t n = 0;
  for (int x = 0; x < size[0]; x++)
    for (int y = 0; y < size[1]; y++)
      for (int z = 0; z < size[2]; z++, n++) {
        cells[n][0] = x;
        cells[n][1] = y;
        cells[n][2] = z;
      }
  uint64_t bits[MO_DEFAULT_WORDS];
  must(mo_genotype_from_cells(MO_DEFAULT_WORKSPACE, (const int64_t(*)[3])cells, n, bits, NULL),
       "box");
  mo_genotype_place(MO_DEFAULT_WORKSPACE, bits);
  return body_of(bits);
}

/* Compares short rollouts of bodies of all sizes with float64: their paths have not diverged yet.
 */
static void check_sizes(uint32_t n_steps)
{
  static const int sizes[][3] = {{1, 1, 1}, {2, 1, 1}, {3, 2, 1}, {3, 3, 3},
                                 {6, 6, 1}, {6, 6, 2}, {6, 6, 4}};
  static const struct {
    const char *name;
    enum mo_sensor sensor;
    enum mo_impact impact;
    int is_passive;
    uint32_t control_steps;
    enum mo_integrator integrator;
  } kinds[] = {
      {"inverse root", MO_SENSOR_INVERSE_SQRT, MO_IMPACT_EXACT, 0, 0},
      {"inverse root, bisection8", MO_SENSOR_INVERSE_SQRT, MO_IMPACT_BISECTION, 0, 0},
      {"inverse square", MO_SENSOR_INVERSE_SQUARE, MO_IMPACT_EXACT, 0, 0},
      {"passive", MO_SENSOR_INVERSE_SQRT, MO_IMPACT_EXACT, 1, 0},
      {"period of 4 steps", MO_SENSOR_INVERSE_SQRT, MO_IMPACT_EXACT, 0, 4},
      {"period of 3 steps, bisection8, inverse square", MO_SENSOR_INVERSE_SQUARE,
       MO_IMPACT_BISECTION, 0, 3},
      {"period of 100 steps", MO_SENSOR_INVERSE_SQRT, MO_IMPACT_EXACT, 0, 100},
      {"passive, period of 4 steps", MO_SENSOR_INVERSE_SQRT, MO_IMPACT_EXACT, 1, 4},
      {"split", MO_SENSOR_INVERSE_SQRT, MO_IMPACT_EXACT, 0, 0, MO_INTEGRATOR_SPLIT},
      {"split, period of 4 steps", MO_SENSOR_INVERSE_SQRT, MO_IMPACT_EXACT, 0, 4,
       MO_INTEGRATOR_SPLIT},
      {"split, period of 3 steps, bisection8, inverse square", MO_SENSOR_INVERSE_SQUARE,
       MO_IMPACT_BISECTION, 0, 3, MO_INTEGRATOR_SPLIT},
      {"split, passive", MO_SENSOR_INVERSE_SQRT, MO_IMPACT_EXACT, 1, 0, MO_INTEGRATOR_SPLIT}};
  enum { SIZES = sizeof(sizes) / sizeof(sizes[0]), PLACES = 3 };
  struct mo_body *bodies[SIZES];
  for (int b = 0; b < SIZES; b++)
    bodies[b] = box(sizes[b]);
  struct rows *rows = make_rows(bodies, SIZES, PLACES);
  const enum mo_sensor sensor = golden.controller->sensor;
  for (size_t kind = 0; kind < sizeof(kinds) / sizeof(kinds[0]); kind++) {
    struct mo_device_controller *controller = NULL;
    struct mo_physics physics = physics_with(kinds[kind].integrator, kinds[kind].control_steps);
    double worst = 0, start = 0;
    physics.scheme.n_steps = n_steps;
    physics.drop_height_m = 0.05;
    physics.scheme.impact = kinds[kind].impact;
    golden.controller->sensor = kinds[kind].sensor;
    if (!kinds[kind].is_passive)
      must(module->controller_create(device, golden.controller, &controller), "controller");
    run(controller, rows->robots, rows->n, &physics, rows->outcomes);
    for (uint32_t r = 0; r < rows->n; r++) {
      const struct mo_outcome *outcome = rows->outcomes + r;
      struct mo_outcome truth;
      must(mo_rollout_reference(rows->robots[r].body,
                                kinds[kind].is_passive ? NULL : golden.controller,
                                rows->robots[r].environment, &physics, NULL, NULL, &truth),
           "reference");
      for (int axis = 0; axis < 3; axis++) {
        worst = fmax(worst, fabs(outcome->com_end_m[axis] - truth.com_end_m[axis]));
        start = fmax(start, fabs(outcome->com_start_m[axis] - truth.com_start_m[axis]));
      }
    }
    expect(worst <= 2e-5 && start == 0,
           "1 to 144 voxels, %u steps, %s: center of mass within %.1e m, start %.1e", n_steps,
           kinds[kind].name, worst, start);
    module->controller_free(device, controller);
  }
  golden.controller->sensor = sensor;
  free_rows(rows);
  for (int b = 0; b < SIZES; b++)
    mo_body_free(bodies[b]);
}

static void check_bits(struct mo_device_controller *controller, uint32_t n_bodies, uint32_t n_steps,
                       struct mo_physics physics)
{
  struct mo_body **bodies = random_bodies(golden.lattice, n_bodies, 5);
  struct rows *rows = make_rows(bodies, n_bodies, 3);
  const uint32_t n = rows->n;
  struct mo_robot *turned = must_have(calloc(n, sizeof(*turned)));
  struct mo_outcome *again = must_have(calloc(n, sizeof(*again)));
  int same = 1;
  for (uint32_t i = 0; i < n; i++)
    turned[n - 1 - i] = rows->robots[i];
  physics.scheme.n_steps = n_steps;
  run(controller, rows->robots, n, &physics, rows->outcomes);
  run(controller, rows->robots, n, &physics, again);
  expect(memcmp(rows->outcomes, again, n * sizeof(*again)) == 0, "two runs produce the same bits");
  run(controller, turned, n, &physics, again);
  for (uint32_t i = 0; i < n; i++)
    same &= memcmp(rows->outcomes + i, again + n - 1 - i, sizeof(*again)) == 0;
  expect(same, "the reverse order produces the same bits");
  same = 1;
  for (uint32_t i = 0; i < n; i += n / 7 + 1) {
    run(controller, rows->robots + i, 1, &physics, again);
    same &= memcmp(rows->outcomes + i, again, sizeof(*again)) == 0;
  }
  expect(same, "a single row has the same bits");
  free(again);
  free(turned);
  free_rows(rows);
  free_bodies(bodies, n_bodies);
}

/* A period of one step changes nothing; one that is not a whole number of steps is refused. */
static void check_periods(struct mo_device_controller *controller)
{
  enum { N = 64 };
  struct mo_body **bodies = random_bodies(golden.lattice, N, 11);
  struct rows *rows = make_rows(bodies, N, 1);
  struct mo_outcome again[N];
  struct mo_physics physics = physics_with_period(0), step = physics_with_period(1),
                    held = physics_with_period(4), refused = physics_with_period(1);
  refused.scheme.control_period_s *= 1.5;
  run(controller, rows->robots, N, &physics, rows->outcomes);
  run(controller, rows->robots, N, &step, again);
  expect(memcmp(rows->outcomes, again, sizeof(again)) == 0, "a period of one step changes no bit");
  run(controller, rows->robots, N, &held, again);
  expect(memcmp(rows->outcomes, again, sizeof(again)) != 0, "one of four steps does");
  struct mo_device_score score = {.controller = controller,
                                  .robots = rows->robots,
                                  .n = N,
                                  .physics = refused,
                                  .outcomes = again};
  expect(module->score(device, &score) == MO_ERR_INVALID, "one and a half steps are refused");
  free_rows(rows);
  free_bodies(bodies, N);
}

/* Springs too stiff for the time step: compares which rows diverge, when, and at which position. */
static void check_divergence(struct mo_device_controller *controller)
{
  enum { N = 64 };
  struct mo_body **bodies = random_bodies(golden.lattice, N, 9);
  struct rows *rows = make_rows(bodies, N, 1);
  struct mo_physics physics = mo_paper_physics();
  physics.constants.stiffness_n_per_m *= 4;
  physics.scheme.n_steps = 200;
  run(controller, rows->robots, N, &physics, rows->outcomes);
  int diverged = 0, agree = 1;
  double apart = 0;
  for (uint32_t i = 0; i < N; i++) {
    const struct mo_outcome *o = rows->outcomes + i;
    struct mo_outcome truth;
    must(mo_rollout_reference(bodies[i], golden.controller, rows->robots[i].environment, &physics,
                              NULL, NULL, &truth),
         "reference");
    diverged += truth.diverged_step != 0;
    agree &= (truth.diverged_step != 0) == (o->diverged_step != 0) &&
             abs(truth.diverged_step - o->diverged_step) <= 2 &&
             isinf(truth.loss) == isinf(o->loss) &&
             isfinite(o->com_end_m[0] + o->com_end_m[1] + o->com_end_m[2]);
    for (int axis = 0; axis < 3 && truth.diverged_step == o->diverged_step; axis++)
      apart = fmax(apart, fabs(truth.com_end_m[axis] - o->com_end_m[axis]));
  }
  expect(diverged > 0 && agree,
         "stiffness x 4: %d of %d diverge, the same rows within 2 steps; last place within %.1e m",
         diverged, N, apart);
  free_rows(rows);
  free_bodies(bodies, N);
}

static volatile int flag;

static void *raise_flag(void *unused)
{
  usleep(20000);
  flag = 1;
  return unused;
}

static void check_cancel(struct mo_device_controller *controller)
{
  struct mo_robot robot = {golden.cases[0].body, &golden.cases[0].environment};
  struct mo_outcome outcome;
  struct mo_device_score score = {.controller = controller,
                                  .robots = &robot,
                                  .n = 1,
                                  .physics = mo_paper_physics(),
                                  .cancel = &flag,
                                  .outcomes = &outcome};
  pthread_t thread;
  score.physics.scheme.n_steps = 100000; /* seconds */
  flag = 0;
  must(pthread_create(&thread, NULL, raise_flag, NULL) == 0 ? MO_OK : MO_ERR_NO_MEMORY, "thread");
  const double start = now_s();
  const int status = module->score(device, &score);
  const double took = now_s() - start;
  pthread_join(thread, NULL);
  expect(status == MO_ERR_CANCELLED && took < 0.2,
         "a flag set after 20 ms stops a call after %.0f ms", 1e3 * took);
  flag = 0;
  score.physics.scheme.n_steps = 10;
  expect(module->score(device, &score) == MO_OK && isfinite(outcome.loss), "the next call works");
}

void check_short(struct mo_device_controller *controller)
{
  check_sizes(3);
  check_bits(controller, 20, 3, physics_with_period(0));
  check_bits(controller, 20, 3, physics_with_period(2));
  check_bits(controller, 20, 3, physics_with(MO_INTEGRATOR_SPLIT, 4));
  check_tasks_short(controller, 9);
  check_measures_short(controller, 9);
}

void check_all(struct mo_device_controller *controller, const char *references)
{
  const struct mo_physics every = physics_with_period(0), threes = physics_with_period(3),
                          fours = physics_with_period(4),
                          split = physics_with(MO_INTEGRATOR_SPLIT, 4);
  check_sizes(40);
  check_tasks(controller);
  check_measures(controller);
  check_starts(controller);
  check_golden(controller);
  check_random(controller, "random, exact impact", RANDOM, &every, references);
  check_random(controller, "random, period of 4 steps", RANDOM / 2, &fours, NULL);
  check_random(controller, "random, period of 3 steps", RANDOM / 2, &threes, NULL);
  check_random(controller, "random, split, period of 4 steps", RANDOM / 2, &split, NULL);
  check_bits(controller, 400, 1000, every);
  check_bits(controller, 100, 1000, threes);
  check_bits(controller, 100, 1000, split);
  check_periods(controller);
  check_divergence(controller);
  check_cancel(controller);
}
