/* common.c: scene, clock, order statistics. */
#include "bench.h"

#include "base/words.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

double bench_now_s(void)
{
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

double bench_thread_s(void)
{
  struct timespec time;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &time);
  return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

void bench_check(int status, const char *what)
{
  if (status == MO_OK)
    return;
  fprintf(stderr, "morpho-bench: %s: %s\n", what, mo_error_text(status));
  exit(1);
}

int bench_word(const char *const *words, const char *word)
{
  const int i = mo_word_index(words, word);
  char list[MO_WORDS_BYTES];
  if (i < 0) {
    fprintf(stderr, "morpho-bench: \"%s\" is not %s\n", word, mo_words_list(words, list));
    exit(2);
  }
  return i;
}

double bench_ms(const char *text)
{
  char *end = NULL;
  const double value = strtod(text, &end);
  if (end == text || *end != '\0' || !(value > 0 && value <= 1e4)) {
    fprintf(stderr, "morpho-bench: \"%s\" is not a number of milliseconds above 0\n", text);
    exit(2);
  }
  return value / 1e3;
}

uint64_t bench_number(const char *text, uint64_t least, uint64_t most)
{
  char *end = NULL;
  errno = 0;
  const unsigned long long value = strtoull(text, &end, 10);
  if (errno != 0 || end == text || *end != '\0' || text[0] == '-' || value < least ||
      value > most) {
    fprintf(stderr, "morpho-bench: \"%s\" is not a whole number from %llu to %llu\n", text,
            (unsigned long long)least, (unsigned long long)most);
    exit(2);
  }
  return value;
}

void *bench_zeros(size_t n, size_t size)
{
  void *memory = calloc(n > 0 ? n : 1, size);
  bench_check(memory == NULL ? MO_ERR_NO_MEMORY : MO_OK, "memory");
  return memory;
}

struct mo_compute *bench_compute(uint32_t workers, enum mo_isa isa)
{
  const struct mo_compute_config config = {.n_workers = workers, .isa = isa};
  struct mo_compute *compute = NULL;
  bench_check(mo_compute_create_cpu(&config, &compute), "back end");
  return compute;
}

double bench_peak_mib(void)
{
  FILE *file = fopen("/proc/self/status", "r");
  char line[256];
  double kib = 0.0;
  while (file != NULL && fgets(line, sizeof(line), file) != NULL)
    if (strncmp(line, "VmHWM:", 6) == 0)
      kib = strtod(line + 6, NULL);
  if (file != NULL)
    fclose(file);
  return kib / 1024.0;
}

enum mo_isa bench_isa(const char *name)
{
  const char *names[MO_ISA_COUNT + 1] = {NULL};
  for (int i = 0; i < MO_ISA_COUNT; i++)
    names[i] = mo_isa_name((enum mo_isa)i);
  return (enum mo_isa)bench_word(names, name);
}

static int ascending(const void *a, const void *b)
{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

double bench_quantile(double *values, size_t n, double q)
{
  qsort(values, n, sizeof(*values), ascending);
  const double rank = ceil(q * (double)n);
  return values[rank < 1 ? 0 : (size_t)rank - 1];
}

double bench_median(double *values, size_t n)
{
  qsort(values, n, sizeof(*values), ascending);
  return 0.5 * (values[(n - 1) / 2] + values[n / 2]);
}

/* Multiplies the constants of each of n worlds by other factors. */
static void vary(struct mo_environment *environments, uint32_t n, uint64_t seed)
{
  struct mo_factor_ranges ranges = {.given = true, .friction = {1.0 / 3, 4.0 / 3}};
  double *const others[] = {ranges.stiffness, ranges.mass, ranges.drag, ranges.gravity,
                            ranges.actuation};
  for (size_t i = 0; i < sizeof(others) / sizeof(others[0]); i++) {
    others[i][0] = 0.7;
    others[i][1] = 1.3;
  }
  struct mo_factors *factors = bench_zeros(n, sizeof(*factors));
  bench_check(mo_factors_draw(&ranges, seed, 0, n, factors), "factors");
  for (uint32_t i = 0; i < n; i++)
    environments[i].factors = factors[i];
  free(factors);
}

void bench_scene_create(struct bench_scene *scene, const struct bench_options *options,
                        uint32_t n_bodies)
{
  *scene = (struct bench_scene){.n_bodies = n_bodies};
  struct mo_message message = {"cannot be read"};
  if (mo_controller_read(options->controller, &scene->controller, &message) != MO_OK) {
    fprintf(stderr, "morpho-bench: %s: %s\n", options->controller, message.text);
    exit(1);
  }
  bench_check(mo_lattice_create(MO_DEFAULT_WORKSPACE, &scene->lattice), "lattice");
  mo_environment_paper_test(scene->environments);
  for (int i = 0; i < MO_BLOCK_LANES; i++)
    scene->list[i] = scene->environments + i % MO_PAPER_TEST_COUNT;
  struct mo_body_stream *stream = NULL;
  bench_check(mo_body_stream_create(MO_DEFAULT_WORKSPACE, options->seed, &stream), "body stream");
  bench_check(mo_controller_create(MO_DEFAULT_WORKSPACE, scene->controller->sensor, &scene->random),
              "controller");
  mo_controller_randomize(scene->random, options->seed);
  scene->bodies = bench_zeros(n_bodies, sizeof(*scene->bodies));
  scene->training = bench_zeros(n_bodies, sizeof(*scene->training));
  scene->robots = bench_zeros(n_bodies, sizeof(*scene->robots));
  for (uint32_t i = 0; i < n_bodies; i++) {
    uint64_t bits[MO_DEFAULT_WORDS];
    bench_check(mo_body_stream_next(stream, bits, NULL), "body stream");
    bench_check(mo_body_create(scene->lattice, bits, &scene->bodies[i]), "body");
    mo_environment_training(options->seed, 0, i, scene->training + i);
    scene->robots[i] = (struct mo_robot){scene->bodies[i], scene->training + i};
  }
  mo_body_stream_free(stream);
  if (options->vary) {
    vary(scene->environments, MO_PAPER_TEST_COUNT, options->seed);
    vary(scene->training, n_bodies, options->seed);
  }
}

struct mo_body *bench_box(const struct bench_scene *scene, int nx, int ny, int nz)
{
  uint64_t bits[MO_DEFAULT_WORDS] = {0};
  for (int x = 0; x < nx; x++)
    for (int y = 0; y < ny; y++)
      for (int z = 0; z < nz; z++) {
        const int v = (x * MO_DEFAULT_WORKSPACE.ny + y) * MO_DEFAULT_WORKSPACE.nz + z;
        bits[v >> 6] |= UINT64_C(1) << (v & 63);
      }
  mo_genotype_place(MO_DEFAULT_WORKSPACE, bits);
  struct mo_body *body = NULL;
  bench_check(mo_body_create(scene->lattice, bits, &body), "box");
  return body;
}

struct mo_physics bench_physics(const struct bench_options *options)
{
  struct mo_physics physics = mo_paper_physics();
  struct mo_message message;
  const double life_s = physics.scheme.n_steps * physics.scheme.dt_s;
  if (options->dt_s > 0)
    physics.scheme.dt_s = options->dt_s;
  physics.scheme.n_steps = (uint32_t)lround(life_s / physics.scheme.dt_s);
  physics.scheme.control_period_s = options->control_period_s;
  physics.scheme.integrator = options->integrator;
  if (mo_physics_check(&physics, &message) != MO_OK) {
    fprintf(stderr, "morpho-bench: %s\n", message.text);
    exit(2);
  }
  return physics;
}

uint32_t bench_passes(const struct mo_physics *physics)
{
  const uint32_t steps = mo_control_steps(&physics->scheme);
  return (physics->scheme.n_steps + steps - 1) / steps;
}
