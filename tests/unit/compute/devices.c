/* Scores on devices: the same bits for any number of devices, no matter how often memory is short
 * or a device is lost; and no block is forgotten. */
#include "devices_fixture.h"

#include <dlfcn.h>
#include <limits.h>

static struct mo_outcome expected[DESIGNS][ENVIRONMENTS]; /* computed by the workers */
static struct mo_block blocks[DESIGNS];

static struct mo_block design_block(uint32_t design, struct mo_compute_controller *brain,
                                    uint32_t steps)
{
  struct mo_block block =
      block_of(genotypes[design], NULL, brain, environments, ENVIRONMENTS, steps);
  block.back_end = MO_ON_DEVICE;
  return block;
}

/* Scores all designs; returns the error of the run. */
static int score_on(struct mo_compute *compute, enum mo_back_end back_end)
{
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  for (uint32_t d = 0; d < DESIGNS; d++) {
    blocks[d] = design_block(d, brain, STEPS);
    blocks[d].back_end = back_end;
  }
  const int status = mo_compute_run(compute, blocks, DESIGNS);
  check_drop_from(brain);
  return status;
}

static int score(struct mo_compute *compute)
{
  return score_on(compute, MO_ON_DEVICE);
}

/* Scores one design on the workers; a NULL controller means passive. */
static void score_one(struct mo_compute *compute, const struct mo_controller *c,
                      enum mo_back_end back_end, enum mo_precision precision, int status)
{
  struct mo_compute_controller *brain = make_compute_controller(compute, c);
  blocks[0] = design_block(0, brain, STEPS);
  blocks[0].back_end = back_end;
  blocks[0].precision = precision;
  CHECK_INT(mo_compute_run(compute, blocks, 1), status);
  check_drop_from(brain);
}

static bool as_expected(uint32_t d)
{
  return SAME(blocks[d].outcomes, expected[d], ENVIRONMENTS);
}

/* What the devices have taken for rollouts; no rollouts: nothing. */
static struct mo_rate device_rate(struct mo_compute *compute)
{
  struct mo_rate rates[MO_RATES_MAX], found = {.rollouts = 0};
  const uint32_t n = mo_compute_get_rates(compute, rates);
  for (uint32_t i = 0; i < n; i++)
    if (rates[i].back_end == MO_ON_DEVICE)
      found = rates[i];
  return found;
}

static void expect_scores(enum mo_back_end computed_on)
{
  for (uint32_t d = 0; d < DESIGNS; d++) {
    CHECK_INT(blocks[d].status, MO_OK);
    CHECK_INT(blocks[d].computed_on, computed_on);
    CHECK(as_expected(d));
  }
}

static void setup(void)
{
  make_robots_of_designs();
  reset();
  struct mo_compute *compute = open_devices(NULL);
  make_check(score_on(compute, MO_ON_CPU), "scores of the workers");
  for (uint32_t d = 0; d < DESIGNS; d++)
    memcpy(expected[d], blocks[d].outcomes, sizeof(expected[d]));
  expect_scores(MO_ON_CPU);
  check_drop_from(compute);
}

/* Every second design is measured, every fourth of them by some measures alone: the measures of the
 * workers, at the same outcomes, also where memory is short and where the workers take over. */
static void measures_rows(void)
{
  static double values[DESIGNS][ENVIRONMENTS][MO_MEASURES], all[ENVIRONMENTS][MO_MEASURES];
  struct mo_measuring measurings[DESIGNS];
  uint32_t on_device = 0, on_device_plain = 0;
  reset();
  set("MORPHO_FAKE_ROWS", "70");
  set("MORPHO_FAKE_SPRINGS", "400");
  struct mo_compute *compute = open_devices("2");
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  for (uint32_t d = 0; d < DESIGNS; d++) {
    blocks[d] = design_block(d, brain, STEPS);
    measurings[d] = (struct mo_measuring){d % 4 == 0 ? 5 : MO_MEASURES_ALL, values[d]};
    blocks[d].measuring = d % 2 == 0 ? &measurings[d] : NULL;
  }
  memset(values, 0x7f, sizeof(values));
  CHECK_INT(mo_compute_run(compute, blocks, DESIGNS), MO_OK);
  struct mo_workspace_memory *memory = make_workspace_memory();
  const struct mo_pack *pack = make_pack(controller, mo_isa_best(), MO_FLOAT32);
  for (uint32_t d = 0; d < DESIGNS; d++) {
    const struct mo_measuring measuring = {measurings[d].set, all};
    struct mo_outcome outcomes[ENVIRONMENTS];
    CHECK(as_expected(d));
    CHECK_INT(mo_rollout_block(memory, pack, bodies[d], blocks[d].environments, ENVIRONMENTS,
                               &blocks[d].physics, NULL, &measuring, NULL, outcomes),
              MO_OK);
    if (d % 2 == 1)
      memset(all, 0x7f, sizeof(all)); /* not requested: left unchanged */
    CHECK(memcmp(values[d], all, sizeof(all)) == 0);
    on_device += blocks[d].computed_on == MO_ON_DEVICE;
    on_device_plain += blocks[d].computed_on == MO_ON_DEVICE && d % 2 == 1;
  }
  CHECK_INT(device_rate(compute).rollouts, on_device_plain * ENVIRONMENTS);
  CHECK(on_device > DESIGNS / 2 && on_device < DESIGNS);
}

/* ---- loading ---- */

static void expect_refusal(const char *module, const uint32_t *devices, uint32_t n, int status,
                           const char *words)
{
  const struct mo_devices_config asked = {
      .module = module, .devices = devices, .n = n, .lost = note_loss};
  struct mo_compute *compute = make_compute(1);
  struct mo_message message = {.text = ""};
  CHECK_INT(mo_compute_add_devices(compute, &asked, &message), status);
  CHECK_SAYS(message, words);
  CHECK_INT(mo_compute_devices(compute), 0);
  CHECK(mo_compute_device_fingerprint(compute) == NULL);
  score_one(compute, NULL, MO_ON_DEVICE, MO_FLOAT32, MO_ERR_DEVICE);
  check_drop_from(compute);
}

static void says_what_cannot_be_loaded(void)
{
  const uint32_t second = 1, first = 0;
  char other[4096];
  reset();
  snprintf(other, sizeof(other), "%s/meson.build", getenv("MORPHO_SOURCE_DIR"));
  expect_refusal("/no/such/file.so", NULL, 0, MO_ERR_NOT_FOUND, "/no/such/file.so");
  expect_refusal(other, NULL, 0, MO_ERR_UNSUPPORTED, "meson.build");
  set("MORPHO_FAKE_ABI", "99");
  expect_refusal(FAKE_DEVICE, NULL, 0, MO_ERR_UNSUPPORTED,
                 "a different version of this program (interface 99, not ");
  reset();
  set("MORPHO_FAKE_DEVICES", "0");
  expect_refusal(FAKE_DEVICE, NULL, 0, MO_ERR_EXHAUSTED, "no working device");
  set("MORPHO_FAKE_DEVICES", "1");
  expect_refusal(FAKE_DEVICE, &second, 1, MO_ERR_RANGE, "device 1 does not exist");
  set("MORPHO_FAKE_SHUT", "0");
  expect_refusal(FAKE_DEVICE, &first, 1, MO_ERR_DEVICE, "device 0");
  expect_refusal(FAKE_DEVICE, NULL, 0, MO_ERR_EXHAUSTED, "no working device");
}

static void passes_over_what_cannot_be_opened(void)
{
  const struct mo_devices_config devices = {.module = FAKE_DEVICE, .lost = note_loss};
  struct mo_device_status status;
  reset();
  set("MORPHO_FAKE_DEVICES", "4");
  set("MORPHO_FAKE_SHUT", "1");
  set("MORPHO_FAKE_FULL", "3");
  atomic_store(&n_lost, 0);
  struct mo_compute *compute = make_compute(1);
  CHECK_INT(mo_compute_add_devices(compute, &devices, NULL), MO_OK);
  CHECK_INT(atomic_load(&n_lost), 2);
  CHECK_INT(mo_compute_devices(compute), 2);
  CHECK_INT(mo_compute_device(compute, 1, &status), MO_OK);
  CHECK_INT(status.index, 2);
  CHECK_TEXT(status.id, "FAKE-2");
  CHECK_INT(mo_compute_device(compute, 2, &status), MO_ERR_RANGE);
  CHECK_INT(mo_compute_add_devices(compute, &devices, NULL), MO_ERR_CONFLICT);
}

/* Bits of different capabilities never get the same fingerprint: the first device's capability
 * counts, and devices with another one are left out. */
static void uses_one_capability(void)
{
  static const struct {
    const char *older, *scores, *gradients;
    uint32_t n, indices[3];
  } cases[] = {{"7", "fake float32 score-1 sm90", "fake float32 gradient-1 sm90", 3, {0, 1, 2}},
               {"1", "fake float32 score-1 sm90", "fake float32 gradient-1 sm90", 2, {0, 2}},
               {"0", "fake float32 score-1 sm80", "fake float32 gradient-1 sm80", 1, {0}}};
  static const uint32_t both[] = {0, 1}, backwards[] = {1, 0};
  const struct mo_devices_config devices = {.module = FAKE_DEVICE, .lost = note_loss};
  reset();
  set("MORPHO_FAKE_DEVICES", "3");
  for (size_t i = 0; i < COUNT(cases); i++) {
    struct mo_device_status status;
    set("MORPHO_FAKE_OLDER", cases[i].older);
    atomic_store(&n_lost, 0);
    struct mo_compute *compute = make_compute(1);
    CHECK_INT(mo_compute_add_devices(compute, &devices, NULL), MO_OK);
    CHECK_INT(mo_compute_devices(compute), cases[i].n);
    CHECK_INT(atomic_load(&n_lost), 3 - cases[i].n);
    CHECK_TEXT(mo_compute_device_fingerprint(compute), cases[i].scores);
    CHECK_TEXT(mo_compute_device_gradient_fingerprint(compute), cases[i].gradients);
    for (uint32_t d = 0; d < cases[i].n; d++) {
      CHECK_INT(mo_compute_device(compute, d, &status), MO_OK);
      CHECK_INT(status.index, cases[i].indices[d]);
    }
    check_drop_from(compute);
  }
  expect_refusal(FAKE_DEVICE, both, 2, MO_ERR_DEVICE,
                 "device 1 cannot be used: its compute capability is 9.0, but device");
  expect_refusal(FAKE_DEVICE, backwards, 2, MO_ERR_DEVICE,
                 "device 0 cannot be used: its compute capability is 8.0");
}

/* ---- scores ---- */

static void scores_do_not_depend_on_the_number(void)
{
  static const char *const numbers[] = {"1", "2", "4"};
  reset();
  for (size_t i = 0; i < 3; i++) {
    struct mo_compute *compute = open_devices(numbers[i]);
    uint64_t rollouts = 0;
    CHECK_TEXT(mo_compute_device_fingerprint(compute), "fake float32 score-1 sm90");
    CHECK_TEXT(mo_compute_device_gradient_fingerprint(compute), "fake float32 gradient-1 sm90");
    CHECK_INT(score(compute), MO_OK);
    expect_scores(MO_ON_DEVICE);
    CHECK_INT(score(compute), MO_OK); /* another controller at the same address */
    expect_scores(MO_ON_DEVICE);
    for (uint32_t d = 0; d < mo_compute_devices(compute); d++) {
      struct mo_device_status status;
      CHECK_INT(mo_compute_device(compute, d, &status), MO_OK);
      CHECK_TEXT(status.name, "Fake device");
      CHECK_INT(status.state, MO_DEVICE_WORKS);
      CHECK_INT(status.capability, 90);
      CHECK(status.memory_bytes > status.free_bytes && status.free_bytes > 0);
      CHECK(status.load >= 0 && status.load <= 1);
      rollouts += status.rollouts_done;
    }
    CHECK_INT(rollouts, 2 * DESIGNS * ENVIRONMENTS);
    uint64_t spring_steps = 0;
    for (uint32_t d = 0; d < DESIGNS; d++)
      spring_steps += UINT64_C(2) * ENVIRONMENTS * STEPS * bodies[d]->n_springs;
    const struct mo_rate rate = device_rate(compute);
    CHECK_INT(rate.rollouts, rollouts);
    CHECK_INT(rate.steps, rollouts * STEPS);
    CHECK_INT(rate.spring_steps, spring_steps);
    CHECK(rate.busy_s > 0);
    check_drop_from(compute);
  }
}

static void scores_do_not_depend_on_memory(void)
{
  static const char *const numbers[] = {"1", "2"};
  reset();
  set("MORPHO_FAKE_ROWS", "37");
  for (size_t i = 0; i < 2; i++) {
    struct mo_compute *compute = open_devices(numbers[i]);
    struct mo_device_status status;
    for (int k = 0; k < 12; k++) { /* it tries larger calls again, and fails again */
      CHECK_INT(score(compute), MO_OK);
      expect_scores(MO_ON_DEVICE);
    }
    CHECK_INT(mo_compute_device(compute, 0, &status), MO_OK);
    CHECK(status.rows_at_once < 300);
    check_drop_from(compute);
  }
  set("MORPHO_FAKE_ROWS", "9"); /* not even one block fits */
  struct mo_compute *compute = open_devices("1");
  CHECK_INT(score(compute), MO_ERR_NO_MEMORY);
  for (uint32_t d = 0; d < DESIGNS; d++)
    CHECK_INT(blocks[d].status, MO_ERR_NO_MEMORY);
}

/* A device's rates include only what it computed itself, because what it leaves to the workers
 * takes it almost no time. */
static void workers_do_the_rest(void)
{
  static const char *const numbers[] = {"1", "2"};
  uint32_t n_large = 0;
  char limit[16];
  reset();
  snprintf(limit, sizeof(limit), "%u", (unsigned)bodies[0]->n_springs);
  set("MORPHO_FAKE_SPRINGS", limit);
  for (size_t i = 0; i < 2; i++) {
    struct mo_compute *compute = open_devices(numbers[i]);
    uint64_t rollouts = 0, spring_steps = 0;
    CHECK_INT(score(compute), MO_OK);
    for (uint32_t d = 0; d < DESIGNS; d++) {
      const bool is_large = bodies[d]->n_springs > bodies[0]->n_springs;
      n_large += is_large;
      rollouts += is_large ? 0 : ENVIRONMENTS;
      spring_steps += is_large ? 0 : (uint64_t)ENVIRONMENTS * STEPS * bodies[d]->n_springs;
      CHECK_INT(blocks[d].status, MO_OK);
      CHECK_INT(blocks[d].computed_on, is_large ? MO_ON_CPU : MO_ON_DEVICE);
      CHECK(as_expected(d));
    }
    CHECK_INT(device_rate(compute).rollouts, rollouts);
    CHECK_INT(device_rate(compute).spring_steps, spring_steps);
    score_one(compute, controller, MO_ON_DEVICE, MO_FLOAT64, MO_OK);
    CHECK_INT(blocks[0].computed_on, MO_ON_CPU);
    check_drop_from(compute);
  }
  CHECK(n_large > 0 && n_large < 2 * DESIGNS);
}

/* ---- failures ---- */

static void goes_on_without_a_device(void)
{
  struct mo_device_status status;
  reset();
  set("MORPHO_FAKE_DELAY_MS", "2");
  set("MORPHO_FAKE_ROWS", "40");
  set("MORPHO_FAKE_LOSE", "0:3");
  struct mo_compute *compute = open_devices("2");
  for (int k = 0; k < 3; k++) {
    CHECK_INT(score(compute), MO_OK);
    expect_scores(MO_ON_DEVICE);
  }
  CHECK_INT(atomic_load(&n_lost), 1);
  CHECK_INT(mo_compute_devices_working(compute), 1);
  CHECK_INT(mo_compute_devices(compute), 2);
  CHECK_INT(mo_compute_device(compute, 0, &status), MO_OK);
  CHECK_INT(status.state, MO_DEVICE_LOST);
  CHECK_TEXT(status.error, "the fake device has fallen off its bus");
}

static void ends_without_any_device(void)
{
  uint32_t n_done = 0, n_failed = 0;
  reset();
  set("MORPHO_FAKE_ROWS", "40");
  set("MORPHO_FAKE_LOSE", "0:8");
  struct mo_compute *compute = open_devices("1");
  CHECK_INT(score(compute), MO_ERR_DEVICE);
  for (uint32_t d = 0; d < DESIGNS; d++) {
    n_done += blocks[d].status == MO_OK;
    n_failed += blocks[d].status == MO_ERR_DEVICE;
    if (blocks[d].status == MO_OK)
      CHECK(as_expected(d));
  }
  CHECK_INT(n_done + n_failed, DESIGNS);
  CHECK(n_done > 0 && n_failed > 0);
  CHECK_INT(mo_compute_devices_working(compute), 0);
  CHECK_INT(score(compute), MO_ERR_DEVICE);
  /* The workers are not affected. */
  score_one(compute, controller, MO_ON_CPU, MO_FLOAT32, MO_OK);
  CHECK(as_expected(0));
}

/* Blocks that a remote taker holds when the last device is lost end when the taker puts them back:
 * the queue is no longer read. */
static void ends_what_takers_put_back(void)
{
  atomic_int done = 0;
  reset();
  set("MORPHO_FAKE_DELAY_MS", "20");
  set("MORPHO_FAKE_ROWS", "40");
  set("MORPHO_FAKE_LOSE", "0:2");
  struct mo_compute *compute = open_devices("1");
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  for (uint32_t d = 0; d < DESIGNS; d++) {
    blocks[d] = design_block(d, brain, STEPS);
    submit_counted(compute, &blocks[d], &done);
  }
  struct mo_taken *taken = mo_compute_take(compute, MO_ON_DEVICE, 1);
  REQUIRE(taken != NULL && taken->n_blocks == 1);
  struct mo_block *block = taken->blocks[0];
  REQUIRE(await(&done, DESIGNS - 1));
  usleep(50000);
  mo_compute_put_back(compute, taken);
  CHECK(await(&done, DESIGNS));
  CHECK_INT(block->status, MO_ERR_DEVICE);
}

/* Half of the blocks are cancelled, then all: the running ones end soon, and the others keep the
 * same bits. */
static void cancels(void)
{
  volatile int flags[2] = {0, 0};
  atomic_int done = 0;
  reset();
  struct mo_compute *compute = open_devices("1");
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  for (int all = 0; all < 2; all++) {
    atomic_store(&done, 0);
    flags[0] = 1;
    flags[1] = 0;
    for (uint32_t d = 0; d < DESIGNS; d++) {
      blocks[d] = design_block(d, brain, all ? 1000000 : STEPS);
      blocks[d].cancel = &flags[d % 2];
      submit_counted(compute, &blocks[d], &done);
    }
    if (all) {
      usleep(50000);
      __atomic_store_n(&flags[1], 1, __ATOMIC_RELAXED);
    }
    REQUIRE(await(&done, DESIGNS));
    for (uint32_t d = 0; d < DESIGNS; d++) {
      CHECK_INT(blocks[d].status, all || d % 2 == 0 ? MO_ERR_CANCELLED : MO_OK);
      CHECK(blocks[d].status != MO_OK || as_expected(d));
    }
  }
}

/* ---- shutdown ---- */

static void hands_everything_back_at_the_end(void)
{
  static const char *const numbers[] = {"1", "2"};
  reset();
  set("MORPHO_FAKE_DELAY_MS", "5");
  set("MORPHO_FAKE_ROWS", "40");
  for (uint32_t k = 0; k < 6; k++) {
    struct mo_compute *compute = open_devices(numbers[k % 2]);
    struct mo_compute_controller *brain = NULL;
    atomic_int done = 0;
    REQUIRE(mo_compute_controller_create(compute, controller, &brain) == MO_OK);
    for (uint32_t d = 0; d < DESIGNS; d++) {
      blocks[d] = design_block(d, brain, STEPS);
      submit_counted(compute, &blocks[d], &done);
    }
    usleep(4000 * k);
    /* Weights may be freed only when they are no longer used. So the back end is freed first here,
     * and its packed weights outlive it this one time. */
    check_drop_from(compute);
    CHECK_INT(atomic_load(&done), DESIGNS);
    for (uint32_t d = 0; d < DESIGNS; d++)
      CHECK(blocks[d].status == MO_OK || blocks[d].status == MO_ERR_CANCELLED);
    free(brain);
  }
}

/* ---- shares ---- */

struct stream {
  struct mo_compute *compute;
  struct mo_block blocks[16];
  atomic_bool stop;
  atomic_int left;
};

static void again(struct mo_block *block, void *context)
{
  struct stream *stream = context;
  if (atomic_load(&stream->stop) || mo_compute_submit(stream->compute, block) != MO_OK)
    atomic_fetch_sub(&stream->left, 1);
}

/* Two jobs on one device get seconds in proportion to their weights, although one has twice as many
 * blocks waiting. A block that lost its processor for a long time leaves a debt that is paid later,
 * so the test waits that much longer. */
static void devices_are_shared_by_weight(void)
{
  static struct stream streams[2];
  static const uint32_t n[2] = {8, 16};
  static const double weights[2] = {3, 1};
  struct mo_compute_share *shares[2];
  struct mo_compute_share_stats stats[2];
  reset();
  set("MORPHO_FAKE_DELAY_MS", "5");
  set("MORPHO_FAKE_ROWS", "20");
  struct mo_compute *compute = open_devices("1");
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  for (int s = 0; s < 2; s++) {
    shares[s] = make_compute_share(compute, 1);
    mo_compute_share_set_weight(shares[s], weights[s]);
    streams[s].compute = compute;
    for (uint32_t i = 0; i < n[s]; i++) {
      streams[s].blocks[i] = design_block(i, brain, 2);
      streams[s].blocks[i].share = shares[s];
      streams[s].blocks[i].done = again;
      streams[s].blocks[i].context = &streams[s];
      atomic_fetch_add(&streams[s].left, 1);
      REQUIRE(mo_compute_submit(compute, &streams[s].blocks[i]) == MO_OK);
    }
  }
  const double late_s = now_s() + 60;
  double sum = 0, ratio = 0;
  while ((sum < 1 || ratio <= 2 || ratio >= 4.5) && now_s() < late_s) {
    usleep(5000);
    for (int s = 0; s < 2; s++)
      mo_compute_share_get_stats(shares[s], &stats[s]);
    sum = stats[0].device_s + stats[1].device_s;
    ratio = stats[1].device_s > 0 ? stats[0].device_s / stats[1].device_s : 0;
  }
  for (int s = 0; s < 2; s++)
    atomic_store(&streams[s].stop, true);
  CHECK(sum >= 1 && ratio > 2 && ratio < 4.5);
  printf("# seconds of the device: %.3f and %.3f\n", stats[0].device_s, stats[1].device_s);
  for (int s = 0; s < 2; s++)
    REQUIRE(await(&streams[s].left, 0));
}

struct order {
  atomic_int next, place[DESIGNS];
};

static void note_order(struct mo_block *block, void *context)
{
  struct order *order = context;
  atomic_store(&order->place[block - blocks], 1 + atomic_fetch_add(&order->next, 1));
}

/* Urgent blocks start before everything that is waiting, including a share that has rested and is
 * behind. The device ends its calls one by one, in the order of their starts; both callers have one
 * when the others arrive. */
static void urgent_blocks_go_first(void)
{
  enum { HELD = 2, BLOCKS = 5, URGENT = 4 };
  static struct order order;
  reset();
  struct mo_compute *compute = open_devices("1");
  void *module = dlopen(FAKE_DEVICE, RTLD_NOW);
  REQUIRE(module != NULL);
  atomic_int *turns = dlsym(module, "turns"), *started = dlsym(module, "started");
  REQUIRE(turns != NULL && started != NULL);
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  struct mo_compute_share *busy = make_compute_share(compute, 1);
  struct mo_compute_share *rested = make_compute_share(compute, 0.01);
  for (int k = 0; k < 5; k++) {
    blocks[0] = design_block(0, brain, 2);
    blocks[0].share = busy;
    CHECK_INT(mo_compute_run(compute, blocks, 1), MO_OK);
  }
  const int first = atomic_load(started);
  atomic_store(turns, first);
  for (uint32_t d = 0; d < BLOCKS; d++) {
    blocks[d] = design_block(d, brain, 2);
    blocks[d].share = d < HELD ? busy : rested;
    blocks[d].urgency = d == URGENT ? MO_INTERACTIVE : MO_BATCH;
    blocks[d].done = note_order;
    blocks[d].context = &order;
    CHECK_INT(mo_compute_submit(compute, &blocks[d]), MO_OK);
    if (d < HELD)
      REQUIRE(await(started, first + (int)d + 1));
  }
  for (int ended = 1; ended <= HELD + 1; ended++) {
    atomic_store(turns, first + ended);
    REQUIRE(await(&order.next, ended));
    if (ended == 1) /* the first call to start is what the test is about */
      REQUIRE(await(started, first + HELD + 1));
  }
  CHECK_INT(atomic_load(&order.place[URGENT]), HELD + 1);
  atomic_store(turns, INT_MAX);
  REQUIRE(await(&order.next, BLOCKS));
  dlclose(module);
}

static const struct check_case cases[] = {
    {"an unusable module is refused with a message", says_what_cannot_be_loaded},
    {"a device that cannot be opened is skipped", passes_over_what_cannot_be_opened},
    {"devices of one capability are used", uses_one_capability},
    {"scores do not depend on the number of devices", scores_do_not_depend_on_the_number},
    {"scores do not depend on available memory", scores_do_not_depend_on_memory},
    {"workers compute what devices do not support", workers_do_the_rest},
    {"rows are measured where that is requested", measures_rows},
    {"the others continue when one device is lost", goes_on_without_a_device},
    {"the loss of the last device ends only its work", ends_without_any_device},
    {"ends blocks that takers put back", ends_what_takers_put_back},
    {"cancelled blocks end soon", cancels},
    {"shutdown hands everything back", hands_everything_back_at_the_end},
    {"devices are shared by weight", devices_are_shared_by_weight},
    {"urgent blocks go first", urgent_blocks_go_first},
};
CHECK_MAIN_WITH(setup, cases)
