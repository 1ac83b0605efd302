/* checks.c: sessions that return different bits: how the correct result is decided, and which
 * sessions are refused. */
#include "scene.h"

/* Every character becomes two in JSON: an event's data has room for half of them. */
#define QUOTES "\"\\\"\\\"\\\"\\\"\\\"\\\"\\"
#define LONG   QUOTES QUOTES QUOTES QUOTES

static atomic_bool may_recompute;

static int recompute(struct mo_compute *compute, struct mo_workspace workspace,
                     const struct mo_wire_lease *lease, const uint8_t *file, size_t file_bytes,
                     const volatile int *cancel, double *losses, uint32_t *diverged_steps,
                     double (*measures)[MO_MEASURES])
{
  while (!atomic_load(&may_recompute) && !*cancel)
    usleep(100);
  return fake_recompute(compute, workspace, lease, file, file_bytes, cancel, losses, diverged_steps,
                        measures);
}

/* Flips one bit in the loss of the first row, or changes its last measure. */
static void lie(struct mo_wire_result *result)
{
  if (result->measures != NULL && result->diverged_steps[0] == 0) {
    result->measures[0][MO_MEASURES - 1]++;
    return;
  }
  if (result->diverged_steps[0] == 0)
    result->losses[0] = nextafter(result->losses[0], 2);
}

/* Sessions compute until two of them differ. If the process decides, all but the last return the
 * same wrong bits and are refused. Otherwise only one returns wrong bits, and it is refused
 * together with an honest one. */
static void decide(bool by_process, bool are_measured)
{
  static const struct mo_measuring measuring = {.set = MO_MEASURES_ALL};
  static const char *const names[] = {"liar" LONG, "liar-2" LONG, LONG "a"};
  struct mo_random random = dice(1, 0, 0);
  struct mo_wire_leases leases[3] = {0};
  uint64_t ids[3];
  begin(0);
  fake->frees_done = true;
  fake->measuring = are_measured ? &measuring : NULL;
  atomic_store(&may_recompute, false);
  if (by_process)
    fake->fleet->config.source.recompute = recompute;
  for (int w = 0; w < 3; w++)
    ids[w] = join(names[w]);
  for (int turn = 0; turn < 4000 && fake_refused(fake, "") < 2; turn++) {
    while (fake->n_waiting < 200)
      fake_submit(fake, (uint64_t)turn);
    for (uint32_t w = 0; w < 3; w++) {
      struct mo_wire_results results = {0};
      for (uint32_t i = 0; i < leases[w].n; i++) {
        results.items[results.n++] =
            fake_compute(&leases[w].items[i], w == 0 && !by_process ? &random : NULL);
        if (by_process && w < 2)
          lie(&results.items[i]);
      }
      mo_wire_free_leases(&leases[w]);
      if (fake_exchange(fake, ids[w], &results, &leases[w]) != MO_OK)
        CHECK(!by_process || w < 2);
    }
    /* The clock advances while the process computes. */
    const bool was_deciding = fake->fleet->decision.lease != NULL;
    const uint32_t n = fake_refused(fake, "");
    advance(0.4);
    CHECK(!by_process || fake_refused(fake, "") == n || was_deciding);
    atomic_store(&may_recompute, was_deciding);
    usleep(was_deciding ? 1000 : 0);
    fake_check(fake);
  }
  CHECK_INT(fake_refused(fake, ""), 2);
  CHECK(orders_of(ids[0]).state == MO_SESSION_REFUSED);
  CHECK(!by_process || orders_of(ids[1]).state == MO_SESSION_REFUSED);
  CHECK_TEXT(fake->event, "fleet.refused");
  CHECK_HAS(fake->data, are_measured ? "\",\"why\":\"returned inverted_voxels = "
                                     : "\",\"why\":\"returned a loss of ");
  CHECK_HAS(fake->data, by_process ? "this machine computed" : "another worker gave");
  CHECK(status().audits_failed >= 1 && status().n_sessions == 1);
  /* The same worker may join with a new session. */
  struct mo_wire_leases welcome = exchange(join(names[0]));
  mo_wire_free_leases(&welcome);
  for (int w = 0; w < 3; w++)
    mo_wire_free_leases(&leases[w]);
}

static void decided(int by_process)
{
  decide(by_process != 0, false);
}

/* Sessions whose losses are right, and whose measures are not. */
static void decided_measures(void)
{
  decide(true, true);
}

/* Shards of gradients: one per lease, spread over sessions, compared as a whole. */
static void shards(void)
{
  enum { N = 40, N_PARAMETERS = 7 };
  static struct mo_robot robots[N];
  struct mo_random random = dice(1, 0, 0);
  begin(0);
  fake->controller = make_random_controller(MO_SENSOR_INVERSE_SQRT, 1);
  struct mo_controller small = *fake->controller;
  small.n_parameters = N_PARAMETERS;
  for (uint32_t i = 0; i < N; i++)
    robots[i] =
        (struct mo_robot){.environment = &fake->environments[i], .genotype = fake->genotypes[i]};
  const struct mo_gradient_batch shard = {.controller = &small,
                                          .robots = robots,
                                          .n = N,
                                          .physics = physics_of(1000),
                                          .options = {.adjoint_bound = 2, .weight = 0.25}};
  fake->shard = &shard;
  const uint64_t ids[3] = {join("liar"), join("a"), join("b")};
  struct mo_wire_leases leases[3] = {exchange(ids[0]), exchange(ids[1]), exchange(ids[2])};
  const struct mo_wire_lease *first = &leases[0].items[0];
  REQUIRE(leases[0].n >= 1 && leases[1].n >= 1 && leases[2].n >= 1);
  CHECK(first->n_parameters == N_PARAMETERS && first->n_blocks == N && first->n_rows == N);
  CHECK(first->gradient.weight == 0.25 && first->gradient.adjoint_bound == 2);
  CHECK(SAME(first->blocks[N - 1].genotype, fake->genotypes[N - 1], MO_DEFAULT_WORDS));
  struct mo_wire_results lacking = {1, {fake_compute(first, NULL)}};
  struct mo_wire_leases none;
  lacking.items[0].n_parameters--;
  CHECK_INT(fake_exchange(fake, ids[0], &lacking, &none), MO_ERR_FORMAT);
  for (int turn = 0; turn < 1000 && fake_refused(fake, "") == 0; turn++) {
    for (int w = 0; w < 3; w++) {
      struct mo_wire_results results = {0};
      for (uint32_t i = 0; i < leases[w].n; i++)
        results.items[results.n++] = fake_compute(&leases[w].items[i], w == 0 ? &random : NULL);
      mo_wire_free_leases(&leases[w]);
      if (fake_exchange(fake, ids[w], &results, &leases[w]) != MO_OK)
        break;
    }
    advance(0.4);
    fake_check(fake);
  }
  CHECK(fake_refused(fake, "") == 2 && orders_of(ids[0]).state == MO_SESSION_REFUSED);
  CHECK_HAS(fake->data, "returned a different gradient of 40 robots than another worker");
  CHECK(fake->n_done > 0 && fake->n_wrong > 0 && fake->n_wrong < fake->n_done);
  for (int w = 0; w < 3; w++)
    mo_wire_free_leases(&leases[w]);
  for (int w = 1; w < 3; w++) /* the work of the honest session is put back */
    CHECK_OK(mo_fleet_leave(fake->fleet, ids[w], true, fake->now_ns));
}

/* A worker that computes 128 rows per second. */
struct worker {
  uint64_t id, ready_ns[2 * MO_FLEET_LEASES];
  struct mo_wire_lease leases[2 * MO_FLEET_LEASES];
  uint32_t n;
  struct mo_random *liar; /* NULL if honest */
};

/* Sends the finished results; returns false if the session no longer exists. */
static bool visit(struct worker *worker, uint32_t *sent)
{
  struct mo_wire_results results = {0};
  struct mo_wire_leases leases;
  while (worker->n > 0 && worker->ready_ns[0] <= fake->now_ns) {
    results.items[results.n++] = fake_compute(&worker->leases[0], worker->liar);
    struct mo_wire_leases done = {1, {worker->leases[0]}};
    mo_wire_free_leases(&done);
    worker->n--;
    for (uint32_t i = 0; i < worker->n; i++) {
      worker->leases[i] = worker->leases[i + 1];
      worker->ready_ns[i] = worker->ready_ns[i + 1];
    }
    (*sent)++;
  }
  if (fake_exchange(fake, worker->id, &results, &leases) != MO_OK)
    return false;
  for (uint32_t i = 0; i < leases.n; i++) {
    const uint64_t free_ns = worker->n > 0 && worker->ready_ns[worker->n - 1] > fake->now_ns
                                 ? worker->ready_ns[worker->n - 1]
                                 : fake->now_ns;
    worker->ready_ns[worker->n] = free_ns + leases.items[i].n_rows * MO_S_NS / 128;
    worker->leases[worker->n++] = leases.items[i];
  }
  return true;
}

/* One session flips a bit in one of 1000 rows, among three honest ones, with 128 rows per lease: in
 * at least 99 of 100 runs it is refused within 500 of its leases. Honest sessions are never
 * refused. */
static void liars(void)
{
  static const char *const names[4] = {"liar", "a", "b", "c"};
  uint32_t found = 0, longest = 0;
  uint64_t leases = 0, rows = 0;
  for (uint32_t seed = 0; seed < 100; seed++) {
    struct mo_random random = dice(seed, 2, 0);
    struct worker workers[4] = {{.liar = &random}};
    uint32_t sent = 0, others = 0, submitted = 0;
    fake = make_fake(seed);
    fake->frees_done = true;
    fake->fleet->config.source.recompute = fake_recompute;
    for (int w = 0; w < 4; w++)
      workers[w].id = join(names[w]);
    while (sent < 500 && fake_refused(fake, "") == 0) {
      while (fake->n_waiting < 200)
        fake_submit(fake, submitted++);
      advance(0.125);
      fake_settle(fake);
      for (int w = 0; w < 4; w++)
        CHECK(visit(&workers[w], w == 0 ? &sent : &others) || w == 0);
    }
    leases += status().leases_done;
    rows += status().rows_done;
    found += fake_refused(fake, "liar") == 1;
    longest = sent > longest ? sent : longest;
    CHECK_INT(fake_refused(fake, ""), fake_refused(fake, "liar"));
    for (int w = 0; w < 4; w++) {
      struct mo_wire_leases held = {.n = workers[w].n};
      memcpy(held.items, workers[w].leases, sizeof(held.items));
      mo_wire_free_leases(&held);
    }
    check_drop_to(0);
  }
  printf("# detected in %u of 100 runs, the last after %u leases of %.0f rows on average\n", found,
         longest, (double)rows / (double)leases);
  CHECK(found >= 99);
}

static const struct check_case cases[] = {
    {"no process decides", WITH(decided, 0)},
    {"the process decides", WITH(decided, 1)},
    {"the process decides about measures", decided_measures},
    {"shards of gradients", shards},
    {"liars are detected", liars},
};
CHECK_MAIN_AROUND(cases, drop_blocks)
