/* The CPU back end: the same bits for any number of workers and any order; urgent blocks overtake;
 * everything is handed back. */
#include "fixture.h"

#include "base/thread.h"

static struct mo_environment environments[MO_PAPER_TEST_COUNT];

static void setup(void)
{
  make_scene();
  mo_environment_paper_test(environments);
}

/* Returns the body of design `number`: a pillar, a plank, or something in between. */
static void genotype_number(uint32_t number, uint64_t bits[MO_DEFAULT_WORDS])
{
  struct mo_random random = dice(2, 0, number);
  do {
    memset(bits, 0, MO_DEFAULT_WORDS * sizeof(uint64_t));
    for (uint32_t v = 0; v < MO_DEFAULT_VOXELS; v++)
      if (mo_random_below(&random, 3) == 0)
        bits[v >> 6] |= UINT64_C(1) << (v & 63);
    mo_genotype_keep_largest(MO_DEFAULT_WORKSPACE, bits);
  } while (mo_genotype_count(MO_DEFAULT_WORKSPACE, bits) < 2);
  mo_genotype_place(MO_DEFAULT_WORKSPACE, bits);
}

/* Rollout steps of a block that others overtake, and of one that is not overtaken. A sanitizer
 * needs eight times as long for each. */
#ifdef __SANITIZE_ADDRESS__
enum { LONG = 1500, SHORT = 40 };
#else
enum { LONG = 6000, SHORT = 120 };
#endif

static void fill_block(struct mo_block *block, const uint64_t *genotype,
                       struct mo_compute_controller *brain, uint32_t steps)
{
  *block = block_of(genotype, NULL, brain, environments, MO_PAPER_TEST_COUNT, steps);
}

static void same_bits_for_any_workers_and_order(void)
{
  enum { N = 24 };
  static uint64_t genotypes[N][MO_DEFAULT_WORDS];
  static struct mo_block blocks[N];
  static struct mo_outcome first[N][MO_BLOCK_LANES];
  for (uint32_t i = 0; i < N; i++)
    genotype_number(i, genotypes[i]);
  const uint32_t workers[] = {1, 2, 7};
  for (int run = 0; run < 6; run++) {
    struct mo_compute *compute = make_compute(workers[run % 3]);
    struct mo_compute_controller *brain = make_compute_controller(compute, controller);
    for (uint32_t i = 0; i < N; i++) {
      const uint32_t design =
          run < 3 ? i : (i * 5 + (uint32_t)run) % N; /* N and 5 have no common factor */
      fill_block(blocks + i, genotypes[design], brain, SHORT);
      blocks[i].tag = design;
      blocks[i].urgency = i % 5 == 3 ? MO_INTERACTIVE : MO_BATCH;
    }
    CHECK_INT(mo_compute_run(compute, blocks, N), MO_OK);
    for (uint32_t i = 0; i < N; i++) {
      CHECK_INT(blocks[i].status, MO_OK);
      const size_t bytes = MO_PAPER_TEST_COUNT * sizeof(struct mo_outcome);
      if (run == 0)
        memcpy(first[blocks[i].tag], blocks[i].outcomes, bytes);
      else
        CHECK(memcmp(first[blocks[i].tag], blocks[i].outcomes, bytes) == 0);
      CHECK(isfinite(blocks[i].outcomes[0].loss));
    }
    const struct mo_compute_stats stats = stats_of(compute);
    CHECK_INT(stats.n_workers, workers[run % 3]);
    CHECK_INT(stats.blocks_done, N);
    CHECK_INT(stats.rollouts_done, N * MO_PAPER_TEST_COUNT);
    CHECK_INT(stats.rollout_steps, N * MO_PAPER_TEST_COUNT * SHORT);
    CHECK_INT(stats.queued_batch + stats.queued_interactive, 0);
    CHECK(stats.busy_s > 0);
    CHECK(stats.worker_bytes_max > 0 && stats.worker_bytes_max <= (16u << 20));
    check_drop_from(compute);
  }
}

/* More workers than processors: the share is charged processor time, without the time in which its
 * threads waited for a processor. */
static void charges_processor_time(void)
{
  enum { N = 64 };
  static uint64_t genotypes[N][MO_DEFAULT_WORDS];
  static struct mo_block blocks[N];
  struct mo_compute *compute = make_compute(16);
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  struct mo_compute_share *share = make_compute_share(compute, 1);
  for (uint32_t i = 0; i < N; i++) {
    genotype_number(i, genotypes[i]);
    fill_block(blocks + i, genotypes[i], brain, SHORT);
    blocks[i].share = share;
    blocks[i].urgency = i % 8 == 0 ? MO_INTERACTIVE : MO_BATCH;
  }
  const double before_s = processor_s();
  CHECK_INT(mo_compute_run(compute, blocks, N), MO_OK);
  const double used_s = processor_s() - before_s;
  struct mo_compute_share_stats stats;
  mo_compute_share_get_stats(share, &stats);
  CHECK(stats.busy_s > 0.5 * used_s && stats.busy_s <= used_s);
  check_drop_from(compute);
}

/* Waits until at most n blocks are queued: the worker has begun the others. */
static void await_queued(struct mo_compute *compute, uint64_t n)
{
  for (;;) {
    const struct mo_compute_stats stats = stats_of(compute);
    if (stats.queued_batch + stats.queued_interactive <= n)
      return;
    usleep(100);
  }
}

/* Runs a try whose long blocks have `steps` steps, with more steps if the computer paused this
 * thread for so long that they ended first. Blocks that do not overtake fail at any length. */
static void try_longer(void overtake(uint32_t steps, bool *overtook))
{
  bool overtook = false;
  for (uint32_t steps = LONG; !overtook && steps <= 16 * LONG; steps *= 4)
    overtake(steps, &overtook);
  CHECK(overtook);
}

/* One worker, inside a long batch block: an interactive block finishes long before it, and the
 * batch block's bits do not change. */
static void urgent_blocks_overtake_one(uint32_t steps, bool *overtook)
{
  uint64_t genotype[MO_DEFAULT_WORDS];
  genotype_number(3, genotype);
  struct mo_compute *compute = make_compute(1);
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  struct mo_block calm, slow, urgent[3];
  fill_block(&calm, genotype, brain, steps);
  CHECK_INT(mo_compute_run(compute, &calm, 1), MO_OK);
  fill_block(&slow, genotype, brain, steps);
  atomic_int slow_done = 0, urgent_done = 0;
  submit_counted(compute, &slow, &slow_done);
  await_queued(compute, 0);
  for (int i = 0; i < 3; i++) {
    fill_block(urgent + i, genotype, brain, 50);
    urgent[i].urgency = MO_INTERACTIVE;
    urgent[i].precision = i == 1 ? MO_FLOAT64 : MO_FLOAT32;
    submit_counted(compute, urgent + i, &urgent_done);
  }
  REQUIRE(await(&urgent_done, 3));
  const bool first = atomic_load(&slow_done) == 0;
  REQUIRE(await(&slow_done, 1));
  CHECK(SAME(calm.outcomes, slow.outcomes, COUNT(calm.outcomes)));
  *overtook = first && stats_of(compute).blocks_preempted == 3;
}

static void urgent_blocks_overtake(void)
{
  try_longer(urgent_blocks_overtake_one);
}

/* One worker, inside a long interactive block that interrupted a long batch block: an immediate
 * block finishes before both, another interactive one does not, and no bits change. */
static void immediate_block_overtakes(uint32_t steps, bool *overtook)
{
  uint64_t genotype[MO_DEFAULT_WORDS];
  genotype_number(3, genotype);
  struct mo_compute *compute = make_compute(1);
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  enum { SLOW, URGENT, NEXT, PROMPT, N };
  static const enum mo_urgency urgency[N] = {MO_BATCH, MO_INTERACTIVE, MO_INTERACTIVE,
                                             MO_IMMEDIATE};
  struct mo_block calm, blocks[N];
  atomic_int done[N] = {0};
  fill_block(&calm, genotype, brain, steps);
  CHECK_INT(mo_compute_run(compute, &calm, 1), MO_OK);
  for (int i = 0; i < N; i++) {
    fill_block(blocks + i, genotype, brain, i == PROMPT ? 50 : steps);
    blocks[i].urgency = urgency[i];
    submit_counted(compute, blocks + i, done + i);
    await_queued(compute, i >= NEXT); /* which waits for URGENT */
  }
  REQUIRE(await(&done[PROMPT], 1));
  const bool first =
      atomic_load(&done[SLOW]) + atomic_load(&done[URGENT]) + atomic_load(&done[NEXT]) == 0;
  for (int i = 0; i < PROMPT; i++) {
    REQUIRE(await(&done[i], 1));
    CHECK(SAME(calm.outcomes, blocks[i].outcomes, COUNT(calm.outcomes)));
  }
  *overtook = first && stats_of(compute).blocks_preempted == 3;
}

static void immediate_blocks_overtake_interactive_ones(void)
{
  try_longer(immediate_block_overtakes);
}

/* Cancellation by flag, and by freeing the back end while blocks run and wait. */
static void cancelled_blocks_come_back(void)
{
  uint64_t genotype[MO_DEFAULT_WORDS];
  genotype_number(4, genotype);
  enum { N = 9 };
  struct mo_block blocks[N];
  atomic_int done[N] = {0};
  int cancel = 0;
  struct mo_compute *compute = make_compute(2);
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  for (int i = 0; i < N; i++) {
    fill_block(blocks + i, genotype, brain, MO_STEPS_MAX);
    blocks[i].cancel = i == 0 ? &cancel : NULL;
    submit_counted(compute, blocks + i, done + i);
  }
  usleep(20000);
  __atomic_store_n(&cancel, 1, __ATOMIC_RELAXED);
  CHECK(await(&done[0], 1));
  CHECK_INT(blocks[0].status, MO_ERR_CANCELLED);
  mo_compute_free(check_take(compute));
  for (int i = 0; i < N; i++) {
    CHECK_INT(atomic_load(&done[i]), 1);
    CHECK_INT(blocks[i].status, MO_ERR_CANCELLED);
  }
}

/* Many threads submit, cancel and read the counters while urgent blocks overtake. Meant for the
 * thread sanitizer. */
struct crowd {
  struct mo_compute *compute;
  struct mo_compute_controller *brain;
  uint32_t number;
  atomic_int *wrong;
};

static void note_tag(struct mo_block *block, void *context)
{
  atomic_store((atomic_int *)context, mo_thread_tag == block->tag ? 1 : 2);
}

static void *submit_many(void *argument)
{
  struct crowd *crowd = argument;
  for (uint32_t round = 0; round < 12; round++) {
    uint64_t genotype[MO_DEFAULT_WORDS];
    genotype_number(crowd->number + round, genotype);
    struct mo_block block;
    atomic_int ended = 0; /* 2 = with the wrong tag */
    int cancel = 0;
    fill_block(&block, genotype, crowd->brain, round % 4 == 3 ? 20000 : 40);
    block.tag = crowd->number * 100 + round;
    block.urgency = (crowd->number + round) % 3 == 0 ? MO_INTERACTIVE : MO_BATCH;
    block.precision = round % 5 == 0 ? MO_FLOAT64 : MO_FLOAT32;
    block.cancel = &cancel;
    block.done = note_tag;
    block.context = &ended;
    if (mo_compute_submit(crowd->compute, &block) != MO_OK)
      atomic_fetch_add(crowd->wrong, 1);
    if (round % 4 == 3)
      __atomic_store_n(&cancel, 1, __ATOMIC_RELAXED);
    const struct mo_compute_stats stats = stats_of(crowd->compute);
    if (!await(&ended, 1) || (block.status != MO_OK && round % 4 != 3) ||
        stats.n_busy > stats.n_workers)
      atomic_fetch_add(crowd->wrong, 1);
  }
  return NULL;
}

static void a_crowd_of_submitters(void)
{
  enum { THREADS = 8 };
  struct mo_compute *compute = make_compute(3);
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  pthread_t threads[THREADS];
  struct crowd crowds[THREADS];
  atomic_int wrong = 0;
  for (uint32_t i = 0; i < THREADS; i++) {
    crowds[i] = (struct crowd){compute, brain, i, &wrong};
    REQUIRE(pthread_create(threads + i, NULL, submit_many, crowds + i) == 0);
  }
  for (int i = 0; i < THREADS; i++)
    pthread_join(threads[i], NULL);
  CHECK_INT(atomic_load(&wrong), 0);
  const struct mo_compute_stats stats = stats_of(compute);
  CHECK_INT(stats.blocks_done, THREADS * 12);
}

/* Each block is computed in its own precision with its own physics, and divergences are counted. */
static void blocks_are_what_was_asked_for(void)
{
  uint64_t genotype[MO_DEFAULT_WORDS];
  genotype_number(6, genotype);
  struct mo_compute *compute = make_compute(2);
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  struct mo_body *body = make_body(lattice, genotype);
  struct mo_workspace_memory *memory = make_workspace_memory();
  struct mo_block blocks[4];
  double values[4][MO_PAPER_TEST_COUNT][MO_MEASURES];
  const struct mo_measuring measurings[4] = {
      {MO_MEASURES_ALL, values[0]}, {0}, {MO_MEASURES_ALL, values[2]}, {1, values[3]}};
  for (int i = 0; i < 4; i++) {
    fill_block(blocks + i, genotype, brain, 100);
    blocks[i].measuring = i != 1 ? &measurings[i] : NULL;
    blocks[i].precision = i & 1 ? MO_FLOAT64 : MO_FLOAT32;
    blocks[i].physics.constants.stiffness_n_per_m =
        i & 2 ? 1e6 : 15000; /* the stiff bodies diverge */
  }
  CHECK_INT(mo_compute_run(compute, blocks, 4), MO_OK);
  uint64_t diverged = 0;
  for (int i = 0; i < 4; i++) {
    struct mo_outcome outcomes[MO_PAPER_TEST_COUNT];
    struct mo_pack *pack = make_pack(controller, mo_isa_best(), blocks[i].precision);
    double expected[MO_PAPER_TEST_COUNT][MO_MEASURES];
    const struct mo_measuring measuring = {measurings[i].set, expected};
    CHECK_INT(mo_rollout_block(memory, pack, body, blocks[i].environments, MO_PAPER_TEST_COUNT,
                               &blocks[i].physics, NULL, &measuring, NULL, outcomes),
              MO_OK);
    CHECK(SAME(outcomes, blocks[i].outcomes, MO_PAPER_TEST_COUNT));
    CHECK(i == 1 || memcmp(expected, values[i], sizeof(expected)) == 0);
    for (int e = 0; e < MO_PAPER_TEST_COUNT; e++)
      diverged += outcomes[e].diverged_step > 0;
  }
  CHECK(memcmp(blocks[0].outcomes, blocks[1].outcomes, sizeof(blocks[0].outcomes)) != 0);
  const struct mo_compute_stats stats = stats_of(compute);
  CHECK_INT(diverged, 2 * MO_PAPER_TEST_COUNT);
  CHECK_INT(stats.rollouts_diverged, diverged);
}

/* A submitter that reacts to a cancelled block by submitting the next one is refused once the back
 * end is being freed; otherwise this would never end. */
struct stubborn {
  struct mo_compute *compute;
  atomic_int accepted, refused;
};

static void submit_again(struct mo_block *block, void *context)
{
  struct stubborn *stubborn = context;
  if (atomic_load(&stubborn->accepted) > 1000)
    return;
  atomic_fetch_add(mo_compute_submit(stubborn->compute, block) == MO_ERR_CANCELLED
                       ? &stubborn->refused
                       : &stubborn->accepted,
                   1);
}

static void no_block_is_taken_after_the_end(void)
{
  uint64_t genotype[MO_DEFAULT_WORDS];
  genotype_number(4, genotype);
  struct mo_compute *compute = make_compute(1);
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  struct mo_block blocks[2];
  struct stubborn stubborn = {.compute = compute};
  for (int i = 0; i < 2; i++) {
    fill_block(blocks + i, genotype, brain, MO_STEPS_MAX);
    blocks[i].done = submit_again;
    blocks[i].context = &stubborn;
    REQUIRE(mo_compute_submit(compute, blocks + i) == MO_OK);
  }
  mo_compute_free(check_take(compute));
  CHECK_INT(atomic_load(&stubborn.refused), 2);
  CHECK_INT(atomic_load(&stubborn.accepted), 0);
}

static void passive_and_faults(void)
{
  mo_compute_free(NULL);
  mo_compute_controller_free(NULL);
  struct mo_compute *compute = make_compute(0);
  CHECK(strstr(mo_compute_fingerprint(compute, MO_FLOAT32), mo_isa_name(mo_isa_best())) != NULL);
  CHECK(strcmp(mo_compute_fingerprint(compute, MO_FLOAT32),
               mo_compute_fingerprint(compute, MO_FLOAT64)) != 0);
  CHECK_INT(mo_thread_tag, -1);
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  struct mo_compute_controller *none = make_compute_controller(compute, NULL);
  uint64_t genotype[MO_DEFAULT_WORDS], empty[MO_DEFAULT_WORDS] = {0};
  genotype_number(1, genotype);
  struct mo_block blocks[2];
  fill_block(blocks, genotype, none, 100);
  CHECK_INT(mo_compute_run(compute, blocks, 1), MO_OK);
  CHECK_NEAR(blocks[0].outcomes[0].loss, 1.0, 0.1);
  fill_block(blocks, empty, brain, 100);
  fill_block(blocks + 1, genotype, brain, 100);
  CHECK_INT(mo_compute_run(compute, blocks, 2), MO_ERR_EMPTY);
  CHECK_INT(blocks[1].status, MO_OK);
}

/* Computes with what takes longer: recordings, measures, states. */
static void run_with_extras(struct mo_compute *compute, struct mo_compute_controller *brain,
                            const uint64_t *genotype)
{
  static struct mo_state states[MO_PAPER_TEST_COUNT];
  static double values[MO_PAPER_TEST_COUNT][MO_MEASURES], com_m[MO_PAPER_TEST_COUNT][41][3];
  const struct mo_measuring measuring = {MO_MEASURES_ALL, values};
  struct mo_recording recordings[MO_PAPER_TEST_COUNT];
  struct mo_body *body = make_body(lattice, genotype);
  for (uint32_t e = 0; e < MO_PAPER_TEST_COUNT; e++) {
    recordings[e] = (struct mo_recording){.stride = 1, .com_m = &com_m[e][0][0]};
    make_check(mo_state_create(states + e, body->n_masses, body->n_springs, body->n_voxels),
               "a state");
  }
  struct mo_block block;
  for (int extra = 0; extra < 4; extra++) {
    fill_block(&block, genotype, brain, 40);
    block.recordings = extra == 0 ? recordings : NULL;
    block.measuring = extra == 1 ? &measuring : NULL;
    block.states.to = extra == 2 ? states : NULL;
    block.states.from = extra == 3 ? states : NULL;
    CHECK_INT(mo_compute_run(compute, &block, 1), MO_OK);
  }
  for (uint32_t e = 0; e < MO_PAPER_TEST_COUNT; e++)
    mo_state_free(states + e);
}

/* Work of one kind is summed; other kinds have sums of their own; passive and failed work has none,
 * nor has work that also records, measures, or begins or ends with states. */
static void work_is_rated(void)
{
  struct mo_compute *compute = make_compute(1);
  struct mo_compute_controller *brain = make_compute_controller(compute, controller);
  struct mo_compute_controller *none = make_compute_controller(compute, NULL);
  uint64_t genotype[MO_DEFAULT_WORDS], empty[MO_DEFAULT_WORDS] = {0};
  genotype_number(1, genotype);
  struct mo_body *body = NULL;
  REQUIRE(mo_body_create(lattice, genotype, &body) == MO_OK);
  struct mo_rate rates[MO_RATES_MAX];
  struct mo_block block;
  for (int run = 0; run < 5; run++) {
    fill_block(&block, run == 4 ? empty : genotype, run == 3 ? none : brain, 10 + 10 * run);
    if (run == 2)
      block.precision = MO_FLOAT64;
    CHECK_INT(mo_compute_run(compute, &block, 1), run == 4 ? MO_ERR_EMPTY : MO_OK);
  }
  run_with_extras(compute, brain, genotype);
  CHECK_INT(mo_compute_get_rates(compute, rates), 2);
  CHECK_INT(rates[0].precision, MO_FLOAT32);
  CHECK_INT(rates[1].precision, MO_FLOAT64);
  CHECK_INT(rates[0].blocks, 2);
  CHECK_INT(rates[0].rollouts, 2 * MO_PAPER_TEST_COUNT);
  CHECK_INT(rates[0].steps, 30 * MO_PAPER_TEST_COUNT);
  CHECK_INT(rates[0].spring_steps, (uint64_t)30 * MO_PAPER_TEST_COUNT * body->n_springs);
  CHECK_INT(rates[1].steps, 30 * MO_PAPER_TEST_COUNT);
  CHECK(rates[0].busy_s > 0 && rates[1].busy_s > 0 && !rates[0].is_gradient);
  /* More kinds than rows: the kind that is oldest in use makes room. */
  for (uint32_t i = 0; i < MO_RATES_MAX; i++) {
    fill_block(&block, genotype, brain, 1);
    block.physics.scheme.dt_s = 1e-5 * (1 + i);
    CHECK_INT(mo_compute_run(compute, &block, 1), MO_OK);
    fill_block(&block, genotype, brain, 1); /* always in use */
    CHECK_INT(mo_compute_run(compute, &block, 1), MO_OK);
  }
  CHECK_INT(mo_compute_get_rates(compute, rates), MO_RATES_MAX);
  bool has_float64 = false;
  for (uint32_t i = 0; i < MO_RATES_MAX; i++)
    has_float64 = has_float64 || rates[i].precision == MO_FLOAT64;
  CHECK(!has_float64);
  CHECK_INT(rates[0].blocks, 2 + MO_RATES_MAX);
  mo_body_free(body);
}

static const struct check_case cases[] = {
    {"the same bits for any workers and order", same_bits_for_any_workers_and_order},
    {"processor time is charged", charges_processor_time},
    {"urgent blocks overtake", urgent_blocks_overtake},
    {"immediate blocks overtake interactive ones", immediate_blocks_overtake_interactive_ones},
    {"cancelled blocks are handed back", cancelled_blocks_come_back},
    {"many submitters at once", a_crowd_of_submitters},
    {"precision and physics of each block", blocks_are_what_was_asked_for},
    {"no block is accepted after the end", no_block_is_taken_after_the_end},
    {"passive bodies and faults", passive_and_faults},
    {"work is rated", work_is_rated},
};
CHECK_MAIN_WITH(setup, cases)
