/* stability.c: which physics rollouts survive, compared with the bound of the linear theory
 * (docs/numerics.md).
 *
 * The map has 32 robots per cell (eight bodies, each in four training environments). It varies the
 * time step together with the stiffness or with another setting, for both integrators and three
 * control periods. Each cell also checks that the rollouts and their gradient return only finite
 * numbers; the loss of a diverged rollout is infinite by definition.
 *
 * The border is the stiffness above which at least one of the ten rollouts of a body in the paper's
 * test set diverges. It is found by bisection, and compared with the linear bound of the same body,
 * from the largest eigenvalue of its springs. */
#include "bench.h"

#include <math.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>

#include "base/processors.h"
#include "base/thread.h"
#include "rollout/kick.h"

enum {
  RANDOM_BODIES = 5,
  BODIES = 3 + RANDOM_BODIES,
  ENVIRONMENTS = 4,
  ROBOTS = BODIES * ENVIRONMENTS,
  GRADIENT_STEPS = 200,
  INTEGRATORS = 2,
  PERIODS = 3,
  ROWS = 21,
  FEW_ROWS = 9, /* rows of the map with the longest period: the stiffnesses */
  TIMES = 11,
  FEW_TIMES = 3, /* the shortest steps, which only the rows of stiffnesses have */
  CELLS = INTEGRATORS * PERIODS * ROWS * TIMES,
  STEPS_MAX = 5000
};

#define LEAST_S       0.5 /* a drop from 1 m takes 0.45 s */
#define LEAST_STEPS   400
#define LONG_PERIOD_S 0.016
#define BLOWN_UP      2.0 /* a spring's length, in rest lengths */

static const char *const period_names[PERIODS] = {"1 step", "4 steps", "16 ms"};
static const double times_s[TIMES] = {1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 3e-3,
                                      4e-3, 5e-3, 6e-3, 8e-3, 1e-2};

/* A change to the default physics, environments or controller. */
struct change {
  enum {
    NOTHING,
    STIFFNESS,
    DRAG,
    FRICTION,
    MASS,
    ROUGHNESS, /* factor of the terrain's heights */
    DROP,
    RIM, /* lights in the corners of the terrain */
    PASSIVE
  } what;
  double value;
};
static const struct {
  const char *name;
  struct change changes[5];
} rows[ROWS] = {
    {"1e3 N/m", {{STIFFNESS, 1e3}}},
    {"3e3 N/m", {{STIFFNESS, 3e3}}},
    {"1e4 N/m", {{STIFFNESS, 1e4}}},
    {"3e4 N/m", {{STIFFNESS, 3e4}}},
    {"1e5 N/m", {{STIFFNESS, 1e5}}},
    {"3e5 N/m", {{STIFFNESS, 3e5}}},
    {"1e6 N/m", {{STIFFNESS, 1e6}}},
    {"3e6 N/m", {{STIFFNESS, 3e6}}},
    {"1e7 N/m", {{STIFFNESS, 1e7}}},
    {"defaults", {{NOTHING, 0}}},
    {"passive", {{PASSIVE, 0}}},
    {"drag 0", {{DRAG, 0}}},
    {"drag 100 /s", {{DRAG, 100}}},
    {"friction 0", {{FRICTION, 0}}},
    {"friction 2", {{FRICTION, 2}}},
    {"0.1 kg", {{MASS, 0.1}}},
    {"10 kg", {{MASS, 10}}},
    {"terrain x 3", {{ROUGHNESS, 3}}},
    {"drop 1 m", {{DROP, 1}}},
    {"light at rim", {{RIM, 0}}},
    /* with drag 0 and friction 2 */
    {"all at once", {{ROUGHNESS, 3}, {DROP, 1}, {RIM, 0}, {DRAG, 0}, {FRICTION, 2}}},
};

enum fate { STAYS, BLEW_UP, DIVERGED, FATES };
static const char *const fate_marks[FATES] = {"", "b", "D"};

struct cell {
  uint32_t period, row;
  struct mo_physics physics;
  double roughness;
  bool is_rim, is_passive;
  bool is_run; /* false: not part of the map, or refused */
  /* results */
  uint32_t n[FATES];
  uint32_t zeroed; /* robots without a gradient although they did not diverge */
  double stretch;  /* largest length of a spring, in rest lengths, without robots that diverged */
  int32_t first;   /* step of the first divergence; 0: no divergence */
  uint32_t wrong;  /* numbers that should be finite, but are not */
};

struct runner {
  struct bench_scene scene;
  const struct bench_options *options;
  struct mo_body *body[BODIES];
  struct mo_environment environments[ENVIRONMENTS];
  struct cell *cells; /* (CELLS) */
  atomic_uint next;
};

/* The memory of one thread. */
struct lane {
  struct mo_pack *packs[2], *gradient; /* packs: passive, moved */
  struct mo_workspace_memory *memory;
  struct mo_gradient_memory *gradient_memory;
  struct mo_recording recordings[ENVIRONMENTS];
  float *d_parameters;
  size_t n_parameters;
};

/* ---- cells ---- */

static void change(struct cell *cell, struct change change)
{
  struct mo_constants *constants = &cell->physics.constants;
  switch (change.what) {
  case NOTHING: break;
  case STIFFNESS: constants->stiffness_n_per_m = change.value; break;
  case DRAG: constants->drag_per_s = change.value; break;
  case FRICTION: constants->friction = change.value; break;
  case MASS: constants->mass_kg = change.value; break;
  case ROUGHNESS: cell->roughness = change.value; break;
  case DROP: cell->physics.drop_height_m = change.value; break;
  case RIM: cell->is_rim = true; break;
  case PASSIVE: cell->is_passive = true; break;
  }
}

static double period_s(uint32_t period, double dt_s)
{
  return period == 0 ? 0 : period == 1 ? 4 * dt_s : LONG_PERIOD_S;
}

static struct cell cell_at(uint32_t place)
{
  const uint32_t time = place % TIMES, row = place / TIMES % ROWS,
                 period = place / (TIMES * ROWS) % PERIODS;
  struct cell cell = {.period = period, .row = row, .physics = mo_paper_physics(), .roughness = 1};
  struct mo_scheme *scheme = &cell.physics.scheme;
  scheme->integrator = (enum mo_integrator)(place / (TIMES * ROWS * PERIODS));
  scheme->dt_s = times_s[time];
  scheme->n_steps = (uint32_t)fmax(LEAST_STEPS, ceil(LEAST_S / scheme->dt_s - 1e-9));
  scheme->control_period_s = period_s(period, scheme->dt_s);
  for (size_t i = 0; i < sizeof(rows[row].changes) / sizeof(rows[row].changes[0]); i++)
    change(&cell, rows[row].changes[i]);
  const bool is_wanted = row < FEW_ROWS || (period < PERIODS - 1 && time >= FEW_TIMES);
  cell.is_run = is_wanted && mo_physics_check(&cell.physics, NULL) == MO_OK;
  return cell;
}

static uint32_t count_wrong(const double *values, size_t n)
{
  uint32_t wrong = 0;
  for (size_t i = 0; i < n; i++)
    wrong += !isfinite(values[i]);
  return wrong;
}

/* A loss is finite unless its rollout diverged, and then it is +∞. */
static uint32_t check_outcome(const struct mo_outcome *outcome)
{
  const bool good =
      outcome->diverged_step > 0 ? outcome->loss == INFINITY : isfinite(outcome->loss) != 0;
  return !good + count_wrong(outcome->com_start_m, 3) + count_wrong(outcome->com_end_m, 3);
}

/* Checks the masses of a recording, and returns the largest length of a spring in rest lengths. */
static double stretch_of(const struct mo_body *body, const struct mo_recording *recording,
                         uint32_t frames, uint32_t *wrong)
{
  double stretch = 0;
  for (uint32_t f = 0; f < frames; f++) {
    const float *x = recording->mass_m + (size_t)f * body->n_masses * 3;
    for (uint32_t i = 0; i < 3 * body->n_masses; i++)
      *wrong += !isfinite(x[i]);
    for (uint32_t s = 0; s < body->n_springs; s++) {
      const float *a = x + 3 * (size_t)body->spring_a[s], *b = x + 3 * (size_t)body->spring_b[s];
      const double d[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]}, rest = body->spring_rest_m[s];
      stretch = fmax(stretch, (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) / (rest * rest));
    }
  }
  return sqrt(stretch);
}

static void run_body(struct lane *lane, const struct mo_body *body,
                     const struct mo_environment *environments, struct cell *cell)
{
  const struct mo_environment *list[ENVIRONMENTS];
  struct mo_outcome outcomes[ENVIRONMENTS];
  const uint32_t frames = mo_recording_frames(&cell->physics, 1);
  for (int e = 0; e < ENVIRONMENTS; e++)
    list[e] = environments + e;
  bench_check(mo_rollout_block(lane->memory, lane->packs[!cell->is_passive], body, list,
                               ENVIRONMENTS, &cell->physics, lane->recordings, NULL, NULL,
                               outcomes),
              "rollouts");
  for (int e = 0; e < ENVIRONMENTS; e++) {
    const double stretch = stretch_of(body, lane->recordings + e, frames, &cell->wrong);
    const int32_t step = outcomes[e].diverged_step;
    cell->wrong +=
        check_outcome(outcomes + e) + count_wrong(lane->recordings[e].com_m, 3 * (size_t)frames);
    cell->n[step > 0 ? DIVERGED : stretch > BLOWN_UP ? BLEW_UP : STAYS]++;
    if (step == 0)
      cell->stretch = fmax(cell->stretch, stretch);
    else if (cell->first == 0 || step < cell->first)
      cell->first = step;
  }
}

static void differentiate(const struct runner *runner, struct lane *lane,
                          const struct mo_environment *environments, struct cell *cell)
{
  struct mo_robot robots[ROBOTS];
  struct mo_outcome outcomes[ROBOTS];
  struct mo_gradient_counts counts = {0};
  struct mo_physics physics = cell->physics;
  const struct mo_gradient_options options = mo_default_gradient_options();
  physics.scheme.n_steps = GRADIENT_STEPS;
  for (int i = 0; i < ROBOTS; i++)
    robots[i] = (struct mo_robot){.body = runner->body[i / ENVIRONMENTS],
                                  .environment = environments + i % ENVIRONMENTS};
  bench_check(mo_gradient_block(lane->gradient_memory, lane->gradient, robots, ROBOTS, &physics,
                                &options, NULL, outcomes, lane->d_parameters, &counts),
              "gradient");
  for (int i = 0; i < ROBOTS; i++)
    cell->wrong += check_outcome(outcomes + i);
  for (size_t i = 0; i < lane->n_parameters; i++)
    cell->wrong += !isfinite(lane->d_parameters[i]);
  cell->wrong += !isfinite(counts.largest);
  cell->zeroed = (uint32_t)counts.zeroed_robots;
}

static void run_cell(const struct runner *runner, struct lane *lane, struct cell *cell)
{
  struct mo_environment environments[ENVIRONMENTS];
  memcpy(environments, runner->environments, sizeof(environments));
  for (int e = 0; e < ENVIRONMENTS; e++) {
    for (int k = 0; k < MO_TERRAIN_HEIGHTS; k++)
      environments[e].terrain_heights_m[k] *= cell->roughness;
    for (int axis = 0; axis < 2 && cell->is_rim; axis++)
      environments[e].light_xy_m[axis] = (e >> axis & 1) != 0 ? MO_TERRAIN_SIZE_M : 0;
  }
  for (int b = 0; b < BODIES; b++)
    run_body(lane, runner->body[b], environments, cell);
  if (!cell->is_passive)
    differentiate(runner, lane, environments, cell);
}

static void create_lane(const struct runner *runner, struct lane *lane)
{
  const struct mo_controller *controller = runner->scene.controller;
  const enum mo_isa isa = runner->options->isa;
  *lane = (struct lane){.n_parameters = controller->n_parameters};
  bench_check(mo_pack_create(NULL, isa, MO_FLOAT32, &lane->packs[0]), "pack");
  bench_check(mo_pack_create(controller, isa, MO_FLOAT32, &lane->packs[1]), "pack");
  bench_check(mo_pack_create_for_gradients(controller, isa, &lane->gradient), "pack");
  bench_check(mo_workspace_memory_create(&lane->memory), "memory");
  bench_check(mo_gradient_memory_create(MO_GRADIENT_DEFAULT_BYTES, &lane->gradient_memory),
              "memory");
  for (int e = 0; e < ENVIRONMENTS; e++)
    bench_check(mo_recording_create(lane->recordings + e, MO_RECORD_COM | MO_RECORD_MASSES, 1,
                                    STEPS_MAX + 1, MO_DEFAULT_MASSES, 0),
                "recordings");
  lane->d_parameters = bench_zeros(lane->n_parameters, sizeof(float));
}

static void run_cells(void *context, size_t first, size_t end)
{
  struct runner *runner = context;
  struct lane lane;
  (void)first;
  (void)end;
  create_lane(runner, &lane);
  for (uint32_t i; i = atomic_fetch_add(&runner->next, 1), i < CELLS;)
    if (runner->cells[i].is_run)
      run_cell(runner, &lane, runner->cells + i);
}

static void write_cell(const struct cell *cell)
{
  const struct mo_physics *physics = &cell->physics;
  printf("%s,%s,%s,%g,%g,%u,%u,%u,%.3f,%d,%u,%u,%.4f\n",
         mo_integrator_words[physics->scheme.integrator], period_names[cell->period],
         rows[cell->row].name, 1e3 * physics->scheme.dt_s, physics->constants.stiffness_n_per_m,
         cell->n[STAYS], cell->n[BLEW_UP], cell->n[DIVERGED], cell->stretch, cell->first,
         cell->zeroed, cell->wrong, 1e3 * mo_stable_step_s(physics, MO_EIGENVALUE_MAX));
}

/* Prints a line of the map: the worst fate in each cell (b: a spring was stretched to twice its
 * rest length; D: diverged), and the share of the robots that have it. A bar marks the linear bound
 * of all bodies. */
static void print_row(const struct cell *cells)
{
  bool is_beyond = false;
  fprintf(stderr, "%-15s", rows[cells->row].name);
  for (int t = 0; t < TIMES; t++) {
    const struct cell *cell = cells + t;
    const bool bar =
        cell->physics.scheme.dt_s > mo_stable_step_s(&cell->physics, MO_EIGENVALUE_MAX);
    const enum fate fate = cell->n[DIVERGED] > 0  ? DIVERGED
                           : cell->n[BLEW_UP] > 0 ? BLEW_UP
                                                  : STAYS;
    char text[16] = "-";
    if (cell->is_run && fate == STAYS)
      memcpy(text, "stays", sizeof("stays"));
    else if (cell->is_run)
      snprintf(text, sizeof(text), "%s%.0f%%", fate_marks[fate], 100.0 * cell->n[fate] / ROBOTS);
    fprintf(stderr, "%c%6s", bar && !is_beyond ? '|' : ' ', text);
    is_beyond = bar;
  }
  fprintf(stderr, "\n");
}

static void print_map(const struct cell *cells)
{
  fprintf(stderr, "\n%s, outputs every %s; time steps in ms:\n%15s",
          mo_integrator_words[cells->physics.scheme.integrator], period_names[cells->period], "");
  for (int t = 0; t < TIMES; t++)
    fprintf(stderr, " %6g", 1e3 * times_s[t]);
  fprintf(stderr, "\n");
  for (int row = 0; row < ROWS; row++)
    if (row < FEW_ROWS || cells->period < PERIODS - 1)
      print_row(cells + (size_t)row * TIMES);
}

/* Returns how many numbers are not finite. */
static uint32_t draw_map(struct runner *runner)
{
  uint32_t wrong = 0, n = 0, zeroed = 0;
  const uint32_t threads =
      runner->options->workers > 0 ? runner->options->workers : mo_processors();
  runner->cells = bench_zeros(CELLS, sizeof(*runner->cells));
  for (uint32_t i = 0; i < CELLS; i++)
    runner->cells[i] = cell_at(i);
  mo_parallel(threads, threads, run_cells, runner);
  printf("integrator,period,row,dt_ms,stiffness_n_per_m,stays,blew_up,diverged,largest_stretch,"
         "first_diverged_step,zeroed_gradients,not_finite,linear_bound_ms\n");
  for (uint32_t i = 0; i < CELLS; i++) {
    const struct cell *cell = runner->cells + i;
    if (i % (TIMES * ROWS) == 0)
      print_map(cell);
    if (!cell->is_run)
      continue;
    write_cell(cell);
    wrong += cell->wrong;
    zeroed += cell->zeroed;
    n++;
  }
  fprintf(stderr,
          "\n%u cells, %u robots each: %u numbers that should be finite are not; %u gradients of "
          "robots were left out because they were not finite\n",
          n, (unsigned)ROBOTS, wrong, zeroed);
  return wrong;
}

/* ---- borders ---- */

enum { BORDER_BODIES = 3, BORDER_TIMES = 5, MODES = 4, HALVINGS = 8 };
static const char *const mode_names[MODES] = {"passive", "moved, 1 step", "moved, 4 steps",
                                              "moved, 16 ms"};
static const double border_times_s[BORDER_TIMES] = {5e-4, 1e-3, 2e-3, 4e-3, 8e-3};

/* The largest eigenvalue of Σ d dᵀ over the springs, d the unit vector along each at rest: power
 * method on a start without symmetry. */
static double largest_eigenvalue(const struct mo_body *body)
{
  const uint32_t n = 3 * body->n_masses;
  double *x = bench_zeros(n, sizeof(*x)), *y = bench_zeros(n, sizeof(*y)), value = 0;
  struct mo_random random;
  mo_random_init(&random, 1, MO_PURPOSE_CHECK, 0, 0);
  for (uint32_t i = 0; i < n; i++)
    x[i] = mo_random_normal(&random);
  for (int step = 0; step < 5000; step++) {
    double norm = 0;
    for (uint32_t i = 0; i < n; i++)
      norm += x[i] * x[i];
    norm = sqrt(norm);
    memset(y, 0, n * sizeof(*y));
    value = 0;
    for (uint32_t s = 0; s < body->n_springs; s++) {
      const uint32_t a = 3 * body->spring_a[s], b = 3 * body->spring_b[s];
      double d[3], length = 0, stretch = 0;
      for (uint32_t i = 0; i < 3; i++) {
        d[i] = (double)body->mass_xyz[b + i] - (double)body->mass_xyz[a + i];
        length += d[i] * d[i];
      }
      for (uint32_t i = 0; i < 3; i++)
        stretch += d[i] / sqrt(length) * (x[b + i] - x[a + i]) / norm;
      for (uint32_t i = 0; i < 3; i++) {
        y[b + i] += stretch * d[i] / sqrt(length);
        y[a + i] -= stretch * d[i] / sqrt(length);
      }
      value += stretch * stretch;
    }
    memcpy(x, y, n * sizeof(*x));
  }
  free(x);
  free(y);
  return value;
}

static struct mo_physics border_physics(enum mo_integrator integrator, int mode, int time)
{
  struct mo_physics physics = mo_paper_physics();
  physics.scheme.integrator = integrator;
  physics.scheme.dt_s = border_times_s[time];
  if (mode > 0)
    physics.scheme.control_period_s = period_s((uint32_t)mode - 1, border_times_s[time]);
  return physics;
}

/* 2 (1 + keep) m/(push dt² λ) */
static double bound_n_per_m(const struct mo_physics *physics, double eigenvalue)
{
  const struct mo_constants *constants = &physics->constants;
  const double dt_s = physics->scheme.dt_s;
  const struct mo_kick kick =
      mo_kick_of(&physics->scheme, constants, exp(-constants->drag_per_s * dt_s));
  return 2 * (1 + kick.keep) * constants->mass_kg / (kick.push * dt_s * dt_s * eigenvalue);
}

/* Bisects the borders of all time steps together, and prints their range. */
static void find_borders(const struct runner *runner, struct mo_compute *compute,
                         struct mo_compute_controller *controller, const struct mo_body *body,
                         double eigenvalue, enum mo_integrator integrator, int mode)
{
  struct mo_block blocks[BORDER_TIMES];
  double low[BORDER_TIMES], high[BORDER_TIMES], least = INFINITY, most = 0;
  for (int t = 0; t < BORDER_TIMES; t++) {
    const struct mo_physics physics = border_physics(integrator, mode, t);
    low[t] = 0.25 * bound_n_per_m(&physics, eigenvalue);
    high[t] = 4 * bound_n_per_m(&physics, eigenvalue);
  }
  for (int halving = 0; halving < HALVINGS; halving++) {
    for (int t = 0; t < BORDER_TIMES; t++) {
      blocks[t] = (struct mo_block){.body = body,
                                    .controller = controller,
                                    .n_environments = MO_PAPER_TEST_COUNT,
                                    .physics = border_physics(integrator, mode, t)};
      blocks[t].physics.constants.stiffness_n_per_m = sqrt(low[t] * high[t]);
      memcpy(blocks[t].environments, runner->scene.list, sizeof(blocks[t].environments));
    }
    bench_check(mo_compute_run(compute, blocks, BORDER_TIMES), "rollouts");
    for (int t = 0; t < BORDER_TIMES; t++) {
      bool diverged = false;
      for (int e = 0; e < MO_PAPER_TEST_COUNT; e++)
        diverged = diverged || blocks[t].outcomes[e].diverged_step > 0;
      *(diverged ? &high[t] : &low[t]) = sqrt(low[t] * high[t]);
    }
  }
  for (int t = 0; t < BORDER_TIMES; t++) {
    const struct mo_physics physics = border_physics(integrator, mode, t);
    const double ratio = sqrt(low[t] * high[t]) / bound_n_per_m(&physics, eigenvalue);
    least = fmin(least, ratio);
    most = fmax(most, ratio);
  }
  fprintf(stderr, "  %s, %s: %.2f to %.2f\n", mo_integrator_words[integrator], mode_names[mode],
          least, most);
}

static void print_borders(const struct runner *runner)
{
  static const char *const names[BORDER_BODIES] = {"one voxel", "full lattice", "random body"};
  struct mo_compute *compute = bench_compute(runner->options->workers, runner->options->isa);
  struct mo_compute_controller *controllers[2];
  bench_check(mo_compute_controller_create(compute, NULL, &controllers[0]), "controller");
  bench_check(mo_compute_controller_create(compute, runner->scene.controller, &controllers[1]),
              "controller");
  for (int b = 0; b < BORDER_BODIES; b++) {
    const struct mo_body *body = runner->body[b];
    const double eigenvalue = largest_eigenvalue(body);
    const struct mo_physics physics = mo_paper_physics();
    fprintf(stderr,
            "\n%s, %u voxels: eigenvalue %.3f, largest stable step of the defaults %.2f ms; "
            "stiffness of the border/linear bound, for steps of 0.5 to 8 ms:\n",
            names[b], body->n_voxels, eigenvalue, 1e3 * mo_stable_step_s(&physics, eigenvalue));
    for (int i = 0; i < INTEGRATORS; i++)
      for (int mode = 0; mode < MODES; mode++)
        find_borders(runner, compute, controllers[mode > 0], body, eigenvalue,
                     (enum mo_integrator)i, mode);
  }
}

static struct mo_body *random_body(const struct bench_scene *scene, uint64_t seed, uint32_t voxels)
{
  struct mo_body_stream *stream = NULL;
  struct mo_body *body = NULL;
  uint64_t bits[MO_DEFAULT_WORDS];
  bench_check(mo_body_stream_create(MO_DEFAULT_WORKSPACE, seed, &stream), "body stream");
  do
    bench_check(mo_body_stream_next(stream, bits, NULL), "body stream");
  while (mo_genotype_count(MO_DEFAULT_WORKSPACE, bits) != voxels);
  bench_check(mo_body_create(scene->lattice, bits, &body), "body");
  mo_body_stream_free(stream);
  return body;
}

int bench_stability(const struct bench_options *options)
{
  static struct runner runner;
  runner.options = options;
  bench_scene_create(&runner.scene, options, RANDOM_BODIES);
  runner.body[0] = bench_box(&runner.scene, 1, 1, 1);
  runner.body[1] = bench_box(&runner.scene, 6, 6, 4);
  runner.body[2] = random_body(&runner.scene, options->seed, 23);
  for (int b = 0; b < RANDOM_BODIES; b++)
    runner.body[3 + b] = runner.scene.bodies[b];
  memcpy(runner.environments, runner.scene.training, sizeof(runner.environments));
  print_borders(&runner);
  return draw_map(&runner) > 0;
}
