/* scene.h: one fleet on a fake source and clock, and actions of its sessions, one by one. */
#ifndef MORPHO_TESTS_FLEET_SCENE_H
#define MORPHO_TESTS_FLEET_SCENE_H

#include "fake.h"

static struct fake *fake;
static struct fake_block *blocks[4096];

/* Makes a new source with n blocks of 16 rows × 1000 steps, kept until the end of the case. Silence
 * does not end sessions. */
static inline void begin(uint32_t n)
{
  fake = make_fake(3);
  fake->fleet->silence_ns = UINT64_MAX;
  for (uint32_t i = 0; i < n; i++) {
    blocks[i] = fake_submit(fake, i);
    memcpy(blocks[i]->genotype, fake->genotypes[i % GENOTYPES], sizeof(blocks[i]->genotype));
  }
}

static inline void advance(double s)
{
  const uint64_t end_ns = fake->now_ns + (uint64_t)(s * 1e9 + 0.5);
  while (fake->now_ns < end_ns) {
    fake->now_ns += end_ns - fake->now_ns < MO_S_NS / 50 ? end_ns - fake->now_ns : MO_S_NS / 50;
    mo_fleet_tick(fake->fleet, fake->now_ns);
  }
}

static inline uint64_t join(const char *name)
{
  const struct mo_fleet_offer offer = fake_offer(name, name);
  struct mo_message message = {""};
  int64_t id = mo_fleet_join(fake->fleet, &offer, fake->now_ns, &message);
  make_check(id > 0 ? MO_OK : (int)id, message.text);
  return (uint64_t)id;
}

static inline struct mo_wire_leases exchange(uint64_t session)
{
  struct mo_wire_leases leases;
  CHECK_OK(fake_exchange(fake, session, NULL, &leases));
  return leases;
}

static inline void send(struct mo_wire_results *results, const struct mo_wire_lease *lease,
                        enum mo_wire_state state)
{
  results->items[results->n++] = state == MO_RESULT_DONE
                                     ? fake_compute(lease, NULL)
                                     : (struct mo_wire_result){.id = lease->id, .state = state};
}

/* Sends the results of all leases, frees them, and receives new ones. */
static inline struct mo_wire_leases finish(uint64_t session, struct mo_wire_leases *leases,
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

/* Joins a session with a rate of `rows_per_s`. Returns its leases. */
static inline struct mo_wire_leases warm(uint64_t session, double rows_per_s)
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

static inline struct mo_fleet_status status(void)
{
  struct mo_fleet_status facts;
  mo_fleet_status(fake->fleet, &facts);
  return facts;
}

static inline struct mo_fleet_orders orders_of(uint64_t session)
{
  struct mo_fleet_orders orders;
  CHECK(mo_fleet_orders(fake->fleet, session, fake->now_ns, &orders) >= 0);
  return orders;
}

static inline bool was_woken(uint64_t session)
{
  for (uint32_t i = 0; i < fake->n_wakes && i < COUNT(fake->woken); i++)
    if (fake->woken[i] == session)
      return true;
  return false;
}

static inline bool same_body(const struct mo_wire_block *block, uint32_t i)
{
  return memcmp(block->genotype, blocks[i]->genotype, sizeof(blocks[i]->genotype)) == 0;
}

/* Runs a case, and keeps its remaining blocks until the end. */
static inline void drop_blocks(void (*run)(void))
{
  memset(blocks, 0, sizeof(blocks));
  run();
  for (size_t i = 0; i < COUNT(blocks); i++)
    if (blocks[i] != NULL && blocks[i]->state == FAKE_DONE)
      check_keep(blocks[i], free);
}

#endif
