/* cuda.c: compares the rollouts of a module that computes on GPUs with float64, and measures their
 * times.
 *
 * cuda-bench MODULE check [FILE]
 *     agreement, bits, divergence, cancelling; FILE keeps the float64 losses
 * cuda-bench MODULE time
 *     8192 bodies × 10 environments, evolved bodies, smaller batches
 * cuda-bench MODULE spread
 *     8192 bodies × 10 environments over all devices, and in parts on one
 * cuda-bench MODULE short
 *     a few steps of everything, for compute-sanitizer
 *
 * Prints one line per measurement; exit status 1 if a bound is missed, 77 without a device. Run it
 * from the top of the source tree. */
#include "../tests/unit/rollout/golden.h"

#include "compute/device.h"

#include <dlfcn.h>
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { RANDOM = 1000, THREADS_MAX = 32, REPEATS = 3 };

static const struct mo_device_module *module;
static struct mo_device *device;
static struct golden golden;
static int missed;

static double now_s(void)
{
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static void must(int status, const char *what)
{
  if (status == MO_OK)
    return;
  fprintf(stderr, "cuda-bench: %s: %s (%s)\n", what, mo_error_text(status),
          device != NULL ? module->error(device) : "no device");
  exit(1);
}

static void expect(int held, const char *what)
{
  printf("%s: %s\n", held ? "ok" : "MISSED", what);
  missed |= !held;
}

static int ascending(const void *a, const void *b)
{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

/* ---- scenes ---- */

static struct mo_body *body_of(const uint64_t *bits)
{
  struct mo_body *body = NULL;
  must(mo_body_create(golden.lattice, bits, &body), "body");
  return body;
}

static struct mo_body **random_bodies(uint32_t n, uint64_t seed)
{
  struct mo_body_stream *stream = NULL;
  struct mo_body **bodies = calloc(n, sizeof(*bodies));
  must(bodies == NULL ? MO_ERR_NO_MEMORY
                      : mo_body_stream_create(MO_DEFAULT_WORKSPACE, seed, &stream),
       "bodies");
  for (uint32_t i = 0; i < n; i++) {
    uint64_t bits[MO_DEFAULT_WORDS];
    must(mo_body_stream_next(stream, bits), "stream");
    bodies[i] = body_of(bits);
  }
  mo_body_stream_free(stream);
  return bodies;
}

/* What a population looks like after some time: descendants of a few bodies. */
static struct mo_body **evolved_bodies(uint32_t n)
{
  enum { FOUNDERS = 24 };
  uint64_t founder[FOUNDERS][MO_DEFAULT_WORDS];
  struct mo_body **bodies = calloc(n, sizeof(*bodies));
  must(bodies == NULL ? MO_ERR_NO_MEMORY : MO_OK, "bodies");
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

static void free_bodies(struct mo_body **bodies, uint32_t n)
{
  for (uint32_t i = 0; i < n; i++)
    mo_body_free(bodies[i]);
  free(bodies);
}

static struct mo_device_score run(struct mo_device_controller *controller,
                                  const struct mo_robot *robots, uint32_t n,
                                  const struct mo_physics *physics,
                                  enum mo_device_precision precision, struct mo_outcome *outcomes)
{
  struct mo_device_score score = {.controller = controller,
                                  .robots = robots,
                                  .n = n,
                                  .physics = *physics,
                                  .precision = precision,
                                  .outcomes = outcomes};
  memset(outcomes, 0x7f, n * sizeof(*outcomes));
  must(module->score(device, &score), "score");
  return score;
}

static const char *const precision_names[] = {"exact", "fast"};

/* |Δloss| and Δloss of rows whose truth is finite. */
static void compare(const char *name, int bounded, const struct mo_outcome *outcomes,
                    const double *truth, uint32_t n)
{
  double *error = malloc(n * sizeof(*error)), mean = 0;
  uint32_t used = 0, apart = 0;
  must(error == NULL ? MO_ERR_NO_MEMORY : MO_OK, "errors");
  for (uint32_t i = 0; i < n; i++) {
    if (isfinite(truth[i]) && isfinite(outcomes[i].loss)) {
      error[used++] = fabs(outcomes[i].loss - truth[i]);
      mean += outcomes[i].loss - truth[i];
    } else if (isfinite(truth[i]) != isfinite(outcomes[i].loss)) {
      apart++;
    }
  }
  qsort(error, used, sizeof(*error), ascending);
  mean /= used;
  const double median = 0.5 * (error[(used - 1) / 2] + error[used / 2]);
  printf("%s: %u rollouts, |d loss| median %.2e, 90 %% %.2e, max %.2e, mean d %+.2e, diverged "
         "apart %u\n",
         name, used, median, error[used * 9 / 10], error[used - 1], mean, apart);
  if (bounded)
    expect(median <= 1e-3 && fabs(mean) <= 0.003 && apart == 0, name);
  free(error);
}

/* ---- agreement ---- */

static void check_golden(struct mo_device_controller *controller)
{
  const uint32_t n = (uint32_t)golden.n;
  struct mo_robot *robots = calloc(n, sizeof(*robots));
  struct mo_outcome *outcomes = calloc(n, sizeof(*outcomes));
  double *truth = calloc(n, sizeof(*truth));
  must(robots == NULL || outcomes == NULL || truth == NULL ? MO_ERR_NO_MEMORY : MO_OK, "golden");
  for (uint32_t i = 0; i < n; i++)
    robots[i] = (struct mo_robot){golden.cases[i].body, &golden.cases[i].environment};
  for (int mode = 0; mode < GOLDEN_MODES; mode++)
    for (int precision = 0; precision < 2; precision++) {
      struct mo_physics physics = mo_default_physics();
      physics.impact = mode == 0 ? MO_IMPACT_EXACT : MO_IMPACT_BISECTION;
      for (uint32_t i = 0; i < n; i++)
        truth[i] = golden.cases[i].loss[mode];
      run(controller, robots, n, &physics, (enum mo_device_precision)precision, outcomes);
      char name[64];
      snprintf(name, sizeof(name), "golden, %s, %s", mode == 0 ? "exact impact" : "bisection8",
               precision_names[precision]);
      compare(name, precision == MO_DEVICE_EXACT, outcomes, truth, n);
    }
  free(truth);
  free(outcomes);
  free(robots);
}

struct references {
  const struct mo_robot *robots;
  double *loss;
  uint32_t next;
};

static void *compute_references(void *context)
{
  struct references *references = context;
  const struct mo_physics physics = mo_default_physics();
  for (;;) {
    const uint32_t i = __atomic_fetch_add(&references->next, 1, __ATOMIC_RELAXED);
    if (i >= RANDOM)
      return NULL;
    struct mo_outcome outcome;
    must(mo_rollout_reference(references->robots[i].body, golden.controller,
                              references->robots[i].environment, &physics, NULL, &outcome),
         "reference");
    references->loss[i] = outcome.loss;
  }
}

static void load_references(const char *path, const struct mo_robot *robots, double *loss)
{
  FILE *file = path != NULL ? fopen(path, "rb") : NULL;
  if (file != NULL) {
    const size_t n = fread(loss, sizeof(*loss), RANDOM, file);
    fclose(file);
    if (n == RANDOM)
      return;
  }
  struct references references = {robots, loss, 0};
  pthread_t threads[THREADS_MAX];
  const long processors = sysconf(_SC_NPROCESSORS_ONLN);
  const int n = processors > THREADS_MAX ? THREADS_MAX : (int)processors;
  for (int t = 0; t < n; t++)
    must(pthread_create(threads + t, NULL, compute_references, &references) == 0 ? MO_OK
                                                                                 : MO_ERR_NO_MEMORY,
         "thread");
  for (int t = 0; t < n; t++)
    pthread_join(threads[t], NULL);
  file = path != NULL ? fopen(path, "wb") : NULL;
  if (file != NULL) {
    fwrite(loss, sizeof(*loss), RANDOM, file);
    fclose(file);
  }
}

static void check_random(struct mo_device_controller *controller, const char *path)
{
  struct mo_body **bodies = random_bodies(RANDOM, 20251101);
  struct mo_environment *environments = calloc(RANDOM, sizeof(*environments));
  struct mo_robot *robots = calloc(RANDOM, sizeof(*robots));
  struct mo_outcome *outcomes = calloc(RANDOM, sizeof(*outcomes));
  double *truth = calloc(RANDOM, sizeof(*truth));
  must(environments == NULL || robots == NULL || outcomes == NULL || truth == NULL
           ? MO_ERR_NO_MEMORY
           : MO_OK,
       "random rollouts");
  for (uint32_t i = 0; i < RANDOM; i++) {
    mo_environment_held_out(20251101, i, environments + i);
    robots[i] = (struct mo_robot){bodies[i], environments + i};
  }
  load_references(path, robots, truth);
  const struct mo_physics physics = mo_default_physics();
  for (int precision = 0; precision < 2; precision++) {
    run(controller, robots, RANDOM, &physics, (enum mo_device_precision)precision, outcomes);
    char name[64];
    snprintf(name, sizeof(name), "random, exact impact, %s", precision_names[precision]);
    compare(name, precision == MO_DEVICE_EXACT, outcomes, truth, RANDOM);
  }
  free(truth);
  free(outcomes);
  free(robots);
  free(environments);
  free_bodies(bodies, RANDOM);
}

/* A box of voxels on the floor. */
static struct mo_body *box(int nx, int ny, int nz)
{
  int64_t cells[MO_DEFAULT_VOXELS][3];
  size_t n = 0;
  for (int x = 0; x < nx; x++)
    for (int y = 0; y < ny; y++)
      for (int z = 0; z < nz; z++, n++) {
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

/* Short lives of bodies of all sizes against float64: there the paths have not parted yet. */
static void check_sizes(uint32_t n_steps, int with_passive)
{
  static const int sizes[][3] = {{1, 1, 1}, {2, 1, 1}, {3, 2, 1}, {3, 3, 3},
                                 {6, 6, 1}, {6, 6, 2}, {6, 6, 4}};
  enum { SIZES = sizeof(sizes) / sizeof(sizes[0]), PLACES = 3 };
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_body *bodies[SIZES];
  struct mo_robot robots[SIZES * PLACES];
  struct mo_outcome outcomes[SIZES * PLACES], truth;
  mo_environment_paper_test(environments);
  for (int b = 0; b < SIZES; b++) {
    bodies[b] = box(sizes[b][0], sizes[b][1], sizes[b][2]);
    for (int e = 0; e < PLACES; e++)
      robots[b * PLACES + e] = (struct mo_robot){bodies[b], environments + e};
  }
  const enum mo_sensor sensor = golden.controller->sensor;
  for (int kind = 0; kind < 3 + with_passive; kind++) {
    /* Sensor, impact: (0, exact), (0, bisection), (1, exact); then no controller. */
    struct mo_device_controller *controller = NULL;
    struct mo_physics physics = mo_default_physics();
    physics.n_steps = n_steps;
    physics.drop_height_m = 0.05;
    physics.impact = kind == 1 ? MO_IMPACT_BISECTION : MO_IMPACT_EXACT;
    golden.controller->sensor = kind == 2 ? MO_SENSOR_INVERSE_SQUARE : MO_SENSOR_INVERSE_SQRT;
    if (kind < 3)
      must(module->controller_create(device, golden.controller, &controller), "controller");
    for (int precision = 0; precision < 2; precision++) {
      double worst = 0, start = 0;
      run(controller, robots, SIZES * PLACES, &physics, (enum mo_device_precision)precision,
          outcomes);
      for (int r = 0; r < SIZES * PLACES; r++) {
        must(mo_rollout_reference(robots[r].body, kind < 3 ? golden.controller : NULL,
                                  robots[r].environment, &physics, NULL, &truth),
             "reference");
        for (int axis = 0; axis < 3; axis++) {
          worst = fmax(worst, fabs(outcomes[r].com_end_m[axis] - truth.com_end_m[axis]));
          start = fmax(start, fabs(outcomes[r].com_start_m[axis] - truth.com_start_m[axis]));
        }
      }
      char name[128];
      snprintf(name, sizeof(name),
               "1 to 144 voxels, %u steps, %s, %s, %s: center of mass within %.1e m, start %.1e",
               n_steps, kind == 3 ? "passive" : mo_sensor_name(golden.controller->sensor),
               kind == 1 ? "bisection8" : "exact impact", precision_names[precision], worst, start);
      expect(worst <= (precision == MO_DEVICE_EXACT || kind == 3 ? 2e-5 : 2e-3) && start == 0,
             name);
    }
    module->controller_free(device, controller);
  }
  golden.controller->sensor = sensor;
  for (int b = 0; b < SIZES; b++)
    mo_body_free(bodies[b]);
}

static void check_bits(struct mo_device_controller *controller, uint32_t n_bodies, uint32_t n_steps)
{
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_body **bodies = random_bodies(n_bodies, 5);
  const uint32_t n = n_bodies * 3;
  struct mo_robot *robots = calloc(2 * (size_t)n, sizeof(*robots)), *turned = robots + n;
  struct mo_outcome *outcomes = calloc(2 * (size_t)n, sizeof(*outcomes)), *again = outcomes + n;
  must(robots == NULL || outcomes == NULL ? MO_ERR_NO_MEMORY : MO_OK, "rows");
  mo_environment_paper_test(environments);
  for (uint32_t i = 0; i < n; i++) {
    robots[i] = (struct mo_robot){bodies[i / 3], environments + i % MO_PAPER_TEST_COUNT};
    turned[n - 1 - i] = robots[i];
  }
  struct mo_physics physics = mo_default_physics();
  physics.n_steps = n_steps;
  for (int precision = 0; precision < 2; precision++) {
    char name[64];
    run(controller, robots, n, &physics, (enum mo_device_precision)precision, outcomes);
    run(controller, robots, n, &physics, (enum mo_device_precision)precision, again);
    snprintf(name, sizeof(name), "two runs give the same bits, %s", precision_names[precision]);
    expect(memcmp(outcomes, again, n * sizeof(*outcomes)) == 0, name);
    run(controller, turned, n, &physics, (enum mo_device_precision)precision, again);
    int same = 1;
    for (uint32_t i = 0; i < n; i++)
      same &= memcmp(outcomes + i, again + n - 1 - i, sizeof(*outcomes)) == 0;
    snprintf(name, sizeof(name), "so does the reverse order, %s", precision_names[precision]);
    expect(same, name);
    same = 1;
    for (uint32_t i = 0; i < n; i += n / 7 + 1) {
      run(controller, robots + i, 1, &physics, (enum mo_device_precision)precision, again);
      same &= memcmp(outcomes + i, again, sizeof(*outcomes)) == 0;
    }
    snprintf(name, sizeof(name), "and a row alone, %s", precision_names[precision]);
    expect(same, name);
  }
  free(outcomes);
  free(robots);
  free_bodies(bodies, n_bodies);
}

/* Springs too stiff for the time step: which rows diverge, when, and where they were last. */
static void check_divergence(struct mo_device_controller *controller)
{
  enum { N = 64 };
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_body **bodies = random_bodies(N, 9);
  struct mo_robot robots[N];
  struct mo_outcome outcomes[N], truth;
  mo_environment_paper_test(environments);
  for (uint32_t i = 0; i < N; i++)
    robots[i] = (struct mo_robot){bodies[i], environments + i % MO_PAPER_TEST_COUNT};
  struct mo_physics physics = mo_default_physics();
  physics.stiffness_n_per_m *= 4;
  physics.n_steps = 200;
  run(controller, robots, N, &physics, MO_DEVICE_EXACT, outcomes);
  int diverged = 0, agree = 1;
  double apart = 0;
  for (uint32_t i = 0; i < N; i++) {
    must(mo_rollout_reference(bodies[i], golden.controller, robots[i].environment, &physics, NULL,
                              &truth),
         "reference");
    diverged += truth.diverged_step != 0;
    agree &=
        (truth.diverged_step != 0) == (outcomes[i].diverged_step != 0) &&
        abs(truth.diverged_step - outcomes[i].diverged_step) <= 2 &&
        isinf(truth.loss) == isinf(outcomes[i].loss) &&
        isfinite(outcomes[i].com_end_m[0] + outcomes[i].com_end_m[1] + outcomes[i].com_end_m[2]);
    if (truth.diverged_step == outcomes[i].diverged_step)
      for (int axis = 0; axis < 3; axis++)
        apart = fmax(apart, fabs(truth.com_end_m[axis] - outcomes[i].com_end_m[axis]));
  }
  char name[128];
  snprintf(
      name, sizeof(name),
      "stiffness x 4: %d of %d diverge, the same rows within 2 steps; last place within %.1e m",
      diverged, N, apart);
  expect(diverged > 0 && agree, name);
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
  struct mo_physics physics = mo_default_physics();
  physics.n_steps = 100000; /* seconds */
  struct mo_robot robot = {golden.cases[0].body, &golden.cases[0].environment};
  struct mo_outcome outcome;
  struct mo_device_score score = {.controller = controller,
                                  .robots = &robot,
                                  .n = 1,
                                  .physics = physics,
                                  .cancel = &flag,
                                  .outcomes = &outcome};
  pthread_t thread;
  flag = 0;
  must(pthread_create(&thread, NULL, raise_flag, NULL) == 0 ? MO_OK : MO_ERR_NO_MEMORY, "thread");
  const double start = now_s();
  const int status = module->score(device, &score);
  const double took = now_s() - start;
  pthread_join(thread, NULL);
  char name[96];
  snprintf(name, sizeof(name), "a flag raised after 20 ms ends a call after %.0f ms", 1e3 * took);
  expect(status == MO_ERR_CANCELLED && took < 0.2, name);
  flag = 0;
  score.physics.n_steps = 10;
  expect(module->score(device, &score) == MO_OK && isfinite(outcome.loss), "the next call works");
}

/* ---- time ---- */

/* Of all outcomes' bits: versions that compute the same have the same. */
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

static void time_rows(struct mo_device_controller *controller, const char *what,
                      struct mo_body **bodies, uint32_t n_bodies, uint32_t n_environments,
                      enum mo_device_precision precision, double bound_s)
{
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  const uint32_t n = n_bodies * n_environments;
  struct mo_robot *robots = calloc(n, sizeof(*robots));
  struct mo_outcome *outcomes = calloc(n, sizeof(*outcomes));
  must(robots == NULL || outcomes == NULL ? MO_ERR_NO_MEMORY : MO_OK, "rows");
  mo_environment_paper_test(environments);
  double masses = 0, springs = 0;
  for (uint32_t b = 0; b < n_bodies; b++) {
    masses += bodies[b]->n_masses;
    springs += bodies[b]->n_springs;
    for (uint32_t e = 0; e < n_environments; e++)
      robots[b * n_environments + e] =
          (struct mo_robot){bodies[b], environments + (n_environments == 1 ? b % 10 : e)};
  }
  const struct mo_physics physics = mo_default_physics();
  double wall[REPEATS], device_s[REPEATS], host_s[REPEATS];
  run(controller, robots, n, &physics, precision, outcomes);
  for (int i = 0; i < REPEATS; i++) {
    const double start = now_s();
    const struct mo_device_score score = run(controller, robots, n, &physics, precision, outcomes);
    wall[i] = now_s() - start;
    device_s[i] = score.device_s;
    host_s[i] = score.host_s;
  }
  qsort(wall, REPEATS, sizeof(*wall), ascending);
  qsort(device_s, REPEATS, sizeof(*device_s), ascending);
  qsort(host_s, REPEATS, sizeof(*host_s), ascending);
  double mean = 0;
  for (uint32_t i = 0; i < n; i++)
    mean += outcomes[i].loss / n;
  printf("%s, %u x %u, %.1f masses, %.1f springs, %s: device %.4f s (%.4f to %.4f), host %.4f s, "
         "together %.4f s; mean loss %.5f, bits %016llx\n",
         what, n_bodies, n_environments, masses / n_bodies, springs / n_bodies,
         precision_names[precision], device_s[REPEATS / 2], device_s[0], device_s[REPEATS - 1],
         host_s[REPEATS / 2], wall[REPEATS / 2], mean, (unsigned long long)hash_of(outcomes, n));
  if (bound_s > 0)
    expect(wall[REPEATS / 2] <= bound_s, what);
  free(outcomes);
  free(robots);
}

static void time_all(struct mo_device_controller *controller)
{
  enum { N = 8192 };
  struct mo_body **bodies = random_bodies(N, 1), **evolved = evolved_bodies(N);
  time_rows(controller, "random bodies", bodies, N, 10, MO_DEVICE_EXACT, 1.0);
  time_rows(controller, "random bodies", bodies, N, 10, MO_DEVICE_FAST, 0);
  time_rows(controller, "evolved bodies", evolved, N, 10, MO_DEVICE_EXACT, 1.0);
  time_rows(controller, "random bodies", bodies, N, 1, MO_DEVICE_EXACT, 0);
  time_rows(controller, "random bodies", bodies, 1024, 1, MO_DEVICE_EXACT, 0);
  time_rows(controller, "random bodies", bodies, 102, 10, MO_DEVICE_EXACT, 0);
  free_bodies(evolved, N);
  free_bodies(bodies, N);
}

/* ---- devices beside each other ---- */

enum { PARTS_MAX = 8 };

/* A device's share of the rows, as the daemon would cut them. */
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

/* Parts on devices of their own, at once, or one after the other on the first. The longest; the
 * best of three. */
static double time_parts(struct mo_device *const *devices,
                         struct mo_device_controller *const *controllers,
                         const struct mo_robot *robots, uint32_t n, uint32_t n_parts, int at_once,
                         struct mo_outcome *outcomes)
{
  double best = INFINITY;
  for (int repeat = -1; repeat < REPEATS; repeat++) { /* the first warms up */
    struct part parts[PARTS_MAX];
    double longest = 0;
    for (uint32_t i = 0; i < n_parts; i++) {
      const uint32_t first = (uint32_t)((uint64_t)n * i / n_parts),
                     end = (uint32_t)((uint64_t)n * (i + 1) / n_parts);
      parts[i] = (struct part){.device = devices[at_once ? i : 0],
                               .score = {.controller = controllers[at_once ? i : 0],
                                         .robots = robots + first,
                                         .n = end - first,
                                         .physics = mo_default_physics(),
                                         .precision = MO_DEVICE_EXACT,
                                         .outcomes = outcomes + first}};
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
  enum { N = 8192, ROWS = N * MO_PAPER_TEST_COUNT };
  struct mo_device *devices[PARTS_MAX] = {device};
  struct mo_device_controller *controllers[PARTS_MAX] = {NULL};
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_body **bodies = random_bodies(N, 1);
  struct mo_robot *robots = calloc(ROWS, sizeof(*robots));
  struct mo_outcome *outcomes = calloc(ROWS, sizeof(*outcomes));
  must(robots == NULL || outcomes == NULL ? MO_ERR_NO_MEMORY : MO_OK, "rows");
  mo_environment_paper_test(environments);
  for (uint32_t i = 0; i < ROWS; i++)
    robots[i] =
        (struct mo_robot){bodies[i / MO_PAPER_TEST_COUNT], environments + i % MO_PAPER_TEST_COUNT};
  n_devices = n_devices < PARTS_MAX ? n_devices : PARTS_MAX;
  for (uint32_t i = 0; i < n_devices; i++) {
    if (i > 0)
      must(module->open(i, &devices[i]), "open");
    must(module->controller_create(devices[i], golden.controller, &controllers[i]), "controller");
  }
  const double alone = time_parts(devices, controllers, robots, ROWS, 1, 1, outcomes);
  const uint64_t bits = hash_of(outcomes, ROWS);
  printf("random bodies, %d x %d, exact, host and device: %.4f s\n", N, MO_PAPER_TEST_COUNT, alone);
  for (uint32_t n = 2; n <= PARTS_MAX; n *= 2) {
    const int at_once = n <= n_devices;
    const double longest = time_parts(devices, controllers, robots, ROWS, n, at_once, outcomes);
    printf("%s of %u parts: %.4f s, 1 / %.2f of the whole\n",
           at_once ? "on as many devices at once, the longest"
                   : "one after the other on one device, the longest",
           n, longest, alone / longest);
    expect(hash_of(outcomes, ROWS) == bits, "the same bits");
  }
  for (uint32_t i = 0; i < n_devices; i++) {
    module->controller_free(devices[i], controllers[i]);
    if (i > 0)
      module->close(devices[i]);
  }
  free(outcomes);
  free(robots);
  free_bodies(bodies, N);
}

static void load(const char *path)
{
  const struct mo_device_module *(*entry)(void) = NULL;
  void *library = dlopen(path, RTLD_NOW | RTLD_LOCAL);
  if (library != NULL)
    *(void **)(void *)&entry = dlsym(library, "mo_device_module");
  if (entry == NULL || entry()->abi != MO_DEVICE_ABI) {
    fprintf(stderr, "cuda-bench: %s: %s\n", path, entry == NULL ? dlerror() : "of another version");
    exit(1);
  }
  module = entry();
}

int main(int argc, char **argv)
{
  if (argc < 2) {
    fprintf(stderr, "usage: cuda-bench MODULE [check [REFERENCES] | time | spread | short]\n");
    return 2;
  }
  const char *what = argc > 2 ? argv[2] : "check";
  load(argv[1]);
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
  } else if (strcmp(what, "spread") == 0) {
    spread(n);
  } else if (strcmp(what, "short") == 0) {
    check_sizes(3, 1);
    check_bits(controller, 20, 3);
  } else {
    check_sizes(40, 1);
    check_golden(controller);
    check_random(controller, argc > 3 ? argv[3] : NULL);
    check_bits(controller, 400, 1000);
    check_divergence(controller);
    check_cancel(controller);
  }
  module->controller_free(device, controller);
  module->close(device);
  golden_free(&golden);
  return missed;
}
