/* memory.c: the fleet while any allocation fails: no block is lost, and nothing leaks. */
#include "../failing.h"
#include "fake.h"

static struct fake *fake;

/* Runs `work` with the first, the second, … allocation failing, each time with a new fleet and two
 * sessions that have work. At least `least` allocations must occur. */
static void each(int (*work)(const uint64_t sessions[2]), int least)
{
  bool reached = true;
  int n = 0;
  for (; reached && n < 1000; n++) {
    const struct mo_fleet_offer offers[2] = {fake_offer("a", "a"), fake_offer("b", "b")};
    uint64_t ids[2];
    fake = make_fake(1);
    fake->frees_done = true;
    fake->controller = make_random_controller(MO_SENSOR_INVERSE_SQRT, 1);
    for (uint32_t i = 0; i < 20; i++)
      fake_submit(fake, i);
    for (int i = 0; i < 2; i++)
      ids[i] = (uint64_t)mo_fleet_join(fake->fleet, &offers[i], fake->now_ns, NULL);
    left = n;
    const int error = work(ids);
    reached = left < 0;
    left = -1;
    CHECK(error == MO_ERR_NO_MEMORY || error == MO_OK || error == MO_ERR_CONFLICT);
    fake_check(fake);
    CHECK_INT(fake->n_waiting + fake->n_taken + fake->n_done, 20);
    check_drop_to(0);
  }
  printf("# %d allocations failed in turn\n", n - 1);
  CHECK(n > least);
}

static int exchange(uint64_t session, const uint8_t *up, size_t up_size, uint8_t **down)
{
  size_t size = 0;
  uint32_t n = 0;
  return mo_fleet_exchange(fake->fleet, session, up, up_size, fake->now_ns, down, &size, &n, NULL);
}

static int give(const uint64_t sessions[2])
{
  uint8_t *down = NULL;
  int error = exchange(sessions[0], NULL, 0, &down);
  free(down);
  if (error == MO_OK)
    mo_fleet_tick(fake->fleet, fake->now_ns += 7 * MO_S_NS); /* both are silent */
  return error;
}

/* A result, an audit of it, and a difference, after which the sessions are refused. */
static int take(const uint64_t sessions[2])
{
  long failing = left; /* except allocations of the test itself */
  int error = MO_OK;
  left = -1;
  uint8_t *down = NULL, *up = NULL;
  size_t up_size = 0;
  for (int turn = 0; turn < 12 && error == MO_OK; turn++) {
    struct mo_wire_results results = {0};
    struct mo_session *session = TAILQ_FIRST(&fake->fleet->sessions);
    session = turn % 2 ? TAILQ_NEXT(session, all) : session;
    for (uint32_t i = 0; i < session->n_held[0]; i++) {
      results.items[results.n++] = fake_compute(&session->held[0][i]->content, NULL);
      if (turn % 2) {
        results.items[i].losses[3] = 7;
        results.items[i].diverged_steps[3] = 0;
      }
    }
    make_check(mo_wire_put_results(&results, &up, &up_size), "results");
    mo_wire_free_results(&results);
    left = failing;
    error = exchange(sessions[turn % 2], up, up_size, &down);
    failing = left;
    left = -1;
    free(up);
    free(down);
    down = NULL;
    fake->now_ns += MO_S_NS;
  }
  CHECK(failing < 0 || fake->fleet->counts.rows_twice > 0); /* no allocation failed */
  left = failing;
  return error;
}

/* The same, but this process decides. */
static int take_disputed(const uint64_t sessions[2])
{
  fake->fleet->config.source.recompute = fake_recompute;
  const int error = take(sessions);
  CHECK(error != MO_ERR_CONFLICT);
  return error;
}

static int join(const uint64_t sessions[2])
{
  const struct mo_fleet_offer offer = fake_offer("c", "c");
  int64_t id = mo_fleet_join(fake->fleet, &offer, fake->now_ns, NULL);
  if (id < 0)
    return (int)id;
  CHECK_OK(mo_fleet_leave(fake->fleet, sessions[1], true, fake->now_ns));
  return MO_OK;
}

static void giving(void)
{
  each(give, 8);
}

static void taking(void)
{
  each(take, 20);
}

static void taking_disputed(void)
{
  each(take_disputed, 20);
}

static void joining(void)
{
  each(join, 3);
}

static void creating(void)
{
  struct mo_fleet *fleet = NULL;
  const struct mo_fleet_config config = {.epoch = 1};
  int error = MO_ERR_NO_MEMORY;
  for (left = 0; error != MO_OK; left = left < 0 ? 1 : left + 1) {
    const long now = left;
    error = mo_fleet_create(&config, &fleet);
    CHECK(error == (now < 1 ? MO_ERR_NO_MEMORY : MO_OK));
    left = now;
  }
  left = -1;
  mo_fleet_free(fleet);
}

static const struct check_case cases[] = {{"creating", creating},
                                          {"joining", joining},
                                          {"giving leases", giving},
                                          {"taking results", taking},
                                          {"taking disputed results", taking_disputed}};
CHECK_MAIN(cases)
