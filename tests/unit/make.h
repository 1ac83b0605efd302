/* make.h: things that tests need, each made in one call. If that fails, the program ends; otherwise
 * the thing is freed at the end of the case (check.h). Also computations that several rooms' tests
 * share. */
#ifndef MORPHO_TESTS_MAKE_H
#define MORPHO_TESTS_MAKE_H

#include "check.h"

#include "base/clock.h"

#include <morpho/compute.h>
#include <morpho/evolution.h>
#include <morpho/learning.h>

static inline void make_check(int status, const char *what)
{
  if (status == MO_OK)
    return;
  printf("Bail out! %s: %s\n", what, mo_error_text(status));
  exit(1);
}

/* make_NAME calls mo_NAME_create, whose last argument (before a message, if there is one) is
 * &made. */
#define MAKE(name, parameters, ...)                                                                \
  static inline void drop_##name(void *thing)                                                      \
  {                                                                                                \
    mo_##name##_free(thing);                                                                       \
  }                                                                                                \
  static inline struct mo_##name *make_##name parameters                                           \
  {                                                                                                \
    struct mo_##name *made = NULL;                                                                 \
    make_check(mo_##name##_create(__VA_ARGS__), #name);                                            \
    return check_keep(made, drop_##name);                                                          \
  }
MAKE(lattice, (struct mo_workspace workspace), workspace, &made)
MAKE(body, (const struct mo_lattice *lattice, const uint64_t *bits), lattice, bits, &made)
MAKE(form_set, (struct mo_workspace workspace), workspace, &made)
MAKE(body_stream, (struct mo_workspace workspace, uint64_t seed), workspace, seed, &made)
MAKE(controller, (struct mo_workspace workspace, enum mo_sensor sensor), workspace, sensor, &made)
MAKE(pack, (const struct mo_controller *c, enum mo_isa isa, enum mo_precision precision), c, isa,
     precision, &made)
MAKE(workspace_memory, (void), &made)
MAKE(gradient_memory, (size_t budget_bytes), budget_bytes, &made)
MAKE(compute_controller, (struct mo_compute * compute, const struct mo_controller *c), compute, c,
     &made)
MAKE(compute_share, (struct mo_compute * compute, double weight), compute, weight, &made)
MAKE(gradient_state, (struct mo_compute * compute), compute, &made)
MAKE(training,
     (const struct mo_training_settings *settings, const struct mo_controller *parent,
      const uint64_t *designs, size_t n),
     settings, parent, designs, n, &made)
MAKE(seen, (struct mo_workspace workspace, const struct mo_form_set *excluded), workspace, excluded,
     &made)
#undef MAKE

static inline struct mo_pack *make_gradient_pack(const struct mo_controller *c, enum mo_isa isa)
{
  struct mo_pack *made = NULL;
  make_check(mo_pack_create_for_gradients(c, isa, &made), "gradient pack");
  return check_keep(made, drop_pack);
}

static inline void drop_compute(void *compute)
{
  mo_compute_free(compute);
}

static inline struct mo_compute *make_compute(uint32_t n_workers)
{
  struct mo_compute *made = NULL;
  const struct mo_compute_config config = {.n_workers = n_workers, .isa = mo_isa_best(), .nice = 1};
  make_check(mo_compute_create_cpu(&config, &made), "workers");
  return check_keep(made, drop_compute);
}

/* Returns n elements, all zero. */
static inline void *make_zeros(size_t n, size_t size)
{
  void *made = calloc(n > 0 ? n : 1, size);
  make_check(made != NULL ? MO_OK : MO_ERR_NO_MEMORY, "memory");
  return check_keep(made, free);
}

/* ---- controllers, bodies and robots ---- */

static inline struct mo_controller *make_random_controller(enum mo_sensor sensor, uint64_t seed)
{
  struct mo_controller *made = make_controller(MO_DEFAULT_WORKSPACE, sensor);
  mo_controller_randomize(made, seed);
  return made;
}

/* Reads a file of the source tree. */
static inline char *make_source_path(const char *relative)
{
  const char *root = getenv("MORPHO_SOURCE_DIR");
  char *path = NULL;
  make_check(asprintf(&path, "%s/%s", root != NULL ? root : ".", relative) < 0 ? MO_ERR_NO_MEMORY
                                                                               : MO_OK,
             "a path");
  return check_keep(path, free);
}

/* data/controllers/NAME.safetensors */
static inline struct mo_controller *make_shipped_controller(const char *name)
{
  struct mo_controller *made = NULL;
  char relative[64];
  snprintf(relative, sizeof(relative), "data/controllers/%s.safetensors", name);
  make_check(mo_controller_read(make_source_path(relative), &made, NULL), relative);
  return check_keep(made, drop_controller);
}

/* Sets all voxels of the lattice's workspace. */
static inline struct mo_body *make_full_body(const struct mo_lattice *lattice)
{
  uint64_t *bits = make_zeros((lattice->n_voxels + 63) / 64, sizeof(uint64_t));
  for (uint32_t v = 0; v < lattice->n_voxels; v++)
    bits[v / 64] |= UINT64_C(1) << v % 64;
  return make_body(lattice, bits);
}

/* Returns n robots: the first bodies of a stream, each in the training environment with its number;
 * the caller may replace both. */
static inline struct mo_robot *make_robots(const struct mo_lattice *lattice, uint64_t body_seed,
                                           uint64_t environment_seed, uint32_t n)
{
  struct mo_robot *robots = make_zeros(n, sizeof(*robots));
  struct mo_environment *environments = make_zeros(n, sizeof(*environments));
  struct mo_body_stream *stream = make_body_stream(lattice->workspace, body_seed);
  for (uint32_t i = 0; i < n; i++) {
    uint64_t *bits = make_zeros(mo_workspace_words(lattice->workspace), sizeof(uint64_t));
    make_check(mo_body_stream_next(stream, bits, NULL), "a body");
    mo_environment_training(environment_seed, 0, i, environments + i);
    robots[i] = (struct mo_robot){make_body(lattice, bits), environments + i};
  }
  return robots;
}

static inline struct mo_physics physics_of(uint32_t n_steps)
{
  struct mo_physics physics = mo_paper_physics();
  physics.scheme.n_steps = n_steps;
  return physics;
}

/* The random stream of a test. */
static inline struct mo_random dice(uint64_t seed, uint32_t step, uint64_t index)
{
  struct mo_random random;
  mo_random_init(&random, seed, MO_PURPOSE_CHECK, step, index);
  return random;
}

/* Gives an environment a profile, one for each k, with heights from N(0, sigma_m). It lies under
 * the start and ends between 4.7 and 6.3 m. */
static inline void set_profile(struct mo_environment *environment, uint64_t k, double sigma_m)
{
  static const struct {
    uint32_t n;
    double spacing_m;
  } shapes[] = {{64, 0.1}, {20, 0.25}, {63, 0.08}, {40, 0.13}};
  struct mo_random random = dice(61, 0, k);
  environment->n_profile = shapes[k % 4].n;
  environment->profile_spacing_m = shapes[k % 4].spacing_m;
  for (uint32_t i = 0; i < MO_TERRAIN_HEIGHTS; i++)
    environment->terrain_heights_m[i] =
        i < environment->n_profile ? sigma_m * mo_random_normal(&random) : 0;
}

static inline void drop_grid(void *grid)
{
  mo_terrain_grid_drop(grid);
}

/* Makes a grid with heights from N(0, sigma_m), one for each seed. */
static inline const struct mo_terrain_grid *
make_grid(uint32_t columns, uint32_t rows, double spacing_m, uint64_t seed, double sigma_m)
{
  struct mo_random random = dice(62, 0, seed);
  const struct mo_terrain_grid *made = NULL;
  double *heights_m = make_zeros((size_t)columns * rows, sizeof(double));
  for (size_t k = 0; k < (size_t)columns * rows; k++)
    heights_m[k] = sigma_m * mo_random_normal(&random);
  make_check(mo_terrain_grid_create(columns, rows, spacing_m, heights_m, &made), "grid");
  return check_keep((void *)(uintptr_t)made, drop_grid);
}

/* Gives an environment a grid, one for each k: long ones along both axes, one that ends under the
 * body, and one that ends far away. */
static inline void set_grid(struct mo_environment *environment, uint64_t k, double sigma_m)
{
  static const struct {
    uint32_t columns, rows;
    double spacing_m;
  } shapes[] = {{31, 31, 0.13}, {128, 7, 0.04}, {5, 90, 0.07}, {12, 12, 0.5}};
  for (uint32_t i = 0; i < MO_TERRAIN_HEIGHTS; i++)
    environment->terrain_heights_m[i] = 0;
  environment->grid = make_grid(shapes[k % 4].columns, shapes[k % 4].rows, shapes[k % 4].spacing_m,
                                k, sigma_m * fmin(1, shapes[k % 4].spacing_m / 0.1));
}

/* ---- settings ---- */

/* A field of settings, a value for it, and the expected message of the check. */
struct field_case {
  void *field;
  size_t size; /* 2: uint16_t; 4: uint32_t or an enumeration; 8: double */
  double value;
  int code;
  const char *says;
};
#define FIELD(lvalue) &(lvalue), sizeof(lvalue)

static inline void set_field(void *field, size_t size, double value)
{
  const uint16_t two = (uint16_t)value;
  const uint32_t four = (uint32_t)(int64_t)value;
  memcpy(field, size == 2 ? (const void *)&two : size == 4 ? (const void *)&four : &value, size);
}

/* ---- numbers ---- */

static inline double now_s(void)
{
  return 1e-9 * (double)mo_clock_ns();
}

#define FNV_START UINT64_C(0xcbf29ce484222325)

/* FNV-1a. */
static inline void hash(uint64_t *h, const void *bytes, size_t n)
{
  for (size_t i = 0; i < n; i++)
    *h = (*h ^ ((const uint8_t *)bytes)[i]) * UINT64_C(0x100000001b3);
}

static inline int ascending(const void *a, const void *b)
{
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

/* The input must be sorted. */
static inline double median_of(const double *sorted, size_t n)
{
  return 0.5 * (sorted[(n - 1) / 2] + sorted[n / 2]);
}

#endif
