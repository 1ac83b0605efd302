/* Shares on running workers: time by weight among submitters of short and long blocks and of
 * gradients, urgent blocks charged to no share, the same bits in any order, and shares that come
 * and go. fair.c tests the arithmetic. */
#include "fixture.h"

enum { BODIES = 64, ROBOTS = 320, INSIDE = 6, LENGTHS = 3 };

/* Rollout steps of a gradient. Sanitizers slow down the work between two batches more than the
 * kernels; longer rollouts compensate for that. */
#ifdef __SANITIZE_THREAD__
#define GRADIENT_STEPS 200
#elif defined(__SANITIZE_ADDRESS__)
#define GRADIENT_STEPS 40
#else
#define GRADIENT_STEPS 4
#endif

#if defined(__SANITIZE_ADDRESS__) ||                                                               \
    defined(__SANITIZE_THREAD__) /* blocks take long there: fewer in the same time */
static const uint32_t lengths[LENGTHS] = {1, 6, 20};
static const double tolerance = 0.3;
#else
static const uint32_t lengths[LENGTHS] = {10, 60, 200}; /* steps */
static const double tolerance = 0.1;
#endif
static struct mo_environment environments[MO_PAPER_TEST_COUNT];
static struct mo_robot *robots;
static struct mo_outcome expected[LENGTHS][MO_BLOCK_LANES];

static void setup(void)
{
  make_scene();
  mo_environment_paper_test(environments);
  robots = make_robots(lattice, 3, 3, ROBOTS);
  for (uint32_t i = BODIES; i < ROBOTS; i++)
    robots[i].body = robots[i % BODIES].body;
}

static void fill_block(struct mo_block *block, struct mo_compute_controller *brain,
                       struct mo_compute_share *share, uint32_t steps)
{
  *block = block_of(NULL, robots[7].body, brain, environments, MO_PAPER_TEST_COUNT, steps);
  block->share = share;
}

/* ---- submitters that keep INSIDE blocks queued or running until they are stopped ---- */

struct submitter {
  struct mo_compute *compute;
  struct mo_compute_controller *brain;
  struct mo_compute_share *share;
  struct mo_block blocks[INSIDE];
  int shortest, n_lengths; /* the lengths that its blocks cycle through */
  atomic_uint turn;
  atomic_bool stop;
  atomic_int inside, wrong;
};

static void next(struct submitter *submitter, struct mo_block *block);

static void again(struct mo_block *block, void *context)
{
  struct submitter *submitter = context;
  const size_t bytes = MO_PAPER_TEST_COUNT * sizeof(struct mo_outcome);
  if (block->status != MO_OK || memcmp(block->outcomes, expected[block->tag], bytes) != 0)
    atomic_fetch_add(&submitter->wrong, 1);
  if (atomic_load(&submitter->stop))
    atomic_fetch_sub(&submitter->inside, 1);
  else
    next(submitter, block);
}

static void next(struct submitter *submitter, struct mo_block *block)
{
  const int length = submitter->shortest +
                     (int)(atomic_fetch_add(&submitter->turn, 1) % (unsigned)submitter->n_lengths);
  fill_block(block, submitter->brain, submitter->share, lengths[length]);
  block->tag = length;
  block->done = again;
  block->context = submitter;
  if (mo_compute_submit(submitter->compute, block) != MO_OK)
    atomic_fetch_sub(&submitter->inside, 1);
}

static void begin(struct submitter *submitter, struct mo_compute *compute,
                  struct mo_compute_controller *brain, struct mo_compute_share *share, int shortest,
                  int n_lengths)
{
  *submitter = (struct submitter){.compute = compute,
                                  .brain = brain,
                                  .share = share,
                                  .shortest = shortest,
                                  .n_lengths = n_lengths};
  atomic_store(&submitter->inside, INSIDE);
  for (int i = 0; i < INSIDE; i++)
    next(submitter, submitter->blocks + i);
}

static int end(struct submitter *submitter)
{
  atomic_store(&submitter->stop, true);
  return await(&submitter->inside, 0) && atomic_load(&submitter->wrong) == 0;
}

static double busy_s(const struct mo_compute_share *share)
{
  struct mo_compute_share_stats stats;
  mo_compute_share_get_stats(share, &stats);
  return stats.busy_s;
}

/* Checks the fraction of worker seconds that each of n shares gets from now on. Once they have had
 * `seconds`, it must be within `tolerance` of the expected one. A block that lost its processor for
 * a long time leaves a debt that is paid later, so the test waits up to twelve times as long. */
static bool gets(struct mo_compute_share *const *shares, int n, double seconds,
                 const double *wanted)
{
  double before[4], part[4] = {0}, sum = 0, late_s = now_s() + 600;
  bool right = false;
  for (int i = 0; i < n; i++)
    before[i] = busy_s(shares[i]);
  while ((sum < seconds || (!right && sum < 12 * seconds)) && now_s() < late_s) {
    usleep(500);
    sum = 0;
    for (int i = 0; i < n; i++)
      sum += part[i] = busy_s(shares[i]) - before[i];
    right = sum > 0;
    for (int i = 0; i < n; i++) {
      part[i] /= sum > 0 ? sum : 1;
      right = right && fabs(part[i] - wanted[i]) <= tolerance * wanted[i];
    }
  }
  printf("# %.1f worker seconds:", sum);
  for (int i = 0; i < n; i++)
    printf(" %.3f (%.3f)", part[i], wanted[i]);
  printf("\n");
  return right;
}

static int expect(struct mo_compute *compute, struct mo_compute_controller *brain)
{
  struct mo_block blocks[LENGTHS];
  for (int i = 0; i < LENGTHS; i++)
    fill_block(blocks + i, brain, NULL, lengths[i]);
  const int status = mo_compute_run(compute, blocks, LENGTHS);
  for (int i = 0; i < LENGTHS; i++)
    memcpy(expected[i], blocks[i].outcomes, sizeof(expected[i]));
  return status;
}

static void time_by_weight(void)
{
  struct mo_compute *compute = make_compute(2);
  struct mo_compute_share *shares[3];
  static struct submitter submitters[3];
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  REQUIRE(expect(compute, brain) == MO_OK);
  for (int i = 0; i < 3; i++)
    shares[i] = make_compute_share(compute, 1 << i);
  begin(&submitters[0], compute, brain, shares[0], 2, 1); /* only long blocks */
  begin(&submitters[1], compute, brain, shares[1], 0, 1); /* only short blocks */
  begin(&submitters[2], compute, brain, shares[2], 0, 3);
  CHECK(gets(shares, 3, 2, (const double[]){1.0 / 7, 2.0 / 7, 4.0 / 7}));
  mo_compute_share_set_weight(shares[0], 14);
  CHECK(gets(shares, 3, 1, (const double[]){0.7, 0.1, 0.2}));
  for (int i = 0; i < 3; i++) {
    CHECK(end(&submitters[i]));
    struct mo_compute_share_stats stats;
    mo_compute_share_get_stats(shares[i], &stats);
    CHECK_INT(stats.waiting, 0);
    CHECK(stats.blocks_done > 0 && stats.urgent_s == 0);
  }
}

/* ---- gradients ---- */

struct learner {
  struct mo_compute *compute;
  struct mo_compute_share *share;
  atomic_bool stop;
  int status;
};

static void *learn(void *argument)
{
  struct learner *learner = argument;
  struct mo_gradient_state *state = NULL;
  static struct mo_outcome outcomes[ROBOTS];
  double *d_parameters = malloc(controller->n_parameters * sizeof(double));
  struct mo_gradient_batch batch = {.controller = controller,
                                    .robots = robots,
                                    .n = ROBOTS,
                                    .physics = mo_paper_physics(),
                                    .share = learner->share,
                                    .d_parameters = d_parameters,
                                    .outcomes = outcomes};
  batch.physics.scheme.n_steps = GRADIENT_STEPS;
  learner->status =
      d_parameters == NULL ? MO_ERR_NO_MEMORY : mo_gradient_state_create(learner->compute, &state);
  while (learner->status == MO_OK && !atomic_load(&learner->stop))
    learner->status = mo_compute_gradient(state, &batch);
  mo_gradient_state_free(state);
  free(d_parameters);
  return NULL;
}

/* Its blocks are long, and it has none between two batches; it gets half the time anyway. */
static void gradients_beside_scores(void)
{
  struct mo_compute *compute = make_compute(2);
  struct mo_compute_share *shares[2];
  static struct submitter submitter;
  pthread_t thread;
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  REQUIRE(expect(compute, brain) == MO_OK);
  for (int i = 0; i < 2; i++)
    shares[i] = make_compute_share(compute, 1);
  struct learner learner = {.compute = compute, .share = shares[0]};
  REQUIRE(pthread_create(&thread, NULL, learn, &learner) == 0);
  begin(&submitter, compute, brain, shares[1], 0, 3);
  CHECK(gets(shares, 2, 2.5, (const double[]){0.5, 0.5}));
  atomic_store(&learner.stop, true);
  pthread_join(thread, NULL);
  CHECK_INT(learner.status, MO_OK);
  CHECK(end(&submitter));
}

/* ---- urgent blocks ---- */

static void urgent_blocks_are_charged_to_nobody(void)
{
  struct mo_compute *compute = make_compute(1);
  struct mo_block slow, urgent[4];
  atomic_int done = 0;
  int cancel = 0;
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  const double before_s = processor_s();
  struct mo_compute_share *calm = make_compute_share(compute, 1);
  struct mo_compute_share *hasty = make_compute_share(compute, 1);
  fill_block(&slow, brain, calm,
             MO_STEPS_MAX); /* runs as long as the urgent ones take, then cancelled */
  slow.cancel = &cancel;
  submit_counted(compute, &slow, &done);
  struct mo_compute_stats stats;
  do {
    usleep(200);
    mo_compute_get_stats(compute, &stats);
  } while (stats.n_busy == 0);
  for (int i = 0; i < 4; i++) {
    fill_block(urgent + i, brain, hasty, 5 * lengths[2]);
    urgent[i].urgency = MO_INTERACTIVE;
    submit_counted(compute, urgent + i, &done);
  }
  CHECK(await(&done, 4));
  __atomic_store_n(&cancel, 1, __ATOMIC_RELAXED);
  REQUIRE(await(&done, 5));
  do {
    usleep(200);
    mo_compute_get_stats(compute, &stats);
  } while (stats.n_busy > 0);
  struct mo_compute_share_stats of_calm, of_hasty;
  mo_compute_share_get_stats(calm, &of_calm);
  mo_compute_share_get_stats(hasty, &of_hasty);
  CHECK_INT(slow.status, MO_ERR_CANCELLED);
  CHECK_INT(stats.blocks_preempted, 4);
  CHECK(of_hasty.urgent_s == of_hasty.busy_s && of_hasty.urgent_s > 0);
  CHECK(of_calm.urgent_s == 0 && of_calm.busy_s > 0);
  CHECK_INT(of_hasty.blocks_done, 4);
  CHECK_INT(of_calm.blocks_done, 1);
  /* No time is counted twice (a worker's time includes that of its blocks), and little is lost, no
   * matter how loaded the machine is. */
  CHECK(of_calm.busy_s + of_hasty.busy_s <= (1 + 1e-9) * stats.busy_s);
  CHECK(of_calm.busy_s + of_hasty.busy_s > (processor_s() - before_s) / 2);
}

/* ---- shares that come and go ---- */

struct visitor {
  struct mo_compute *compute;
  struct mo_compute_controller *brain;
  int number;
  atomic_int *wrong;
};

static void *visit(void *argument)
{
  const struct visitor *visitor = argument;
  enum { N = 5 };
  for (int round = 0; round < 10; round++) {
    struct mo_compute_share *share = NULL;
    struct mo_block blocks[N];
    atomic_int done = 0;
    int cancel = 0;
    if (mo_compute_share_create(visitor->compute, 1 + visitor->number, &share) != MO_OK) {
      atomic_fetch_add(visitor->wrong, 1);
      break;
    }
    for (int i = 0; i < N; i++) {
      fill_block(blocks + i, visitor->brain, share, i == 0 ? MO_STEPS_MAX : lengths[0]);
      blocks[i].cancel = &cancel;
      blocks[i].urgency = i == 3 ? MO_INTERACTIVE : MO_BATCH;
      blocks[i].done = count_one;
      blocks[i].context = &done;
      if (mo_compute_submit(visitor->compute, blocks + i) != MO_OK)
        atomic_fetch_add(visitor->wrong, 1);
    }
    mo_compute_share_set_weight(share, 1 + (visitor->number + round) % 7);
    struct mo_compute_share_stats stats;
    mo_compute_share_get_stats(share, &stats);
    usleep(500 * (useconds_t)(round % 3));
    __atomic_store_n(&cancel, 1, __ATOMIC_RELAXED);
    if (!await(&done, N) || stats.waiting > N || blocks[0].status != MO_ERR_CANCELLED)
      atomic_fetch_add(visitor->wrong, 1);
    mo_compute_share_free(share);
  }
  return NULL;
}

static void shares_come_and_go(void)
{
  enum { THREADS = 6 };
  struct mo_compute *compute = make_compute(3);
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  pthread_t threads[THREADS];
  struct visitor visitors[THREADS];
  atomic_int wrong = 0;
  for (int i = 0; i < THREADS; i++) {
    visitors[i] = (struct visitor){compute, brain, i, &wrong};
    REQUIRE(pthread_create(threads + i, NULL, visit, visitors + i) == 0);
  }
  for (int i = 0; i < THREADS; i++)
    pthread_join(threads[i], NULL);
  CHECK_INT(atomic_load(&wrong), 0);
  const struct mo_compute_stats stats = stats_of(compute);
  CHECK_INT(stats.queued_batch + stats.queued_interactive, 0);
}

/* The back end is freed while blocks of shares are waiting: all are handed back, and the shares may
 * be freed afterward. */
static void the_end_with_blocks_waiting(void)
{
  enum { N = 8 };
  struct mo_compute *compute = make_compute(1);
  struct mo_compute_share *shares[2];
  struct mo_block blocks[N];
  atomic_int done = 0;
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  for (int i = 0; i < 2; i++)
    shares[i] = make_compute_share(compute, i == 0 ? -1 : 1e9);
  for (int i = 0; i < N; i++) {
    fill_block(blocks + i, brain, shares[i % 2], MO_STEPS_MAX);
    submit_counted(compute, blocks + i, &done);
  }
  mo_compute_free(check_take(compute));
  CHECK_INT(atomic_load(&done), N);
  for (int i = 0; i < N; i++)
    CHECK_INT(blocks[i].status, MO_ERR_CANCELLED);
  mo_compute_share_free(NULL);
}

static const struct check_case cases[] = {
    {"time by weight", time_by_weight},
    {"gradients along with scores", gradients_beside_scores},
    {"urgent blocks are charged to no share", urgent_blocks_are_charged_to_nobody},
    {"shares come and go", shares_come_and_go},
    {"shutdown with waiting blocks", the_end_with_blocks_waiting},
};
CHECK_MAIN_WITH(setup, cases)
