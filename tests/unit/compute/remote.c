/* Remote takers: what they take, in which order it comes back, and that blocks get the results as
 * if workers had computed them. */
#include "fixture.h"

enum { BODIES = 12, STEPS = 40 };

static struct mo_environment environments[MO_PAPER_TEST_COUNT];
static uint64_t genotypes[BODIES][3];
static struct mo_block blocks[BODIES];
static struct mo_outcome local[BODIES][MO_BLOCK_LANES];
static atomic_int ended, arrivals;

static void arrived(void *context)
{
  (void)context;
  atomic_fetch_add(&arrivals, 1);
}

/* Makes a compute with workers that leave everything to takers, with a controller and blocks to
 * submit. */
struct world {
  struct mo_compute *compute;
  struct mo_compute_controller *brain;
};

static struct mo_block block_at(const struct world *world, int i)
{
  struct mo_block block =
      block_of(genotypes[i], NULL, world->brain, environments, MO_PAPER_TEST_COUNT, STEPS);
  block.done = count_one;
  block.context = &ended;
  return block;
}

static struct world open_world(void)
{
  struct world world = {.compute = make_compute(2)};
  atomic_store(&ended, 0);
  atomic_store(&arrivals, 0);
  mo_compute_watch_remote(world.compute, arrived, NULL);
  mo_compute_leave_remote(world.compute, true);
  make_check(mo_compute_controller_create(world.compute, controller, &world.brain), "a controller");
  for (int i = 0; i < BODIES; i++)
    blocks[i] = block_at(&world, i);
  return world;
}

static void close_world(struct world *world)
{
  mo_compute_controller_free(world->brain);
  mo_compute_free(check_take(world->compute));
}

static void submit(const struct world *world, int first, int last)
{
  for (int i = first; i < last; i++)
    REQUIRE(mo_compute_submit(world->compute, &blocks[i]) == MO_OK);
}

static uint64_t steps_of(int n_blocks)
{
  return (uint64_t)n_blocks * MO_PAPER_TEST_COUNT * STEPS;
}

static void setup(void)
{
  struct mo_compute *compute;
  struct mo_compute_controller *brain;
  struct mo_body_stream *stream = make_body_stream(MO_DEFAULT_WORKSPACE, 11);
  make_scene();
  mo_environment_paper_test(environments);
  for (int i = 0; i < BODIES; i++)
    make_check(mo_body_stream_next(stream, genotypes[i], NULL), "a body");
  compute = make_compute(2);
  make_check(mo_compute_controller_create(compute, controller, &brain), "a controller");
  for (int i = 0; i < BODIES; i++)
    blocks[i] = block_of(genotypes[i], NULL, brain, environments, MO_PAPER_TEST_COUNT, STEPS);
  make_check(mo_compute_run(compute, blocks, BODIES), "local scores");
  for (int i = 0; i < BODIES; i++)
    memcpy(local[i], blocks[i].outcomes, sizeof(local[i]));
  mo_compute_controller_free(brain);
  mo_compute_free(check_take(compute));
}

/* Delivers results that workers of one machine computed before. */
static void deliver_measured(const struct world *world, struct mo_taken *taken, int64_t origin,
                             const double (*measures)[MO_MEASURES])
{
  double losses[BODIES * MO_PAPER_TEST_COUNT];
  uint32_t diverged[BODIES * MO_PAPER_TEST_COUNT], row = 0;
  for (uint32_t b = 0; b < taken->n_blocks; b++)
    for (uint32_t k = 0; k < taken->blocks[b]->n_environments; k++, row++) {
      const struct mo_outcome *outcome = &local[taken->blocks[b] - blocks][k];
      losses[row] = outcome->loss;
      diverged[row] = (uint32_t)outcome->diverged_step;
    }
  CHECK_INT(row, taken->n_rows);
  mo_compute_deliver(world->compute, taken,
                     &(struct mo_remote_result){.losses = losses,
                                                .diverged = diverged,
                                                .origin = origin,
                                                .busy_s = 0.25,
                                                .measures = measures});
}

static void deliver(const struct world *world, struct mo_taken *taken, int64_t origin)
{
  deliver_measured(world, taken, origin, NULL);
}

static void check_block(int i, int64_t origin)
{
  CHECK_INT(blocks[i].status, MO_OK);
  CHECK_INT(blocks[i].origin, origin);
  for (int k = 0; k < MO_PAPER_TEST_COUNT; k++)
    CHECK(blocks[i].outcomes[k].loss == local[i][k].loss &&
          blocks[i].outcomes[k].diverged_step == local[i][k].diverged_step);
}

static void takes_in_order(void)
{
  struct world world = open_world();
  CHECK(mo_compute_take(world.compute, MO_ON_CPU, steps_of(4)) == NULL);
  CHECK(mo_compute_take(world.compute, MO_ON_DEVICE, steps_of(4)) == NULL);
  submit(&world, 0, BODIES);
  CHECK_INT(atomic_load(&arrivals), 1); /* the first one only */
  CHECK_INT(mo_compute_remote_waiting(world.compute, MO_ON_CPU), steps_of(BODIES));
  struct mo_taken *first = mo_compute_take(world.compute, MO_ON_CPU, steps_of(5));
  REQUIRE(first != NULL);
  CHECK_INT(first->n_blocks, 5);
  CHECK_INT(first->n_rows, 5 * MO_PAPER_TEST_COUNT);
  CHECK(first->controller == controller);
  struct mo_taken *second = mo_compute_take(world.compute, MO_ON_CPU, 1); /* at least one */
  REQUIRE(second != NULL && second->n_blocks == 1 && second->blocks[0] == &blocks[5]);
  mo_compute_put_back(world.compute, second);
  struct mo_taken *half = mo_compute_split(world.compute, first);
  REQUIRE(half != NULL && first->n_blocks == 2 && half->n_blocks == 3);
  CHECK(half->blocks[0] == &blocks[2]);
  mo_compute_put_back(world.compute, half);
  struct mo_taken *rest = mo_compute_take(world.compute, MO_ON_CPU, steps_of(BODIES));
  REQUIRE(rest != NULL);
  CHECK_INT(rest->n_blocks, BODIES - 2);
  for (uint32_t i = 0; i < rest->n_blocks; i++)
    CHECK(rest->blocks[i] == &blocks[i + 2]);
  CHECK_INT(mo_compute_remote_waiting(world.compute, MO_ON_CPU), 0);
  deliver(&world, rest, 2);
  deliver(&world, first, 1);
  CHECK(await(&ended, BODIES));
  for (int i = 0; i < BODIES; i++)
    check_block(i, i < 2 ? 1 : 2);
  close_world(&world);
}

/* Unsuitable blocks are computed by the workers, and do not delay others. */
static void workers_keep_the_rest(void)
{
  struct world world = open_world();
  struct mo_body *body = NULL;
  struct mo_compute_share *share = NULL;
  REQUIRE(mo_body_create(lattice, genotypes[0], &body) == MO_OK);
  REQUIRE(mo_compute_share_create(world.compute, 1, &share) == MO_OK);
  double values[MO_BLOCK_LANES][MO_MEASURES];
  const struct mo_measuring measuring = {1U << MO_MEASURE_WORK, values}; /* takers send all */
  blocks[0].body = body;
  blocks[0].share = share;
  blocks[1].precision = MO_FLOAT64;
  blocks[2].urgency = MO_INTERACTIVE;
  blocks[4].measuring = &measuring;
  submit(&world, 4, 5);
  submit(&world, 0, 4);
  CHECK(await(&ended, 4));
  check_block(0, 0);
  check_block(2, 0);
  check_block(4, 0);
  struct mo_taken *taken = mo_compute_take(world.compute, MO_ON_CPU, steps_of(BODIES));
  REQUIRE(taken != NULL && taken->n_blocks == 1 && taken->blocks[0] == &blocks[3]);
  mo_compute_put_back(world.compute, taken);
  mo_compute_leave_remote(world.compute, false); /* workers take it at once */
  CHECK(await(&ended, 5));
  check_block(3, 0);
  mo_compute_share_free(share);
  mo_body_free(body);
  close_world(&world);
}

/* Blocks that measure are taken apart from others, and get all measures of their rollouts. */
static void measures_are_delivered(void)
{
  struct world world = open_world();
  static double values[3][MO_BLOCK_LANES][MO_MEASURES];
  static double sent[3 * MO_PAPER_TEST_COUNT][MO_MEASURES];
  struct mo_measuring measuring[3];
  memset(values, 0, sizeof(values));
  for (int i = 0; i < 3; i++) {
    measuring[i] = (struct mo_measuring){MO_MEASURES_ALL, values[i]};
    blocks[1 + i].measuring = &measuring[i];
  }
  for (size_t row = 0; row < COUNT(sent); row++)
    for (unsigned m = 0; m < MO_MEASURES; m++)
      sent[row][m] = (double)(row * MO_MEASURES + m + 1);
  submit(&world, 0, 5);
  for (int n = 0; n < 3; n++) {
    struct mo_taken *taken = mo_compute_take(world.compute, MO_ON_CPU, steps_of(BODIES));
    REQUIRE(taken != NULL);
    CHECK_INT(taken->n_blocks, n == 1 ? 3 : 1);
    CHECK((taken->blocks[0]->measuring != NULL) == (n == 1));
    deliver_measured(&world, taken, 1, n == 1 ? (const double(*)[MO_MEASURES])sent : NULL);
  }
  CHECK_INT(atomic_load(&ended), 5);
  for (int i = 0; i < 3; i++) {
    check_block(1 + i, 1);
    CHECK(SAME(values[i][0], sent[i * MO_PAPER_TEST_COUNT], MO_PAPER_TEST_COUNT * MO_MEASURES));
    blocks[1 + i].measuring = NULL;
  }
  close_world(&world);
}

static void one_physics_at_a_time(void)
{
  struct world world = open_world();
  blocks[2].physics.constants.friction = 0.5;
  submit(&world, 0, 4);
  for (int n = 0; n < 3; n++) {
    struct mo_taken *taken = mo_compute_take(world.compute, MO_ON_CPU, steps_of(BODIES));
    REQUIRE(taken != NULL);
    CHECK_INT(taken->n_blocks, n == 0 ? 2 : 1);
    deliver(&world, taken, 1);
  }
  CHECK_INT(atomic_load(&ended), 4);
  close_world(&world);
}

static void cancelled_blocks(void)
{
  struct world world = open_world();
  volatile int cancel = 0;
  struct mo_compute_share *share = NULL;
  struct mo_compute_share_stats stats;
  REQUIRE(mo_compute_share_create(world.compute, 1, &share) == MO_OK);
  for (int i = 0; i < 3; i++) {
    blocks[i].cancel = i < 2 ? &cancel : NULL;
    blocks[i].share = share;
  }
  submit(&world, 0, 3);
  struct mo_taken *taken = mo_compute_take(world.compute, MO_ON_CPU, steps_of(2));
  REQUIRE(taken != NULL && !mo_taken_is_cancelled(taken));
  __atomic_store_n(&cancel, 1, __ATOMIC_RELAXED);
  CHECK(mo_taken_is_cancelled(taken));
  deliver(&world, taken, 1);
  CHECK_INT(blocks[0].status, MO_ERR_CANCELLED);
  taken = mo_compute_take(world.compute, MO_ON_CPU, steps_of(2));
  REQUIRE(taken != NULL && taken->n_blocks == 1);
  mo_compute_share_get_stats(share, &stats);
  CHECK(stats.busy_s == 0.25); /* wasted work is charged, too */
  mo_compute_deliver(world.compute, taken, &(struct mo_remote_result){.status = MO_ERR_EXHAUSTED});
  CHECK_INT(blocks[2].status, MO_ERR_EXHAUSTED);
  mo_compute_share_free(share);
  close_world(&world);
}

/* Blocks that no taker has taken end soon after they are cancelled. */
static void cancelled_without_a_taker(void)
{
  struct world world = open_world();
  volatile int cancel = 0;
  for (int i = 0; i < BODIES; i++)
    blocks[i].cancel = &cancel;
  submit(&world, 0, BODIES);
  usleep(20000);
  CHECK_INT(atomic_load(&ended), 0);
  __atomic_store_n(&cancel, 1, __ATOMIC_RELAXED);
  CHECK(await(&ended, BODIES));
  CHECK_INT(blocks[BODIES - 1].status, MO_ERR_CANCELLED);
  close_world(&world);
}

/* Blocks that takers put back are cancelled when the back end is freed. */
static void the_end_with_blocks_waiting(void)
{
  struct world world = open_world();
  submit(&world, 0, 3);
  mo_compute_put_back(world.compute, mo_compute_take(world.compute, MO_ON_CPU, steps_of(2)));
  CHECK_INT(atomic_load(&ended), 0);
  close_world(&world);
  CHECK_INT(atomic_load(&ended), 3);
  CHECK_INT(blocks[0].status, MO_ERR_CANCELLED);
}

/* Devices that only takers have: no block is accepted before their class is known. Takers get the
 * blocks; others end as cancelled, or are left to the workers. */
static void devices_of_takers(void)
{
  struct world world = {.compute = make_compute(2)};
  volatile int cancel = 0;
  atomic_store(&ended, 0);
  atomic_store(&arrivals, 0);
  CHECK(!mo_compute_expects_devices(world.compute) && !mo_compute_serves_devices(world.compute));
  REQUIRE_OK(mo_compute_expect_devices(world.compute));
  CHECK_INT(mo_compute_expect_devices(world.compute), MO_ERR_CONFLICT);
  mo_compute_watch_remote(world.compute, arrived, NULL);
  make_check(mo_compute_controller_create(world.compute, controller, &world.brain), "a controller");
  for (int i = 0; i < 6; i++) {
    blocks[i] = block_at(&world, i);
    blocks[i].back_end = MO_ON_DEVICE;
    blocks[i].cancel = i == 3 ? &cancel : NULL;
  }
  CHECK(mo_compute_device_fingerprint(world.compute) == NULL);
  CHECK_INT(mo_compute_submit(world.compute, &blocks[0]), MO_ERR_DEVICE);
  REQUIRE_OK(mo_compute_name_devices(world.compute, "scores-1", "gradients-1"));
  CHECK_INT(mo_compute_name_devices(world.compute, "scores-2", "gradients-1"), MO_ERR_CONFLICT);
  CHECK_TEXT(mo_compute_device_fingerprint(world.compute), "scores-1");
  CHECK_TEXT(mo_compute_device_gradient_fingerprint(world.compute), "gradients-1");
  CHECK(mo_compute_serves_devices(world.compute) && mo_compute_devices(world.compute) == 0);
  CHECK(mo_compute_lacks_takers(world.compute, MO_ON_DEVICE));
  mo_compute_want_remote(world.compute, MO_ON_DEVICE, 1);
  CHECK(!mo_compute_lacks_takers(world.compute, MO_ON_DEVICE));
  blocks[5].urgency = MO_INTERACTIVE; /* takers get no such block */
  CHECK_INT(mo_compute_submit(world.compute, &blocks[5]), MO_ERR_DEVICE);
  CHECK(mo_compute_take(world.compute, MO_ON_DEVICE, steps_of(1)) == NULL);
  submit(&world, 0, 3);
  CHECK_INT(atomic_load(&arrivals), 1);
  CHECK(mo_compute_take(world.compute, MO_ON_CPU, steps_of(BODIES)) == NULL);
  struct mo_taken *one = mo_compute_take(world.compute, MO_ON_DEVICE, steps_of(1)),
                  *two = mo_compute_take(world.compute, MO_ON_DEVICE, steps_of(1));
  REQUIRE(one != NULL && two != NULL && one->back_end == MO_ON_DEVICE);
  deliver(&world, one, 4);
  check_block(0, 4);
  CHECK_INT(blocks[0].computed_on, MO_ON_DEVICE);
  mo_compute_keep(world.compute, two); /* takers cannot compute it */
  CHECK(await(&ended, 2));
  check_block(1, 0);
  CHECK_INT(blocks[1].computed_on, MO_ON_CPU);
  submit(&world, 3, 5);
  one = mo_compute_take(world.compute, MO_ON_DEVICE, steps_of(1));
  REQUIRE(one != NULL && one->blocks[0] == &blocks[2]);
  __atomic_store_n(&cancel, 1, __ATOMIC_RELAXED);
  CHECK(await(&ended, 3));
  CHECK_INT(blocks[3].status, MO_ERR_CANCELLED);
  mo_compute_put_back(world.compute, one);
  CHECK_INT(atomic_load(&ended), 3);
  mo_compute_controller_free(world.brain);
  mo_compute_free(check_take(world.compute));
  CHECK_INT(atomic_load(&ended), 5);
  CHECK_INT(blocks[2].status, MO_ERR_CANCELLED);
}

static const struct check_case cases[] = {
    {"takes in order", takes_in_order},
    {"workers keep the rest", workers_keep_the_rest},
    {"measures are delivered", measures_are_delivered},
    {"one physics at a time", one_physics_at_a_time},
    {"cancelled blocks", cancelled_blocks},
    {"cancelled without a taker", cancelled_without_a_taker},
    {"shutdown with waiting blocks", the_end_with_blocks_waiting},
    {"devices of takers", devices_of_takers},
};
CHECK_MAIN_WITH(setup, cases)
