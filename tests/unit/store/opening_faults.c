/* opening_faults.c: the store opens and works while the disk or memory fails or is short, at each
 * call in turn.
 *
 * Each time the store either succeeds or reports the shortage. It must never report a damaged
 * database, because the database is intact. Failed calls leave nothing in memory (checked by the
 * address sanitizer) or in the folder. When the store finally opens, all data is there. */
#include "../failing.h"
#include "../make.h"
#include "fixture.h"
#include "life.h"
#include "store/internal.h"
#include "store/worlds.h"

/* SQLite's allocator, which fails together with the program's own. */
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
  if (sqlite3_config(SQLITE_CONFIG_GETMALLOC, &plain) != SQLITE_OK)
    return -1;
  failing = plain;
  failing.xMalloc = sqlite_malloc;
  failing.xRealloc = sqlite_realloc;
  return sqlite3_config(SQLITE_CONFIG_MALLOC, &failing) == SQLITE_OK ? 0 : -1;
}

/* Stops like a kill: nothing is cleaned up. */
static void leave(struct life *life)
{
  if (life->store != NULL)
    mo_store_declare_fatal(life->store, "the end of a test");
  mo_store_close(life->store);
  life->store = NULL;
}

static struct mo_bits *forms, *genotypes; /* (BODIES) */

static const struct act requeue = {.kind = ACT_REQUEUE, .parts = 1};

static void do_act(struct life *life, struct act act, int *error)
{
  life_apply(life, &act, life_do(life, life->store, &act, error));
}

/* Makes a folder with data of every kind, as a killed process leaves it. */
static int fill(struct life *life)
{
  struct mo_message message;
  int error = life_start(life, 1, DISK_HONEST, forms, genotypes);
  if (error == MO_OK)
    error = life_open(life, 0, &message);
  if (error == MO_OK)
    do_act(life, requeue, &error);
  for (size_t i = 0; i < HELD && error == MO_OK; i++)
    do_act(life, life_script[i], &error);
  leave(life);
  return error;
}

/* Opens the store without faults and compares it with what it held. */
static void check_contents(struct life *life)
{
  struct mo_message message;
  char text[MATCH_TEXT] = "";
  const int error = life_open(life, 0, &message);
  if (error != MO_OK)
    printf("# %s\n", message.text);
  REQUIRE_OK(error);
  CHECK_OK(mo_store_check(life->store, &message));
  if (!life_matches(life, text)) {
    printf("# %s\n", text);
    CHECK(false);
  }
  leave(life);
}

#ifdef __SANITIZE_ADDRESS__ /* slow there: test fewer calls */
enum { SPARSE = 4, DENSE = 2, LAST_STRIDE = 8 };
#else
enum { SPARSE = 1, DENSE = 16, LAST_STRIDE = 1 };
#endif

/* ---- the disk ---- */

static void opens_on_a_failing_disk(bool first_time, bool lasting, long stride)
{
  static struct life life;
  struct mo_message message;
  long n = 1, failed = 0, tolerated = 0;
  bool reached = true;
  REQUIRE_OK(fill(&life));
  for (; reached && n < 20000; n += stride) {
    if (first_time) {
      disk_free(life.disk);
      life.disk = disk_new(1, DISK_HONEST);
      REQUIRE(life.disk != NULL);
    }
    message.text[0] = '\0';
    disk_fail_at(life.disk, n, lasting);
    int error = life_open(&life, 0, &message);
    reached = disk_has_failed(life.disk);
    disk_fail_at(life.disk, 0, false);
    if (error != MO_OK && (error != MO_ERR_IO || message.text[0] == '\0'))
      printf("# call %ld: %d, %s\n", n, error, message.text);
    CHECK(error == MO_OK || (error == MO_ERR_IO && message.text[0] != '\0'));
    CHECK(error == MO_OK || reached);
    failed += error != MO_OK;
    tolerated += error == MO_OK && reached;
    leave(&life);
    if (!first_time &&
        (n / stride) % 8 ==
            0) { /* each opening makes the log longer, so the next opening makes more calls */
      check_contents(&life);
      life_end(&life);
      REQUIRE_OK(fill(&life));
    }
  }
  printf("# %ld calls failed in turn: %ld openings failed, %ld worked without\n",
         failed + tolerated, failed, tolerated);
  CHECK(failed > 10);
  if (!first_time)
    check_contents(&life);
  life_end(&life);
}

static const struct {
  bool first_time, lasting;
  long stride;
} disk_cases[] = {{false, false, 3}, {false, true, 5}, {true, false, 7}, {true, true, 11}};

static void opens_in_spite_of_errors(int i)
{
  opens_on_a_failing_disk(disk_cases[i].first_time, disk_cases[i].lasting,
                          SPARSE * disk_cases[i].stride);
}

/* ---- memory ---- */

/* The last allocations belong to the writer's first operation: all of them are tested, except with
 * the address sanitizer. */
enum { PLENTY = 1000000, AT_THE_END = 160 };

static void opens_without_memory(bool first_time, long stride)
{
  static struct life life;
  struct mo_message message;
  long n = 0, all = PLENTY, failed = 0, tolerated = 0;
  bool reached = true;
  REQUIRE_OK(fill(&life));
  for (; reached && n < PLENTY; n += n + AT_THE_END < all ? stride : LAST_STRIDE) {
    struct mo_store_config config = {.path = disk_folder(life.disk),
                                     .n_readers =
                                         1}; /* the simulated disk's own allocations do not fail */
    if (first_time) {
      REQUIRE(fixture_folder() == 0);
      config.path = fixture.path;
    }
    left = all == PLENTY ? PLENTY : n; /* first only count them */
    int error = mo_store_open(&config, &life.store, &message);
    reached = left < 0 || all == PLENTY;
    if (all == PLENTY)
      all -= left;
    left = -1;
    if (error != MO_OK && error != MO_ERR_NO_MEMORY)
      printf("# allocation %ld: %d, %s\n", n, error, message.text);
    CHECK(error == MO_OK || error == MO_ERR_NO_MEMORY);
    failed += error != MO_OK;
    tolerated += error == MO_OK && reached;
    if (error != MO_OK)
      life.store = NULL;
    leave(&life);
    if (first_time)
      fixture_remove(fixture.path);
    else if ((n / stride) % 8 == 0) {
      check_contents(&life);
      life_end(&life);
      REQUIRE_OK(fill(&life));
    }
  }
  printf("# %ld allocations failed in turn: %ld openings failed, %ld worked without\n",
         failed + tolerated, failed, tolerated);
  CHECK(failed > 10);
  check_contents(&life);
  life_end(&life);
}

static void opens_when_memory_is_short(int first_time)
{
  opens_without_memory(first_time, SPARSE * (first_time ? 197 : 67));
}

/* ---- while it is open ---- */

enum shortage { ONE_ALLOCATION, ALLOCATIONS, ROOM_IN_THE_DATABASE, ROOM_FOR_FILES };

/* Makes n more units of the resource available; negative = unlimited. */
static void shorten(struct life *life, enum shortage what, long n)
{
  if (what == ROOM_IN_THE_DATABASE || what == ROOM_FOR_FILES)
    disk_fill_after(life->disk, what == ROOM_FOR_FILES ? DISK_FILES : DISK_DATABASE, n);
  fails_for_good = what == ALLOCATIONS;
  left = what == ONE_ALLOCATION || what == ALLOCATIONS ? n : -1;
}

static uint64_t digest(const struct life *life)
{
  static struct contents contents;
  life_contents(disk_folder(life->disk), &contents);
  return contents.sum;
}

/* Each act of a history is tried, one part at a time, with more and more of the scarce resource
 * until that is enough. Each time the store must report the error, survive, and store nothing. */
static void works_short_of(enum shortage what, bool is_long)
{
  static struct life life;
  const bool is_memory = what == ONE_ALLOCATION || what == ALLOCATIONS;
  struct mo_message message;
  struct mo_store_stats stats;
  char text[MATCH_TEXT] = "";
  long failed = 0;
  int error = MO_OK;
  REQUIRE_OK(life_start(&life, 1, DISK_HONEST, forms, genotypes));
  REQUIRE_OK(life_open(&life, 0, &message));
  do_act(&life, requeue, &error);
  CHECK_OK(error);
  for (int i = 0; i < SCRIPT; i++) {
    struct act act = life_script[i];
    uint64_t before = digest(&life);
    for (long n = 0; act.parts > 0 && n < 10000; n += 1 + (is_long || !is_memory ? 0 : n / DENSE)) {
      struct act part = act;
      part.parts = 1;
      part.n = act.kind == ACT_SAVE ? 1 : act.n;
      error = MO_OK;
      shorten(&life, what, n);
      uint32_t done = life_do(&life, life.store, &part, &error);
      shorten(&life, what, -1);
      mo_store_get_stats(life.store, &stats);
      const uint64_t after = digest(&life);
      if (!(error == MO_OK || error == (is_memory ? MO_ERR_NO_MEMORY : MO_ERR_NO_SPACE)) ||
          (done == 0 && after != before) || stats.fatal ||
          (error != MO_OK && what == ROOM_IN_THE_DATABASE && !stats.no_space)) {
        printf("# act %d of the script with %ld of %d: error %d\n", i, n, what, error);
        CHECK(false);
      }
      before = after;
      life_apply(&life, &act, done);
      failed += error != MO_OK;
    }
    CHECK_INT(act.parts, 0);
    life_wait_for_writer(life.store);
    CHECK(life_matches(&life, text));
  }
  printf("# %ld acts failed%s\n", failed, text);
  CHECK(failed > (what == ROOM_FOR_FILES ? 20 : 4 * SCRIPT));
  mo_store_close(life.store);
  check_contents(&life);
  life_end(&life);
}

static void works_when_short_of(int what)
{
  works_short_of((enum shortage)what, false);
}

/* Readers must report the shortage as well. */
static int read_all(const struct life *life)
{
  struct mo_store *of = life->store;
  const int64_t id = life->jobs[MO_JOB_CAMPAIGN][0].id;
  struct mo_campaign_design designs[MEMBERS];
  struct mo_campaign_status status;
  struct mo_campaign_state *state = NULL;
  struct mo_environment *environments = NULL;
  struct mo_bits *initial = NULL, *best = NULL;
  struct mo_descent *descents = NULL;
  struct mo_campaign_loss *losses = NULL;
  uint32_t *born = NULL, n = 0, generation = 0, step = 0;
  uint8_t *bytes = NULL;
  size_t size = 0;
  int64_t found = mo_store_campaign(of, id, &status);
  if (found == MO_OK)
    found = mo_store_job_environments(of, id, MO_JOB_CAMPAIGN, &environments, &n);
  if (found == MO_OK)
    found = mo_store_job_designs(of, id, &initial, &n);
  if (found == MO_OK)
    found = mo_store_campaign_state(of, id, &state);
  if (found == MO_OK)
    found = mo_store_campaign_descents(of, id, &descents, &born, &n);
  if (found == MO_OK)
    found = mo_store_campaign_losses(of, id, status.job.steps_done + 1, &losses, &size);
  if (found == MO_OK)
    found = newest_checkpoint(of, id, &generation, &step, &bytes, &size);
  if (found == MO_OK)
    found = mo_store_population(of, id, 0, &best, &n);
  if (found == MO_OK)
    found = mo_store_campaign_designs(of, id, -1, designs, MEMBERS);
  if (found > 0)
    found = mo_store_campaign_population(of, id, -1, 0, designs, MEMBERS, &n);
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
  static struct life life;
  struct mo_message message;
  int error = MO_ERR_NO_MEMORY, failed = 0;
  REQUIRE_OK(fill(&life));
  for (long n = 0; n < 100000 && error != MO_OK; n += 1 + n / 16) {
    REQUIRE_OK(life_open(&life, 0, &message)); /* no statement is prepared yet */
    shorten(&life, ALLOCATIONS, n);
    error = read_all(&life);
    shorten(&life, ALLOCATIONS, -1);
    CHECK(error == MO_OK || error == MO_ERR_NO_MEMORY);
    failed += error != MO_OK;
    mo_store_close(life.store);
  }
  CHECK_OK(error);
  printf("# %d times without memory\n", failed);
  CHECK(failed > 50);
  life.store = NULL;
  life_end(&life);
}

static void fails_at_every_call(void)
{
  for (size_t i = 0; i < COUNT(disk_cases); i++)
    opens_on_a_failing_disk(disk_cases[i].first_time, disk_cases[i].lasting, 1);
  opens_without_memory(false, 1);
  opens_without_memory(true, 1);
  for (int what = ONE_ALLOCATION; what <= ROOM_FOR_FILES; what++)
    works_short_of((enum shortage)what, true);
}

static const struct check_case cases[] = {
    {"short: opens after a disk error", WITH(opens_in_spite_of_errors, 0)},
    {"short: opens after a period of errors", WITH(opens_in_spite_of_errors, 1)},
    {"short: is created after a disk error", WITH(opens_in_spite_of_errors, 2)},
    {"short: is created after a period of errors", WITH(opens_in_spite_of_errors, 3)},
    {"short: opens after a period without memory", WITH(opens_when_memory_is_short, false)},
    {"short: is created after a period without memory", WITH(opens_when_memory_is_short, true)},
    {"short: works without an allocation", WITH(works_when_short_of, ONE_ALLOCATION)},
    {"short: works without memory", WITH(works_when_short_of, ALLOCATIONS)},
    {"short: works without room in the database", WITH(works_when_short_of, ROOM_IN_THE_DATABASE)},
    {"short: works without room for files", WITH(works_when_short_of, ROOM_FOR_FILES)},
    {"short: reads without memory", reads_without_memory},
    {"long: an error at every call, an allocation that fails at every one", fails_at_every_call},
};

int main(int argc, char **argv)
{
  if (fail_in_sqlite() != 0) { /* before any other call to SQLite */
    printf("Bail out! SQLite takes no other allocator\n");
    return 1;
  }
  genotypes = make_bodies(7, BODIES, &forms);
  return check_run(cases, COUNT(cases), argc, argv);
}
