/* The bits themselves. Stored scores are compared bit by bit with later ones, under a fingerprint
 * that contains the kernels' version. So any change of bits, intended or not, must be noticed here:
 * 50 rollouts per instruction set and precision are hashed. An intended change raises
 * MO_KERNEL_VERSION and copies the hashes that this test prints into the table. */
#include "../make.h"
#include "compute/internal.h"

#include <gnu/libc-version.h>
#include <inttypes.h>

#define HASHED_VERSION 2 /* the MO_KERNEL_VERSION that the hashes belong to */

static const uint64_t kernel_hashes[MO_ISA_COUNT][2] = {
    {UINT64_C(0x6fe7e67030df6fcb), UINT64_C(0x37fb2054f5c0bb02)}, /* x86-64: float32, float64 */
    {UINT64_C(0xcd4211e5a31364b8), UINT64_C(0xcd5d290c876039c7)}, /* avx2 */
    {UINT64_C(0xd036df9a2a94059c), UINT64_C(0x07d455d8b54ba940)}, /* avx512 */
};
static const uint64_t reference_hash = UINT64_C(0x882fab95a9e24546);

enum {
  BODIES = 5,
  ENVIRONMENTS = MO_PAPER_TEST_COUNT,
  STEPS = 200,
  STRIDE = 50,
  FRAMES = STEPS / STRIDE + 1
};

static struct mo_controller *controller;
static struct mo_lattice *lattice;
static struct mo_environment environments[ENVIRONMENTS];

static void setup(void)
{
  mo_environment_paper_test(environments);
  lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  controller = make_shipped_controller("bootstrap");
}

/* 1 voxel, three random bodies, all 144 voxels. */
static const struct mo_body *body_number(uint32_t number)
{
  static const uint32_t size[BODIES] = {1, 4, 14, 40, MO_DEFAULT_VOXELS};
  const struct mo_workspace workspace = MO_DEFAULT_WORKSPACE;
  uint64_t bits[MO_DEFAULT_WORDS];
  struct mo_random random = dice(21, 0, number);
  do {
    memset(bits, 0, sizeof(bits));
    for (uint32_t v = 0; v < MO_DEFAULT_VOXELS; v++)
      if (size[number] == 1
              ? v == 0
              : mo_random_below(&random, MO_DEFAULT_VOXELS) < 36 + 3 * size[number] / 4)
        bits[v >> 6] |= UINT64_C(1) << (v & 63);
    mo_genotype_keep_largest(workspace, bits);
  } while (mo_genotype_count(workspace, bits) < size[number]);
  mo_genotype_place(workspace, bits);
  return make_body(lattice, bits);
}

/* Both impact modes and both sensors; stiff springs, which diverge, for one body. */
static struct mo_physics physics_number(uint32_t number)
{
  struct mo_physics physics = physics_of(STEPS);
  physics.scheme.impact = number % 2 == 1 ? MO_IMPACT_BISECTION : MO_IMPACT_EXACT;
  if (number == 3)
    physics.constants.stiffness_n_per_m = 22500;
  return physics;
}

static enum mo_sensor sensor_number(uint32_t number)
{
  return number % 3 == 2 ? MO_SENSOR_INVERSE_SQUARE : MO_SENSOR_INVERSE_SQRT;
}

static void hash_outcome(uint64_t *h, const struct mo_outcome *outcome,
                         const double com[FRAMES * 3])
{
  hash(h, &outcome->diverged_step, sizeof(outcome->diverged_step));
  hash(h, outcome->com_start_m, sizeof(outcome->com_start_m));
  hash(h, outcome->com_end_m, sizeof(outcome->com_end_m));
  hash(h, com, FRAMES * 3 * sizeof(*com));
}

static void kernels(void)
{
  CHECK_INT(MO_KERNEL_VERSION, HASHED_VERSION);
  struct mo_workspace_memory *memory = make_workspace_memory();
  const struct mo_environment *list[ENVIRONMENTS];
  for (uint32_t e = 0; e < ENVIRONMENTS; e++)
    list[e] = environments + e;
  for (int isa = 0; isa < MO_ISA_COUNT; isa++)
    for (int precision = MO_FLOAT32; precision <= MO_FLOAT64; precision++) {
      if (isa > (int)mo_isa_best()) {
        printf("# %s: not supported by this processor\n", mo_isa_name((enum mo_isa)isa));
        continue;
      }
      uint64_t h = FNV_START;
      int diverged = 0;
      for (uint32_t number = 0; number < BODIES; number++) {
        const struct mo_body *body = body_number(number);
        const struct mo_physics physics = physics_number(number);
        struct mo_outcome outcomes[ENVIRONMENTS];
        double com[ENVIRONMENTS][FRAMES * 3];
        struct mo_recording recordings[ENVIRONMENTS];
        for (uint32_t e = 0; e < ENVIRONMENTS; e++)
          recordings[e] = (struct mo_recording){.stride = STRIDE, .com_m = com[e]};
        controller->sensor = sensor_number(number);
        struct mo_pack *pack =
            make_pack(controller, (enum mo_isa)isa, (enum mo_precision)precision);
        REQUIRE(mo_rollout_block(memory, pack, body, list, ENVIRONMENTS, &physics, recordings, NULL,
                                 NULL, outcomes) == MO_OK);
        for (uint32_t e = 0; e < ENVIRONMENTS; e++) {
          hash_outcome(&h, outcomes + e, com[e]);
          const float loss =
              (float)outcomes[e].loss; /* hypot's last bits depend on the C library */
          hash(&h, &loss, sizeof(loss));
          diverged += outcomes[e].diverged_step > 0;
        }
      }
      if (h != kernel_hashes[isa][precision])
        printf("# %s, %s: the bits hash to 0x%016" PRIx64 ", version %d had 0x%016" PRIx64 "\n",
               mo_isa_name((enum mo_isa)isa), precision == MO_FLOAT32 ? "float32" : "float64", h,
               HASHED_VERSION, kernel_hashes[isa][precision]);
      CHECK(h == kernel_hashes[isa][precision]);
      CHECK(diverged > 0 && diverged <= ENVIRONMENTS);
    }
}

/* The reference calls sin, exp and tanh of the C library, which has variants with and without fused
 * operations. */
static void reference(void)
{
  if (strcmp(gnu_get_libc_version(), "2.36") != 0 || mo_isa_best() < MO_ISA_AVX2) {
    printf("# the hash was made with another C library or processor\n");
    return;
  }
  uint64_t h = FNV_START;
  for (uint32_t number = 0; number < BODIES; number++) {
    const struct mo_body *body = body_number(number);
    const struct mo_physics physics = physics_number(number);
    controller->sensor = sensor_number(number);
    for (uint32_t e = number % 2; e < ENVIRONMENTS; e += 4) {
      struct mo_outcome outcome;
      double com[FRAMES * 3];
      const struct mo_recording recording = {.stride = STRIDE, .com_m = com};
      REQUIRE(mo_rollout_reference(body, controller, environments + e, &physics, &recording, NULL,
                                   &outcome) == MO_OK);
      hash_outcome(&h, &outcome, com);
      hash(&h, &outcome.loss, sizeof(outcome.loss));
    }
  }
  if (h != reference_hash)
    printf("# the reference's bits hash to 0x%016" PRIx64 "\n", h);
  CHECK(h == reference_hash);
}

static const struct check_case cases[] = {
    {"the kernels' bits have not changed", kernels},
    {"the reference's bits have not changed", reference},
};
CHECK_MAIN_WITH(setup, cases)
