/* The CPU back end: the same bits for any number of workers and any order, urgent blocks overtake,
 * everything is handed back. */
#include <morpho/compute.h>

#include "../check.h"

#include <pthread.h>
#include <stdatomic.h>
#include <time.h>
#include <unistd.h>

static struct mo_controller *controller;
static struct mo_lattice *lattice;
static struct mo_environment environments[MO_PAPER_TEST_COUNT];

static int setup(void)
{
  if (controller != NULL)
    return 1;
  mo_environment_paper_test(environments);
  return mo_lattice_create(MO_DEFAULT_WORKSPACE, &lattice) == MO_OK &&
         mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &controller) == MO_OK &&
         (mo_controller_randomize(controller, 5), 1);
}

static double now_s(void)
{
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

/* Design `number`: a pillar, a plank, or something between. */
static void genotype_number(uint32_t number, uint64_t bits[MO_DEFAULT_WORDS])
{
  struct mo_random random;
  mo_random_init(&random, 2, MO_PURPOSE_CHECK, 0, number);
  do {
    memset(bits, 0, MO_DEFAULT_WORDS * sizeof(uint64_t));
    for (uint32_t v = 0; v < MO_DEFAULT_VOXELS; v++)
      if (mo_random_below(&random, 3) == 0)
        bits[v >> 6] |= UINT64_C(1) << (v & 63);
    mo_genotype_keep_largest(MO_DEFAULT_WORKSPACE, bits);
  } while (mo_genotype_count(MO_DEFAULT_WORKSPACE, bits) < 2);
  mo_genotype_place(MO_DEFAULT_WORKSPACE, bits);
}

static void fill_block(struct mo_block *block, const uint64_t *genotype,
                       struct mo_compute_controller *brain, uint32_t steps)
{
  *block = (struct mo_block){.lattice = lattice,
                             .genotype = genotype,
                             .controller = brain,
                             .n_environments = MO_PAPER_TEST_COUNT,
                             .physics = mo_default_physics(),
                             .tag = 1};
  block->physics.n_steps = steps;
  for (uint32_t i = 0; i < MO_PAPER_TEST_COUNT; i++)
    block->environments[i] = environments + i;
}

static struct mo_compute *make_compute(uint32_t n_workers)
{
  struct mo_compute *compute = NULL;
  const struct mo_compute_config config = {.n_workers = n_workers, .isa = mo_isa_best(), .nice = 1};
  return mo_compute_create_cpu(&config, &compute) == MO_OK ? compute : NULL;
}

static void same_bits_for_any_workers_and_order(void)
{
  REQUIRE(setup());
  enum { N = 24 };
  static uint64_t genotypes[N][MO_DEFAULT_WORDS];
  static struct mo_block blocks[N];
  static struct mo_outcome first[N][MO_BLOCK_LANES];
  for (uint32_t i = 0; i < N; i++)
    genotype_number(i, genotypes[i]);
  const uint32_t workers[] = {1, 2, 7};
  for (int run = 0; run < 6; run++) {
    struct mo_compute *compute = make_compute(workers[run % 3]);
    REQUIRE(compute != NULL);
    struct mo_compute_controller *brain = NULL;
    REQUIRE(mo_compute_controller_create(compute, controller, &brain) == MO_OK);
    for (uint32_t i = 0; i < N; i++) {
      const uint32_t design =
          run < 3 ? i : (i * 5 + (uint32_t)run) % N; /* N and 5 have no common factor */
      fill_block(blocks + i, genotypes[design], brain, 120);
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
    struct mo_compute_stats stats;
    mo_compute_get_stats(compute, &stats);
    CHECK_INT(stats.n_workers, workers[run % 3]);
    CHECK_INT(stats.blocks_done, N);
    CHECK_INT(stats.rollouts_done, N * MO_PAPER_TEST_COUNT);
    CHECK_INT(stats.rollout_steps, N * MO_PAPER_TEST_COUNT * 120);
    CHECK_INT(stats.queued_batch + stats.queued_interactive, 0);
    CHECK(stats.busy_s > 0);
    CHECK(stats.worker_bytes_max > 0 && stats.worker_bytes_max <= (16u << 20));
    mo_compute_controller_free(brain);
    mo_compute_free(compute);
  }
}

struct note {
  atomic_int done;
  atomic_int tag_is_right;
  double at_s;
};

static void take_note(struct mo_block *block, void *context)
{
  struct note *note = context;
  (void)block;
  note->at_s = now_s();
  atomic_store(&note->done, 1);
}

static int wait_for(atomic_int *flag, double seconds)
{
  const double end = now_s() + seconds;
  while (atomic_load(flag) == 0) {
    if (now_s() > end)
      return 0;
    usleep(200);
  }
  return 1;
}

/* One worker, inside a long batch block: an interactive block is done long before it, and the batch
 * block's bits do not change. */
static void urgent_blocks_overtake(void)
{
  REQUIRE(setup());
  uint64_t genotype[MO_DEFAULT_WORDS];
  genotype_number(3, genotype);
  struct mo_compute *compute = make_compute(1);
  REQUIRE(compute != NULL);
  struct mo_compute_controller *brain = NULL;
  REQUIRE(mo_compute_controller_create(compute, controller, &brain) == MO_OK);
  struct mo_block calm, slow, urgent[3];
  fill_block(&calm, genotype, brain, 6000);
  CHECK_INT(mo_compute_run(compute, &calm, 1), MO_OK);
  fill_block(&slow, genotype, brain, 6000);
  struct note slow_note = {0}, notes[3] = {0};
  slow.done = take_note;
  slow.context = &slow_note;
  REQUIRE(mo_compute_submit(compute, &slow) == MO_OK);
  usleep(20000);
  for (int i = 0; i < 3; i++) {
    fill_block(urgent + i, genotype, brain, 50);
    urgent[i].urgency = MO_INTERACTIVE;
    urgent[i].precision = i == 1 ? MO_FLOAT64 : MO_FLOAT32;
    urgent[i].done = take_note;
    urgent[i].context = notes + i;
    REQUIRE(mo_compute_submit(compute, urgent + i) == MO_OK);
  }
  for (int i = 0; i < 3; i++)
    CHECK(wait_for(&notes[i].done, 30));
  CHECK(atomic_load(&slow_note.done) == 0);
  REQUIRE(wait_for(&slow_note.done, 120));
  CHECK(memcmp(calm.outcomes, slow.outcomes, sizeof(calm.outcomes)) == 0);
  struct mo_compute_stats stats;
  mo_compute_get_stats(compute, &stats);
  CHECK_INT(stats.blocks_preempted, 3);
  mo_compute_controller_free(brain);
  mo_compute_free(compute);
}

/* Cancelling by flag, and by freeing the back end while blocks run and wait. */
static void cancelled_blocks_come_back(void)
{
  REQUIRE(setup());
  uint64_t genotype[MO_DEFAULT_WORDS];
  genotype_number(4, genotype);
  enum { N = 9 };
  struct mo_block blocks[N];
  struct note notes[N] = {0};
  int cancel = 0;
  struct mo_compute *compute = make_compute(2);
  REQUIRE(compute != NULL);
  struct mo_compute_controller *brain = NULL;
  REQUIRE(mo_compute_controller_create(compute, controller, &brain) == MO_OK);
  for (int i = 0; i < N; i++) {
    fill_block(blocks + i, genotype, brain, MO_STEPS_MAX);
    blocks[i].cancel = i == 0 ? &cancel : NULL;
    blocks[i].done = take_note;
    blocks[i].context = notes + i;
    REQUIRE(mo_compute_submit(compute, blocks + i) == MO_OK);
  }
  usleep(20000);
  __atomic_store_n(&cancel, 1, __ATOMIC_RELAXED);
  CHECK(wait_for(&notes[0].done, 30));
  CHECK_INT(blocks[0].status, MO_ERR_CANCELLED);
  mo_compute_free(compute);
  for (int i = 0; i < N; i++) {
    CHECK(atomic_load(&notes[i].done) == 1);
    CHECK_INT(blocks[i].status, MO_ERR_CANCELLED);
  }
  mo_compute_controller_free(brain);
}

/* Many threads submit, cancel and look at the counters while urgent blocks overtake. Meant for the
 * thread sanitizer. */
struct crowd {
  struct mo_compute *compute;
  struct mo_compute_controller *brain;
  uint32_t number;
  atomic_int *wrong;
};

static void note_tag(struct mo_block *block, void *context)
{
  struct note *note = context;
  atomic_store(&note->tag_is_right, mo_compute_current_tag() == block->tag);
  atomic_store(&note->done, 1);
}

static void *submit_many(void *argument)
{
  struct crowd *crowd = argument;
  for (uint32_t round = 0; round < 12; round++) {
    uint64_t genotype[MO_DEFAULT_WORDS];
    genotype_number(crowd->number + round, genotype);
    struct mo_block block;
    struct note note = {0};
    int cancel = 0;
    fill_block(&block, genotype, crowd->brain, round % 4 == 3 ? 20000 : 40);
    block.tag = crowd->number * 100 + round;
    block.urgency = (crowd->number + round) % 3 == 0 ? MO_INTERACTIVE : MO_BATCH;
    block.precision = round % 5 == 0 ? MO_FLOAT64 : MO_FLOAT32;
    block.cancel = &cancel;
    block.done = note_tag;
    block.context = &note;
    if (mo_compute_submit(crowd->compute, &block) != MO_OK)
      atomic_fetch_add(crowd->wrong, 1);
    if (round % 4 == 3)
      __atomic_store_n(&cancel, 1, __ATOMIC_RELAXED);
    struct mo_compute_stats stats;
    mo_compute_get_stats(crowd->compute, &stats);
    if (!wait_for(&note.done, 120) || (block.status != MO_OK && round % 4 != 3) ||
        stats.n_busy > stats.n_workers || !atomic_load(&note.tag_is_right))
      atomic_fetch_add(crowd->wrong, 1);
  }
  return NULL;
}

static void a_crowd_of_submitters(void)
{
  REQUIRE(setup());
  enum { THREADS = 8 };
  struct mo_compute *compute = make_compute(3);
  REQUIRE(compute != NULL);
  struct mo_compute_controller *brain = NULL;
  REQUIRE(mo_compute_controller_create(compute, controller, &brain) == MO_OK);
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
  struct mo_compute_stats stats;
  mo_compute_get_stats(compute, &stats);
  CHECK_INT(stats.blocks_done, THREADS * 12);
  mo_compute_controller_free(brain);
  mo_compute_free(compute);
}

/* A block's results are those of its own precision and its own physics, and divergences are
 * counted. */
static void blocks_are_what_was_asked_for(void)
{
  REQUIRE(setup());
  uint64_t genotype[MO_DEFAULT_WORDS];
  genotype_number(6, genotype);
  struct mo_compute *compute = make_compute(2);
  struct mo_compute_controller *brain = NULL;
  struct mo_body *body = NULL;
  struct mo_workspace_memory *memory = NULL;
  REQUIRE(compute != NULL && mo_compute_controller_create(compute, controller, &brain) == MO_OK);
  REQUIRE(mo_body_create(lattice, genotype, &body) == MO_OK &&
          mo_workspace_memory_create(&memory) == MO_OK);
  struct mo_block blocks[4];
  for (int i = 0; i < 4; i++) {
    fill_block(blocks + i, genotype, brain, 100);
    blocks[i].precision = i & 1 ? MO_FLOAT64 : MO_FLOAT32;
    blocks[i].physics.stiffness_n_per_m = i & 2 ? 1e6 : 15000; /* the stiff ones diverge */
  }
  CHECK_INT(mo_compute_run(compute, blocks, 4), MO_OK);
  uint64_t diverged = 0;
  for (int i = 0; i < 4; i++) {
    struct mo_pack *pack = NULL;
    struct mo_outcome outcomes[MO_PAPER_TEST_COUNT];
    REQUIRE(mo_pack_create(controller, mo_isa_best(), blocks[i].precision, &pack) == MO_OK);
    CHECK_INT(mo_rollout_block(memory, pack, body, blocks[i].environments, MO_PAPER_TEST_COUNT,
                               &blocks[i].physics, NULL, NULL, outcomes),
              MO_OK);
    CHECK(memcmp(outcomes, blocks[i].outcomes, sizeof(outcomes)) == 0);
    for (int e = 0; e < MO_PAPER_TEST_COUNT; e++)
      diverged += outcomes[e].diverged_step > 0;
    mo_pack_free(pack);
  }
  CHECK(memcmp(blocks[0].outcomes, blocks[1].outcomes, sizeof(blocks[0].outcomes)) != 0);
  struct mo_compute_stats stats;
  mo_compute_get_stats(compute, &stats);
  CHECK_INT(diverged, 2 * MO_PAPER_TEST_COUNT);
  CHECK_INT(stats.rollouts_diverged, diverged);
  mo_workspace_memory_free(memory);
  mo_body_free(body);
  mo_compute_controller_free(brain);
  mo_compute_free(compute);
}

/* A submitter that answers a cancelled block with the next one is turned away once the back end is
 * being freed: it would have no end otherwise. */
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
  REQUIRE(setup());
  uint64_t genotype[MO_DEFAULT_WORDS];
  genotype_number(4, genotype);
  struct mo_compute *compute = make_compute(1);
  struct mo_compute_controller *brain = NULL;
  REQUIRE(compute != NULL && mo_compute_controller_create(compute, controller, &brain) == MO_OK);
  struct mo_block blocks[2];
  struct stubborn stubborn = {.compute = compute};
  for (int i = 0; i < 2; i++) {
    fill_block(blocks + i, genotype, brain, MO_STEPS_MAX);
    blocks[i].done = submit_again;
    blocks[i].context = &stubborn;
    REQUIRE(mo_compute_submit(compute, blocks + i) == MO_OK);
  }
  mo_compute_free(compute);
  CHECK_INT(atomic_load(&stubborn.refused), 2);
  CHECK_INT(atomic_load(&stubborn.accepted), 0);
  mo_compute_controller_free(brain);
}

static void passive_and_faults(void)
{
  REQUIRE(setup());
  struct mo_compute *compute = NULL;
  CHECK_INT(mo_compute_create_cpu(&(struct mo_compute_config){.n_workers = 100000}, &compute),
            MO_ERR_RANGE);
  CHECK_INT(mo_compute_create_cpu(&(struct mo_compute_config){.nice = 40}, &compute), MO_ERR_RANGE);
  mo_compute_free(NULL);
  mo_compute_controller_free(NULL);
  compute = make_compute(0);
  REQUIRE(compute != NULL);
  CHECK(strstr(mo_compute_fingerprint(compute, MO_FLOAT32), mo_isa_name(mo_isa_best())) != NULL);
  CHECK(strcmp(mo_compute_fingerprint(compute, MO_FLOAT32),
               mo_compute_fingerprint(compute, MO_FLOAT64)) != 0);
  CHECK_INT(mo_compute_current_tag(), -1);
  struct mo_compute_controller *brain = NULL, *none = NULL;
  REQUIRE(mo_compute_controller_create(compute, controller, &brain) == MO_OK);
  REQUIRE(mo_compute_controller_create(compute, NULL, &none) == MO_OK);
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
  struct mo_environment bad = environments[0];
  bad.terrain_heights_m[7] = NAN;
  for (int fault = 0; fault < 7; fault++) {
    fill_block(blocks, genotype, brain, 100);
    blocks[0].done = take_note;
    switch (fault) {
    case 0: blocks[0].n_environments = 0; break;
    case 1: blocks[0].n_environments = MO_BLOCK_LANES + 1; break;
    case 2: blocks[0].controller = NULL; break;
    case 3: blocks[0].genotype = NULL; break;
    case 4: blocks[0].environments[9] = &bad; break;
    case 5: blocks[0].physics.dt_s = -1; break;
    default: blocks[0].done = NULL; break;
    }
    CHECK_INT(mo_compute_submit(compute, blocks), MO_ERR_INVALID);
  }
  mo_compute_controller_free(none);
  mo_compute_controller_free(brain);
  mo_compute_free(compute);
}

static const struct check_case cases[] = {
    {"the same bits for any workers and order", same_bits_for_any_workers_and_order},
    {"urgent blocks overtake", urgent_blocks_overtake},
    {"cancelled blocks come back", cancelled_blocks_come_back},
    {"a crowd of submitters", a_crowd_of_submitters},
    {"blocks are what was asked for", blocks_are_what_was_asked_for},
    {"no block is taken after the end", no_block_is_taken_after_the_end},
    {"passive bodies and faults", passive_and_faults},
};
CHECK_MAIN(cases)
