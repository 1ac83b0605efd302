/* The gradient of a batch: the same bits for any number of workers, whether or not urgent blocks
 * overtake; correct errors when it is cancelled, invalid or out of memory. */
#include "fixture.h"

#include "base/thread.h"

enum { ROBOTS = 150 };

/* The thread sanitizer makes a step thirty times slower, the other one eight times. Data that
 * threads share is touched once per block, or every few steps: rollouts a fifth as long, in the
 * same number of blocks for the same number of workers, cover everything. */
#if defined(__SANITIZE_THREAD__) || defined(__SANITIZE_ADDRESS__)
#define LIVES(steps) ((steps) / 5)
#else
#define LIVES(steps) (steps)
#endif

static struct mo_robot *robots;
static double *d_parameters[2];
static struct mo_outcome outcomes[2][ROBOTS];

static void setup(void)
{
  make_scene();
  robots = make_robots(lattice, 3, 3, ROBOTS);
  for (int k = 0; k < 2; k++)
    d_parameters[k] = make_zeros(controller->n_parameters, sizeof(double));
}

/* Wraps the real function: fails the block that starts with a certain robot, counts threads inside,
 * or makes up gradients. */
static struct {
  const struct mo_environment
      *made_up;                  /* of the robots with made-up gradients; NULL = real gradients */
  const struct mo_body *fail_at; /* NULL = no failure */
  int status;
  atomic_int begun, inside, most_inside;
  atomic_int wrong_tags;
  bool workers_hang; /* blocks with tag 7 end only when they are cancelled */
} plan;

typeof(mo_gradient_block) __real_mo_gradient_block, __wrap_mo_gradient_block;

/* Made-up numbers need not be checked for races one by one. */
#define ALONE __attribute__((no_sanitize("thread")))

/* Numbers of very different magnitudes, so that almost every order of additions has different
 * bits. */
ALONE static void make_up(uint64_t robot, float *gradient)
{
  uint64_t state = robot;
  for (size_t i = 0; i < controller->n_parameters; i++) {
    state = state * UINT64_C(6364136223846793005) + UINT64_C(1442695040888963407);
    const uint32_t exponent = 90 + (uint32_t)(state >> 20) % 64;
    const uint32_t bits = ((uint32_t)(state >> 32) & 0x807fffff) | exponent << 23;
    memcpy(&gradient[i], &bits, sizeof(bits));
  }
}

int __wrap_mo_gradient_block(struct mo_gradient_memory *memory, const struct mo_pack *pack,
                             const struct mo_robot *list, uint32_t n,
                             const struct mo_physics *physics,
                             const struct mo_gradient_options *options,
                             const struct mo_pause_point *pause, struct mo_outcome *results,
                             float *gradient, struct mo_gradient_counts *counts)
{
  if (plan.made_up != NULL) {
    while (plan.workers_hang && mo_thread_tag == 7) {
      if (pause->reached(pause->context) != 0)
        return MO_ERR_CANCELLED;
      usleep(1000);
    }
    memset(results, 0, n * sizeof(*results));
    memset(gradient, 0,
           controller->n_parameters * sizeof(float)); /* a write that the sanitizer checks */
    make_up((uint64_t)(list[0].environment - plan.made_up), gradient);
    return MO_OK;
  }
  atomic_fetch_add(&plan.begun, 1);
  const int inside = atomic_fetch_add(&plan.inside, 1) + 1;
  int most = atomic_load(&plan.most_inside);
  while (most < inside && !atomic_compare_exchange_weak(&plan.most_inside, &most, inside))
    ;
  int status = MO_OK;
  if (mo_thread_tag != 7)
    atomic_fetch_add(&plan.wrong_tags, 1);
  for (uint32_t i = 0; i < n && plan.fail_at != NULL; i++)
    if (list[i].body == plan.fail_at)
      status = plan.status;
  if (status == MO_OK)
    status = __real_mo_gradient_block(memory, pack, list, n, physics, options, pause, results,
                                      gradient, counts);
  atomic_fetch_sub(&plan.inside, 1);
  return status;
}

static struct mo_gradient_batch make_batch(uint32_t n, uint32_t n_steps, int result)
{
  struct mo_gradient_batch batch = {.controller = controller,
                                    .robots = robots,
                                    .n = n,
                                    .physics = mo_paper_physics(),
                                    .options.adjoint_bound = MO_ADJOINT_BOUND,
                                    .tag = 7,
                                    .d_parameters = d_parameters[result],
                                    .outcomes = outcomes[result]};
  batch.physics.scheme.n_steps = n_steps;
  return batch;
}

static bool same_counts(const struct mo_gradient_counts *a, const struct mo_gradient_counts *b)
{
  return a->robots == b->robots && a->steps == b->steps && a->clipped_steps == b->clipped_steps &&
         a->clipped_robots == b->clipped_robots && a->zeroed_robots == b->zeroed_robots &&
         a->diverged_robots == b->diverged_robots && a->largest == b->largest;
}

static bool same_results(uint32_t n)
{
  return SAME(d_parameters[0], d_parameters[1], controller->n_parameters) &&
         SAME(outcomes[0], outcomes[1], n);
}

static void same_bits_for_any_workers(void)
{
  static const uint32_t workers[] = {1, 2, 7};
  struct mo_gradient_counts first = {0};
  for (int run = 0; run < 3; run++) {
    struct mo_compute *compute = make_compute(workers[run]);
    struct mo_gradient_state *state = make_gradient_state(compute);
    for (int again = 0; again < 2; again++) { /* at the second call everything exists */
      struct mo_gradient_batch batch =
          make_batch(ROBOTS, LIVES(40), run == 0 && again == 0 ? 0 : 1);
      CHECK_INT(mo_compute_gradient(state, &batch), MO_OK);
      CHECK_INT(batch.counts.robots, ROBOTS);
      CHECK_INT(batch.counts.steps, ROBOTS * LIVES(40));
      if (run == 0 && again == 0)
        first = batch.counts;
      else
        CHECK(same_results(ROBOTS) && same_counts(&batch.counts, &first));
    }
    const struct mo_compute_stats stats = stats_of(compute);
    CHECK_INT(stats.gradient_robots_done, 2 * ROBOTS);
    CHECK_INT(stats.gradient_robots_diverged + stats.gradient_robots_zeroed, 0);
    CHECK_INT(stats.blocks_done, 2 * ((ROBOTS + MO_GRADIENT_ROBOTS - 1) / MO_GRADIENT_ROBOTS));
    CHECK_INT(stats.rollouts_done, 0);
    check_drop_from(compute);
  }
  double largest = 0;
  for (size_t i = 0; i < controller->n_parameters; i++)
    largest = fmax(largest, fabs(d_parameters[0][i]));
  CHECK(largest > 0);
}

enum {
  SHARD = 1024,
  MANY = 2 * SHARD + 100
}; /* the last shard is smaller, and so is the last block in it */

/* Adds made-up blocks in order within shards, and then the shards in order; and also all blocks in
 * one sequence. */
ALONE static void add_plainly(const struct mo_robot *list, uint32_t n_robots, double *by_shards,
                              double *in_one_row)
{
  static uint32_t order[MANY];
  const size_t n = controller->n_parameters;
  float *block = make_zeros(n, sizeof(float));
  double *shard = make_zeros(n, sizeof(double));
  CHECK_INT(mo_gradient_arrange(list, n_robots, order), MO_OK);
  memset(by_shards, 0, n * sizeof(double));
  memset(in_one_row, 0, n * sizeof(double));
  for (uint32_t first = 0; first < n_robots; first += SHARD) {
    memset(shard, 0, n * sizeof(double));
    for (uint32_t at = first; at < first + SHARD && at < n_robots; at += MO_GRADIENT_ROBOTS) {
      make_up(order[at], block);
      for (size_t i = 0; i < n; i++) {
        shard[i] += (double)block[i];
        in_one_row[i] += (double)block[i];
      }
    }
    for (size_t i = 0; i < n; i++)
      by_shards[i] += shard[i];
  }
  check_drop_from(block);
}

/* Blocks of 32 robots are added in order within shards of 1024, and the shards in order. */
static void shards_are_added_in_order(void)
{
  static const uint32_t sizes[] = {MANY, SHARD + 1, SHARD}, workers[] = {3, 1};
  static struct mo_environment many_environments[MANY];
  static struct mo_robot many[MANY];
  static struct mo_outcome many_outcomes[MANY];
  const size_t n = controller->n_parameters;
  double *in_one_row = make_zeros(n, sizeof(double));
  for (uint32_t i = 0; i < MANY; i++) {
    many_environments[i] = *robots[i % ROBOTS].environment;
    many[i] = (struct mo_robot){robots[i % ROBOTS].body, &many_environments[i]};
  }
  plan.made_up = many_environments;
  for (int w = 0; w < (CHECK_SANITIZED ? 1 : 2); w++) {
    struct mo_compute *compute = make_compute(workers[w]);
    struct mo_gradient_state *state = make_gradient_state(compute);
    for (size_t size = 0; size < COUNT(sizes); size++) {
      struct mo_gradient_batch batch = make_batch(sizes[size], 1, 0);
      batch.robots = many;
      batch.outcomes = many_outcomes;
      CHECK_INT(mo_compute_gradient(state, &batch), MO_OK);
      add_plainly(many, sizes[size], d_parameters[1], in_one_row);
      CHECK(SAME(batch.d_parameters, d_parameters[1], n));
      /* With one shard, or with one block more, there is only one order. */
      CHECK(SAME(in_one_row, d_parameters[1], n) == (sizes[size] < MANY));
    }
    check_drop_from(compute);
  }
  plan.made_up = NULL;
}

/* The batch's gradient is the mean of its robots' gradients, and each robot has its own outcome. */
__attribute__((unused)) static void it_is_the_mean(void)
{
  enum { N = 40, STEPS = 60 };
  struct mo_compute *compute = make_compute(2);
  struct mo_gradient_state *state = make_gradient_state(compute);
  struct mo_gradient_batch batch = make_batch(N, STEPS, 0);
  const struct mo_gradient_options options = {.adjoint_bound = 0.01,
                                              .weight = 1.0 / N,
                                              .adjoint_rule = MO_ADJOINT_RESTART,
                                              .restart_weight = 2.5};
  batch.options = options; /* each adjoint restarts at each step, and counts 2.5 times */
  batch.options.weight = 0;
  CHECK_INT(mo_compute_gradient(state, &batch), MO_OK);
  CHECK_INT(batch.counts.clipped_steps, N * STEPS);
  const size_t n = controller->n_parameters;
  memset(d_parameters[1], 0, n * sizeof(double));
  for (uint32_t i = 0; i < N; i++) {
    CHECK_INT(mo_gradient_reference(robots[i].body, controller, robots[i].environment,
                                    &batch.physics, &options, outcomes[1] + i, d_parameters[1],
                                    NULL),
              MO_OK);
    CHECK_NEAR(outcomes[0][i].loss, outcomes[1][i].loss, 1e-3);
    for (int axis = 0; axis < 3; axis++)
      CHECK_NEAR(outcomes[0][i].com_end_m[axis], outcomes[1][i].com_end_m[axis], 1e-3);
  }
  double ratio;
  const double cosine = cosine_of(d_parameters[0], d_parameters[1], n, &ratio);
  printf("# %d robots, %d steps: 1 - cosine %.2g, norms' ratio %.9g\n", N, STEPS, 1 - cosine,
         ratio);
  CHECK(cosine > 0.999); /* float32: a mass may touch the ground a step earlier or later */
  CHECK_NEAR(ratio, 1.0, 1e-3);
}

/* A call in a separate thread. */
struct call {
  struct mo_gradient_state *state;
  struct mo_gradient_batch batch;
  pthread_t thread;
  atomic_int returned;
  int status;
  double processor_s;
};

static void *make_call(void *argument)
{
  struct call *call = argument;
  struct timespec used;
  call->status = mo_compute_gradient(call->state, &call->batch);
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &used);
  call->processor_s = (double)used.tv_sec + 1e-9 * (double)used.tv_nsec;
  atomic_store(&call->returned, 1);
  return NULL;
}

static void hear_nothing(void *context)
{
  (void)context;
}

/* A remote taker: a thread with its own back end. */
struct taker {
  struct mo_compute *from, *own;
  struct mo_gradient_state *state;
  bool refuses;          /* keeps putting back the first shard, and fails the second */
  bool holds;            /* puts back a shard when it is cancelled */
  struct mo_taken *late; /* the first shard, held until the others are done; NULL if none */
  bool is_late;
  atomic_int end, taken;
  pthread_t thread;
};

static void compute_shard(struct taker *taker, struct mo_taken *taken)
{
  static double sum[1 << 20];
  static struct mo_outcome results[SHARD];
  static double losses[SHARD];
  static uint32_t diverged[SHARD];
  struct mo_gradient_batch part = *taken->shard;
  make_check(part.controller->n_parameters <= COUNT(sum) ? MO_OK : MO_ERR_LIMIT, "a sum");
  part.share = NULL;
  part.tag = 8;
  part.d_parameters = sum;
  part.outcomes = results;
  make_check(mo_compute_gradient(taker->state, &part), "a shard");
  for (uint32_t i = 0; i < part.n; i++) {
    losses[i] = results[i].loss;
    diverged[i] = (uint32_t)results[i].diverged_step;
  }
  mo_compute_deliver(
      taker->from, taken,
      &(struct mo_remote_result){
          .losses = losses, .diverged = diverged, .d_parameters = sum, .counts = part.counts});
}

static void *take_shards(void *argument)
{
  struct taker *taker = argument;
  while (!atomic_load(&taker->end)) {
    struct mo_taken *taken = mo_compute_take(taker->from, MO_ON_CPU, 1);
    if (taken == NULL && taker->late != NULL) {
      usleep(1000000);
      compute_shard(taker, taker->late);
      taker->late = NULL;
    }
    if (taken == NULL) {
      usleep(1000);
      continue;
    }
    const int n = atomic_fetch_add(&taker->taken, 1);
    while (taker->holds && !mo_taken_is_cancelled(taken))
      usleep(1000);
    if (taker->is_late && n == 0)
      taker->late = taken;
    else if (taker->holds || (taker->refuses && n < 3))
      mo_compute_put_back(taker->from, taken);
    else if (taker->refuses && n == 3)
      mo_compute_deliver(taker->from, taken,
                         &(struct mo_remote_result){.status = MO_ERR_EXHAUSTED});
    else
      compute_shard(taker, taken);
  }
  return NULL;
}

/* Takers compute all shards, the first one last, only some, or those that the workers have begun:
 * the bits are the same. A call that waits for a shard sleeps. A cancelled call waits until the
 * takers have returned their shards. */
static void takers_compute_shards(void)
{
  enum { ALL, LATE, SOME, BEGUN, CANCELLED, MODES };
  static struct mo_environment many_environments[MANY];
  static struct mo_robot many[MANY];
  static struct mo_outcome many_outcomes[MANY];
  static const uint64_t genotype;
  double *in_one_row = make_zeros(controller->n_parameters, sizeof(double));
  for (uint32_t i = 0; i < MANY; i++) {
    many_environments[i] = *robots[i % ROBOTS].environment;
    many[i] = (struct mo_robot){robots[i % ROBOTS].body, &many_environments[i], &genotype};
  }
  add_plainly(many, MANY, d_parameters[1], in_one_row);
  plan.made_up = many_environments;
  for (int mode = 0; mode < MODES; mode++) {
    struct taker taker = {.from = make_compute(2),
                          .own = make_compute(1),
                          .refuses = mode == SOME,
                          .is_late = mode == LATE,
                          .holds = mode == CANCELLED};
    struct mo_compute_share *share = NULL;
    struct mo_gradient_batch batch = make_batch(MANY, 5000, 0);
    volatile int cancel = 0;
    struct call call = {.state = make_gradient_state(taker.from)};
    taker.state = make_gradient_state(taker.own);
    REQUIRE(mo_compute_share_create(taker.from, 1, &share) == MO_OK);
    mo_compute_watch_remote(taker.from, hear_nothing, NULL);
    mo_compute_leave_remote(taker.from, mode != BEGUN);
    mo_compute_want_remote(taker.from, MO_ON_CPU, 1);
    plan.workers_hang = mode == BEGUN;
    batch.robots = many;
    batch.outcomes = many_outcomes;
    batch.share = share;
    batch.cancel = &cancel;
    call.batch = batch;
    make_check(pthread_create(&taker.thread, NULL, take_shards, &taker) != 0, "a taker");
    make_check(pthread_create(&call.thread, NULL, make_call, &call) != 0, "a thread");
    while (mode == CANCELLED && atomic_load(&taker.taken) == 0)
      usleep(1000);
    __atomic_store_n(&cancel, mode == CANCELLED, __ATOMIC_RELAXED);
    pthread_join(call.thread, NULL);
    atomic_store(&taker.end, 1);
    pthread_join(taker.thread, NULL);
    CHECK(mode != LATE || call.processor_s < 0.4); /* the shard arrives a second late */
    CHECK_INT(call.status, mode == CANCELLED ? MO_ERR_CANCELLED : MO_OK);
    CHECK(mode == CANCELLED || SAME(batch.d_parameters, d_parameters[1], controller->n_parameters));
    CHECK_INT(atomic_load(&taker.taken), mode == CANCELLED ? 1 : mode == SOME ? 5 : 3);
    CHECK_INT(stats_of(taker.from).gradient_robots_done, mode == SOME ? 2 * SHARD : 0);
    CHECK_INT(mo_compute_remote_waiting(taker.from, MO_ON_CPU), 0);
    mo_compute_share_free(share);
    check_drop_from(taker.from);
  }
  plan.made_up = NULL;
  plan.workers_hang = false;
}

static struct mo_block urgent_block(struct mo_compute_controller *brain, uint32_t i)
{
  struct mo_block block =
      block_of(NULL, robots[i].body, brain, robots[0].environment, 1, LIVES(20));
  block.urgency = MO_INTERACTIVE;
  block.tag = 9;
  return block;
}

/* Waits until a call has this many blocks inside. */
static void begin_call(struct call *call, int blocks)
{
  atomic_store(&plan.begun, 0);
  make_check(pthread_create(&call->thread, NULL, make_call, call) != 0, "a thread");
  while (atomic_load(&plan.begun) < blocks)
    usleep(100);
}

/* One worker: interactive scoring blocks arrive while it is inside a gradient, and neither changes
 * the other's result. Most of them finish with less work than a gradient block needs. This is
 * measured in processor time, which does not advance while this thread sleeps or the computer does
 * something else. */
static void urgent_blocks_overtake(void)
{
  enum { STEPS = LIVES(150), URGENT = 8 };
  struct mo_compute *compute = make_compute(1);
  struct call call = {0};
  call.state = make_gradient_state(compute);
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  struct mo_block calm[URGENT], urgent[URGENT];
  for (uint32_t i = 0; i < URGENT; i++)
    calm[i] = urgent_block(brain, i);
  CHECK_INT(mo_compute_run(compute, calm, URGENT), MO_OK);
  struct mo_gradient_batch batch = make_batch(ROBOTS, STEPS, 0);
  double start_s = processor_s();
  CHECK_INT(mo_compute_gradient(call.state, &batch), MO_OK);
  const double block_s = (processor_s() - start_s) * MO_GRADIENT_ROBOTS / ROBOTS;

  call.batch = make_batch(ROBOTS, STEPS, 1);
  atomic_store(&plan.wrong_tags, 0);
  begin_call(&call, 1);
  int overtook = 0;
  for (uint32_t i = 0; i < URGENT; i++) {
    urgent[i] = urgent_block(brain, i);
    start_s = processor_s();
    CHECK_INT(mo_compute_run(compute, urgent + i, 1), MO_OK);
    overtook += processor_s() - start_s < block_s;
    CHECK(SAME(urgent[i].outcomes, calm[i].outcomes, 1));
  }
  CHECK(atomic_load(&call.returned) == 0);
  pthread_join(call.thread, NULL);
  CHECK_INT(call.status, MO_OK);
  CHECK(same_results(ROBOTS) && same_counts(&batch.counts, &call.batch.counts));
  CHECK_INT(atomic_load(&plan.wrong_tags), 0);
  const struct mo_compute_stats stats = stats_of(compute);
  CHECK(stats.blocks_preempted >= URGENT / 2); /* a few may arrive between two gradient blocks */
  printf("# %d of %d urgent blocks took less than a gradient block, %.0f ms\n", overtook, URGENT,
         1e3 * block_s);
  CHECK(overtook > URGENT / 2);
}

/* An urgent gradient waits for the running block but not for waiting ones. */
static void urgent_gradients_go_first(void)
{
  struct mo_compute *compute = make_compute(1);
  struct call calls[2] = {{0}, {0}};
  for (int i = 0; i < 2; i++) {
    calls[i].state = make_gradient_state(compute);
    /* Long enough that the first call is still running when the second one starts. */
    calls[i].batch = make_batch(i == 0 ? ROBOTS : 3, 100, i);
    calls[i].batch.urgency = i == 0 ? MO_BATCH : MO_INTERACTIVE;
  }
  begin_call(&calls[0], 1);
  CHECK_INT(mo_compute_gradient(calls[1].state, &calls[1].batch), MO_OK);
  CHECK(atomic_load(&calls[0].returned) == 0);
  pthread_join(calls[0].thread, NULL);
  CHECK_INT(calls[0].status, MO_OK);
}

static void cancelled_calls_come_back(void)
{
  struct mo_compute *compute = make_compute(2);
  struct call call = {0};
  int cancel = 0;
  call.state = make_gradient_state(compute);
  call.batch = make_batch(ROBOTS, 5000, 1); /* many seconds */
  call.batch.cancel = &cancel;
  begin_call(&call, 2);
  usleep(20000);
  CHECK(atomic_load(&call.returned) == 0);
  const double start_s = now_s();
  __atomic_store_n(&cancel, 1, __ATOMIC_RELAXED);
  pthread_join(call.thread, NULL);
  printf("# cancelled within %.0f ms\n", 1e3 * (now_s() - start_s));
  CHECK_INT(call.status, MO_ERR_CANCELLED);
  call.batch = make_batch(ROBOTS, LIVES(40), 1);
  call.batch.cancel = &cancel;
  atomic_store(&plan.begun, 0);
  CHECK_INT(mo_compute_gradient(call.state, &call.batch), MO_ERR_CANCELLED);
  CHECK_INT(atomic_load(&plan.begun), 0);
  cancel = 0; /* and the state is as good as new */
  CHECK_INT(mo_compute_gradient(call.state, &call.batch), MO_OK);
  struct mo_gradient_batch batch = make_batch(ROBOTS, LIVES(40), 0);
  CHECK_INT(mo_compute_gradient(call.state, &batch), MO_OK);
  CHECK(same_results(ROBOTS) && same_counts(&batch.counts, &call.batch.counts));
}

/* If any block fails, the call ends with its error, after waiting for the other running blocks. */
static void failed_blocks_end_the_call(void)
{
  struct mo_compute *compute = make_compute(2);
  struct mo_gradient_state *state = make_gradient_state(compute);
  atomic_store(&plan.most_inside, 0);
  for (uint32_t robot = 0; robot < ROBOTS; robot += 37) {
    struct mo_gradient_batch batch = make_batch(ROBOTS, 10, 0);
    plan.fail_at = robots[robot].body;
    plan.status = MO_ERR_NO_MEMORY;
    CHECK_INT(mo_compute_gradient(state, &batch), MO_ERR_NO_MEMORY);
    CHECK_INT(atomic_load(&plan.inside), 0);
  }
  plan.fail_at = NULL;
  CHECK(atomic_load(&plan.most_inside) >= 1 && atomic_load(&plan.most_inside) <= 2);
  struct mo_gradient_batch batch = make_batch(ROBOTS, 10, 0);
  CHECK_INT(mo_compute_gradient(state, &batch), MO_OK);
}

static void bodies_of_another_workspace(void)
{
  struct mo_compute *compute = make_compute(1);
  struct mo_robot others[ROBOTS];
  const uint64_t one = 1;
  struct mo_gradient_state *state = make_gradient_state(compute);
  struct mo_lattice *small = make_lattice((struct mo_workspace){2, 2, 2});
  struct mo_body *stranger = make_body(small, &one);
  struct mo_gradient_batch batch = make_batch(ROBOTS, 1, 0);
  memcpy(others, robots, sizeof(others));
  others[ROBOTS - 1].body = stranger;
  batch.robots = others;
  CHECK_INT(mo_compute_gradient(state, &batch), MO_ERR_INVALID);
  batch.robots = robots;
  CHECK_INT(mo_compute_gradient(state, &batch), MO_OK);
  CHECK(strstr(mo_compute_gradient_fingerprint(compute), mo_isa_name(mo_isa_best())) != NULL);
  CHECK(strcmp(mo_compute_gradient_fingerprint(compute),
               mo_compute_fingerprint(compute, MO_FLOAT32)) != 0);
  mo_gradient_state_free(NULL);
}

/* One state serves controllers of different workspaces and sensors, one after the other; diverged
 * robots are counted. */
static void one_state_takes_any_controller(void)
{
  struct mo_compute *compute = make_compute(2);
  struct mo_outcome outcome;
  struct mo_gradient_state *state = make_gradient_state(compute);
  const struct mo_workspace workspace = {8, 5, 5};
  uint64_t bits[8] = {0x3f};
  struct mo_lattice *large = make_lattice(workspace);
  struct mo_body *body = make_body(large, bits);
  struct mo_controller *other = make_controller(workspace, MO_SENSOR_INVERSE_SQUARE);
  mo_controller_randomize(other, 8);
  double *gradient = make_zeros(other->n_parameters, sizeof(double));
  CHECK(other->n_parameters > controller->n_parameters);
  for (int round = 0; round < 4; round++) {
    struct mo_gradient_batch batch = make_batch(34, LIVES(20), round / 2);
    if (round % 2 == 1) {
      const struct mo_robot alone = {body, robots[0].environment};
      batch.controller = other;
      batch.robots = &alone;
      batch.n = 1;
      batch.d_parameters = gradient;
      batch.outcomes = &outcome;
      CHECK_INT(mo_compute_gradient(state, &batch), MO_OK);
      CHECK_INT(batch.counts.robots, 1);
    } else {
      CHECK_INT(mo_compute_gradient(state, &batch), MO_OK);
    }
  }
  CHECK(same_results(34));
  struct mo_gradient_batch stiff = make_batch(34, 60, 0);
  stiff.physics.constants.stiffness_n_per_m = 1e6;
  CHECK_INT(mo_compute_gradient(state, &stiff), MO_OK);
  uint64_t diverged = 0;
  size_t not_zero = 0;
  for (uint32_t i = 0; i < 34; i++)
    diverged += outcomes[0][i].diverged_step > 0;
  for (size_t i = 0; i < controller->n_parameters; i++)
    not_zero += d_parameters[0][i] != 0;
  CHECK_INT(diverged, 34);
  CHECK_INT(stiff.counts.diverged_robots, 34);
  CHECK_INT(not_zero, 0);
  const struct mo_compute_stats stats = stats_of(compute);
  CHECK_INT(stats.gradient_robots_diverged, 34);
}

static const struct check_case cases[] = {
    {"the same bits for any workers", same_bits_for_any_workers},
    {"shards are added in order", shards_are_added_in_order},
    {"takers compute shards", takers_compute_shards},
    {"urgent blocks overtake", urgent_blocks_overtake},
    {"urgent gradients go first", urgent_gradients_go_first},
    {"cancelled calls return", cancelled_calls_come_back},
    {"failed blocks end the call", failed_blocks_end_the_call},
    {"bodies in another workspace", bodies_of_another_workspace},
    {"one state serves any controller", one_state_takes_any_controller},
#if !defined(__SANITIZE_THREAD__) &&                                                               \
    !defined(__SANITIZE_ADDRESS__) /* slow there, and the other cases run the same code */
    {"it is the mean", it_is_the_mean},
#endif
};
CHECK_MAIN_WITH(setup, cases)
