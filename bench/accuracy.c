/* accuracy.c: run time against error.
 *
 * Every combination of integrator, control period, precision, impact mode and time step simulates
 * the same 4 seconds. A digital controller makes the motion well defined while the time step goes
 * to 0, so each integrator and period has a limit of its own: the float64 `exact` rollout at 1/64
 * ms. The errors are the largest distance of the center of mass from it up to a time, and the
 * difference in loss. Contact makes rollouts chaotic: a rounding difference grows by orders of
 * magnitude per second. The path error is therefore also reported after 0.2 s and 1 s, where it
 * still separates the methods. The time step dominates everything else, so the last columns compare
 * with float64 `exact` at the same time step to show the effect of precision and impact mode. */
#include "bench.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define LIFE_S  4.0
#define FRAME_S 0.02

#define LIMIT_DT_S (0.001 / 64)

enum { INTEGRATORS = 2, PERIODS = 3, DTS = 4, MODES = 5, FRAMES = 201, TIMES = 3 };

static const char *const integrator_names[INTEGRATORS] = {"paper", "split"};
static const double periods_s[PERIODS] = {0.004, 0.008, 0.016};
/* Trained with outputs every 16 ms, and measured with them alone. */
static const char held_controller[] = "data/controllers/phototaxis-16ms.safetensors";
static const double dts_s[DTS] = {0.004, 0.002, 0.001, 0.0005};
/* All but the first two are measured with one integrator and period only. */
static const struct {
  const char *name;
  enum mo_impact impact;
  uint32_t bisections;
} modes[MODES] = {{"exact", MO_IMPACT_EXACT, 8},
                  {"bisection8", MO_IMPACT_BISECTION, 8},
                  {"bisection4", MO_IMPACT_BISECTION, 4},
                  {"bisection12", MO_IMPACT_BISECTION, 12},
                  {"bisection16", MO_IMPACT_BISECTION, 16}};
static const char *const precision_names[] = {"float32", "float64"};
static const int frame_ends[TIMES] = {10, 50, 200}; /* 0.2 s, 1 s, 4 s */

/* The rollouts of all bodies, each in one environment, in one configuration. */
struct rollouts {
  double (*com_m)[FRAMES][3];
  double *loss;
  uint8_t *diverged;
};

static void rollouts_create(struct rollouts *rollouts, uint32_t n)
{
  rollouts->com_m = bench_zeros(n, sizeof(*rollouts->com_m));
  rollouts->loss = bench_zeros(n, sizeof(*rollouts->loss));
  rollouts->diverged = bench_zeros(n, 1);
}

/* What is held while the time step, precision and impact mode vary. */
struct motion {
  enum mo_integrator integrator;
  double period_s;
};

static struct mo_physics physics_at(struct motion motion, double dt_s, int mode)
{
  struct mo_physics physics = mo_paper_physics();
  physics.scheme.integrator = motion.integrator;
  physics.scheme.control_period_s = motion.period_s;
  physics.scheme.dt_s = dt_s;
  physics.scheme.n_steps = (uint32_t)lround(LIFE_S / dt_s);
  physics.scheme.impact = modes[mode].impact;
  physics.scheme.bisections = modes[mode].bisections;
  return physics;
}

static void simulate(struct rollouts *rollouts, const struct bench_scene *scene,
                     struct mo_compute *compute, struct mo_compute_controller *controller,
                     struct motion motion, double dt_s, int mode, enum mo_precision precision)
{
  const uint32_t n = scene->n_bodies;
  struct mo_block *blocks = bench_zeros(n, sizeof(*blocks));
  struct mo_recording *recordings = bench_zeros(n, sizeof(*recordings));
  for (uint32_t i = 0; i < n; i++) {
    recordings[i] = (struct mo_recording){.stride = (uint32_t)lround(FRAME_S / dt_s),
                                          .com_m = rollouts->com_m[i][0]};
    blocks[i] = (struct mo_block){.body = scene->bodies[i],
                                  .controller = controller,
                                  .environments = {scene->list[i % MO_PAPER_TEST_COUNT]},
                                  .n_environments = 1,
                                  .physics = physics_at(motion, dt_s, mode),
                                  .precision = precision,
                                  .recordings = recordings + i};
  }
  bench_check(mo_compute_run(compute, blocks, n), "rollouts");
  for (uint32_t i = 0; i < n; i++) {
    rollouts->loss[i] = blocks[i].outcomes[0].loss;
    rollouts->diverged[i] = blocks[i].outcomes[0].diverged_step > 0;
  }
  free(recordings);
  free(blocks);
}

/* Returns milliseconds per rollout on one core, the best of three times. The whole test set of a
 * body runs at once, as in evaluations. */
static double time_ms(const struct bench_scene *scene, enum mo_isa isa, struct motion motion,
                      double dt_s, int mode, enum mo_precision precision)
{
  struct mo_pack *pack = NULL;
  struct mo_workspace_memory *memory = NULL;
  struct mo_outcome outcomes[MO_BLOCK_LANES];
  const struct mo_physics physics = physics_at(motion, dt_s, mode);
  const uint32_t n = scene->n_bodies < 5 ? scene->n_bodies : 5;
  bench_check(mo_pack_create(scene->controller, isa, precision, &pack), "pack");
  bench_check(mo_workspace_memory_create(&memory), "scratch");
  double ms = INFINITY;
  for (int repeat = 0; repeat < 3; repeat++) {
    const double start = bench_thread_s();
    for (uint32_t i = 0; i < n; i++)
      bench_check(mo_rollout_block(memory, pack, scene->bodies[i], scene->list, MO_PAPER_TEST_COUNT,
                                   &physics, NULL, NULL, NULL, outcomes),
                  "rollout");
    ms = fmin(ms, 1e3 * (bench_thread_s() - start) / (n * MO_PAPER_TEST_COUNT));
  }
  mo_workspace_memory_free(memory);
  mo_pack_free(pack);
  return ms;
}

/* Median, 90th percentile and maximum. The error of a rollout that diverged is infinite. */
struct spread {
  double median, p90, most;
};

static struct spread spread_of(double *errors, uint32_t n)
{
  return (struct spread){bench_median(errors, n), bench_quantile(errors, n, 0.9),
                         bench_quantile(errors, n, 1.0)};
}

struct row {
  double ms;
  struct spread path[TIMES], loss;          /* against the reference */
  struct spread same_dt_path, same_dt_loss; /* against float64 `exact` at the same time step; the
                                               path only in its first second */
  uint32_t diverged;
};

/* Returns the error of the center of mass up to frame `end`. */
static struct spread path_error(const struct rollouts *rollouts, const struct rollouts *truth,
                                uint32_t n, int end, double *errors)
{
  for (uint32_t i = 0; i < n; i++) {
    errors[i] = rollouts->diverged[i] || truth->diverged[i] ? INFINITY : 0;
    for (int f = 0; f <= end; f++) {
      const double *a = rollouts->com_m[i][f], *b = truth->com_m[i][f];
      errors[i] =
          fmax(errors[i], sqrt((a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1]) +
                               (a[2] - b[2]) * (a[2] - b[2])));
    }
  }
  return spread_of(errors, n);
}

static struct spread loss_error(const struct rollouts *rollouts, const struct rollouts *truth,
                                uint32_t n, double *errors)
{
  for (uint32_t i = 0; i < n; i++)
    errors[i] = rollouts->diverged[i] || truth->diverged[i]
                    ? INFINITY
                    : fabs(rollouts->loss[i] - truth->loss[i]);
  return spread_of(errors, n);
}

static void print_header(void)
{
  static const char *const kinds[] = {"median", "p90", "max"};
  printf("controller,integrator,period_ms,precision,impact,dt_ms,bodies,time_ms_per_rollout");
  for (int t = 0; t < TIMES; t++)
    for (int k = 0; k < 3; k++)
      printf(",path_error_m_%gs_%s", frame_ends[t] * FRAME_S, kinds[k]);
  for (int k = 0; k < 3; k++)
    printf(",loss_error_%s", kinds[k]);
  for (int k = 0; k < 3; k++)
    printf(",same_dt_path_error_m_1s_%s", kinds[k]);
  for (int k = 0; k < 3; k++)
    printf(",same_dt_loss_error_%s", kinds[k]);
  printf(",diverged\n");
}

static void print_spread(struct spread spread)
{
  printf(",%.3e,%.3e,%.3e", spread.median, spread.p90, spread.most);
}

static void print_row(const char *controller, struct motion motion, enum mo_precision precision,
                      int mode, double dt_s, uint32_t n, const struct row *row)
{
  printf("%s,%s,%g,%s,%s,%g,%u,%.4f", controller, integrator_names[motion.integrator],
         1e3 * motion.period_s, precision_names[precision], modes[mode].name, 1e3 * dt_s, n,
         row->ms);
  for (int t = 0; t < TIMES; t++)
    print_spread(row->path[t]);
  print_spread(row->loss);
  print_spread(row->same_dt_path);
  print_spread(row->same_dt_loss);
  printf(",%u\n", row->diverged);
  fflush(stdout);
}

struct bench {
  struct bench_scene scene;
  struct mo_compute *compute;
  struct mo_compute_controller *controller; /* the scene's */
  char name[64];                            /* its own */
  enum mo_isa isa;
  uint32_t n;
  struct rollouts limit, same_dt, rollouts;
  double *errors; /* (n) scratch */
};

/* All precisions and impact modes at one time step. */
static void measure(struct bench *b, struct motion motion, double dt_s, int n_modes)
{
  const uint32_t n = b->n;
  simulate(&b->same_dt, &b->scene, b->compute, b->controller, motion, dt_s, 0, MO_FLOAT64);
  for (int s = 0; s < 2 * n_modes; s++) {
    const enum mo_precision precision = s < n_modes ? MO_FLOAT32 : MO_FLOAT64;
    const int mode = s % n_modes;
    simulate(&b->rollouts, &b->scene, b->compute, b->controller, motion, dt_s, mode, precision);
    struct row row = {.ms = time_ms(&b->scene, b->isa, motion, dt_s, mode, precision)};
    for (int t = 0; t < TIMES; t++)
      row.path[t] = path_error(&b->rollouts, &b->limit, n, frame_ends[t], b->errors);
    row.loss = loss_error(&b->rollouts, &b->limit, n, b->errors);
    row.same_dt_path = path_error(&b->rollouts, &b->same_dt, n, frame_ends[1], b->errors);
    row.same_dt_loss = loss_error(&b->rollouts, &b->same_dt, n, b->errors);
    for (uint32_t i = 0; i < n; i++)
      row.diverged += b->rollouts.diverged[i];
    print_row(b->name, motion, precision, mode, dt_s, n, &row);
  }
}

/* Makes the rollouts that follow use this controller. */
static void use_controller(struct bench *b, const char *path)
{
  struct mo_message message = {"cannot be read"};
  const char *name = strrchr(path, '/') != NULL ? strrchr(path, '/') + 1 : path;
  snprintf(b->name, sizeof(b->name), "%.*s", (int)strcspn(name, ".,"), name);
  if (mo_controller_read(path, &b->scene.controller, &message) != MO_OK) {
    fprintf(stderr, "morpho-bench: %s: %s\n", path, message.text);
    exit(1);
  }
  bench_check(mo_compute_controller_create(b->compute, b->scene.controller, &b->controller),
              "controller");
}

/* All time steps of a motion. */
static void measure_motion(struct bench *b, struct motion motion, int n_modes)
{
  simulate(&b->limit, &b->scene, b->compute, b->controller, motion, LIMIT_DT_S, 0, MO_FLOAT64);
  for (int d = 0; d < DTS; d++)
    measure(b, motion, dts_s[d], n_modes);
  fprintf(stderr, "%s, %s, outputs every %g ms: done\n", b->name,
          integrator_names[motion.integrator], 1e3 * motion.period_s);
}

int bench_accuracy(const struct bench_options *options)
{
  struct bench b = {.isa = options->isa,
                    .n = options->bodies > 0 ? options->bodies
                         : options->quick    ? 10
                                             : 100};
  bench_scene_create(&b.scene, options, b.n);
  rollouts_create(&b.limit, b.n);
  rollouts_create(&b.same_dt, b.n);
  rollouts_create(&b.rollouts, b.n);
  b.errors = bench_zeros(b.n, sizeof(*b.errors));
  b.compute = bench_compute(options->workers, options->isa);
  print_header();
  use_controller(&b, options->controller);
  for (int i = 0; i < INTEGRATORS; i++)
    for (int p = 0; p < PERIODS; p++)
      measure_motion(&b, (struct motion){(enum mo_integrator)i, periods_s[p]},
                     i == 0 && p == 0 ? MODES : 2);
  use_controller(&b, held_controller);
  for (int i = 0; i < INTEGRATORS; i++)
    measure_motion(&b, (struct motion){(enum mo_integrator)i, periods_s[PERIODS - 1]}, 2);
  return 0;
}
