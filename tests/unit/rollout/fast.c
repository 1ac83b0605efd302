/* The fast path: its parts compared with plain arithmetic, its bits with each other, its results
 * with the reference. */
#include "probe.h"

static struct mo_controller *controller;
static struct mo_lattice *lattice;
static struct mo_environment environments[MO_PAPER_TEST_COUNT];

static void setup(void)
{
  mo_environment_paper_test(environments);
  lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  controller = make_shipped_controller("bootstrap");
}

/* Returns a body of about `size` voxels, always the same for the same number. */
static struct mo_body *body_number(uint64_t number, uint32_t size)
{
  const struct mo_workspace workspace = MO_DEFAULT_WORKSPACE;
  uint64_t bits[MO_DEFAULT_WORDS];
  struct mo_random random = dice(11, size, number);
  do {
    memset(bits, 0, sizeof(bits));
    for (uint32_t v = 0; v < MO_DEFAULT_VOXELS; v++)
      if (mo_random_below(&random, MO_DEFAULT_VOXELS) < 36 + size / 2)
        bits[v >> 6] |= UINT64_C(1) << (v & 63);
    mo_genotype_keep_largest(workspace, bits);
  } while (mo_genotype_count(workspace, bits) < size);
  mo_genotype_place(workspace, bits);
  return make_body(lattice, bits);
}

/* Each of n lanes in its environment. */
static void run_block(int isa, int precision, const struct mo_body *body, const int *lanes,
                      uint32_t n, const struct mo_physics *physics,
                      const struct mo_recording *recordings, struct mo_outcome *outcomes)
{
  const size_t kept = check_n_kept;
  const struct mo_environment *list[MO_BLOCK_LANES];
  for (uint32_t l = 0; l < n; l++)
    list[l] = environments + lanes[l] % MO_PAPER_TEST_COUNT;
  make_check(mo_rollout_block(make_workspace_memory(),
                              make_pack(controller, (enum mo_isa)isa, (enum mo_precision)precision),
                              body, list, n, physics, recordings, NULL, NULL, outcomes),
             "rollouts");
  check_drop_to(kept);
}

/* The address sanitizer sees the same code, contacts included, in fewer steps. */
#ifdef __SANITIZE_ADDRESS__
enum { STEPS = 60 };
#else
enum { STEPS = 100 };
#endif

#define EACH_KERNEL(isa, precision)                                                                \
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++)                                              \
    for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++)

/* ---- parts ---- */

/* Returns the worst error of tanh over n numbers whose highest bits are `high`, in units of the
 * last place: both signs, mantissas spread over all bits. Infinite if a result is beyond ±1 or has
 * the wrong sign. */
static double tanh_error(int isa, enum mo_precision precision, uint64_t high, uint32_t n)
{
  static double x[1 << 14] __attribute__((aligned(64))), y[1 << 14] __attribute__((aligned(64)));
  const bool wide = precision == MO_FLOAT64;
  double worst = 0;
  for (uint32_t i = 0; i < n; i++)
    if (wide) {
      const uint64_t bits =
          high << 52 | (i * UINT64_C(0x9e3779b97f4a7c15)) >> 12 | (uint64_t)i << 63;
      memcpy(x + i, &bits, sizeof(bits));
    } else {
      const uint32_t bits = (uint32_t)high << 23 | ((i * 2654435761u) & 0x7fffff) | i << 31;
      memcpy((float *)x + i, &bits, sizeof(bits));
    }
  memcpy(y, x, sizeof(y));
  run_probe((enum mo_isa)isa, precision, (struct probe){.tanh_values = y, .n_tanh = n});
  for (uint32_t i = 0; i < n; i++) {
    const double from = get_real(precision, x, i), got = get_real(precision, y, i);
    const long double exact = tanhl((long double)from);
    const double spacing =
        exact == 0
            ? (wide ? 0x1p-1074 : 0x1p-149)
            : ldexp(1.0, (int)fmax(ilogb((double)exact), wide ? -1022 : -126) - (wide ? 52 : 23));
    const double error = (double)(fabsl((long double)got - exact) / (long double)spacing);
    if (!(fabs(got) <= 1) || (!isnan(from) && signbit(got) != signbit(from)))
      worst = INFINITY;
    else if (!isnan(from))
      worst = fmax(worst, error);
  }
  return worst;
}

static void tanh_of_every_exponent(void)
{
  enum { FEWER = CHECK_SANITIZED ? 64 : 1 }; /* numbers of an exponent */
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    double worst[2] = {0, 0};
    for (uint64_t high = 0; high < 256; high++)
      worst[0] = fmax(worst[0], tanh_error(isa, MO_FLOAT32, high, (1 << 14) / FEWER));
    for (uint64_t high = 0; high < 2048; high++)
      worst[1] = fmax(worst[1], tanh_error(isa, MO_FLOAT64, high, (1 << 12) / FEWER));
    printf("# %s: tanh within %.2f ulp in float, %.2f in double\n", mo_isa_name((enum mo_isa)isa),
           worst[0], worst[1]);
    CHECK(worst[0] <= 3);
    CHECK(worst[1] <= 3);
  }
}

static void sin_and_exp(void)
{
  for (int i = 0; i < 200000; i++) {
    const double x = (i - 1000) * 0.37719;
    CHECK_NEAR(mo_fast_sin(x), sin(x), 5e-16);
    const double e = -i * 0.0035;
    CHECK_NEAR(mo_fast_exp(e) / exp(e), 1.0, 5e-16);
    const double far = exp(e), near = 1 + x * 1e-5;
    CHECK_NEAR(mo_fast_log(far), log(far), 5e-16 * fabs(e));
    if (near > 0)
      CHECK_NEAR(mo_fast_log(near), log(near), 5e-16 * fabs(log(near)));
  }
  CHECK(mo_fast_exp(-800.0) == 0.0);
}

/* The product of every tile height compared with the same sum written plainly: k ascending, one
 * fused operation per term if the instruction set has it, so the bits must agree. */
static void products(void)
{
  enum { K = 83, ROWS = MO_BLOCK_LANES };
  static double x[ROWS * K], w[K * PANEL_MAX], init[PANEL_MAX];
  struct mo_random random = dice(3, 0, 0);
  for (int i = 0; i < ROWS * K; i++)
    x[i] = (float)(mo_random_uniform(&random) - 0.5);
  for (int i = 0; i < K * PANEL_MAX; i++)
    w[i] = (float)(mo_random_uniform(&random) - 0.5);
  for (int i = 0; i < PANEL_MAX; i++)
    init[i] = (float)mo_random_uniform(&random);
  EACH_KERNEL(isa, precision)
  {
    const uint32_t panel = panel_of((enum mo_isa)isa, (enum mo_precision)precision);
    for (uint32_t rows = 1; rows <= ROWS; rows++) {
      const void *c =
          run_product((enum mo_isa)isa, (enum mo_precision)precision, rows, K, panel, x, w, init);
      int wrong = 0;
      for (uint32_t i = 0; i < rows * panel; i++) {
        const double *row = x + i / panel * K, *column = w + i % panel;
        double sum = init[i % panel];
        float narrow = (float)sum;
        for (uint32_t k = 0; k < K; k++) {
          const double a = row[k], b = column[k * panel];
          sum = isa == MO_ISA_BASELINE ? sum + a * b : fma(a, b, sum);
          narrow = isa == MO_ISA_BASELINE ? narrow + (float)a * (float)b
                                          : fmaf((float)a, (float)b, narrow);
        }
        wrong += get_real((enum mo_precision)precision, c, i) !=
                 (precision == MO_FLOAT64 ? sum : (double)narrow);
      }
      CHECK_INT(wrong, 0);
    }
  }
}

/* ---- bits ---- */

enum { PATH_FRAMES = 7 };

/* What a lane records; the remaining entries stay 0. */
struct path {
  float mass_m[PATH_FRAMES * MO_DEFAULT_MASSES * 3];
  int8_t actuation[PATH_FRAMES * MO_DEFAULT_SPRINGS];
  uint8_t contacts[PATH_FRAMES * MO_DEFAULT_MASSES];
};

static struct mo_recording recording_of(struct path *path, uint32_t stride)
{
  return (struct mo_recording){.stride = stride,
                               .mass_m = path->mass_m,
                               .actuation = path->actuation,
                               .contacts = path->contacts};
}

/* A lane by itself, and among others at every position, in any mixture: the same outcome and the
 * same path, bit for bit. */
static void lanes_keep_to_themselves(void)
{
  struct mo_physics physics = physics_of(STEPS * 3 / 2);
  enum { STRIDE = STEPS / 4 };
  EACH_KERNEL(isa, precision)
  for (int variant = 0; variant < 4; variant++) {
    physics.scheme.impact = variant == 1 ? MO_IMPACT_BISECTION : MO_IMPACT_EXACT;
    physics.scheme.control_period_s = variant == 2 ? 4 * physics.scheme.dt_s : 0;
    physics.scheme.integrator = variant == 3 ? MO_INTEGRATOR_SPLIT : MO_INTEGRATOR_PAPER;
    struct mo_body *body = body_number(1, 10);
    struct mo_outcome alone[MO_PAPER_TEST_COUNT], outcomes[MO_BLOCK_LANES];
    static struct path paths[MO_PAPER_TEST_COUNT], path[MO_BLOCK_LANES];
    for (int e = 0; e < MO_PAPER_TEST_COUNT; e++) {
      const struct mo_recording recording = recording_of(&paths[e], STRIDE);
      run_block(isa, precision, body, &e, 1, &physics, &recording, &alone[e]);
    }
    for (uint32_t n = 2; n <= MO_BLOCK_LANES; n += n < 5 ? 1 : n < 8 ? 3 : 4) {
      int lanes[MO_BLOCK_LANES];
      struct mo_recording recordings[MO_BLOCK_LANES];
      for (uint32_t l = 0; l < n; l++) {
        lanes[l] = (int)(l * 3 + n) % MO_PAPER_TEST_COUNT;
        recordings[l] = recording_of(&path[l], STRIDE);
      }
      run_block(isa, precision, body, lanes, n, &physics, recordings, outcomes);
      for (uint32_t l = 0; l < n; l++) {
        CHECK(memcmp(&outcomes[l], &alone[lanes[l]], sizeof(outcomes[l])) == 0);
        CHECK(memcmp(&path[l], &paths[lanes[l]], sizeof(path[l])) == 0);
      }
    }
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
    lives->recordings[l] = (struct mo_recording){.stride = STEPS / 4, .com_m = lives->com[l]};
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

/* Every kernel compared with the same reference. */
static void compare_kernels(const struct mo_body *body, const struct mo_physics *physics,
                            int variant)
{
  static const int lanes[LANES] = {0, 4, 7};
  struct lives reference, lives;
  prepare_lives(&reference);
  for (int l = 0; l < LANES; l++)
    REQUIRE(mo_rollout_reference(body, controller, environments + lanes[l], physics,
                                 &reference.recordings[l], NULL, &reference.outcomes[l]) == 0);
  EACH_KERNEL(isa, precision)
  {
    prepare_lives(&lives);
    run_block(isa, precision, body, lanes, LANES, physics, lives.recordings, lives.outcomes);
    const double worst = worst_difference(&lives, &reference);
    if (!(worst <= (precision == MO_FLOAT64 ? 1e-10 : 1e-3)))
      printf("# %s precision %d variant %d: %g\n", mo_isa_name((enum mo_isa)isa), precision,
             variant, worst);
    CHECK(worst <= (precision == MO_FLOAT64 ? 1e-10 : 1e-3));
  }
}

static void close_to_reference(void)
{
  struct mo_physics physics = physics_of(STEPS);
  static const uint32_t held[] = {1, 4, 7, 200};
  for (int variant = 0; variant < 16; variant++) {
    physics.scheme.impact = variant & 1 ? MO_IMPACT_BISECTION : MO_IMPACT_EXACT;
    physics.scheme.control_period_s =
        variant % 8 < 4 ? 0 : held[variant % 8 - 4] * physics.scheme.dt_s;
    physics.scheme.integrator = variant < 8 ? MO_INTEGRATOR_PAPER : MO_INTEGRATOR_SPLIT;
    controller->sensor = variant & 2 ? MO_SENSOR_INVERSE_SQUARE : MO_SENSOR_INVERSE_SQRT;
    for (uint64_t number = 0; number < 4; number++) {
      struct mo_body *body = body_number(number, 1 + 12 * (uint32_t)number);
      compare_kernels(body, &physics, variant);
    }
  }
  controller->sensor = MO_SENSOR_INVERSE_SQRT;
}

/* Contact of `split` where its constants are extreme. */
static void close_at_the_bounds(void)
{
  static const struct {
    double dt_s, drag_per_s, friction, friction_cap;
  } cases[] = {{0.004, 250, 0.9, 0.95}, {0.004, 15, 0, 0.95}, {0.004, 15, 0.9, 0},
               {0.004, 15, 0.9, 1},     {0.0005, 0, 2, 0.95}, {0.001, 1e-6, 0.5, 0.5}};
  for (size_t i = 0; i < COUNT(cases); i++) {
    struct mo_physics physics = physics_of(STEPS);
    physics.scheme.integrator = MO_INTEGRATOR_SPLIT;
    physics.scheme.dt_s = cases[i].dt_s;
    physics.constants.drag_per_s = cases[i].drag_per_s;
    physics.constants.friction = cases[i].friction;
    physics.constants.friction_cap = cases[i].friction_cap;
    REQUIRE_OK(mo_physics_check(&physics, NULL));
    for (uint64_t number = 0; number < 2; number++)
      compare_kernels(body_number(number, 1 + 20 * (uint32_t)number), &physics, 100 + (int)i);
  }
}

/* ---- channels ---- */

enum { CHANNEL_FRAMES = 21, CHANNEL_STRIDE = 5 };

static void make_recordings(struct mo_recording *recordings, int n, const struct mo_body *body)
{
  for (int l = 0; l < n; l++)
    REQUIRE(mo_recording_create(&recordings[l], (1U << MO_CHANNELS) - 1, CHANNEL_STRIDE,
                                CHANNEL_FRAMES, body->n_masses, body->n_springs) == MO_OK);
}

static void free_recordings(struct mo_recording *recordings, int n)
{
  for (int l = 0; l < n; l++)
    mo_recording_free(&recordings[l]);
}

/* Compares actuation and contacts of one lane with the reference's. Counts the reference's
 * contacts. */
static void compare_channels(const struct mo_body *body, const struct mo_recording *a,
                             const struct mo_recording *b, int precision, uint32_t *contacts)
{
  uint32_t differ = 0;
  int worst = 0;
  for (size_t i = 0; i < (size_t)CHANNEL_FRAMES * body->n_springs; i++) {
    const int apart = abs(a->actuation[i] - b->actuation[i]);
    worst = apart > worst ? apart : worst;
  }
  for (size_t i = 0; i < (size_t)CHANNEL_FRAMES * body->n_masses; i++) {
    differ += a->contacts[i] != b->contacts[i];
    *contacts += b->contacts[i];
    CHECK(a->contacts[i] <= 1);
  }
  CHECK(worst <= 1); /* in units of 1/127: where an output lies between two numbers */
  CHECK(precision == MO_FLOAT64 ? differ == 0 : differ <= 1 + CHANNEL_FRAMES * body->n_masses / 50);
}

static void channels_agree(void)
{
  struct mo_physics physics = physics_of((CHANNEL_FRAMES - 1) * CHANNEL_STRIDE);
  static const int lanes[LANES] = {0, 4, 7};
  for (uint64_t number = 0; number < 4; number++) {
    physics.scheme.control_period_s = number == 3 ? 8 * physics.scheme.dt_s : 0;
    physics.scheme.integrator = number > 1 ? MO_INTEGRATOR_SPLIT : MO_INTEGRATOR_PAPER;
    struct mo_body *body = body_number(number, 1 + 20 * (uint32_t)number);
    struct mo_recording reference[LANES], recordings[LANES];
    struct mo_outcome outcomes[LANES];
    make_recordings(reference, LANES, body);
    for (int l = 0; l < LANES; l++)
      REQUIRE(mo_rollout_reference(body, controller, environments + lanes[l], &physics,
                                   &reference[l], NULL, &outcomes[l]) == MO_OK);
    EACH_KERNEL(isa, precision)
    {
      uint32_t contacts = 0, moved = 0;
      make_recordings(recordings, LANES, body);
      memset(recordings[0].actuation, 99, body->n_springs); /* the first frame is also written */
      memset(recordings[0].contacts, 99, body->n_masses);
      run_block(isa, precision, body, lanes, LANES, &physics, recordings, outcomes);
      for (int l = 0; l < LANES; l++) {
        compare_channels(body, &recordings[l], &reference[l], precision, &contacts);
        for (uint32_t s = 0; s < body->n_springs; s++) {
          CHECK_INT(recordings[l].actuation[s], 0);
          moved += recordings[l].actuation[body->n_springs + s] != 0;
        }
        for (uint32_t m = 0; m < body->n_masses; m++)
          CHECK_INT(recordings[l].contacts[m], 0);
      }
      CHECK(contacts > 0 && contacts < LANES * CHANNEL_FRAMES * body->n_masses);
      CHECK(moved > LANES * body->n_springs / 2);
      free_recordings(recordings, LANES);
    }
    free_recordings(reference, LANES);
  }
}

/* A passive body that falls: no actuation, and every mass in contact lies on the terrain. */
static void contacts_of_a_fall(void)
{
  struct mo_physics physics = physics_of((CHANNEL_FRAMES - 1) * CHANNEL_STRIDE);
  const struct mo_environment *list[1] = {environments};
  struct mo_body *body = body_number(5, 20);
  physics.drop_height_m = 0.1;
  EACH_KERNEL(isa, precision)
  {
    struct mo_pack *pack = make_pack(NULL, (enum mo_isa)isa, (enum mo_precision)precision);
    struct mo_workspace_memory *memory = make_workspace_memory();
    struct mo_recording recording;
    struct mo_outcome outcome;
    uint32_t touched = 0;
    make_recordings(&recording, 1, body);
    memset(recording.actuation, 99, (size_t)CHANNEL_FRAMES * body->n_springs);
    REQUIRE(mo_rollout_block(memory, pack, body, list, 1, &physics, &recording, NULL, NULL,
                             &outcome) == MO_OK);
    for (size_t i = 0; i < (size_t)CHANNEL_FRAMES * body->n_springs; i++)
      CHECK_INT(recording.actuation[i], 0);
    for (size_t i = 0; i < (size_t)CHANNEL_FRAMES * body->n_masses; i++) {
      const float *p = recording.mass_m + 3 * i;
      touched += recording.contacts[i];
      CHECK(!recording.contacts[i] ||
            p[2] - mo_terrain_height(&environments[0], p[0], p[1]) < 0.005);
    }
    for (uint32_t m = 0; m < body->n_masses; m++)
      CHECK_INT(recording.contacts[4 * (size_t)body->n_masses + m],
                0); /* after 0.08 s: in the air */
    CHECK(touched > 0);
    mo_recording_free(&recording);
  }
}

static void passive_bodies(void)
{
  struct mo_physics physics = physics_of(60);
  physics.drop_height_m = 0.3;
  EACH_KERNEL(isa, precision)
  {
    struct mo_body *body = body_number(5, 20);
    struct mo_outcome outcome, reference;
    const struct mo_environment *list[1] = {environments};
    struct mo_pack *pack = make_pack(NULL, (enum mo_isa)isa, (enum mo_precision)precision);
    struct mo_workspace_memory *memory = make_workspace_memory();
    REQUIRE(mo_rollout_block(memory, pack, body, list, 1, &physics, NULL, NULL, NULL, &outcome) ==
            MO_OK);
    REQUIRE(mo_rollout_reference(body, NULL, environments, &physics, NULL, NULL, &reference) ==
            MO_OK);
    const double tolerance = precision == MO_FLOAT64 ? 1e-11 : 1e-4;
    for (int axis = 0; axis < 3; axis++)
      CHECK_NEAR(outcome.com_end_m[axis], reference.com_end_m[axis], tolerance);
    CHECK_NEAR(outcome.loss, reference.loss, tolerance);
    CHECK(outcome.com_end_m[2] < outcome.com_start_m[2] - 0.05); /* it fell */
  }
}

/* Stiff springs blow up in some environments sooner than in others. Each lane ends independently,
 * at the reference's step, and non-finite values never leave the block. */
static void divergence_stays_in_its_lane(void)
{
  struct mo_physics physics = physics_of(400);
  physics.constants.stiffness_n_per_m = 22500; /* the others follow later, or not at all */
  EACH_KERNEL(isa, precision)
  {
    struct mo_body *body = body_number(2, 60);
    enum { N = MO_PAPER_TEST_COUNT, FRAMES = 41 };
    static double com[N][FRAMES * 3];
    static float mass[N][FRAMES * MO_DEFAULT_MASSES * 3];
    static int8_t actuation[N][FRAMES * MO_DEFAULT_SPRINGS];
    static uint8_t contacts[N][FRAMES * MO_DEFAULT_MASSES];
    struct mo_outcome outcomes[N], alone;
    struct mo_recording recordings[N];
    int lanes[N], diverged = 0;
    for (int l = 0; l < N; l++) {
      lanes[l] = l;
      recordings[l] = (struct mo_recording){10, com[l], mass[l], actuation[l], contacts[l]};
    }
    run_block(isa, precision, body, lanes, N, &physics, recordings, outcomes);
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
      run_block(isa, precision, body, &l, 1, &physics, NULL, &alone);
      CHECK(SAME(&alone, &outcomes[l], 1));
      /* It stops where a rollout that is a step shorter ends: at the last finite state. */
      struct mo_physics shorter = physics;
      shorter.scheme.n_steps = (uint32_t)outcomes[l].diverged_step - 1;
      if (outcomes[l].diverged_step <= 1)
        continue;
      run_block(isa, precision, body, &l, 1, &shorter, NULL, &alone);
      CHECK_INT(alone.diverged_step, 0);
      CHECK(SAME(alone.com_end_m, outcomes[l].com_end_m, 3));
      for (int frame = (outcomes[l].diverged_step + 9) / 10; frame < FRAMES; frame++) {
        int acts = 0;
        CHECK(SAME(com[l] + 3 * (size_t)frame, alone.com_end_m, 3));
        for (uint32_t s = 0; s < body->n_springs; s++)
          acts += actuation[l][frame * body->n_springs + s] != 0;
        for (uint32_t m = 0; m < body->n_masses; m++)
          acts += contacts[l][frame * body->n_masses + m] != 0;
        CHECK_INT(acts, 0);
      }
    }
    printf("# %s precision %d: %d of %d diverged, first at step %d\n",
           mo_isa_name((enum mo_isa)isa), precision, diverged, N, outcomes[0].diverged_step);
    CHECK(diverged > 0 && diverged < N);
  }
}

/* Recorded masses are on the terrain or above it, at every step of a controlled rollout. */
static void no_mass_below_the_terrain(void)
{
  struct mo_physics physics = physics_of(200);
  enum { N = MO_PAPER_TEST_COUNT };
  struct mo_body *body = body_number(4, 16);
  float *mass = make_zeros((size_t)N * 201 * body->n_masses * 3, sizeof(float));
  EACH_KERNEL(isa, precision)
  {
    physics.scheme.impact = precision == MO_FLOAT64 ? MO_IMPACT_BISECTION : MO_IMPACT_EXACT;
    struct mo_recording recordings[N];
    struct mo_outcome outcomes[N];
    int lanes[N];
    for (int l = 0; l < N; l++) {
      lanes[l] = l;
      recordings[l] =
          (struct mo_recording){.stride = 1, .mass_m = mass + (size_t)l * 201 * body->n_masses * 3};
    }
    run_block(isa, precision, body, lanes, N, &physics, recordings, outcomes);
    double deepest = 0;
    for (int l = 0; l < N; l++)
      for (size_t i = 0; i < 201 * (size_t)body->n_masses; i++) {
        const float *p = recordings[l].mass_m + 3 * i;
        deepest = fmax(deepest, mo_terrain_height(&environments[l], p[0], p[1]) - p[2]);
      }
    CHECK(deepest <= 1e-6); /* recordings are float32, whatever the precision of the rollout */
  }
}

/* Bodies far beyond the default workspace: a controlled one compared with the reference, and a
 * passive one with over a million springs. */
static void large_bodies(void)
{
  const struct mo_workspace middle = {14, 11, 9}, huge = {48, 48, 48};
  struct mo_environment environment;
  mo_environment_training(9, 0, 0, &environment);
  const struct mo_environment *list[2] = {&environment, &environment};
  struct mo_physics physics = physics_of(5);
  for (int large = 0; large < 2; large++) {
    const struct mo_workspace workspace = large ? huge : middle;
    const struct mo_body *body = make_full_body(make_lattice(workspace));
    struct mo_controller *brain = large ? NULL : make_controller(workspace, MO_SENSOR_INVERSE_SQRT);
    struct mo_outcome outcomes[2], reference;
    CHECK(!large || body->n_springs > 1000000);
    if (!large)
      mo_controller_randomize(brain, 1);
    struct mo_pack *pack = make_pack(brain, mo_isa_best(), MO_FLOAT32);
    struct mo_workspace_memory *memory = make_workspace_memory();
    REQUIRE(mo_rollout_block(memory, pack, body, list, large ? 1 : 2, &physics, NULL, NULL, NULL,
                             outcomes) == MO_OK);
    REQUIRE(mo_rollout_reference(body, brain, &environment, &physics, NULL, NULL, &reference) ==
            MO_OK);
    for (int axis = 0; axis < 3; axis++)
      CHECK_NEAR(outcomes[0].com_end_m[axis], reference.com_end_m[axis], 1e-5);
    CHECK(large || memcmp(&outcomes[0], &outcomes[1], sizeof(outcomes[0])) == 0);
  }
}

static int stop_after_three(void *context)
{
  return ++*(int *)context == 3;
}

static void pauses_and_faults(void)
{
  struct mo_physics physics = physics_of(100);
  struct mo_body *body = body_number(3, 4);
  struct mo_outcome outcome;
  const struct mo_environment *list[1] = {environments};
  struct mo_pack *pack = make_pack(controller, mo_isa_best(), MO_FLOAT32);
  struct mo_workspace_memory *memory = make_workspace_memory();
  int calls = 0;
  struct mo_pause_point pause = {.interval = 10, .reached = stop_after_three, .context = &calls};
  CHECK_INT(mo_rollout_block(memory, pack, body, list, 1, &physics, NULL, NULL, &pause, &outcome),
            MO_ERR_CANCELLED);
  CHECK_INT(calls, 3);
  calls = 3;
  CHECK_INT(mo_rollout_block(memory, pack, body, list, 1, &physics, NULL, NULL, &pause, &outcome),
            MO_OK);
  CHECK_INT(calls, 13);
  CHECK_INT(mo_rollout_block(memory, pack, body, list, 0, &physics, NULL, NULL, NULL, &outcome),
            MO_ERR_RANGE);
  CHECK_INT(mo_rollout_block(memory, pack, body, list, MO_BLOCK_LANES + 1, &physics, NULL, NULL,
                             NULL, &outcome),
            MO_ERR_RANGE);
  struct mo_pack *other = NULL;
  CHECK_INT(mo_pack_create(controller, MO_ISA_COUNT, MO_FLOAT32, &other), MO_ERR_INVALID);
  const uint64_t one = 1;
  struct mo_lattice *small = make_lattice((struct mo_workspace){2, 1, 1});
  struct mo_body *voxel = make_body(small, &one);
  CHECK_INT(mo_rollout_block(memory, pack, voxel, list, 1, &physics, NULL, NULL, NULL, &outcome),
            MO_ERR_INVALID);
}

static void names(void)
{
  CHECK_TEXT(mo_isa_name(MO_ISA_BASELINE), "x86-64");
  CHECK_TEXT(mo_isa_name(MO_ISA_AVX512), "avx512");
  CHECK_TEXT(mo_isa_name(MO_ISA_COUNT), "unknown");
}

static const struct check_case cases[] = {
    {"names of instruction sets", names},
    {"tanh", tanh_of_every_exponent},
    {"sin, exp and log", sin_and_exp},
    {"products bit for bit", products},
    {"a lane's bits do not depend on other lanes", lanes_keep_to_themselves},
    {"close to the reference", close_to_reference},
    {"split at the bounds of its constants", close_at_the_bounds},
    {"actuation and contacts agree with the reference", channels_agree},
    {"contacts of a fall", contacts_of_a_fall},
    {"passive bodies", passive_bodies},
    {"divergence stays in its lane", divergence_stays_in_its_lane},
    {"no mass below the terrain", no_mass_below_the_terrain},
    {"large bodies", large_bodies},
    {"pauses and faults", pauses_and_faults},
};
CHECK_MAIN_WITH(setup, cases)
