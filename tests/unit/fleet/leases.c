/* leases.c: which session gets which lease, and how the lease ends; model.c tests the same at
 * random. */
#include "scene.h"

#include "fleet/sessions.h"

#include "fleet/weights.h"

#define MANY 1000

/* ---- sessions ---- */

static void refused(void)
{
  struct mo_message message = {""};
  struct mo_fleet_offer offer = fake_offer("w", "h");
  begin(0);
  snprintf(offer.version, sizeof(offer.version), "0.9.0");
  snprintf(offer.classes[0].scores, sizeof(offer.classes[0].scores), "cpu avx2");
  CHECK_INT(mo_fleet_join(fake->fleet, &offer, 1, &message), MO_ERR_UNSUPPORTED);
  CHECK_SAYS(message, "must be version 1.0.0 with class \"cpu fake float32 kernels-1\"");
  CHECK_SAYS(message, "got version 0.9.0 with \"cpu avx2\"");
  offer = fake_offer("w", "h");
  offer.classes[0].canary.bytes[0] = 0xab;
  CHECK_INT(mo_fleet_join(fake->fleet, &offer, fake->now_ns, &message), MO_ERR_CONFLICT);
  CHECK_SAYS(message, "must have the hash 0000");
  CHECK_SAYS(message, "got ab00");
  CHECK_TEXT(fake->event, "fleet.refused");
  CHECK_HAS(fake->data, "\"name\":\"w\",\"host\":\"h\"");
  CHECK_INT(fake->n_origins, 0);
  offer = fake_offer("w", "h");
  offer.user[0] = 'u';
  for (int i = 0; i < MO_FLEET_TOKEN_MAX; i++)
    CHECK(mo_fleet_join(fake->fleet, &offer, 1, &message) > 0);
  CHECK_INT(mo_fleet_join(fake->fleet, &offer, 1, &message), MO_ERR_LIMIT);
  CHECK_SAYS(message, "the token has 2048 open sessions, which is the limit");
  for (int i = MO_FLEET_TOKEN_MAX; i < MO_FLEET_SESSIONS_MAX; i++)
    join("many");
  offer = fake_offer("w", "h");
  CHECK_INT(mo_fleet_join(fake->fleet, &offer, 1, &message), MO_ERR_LIMIT);
  CHECK_SAYS(message, "4096 sessions are open, which is the limit");
  CHECK_INT(fake->n_origins, 0);
}

/* A refused session returns its leases; its worker may rejoin. */
static void refused_and_drained(void)
{
  struct mo_wire_leases leases;
  begin(MANY);
  const uint64_t a = join("a"), again = join("a");
  leases = exchange(a);
  CHECK(leases.n == MO_FLEET_LEASES && fake->n_taken > 0);
  struct mo_after after = {0};
  for (int i = 0; i < 2; i++) /* the second time changes nothing */
    mo_session_refuse(fake->fleet, a, "a", "a", "gave odd bits", fake->now_ns, &after);
  mo_after_run(fake->fleet, &after);
  CHECK(was_woken(a) && fake->n_taken == 0 && orders_of(a).state == MO_SESSION_REFUSED);
  CHECK(orders_of(again).state == MO_SESSION_ACTIVE);
  CHECK_TEXT(fake->event, "fleet.refused");
  CHECK_HAS(fake->data, "\"why\":\"gave odd bits\"");
  CHECK_INT(fake->n_events, 3);
  mo_wire_free_leases(&leases);
  CHECK_INT(fake_exchange(fake, a, NULL, &leases), MO_ERR_CONFLICT);
  CHECK_OK(mo_fleet_leave(fake->fleet, a, false, fake->now_ns));
  CHECK_INT(fake_exchange(fake, a, NULL, &leases), MO_ERR_NOT_FOUND);
  join("a");
  /* A drained session gets no more leases, and its results are accepted. */
  const uint64_t c = join("c");
  leases = exchange(c);
  CHECK_OK(mo_fleet_drain(fake->fleet, c, false));
  CHECK(was_woken(c) && orders_of(c).state == MO_SESSION_DRAINING);
  CHECK_INT(fake->n_origins, 0); /* nothing has been delivered */
  leases = finish(c, &leases, MO_RESULT_DONE);
  CHECK(leases.n == 0 && status().leases_done == 2);
  CHECK_INT(fake->n_origins, 1);
  /* Only the newest ended sessions are listed. */
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

/* Workers of any version may join if they compute the same bits. */
static void versions(void)
{
  static const struct {
    const char *version;
    bool is_older;
  } offers[] = {{"1.0.0", false}, {"0.10.1", true}, {"0.9.0", true}, {"1.0.10", false}};
  uint64_t ids[COUNT(offers)];
  begin(0);
  for (size_t i = 0; i < COUNT(offers); i++) {
    struct mo_fleet_offer offer = fake_offer("w", "h");
    snprintf(offer.version, sizeof(offer.version), "%s", offers[i].version);
    const uint32_t n_events = fake->n_events;
    ids[i] = (uint64_t)mo_fleet_join(fake->fleet, &offer, fake->now_ns, NULL);
    /* One event when it joins, and one about older sessions. */
    CHECK_INT(fake->n_events, n_events + (i == 1 ? 2 : 1));
    CHECK_TEXT(fake->event, i == 1 ? "fleet.older" : "fleet.joined");
    CHECK(i != 1 || strstr(fake->data, "\"version\":\"0.10.1\",\"wanted\":\"1.0.0\"") != NULL);
  }
  struct mo_session_status *items = NULL;
  size_t n = 0;
  CHECK_OK(mo_fleet_sessions(fake->fleet, &items, &n));
  CHECK_INT(status().n_older, 2);
  for (size_t i = 0; i < n; i++)
    CHECK(items[i].is_older == offers[i].is_older);
  free(items);
  /* Only a worker that is drained for an upgrade receives the required version. */
  CHECK_OK(mo_fleet_drain(fake->fleet, ids[1], true));
  CHECK_OK(mo_fleet_drain(fake->fleet, ids[2], false));
  CHECK_OK(mo_fleet_drain(fake->fleet, ids[2], true));
  CHECK_TEXT(orders_of(ids[1]).wanted, "1.0.0");
  CHECK_TEXT(orders_of(ids[2]).wanted, "");
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
  /* Near the end of the queue, leases shrink down to one body. */
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

/* Claims of sessions make the source hold only little. */
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

/* Two sessions, one four times as fast: each lease takes about a second, and both end together. */
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

/* ---- lost and late sessions ---- */

static void lost(void)
{
  begin(MANY);
  const uint64_t a = join("a");
  struct mo_wire_leases leases = warm(a, 320);
  const uint32_t first = fake->n_done;
  const uint64_t b = join("b");
  struct mo_wire_leases none = {0};
  CHECK(leases.n == 2 && same_body(&leases.items[0].blocks[0], first));
  /* The blocks are back in order, ahead of waiting ones; the next session gets them. */
  CHECK_OK(mo_fleet_leave(fake->fleet, a, true, fake->now_ns));
  CHECK_TEXT(fake->event, "fleet.lost");
  CHECK(fake->n_taken == 0 && status().lost == 1 && status().leases_again == 2);
  struct fake_block *block = TAILQ_FIRST(&fake->queue);
  for (uint32_t i = first; i < MANY && block != NULL; i++, block = TAILQ_NEXT(block, next))
    CHECK(block == blocks[i]);
  mo_wire_free_leases(&leases);
  leases = exchange(b);
  CHECK(same_body(&leases.items[0].blocks[0], first));
  /* After six seconds of silence a session is lost, even if it has just joined, but not one that
   * has sent something in the meantime. */
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
  /* Session a hangs with both leases. After five times the expected time, a session with the same
   * rate may get them too; ten seconds later, any session. */
  advance(25);
  fast = exchange(b);
  CHECK(fast.n == 2 && fast.items[0].id.number == slow.items[0].id.number);
  CHECK(status().leases_again == 2 && status().leases == 4);
  advance(0.5);
  const uint64_t rows = fake->rows_done;
  struct mo_wire_leases next = finish(b, &fast, MO_RESULT_DONE);
  CHECK_INT(fake->rows_done - rows, slow.items[0].n_rows + slow.items[1].n_rows);
  /* The first result counts. What session a still sends is compared, until it learns that the lease
   * ended. */
  const uint64_t delivered = fake->rows_done, twice = status().rows_twice;
  const uint32_t one = slow.items[0].n_rows;
  struct mo_wire_leases first = {1, {slow.items[0]}}, more;
  more = finish(a, &first, MO_RESULT_DONE);
  CHECK(fake->rows_done == delivered && status().rows_twice == twice + one && more.n == 1);
  struct mo_fleet_orders orders = orders_of(a);
  CHECK(orders.n_dropped == 2 && orders.dropped[1].number == slow.items[1].id.number);
  mo_wire_free_leases(&more);
  more = exchange(a); /* instead of the first session */
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

/* The queue is empty and a session is idle: it gets the oldest overdue lease. */
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
  /* New work wakes waiting sessions. */
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
  /* A late result arrives; it belongs to no lease and is ignored. */
  leases = finish(a, &leases, MO_RESULT_DONE);
  CHECK_INT(status().results_ignored, 1);
  mo_wire_free_leases(&leases);
}

/* ---- failing bodies and workers ---- */

/* A body that crashes every session that computes it is identified once three workers were lost
 * with it, and no other body is affected. With fewer workers the body is kept, because a worker
 * that keeps rejoining proves nothing. This holds even if only workers compute the class. */
static void poison_of(int n_workers, bool is_absent)
{
  uint32_t sessions = 0;
  begin(GENOTYPES);
  fake->fleet->config.classes[0].is_absent = is_absent;
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
  /* A resubmitted body gets the same number of tries. */
  blocks[GENOTYPES] = fake_submit(fake, 40);
  const uint64_t session = join("w");
  struct mo_wire_leases leases = exchange(session);
  CHECK_INT(leases.n, 1);
  mo_wire_free_leases(&leases);
  CHECK_OK(mo_fleet_leave(fake->fleet, session, true, fake->now_ns));
  CHECK_INT(fake->n_waiting, 1);
}

static void poison(int n_workers)
{
  poison_of(n_workers, false);
}

static void poison_of_absent(int n_workers)
{
  poison_of(n_workers, true);
}

/* The same, if it takes seconds to notice that a session is lost: at the end of the queue, other
 * sessions get the lease while the first ones still hold it. */
static void poison_seen_late(void)
{
  static const char *const names[] = {"w0", "w1", "w2"};
  uint64_t stuck[3] = {0};
  uint32_t sessions = 0;
  begin(GENOTYPES);
  for (; fake->n_done < GENOTYPES && sessions < 60; sessions++) {
    struct mo_fleet_offer offer = fake_offer(names[sessions % 3], "h");
    offer.n_threads = 4;
    const uint64_t session = (uint64_t)mo_fleet_join(fake->fleet, &offer, fake->now_ns, NULL);
    struct mo_wire_leases leases = exchange(session);
    bool is_stuck = false;
    while (!is_stuck && leases.n > 0) {
      for (uint32_t i = 0; i < leases.n; i++)
        for (uint32_t b = 0; b < leases.items[i].n_blocks; b++)
          is_stuck |= same_body(&leases.items[i].blocks[b], 40);
      advance(0.05);
      if (!is_stuck)
        leases = finish(session, &leases, MO_RESULT_DONE);
    }
    mo_wire_free_leases(&leases);
    uint64_t *place = &stuck[sessions % 3];
    if (*place != 0)
      CHECK_OK(mo_fleet_leave(fake->fleet, *place, true, fake->now_ns));
    *place = is_stuck ? session : 0;
    if (!is_stuck)
      CHECK_OK(mo_fleet_leave(fake->fleet, session, false, fake->now_ns));
    advance(1.5);
  }
  printf("# the body was found after %u sessions\n", sessions);
  CHECK(sessions <= 40);
  for (uint32_t i = 0; i < GENOTYPES; i++)
    CHECK_INT(blocks[i]->status, i == 40 ? MO_ERR_EXHAUSTED : MO_OK);
}

/* Two sessions hold a lease of only this body. The session that holds it for too long counts as the
 * third worker lost with it: the lease ends, and the other session is asked to drop it. */
static void poison_held_twice(void)
{
  static const char *const names[] = {"w0", "w1", "w2", "w0", "w1"};
  struct mo_wire_leases leases;
  begin(1);
  for (size_t i = 0; i < COUNT(names); i++) {
    const uint64_t session = join(names[i]);
    leases = exchange(session);
    CHECK_INT(leases.n, 1);
    mo_wire_free_leases(&leases);
    CHECK_OK(mo_fleet_leave(fake->fleet, session, true, fake->now_ns));
  }
  const uint64_t hung = join("w2"), other = join("w3");
  leases = exchange(hung);
  CHECK_INT(leases.n, 1);
  mo_wire_free_leases(&leases);
  advance(6);
  leases = exchange(other);
  CHECK(leases.n == 1 && fake->n_done == 0);
  mo_wire_free_leases(&leases);
  advance(55);
  CHECK(fake->n_done == 1 && blocks[0]->status == MO_ERR_EXHAUSTED);
  CHECK(TAILQ_EMPTY(&fake->fleet->leases));
  CHECK(orders_of(hung).n_dropped == 1 && orders_of(other).n_dropped == 1);
}

/* Sessions that hold a lease put a suspect body back, and wake only a session without leases. */
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

/* Blocks that no worker of the class can compute stay in this process. A worker that returns every
 * block gets little work and leaves the rest to others, until it computes again. */
static void unsupported(void)
{
  begin(MANY);
  const uint64_t a = join("a"), b = join("b");
  struct mo_wire_leases leases = exchange(a), of_b;
  for (int i = 0; i < 120; i++) {
    leases = finish(a, &leases, MO_RESULT_UNSUPPORTED);
    advance(0.5);
    if (leases.n == 0)
      leases = exchange(a);
  }
  CHECK(fake->n_kept >= 10 && fake->n_kept <= 30 && fake->n_kept == fake->n_done);
  CHECK(orders_of(a).state == MO_SESSION_ACTIVE);
  of_b = warm(b, 320);
  CHECK(of_b.n == 2);
  mo_wire_free_leases(&of_b);
  for (int i = 0; i < 25 && leases.n == 0; i++) {
    advance(0.5);
    leases = exchange(a);
  }
  CHECK(leases.n > 0 && mo_session_find(fake->fleet, a)->n_refusals > 0);
  leases = finish(a, &leases, MO_RESULT_DONE);
  CHECK_INT(mo_session_find(fake->fleet, a)->n_refusals, 0);
  mo_wire_free_leases(&leases);
}

/* A worker that fails everything is paused, and then gets no more work; another worker does it. */
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
  struct mo_fleet_file *file = NULL, *files[MO_WEIGHTS_READ];
  begin(4);
  fake->controller = make_random_controller(MO_SENSOR_INVERSE_SQRT, 3);
  const uint64_t a = join("a");
  struct mo_wire_leases leases = exchange(a);
  const struct mo_sha256 wanted = leases.items[0].controller;
  CHECK(leases.n == 2 && mo_sha256_equal(&wanted, &leases.items[1].controller));
  REQUIRE_OK(mo_fleet_controller(fake->fleet, &wanted, &file));
  mo_sha256_of(file->bytes, file->size, &hash);
  CHECK(mo_sha256_equal(&hash, &wanted));
  mo_fleet_file_release(file);
  while (leases.n > 0) {
    advance(0.05);
    leases = finish(a, &leases, MO_RESULT_DONE);
  }
  /* The file is kept for a while; later, another file may have its controller's address. */
  REQUIRE_OK(mo_fleet_controller(fake->fleet, &wanted, &file));
  mo_fleet_file_release(file);
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
  REQUIRE_OK(mo_fleet_controller(fake->fleet, &wanted, &file));
  mo_fleet_file_release(file);
  leases = finish(a, &leases, MO_RESULT_DONE);
  mo_wire_free_leases(&leases);
  /* It is for another session, but no other session polls. A late tick changes nothing. */
  mo_fleet_tick(fake->fleet, fake->now_ns - 1);
  CHECK_INT(fake->fleet->n_checks, 1);
  advance(20);
  leases = exchange(a);
  CHECK(leases.n == 0 && fake->fleet->n_checks == 1);
  advance(11);
  CHECK_INT(fake->fleet->n_checks, 0);
  /* Readers keep a bounded number of files. */
  for (uint32_t i = 0; i <= MO_WEIGHTS_READ; i++) {
    mo_controller_randomize(fake->controller, i);
    blocks[201 + i] = fake_submit(fake, i);
    leases = exchange(a);
    const struct mo_sha256 newest = leases.items[0].controller;
    leases = finish(a, &leases, MO_RESULT_DONE);
    mo_wire_free_leases(&leases);
    const bool is_full = i == MO_WEIGHTS_READ;
    CHECK_INT(mo_fleet_controller(fake->fleet, &newest, is_full ? &file : &files[i]),
              is_full ? MO_ERR_BUSY : MO_OK);
  }
  /* A file that a lease keeps anyway can always be read. */
  blocks[202 + MO_WEIGHTS_READ] = fake_submit(fake, 0);
  leases = exchange(a);
  REQUIRE(leases.n == 1);
  REQUIRE_OK(mo_fleet_controller(fake->fleet, &leases.items[0].controller, &file));
  mo_fleet_file_release(file);
  leases = finish(a, &leases, MO_RESULT_DONE);
  mo_wire_free_leases(&leases);
  for (uint32_t i = 0; i < MO_WEIGHTS_READ; i++)
    mo_fleet_file_release(files[i]);
  CHECK_INT(mo_fleet_controller(fake->fleet, &wanted, &file), MO_ERR_NOT_FOUND);
}

static int name_error; /* belongs to the next name */

static int name_class(void *context, enum mo_back_end back_end, const char *scores,
                      const char *gradients, const char *names[2])
{
  CHECK(context == fake && back_end == MO_ON_DEVICE && strncmp(gradients, "g", 1) == 0);
  names[0] = strcmp(scores, "s-1") == 0 ? "s-1" : "another";
  names[1] = "g-1";
  return name_error;
}

/* Joins a worker with devices; canary: its first byte. */
static int64_t join_with_devices(const char *name, const char *scores, uint8_t canary)
{
  struct mo_fleet_offer offer = fake_offer(name, name);
  snprintf(offer.classes[1].scores, sizeof(offer.classes[1].scores), "%s", scores);
  snprintf(offer.classes[1].gradients, sizeof(offer.classes[1].gradients), "g-1");
  offer.classes[1].canary.bytes[0] = canary;
  return mo_fleet_join(fake->fleet, &offer, fake->now_ns, NULL);
}

/* A class that only workers compute: the first worker names it and becomes its reference, unless
 * that worker may not join. */
static void absent_class(void)
{
  begin(0);
  fake->fleet->config.classes[1].is_absent = true;
  fake->fleet->config.name_class = name_class;
  name_error = MO_ERR_LIMIT;
  CHECK_INT(join_with_devices("a", "s-1", 1), MO_ERR_UNSUPPORTED);
  name_error = MO_ERR_NO_SPACE;
  CHECK_INT(join_with_devices("a", "s-1", 1), MO_ERR_NO_SPACE);
  name_error = MO_OK;
  CHECK(fake->fleet->config.classes[1].scores == NULL && status().n_serving[1] == 0);
  CHECK(join_with_devices("a", "s-1", 1) > 0);
  CHECK_TEXT(fake->fleet->config.classes[1].scores, "s-1");
  CHECK_INT(join_with_devices("c", "s-1", 2), MO_ERR_CONFLICT);
  CHECK(join_with_devices("d", "s-2", 2) > 0); /* serves with its processors */
  CHECK(status().n_serving[0] == 2 && status().n_serving[1] == 1);
  CHECK(join_with_devices("e", "s-1", 1) > 0);
  CHECK(status().n_serving[0] == 3 && status().n_serving[1] == 2);
}

/* If the store cannot record the origin of results, neither the worker nor its bodies are
 * blamed. */
static void without_an_origin(void)
{
  begin(1);
  for (int i = 0; i < 8; i++) {
    char name[16];
    snprintf(name, sizeof(name), "w%d", i);
    const uint64_t id = join(name);
    struct mo_wire_leases leases = exchange(id), none;
    struct mo_wire_results results = {0};
    REQUIRE(leases.n == 1);
    send(&results, &leases.items[0], MO_RESULT_DONE);
    mo_wire_free_leases(&leases);
    fake->origin_error = MO_ERR_NO_SPACE;
    CHECK_INT(fake_exchange(fake, id, &results, &none), MO_ERR_NO_SPACE);
    fake->origin_error = MO_OK;
    CHECK_INT(fake->n_taken, 0);
    CHECK_OK(mo_fleet_leave(fake->fleet, id, true, fake->now_ns));
  }
  CHECK_INT(fake->n_failed, 0);
  const uint64_t id = join("last");
  struct mo_wire_leases leases = exchange(id);
  leases = finish(id, &leases, MO_RESULT_DONE);
  CHECK(leases.n == 0 && blocks[0]->state == FAKE_DONE && blocks[0]->status == MO_OK);
  mo_wire_free_leases(&leases);
}

static const struct check_case cases[] = {
    {"refused", refused},
    {"refused and drained", refused_and_drained},
    {"other versions", versions},
    {"sizes of leases", sizes},
    {"sessions with inflated claims", boasters},
    {"sessions of different rates", shared},
    {"lost sessions", lost},
    {"late leases", late},
    {"an idle session", idle},
    {"cancelled", cancelled},
    {"a body that ends sessions", WITH(poison, 3)},
    {"workers that end with a body", WITH(poison, 2)},
    {"a worker that ends with a body of an absent class", WITH(poison_of_absent, 1)},
    {"a body that ends sessions, noticed late", poison_seen_late},
    {"a body that ends sessions, held by two", poison_held_twice},
    {"a suspect and busy sessions", suspected},
    {"blocks that no worker computes", unsupported},
    {"a worker that fails", failing},
    {"a store without room for an origin", without_an_origin},
    {"weights", weights},
    {"a class that only workers compute", absent_class},
};
CHECK_MAIN_AROUND(cases, drop_blocks)
