/* cuda.c: compares the rollouts of a module that computes on GPUs with float64, and measures their
 * times.
 *
 * cuda-bench MODULE check [FILE]
 *     agreement, bits, control periods, guides and objectives, profiles, damage, measures,
 *     divergence, cancelling; FILE keeps the float64 losses of rollouts without control periods
 * cuda-bench MODULE time
 *     8192 bodies × 10 environments, also with control periods, with tasks, profiles and damage,
 *     measured, evolved bodies, smaller batches
 * cuda-bench MODULE accuracy
 *     CSV: time per rollout of each integrator, control period and time step of `tools/bench
 *     accuracy`, which has the errors
 * cuda-bench MODULE spread
 *     8192 bodies × 10 environments on all devices, and in parts on one
 * cuda-bench MODULE short
 *     a few steps of everything, for compute-sanitizer
 *
 * Prints one line per measurement; exit status 1 if a bound is missed, 77 without a device. Run it
 * from the top of the source tree. */
#include "cuda.h"
#include "../tests/unit/rollout/task-cases.h"

#include <dlfcn.h>
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { REPEATS = 3 };

const struct mo_device_module *module;
struct mo_device *device;
struct golden golden;

static const char *error_of_module(void)
{
  return device != NULL ? module->error(device) : "no device";
}

/* ---- scenes ---- */

struct mo_body *body_of(const uint64_t *bits)
{
  struct mo_body *body = NULL;
  must(mo_body_create(golden.lattice, bits, &body), "body");
  return body;
}

/* Makes a population as it looks after some time: descendants of a few bodies. */
static struct mo_body **evolved_bodies(uint32_t n)
{
  enum { FOUNDERS = 24 };
  uint64_t founder[FOUNDERS][MO_DEFAULT_WORDS];
  struct mo_body **bodies = must_have(calloc(n, sizeof(*bodies)));
  struct mo_random random;
  mo_random_init(&random, 7, MO_PURPOSE_CHECK, 0, 0);
  for (int f = 0; f < FOUNDERS; f++)
    do
      must(mo_genotype_random(MO_DEFAULT_WORKSPACE, &random, founder[f]), "founder");
    while (mo_genotype_count(MO_DEFAULT_WORKSPACE, founder[f]) < 30);
  for (uint32_t i = 0; i < n; i++) {
    uint64_t bits[MO_DEFAULT_WORDS], child[MO_DEFAULT_WORDS];
    memcpy(bits, founder[i % FOUNDERS], sizeof(bits));
    for (uint32_t generation = 0; generation < 1 + i % 8; generation++)
      if (mo_genotype_mutate(MO_DEFAULT_WORKSPACE, bits, 1.0 / 144.0, &random, child) == MO_OK)
        memcpy(bits, child, sizeof(bits));
    bodies[i] = body_of(bits);
  }
  return bodies;
}

struct rows *make_rows(struct mo_body *const *bodies, uint32_t n_bodies, uint32_t each)
{
  struct rows *rows = must_have(calloc(1, sizeof(*rows)));
  rows->n = n_bodies * each;
  rows->robots = must_have(calloc(rows->n, sizeof(*rows->robots)));
  rows->outcomes = must_have(calloc(rows->n, sizeof(*rows->outcomes)));
  mo_environment_paper_test(rows->environments);
  for (uint32_t i = 0; i < rows->n; i++)
    rows->robots[i] =
        (struct mo_robot){bodies[i / each], rows->environments + i % MO_PAPER_TEST_COUNT};
  return rows;
}

void free_rows(struct rows *rows)
{
  free(rows->outcomes);
  free(rows->robots);
  free(rows);
}

struct mo_device_score run_measured(struct mo_device_controller *controller,
                                    const struct mo_robot *robots, uint32_t n,
                                    const struct mo_physics *physics, struct mo_outcome *outcomes,
                                    double (*measures)[MO_MEASURES])
{
  struct mo_device_score score = {.controller = controller,
                                  .robots = robots,
                                  .n = n,
                                  .physics = *physics,
                                  .outcomes = outcomes,
                                  .measures = measures};
  memset(outcomes, 0x7f, n * sizeof(*outcomes));
  must(module->score(device, &score), "score");
  return score;
}

struct mo_device_score run(struct mo_device_controller *controller, const struct mo_robot *robots,
                           uint32_t n, const struct mo_physics *physics,
                           struct mo_outcome *outcomes)
{
  return run_measured(controller, robots, n, physics, outcomes, NULL);
}

struct mo_physics physics_with(enum mo_integrator integrator, uint32_t control_steps)
{
  struct mo_physics physics = mo_paper_physics();
  physics.scheme.integrator = integrator;
  if (control_steps > 0)
    physics.scheme.control_period_s = control_steps * physics.scheme.dt_s;
  return physics;
}

struct mo_physics physics_with_period(uint32_t control_steps)
{
  return physics_with(MO_INTEGRATOR_PAPER, control_steps);
}

/* ---- time ---- */

/* Returns a hash of all outcomes: versions that compute the same bits have the same hash. */
static uint64_t hash_of(const struct mo_outcome *outcomes, uint32_t n)
{
  uint64_t hash = UINT64_C(14695981039346656037);
  for (uint32_t i = 0; i < n; i++) {
    uint64_t words[7];
    memcpy(words, outcomes[i].com_start_m, sizeof(outcomes[i].com_start_m));
    memcpy(words + 3, outcomes[i].com_end_m, sizeof(outcomes[i].com_end_m));
    words[6] = (uint64_t)outcomes[i].diverged_step;
    for (int k = 0; k < 7; k++) {
      hash = (hash ^ words[k]) * UINT64_C(1099511628211);
      hash ^= hash >> 29;
    }
  }
  return hash;
}

static void time_some(struct mo_device_controller *controller, const char *what,
                      const struct mo_physics *physics, struct mo_body **bodies, uint32_t n_bodies,
                      uint32_t each, double bound_s, int has_tasks, int has_more, int is_measured)
{
  struct rows *rows = make_rows(bodies, n_bodies, each);
  for (uint32_t e = 0; has_tasks && e < MO_PAPER_TEST_COUNT; e++)
    rows->environments[e].task = task_case(e + (e > 4)); /* every guide and objective */
  for (uint32_t e = 0; has_more && e < MO_PAPER_TEST_COUNT; e++) {
    rows->environments[e].n_profile = MO_TERRAIN_HEIGHTS; /* the heights one after the other */
    rows->environments[e].profile_spacing_m = 0.2;
    rows->environments[e].damage = (struct mo_damage){1 + e % MO_OCTANTS, 2};
  }
  double wall[REPEATS], device_s[REPEATS], host_s[REPEATS], masses = 0, springs = 0, mean = 0;
  double(*measures)[MO_MEASURES] =
      is_measured ? must_have(calloc(rows->n, sizeof(*measures))) : NULL;
  for (uint32_t b = 0; b < n_bodies; b++) {
    masses += (double)bodies[b]->n_masses / n_bodies;
    springs += (double)bodies[b]->n_springs / n_bodies;
  }
  run_measured(controller, rows->robots, rows->n, physics, rows->outcomes, measures);
  for (int i = 0; i < REPEATS; i++) {
    const double start = now_s();
    const struct mo_device_score score =
        run_measured(controller, rows->robots, rows->n, physics, rows->outcomes, measures);
    wall[i] = now_s() - start;
    device_s[i] = score.device_s;
    host_s[i] = score.host_s;
  }
  for (uint32_t i = 0; i < rows->n; i++)
    mean += rows->outcomes[i].loss / rows->n;
  const double median = quantile(device_s, REPEATS, 0.5), together = quantile(wall, REPEATS, 0.5);
  printf("%s, %u x %u, %.1f masses, %.1f springs: device %.4f s (%.4f to %.4f), host %.4f s, "
         "together %.4f s; mean loss %.5f, bits %016llx\n",
         what, n_bodies, each, masses, springs, median, device_s[0], device_s[REPEATS - 1],
         quantile(host_s, REPEATS, 0.5), together, mean,
         (unsigned long long)hash_of(rows->outcomes, rows->n));
  if (bound_s > 0)
    expect(together <= bound_s, "%s", what);
  free(measures);
  free_rows(rows);
}

static void time_rows(struct mo_device_controller *controller, const char *what,
                      const struct mo_physics *physics, struct mo_body **bodies, uint32_t n_bodies,
                      uint32_t each, double bound_s)
{
  time_some(controller, what, physics, bodies, n_bodies, each, bound_s, 0, 0, 0);
}

static void time_all(struct mo_device_controller *controller)
{
  enum { N = 8192 };
  struct mo_body **bodies = random_bodies(golden.lattice, N, 1), **evolved = evolved_bodies(N);
  const struct mo_physics physics = mo_paper_physics(), held = physics_with_period(4);
  struct mo_physics fine = held; /* half the step, the same periods */
  fine.scheme.dt_s /= 2;
  fine.scheme.n_steps *= 2;
  struct mo_physics split = fine;
  split.scheme.integrator = MO_INTEGRATOR_SPLIT;
  struct mo_physics quick = held;
  quick.scheme.integrator = MO_INTEGRATOR_SPLIT;
  time_rows(controller, "random bodies", &physics, bodies, N, 10, 1.0);
  time_rows(controller, "random bodies, period 16 ms", &held, bodies, N, 10, 0);
  time_rows(controller, "random bodies, period 16 ms, dt 2 ms, 2000 steps", &fine, bodies, N, 10,
            0);
  time_rows(controller, "random bodies, split, period 16 ms, dt 2 ms, 2000 steps", &split, bodies,
            N, 10, 0);
  time_some(controller, "random bodies with tasks, split, period 16 ms, dt 2 ms, 2000 steps",
            &split, bodies, N, 10, 0, 1, 0, 0);
  time_some(controller, "the same with profiles and damage", &split, bodies, N, 10, 0, 1, 1, 0);
  time_some(controller, "random bodies, measured, split, period 16 ms, dt 2 ms, 2000 steps", &split,
            bodies, N, 10, 0, 0, 0, 1);
  time_some(controller,
            "random bodies with tasks, measured, split, period 16 ms, dt 2 ms, 2000 "
            "steps",
            &split, bodies, N, 10, 0, 1, 0, 1);
  time_some(controller, "random bodies, measured, every step", &physics, bodies, N, 10, 0, 0, 0, 1);
  time_rows(controller, "random bodies, split, period 16 ms, dt 4 ms", &quick, bodies, N, 10, 0);
  time_rows(controller, "evolved bodies", &physics, evolved, N, 10, 1.0);
  time_rows(controller, "random bodies", &physics, bodies, N, 1, 0);
  time_rows(controller, "random bodies", &physics, bodies, 1024, 1, 0);
  time_rows(controller, "random bodies", &physics, bodies, 102, 10, 0);
  free_bodies(evolved, N);
  free_bodies(bodies, N);
}

/* Like time_all, but for the settings of accuracy.c. */
static void time_settings(struct mo_device_controller *controller)
{
  enum { N = 8192, TIMED = 2, INTEGRATORS = 2, PERIODS = 3, DTS = 4 };
  static const double periods_s[PERIODS] = {0.004, 0.008, 0.016};
  static const double dts_s[DTS] = {0.004, 0.002, 0.001, 0.0005};
  static const char *const names[INTEGRATORS] = {"paper", "split"};
  struct mo_body **bodies = random_bodies(golden.lattice, N, 1);
  struct rows *rows = make_rows(bodies, N, MO_PAPER_TEST_COUNT);
  printf("integrator,period_ms,dt_ms,rollouts,time_ms_per_rollout,mean_loss\n");
  for (int i = 0; i < INTEGRATORS * PERIODS * DTS; i++) {
    struct mo_physics physics = mo_paper_physics();
    struct mo_scheme *scheme = &physics.scheme;
    scheme->dt_s = dts_s[i % DTS];
    scheme->control_period_s = periods_s[i / DTS % PERIODS];
    scheme->integrator = (enum mo_integrator)(i / DTS / PERIODS);
    scheme->n_steps = (uint32_t)lround(4 / scheme->dt_s);
    double best_s = INFINITY, mean = 0;
    for (int k = 0; k < TIMED; k++)
      best_s =
          fmin(best_s, run(controller, rows->robots, rows->n, &physics, rows->outcomes).device_s);
    for (uint32_t r = 0; r < rows->n; r++)
      mean += rows->outcomes[r].loss / rows->n;
    printf("%s,%g,%g,%u,%.6f,%.5f\n", names[scheme->integrator], 1e3 * scheme->control_period_s,
           1e3 * scheme->dt_s, rows->n, 1e3 * best_s / rows->n, mean);
  }
  free_rows(rows);
  free_bodies(bodies, N);
}

/* ---- several devices ---- */

enum { PARTS_MAX = 8 };

/* A device's share of the rows, split as by the daemon. */
struct part {
  pthread_t thread;
  struct mo_device *device;
  struct mo_device_score score;
  double took_s;
  int status;
};

static void *score_part(void *context)
{
  struct part *part = context;
  const double start = now_s();
  part->status = module->score(part->device, &part->score);
  part->took_s = now_s() - start;
  return NULL;
}

/* Runs the parts on separate devices at the same time, or one after the other on the first. Returns
 * the time of the longest; the best of three. */
static double time_parts(struct mo_device *const *devices,
                         struct mo_device_controller *const *controllers, struct rows *rows,
                         uint32_t n_parts, int at_once)
{
  double best = INFINITY;
  for (int repeat = -1; repeat < REPEATS; repeat++) { /* the first warms up */
    struct part parts[PARTS_MAX];
    double longest = 0;
    for (uint32_t i = 0; i < n_parts; i++) {
      const uint32_t first = (uint32_t)((uint64_t)rows->n * i / n_parts),
                     end = (uint32_t)((uint64_t)rows->n * (i + 1) / n_parts);
      parts[i] = (struct part){.device = devices[at_once ? i : 0],
                               .score = {.controller = controllers[at_once ? i : 0],
                                         .robots = rows->robots + first,
                                         .n = end - first,
                                         .physics = mo_paper_physics(),
                                         .outcomes = rows->outcomes + first}};
      if (!at_once)
        score_part(&parts[i]);
      else
        must(pthread_create(&parts[i].thread, NULL, score_part, &parts[i]) == 0 ? MO_OK
                                                                                : MO_ERR_NO_MEMORY,
             "thread");
    }
    for (uint32_t i = 0; i < n_parts; i++) {
      if (at_once)
        pthread_join(parts[i].thread, NULL);
      must(parts[i].status, "score of a part");
      longest = fmax(longest, parts[i].took_s);
    }
    if (repeat >= 0)
      best = fmin(best, longest);
  }
  return best;
}

static void spread(uint32_t n_devices)
{
  enum { N = 8192 };
  struct mo_device *devices[PARTS_MAX] = {device};
  struct mo_device_controller *controllers[PARTS_MAX] = {NULL};
  struct mo_body **bodies = random_bodies(golden.lattice, N, 1);
  struct rows *rows = make_rows(bodies, N, MO_PAPER_TEST_COUNT);
  n_devices = n_devices < PARTS_MAX ? n_devices : PARTS_MAX;
  for (uint32_t i = 0; i < n_devices; i++) {
    if (i > 0)
      must(module->open(i, &devices[i]), "open");
    must(module->controller_create(devices[i], golden.controller, &controllers[i]), "controller");
  }
  const double alone = time_parts(devices, controllers, rows, 1, 1);
  const uint64_t bits = hash_of(rows->outcomes, rows->n);
  printf("random bodies, %d x %d, host and device: %.4f s\n", N, MO_PAPER_TEST_COUNT, alone);
  for (uint32_t n = 2; n <= PARTS_MAX; n *= 2) {
    const int at_once = n <= n_devices;
    const double longest = time_parts(devices, controllers, rows, n, at_once);
    expect(hash_of(rows->outcomes, rows->n) == bits,
           "the same bits; %s of %u parts: %.4f s, 1 / %.2f of the whole",
           at_once ? "on as many devices at once, the longest"
                   : "one after the other on one device, the longest",
           n, longest, alone / longest);
  }
  for (uint32_t i = 0; i < n_devices; i++) {
    module->controller_free(devices[i], controllers[i]);
    if (i > 0)
      module->close(devices[i]);
  }
  free_rows(rows);
  free_bodies(bodies, N);
}

static void load(const char *path)
{
  const struct mo_device_module *(*entry)(void) = NULL;
  void *library = dlopen(path, RTLD_NOW | RTLD_LOCAL);
  if (library != NULL)
    *(void **)(void *)&entry = dlsym(library, "mo_device_module");
  if (entry == NULL || entry()->abi != MO_DEVICE_ABI) {
    fprintf(stderr, "cuda-bench: %s: %s\n", path,
            entry == NULL ? dlerror() : "it has another version");
    exit(1);
  }
  module = entry();
}

int main(int argc, char **argv)
{
  if (argc < 2) {
    fprintf(stderr,
            "usage: cuda-bench MODULE [check [REFERENCES] | time | accuracy | spread | short]\n");
    return 2;
  }
  const char *what = argc > 2 ? argv[2] : "check";
  load(argv[1]);
  device_error = error_of_module;
  uint32_t n = 0;
  must(module->count(&n), "count");
  if (n == 0) {
    printf("no device\n");
    return 77;
  }
  must(golden_load(&golden) == 0 ? MO_OK : MO_ERR_NOT_FOUND, "golden cases");
  must(module->open(0, &device), "open");
  struct mo_device_info info;
  must(module->info(device, &info), "info");
  printf("%s, %s, %u multiprocessors, capability %u\n", info.name, info.id, info.multiprocessors,
         info.capability);
  struct mo_device_controller *controller = NULL;
  must(module->controller_create(device, golden.controller, &controller), "controller");
  if (strcmp(what, "time") == 0) {
    time_all(controller);
  } else if (strcmp(what, "accuracy") == 0) {
    time_settings(controller);
  } else if (strcmp(what, "spread") == 0) {
    spread(n);
  } else if (strcmp(what, "short") == 0) {
    check_short(controller);
  } else {
    check_all(controller, argc > 3 ? argv[3] : NULL);
  }
  module->controller_free(device, controller);
  module->close(device);
  golden_free(&golden);
  return missed();
}
