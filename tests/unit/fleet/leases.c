/* leases.c: who gets which lease, and what becomes of it; model.c is the same by chance. */
#include "fake.h"

#include <unistd.h>

#define MANY 1000

static struct fake *fake;
static struct fake_block *blocks[4096];

/* A new source with n blocks of 16 rows × 1000 steps, kept until the end of the case. Silence ends
 * no session. */
static void begin(uint32_t n)
{
  fake = make_fake(3);
  fake->fleet->silence_ns = UINT64_MAX;
  for (uint32_t i = 0; i < n; i++) {
    blocks[i] = fake_submit(fake, i);
    memcpy(blocks[i]->genotype, fake->genotypes[i % GENOTYPES], sizeof(blocks[i]->genotype));
  }
}

static void advance(double s)
{
  const uint64_t end_ns = fake->now_ns + (uint64_t)(s * 1e9 + 0.5);
  while (fake->now_ns < end_ns) {
    fake->now_ns += end_ns - fake->now_ns < MO_S_NS / 50 ? end_ns - fake->now_ns : MO_S_NS / 50;
    mo_fleet_tick(fake->fleet, fake->now_ns);
  }
}

static uint64_t join(const char *name)
{
  const struct mo_fleet_offer offer = fake_offer(name, name);
  struct mo_message message = {""};
  int64_t id = mo_fleet_join(fake->fleet, &offer, fake->now_ns, &message);
  make_check(id > 0 ? MO_OK : (int)id, message.text);
  return (uint64_t)id;
}

static struct mo_wire_leases exchange(uint64_t session)
{
  struct mo_wire_leases leases;
  CHECK_OK(fake_exchange(fake, session, NULL, &leases));
  return leases;
}

static void send(struct mo_wire_results *results, const struct mo_wire_lease *lease,
                 enum mo_wire_state state)
{
  results->items[results->n++] = state == MO_RESULT_DONE
                                     ? fake_compute(lease, NULL)
                                     : (struct mo_wire_result){.id = lease->id, .state = state};
}

/* Sends the results of all leases, frees them, and takes new ones. */
static struct mo_wire_leases finish(uint64_t session, struct mo_wire_leases *leases,
                                    enum mo_wire_state state)
{
  struct mo_wire_results results = {0};
  struct mo_wire_leases next;
  for (uint32_t i = 0; i < leases->n; i++)
    send(&results, &leases->items[i], state);
  mo_wire_free_leases(leases);
  CHECK_OK(fake_exchange(fake, session, &results, &next));
  return next;
}

/* A session that has the rate of `rows_per_s`. Returns its leases. */
static struct mo_wire_leases warm(uint64_t session, double rows_per_s)
{
  struct mo_wire_leases leases = exchange(session);
  for (int i = 0; i < 12; i++) {
    uint32_t rows = 0;
    for (uint32_t k = 0; k < leases.n; k++)
      rows += leases.items[k].n_rows;
    advance(rows / rows_per_s);
    leases = finish(session, &leases, MO_RESULT_DONE);
  }
  return leases;
}

static struct mo_fleet_status status(void)
{
  struct mo_fleet_status facts;
  mo_fleet_status(fake->fleet, &facts);
  return facts;
}

static struct mo_fleet_orders orders_of(uint64_t session)
{
  struct mo_fleet_orders orders;
  CHECK(mo_fleet_orders(fake->fleet, session, fake->now_ns, &orders) >= 0);
  return orders;
}

static bool was_woken(uint64_t session)
{
  for (uint32_t i = 0; i < fake->n_wakes && i < COUNT(fake->woken); i++)
    if (fake->woken[i] == session)
      return true;
  return false;
}

static bool same_body(const struct mo_wire_block *block, uint32_t i)
{
  return memcmp(block->genotype, blocks[i]->genotype, sizeof(blocks[i]->genotype)) == 0;
}

/* ---- sessions ---- */

static void refused(void)
{
  struct mo_message message = {""};
  struct mo_fleet_offer offer = fake_offer("w", "h");
  begin(0);
  snprintf(offer.version, sizeof(offer.version), "0.9.0");
  CHECK_INT(mo_fleet_join(fake->fleet, &offer, 1, &message), MO_ERR_UNSUPPORTED);
  CHECK_SAYS(message, "version 1.0.0, got 0.9.0");
  offer = fake_offer("w", "h");
  snprintf(offer.classes[0].scores, sizeof(offer.classes[0].scores), "cpu avx2");
  CHECK_INT(mo_fleet_join(fake->fleet, &offer, 1, &message), MO_ERR_UNSUPPORTED);
  CHECK_SAYS(message, fake_class);
  offer = fake_offer("w", "h");
  offer.classes[0].canary.bytes[0] = 0xab;
  CHECK_INT(mo_fleet_join(fake->fleet, &offer, fake->now_ns, &message), MO_ERR_CONFLICT);
  CHECK_SAYS(message, "must have the hash 0000");
  CHECK_SAYS(message, "got ab00");
  CHECK_TEXT(fake->event, "fleet.refused");
  CHECK_HAS(fake->data, "\"name\":\"w\",\"host\":\"h\"");
  CHECK_INT(fake->n_origins, 0);
  for (int i = 0; i < MO_FLEET_SESSIONS_MAX; i++)
    join("many");
  offer = fake_offer("w", "h");
  CHECK_INT(mo_fleet_join(fake->fleet, &offer, 1, &message), MO_ERR_LIMIT);
  CHECK_SAYS(message, "at most 4096 sessions");
  CHECK_INT(fake->n_origins, MO_FLEET_SESSIONS_MAX);
}

static void quarantined(void)
{
  struct mo_message message = {""};
  struct mo_wire_leases leases;
  struct mo_fleet_offer offer = fake_offer("a", "elsewhere");
  begin(MANY);
  const uint64_t a = join("a"), again = join("a"), b = join("b");
  leases = exchange(a);
  CHECK(leases.n == MO_FLEET_LEASES && fake->n_taken > 0);
  CHECK_OK(mo_fleet_quarantine(fake->fleet, again, "an operator's words"));
  CHECK(fake->n_taken == 0 && orders_of(a).state == MO_SESSION_QUARANTINED);
  CHECK_TEXT(fake->event, "fleet.quarantined");
  CHECK_HAS(fake->data, "\"why\":\"an operator's words\"");
  mo_wire_free_leases(&leases);
  CHECK_INT(fake_exchange(fake, a, NULL, &leases), MO_ERR_CONFLICT);
  CHECK_INT(mo_fleet_join(fake->fleet, &offer, 1, &message), MO_ERR_CONFLICT);
  CHECK_SAYS(message, "\"a\" is quarantined");
  CHECK_INT(fake->n_origins, 3);
  offer.user[0] = 'u'; /* the name of another token */
  CHECK_OK(mo_fleet_leave(fake->fleet, (uint64_t)mo_fleet_join(fake->fleet, &offer, 1, &message),
                          false, fake->now_ns));
  offer.user[0] = '\0';
  CHECK_OK(mo_fleet_leave(fake->fleet, a, false, fake->now_ns));
  CHECK_INT(fake_exchange(fake, a, NULL, &leases), MO_ERR_NOT_FOUND);
  CHECK_INT(status().n_quarantined, 1);
  CHECK_OK(mo_fleet_release(fake->fleet, "a"));
  CHECK_INT(mo_fleet_release(fake->fleet, "a"), MO_ERR_NOT_FOUND);
  CHECK(mo_fleet_join(fake->fleet, &offer, 1, &message) > 0);
  /* Drained: no more leases, and what it has is taken. */
  leases = exchange(b);
  CHECK_OK(mo_fleet_drain(fake->fleet, b));
  CHECK(was_woken(b) && orders_of(b).state == MO_SESSION_DRAINING);
  leases = finish(b, &leases, MO_RESULT_DONE);
  CHECK(leases.n == 0 && status().leases_done == 2);
  /* Of ended sessions the newest are listed. */
  for (int i = 0; i < 300; i++)
    CHECK_OK(mo_fleet_leave(fake->fleet, join("short"), true, fake->now_ns));
  struct mo_session_status *items = NULL;
  size_t n = 0;
  CHECK_OK(mo_fleet_sessions(fake->fleet, &items, &n));
  CHECK_INT(n, 3 + 256);
  CHECK(items[0].ended_ns == 0 && items[3].state == MO_SESSION_LOST);
  CHECK_TEXT(items[n - 1].why, "its connection ended");
  free(items);
}

/* ---- sizes ---- */

static void sizes(void)
{
  begin(4096);
  const uint64_t a = join("a"), b = join("b");
  struct mo_wire_leases first = exchange(b), leases = exchange(a);
  CHECK_INT(leases.items[0].n_blocks, 1);
  mo_wire_free_leases(&leases);
  mo_wire_free_leases(&first);
  CHECK_OK(mo_fleet_leave(fake->fleet, b, false, fake->now_ns));
  CHECK_OK(mo_fleet_leave(fake->fleet, a, false, fake->now_ns));
  const uint64_t c = join("c");
  leases = warm(c, 320);
  CHECK(leases.n == 2 && leases.items[0].n_rows >= 256 && leases.items[0].n_rows <= 320);
  CHECK(fake->wanted >= 60 && fake->wanted <= 100); /* four seconds of 20 blocks */
  /* Near the end of the queue leases become smaller, down to one body. */
  uint32_t last = leases.items[0].n_blocks;
  while (leases.n > 0) {
    advance(
        (leases.n > 1 ? leases.items[0].n_rows + leases.items[1].n_rows : leases.items[0].n_rows) /
        320.0);
    const uint32_t n = leases.items[0].n_blocks;
    CHECK(n <= last + 2 || fake->n_waiting > 40);
    last = n;
    leases = finish(c, &leases, MO_RESULT_DONE);
  }
  CHECK(last <= 2 && fake->n_done == 4096 && fake->n_wrong == 0);
}

/* What sessions say of themselves makes the source hold little. */
static void boasters(void)
{
  struct mo_fleet_offer offer = fake_offer("w", "h");
  offer.n_threads = 65536;
  begin(0);
  CHECK(mo_fleet_join(fake->fleet, &offer, fake->now_ns, NULL) > 0);
  advance(0.1);
  CHECK(fake->wanted > 256 && fake->wanted <= 2048);
  for (int i = 0; i < 1000; i++)
    CHECK(mo_fleet_join(fake->fleet, &offer, fake->now_ns, NULL) > 0);
  advance(0.1);
  CHECK_INT(fake->wanted, 1 << 17);
}

/* Two sessions, one four times as fast: both get about a second, and end together. */
static void shared(void)
{
  begin(4096);
  const uint64_t a = join("a"), b = join("b");
  struct mo_wire_leases of_a = warm(a, 160), of_b = warm(b, 640);
  CHECK(of_a.items[0].n_rows >= 128 && of_a.items[0].n_rows <= 192);
  CHECK(of_b.items[0].n_rows >= 512 && of_b.items[0].n_rows <= 768);
  mo_wire_free_leases(&of_a);
  mo_wire_free_leases(&of_b);
}

/* ---- lost and late ---- */

static void lost(void)
{
  begin(MANY);
  const uint64_t a = join("a");
  struct mo_wire_leases leases = warm(a, 320);
  const uint32_t first = fake->n_done;
  const uint64_t b = join("b");
  struct mo_wire_leases none = {0};
  CHECK(leases.n == 2 && same_body(&leases.items[0].blocks[0], first));
  /* Back in their order, in front of what waits; the next session gets them. */
  CHECK_OK(mo_fleet_leave(fake->fleet, a, true, fake->now_ns));
  CHECK_TEXT(fake->event, "fleet.lost");
  CHECK(fake->n_taken == 0 && status().lost == 1 && status().leases_again == 2);
  struct fake_block *block = TAILQ_FIRST(&fake->queue);
  for (uint32_t i = first; i < MANY && block != NULL; i++, block = TAILQ_NEXT(block, next))
    CHECK(block == blocks[i]);
  mo_wire_free_leases(&leases);
  leases = exchange(b);
  CHECK(same_body(&leases.items[0].blocks[0], first));
  /* Silence: after six seconds, and the newcomer is lost, not who spoke meanwhile. */
  const uint64_t c = join("c");
  fake->fleet->silence_ns = MO_FLEET_SILENCE_MS * UINT64_C(1000000);
  advance(4);
  orders_of(c);
  advance(2.1);
  CHECK(status().n_sessions == 1 && fake->n_taken == 0);
  CHECK_INT(fake_exchange(fake, b, NULL, &none), MO_ERR_NOT_FOUND);
  mo_wire_free_leases(&leases);
}

static void late(void)
{
  begin(MANY);
  const uint64_t a = join("a");
  struct mo_wire_leases slow = warm(a, 320), fast = {0};
  const uint64_t b = join("b");
  /* a hangs with both leases: after five times the expected time a session of its rate may have
   * them, too, and ten seconds later any. */
  advance(25);
  fast = exchange(b);
  CHECK(fast.n == 2 && fast.items[0].id.number == slow.items[0].id.number);
  CHECK(status().leases_again == 2 && status().leases == 4);
  advance(0.5);
  const uint64_t rows = fake->rows_done;
  struct mo_wire_leases next = finish(b, &fast, MO_RESULT_DONE);
  CHECK_INT(fake->rows_done - rows, slow.items[0].n_rows + slow.items[1].n_rows);
  /* The first result won; what a still sends is compared, until it is told so. */
  const uint64_t delivered = fake->rows_done, twice = status().rows_twice;
  const uint32_t one = slow.items[0].n_rows;
  struct mo_wire_leases first = {1, {slow.items[0]}}, more;
  more = finish(a, &first, MO_RESULT_DONE);
  CHECK(fake->rows_done == delivered && status().rows_twice == twice + one && more.n == 1);
  struct mo_fleet_orders orders = orders_of(a);
  CHECK(orders.n_dropped == 2 && orders.dropped[1].number == slow.items[1].id.number);
  mo_wire_free_leases(&more);
  more = exchange(a); /* in its place */
  CHECK(more.n == 1 && status().leases == 2 + next.n);
  mo_wire_free_leases(&more);
  slow.items[0] = slow.items[1];
  slow.n = 1;
  slow = finish(a, &slow, MO_RESULT_DONE);
  CHECK(status().results_ignored == 1 && status().rows_twice == twice + one);
  CHECK(status().audits == 1 && status().audits_failed == 0 && fake->n_wrong == 0);
  mo_wire_free_leases(&slow);
  mo_wire_free_leases(&next);
}

/* Nothing is left and a session is idle: it gets the oldest lease that should be done. */
static void idle(void)
{
  begin(2);
  const uint64_t a = join("a"), b = join("b");
  struct mo_wire_leases of_a = exchange(a), of_b = exchange(b);
  CHECK(of_a.n == 2 && of_b.n == 0 && fake->n_waiting == 0);
  advance(0.02);
  of_b = exchange(b);
  fake->n_wakes = 0;
  advance(0.5);
  CHECK(!was_woken(b));
  advance(0.6);
  CHECK(was_woken(b));
  of_b = exchange(b);
  CHECK(of_b.n == 1 && of_b.items[0].id.number == of_a.items[0].id.number);
  of_b = finish(b, &of_b, MO_RESULT_DONE);
  CHECK(of_b.n == 1 && of_b.items[0].id.number == of_a.items[1].id.number);
  of_b = finish(b, &of_b, MO_RESULT_DONE);
  CHECK(fake->n_done == 2 && of_b.n == 0);
  /* New work wakes who waits. */
  fake->n_wakes = 0;
  blocks[2] = fake_submit(fake, 2);
  advance(0.02);
  CHECK(was_woken(b));
  mo_wire_free_leases(&of_a);
}

static void cancelled(void)
{
  begin(MANY);
  const uint64_t a = join("a");
  struct mo_wire_leases leases = warm(a, 320);
  const uint32_t first = fake->n_done, n = leases.items[0].n_blocks;
  for (uint32_t i = 0; i < n; i++)
    blocks[first + i]->cancel = 1;
  fake->n_wakes = 0;
  advance(0.02);
  struct mo_fleet_orders orders = orders_of(a);
  CHECK(was_woken(a) && orders.n_dropped == 1 && fake->n_cancelled == n);
  CHECK(orders.dropped[0].number == leases.items[0].id.number);
  /* Its result comes all the same: it is of no lease. */
  leases = finish(a, &leases, MO_RESULT_DONE);
  CHECK_INT(status().results_ignored, 1);
  mo_wire_free_leases(&leases);
}

/* ---- bodies and workers that fail ---- */

/* A body that ends every session that computes it is found, if three workers say so, and no other
 * body suffers. */
static void poison(int n_workers)
{
  uint32_t sessions = 0;
  begin(GENOTYPES);
  for (uint32_t i = 0; i < GENOTYPES; i++)
    blocks[i]->block.n_environments = 1; /* many to a lease */
  while (fake->n_done < GENOTYPES && sessions < 40) {
    char name[16];
    snprintf(name, sizeof(name), "w%u", sessions % n_workers);
    struct mo_fleet_offer offer = fake_offer(name, "h");
    offer.n_threads = 4;
    const uint64_t session = (uint64_t)mo_fleet_join(fake->fleet, &offer, fake->now_ns, NULL);
    struct mo_wire_leases leases = exchange(session);
    bool is_dead = false;
    sessions++;
    for (int turn = 0; turn < 200 && !is_dead && leases.n > 0; turn++) {
      for (uint32_t i = 0; i < leases.n; i++)
        for (uint32_t b = 0; b < leases.items[i].n_blocks; b++)
          is_dead |= same_body(&leases.items[i].blocks[b], 40);
      advance(0.05);
      if (!is_dead)
        leases = finish(session, &leases, MO_RESULT_DONE);
    }
    mo_wire_free_leases(&leases);
    CHECK_OK(mo_fleet_leave(fake->fleet, session, is_dead, fake->now_ns));
  }
  printf("# the body was found after %u sessions\n", sessions);
  if (n_workers < 3) {
    CHECK(fake->n_kept == 1 && fake->n_failed == 0 && blocks[40]->status == MO_ERR_UNSUPPORTED);
    return;
  }
  CHECK(sessions >= 3 && sessions <= 16);
  for (uint32_t i = 0; i < GENOTYPES; i++)
    CHECK_INT(blocks[i]->status, i == 40 ? MO_ERR_EXHAUSTED : MO_OK);
  /* Submitted again it gets the same patience. */
  blocks[GENOTYPES] = fake_submit(fake, 40);
  const uint64_t session = join("w");
  struct mo_wire_leases leases = exchange(session);
  CHECK_INT(leases.n, 1);
  mo_wire_free_leases(&leases);
  CHECK_OK(mo_fleet_leave(fake->fleet, session, true, fake->now_ns));
  CHECK_INT(fake->n_waiting, 1);
}

/* Sessions that hold a lease put a suspect back, and wake nobody but one that holds none. */
static void suspected(void)
{
  uint64_t ids[3];
  struct mo_wire_leases leases;
  begin(1);
  for (int i = 0; i < 3; i++) {
    const uint64_t a = join("a");
    leases = exchange(a);
    CHECK_INT(leases.n, 1);
    mo_wire_free_leases(&leases);
    CHECK_OK(mo_fleet_leave(fake->fleet, a, true, fake->now_ns));
  }
  struct fake_block *suspect = TAILQ_FIRST(&fake->queue);
  TAILQ_REMOVE(&fake->queue, suspect, next);
  fake->n_waiting--;
  for (int i = 0; i < 2; i++) {
    blocks[1 + i] = fake_submit(fake, 1 + (uint64_t)i);
    ids[i] = join("b");
    leases = exchange(ids[i]);
    CHECK_INT(leases.n, 1);
    mo_wire_free_leases(&leases);
  }
  fake->n_waiting++;
  TAILQ_INSERT_HEAD(&fake->queue, suspect, next);
  fake->n_wakes = 0;
  for (int i = 0; i < 2; i++) {
    leases = exchange(ids[i]);
    CHECK(leases.n == 0 && fake->n_wakes == 0 && fake->n_waiting == 1);
    mo_wire_free_leases(&leases);
  }
  ids[2] = join("c");
  leases = exchange(ids[2]);
  CHECK(leases.n == 1 && same_body(&leases.items[0].blocks[0], 0));
  leases = finish(ids[2], &leases, MO_RESULT_DONE);
}

/* What the workers of a class cannot compute stays here, and nobody suffers. */
static void unsupported(void)
{
  begin(200);
  const uint64_t a = join("a");
  struct mo_wire_leases leases = exchange(a);
  for (int i = 0; i < 10; i++)
    leases = finish(a, &leases, MO_RESULT_UNSUPPORTED);
  CHECK(fake->n_kept >= 20 && fake->n_kept == fake->n_done);
  CHECK(orders_of(a).state == MO_SESSION_ACTIVE && leases.n == 2);
  mo_wire_free_leases(&leases);
}

/* A worker that fails everything rests, and then gets no more; the work is done by another. */
static void failing(void)
{
  begin(8);
  const uint64_t a = join("a"), b = join("b");
  for (int i = 0; i < 40 && orders_of(a).state == MO_SESSION_ACTIVE; i++) {
    struct mo_wire_leases leases = exchange(a);
    leases = finish(a, &leases, MO_RESULT_FAILED);
    CHECK_INT(leases.n, 0);
    advance(0.5);
  }
  CHECK(orders_of(a).state == MO_SESSION_DRAINING);
  struct mo_wire_leases leases = exchange(b);
  while (leases.n > 0) {
    advance(0.05);
    leases = finish(b, &leases, MO_RESULT_DONE);
  }
  CHECK(fake->n_done == 8 && fake->n_failed == 0);
}

/* ---- weights ---- */

static void weights(void)
{
  struct mo_sha256 hash;
  uint8_t *bytes = NULL;
  size_t size = 0;
  begin(4);
  fake->controller = make_random_controller(MO_SENSOR_INVERSE_SQRT, 3);
  const uint64_t a = join("a");
  struct mo_wire_leases leases = exchange(a);
  const struct mo_sha256 wanted = leases.items[0].controller;
  CHECK(leases.n == 2 && mo_sha256_equal(&wanted, &leases.items[1].controller));
  REQUIRE_OK(mo_fleet_controller(fake->fleet, &wanted, &bytes, &size));
  mo_sha256_of(bytes, size, &hash);
  CHECK(mo_sha256_equal(&hash, &wanted));
  free(bytes);
  while (leases.n > 0) {
    advance(0.05);
    leases = finish(a, &leases, MO_RESULT_DONE);
  }
  /* The file is kept for a while; under the address of its controller there may be another one. */
  REQUIRE_OK(mo_fleet_controller(fake->fleet, &wanted, &bytes, &size));
  free(bytes);
  join("b");
  for (uint32_t i = 4; i < 200 && fake->fleet->n_checks == 0; i++) {
    blocks[i] = fake_submit(fake, i);
    leases = exchange(a);
    leases = finish(a, &leases, MO_RESULT_DONE);
    mo_wire_free_leases(&leases);
  }
  CHECK_INT(fake->fleet->n_checks, 1);
  mo_controller_randomize(fake->controller, 4);
  blocks[200] = fake_submit(fake, 200);
  leases = exchange(a);
  REQUIRE(leases.n == 1);
  CHECK(!mo_sha256_equal(&wanted, &leases.items[0].controller));
  REQUIRE_OK(mo_fleet_controller(fake->fleet, &wanted, &bytes, &size));
  free(bytes);
  leases = finish(a, &leases, MO_RESULT_DONE);
  mo_wire_free_leases(&leases);
  /* It is for another session, and nobody else comes. A tick that is late changes nothing. */
  mo_fleet_tick(fake->fleet, fake->now_ns - 1);
  CHECK_INT(fake->fleet->n_checks, 1);
  advance(20);
  leases = exchange(a);
  CHECK(leases.n == 0 && fake->fleet->n_checks == 1);
  advance(11);
  CHECK_INT(fake->fleet->n_checks, 0);
  for (uint32_t i = 0; i < 10; i++) {
    mo_controller_randomize(fake->controller, i);
    blocks[201 + i] = fake_submit(fake, i);
    leases = exchange(a);
    leases = finish(a, &leases, MO_RESULT_DONE);
    mo_wire_free_leases(&leases);
  }
  CHECK_INT(mo_fleet_controller(fake->fleet, &wanted, &bytes, &size), MO_ERR_NOT_FOUND);
}

/* ---- wrong bits ---- */

static atomic_bool may_recompute;

static int recompute(void *context, const struct mo_wire_lease *lease,
                     struct mo_workspace workspace, const uint8_t *file, size_t file_bytes,
                     const volatile int *cancel, double *losses, uint32_t *diverged_steps)
{
  struct mo_wire_result result = fake_compute(lease, NULL);
  (void)context;
  while (!atomic_load(&may_recompute) && !*cancel)
    usleep(100);
  CHECK(lease->n_blocks == 1 && file == NULL && file_bytes == 0 && workspace.nz == 4);
  memcpy(losses, result.losses, result.n_rows * sizeof(*losses));
  memcpy(diverged_steps, result.diverged_steps, result.n_rows * sizeof(*diverged_steps));
  free(result.losses);
  free(result.diverged_steps);
  return MO_OK;
}

/* Gives the loss of the first row a wrong bit. */
static void lie(struct mo_wire_result *result)
{
  if (result->diverged_steps[0] == 0)
    result->losses[0] = nextafter(result->losses[0], 2);
}

/* Sessions compute until two differ; a third, or the process, decides. With the process, all but
 * the last give the same wrong bits, and it is not outvoted. */
static void decided(int by_process)
{
  static const char *const names[] = {"liar", "liar-2", "a"};
  struct mo_random random = dice(1, 0, 0);
  const uint32_t n_liars = by_process ? 2 : 1;
  struct mo_wire_leases leases[3] = {0};
  uint64_t ids[3];
  begin(0);
  fake->frees_done = true;
  atomic_store(&may_recompute, false);
  if (by_process)
    fake->fleet->config.source.recompute = recompute;
  for (int w = 0; w < 3; w++)
    ids[w] = join(names[w]);
  for (int turn = 0; turn < 4000 && fake->fleet->n_quarantined < n_liars; turn++) {
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
        CHECK(w < 2);
    }
    /* The clock turns while the process computes. */
    const bool was_deciding = fake->fleet->decision.lease != NULL;
    const uint32_t n = fake->fleet->n_quarantined;
    advance(0.4);
    CHECK(!by_process || fake->fleet->n_quarantined == n || was_deciding);
    atomic_store(&may_recompute, was_deciding);
    usleep(was_deciding ? 1000 : 0);
    fake_check(fake);
  }
  CHECK_INT(fake->fleet->n_quarantined, n_liars);
  for (uint32_t i = 0; i < n_liars; i++)
    CHECK(strncmp(fake->fleet->quarantined[i].name, "liar", 4) == 0);
  CHECK_TEXT(fake->event, "fleet.quarantined");
  CHECK_HAS(fake->data, "\",\"why\":\"gave a loss of ");
  CHECK_HAS(fake->data, by_process ? "this machine computed" : "two others gave");
  CHECK(status().audits_failed >= n_liars && status().n_quarantined == n_liars);
  for (int w = 0; w < 3; w++)
    mo_wire_free_leases(&leases[w]);
}

/* Shards of gradients: one per lease, shared out, compared as a whole. */
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
                                          .adjoint_bound = 2,
                                          .weight = 0.25};
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
  for (int turn = 0; turn < 1000 && fake->fleet->n_quarantined == 0; turn++) {
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
  CHECK_INT(fake->fleet->n_quarantined, 1);
  CHECK_TEXT(fake->fleet->quarantined[0].name, "liar");
  CHECK_HAS(fake->data, "gave another gradient of 40 robots than two others");
  CHECK(fake->n_done > 0 && fake->n_wrong > 0 && fake->n_wrong < fake->n_done);
  for (int w = 0; w < 3; w++)
    mo_wire_free_leases(&leases[w]);
  CHECK_OK(mo_fleet_leave(fake->fleet, ids[1], true, fake->now_ns)); /* what it has goes back */
}

/* A worker of 128 rows a second. */
struct worker {
  uint64_t id, ready_ns[2 * MO_FLEET_LEASES];
  struct mo_wire_lease leases[2 * MO_FLEET_LEASES];
  uint32_t n;
  struct mo_random *liar; /* NULL: honest */
};

/* Sends what is ready; false: the session is no more. */
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

/* A session that flips a bit in one of 1000 rows, among three honest ones, with 128 rows to a
 * lease: it is quarantined within 500 of its leases in at least 99 of 100 runs, and they never are.
 */
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
    for (int w = 0; w < 4; w++)
      workers[w].id = join(names[w]);
    while (sent < 500 && fake->fleet->n_quarantined == 0) {
      while (fake->n_waiting < 200)
        fake_submit(fake, submitted++);
      advance(0.125);
      for (int w = 0; w < 4; w++)
        CHECK(visit(&workers[w], w == 0 ? &sent : &others) || w == 0);
    }
    leases += status().leases_done;
    rows += status().rows_done;
    found += fake->fleet->n_quarantined == 1;
    longest = sent > longest ? sent : longest;
    if (fake->fleet->n_quarantined > 0)
      CHECK_TEXT(fake->fleet->quarantined[0].name, "liar");
    for (int w = 0; w < 4; w++) {
      struct mo_wire_leases held = {.n = workers[w].n};
      memcpy(held.items, workers[w].leases, sizeof(held.items));
      mo_wire_free_leases(&held);
    }
    check_drop_to(0);
  }
  printf("# found in %u of 100 runs, the last after %u leases of %.0f rows on average\n", found,
         longest, (double)rows / (double)leases);
  CHECK(found >= 99);
}

static void drop_blocks(void (*run)(void))
{
  memset(blocks, 0, sizeof(blocks));
  run();
  for (size_t i = 0; i < COUNT(blocks); i++)
    if (blocks[i] != NULL && blocks[i]->state == FAKE_DONE)
      check_keep(blocks[i], free);
}

static const struct check_case cases[] = {
    {"refused", refused},
    {"quarantined and drained", quarantined},
    {"sizes of leases", sizes},
    {"sessions that boast", boasters},
    {"sessions of different rates", shared},
    {"lost sessions", lost},
    {"late leases", late},
    {"an idle session", idle},
    {"cancelled", cancelled},
    {"a body that ends sessions", WITH(poison, 3)},
    {"workers that end with a body", WITH(poison, 2)},
    {"a suspect and busy sessions", suspected},
    {"what no worker computes", unsupported},
    {"a worker that fails", failing},
    {"weights", weights},
    {"a third session decides", WITH(decided, 0)},
    {"the process decides", WITH(decided, 1)},
    {"shards of gradients", shards},
    {"liars are found", liars},
};
CHECK_MAIN_AROUND(cases, drop_blocks)
