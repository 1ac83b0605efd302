/* The gatherer of a device waits for more blocks, but not for as long as somebody keeps handing them over. */
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

/* One block every half millisecond, so that the device always waits for less time than it would take no more to come: the first has
 * an outcome while they still come. */
static void does_not_wait_for_ever(void)
{
  const struct mo_compute_config config = {.n_workers = 1, .isa = mo_isa_best()};
  const struct mo_devices_config devices = {.module = FAKE_DEVICE};
  struct mo_compute *compute = NULL;
  struct mo_compute_controller *passive = NULL;
  struct mo_lattice *lattice = NULL;
  struct mo_environment environment;
  struct mo_random random;
  uint64_t genotype[MO_DEFAULT_WORDS];
  unsigned n = 0;
  REQUIRE(mo_compute_create_cpu(&config, &compute) == MO_OK);
  REQUIRE(mo_compute_add_devices(compute, &devices, NULL) == MO_OK);
  REQUIRE(mo_compute_controller_create(compute, NULL, &passive) == MO_OK);
  REQUIRE(mo_lattice_create(MO_DEFAULT_WORKSPACE, &lattice) == MO_OK);
  mo_random_init(&random, 1, MO_PURPOSE_BODY, 0, 0);
  REQUIRE(mo_genotype_random(MO_DEFAULT_WORKSPACE, &random, genotype) == MO_OK);
  mo_environment_training(1, 0, 0, &environment);
  for (; n < MOST && atomic_load(&n_ended) == 0; n++) {
    blocks[n] = (struct mo_block){.lattice = lattice,
                                  .genotype = genotype,
                                  .controller = passive,
                                  .environments = {&environment},
                                  .n_environments = 1,
                                  .physics = mo_default_physics(),
                                  .back_end = MO_ON_DEVICE,
                                  .done = note_end};
    blocks[n].physics.n_steps = STEPS;
    REQUIRE(mo_compute_submit(compute, &blocks[n]) == MO_OK);
    sleep_us(500);
  }
  printf("# the device began before block %u\n", n);
  CHECK(n < MOST);
  for (int ms = 0; atomic_load(&n_ended) < n && ms < 60000; ms++)
    sleep_us(1000);
  REQUIRE(atomic_load(&n_ended) == n);
  mo_compute_controller_free(passive);
  mo_compute_free(compute);
  mo_lattice_free(lattice);
}

static const struct check_case cases[] = {
    {"a trickle of blocks does not keep a device waiting", does_not_wait_for_ever}};
CHECK_MAIN(cases)
