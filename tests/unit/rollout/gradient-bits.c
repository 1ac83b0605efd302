/* The bits of the fast gradient, like bits.c for scores: a training run that continues after an
 * upgrade must continue with the same weights, or its fingerprint must show that it does not. An
 * intended change of bits raises MO_GRADIENT_VERSION and copies the hashes that this test prints
 * into the table. */
#include "../make.h"
#include "compute/internal.h"

#include <inttypes.h>

#define HASHED_VERSION 5 /* the MO_GRADIENT_VERSION that the hashes belong to */

static const uint64_t gradient_hashes[MO_ISA_COUNT] = {
    UINT64_C(0xcd858264b49d2547), /* x86-64 */
    UINT64_C(0x5a9e711e8414f015), /* avx2 */
    UINT64_C(0x3d5b81bc9e63ba58), /* avx512 */
};

/* For rollouts in which rare kinds of contact are frequent. */
static const uint64_t rare_hashes[MO_ISA_COUNT] = {
    UINT64_C(0x2cad5ded0fb30d47), /* x86-64 */
    UINT64_C(0x4809bdfc431286f4), /* avx2 */
    UINT64_C(0x034c79c12f1c6c00), /* avx512 */
};

enum { ROBOTS = MO_GRADIENT_ROBOTS, STEPS = 120, BLOCKS = 4 };

static struct mo_robot *robots;

/* The full lattice, one voxel, random bodies; one light inside its robot. */
static void setup(void)
{
  const struct mo_lattice *lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  uint64_t bits[MO_DEFAULT_WORDS] = {1};
  robots = make_robots(lattice, 41, 41, ROBOTS);
  for (uint32_t i = ROBOTS - 1; i >= 2; i--) /* the stream's first body is the third */
    robots[i].body = robots[i - 2].body;
  robots[0].body = make_full_body(lattice);
  mo_genotype_place(MO_DEFAULT_WORKSPACE, bits);
  robots[1].body = make_body(lattice, bits);
  struct mo_environment *beside = make_zeros(1, sizeof(*beside));
  *beside = *robots[2].environment;
  beside->light_xy_m[0] = beside->light_xy_m[1] = MO_WORLD_CENTER_M;
  robots[2].environment = beside;
}

/* Returns a hash of the gradient of n robots with a random controller. */
static void run(enum mo_isa isa, enum mo_sensor sensor, uint64_t seed, const struct mo_robot *own,
                uint32_t n, const struct mo_physics *physics, double bound, uint64_t *h,
                struct mo_outcome *outcomes, struct mo_gradient_counts *counts)
{
  const size_t kept = check_n_kept;
  const struct mo_gradient_options options = {.adjoint_bound = bound, .weight = 1.0 / n};
  struct mo_controller *controller = make_random_controller(sensor, seed);
  float *gradient = make_zeros(controller->n_parameters, sizeof(float));
  CHECK_INT(mo_gradient_block(make_gradient_memory(MO_GRADIENT_DEFAULT_BYTES),
                              make_gradient_pack(controller, isa), own, n, physics, &options, NULL,
                              outcomes, gradient, counts),
            MO_OK);
  hash(h, gradient, controller->n_parameters * sizeof(float));
  check_drop_to(kept);
}

/* Both sensors, both impact modes, with and without a bound, whole and partial blocks, and one in
 * which robots diverge. */
static void run_block(enum mo_isa isa, int block, uint64_t *h, struct mo_gradient_counts *counts)
{
  struct mo_outcome outcomes[ROBOTS];
  const uint32_t n = block == 1 ? 7 : ROBOTS;
  struct mo_physics physics = physics_of(STEPS);
  physics.scheme.impact = block % 2 == 1 ? MO_IMPACT_BISECTION : MO_IMPACT_EXACT;
  if (block == 3)
    physics.constants.stiffness_n_per_m = 25000; /* unstable for large bodies */
  run(isa, block < 2 ? MO_SENSOR_INVERSE_SQRT : MO_SENSOR_INVERSE_SQUARE, 41 + (uint64_t)block,
      robots, n, &physics, block == 2 ? 0 : MO_ADJOINT_BOUND, h, outcomes, counts);
  for (uint32_t i = 0; i < n; i++) {
    const float loss =
        (float)outcomes[i].loss; /* as when its last bits depended on the C library */
    hash(h, &loss, sizeof(loss));
    hash(h, &outcomes[i].diverged_step, sizeof(outcomes[i].diverged_step));
    hash(h, outcomes[i].com_start_m, sizeof(outcomes[i].com_start_m));
    hash(h, outcomes[i].com_end_m, sizeof(outcomes[i].com_end_m));
  }
}

static void gradients(void)
{
  CHECK_INT(MO_GRADIENT_VERSION, HASHED_VERSION);
  for (int isa = 0; isa < MO_ISA_COUNT; isa++) {
    if (isa > (int)mo_isa_best()) {
      printf("# %s: not supported by this processor\n", mo_isa_name((enum mo_isa)isa));
      continue;
    }
    uint64_t h = FNV_START;
    struct mo_gradient_counts counts = {0};
    for (int block = 0; block < BLOCKS; block++)
      run_block((enum mo_isa)isa, block, &h, &counts);
    if (h != gradient_hashes[isa])
      printf("# %s: the bits hash to 0x%016" PRIx64 ", version %d had 0x%016" PRIx64 "\n",
             mo_isa_name((enum mo_isa)isa), h, HASHED_VERSION, gradient_hashes[isa]);
    CHECK(h == gradient_hashes[isa]);
    CHECK(counts.diverged_robots > 0 && counts.diverged_robots < ROBOTS &&
          counts.clipped_steps > 0);
  }
}

/* Robots slide down a rough mountain side, and across the edges of many cells: down slopes that
 * bend, into pits, up and over ridges. Case 1 starts with a fall from 10 m; case 2 crosses roofs
 * with a ridge or a valley along every edge. Returns how many do not diverge. */
static uint32_t run_rare(enum mo_isa isa, int life, uint64_t *h)
{
  enum { N = 12 };
  struct mo_outcome outcomes[N];
  struct mo_environment steep[N];
  struct mo_robot own[N];
  struct mo_gradient_counts counts = {0};
  struct mo_physics physics = physics_of(life == 1 ? 420 : 200);
  uint32_t n_finite = 0;
  physics.drop_height_m = life == 1 ? 10 : 0;
  physics.constants.drag_per_s = 0.5;
  physics.constants.friction = 0.3;
  for (uint32_t i = 0; i < N; i++) {
    steep[i] = *robots[i].environment;
    mo_terrain_random(41, 9, i, life == 2 ? 0.05 : 0.4, steep[i].terrain_heights_m);
    for (int j = 0; j < MO_TERRAIN_HEIGHTS; j++) {
      const int x = j % MO_TERRAIN_SIDE, y = j / MO_TERRAIN_SIDE;
      steep[i].terrain_heights_m[j] += (i % 2 == 0 ? x : MO_TERRAIN_SIDE - x) * 0.8 + y * 0.4;
      steep[i].terrain_heights_m[j] += life == 2 ? 0.3 * ((x + y + (int)i) % 2) : 0;
    }
    own[i] = (struct mo_robot){robots[i].body, &steep[i]};
  }
  run(isa, MO_SENSOR_INVERSE_SQRT, 51, own, N, &physics, MO_ADJOINT_BOUND, h, outcomes, &counts);
  hash(h, &counts.clipped_steps, sizeof(counts.clipped_steps));
  for (uint32_t i = 0; i < N; i++) {
    hash(h, &outcomes[i].loss, sizeof(outcomes[i].loss));
    hash(h, outcomes[i].com_end_m, sizeof(outcomes[i].com_end_m));
    n_finite += outcomes[i].diverged_step == 0;
  }
  return n_finite;
}

static void rare_contacts(void)
{
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    uint64_t h = FNV_START;
    uint32_t n_finite = 0;
    for (int life = 0; life < 3; life++)
      n_finite += run_rare((enum mo_isa)isa, life, &h);
    printf("# %s: %u of 36 rollouts did not diverge; the bits hash to 0x%016" PRIx64 "\n",
           mo_isa_name((enum mo_isa)isa), n_finite, h);
    CHECK(h == rare_hashes[isa]);
    CHECK(n_finite >= 24);
  }
}

static const struct check_case cases[] = {
    {"the gradient's bits have not changed", gradients},
    {"the bits of rare contacts have not changed", rare_contacts},
};
CHECK_MAIN_WITH(setup, cases)
