/* The gatherer of a device: how long it waits for more blocks, and what it makes of those that it
 * has. */
#include <morpho/compute.h>

#include "../check.h"

#include <stdatomic.h>
#include <time.h>

enum { MOST = 3000, STEPS = 2 }; /* fewer blocks than make a chunk by their number */

static struct mo_block blocks[MOST];
static atomic_uint n_ended;

static void note_end(struct mo_block *block, void *context)
{
  (void)context;
  CHECK_INT(block->status, MO_OK);
  atomic_fetch_add(&n_ended, 1);
}

static void sleep_us(long us)
{
  const struct timespec time = {.tv_nsec = us * 1000};
  nanosleep(&time, NULL);
}

static struct mo_compute *compute;
static struct mo_compute_controller *passive;
static struct mo_lattice *lattice;
static struct mo_environment environments[2];

static int open_device(void)
{
  const struct mo_compute_config config = {.n_workers = 4, .isa = mo_isa_best()};
  const struct mo_devices_config devices = {.module = FAKE_DEVICE};
  for (uint32_t i = 0; i < 2; i++)
    mo_environment_training(1, 0, i, environments + i);
  return mo_compute_create_cpu(&config, &compute) == MO_OK &&
         mo_compute_add_devices(compute, &devices, NULL) == MO_OK &&
         mo_compute_controller_create(compute, NULL, &passive) == MO_OK &&
         mo_lattice_create(MO_DEFAULT_WORKSPACE, &lattice) == MO_OK;
}

static void close_device(void)
{
  mo_compute_controller_free(passive);
  mo_compute_free(compute);
  mo_lattice_free(lattice);
}

static int draw(uint64_t number, uint64_t genotype[MO_DEFAULT_WORDS])
{
  struct mo_random random;
  mo_random_init(&random, 1, MO_PURPOSE_BODY, 0, number);
  return mo_genotype_random(MO_DEFAULT_WORKSPACE, &random, genotype) == MO_OK;
}

static struct mo_block block_of(const uint64_t *genotype, const struct mo_environment *environment)
{
  struct mo_block block = {.lattice = lattice,
                           .genotype = genotype,
                           .controller = passive,
                           .environments = {environment},
                           .n_environments = 1,
                           .physics = mo_default_physics(),
                           .back_end = MO_ON_DEVICE};
  block.physics.n_steps = STEPS;
  return block;
}

/* One block every half millisecond, so that the device always waits for less time than it would
 * take no more to come: the first has an outcome while they still come. */
static void does_not_wait_for_ever(void)
{
  uint64_t genotype[MO_DEFAULT_WORDS];
  unsigned n = 0;
  REQUIRE(open_device());
  REQUIRE(draw(0, genotype));
  for (; n < MOST && atomic_load(&n_ended) == 0; n++) {
    blocks[n] = block_of(genotype, environments);
    blocks[n].done = note_end;
    REQUIRE(mo_compute_submit(compute, &blocks[n]) == MO_OK);
    sleep_us(500);
  }
  printf("# the device began before block %u\n", n);
  CHECK(n < MOST);
  for (int ms = 0; atomic_load(&n_ended) < n && ms < 60000; ms++)
    sleep_us(1000);
  REQUIRE(atomic_load(&n_ended) == n);
  close_device();
}

/* Three blocks in turn have one genotype, in two environments; some are cancelled, some cannot be
 * built. The others have the outcomes that the workers find. */
static void builds_what_is_wanted(void)
{
  enum { BODIES = 400, N = 3 * BODIES };
  static uint64_t genotypes[BODIES][MO_DEFAULT_WORDS];
  static struct mo_block expected[N];
  static volatile int cancelled = 1;
  REQUIRE(open_device());
  for (uint32_t i = 0; i < BODIES; i++)
    REQUIRE(i % 50 == 7 || draw(i, genotypes[i])); /* else without a voxel */
  for (uint32_t i = 0; i < N; i++) {
    blocks[i] = expected[i] = block_of(genotypes[i / 3], &environments[i % 2]);
    blocks[i].cancel = i % 5 == 2 ? &cancelled : NULL;
    expected[i].back_end = MO_ON_CPU;
  }
  (void)mo_compute_run(compute, expected, N);
  (void)mo_compute_run(compute, blocks, N);
  for (uint32_t i = 0; i < N; i++) {
    CHECK_INT(blocks[i].status, i % 5 == 2 ? MO_ERR_CANCELLED : expected[i].status);
    CHECK(i / 3 % 50 == 7 || expected[i].status == MO_OK);
    if (blocks[i].status == MO_OK)
      CHECK(memcmp(blocks[i].outcomes, expected[i].outcomes, sizeof(struct mo_outcome)) == 0);
  }
  CHECK(expected[3 * 7].status != MO_OK);
  close_device();
}

static const struct check_case cases[] = {
    {"a trickle of blocks does not keep a device waiting", does_not_wait_for_ever},
    {"bodies are shared by neighbors, and built for those that are wanted", builds_what_is_wanted},
};
CHECK_MAIN(cases)
