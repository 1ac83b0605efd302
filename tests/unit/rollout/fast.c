/* The fast path: its parts against plain arithmetic, its bits against themselves, its results
 * against the reference. */
#include <morpho/rollout.h>

#include "../check.h"
#include "probe.h"

#include <stdint.h>
#include <stdlib.h>

static const char *source_path(const char *relative)
{
  static char path[4096];
  const char *root = getenv("MORPHO_SOURCE_DIR");
  snprintf(path, sizeof(path), "%s/%s", root != NULL ? root : ".", relative);
  return path;
}

static struct mo_controller *controller;
static struct mo_lattice *lattice;
static struct mo_environment environments[MO_PAPER_TEST_COUNT];

static int setup(void)
{
  if (controller != NULL)
    return 1;
  mo_environment_paper_test(environments);
  return mo_lattice_create(MO_DEFAULT_WORKSPACE, &lattice) == MO_OK &&
         mo_controller_read(source_path("data/controllers/bootstrap.safetensors"), &controller,
                            NULL) == MO_OK;
}

/* A body of about `size` voxels, always the same for the same number. */
static struct mo_body *body_number(uint64_t number, uint32_t size)
{
  const struct mo_workspace workspace = MO_DEFAULT_WORKSPACE;
  uint64_t bits[MO_DEFAULT_WORDS];
  struct mo_random random;
  mo_random_init(&random, 11, MO_PURPOSE_CHECK, size, number);
  do {
    memset(bits, 0, sizeof(bits));
    for (uint32_t v = 0; v < MO_DEFAULT_VOXELS; v++)
      if (mo_random_below(&random, MO_DEFAULT_VOXELS) < 36 + size / 2)
        bits[v >> 6] |= UINT64_C(1) << (v & 63);
    mo_genotype_keep_largest(workspace, bits);
  } while (mo_genotype_count(workspace, bits) < size);
  mo_genotype_place(workspace, bits);
  struct mo_body *body = NULL;
  return mo_body_create(lattice, bits, &body) == MO_OK ? body : NULL;
}

static int run_block(enum mo_isa isa, enum mo_precision precision, const struct mo_body *body,
                     const int *lanes, uint32_t n, const struct mo_physics *physics,
                     const struct mo_recording *recordings, struct mo_outcome *outcomes)
{
  struct mo_pack *pack = NULL;
  struct mo_workspace_memory *memory = NULL;
  const struct mo_environment *list[MO_BLOCK_LANES];
  for (uint32_t l = 0; l < n; l++)
    list[l] = environments + lanes[l] % MO_PAPER_TEST_COUNT;
  int status = mo_pack_create(controller, isa, precision, &pack);
  if (status == MO_OK)
    status = mo_workspace_memory_create(&memory);
  if (status == MO_OK)
    status = mo_rollout_block(memory, pack, body, list, n, physics, recordings, NULL, outcomes);
  mo_workspace_memory_free(memory);
  mo_pack_free(pack);
  return status;
}

#define EACH_KERNEL(isa, precision)                                                                \
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)                                              \
    for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++)

/* ---- parts ---- */

/* Units in the last place between a float and the exact value. */
static double float_ulp(float got, double exact)
{
  const double spacing = exact == 0 ? 0x1p-149 : ldexp(1.0, (int)fmax(ilogb(exact), -126) - 23);
  return fabs((double)got - exact) / spacing;
}

static void tanh_float(void)
{
  enum { N = 1 << 14 };
  static float x[N] __attribute__((aligned(64))), y[N] __attribute__((aligned(64)));
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    double worst = 0;
    for (uint32_t high = 0; high < 256;
         high += 1) { /* every exponent, both signs, mantissas spread over all bits */
      for (uint32_t i = 0; i < N; i++) {
        const uint32_t bits = (high << 23) | ((i * 2654435761u) & 0x7fffff) | (i << 31);
        memcpy(&x[i], &bits, 4);
      }
      memcpy(y, x, sizeof(y));
      run_probe((enum mo_isa)isa, MO_FLOAT32, (struct probe){.tanh_values = y, .n_tanh = N});
      for (uint32_t i = 0; i < N; i++) {
        if (isnan(x[i])) {
          if (!(fabsf(y[i]) <= 1))
            worst = INFINITY;
          continue;
        }
        const double error = float_ulp(y[i], tanh((double)x[i]));
        worst = error <= worst ? worst : error;
        if (!(fabsf(y[i]) <= 1) || signbit(y[i]) != signbit(x[i]))
          worst = INFINITY;
      }
    }
    printf("# %s: tanh in float within %.2f ulp\n", mo_isa_name((enum mo_isa)isa), worst);
    CHECK(worst <= 3);
  }
}

static void tanh_double(void)
{
  enum { N = 1 << 12 };
  static double x[N] __attribute__((aligned(64))), y[N] __attribute__((aligned(64)));
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    double worst = 0;
    for (uint64_t high = 0; high < 2048; high++) {
      for (uint64_t i = 0; i < N; i++) {
        const uint64_t bits = (high << 52) | ((i * UINT64_C(0x9e3779b97f4a7c15)) >> 12) | (i << 63);
        memcpy(&x[i], &bits, 8);
      }
      memcpy(y, x, sizeof(y));
      run_probe((enum mo_isa)isa, MO_FLOAT64, (struct probe){.tanh_values = y, .n_tanh = N});
      for (uint32_t i = 0; i < N; i++) {
        if (isnan(x[i])) {
          if (!(fabs(y[i]) <= 1))
            worst = INFINITY;
          continue;
        }
        const long double exact = tanhl((long double)x[i]);
        const double spacing =
            exact == 0 ? 0x1p-1074 : ldexp(1.0, (int)fmax(ilogb((double)exact), -1022) - 52);
        const double error = (double)(fabsl((long double)y[i] - exact) / (long double)spacing);
        worst = error <= worst ? worst : error;
        if (!(fabs(y[i]) <= 1) || signbit(y[i]) != signbit(x[i]))
          worst = INFINITY;
      }
    }
    printf("# %s: tanh in double within %.2f ulp\n", mo_isa_name((enum mo_isa)isa), worst);
    CHECK(worst <= 3);
  }
}

static void sin_and_exp(void)
{
  for (int i = 0; i < 200000; i++) {
    const double x = (i - 1000) * 0.37719;
    CHECK_NEAR(mo_fast_sin(x), sin(x), 5e-16);
    const double e = -i * 0.0035;
    CHECK_NEAR(mo_fast_exp(e) / exp(e), 1.0, 5e-16);
  }
  CHECK(mo_fast_exp(-800.0) == 0.0);
}

/* The product of every tile height against the same sum written plainly: k ascending, one fused
 * operation per term where the instruction set has it, so the bits must agree. */
static void products(void)
{
  enum { K = 83, ROWS = MO_BLOCK_LANES, PANEL_MAX = 32 };
  static double x[ROWS * K], w[K * PANEL_MAX], init[PANEL_MAX];
  static double storage[4][ROWS * K + K * PANEL_MAX] __attribute__((aligned(64)));
  struct mo_random random;
  mo_random_init(&random, 3, MO_PURPOSE_CHECK, 0, 0);
  for (int i = 0; i < ROWS * K; i++)
    x[i] = (float)(mo_random_uniform(&random) - 0.5);
  for (int i = 0; i < K * PANEL_MAX; i++)
    w[i] = (float)(mo_random_uniform(&random) - 0.5);
  for (int i = 0; i < PANEL_MAX; i++)
    init[i] = (float)mo_random_uniform(&random);
  EACH_KERNEL(isa, precision)
  {
    const uint32_t real = precision == MO_FLOAT64 ? 8 : 4,
                   panel = 2 * mo_isa_vector_bytes((enum mo_isa)isa) / real;
    for (uint32_t rows = 1; rows <= ROWS; rows++) {
      for (uint32_t i = 0; i < ROWS * K; i++)
        precision == MO_FLOAT64 ? (void)(storage[0][i] = x[i])
                                : (void)(((float *)storage[0])[i] = (float)x[i]);
      for (uint32_t i = 0; i < K * panel; i++)
        precision == MO_FLOAT64 ? (void)(storage[1][i] = w[i])
                                : (void)(((float *)storage[1])[i] = (float)w[i]);
      for (uint32_t i = 0; i < panel; i++)
        precision == MO_FLOAT64 ? (void)(storage[2][i] = init[i])
                                : (void)(((float *)storage[2])[i] = (float)init[i]);
      run_probe((enum mo_isa)isa, (enum mo_precision)precision,
                (struct probe){.rows = rows,
                               .k = K,
                               .x = storage[0],
                               .w = storage[1],
                               .init = storage[2],
                               .c = storage[3]});
      int wrong = 0;
      for (uint32_t r = 0; r < rows; r++)
        for (uint32_t o = 0; o < panel; o++) {
          double expected;
          if (precision == MO_FLOAT64) {
            double sum = init[o];
            for (uint32_t k = 0; k < K; k++)
              sum = isa == MO_ISA_BASELINE ? sum + x[r * K + k] * w[k * panel + o]
                                           : fma(x[r * K + k], w[k * panel + o], sum);
            expected = sum;
            wrong += storage[3][r * panel + o] != expected;
          } else {
            float sum = (float)init[o];
            for (uint32_t k = 0; k < K; k++) {
              const float a = (float)x[r * K + k], b = (float)w[k * panel + o];
              sum = isa == MO_ISA_BASELINE ? sum + a * b : fmaf(a, b, sum);
            }
            wrong += ((float *)storage[3])[r * panel + o] != sum;
          }
        }
      CHECK_INT(wrong, 0);
    }
  }
}

/* ---- bits ---- */

/* A lane alone, and among others at every place, in any mixture: the same outcome and the same
 * path, bit for bit. */
static void lanes_keep_to_themselves(void)
{
  REQUIRE(setup());
  struct mo_physics physics = mo_default_physics();
  physics.n_steps = 150;
  enum { STRIDE = 25, FRAMES = 7 };
  EACH_KERNEL(isa, precision)
  for (int impact = MO_IMPACT_EXACT; impact <= MO_IMPACT_BISECTION; impact++) {
    physics.impact = (enum mo_impact)impact;
    struct mo_body *body = body_number(1, 10);
    REQUIRE(body != NULL);
    struct mo_outcome alone[MO_PAPER_TEST_COUNT], outcomes[MO_BLOCK_LANES];
    static float paths[MO_PAPER_TEST_COUNT][FRAMES * MO_DEFAULT_MASSES * 3],
        path[MO_BLOCK_LANES][FRAMES * MO_DEFAULT_MASSES * 3];
    for (int e = 0; e < MO_PAPER_TEST_COUNT; e++) {
      const struct mo_recording recording = {.stride = STRIDE, .mass_m = paths[e]};
      REQUIRE(run_block((enum mo_isa)isa, (enum mo_precision)precision, body, &e, 1, &physics,
                        &recording, &alone[e]) == 0);
    }
    for (uint32_t n = 2; n <= MO_BLOCK_LANES; n += n == 2 ? 1 : 3) {
      int lanes[MO_BLOCK_LANES];
      struct mo_recording recordings[MO_BLOCK_LANES];
      for (uint32_t l = 0; l < n; l++) {
        lanes[l] = (int)(l * 3 + n) % MO_PAPER_TEST_COUNT;
        recordings[l] = (struct mo_recording){.stride = STRIDE, .mass_m = path[l]};
      }
      REQUIRE(run_block((enum mo_isa)isa, (enum mo_precision)precision, body, lanes, n, &physics,
                        recordings, outcomes) == 0);
      for (uint32_t l = 0; l < n; l++) {
        CHECK(memcmp(&outcomes[l], &alone[lanes[l]], sizeof(outcomes[l])) == 0);
        CHECK(memcmp(path[l], paths[lanes[l]], sizeof(float) * FRAMES * body->n_masses * 3) == 0);
      }
    }
    mo_body_free(body);
  }
}

/* ---- results ---- */

enum { LANES = 3, COM_FRAMES = 5 };

/* One rollout in several lanes. */
struct lives {
  struct mo_outcome outcomes[LANES];
  double com[LANES][COM_FRAMES * 3];
  struct mo_recording recordings[LANES];
};

static void prepare_lives(struct lives *lives)
{
  for (int l = 0; l < LANES; l++)
    lives->recordings[l] = (struct mo_recording){.stride = 25, .com_m = lives->com[l]};
}

static double worst_difference(const struct lives *a, const struct lives *b)
{
  double worst = 0;
  for (int l = 0; l < LANES; l++) {
    worst = fmax(worst, fabs(a->outcomes[l].loss - b->outcomes[l].loss));
    for (int i = 0; i < COM_FRAMES * 3; i++)
      worst = fmax(worst, fabs(a->com[l][i] - b->com[l][i]));
  }
  return worst;
}

/* Every kernel against the one reference of a body. */
static void compare_kernels(const struct mo_body *body, const struct mo_physics *physics,
                            int variant)
{
  static const int lanes[LANES] = {0, 4, 7};
  struct lives reference, lives;
  prepare_lives(&reference);
  for (int l = 0; l < LANES; l++)
    REQUIRE(mo_rollout_reference(body, controller, environments + lanes[l], physics,
                                 &reference.recordings[l], &reference.outcomes[l]) == 0);
  EACH_KERNEL(isa, precision)
  {
    prepare_lives(&lives);
    REQUIRE(run_block((enum mo_isa)isa, (enum mo_precision)precision, body, lanes, LANES, physics,
                      lives.recordings, lives.outcomes) == 0);
    const double worst = worst_difference(&lives, &reference);
    if (!(worst <= (precision == MO_FLOAT64 ? 1e-10 : 1e-3)))
      printf("# %s precision %d variant %d: %g\n", mo_isa_name((enum mo_isa)isa), precision,
             variant, worst);
    CHECK(worst <= (precision == MO_FLOAT64 ? 1e-10 : 1e-3));
  }
}

static void close_to_reference(void)
{
  REQUIRE(setup());
  struct mo_physics physics = mo_default_physics();
  physics.n_steps = 100;
  for (int variant = 0; variant < 4; variant++) {
    physics.impact = variant & 1 ? MO_IMPACT_BISECTION : MO_IMPACT_EXACT;
    controller->sensor = variant & 2 ? MO_SENSOR_INVERSE_SQUARE : MO_SENSOR_INVERSE_SQRT;
    for (uint64_t number = 0; number < 4; number++) {
      struct mo_body *body = body_number(number, 1 + 12 * (uint32_t)number);
      REQUIRE(body != NULL);
      compare_kernels(body, &physics, variant);
      mo_body_free(body);
    }
  }
  controller->sensor = MO_SENSOR_INVERSE_SQRT;
}

static void passive_bodies(void)
{
  REQUIRE(setup());
  struct mo_physics physics = mo_default_physics();
  physics.drop_height_m = 0.3;
  physics.n_steps = 60;
  EACH_KERNEL(isa, precision)
  {
    struct mo_pack *pack = NULL;
    struct mo_workspace_memory *memory = NULL;
    struct mo_body *body = body_number(5, 20);
    struct mo_outcome outcome, reference;
    const struct mo_environment *list[1] = {environments};
    REQUIRE(mo_pack_create(NULL, (enum mo_isa)isa, (enum mo_precision)precision, &pack) == MO_OK);
    REQUIRE(mo_workspace_memory_create(&memory) == MO_OK && body != NULL);
    REQUIRE(mo_rollout_block(memory, pack, body, list, 1, &physics, NULL, NULL, &outcome) == MO_OK);
    REQUIRE(mo_rollout_reference(body, NULL, environments, &physics, NULL, &reference) == MO_OK);
    const double tolerance = precision == MO_FLOAT64 ? 1e-11 : 1e-4;
    for (int axis = 0; axis < 3; axis++)
      CHECK_NEAR(outcome.com_end_m[axis], reference.com_end_m[axis], tolerance);
    CHECK_NEAR(outcome.loss, reference.loss, tolerance);
    CHECK(outcome.com_end_m[2] < outcome.com_start_m[2] - 0.05); /* it fell */
    mo_body_free(body);
    mo_workspace_memory_free(memory);
    mo_pack_free(pack);
  }
}

/* Stiff springs blow up in some environments sooner than in others: each lane ends by itself, at
 * the reference's step, and nothing that is not finite leaves the block. */
static void divergence_stays_in_its_lane(void)
{
  REQUIRE(setup());
  struct mo_physics physics = mo_default_physics();
  physics.n_steps = 400;
  physics.stiffness_n_per_m = 22500; /* the others follow later, or not at all */
  EACH_KERNEL(isa, precision)
  {
    struct mo_body *body = body_number(2, 60);
    REQUIRE(body != NULL);
    enum { N = MO_PAPER_TEST_COUNT, FRAMES = 41 };
    static double com[N][FRAMES * 3];
    static float mass[N][FRAMES * MO_DEFAULT_MASSES * 3];
    struct mo_outcome outcomes[N], alone;
    struct mo_recording recordings[N];
    int lanes[N], diverged = 0;
    for (int l = 0; l < N; l++) {
      lanes[l] = l;
      recordings[l] = (struct mo_recording){.stride = 10, .com_m = com[l], .mass_m = mass[l]};
    }
    REQUIRE(run_block((enum mo_isa)isa, (enum mo_precision)precision, body, lanes, N, &physics,
                      recordings, outcomes) == 0);
    for (int l = 0; l < N; l++) {
      diverged += outcomes[l].diverged_step > 0;
      CHECK(outcomes[l].diverged_step > 0 ? isinf(outcomes[l].loss) : isfinite(outcomes[l].loss));
      int wild = 0;
      for (int i = 0; i < FRAMES * 3; i++)
        wild += !isfinite(com[l][i]);
      for (uint32_t i = 0; i < FRAMES * body->n_masses * 3; i++)
        wild += !isfinite(mass[l][i]);
      for (int axis = 0; axis < 3; axis++)
        wild += !isfinite(outcomes[l].com_end_m[axis]);
      CHECK_INT(wild, 0);
      REQUIRE(run_block((enum mo_isa)isa, (enum mo_precision)precision, body, &l, 1, &physics, NULL,
                        &alone) == 0);
      CHECK(memcmp(&alone, &outcomes[l], sizeof(alone)) == 0);
      /* It stays where a life that ends a step earlier ends: at the last finite state. */
      struct mo_physics shorter = physics;
      shorter.n_steps = (uint32_t)outcomes[l].diverged_step - 1;
      if (outcomes[l].diverged_step <= 1)
        continue;
      REQUIRE(run_block((enum mo_isa)isa, (enum mo_precision)precision, body, &l, 1, &shorter, NULL,
                        &alone) == 0);
      CHECK_INT(alone.diverged_step, 0);
      CHECK(memcmp(alone.com_end_m, outcomes[l].com_end_m, sizeof(alone.com_end_m)) == 0);
      for (int frame = (outcomes[l].diverged_step + 9) / 10; frame < FRAMES; frame++)
        CHECK(memcmp(com[l] + 3 * (size_t)frame, alone.com_end_m, sizeof(alone.com_end_m)) == 0);
    }
    printf("# %s precision %d: %d of %d diverged, first at step %d\n",
           mo_isa_name((enum mo_isa)isa), precision, diverged, N, outcomes[0].diverged_step);
    CHECK(diverged > 0 && diverged < N);
    mo_body_free(body);
  }
}

/* Recorded masses stand on the terrain or above it, at every step of a controlled life. */
static void no_mass_below_the_terrain(void)
{
  REQUIRE(setup());
  struct mo_physics physics = mo_default_physics();
  physics.n_steps = 200;
  enum { N = MO_PAPER_TEST_COUNT };
  struct mo_body *body = body_number(4, 16);
  REQUIRE(body != NULL);
  float *mass = calloc((size_t)N * 201 * body->n_masses * 3, sizeof(float));
  REQUIRE(mass != NULL);
  EACH_KERNEL(isa, precision)
  {
    physics.impact = precision == MO_FLOAT64 ? MO_IMPACT_BISECTION : MO_IMPACT_EXACT;
    struct mo_recording recordings[N];
    struct mo_outcome outcomes[N];
    int lanes[N];
    for (int l = 0; l < N; l++) {
      lanes[l] = l;
      recordings[l] =
          (struct mo_recording){.stride = 1, .mass_m = mass + (size_t)l * 201 * body->n_masses * 3};
    }
    REQUIRE(run_block((enum mo_isa)isa, (enum mo_precision)precision, body, lanes, N, &physics,
                      recordings, outcomes) == 0);
    double deepest = 0;
    for (int l = 0; l < N; l++)
      for (size_t i = 0; i < 201 * (size_t)body->n_masses; i++) {
        const float *p = recordings[l].mass_m + 3 * i;
        deepest =
            fmax(deepest, mo_terrain_height(environments[l].terrain_heights_m, p[0], p[1]) - p[2]);
      }
    CHECK(deepest <= 1e-6); /* recordings are float32, whatever the precision of the life */
  }
  free(mass);
  mo_body_free(body);
}

/* Bodies far beyond the default workspace: a controlled one against the reference, and a passive
 * one of over a million springs. */
static void large_bodies(void)
{
  const struct mo_workspace middle = {14, 11, 9}, huge = {48, 48, 48};
  struct mo_environment environment;
  mo_environment_training(9, 0, 0, &environment);
  const struct mo_environment *list[2] = {&environment, &environment};
  struct mo_physics physics = mo_default_physics();
  physics.n_steps = 5;
  for (int large = 0; large < 2; large++) {
    const struct mo_workspace workspace = large ? huge : middle;
    struct mo_lattice *grid = NULL;
    struct mo_body *body = NULL;
    struct mo_controller *brain = NULL;
    struct mo_pack *pack = NULL;
    struct mo_workspace_memory *memory = NULL;
    struct mo_outcome outcomes[2], reference;
    uint64_t *bits = calloc(mo_workspace_words(workspace), sizeof(uint64_t));
    REQUIRE(bits != NULL && mo_lattice_create(workspace, &grid) == MO_OK);
    for (uint32_t v = 0; v < mo_workspace_voxels(workspace); v++)
      bits[v >> 6] |= UINT64_C(1) << (v & 63);
    REQUIRE(mo_body_create(grid, bits, &body) == MO_OK);
    CHECK(!large || body->n_springs > 1000000);
    if (!large) {
      REQUIRE(mo_controller_create(workspace, MO_SENSOR_INVERSE_SQRT, &brain) == MO_OK);
      mo_controller_randomize(brain, 1);
    }
    REQUIRE(mo_pack_create(brain, mo_isa_best(), MO_FLOAT32, &pack) == MO_OK);
    REQUIRE(mo_workspace_memory_create(&memory) == MO_OK);
    REQUIRE(mo_rollout_block(memory, pack, body, list, large ? 1 : 2, &physics, NULL, NULL,
                             outcomes) == MO_OK);
    REQUIRE(mo_rollout_reference(body, brain, &environment, &physics, NULL, &reference) == MO_OK);
    for (int axis = 0; axis < 3; axis++)
      CHECK_NEAR(outcomes[0].com_end_m[axis], reference.com_end_m[axis], 1e-5);
    CHECK(large || memcmp(&outcomes[0], &outcomes[1], sizeof(outcomes[0])) == 0);
    mo_workspace_memory_free(memory);
    mo_pack_free(pack);
    mo_controller_free(brain);
    mo_body_free(body);
    mo_lattice_free(grid);
    free(bits);
  }
}

static int stop_after_three(void *context)
{
  return ++*(int *)context == 3;
}

static void pauses_and_faults(void)
{
  REQUIRE(setup());
  struct mo_physics physics = mo_default_physics();
  physics.n_steps = 100;
  struct mo_pack *pack = NULL;
  struct mo_workspace_memory *memory = NULL;
  struct mo_body *body = body_number(3, 4);
  struct mo_outcome outcome;
  const struct mo_environment *list[1] = {environments};
  REQUIRE(mo_pack_create(controller, mo_isa_best(), MO_FLOAT32, &pack) == MO_OK);
  REQUIRE(mo_workspace_memory_create(&memory) == MO_OK && body != NULL);
  int calls = 0;
  struct mo_pause_point pause = {.interval = 10, .reached = stop_after_three, .context = &calls};
  CHECK_INT(mo_rollout_block(memory, pack, body, list, 1, &physics, NULL, &pause, &outcome),
            MO_ERR_CANCELLED);
  CHECK_INT(calls, 3);
  calls = 3;
  CHECK_INT(mo_rollout_block(memory, pack, body, list, 1, &physics, NULL, &pause, &outcome), MO_OK);
  CHECK_INT(calls, 13);
  CHECK_INT(mo_rollout_block(memory, pack, body, list, 0, &physics, NULL, NULL, &outcome),
            MO_ERR_RANGE);
  CHECK_INT(mo_rollout_block(memory, pack, body, list, MO_BLOCK_LANES + 1, &physics, NULL, NULL,
                             &outcome),
            MO_ERR_RANGE);
  struct mo_pack *other = NULL;
  CHECK_INT(mo_pack_create(controller, MO_ISA_COUNT, MO_FLOAT32, &other), MO_ERR_INVALID);
  struct mo_lattice *small = NULL;
  struct mo_body *voxel = NULL;
  const uint64_t one = 1;
  REQUIRE(mo_lattice_create((struct mo_workspace){2, 1, 1}, &small) == MO_OK &&
          mo_body_create(small, &one, &voxel) == MO_OK);
  CHECK_INT(mo_rollout_block(memory, pack, voxel, list, 1, &physics, NULL, NULL, &outcome),
            MO_ERR_INVALID);
  mo_body_free(voxel);
  mo_lattice_free(small);
  mo_body_free(body);
  mo_workspace_memory_free(memory);
  mo_pack_free(pack);
}

static void names(void)
{
  CHECK_TEXT(mo_isa_name(MO_ISA_BASELINE), "x86-64");
  CHECK_TEXT(mo_isa_name(MO_ISA_AVX512), "avx512");
  CHECK_TEXT(mo_isa_name(MO_ISA_COUNT), "unknown");
}

static const struct check_case cases[] = {
    {"names of instruction sets", names},
    {"tanh, float", tanh_float},
    {"tanh, double", tanh_double},
    {"sin and exp", sin_and_exp},
    {"products bit for bit", products},
    {"a lane's bits are its own", lanes_keep_to_themselves},
    {"close to the reference", close_to_reference},
    {"passive bodies", passive_bodies},
    {"divergence stays in its lane", divergence_stays_in_its_lane},
    {"no mass below the terrain", no_mass_below_the_terrain},
    {"large bodies", large_bodies},
    {"pauses and faults", pauses_and_faults},
};
CHECK_MAIN(cases)
