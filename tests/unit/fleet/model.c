/* model.c: the fleet under every behavior of workers and networks, with a clock that the test
 * advances.
 *
 * Workers join, compute, leave, are lost, fall silent, hang, fail, give leases back, repeat old
 * results and send wrong ones, while work arrives, stops and is cancelled. At the same time, every
 * block must be delivered or put back exactly once, every lease must have an owner, the counters
 * must agree, and no honest session may be refused. Argument "soak": 10^6 steps instead of 2 ×
 * 10^4. */
#include "fake.h"
#include "messages.h"

#include "fleet/sessions.h"

#define WORKERS  24
#define STEP_NS  (MO_S_NS / 50)
#define OLD_MAX  8
#define JOBS_MAX 16 /* including those that it should have dropped */
#define TICKS_NS (MO_S_NS / 50)

struct job {
  struct mo_wire_lease lease;
  uint64_t ready_ns;
};

struct worker {
  char name[16], host[16];
  uint64_t session;         /* 0 if none */
  uint64_t silent_until_ns; /* disconnected or stopped */
  double rows_per_s;
  bool is_liar;
  struct job jobs[JOBS_MAX];
  uint32_t n_jobs, n_old;
  struct mo_lease_id old[OLD_MAX]; /* results sent earlier */
};

struct world {
  struct fake *fake;
  struct mo_random random;
  struct worker workers[WORKERS];
  uint64_t ticked_ns, submitted, refused, given_back, hung;
  bool is_calm; /* from now on nothing goes wrong */
};

static uint64_t n_steps = 20000;

/* Returns true once in n times on average. */
static bool chance(struct world *world, uint32_t n)
{
  return mo_random_below(&world->random, n) == 0 && !world->is_calm;
}

/* ---- workers ---- */

static void end_job(struct worker *worker, uint32_t i)
{
  free(worker->jobs[i].lease.environments);
  free(worker->jobs[i].lease.blocks);
  worker->jobs[i] = worker->jobs[--worker->n_jobs];
}

static void forget_session(struct worker *worker)
{
  while (worker->n_jobs > 0)
    end_job(worker, 0);
  worker->session = 0;
}

static void join(struct world *world, struct worker *worker)
{
  struct fake *fake = world->fake;
  const struct mo_fleet_offer offer = fake_offer(worker->name, worker->host);
  int64_t id = mo_fleet_join(fake->fleet, &offer, fake->now_ns, NULL);
  REQUIRE(id > 0);
  worker->session = (uint64_t)id;
}

static void take_jobs(struct world *world, struct worker *worker, struct mo_wire_leases *leases)
{
  uint64_t free_ns = world->fake->now_ns;
  for (uint32_t i = 0; i < worker->n_jobs; i++)
    free_ns = worker->jobs[i].ready_ns > free_ns ? worker->jobs[i].ready_ns : free_ns;
  for (uint32_t i = 0; i < leases->n; i++) {
    const bool hangs = chance(world, 200);
    const double s = leases->items[i].n_rows / worker->rows_per_s * (hangs ? 30 : 1);
    world->hung += hangs;
    free_ns += (uint64_t)(1e9 * s);
    if (worker->n_jobs == JOBS_MAX)
      end_job(worker, 0);
    worker->jobs[worker->n_jobs++] = (struct job){leases->items[i], free_ns};
  }
}

static void read_orders(struct world *world, struct worker *worker)
{
  struct mo_fleet_orders orders;
  int r = mo_fleet_orders(world->fake->fleet, worker->session, world->fake->now_ns, &orders);
  if (r == MO_ERR_NOT_FOUND || orders.state == MO_SESSION_REFUSED) {
    CHECK(r == MO_ERR_NOT_FOUND || worker->is_liar);
    world->refused += r != MO_ERR_NOT_FOUND;
    if (r != MO_ERR_NOT_FOUND) /* it rejoins */
      CHECK_OK(mo_fleet_leave(world->fake->fleet, worker->session, false, world->fake->now_ns));
    forget_session(worker);
    return;
  }
  /* A worker does not always stop in time. */
  for (uint32_t d = 0; d < orders.n_dropped && !chance(world, 3); d++)
    for (uint32_t i = worker->n_jobs; i-- > 0;)
      if (worker->jobs[i].lease.id.number == orders.dropped[d].number)
        end_job(worker, i);
  if (orders.state == MO_SESSION_DRAINING && worker->n_jobs == 0) {
    CHECK_OK(mo_fleet_leave(world->fake->fleet, worker->session, false, world->fake->now_ns));
    forget_session(worker);
  }
}

static void add_empty(struct mo_wire_results *results, struct mo_lease_id id,
                      enum mo_wire_state state)
{
  results->items[results->n++] = (struct mo_wire_result){.id = id, .state = state};
}

/* Sends results for leases that the session does not hold: of an earlier daemon, of another
 * session, sent before, or never handed out. They must change nothing. */
static void add_foreign(struct world *world, struct worker *worker, struct mo_wire_results *results)
{
  const struct worker *other = &world->workers[mo_random_below(&world->random, WORKERS)];
  const struct mo_wire_lease *own = &worker->jobs[0].lease;
  const bool has_job = worker->n_jobs > 0;
  struct mo_lease_id ids[] = {
      {4, has_job ? own->id.number : 1},
      {5, UINT64_MAX},
      worker->n_old > 0 ? worker->old[mo_random_below(&world->random, worker->n_old)]
                        : (struct mo_lease_id){5, 0},
      other != worker && other->n_jobs > 0 ? other->jobs[0].lease.id : (struct mo_lease_id){3, 3},
  };
  const struct mo_lease_id id = ids[mo_random_below(&world->random, COUNT(ids))];
  for (uint32_t i = 0; i < worker->n_jobs; i++)
    if (memcmp(&worker->jobs[i].lease.id, &id, sizeof(id)) == 0)
      return; /* a lease may be given to the same worker twice, or be held by two sessions */
  results->items[results->n++] = result_of(id, has_job ? own->n_rows : 3);
}

static bool holds(struct mo_fleet *fleet, const struct worker *worker, uint64_t number)
{
  const struct mo_session *session = mo_session_find(fleet, worker->session);
  const struct mo_lease *lease = mo_lease_find(fleet, number);
  return session != NULL && lease != NULL && mo_lease_held_by(lease, session) >= 0;
}

static void exchange(struct world *world, struct worker *worker)
{
  struct fake *fake = world->fake;
  struct mo_wire_results results = {0};
  struct mo_wire_leases leases;
  const uint32_t n_done = fake->n_done;
  bool is_bad = false;
  if (chance(world, 30))
    add_foreign(world, worker, &results);
  for (uint32_t i = worker->n_jobs; i-- > 0 && results.n < MO_WIRE_RESULTS_MAX;) {
    struct job *job = &worker->jobs[i];
    const bool is_ready = job->ready_ns <= fake->now_ns;
    if (!is_ready && !chance(world, 300))
      continue;
    if (!is_ready || chance(world, 100)) {
      add_empty(&results, job->lease.id,
                chance(world, 10) ? MO_RESULT_FAILED : MO_RESULT_GIVEN_BACK);
      world->given_back++;
    } else {
      struct mo_wire_result *result = &results.items[results.n++];
      *result = fake_compute(&job->lease, worker->is_liar ? &world->random : NULL);
      if (chance(world, 200) && result->n_rows > 1) {
        is_bad = holds(fake->fleet, worker, job->lease.id.number);
        result->n_rows--;
        break;
      }
      worker->old[worker->n_old < OLD_MAX ? worker->n_old++
                                          : mo_random_below(&world->random, OLD_MAX)] =
          job->lease.id;
    }
    end_job(worker, i);
  }
  int error = fake_exchange(fake, worker->session, results.n > 0 ? &results : NULL, &leases);
  if (is_bad)
    CHECK(error == MO_ERR_FORMAT || error == MO_ERR_NOT_FOUND || error == MO_ERR_CONFLICT);
  if (error == MO_ERR_FORMAT) {
    CHECK(is_bad && fake->n_done == n_done);
    /* puts back everything that it has */
    CHECK_OK(mo_fleet_leave(fake->fleet, worker->session, true, fake->now_ns));
  }
  if (error == MO_ERR_CONFLICT)
    CHECK(worker->is_liar);
  if (error != MO_OK) {
    CHECK(error == MO_ERR_FORMAT || error == MO_ERR_NOT_FOUND || error == MO_ERR_CONFLICT);
    forget_session(worker);
    return;
  }
  take_jobs(world, worker, &leases);
}

static void visit(struct world *world, struct worker *worker)
{
  struct fake *fake = world->fake;
  if (worker->silent_until_ns > fake->now_ns)
    return;
  if (chance(world, 400)) {
    worker->silent_until_ns = fake->now_ns + MO_S_NS * (1 + mo_random_below(&world->random, 9));
    return;
  }
  if (worker->session == 0) {
    if (!worker->is_liar || !world->is_calm)
      join(world, worker);
    return;
  }
  if (chance(world, 400)) {
    const bool is_lost = chance(world, 2);
    int error = mo_fleet_leave(fake->fleet, worker->session, is_lost, fake->now_ns);
    CHECK(error == MO_OK || error == MO_ERR_NOT_FOUND);
    forget_session(worker);
    return;
  }
  read_orders(world, worker);
  if (worker->session != 0)
    exchange(world, worker);
}

/* ---- invariants ---- */

static void check_counts(const struct world *world)
{
  struct fake *fake = world->fake;
  struct mo_fleet_status status;
  struct mo_session_status *sessions = NULL;
  size_t n = 0;
  uint32_t leases = 0, rows = 0, open = 0;
  CHECK_INT(world->submitted, (uint64_t)fake->n_waiting + fake->n_taken + fake->n_done);
  mo_fleet_status(fake->fleet, &status);
  CHECK(status.rows_done == fake->rows_done && status.audits_failed <= status.audits);
  CHECK_OK(mo_fleet_sessions(fake->fleet, &sessions, &n));
  for (size_t i = 0; i < n; i++) {
    leases += sessions[i].leases;
    rows += sessions[i].rows_out;
    open += sessions[i].ended_ns == 0 && sessions[i].state != MO_SESSION_REFUSED;
    CHECK(sessions[i].ended_ns == 0 || sessions[i].leases == 0);
  }
  CHECK(leases == status.leases && rows == status.rows_out && open == status.n_sessions);
  free(sessions);
  CHECK_INT(fake_refused(fake, ""), fake_refused(fake, "liar-"));
}

/* ---- the run ---- */

static void cancel_some(struct world *world)
{
  const struct mo_lease *lease = TAILQ_FIRST(&world->fake->fleet->leases);
  const uint32_t part = 1 + mo_random_below(&world->random, 2);
  for (uint32_t skip = mo_random_below(&world->random, 20); lease != NULL && skip > 0; skip--)
    lease = TAILQ_NEXT(lease, all);
  if (lease == NULL || lease->parcel == NULL)
    return;
  const struct mo_taken *taken = lease->parcel->taken;
  for (uint32_t i = 0; i < taken->n_blocks / part; i++)
    ((struct fake_block *)taken->blocks[i])->cancel = 1;
}

static void step(struct world *world)
{
  struct fake *fake = world->fake;
  fake->now_ns += mo_random_below(&world->random, STEP_NS);
  if (fake->now_ns - world->ticked_ns >= TICKS_NS) {
    world->ticked_ns = fake->now_ns;
    mo_fleet_tick(fake->fleet, fake->now_ns);
    fake_settle(fake);
  }
  if (fake->n_waiting < 100 && chance(world, 20))
    for (uint32_t i = 0; i < 300; i++)
      fake_submit(fake, world->submitted++);
  if (chance(world, 200))
    cancel_some(world);
  visit(world, &world->workers[mo_random_below(&world->random, WORKERS)]);
}

static void run(uint64_t seed, uint32_t n_liars)
{
  struct world *world = make_zeros(1, sizeof(*world));
  struct fake *fake = world->fake = make_fake(seed);
  fake->frees_done = true;
  fake->fleet->config.source.recompute = fake_recompute;
  world->random = dice(seed, 1, 0);
  for (uint32_t w = 0; w < WORKERS; w++) {
    struct worker *worker = &world->workers[w];
    snprintf(worker->name, sizeof(worker->name), w < n_liars ? "liar-x%u" : "worker-%u", w);
    snprintf(worker->host, sizeof(worker->host), "host-%u", w / 3);
    worker->rows_per_s = 50 * (1 + mo_random_below(&world->random, 20));
    worker->is_liar = w < n_liars;
  }
  for (uint64_t i = 0; i < n_steps && check_failures < 10; i++) {
    step(world);
    if (i % 64 == 0)
      fake_check(fake);
    if (i % 1024 == 0)
      check_counts(world);
  }
  /* Nothing goes wrong from here on: the remaining sessions must compute everything that is
   * left. */
  world->is_calm = true;
  for (uint64_t i = 0; i < 200000 && fake->n_waiting + fake->n_taken > 0; i++)
    step(world);
  CHECK(fake->n_waiting + fake->n_taken == 0);
  CHECK_INT(fake->n_done, world->submitted);
  CHECK(n_liars > 0 || fake->n_wrong == 0);
  fake_check(fake);
  check_counts(world);
  struct mo_fleet_status status;
  mo_fleet_status(fake->fleet, &status);
  printf(
      "# %u blocks, %u cancelled, %u failed; %llu leases, %llu repeated; %llu sessions, %llu lost; "
      "%llu rows twice, %llu audits, %llu failed, %u wrong rows, %llu refused; %llu ignored, "
      "%llu given back, %llu hung\n",
      fake->n_done, fake->n_cancelled, fake->n_failed, (unsigned long long)status.leases_done,
      (unsigned long long)status.leases_again, (unsigned long long)status.joined,
      (unsigned long long)status.lost, (unsigned long long)status.rows_twice,
      (unsigned long long)status.audits, (unsigned long long)status.audits_failed, fake->n_wrong,
      (unsigned long long)world->refused, (unsigned long long)status.results_ignored,
      (unsigned long long)world->given_back, (unsigned long long)world->hung);
  CHECK(status.leases_again > 0 && status.lost > 0 && status.audits > 0 &&
        status.results_ignored > 0 && (world->refused > 0) == (n_liars > 0) &&
        status.rows_twice > 0 && world->hung > 0);
  for (uint32_t w = 0; w < WORKERS; w++)
    forget_session(&world->workers[w]);
}

static void honest(void)
{
  run(1, 0);
}

static void with_liars(void)
{
  run(2, 3);
}

static const struct check_case cases[] = {{"honest workers", honest}, {"with liars", with_liars}};

int main(int argc, char **argv)
{
  if (argc > 1 && strcmp(argv[1], "soak") == 0) {
    n_steps = 1000000;
    argc = 1;
  }
  return check_run(cases, COUNT(cases), argc, argv);
}
