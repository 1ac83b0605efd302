/* The gatherer of a device: how long it waits for more blocks, and how it combines the blocks that
 * it has. */
#include "fixture.h"

enum { MOST = 3000, STEPS = 2 }; /* fewer blocks than needed to fill a chunk */

static struct mo_block blocks[MOST];
static struct mo_compute *compute;
static struct mo_compute_controller *passive;
static struct mo_environment environments[2];

static void setup(void)
{
  const struct mo_devices_config devices = {.module = FAKE_DEVICE};
  make_scene();
  for (uint32_t i = 0; i < 2; i++)
    mo_environment_training(1, 0, i, environments + i);
  compute = make_compute(4);
  make_check(mo_compute_add_devices(compute, &devices, NULL), "a device");
  passive = make_compute_controller(compute, NULL);
}

static void draw(uint64_t number, uint64_t genotype[MO_DEFAULT_WORDS])
{
  struct mo_random random;
  mo_random_init(&random, 1, MO_PURPOSE_BODY, 0, number);
  make_check(mo_genotype_random(MO_DEFAULT_WORKSPACE, &random, genotype), "a body");
}

static struct mo_block device_block(const uint64_t *genotype,
                                    const struct mo_environment *environment)
{
  struct mo_block block = block_of(genotype, NULL, passive, environment, 1, STEPS);
  block.back_end = MO_ON_DEVICE;
  return block;
}

/* One block every half millisecond, so that each wait is shorter than the time after which the
 * device stops waiting: the first block must finish while others still arrive. */
static void does_not_wait_for_ever(void)
{
  uint64_t genotype[MO_DEFAULT_WORDS];
  atomic_int n_ended = 0;
  int n = 0;
  draw(0, genotype);
  for (; n < MOST && atomic_load(&n_ended) == 0; n++) {
    blocks[n] = device_block(genotype, environments);
    submit_counted(compute, &blocks[n], &n_ended);
    usleep(500);
  }
  printf("# the device began before block %d\n", n);
  CHECK(n < MOST);
  REQUIRE(await(&n_ended, n));
  for (int i = 0; i < n; i++)
    CHECK_INT(blocks[i].status, MO_OK);
}

/* Each group of three blocks shares a genotype and uses two environments. Some blocks are
 * cancelled, and some bodies cannot be built. The others have the outcomes that the workers
 * compute. */
static void builds_what_is_wanted(void)
{
  enum { BODIES = 400, N = 3 * BODIES };
  static uint64_t genotypes[BODIES][MO_DEFAULT_WORDS];
  static struct mo_block expected[N];
  static volatile int cancelled = 1;
  for (uint32_t i = 0; i < BODIES; i++)
    if (i % 50 != 7) /* otherwise without a voxel */
      draw(i, genotypes[i]);
  for (uint32_t i = 0; i < N; i++) {
    blocks[i] = expected[i] = device_block(genotypes[i / 3], &environments[i % 2]);
    blocks[i].cancel = i % 5 == 2 ? &cancelled : NULL;
    expected[i].back_end = MO_ON_CPU;
  }
  (void)mo_compute_run(compute, expected, N);
  (void)mo_compute_run(compute, blocks, N);
  for (uint32_t i = 0; i < N; i++) {
    CHECK_INT(blocks[i].status, i % 5 == 2 ? MO_ERR_CANCELLED : expected[i].status);
    CHECK(i / 3 % 50 == 7 || expected[i].status == MO_OK);
    CHECK(blocks[i].status != MO_OK || SAME(blocks[i].outcomes, expected[i].outcomes, 1));
  }
  CHECK(expected[3 * 7].status != MO_OK);
}

/* Blocks that arrive during a call go into a second, parallel call: a call that waits in vain for
 * another one fails. */
static void calls_run_side_by_side(void)
{
  enum { N = 200 };
  uint64_t genotype[MO_DEFAULT_WORDS];
  atomic_int n_ended = 0;
  draw(0, genotype);
  setenv("MORPHO_FAKE_BESIDE", "2", 1);
  for (int i = 0; i < N; i++) {
    blocks[i] = device_block(genotype, environments);
    submit_counted(compute, &blocks[i], &n_ended);
    usleep(500);
  }
  REQUIRE(await(&n_ended, N));
  for (int i = 0; i < N; i++)
    CHECK_INT(blocks[i].status, MO_OK);
}

static const struct check_case cases[] = {
    {"a trickle of blocks does not keep a device waiting", does_not_wait_for_ever},
    {"neighbors share bodies, and only needed bodies are built", builds_what_is_wanted},
    {"calls run in parallel", calls_run_side_by_side},
};
CHECK_MAIN_WITH(setup, cases)
