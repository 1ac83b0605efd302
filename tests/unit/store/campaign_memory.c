/* campaign_memory.c: memory runs out at every allocation of every part of a campaign's life, ours
 * and SQLite's: all of a part is there, or nothing of it, and nothing is left behind (the address
 * sanitizer looks). */
#include "../check.h"
#include "campaign_life.h"
#include "store/trainings.h"

#include <stdatomic.h>

void *__real_malloc(size_t size);
void *__real_calloc(size_t count, size_t size);
void *__real_realloc(void *old, size_t size);
void *__wrap_malloc(size_t size);
void *__wrap_calloc(size_t count, size_t size);
void *__wrap_realloc(void *old, size_t size);

/* So many allocations succeed before all fail; negative: none fails. The store's threads allocate,
 * too. */
static atomic_long left = -1;

static bool fails(void)
{
  long now = atomic_load(&left);
  while (now > 0 && !atomic_compare_exchange_weak(&left, &now, now - 1))
    ;
  return now == 0;
}

void *__wrap_malloc(size_t size)
{
  return fails() ? NULL : __real_malloc(size);
}

void *__wrap_calloc(size_t count, size_t size)
{
  return fails() ? NULL : __real_calloc(count, size);
}

void *__wrap_realloc(void *old, size_t size)
{
  return fails() ? NULL : __real_realloc(old, size);
}

static sqlite3_mem_methods plain;

static void *sqlite_malloc(int size)
{
  return fails() ? NULL : plain.xMalloc(size);
}

static void *sqlite_realloc(void *old, int size)
{
  return fails() ? NULL : plain.xRealloc(old, size);
}

static int fail_in_sqlite(void)
{
  sqlite3_mem_methods failing;
  if (plain.xMalloc != NULL)
    return SQLITE_OK;
  if (sqlite3_config(SQLITE_CONFIG_GETMALLOC, &plain) != SQLITE_OK)
    return SQLITE_ERROR;
  failing = plain;
  failing.xMalloc = sqlite_malloc;
  failing.xRealloc = sqlite_realloc;
  return sqlite3_config(SQLITE_CONFIG_MALLOC, &failing);
}

/* Ever later, in steps that grow: a part makes some hundreds of allocations. */
static void is_short_of_memory(void)
{
  struct life life;
  const struct mo_store_config config = {.n_readers = 1};
  int failures = 0;
  REQUIRE(fail_in_sqlite() == SQLITE_OK && begin_life(&life, &config) == MO_OK);
  for (int part = SUBMIT; part < LIFE; part++) {
    uint64_t before;
    int error = MO_ERR_NO_MEMORY;
    REQUIRE(prepare_life(&life, part) == MO_OK);
    before = digest(&life);
    for (long n = 0; n < 100000 && error != MO_OK; n += 1 + n / 16) {
      atomic_store(&left, n);
      error = live_on(&life, part);
      atomic_store(&left, -1);
      if (error != MO_OK) {
        failures++;
        CHECK_INT(error, MO_ERR_NO_MEMORY);
        CHECK(digest(&life) == before);
      }
    }
    CHECK_INT(error, MO_OK);
    note_life(&life, part);
    if (part >= FIRST_COMMIT)
      CHECK(made_is_stored(&life.made));
  }
  printf("# %d times without memory\n", failures);
  CHECK(failures >= 5 * LIFE);
  CHECK_INT(mo_store_check(life.fixture.store, &life.fixture.message), MO_OK);
  end_life(&life);
}

/* Readers, too: they say so, and give the same when there is memory again. */
static int read_all(const struct life *life)
{
  struct mo_store *store = life->fixture.store;
  struct mo_campaign_design designs[MADE_POPULATION];
  struct mo_campaign_status status;
  struct mo_campaign_state *state = NULL;
  struct mo_environment *environments = NULL;
  struct mo_bits *initial = NULL, *best = NULL;
  struct mo_descent *descents = NULL;
  struct mo_campaign_loss *losses = NULL;
  uint32_t *born = NULL, n = 0, generation = 0, step = 0;
  uint8_t *bytes = NULL;
  size_t size = 0;
  int64_t found = mo_store_campaign(store, life->id, &status);
  if (found == MO_OK)
    found = mo_store_campaign_environments(store, life->id, &environments, &n);
  if (found == MO_OK)
    found = mo_store_job_designs(store, life->id, &initial, &n);
  if (found == MO_OK)
    found = mo_store_campaign_state(store, life->id, &state);
  if (found == MO_OK)
    found = mo_store_campaign_descents(store, life->id, &descents, &born, &n);
  if (found == MO_OK)
    found = mo_store_campaign_losses(store, life->id, status.job.steps_done + 1, &losses, &size);
  if (found == MO_OK)
    found = fixture_campaign_checkpoint(store, life->id, &generation, &step, &bytes, &size);
  if (found == MO_OK)
    found = mo_store_population(store, life->id, 0, &best, &n);
  if (found == MO_OK)
    found = mo_store_campaign_designs(store, life->id, -1, designs, MADE_POPULATION);
  if (found > 0)
    found = mo_store_campaign_population(store, life->id, -1, 0, designs, MADE_POPULATION, &n);
  mo_campaign_state_free(state);
  free(environments);
  free(initial);
  free(best);
  free(descents);
  free(losses);
  free(born);
  free(bytes);
  return found > 0 ? MO_OK : (int)found;
}

static void reads_without_memory(void)
{
  struct life life;
  const struct mo_store_config config = {.n_readers = 1};
  int error = MO_ERR_NO_MEMORY, failures = 0;
  REQUIRE(fail_in_sqlite() == SQLITE_OK && begin_life(&life, &config) == MO_OK);
  for (int part = SUBMIT; part <= SECOND_COMMIT; part++) {
    REQUIRE(prepare_life(&life, part) == MO_OK && live_on(&life, part) == MO_OK);
    note_life(&life, part);
  }
  for (long n = 0; n < 100000 && error != MO_OK; n += 1 + n / 16) {
    REQUIRE(open_life(&life) == MO_OK); /* nothing is prepared yet */
    atomic_store(&left, n);
    error = read_all(&life);
    atomic_store(&left, -1);
    if (error != MO_OK) {
      failures++;
      CHECK_INT(error, MO_ERR_NO_MEMORY);
    }
  }
  CHECK_INT(error, MO_OK);
  printf("# %d times without memory\n", failures);
  CHECK(failures > 50);
  end_life(&life);
}

static const struct check_case cases[] = {
    {"is short of memory", is_short_of_memory},
    {"reads without memory", reads_without_memory},
};
CHECK_MAIN(cases)
