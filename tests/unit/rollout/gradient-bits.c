/* The bits of the fast gradient, as bits.c does it for scores: a training that goes on after an
 * upgrade must go on with the same weights, or its fingerprint must say that it does not. A
 * change of bits on purpose raises MO_GRADIENT_VERSION and writes the hashes that this test prints
 * into the table. */
#include <morpho/gradient.h>

#include "../check.h"
#include "compute/internal.h"

#include <inttypes.h>

#define HASHED_VERSION 4 /* the MO_GRADIENT_VERSION that the hashes belong to */

static const uint64_t gradient_hashes[MO_ISA_COUNT] = {
    UINT64_C(0xcd858264b49d2547), /* x86-64 */
    UINT64_C(0x5a9e711e8414f015), /* avx2 */
    UINT64_C(0x3d5b81bc9e63ba58), /* avx512 */
};

/* Of lives in which what is rare in contact happens all the time. */
static const uint64_t rare_hashes[MO_ISA_COUNT] = {
    UINT64_C(0x7cd33a33a30d3d76), /* x86-64 */
    UINT64_C(0x3c64ec7d313dda59), /* avx2 */
    UINT64_C(0x5afac5d24f6566f3), /* avx512 */
};

enum { ROBOTS = MO_GRADIENT_ROBOTS, STEPS = 120, BLOCKS = 4 };

static struct mo_lattice *lattice;
static struct mo_body *bodies[ROBOTS];
static struct mo_environment environments[ROBOTS];
static struct mo_robot robots[ROBOTS];

/* The full lattice, one voxel, random bodies; one light inside its robot. */
static int setup(void)
{
  if (lattice != NULL)
    return 1;
  struct mo_body_stream *stream = NULL;
  if (mo_lattice_create(MO_DEFAULT_WORKSPACE, &lattice) != MO_OK ||
      mo_body_stream_create(MO_DEFAULT_WORKSPACE, 41, &stream) != MO_OK)
    return 0;
  for (uint32_t i = 0; i < ROBOTS; i++) {
    uint64_t bits[MO_DEFAULT_WORDS] = {0};
    if (i == 0)
      bits[0] = bits[1] = UINT64_MAX, bits[2] = 0xffff;
    else if (i == 1)
      bits[0] = 1;
    else if (mo_body_stream_next(stream, bits) != MO_OK)
      return 0;
    mo_genotype_place(MO_DEFAULT_WORKSPACE, bits);
    if (mo_body_create(lattice, bits, &bodies[i]) != MO_OK)
      return 0;
    mo_environment_training(41, 0, i, environments + i);
    robots[i] = (struct mo_robot){bodies[i], environments + i};
  }
  environments[2].light_xy_m[0] = environments[2].light_xy_m[1] = MO_WORLD_CENTRE_M;
  mo_body_stream_free(stream);
  return 1;
}

/* FNV-1a. */
static void hash(uint64_t *h, const void *bytes, size_t n)
{
  for (size_t i = 0; i < n; i++)
    *h = (*h ^ ((const uint8_t *)bytes)[i]) * UINT64_C(0x100000001b3);
}

/* Both sensors, both impact modes, a bound and none, whole and cut blocks, and one in which robots
 * diverge. */
static int run_block(enum mo_isa isa, int block, uint64_t *h, struct mo_gradient_counts *counts)
{
  struct mo_controller *controller = NULL;
  struct mo_gradient_pack *pack = NULL;
  struct mo_gradient_memory *memory = NULL;
  struct mo_outcome outcomes[ROBOTS];
  const uint32_t n = block == 1 ? 7 : ROBOTS;
  const struct mo_gradient_options options = {.adjoint_bound = block == 2 ? 0 : MO_ADJOINT_BOUND,
                                              .weight = 1.0 / n};
  struct mo_physics physics = mo_default_physics();
  physics.n_steps = STEPS;
  physics.impact = block % 2 == 1 ? MO_IMPACT_BISECTION : MO_IMPACT_EXACT;
  if (block == 3)
    physics.stiffness_n_per_m = 25000; /* unstable for large bodies */
  if (mo_controller_create(MO_DEFAULT_WORKSPACE,
                           block < 2 ? MO_SENSOR_INVERSE_SQRT : MO_SENSOR_INVERSE_SQUARE,
                           &controller) != MO_OK)
    return -1;
  mo_controller_randomize(controller, 41 + (uint64_t)block);
  float *gradient = malloc(controller->n_parameters * sizeof(float));
  int status =
      gradient != NULL ? mo_gradient_pack_create(controller, isa, &pack) : MO_ERR_NO_MEMORY;
  if (status == MO_OK)
    status = mo_gradient_memory_create(MO_GRADIENT_DEFAULT_BYTES, &memory);
  if (status == MO_OK)
    status = mo_gradient_block(memory, pack, robots, n, &physics, &options, NULL, outcomes,
                               gradient, counts);
  if (status == MO_OK) {
    hash(h, gradient, controller->n_parameters * sizeof(float));
    for (uint32_t i = 0; i < n; i++) {
      const float loss =
          (float)outcomes[i].loss; /* as it was when its last bits were the C library's */
      hash(h, &loss, sizeof(loss));
      hash(h, &outcomes[i].diverged_step, sizeof(outcomes[i].diverged_step));
      hash(h, outcomes[i].com_start_m, sizeof(outcomes[i].com_start_m));
      hash(h, outcomes[i].com_end_m, sizeof(outcomes[i].com_end_m));
    }
  }
  mo_gradient_memory_free(memory);
  mo_gradient_pack_free(pack);
  free(gradient);
  mo_controller_free(controller);
  return status;
}

static void gradients(void)
{
  REQUIRE(setup());
  CHECK_INT(MO_GRADIENT_VERSION, HASHED_VERSION);
  for (int isa = 0; isa < MO_ISA_COUNT; isa++) {
    if (isa > (int)mo_isa_best()) {
      printf("# %s: not on this processor\n", mo_isa_name((enum mo_isa)isa));
      continue;
    }
    uint64_t h = UINT64_C(0xcbf29ce484222325);
    struct mo_gradient_counts counts = {0};
    for (int block = 0; block < BLOCKS; block++)
      CHECK_INT(run_block((enum mo_isa)isa, block, &h, &counts), MO_OK);
    if (h != gradient_hashes[isa])
      printf("# %s: the bits hash to 0x%016" PRIx64 ", version %d had 0x%016" PRIx64 "\n",
             mo_isa_name((enum mo_isa)isa), h, HASHED_VERSION, gradient_hashes[isa]);
    CHECK(h == gradient_hashes[isa]);
    CHECK(counts.diverged_robots > 0 && counts.diverged_robots < ROBOTS &&
          counts.clipped_steps > 0);
  }
}

/* Robots slide down a mountain side that is rough, and over the edges of many cells: down slopes
 * that bend, into pits, up and over ridges. Life 1 begins with a fall from 10 m, life 2 goes across
 * roofs with a ridge or a valley along every edge. */
static int run_rare(enum mo_isa isa, int life, uint64_t *h, uint32_t *n_finite)
{
  enum { N = 12 };
  struct mo_controller *controller = NULL;
  struct mo_gradient_pack *pack = NULL;
  struct mo_gradient_memory *memory = NULL;
  struct mo_outcome outcomes[N];
  struct mo_environment steep[N];
  struct mo_robot own[N];
  struct mo_gradient_counts counts = {0};
  const struct mo_gradient_options options = {.adjoint_bound = MO_ADJOINT_BOUND, .weight = 1.0 / N};
  struct mo_physics physics = mo_default_physics();
  physics.n_steps = life == 1 ? 420 : 200;
  physics.drop_height_m = life == 1 ? 10 : 0;
  physics.drag_per_s = 0.5;
  physics.friction = 0.3;
  for (uint32_t i = 0; i < N; i++) {
    steep[i] = environments[i];
    mo_terrain_random(41, 9, i, life == 2 ? 0.05 : 0.4, steep[i].terrain_heights_m);
    for (int j = 0; j < MO_TERRAIN_HEIGHTS; j++) {
      const int x = j % MO_TERRAIN_SIDE, y = j / MO_TERRAIN_SIDE;
      steep[i].terrain_heights_m[j] += (i % 2 == 0 ? x : MO_TERRAIN_SIDE - x) * 0.8 + y * 0.4;
      steep[i].terrain_heights_m[j] += life == 2 ? 0.3 * ((x + y + (int)i) % 2) : 0;
    }
    own[i] = (struct mo_robot){bodies[i], &steep[i]};
  }
  if (mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &controller) != MO_OK)
    return -1;
  mo_controller_randomize(controller, 51);
  float *gradient = malloc(controller->n_parameters * sizeof(float));
  int status =
      gradient != NULL ? mo_gradient_pack_create(controller, isa, &pack) : MO_ERR_NO_MEMORY;
  if (status == MO_OK)
    status = mo_gradient_memory_create(MO_GRADIENT_DEFAULT_BYTES, &memory);
  if (status == MO_OK)
    status = mo_gradient_block(memory, pack, own, N, &physics, &options, NULL, outcomes, gradient,
                               &counts);
  if (status == MO_OK) {
    hash(h, gradient, controller->n_parameters * sizeof(float));
    hash(h, &counts.clipped_steps, sizeof(counts.clipped_steps));
    for (uint32_t i = 0; i < N; i++) {
      hash(h, &outcomes[i].loss, sizeof(outcomes[i].loss));
      hash(h, outcomes[i].com_end_m, sizeof(outcomes[i].com_end_m));
      *n_finite += outcomes[i].diverged_step == 0;
    }
  }
  mo_gradient_memory_free(memory);
  mo_gradient_pack_free(pack);
  free(gradient);
  mo_controller_free(controller);
  return status;
}

static void rare_contacts(void)
{
  REQUIRE(setup());
  for (int isa = 0; isa <= (int)mo_isa_best(); isa++) {
    uint64_t h = UINT64_C(0xcbf29ce484222325);
    uint32_t n_finite = 0;
    for (int life = 0; life < 3; life++)
      CHECK_INT(run_rare((enum mo_isa)isa, life, &h, &n_finite), MO_OK);
    printf("# %s: %u of 36 lives end well; the bits hash to 0x%016" PRIx64 "\n",
           mo_isa_name((enum mo_isa)isa), n_finite, h);
    CHECK(h == rare_hashes[isa]);
    CHECK(n_finite >= 24);
  }
}

static const struct check_case cases[] = {
    {"the gradient's bits have not changed", gradients},
    {"nor where contacts are rare ones", rare_contacts},
};
CHECK_MAIN(cases)
