/* stability.c: which time steps and stiffnesses a rollout survives, compared with the bound of the
 * linear theory.
 *
 * Linearized about rest, a mode of the springs' stiffness with eigenvalue λk follows q'' = (1 + e −
 * w) q' − e q from step to step, with e = exp(−drag dt) and w = dt² λ k/m; it decays if and only if
 * w < 2 (1 + e). λ is the largest eigenvalue of the body's springs, found here by the power method.
 * A point of the map is a body in the ten environments of the paper's test set for 1000 steps,
 * passive or moved by the trained controller. The border is found by bisection of the stiffness,
 * once per time step. */
#include "bench.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum {
  BODIES = 3,
  MODES = 2,
  TIMES = 21,
  STIFFNESSES = 31,
  CELLS = TIMES * STIFFNESSES,
  HALVINGS = 9,
  LOOKS = 80
};

static const char *const mode_names[MODES] = {"passive", "trained"};

struct map {
  const char *name;
  struct mo_body *body;
  double eigenvalue; /* of stiffness 1 */
  uint32_t diverged[MODES][CELLS];
  int32_t first_step[MODES][CELLS]; /* of the first divergence; 0: no divergence */
  double border[MODES][TIMES];      /* stiffness above which some environment diverges */
};

static double dt_s(int time)
{
  return 1e-3 * pow(10.0, time / (double)(TIMES - 1));
}

static double stiffness_n_per_m(int k)
{
  return 1e3 * pow(10.0, 3.0 * k / (STIFFNESSES - 1));
}

static struct mo_physics physics_of(double dt, double stiffness)
{
  struct mo_physics physics = mo_default_physics();
  physics.scheme.dt_s = dt;
  physics.constants.stiffness_n_per_m = stiffness;
  return physics;
}

/* 2 (1 + e) m/(dt² λ) */
static double linear_bound(const struct map *map, double dt)
{
  const struct mo_physics physics = mo_default_physics();
  return 2 * (1 + exp(-physics.constants.drag_per_s * dt)) * physics.constants.mass_kg /
         (dt * dt * map->eigenvalue);
}

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

struct runner {
  struct mo_compute *compute;
  struct mo_compute_controller *controller[MODES];
  const struct bench_scene *scene;
};

static void fill(const struct runner *runner, const struct mo_body *body, int mode,
                 struct mo_physics physics, struct mo_block *block)
{
  *block = (struct mo_block){.body = body,
                             .controller = runner->controller[mode],
                             .n_environments = MO_PAPER_TEST_COUNT,
                             .physics = physics};
  memcpy(block->environments, runner->scene->list, sizeof(block->environments));
}

static uint32_t count_diverged(const struct mo_block *block, int32_t *first)
{
  uint32_t diverged = 0;
  *first = 0;
  for (uint32_t e = 0; e < block->n_environments; e++)
    if (block->outcomes[e].diverged_step > 0) {
      diverged++;
      if (*first == 0 || block->outcomes[e].diverged_step < *first)
        *first = block->outcomes[e].diverged_step;
    }
  return diverged;
}

/* Computes all grid points at once, then the borders of all time steps by bisection. */
static void explore(const struct runner *runner, struct map *map, int mode)
{
  struct mo_block *blocks = bench_zeros(CELLS, sizeof(*blocks));
  double low[TIMES], high[TIMES];
  int32_t first;
  for (int c = 0; c < CELLS; c++)
    fill(runner, map->body, mode,
         physics_of(dt_s(c / STIFFNESSES), stiffness_n_per_m(c % STIFFNESSES)), blocks + c);
  bench_check(mo_compute_run(runner->compute, blocks, CELLS), "rollouts");
  for (int c = 0; c < CELLS; c++)
    map->diverged[mode][c] = count_diverged(blocks + c, &map->first_step[mode][c]);
  for (int t = 0; t < TIMES; t++) {
    low[t] = 0.25 * linear_bound(map, dt_s(t));
    high[t] = 4 * linear_bound(map, dt_s(t));
  }
  for (int halving = 0; halving < HALVINGS; halving++) {
    for (int t = 0; t < TIMES; t++)
      fill(runner, map->body, mode, physics_of(dt_s(t), sqrt(low[t] * high[t])), blocks + t);
    bench_check(mo_compute_run(runner->compute, blocks, TIMES), "rollouts");
    for (int t = 0; t < TIMES; t++)
      *(count_diverged(blocks + t, &first) > 0 ? &high[t] : &low[t]) = sqrt(low[t] * high[t]);
  }
  for (int t = 0; t < TIMES; t++)
    map->border[mode][t] = sqrt(low[t] * high[t]);
  free(blocks);
}

static void write_rows(const struct map *map, int mode)
{
  for (int c = 0; c < CELLS; c++) {
    const double dt = dt_s(c / STIFFNESSES), stiffness = stiffness_n_per_m(c % STIFFNESSES);
    printf("%s,%s,%.3f,%.0f,%u,%d,%.0f,%.0f\n", map->name, mode_names[mode], 1e3 * dt, stiffness,
           map->diverged[mode][c], map->first_step[mode][c], linear_bound(map, dt),
           map->border[mode][c / STIFFNESSES]);
  }
}

static void print_summary(const struct map *map, int mode)
{
  double least = INFINITY, most = 0;
  uint32_t wrong = 0;
  for (int t = 0; t < TIMES; t++) {
    const double ratio = map->border[mode][t] / linear_bound(map, dt_s(t));
    least = fmin(least, ratio);
    most = fmax(most, ratio);
  }
  for (int c = 0; c < CELLS; c++)
    wrong += (map->diverged[mode][c] > 0) !=
             (stiffness_n_per_m(c % STIFFNESSES) > linear_bound(map, dt_s(c / STIFFNESSES)));
  const struct mo_physics physics = mo_default_physics();
  double dt = 1e-3; /* linear bound of the time step at the default stiffness */
  for (int look = 0; look < LOOKS; look++)
    dt *= pow(linear_bound(map, dt) / physics.constants.stiffness_n_per_m, 0.25);
  fprintf(stderr,
          "%-11s %3u voxels, %-7s λ = %.3f k; at 15000 N/m dt < %.2f ms; border/bound %.2f to "
          "%.2f; %u of %d points on the other side of the bound\n",
          map->name, map->body->n_voxels, mode_names[mode], map->eigenvalue, 1e3 * dt, least, most,
          wrong, CELLS);
}

int bench_stability(const struct bench_options *options)
{
  static struct map maps[BODIES] = {
      {.name = "one voxel"}, {.name = "random body"}, {.name = "full"}};
  struct bench_scene scene;
  struct runner runner = {.scene = &scene};
  bench_scene_create(&scene, options, 0);
  runner.compute = bench_compute(options->workers, options->isa);
  bench_check(mo_compute_controller_create(runner.compute, NULL, &runner.controller[0]),
              "controller");
  bench_check(mo_compute_controller_create(runner.compute, scene.controller, &runner.controller[1]),
              "controller");
  maps[0].body = bench_box(&scene, 1, 1, 1);
  maps[1].body = random_body(&scene, options->seed, 23);
  maps[2].body = bench_box(&scene, 6, 6, 4);
  printf(
      "body,mode,dt_ms,stiffness_n_per_m,diverged_of_10,first_diverged_step,linear_bound_n_per_m,"
      "border_n_per_m\n");
  for (int b = 0; b < BODIES; b++) {
    maps[b].eigenvalue = largest_eigenvalue(maps[b].body);
    for (int mode = 0; mode < MODES; mode++) {
      explore(&runner, maps + b, mode);
      write_rows(maps + b, mode);
      print_summary(maps + b, mode);
    }
  }
  return 0;
}
