/* opening_faults.c: the store is opened while the disk or the memory fails, at every call in turn.
 *
 * Each time it opens, or says what was missing: never that the database is damaged, for it is not.
 * Nothing is left behind in memory (the address sanitizer looks), and what the folder holds is all
 * there when it opens at last. */
#include "../check.h"
#include "../failing.h"
#include "fixture.h"
#include "life.h"
#include "store/internal.h"

/* SQLite's allocator, failing with ours. */
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

/* A folder with something of everything, as a killed process leaves it. */
static const struct act contents[] = {
    {ACT_REQUEUE, 0, 0, 0, 1},
    {ACT_PUT, 0, 9, 0, 1},
    {ACT_SUBMIT, 0, 1, 0, 1},
    {ACT_SAVE, 0, 0, 2, 2},
    {ACT_TRAIN, 0, 21, 0, 1},
    {ACT_TRAIN_START, 0, 0, 0, 1},
    {ACT_TRAIN_PROGRESS, 0, 3, 7, 1},
    {ACT_TRAIN_CHECKPOINT, 0, 0, 1, 1},
    {ACT_CAMPAIGN, 0, 22, 0, 1},
    {ACT_CAMPAIGN_START, 0, 0, 0, 1},
    {ACT_CAMPAIGN_GENERATION, 0, 0, 0, 1},
};

static int open_life(struct life *life, struct mo_message *message)
{
  struct mo_store_config config = {.path = disk_folder(life->disk),
                                   .vfs = disk_vfs(life->disk),
                                   .files = disk_files(life->disk),
                                   .n_readers = 1};
  life->store = NULL;
  return mo_store_open(&config, &life->store, message);
}

/* As a kill does: nothing is tidied up. */
static void leave(struct life *life)
{
  if (life->store != NULL)
    mo_store_declare_fatal(life->store, "the end of a test");
  mo_store_close(life->store);
  life->store = NULL;
}

static int begin(struct life *life)
{
  *life = (struct life){.disk = disk_new(1, DISK_HONEST)};
  for (int i = 0; i < NAMES; i++)
    life->model.names[i].content = -1;
  if (life->disk == NULL)
    return MO_ERR_IO;
  return fixture_bodies(7, BODIES, &life->forms, &life->genotypes);
}

static int fill(struct life *life)
{
  struct mo_message message;
  int error = begin(life);
  if (error == MO_OK)
    error = open_life(life, &message);
  for (size_t i = 0; i < sizeof(contents) / sizeof(contents[0]) && error == MO_OK; i++)
    life_apply(&life->model, &contents[i], life_do(life, &contents[i], &error));
  leave(life);
  return error;
}

static void empty(struct life *life)
{
  mo_store_close(life->store);
  disk_free(life->disk);
  free(life->forms);
  free(life->genotypes);
}

/* It opens now, and holds what it held. */
static void check_contents(struct life *life)
{
  struct mo_message message;
  char text[300] = "";
  const int error = open_life(life, &message);
  if (error != MO_OK)
    printf("# %s\n", message.text);
  REQUIRE(error == MO_OK);
  CHECK_INT(mo_store_check(life->store, &message), MO_OK);
  if (!life_matches(life, &life->model, text)) {
    printf("# %s\n", text);
    CHECK(false);
  }
  leave(life);
}

/* ---- the disk ---- */

static void opens_on_a_failing_disk(bool first_time, bool lasting, long stride)
{
  static struct life life;
  struct mo_message message;
  long n = 1, failed = 0, tolerated = 0;
  bool reached = true;
  REQUIRE(fill(&life) == MO_OK);
  for (; reached && n < 20000; n += stride) {
    int error;
    if (first_time) {
      disk_free(life.disk);
      life.disk = disk_new(1, DISK_HONEST);
      REQUIRE(life.disk != NULL);
    }
    message.text[0] = '\0';
    disk_fail_at(life.disk, n, lasting);
    error = open_life(&life, &message);
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
        (n / stride) % 8 == 0) { /* each opening makes the log longer, and so the next one */
      check_contents(&life);
      empty(&life);
      REQUIRE(fill(&life) == MO_OK);
    }
  }
  printf("# %ld calls failed in turn: %ld openings failed, %ld did without\n", failed + tolerated,
         failed, tolerated);
  CHECK(failed > 10);
  if (!first_time)
    check_contents(&life);
  empty(&life);
}

static void opens_after_one_error(void)
{
  opens_on_a_failing_disk(false, false, 3);
}

static void opens_after_many_errors(void)
{
  opens_on_a_failing_disk(false, true, 5);
}

static void is_made_after_one_error(void)
{
  opens_on_a_failing_disk(true, false, 7);
}

static void is_made_after_many_errors(void)
{
  opens_on_a_failing_disk(true, true, 11);
}

/* ---- memory ---- */

/* The last ones are of the writer's first operation: none of those is left out. */
enum { PLENTY = 1000000, AT_THE_END = 160 };

static void opens_without_memory(bool first_time, long stride)
{
  static struct life life;
  struct mo_message message;
  long n = 0, all = PLENTY, failed = 0, tolerated = 0;
  bool reached = true;
  REQUIRE(fill(&life) == MO_OK);
  for (; reached && n < PLENTY; n += n + AT_THE_END < all ? stride : 1) {
    struct mo_store_config config = {.path = disk_folder(life.disk),
                                     .n_readers = 1}; /* the disk's own memory stays */
    struct fixture fixture;
    int error;
    if (first_time) {
      REQUIRE(fixture_folder(&fixture) == 0);
      config.path = fixture.path;
    }
    left = all == PLENTY ? PLENTY : n; /* first they are counted */
    error = mo_store_open(&config, &life.store, &message);
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
      empty(&life);
      REQUIRE(fill(&life) == MO_OK);
    }
  }
  printf("# %ld allocations failed in turn: %ld openings failed, %ld did without\n",
         failed + tolerated, failed, tolerated);
  CHECK(failed > 10);
  check_contents(&life);
  empty(&life);
}

static void opens_when_memory_is_short(void)
{
  opens_without_memory(false, 67);
}

static void is_made_when_memory_is_short(void)
{
  opens_without_memory(true, 197);
}

/* Every act of a life is tried until it finds all the memory that it wants: the store tells each
 * time, and does not die of it. */
static void works_without_memory(long stride)
{
  static struct life life;
  struct mo_message message;
  struct mo_store_stats stats;
  long failed = 0, tolerated = 0;
  REQUIRE(begin(&life) == MO_OK);
  REQUIRE(open_life(&life, &message) == MO_OK);
  for (size_t i = 0; i < sizeof(contents) / sizeof(contents[0]); i++) {
    struct act act = contents[i];
    bool reached = true;
    for (long n = 0; act.parts > 0 && n < 10000; n += stride) {
      uint32_t done;
      int error = MO_OK;
      left = n;
      done = life_do(&life, &act, &error);
      reached = left < 0;
      left = -1;
      if (error != MO_OK && error != MO_ERR_NO_MEMORY)
        printf("# act %d, allocation %ld: %d\n", (int)act.kind, n, error);
      CHECK(error == MO_OK || error == MO_ERR_NO_MEMORY);
      CHECK(error == MO_OK || reached);
      life_apply(&life.model, &act, done);
      act.parts -= done;
      if (act.kind == ACT_SAVE)
        act.n = act.parts;
      failed += error != MO_OK;
      tolerated += error == MO_OK && reached;
    }
    CHECK_INT(act.parts, 0);
    life_settle(&life);
  }
  mo_store_get_stats(life.store, &stats);
  CHECK(!stats.fatal);
  printf("# %ld allocations failed in turn: %ld acts failed, %ld did without\n", failed + tolerated,
         failed, tolerated);
  CHECK(failed > 10);
  mo_store_close(life.store);
  check_contents(&life);
  empty(&life);
}

static void works_when_memory_is_short(void)
{
  works_without_memory(1);
}

static void fails_at_every_call(void)
{
  opens_on_a_failing_disk(false, false, 1);
  opens_on_a_failing_disk(false, true, 1);
  opens_on_a_failing_disk(true, false, 1);
  opens_on_a_failing_disk(true, true, 1);
  opens_without_memory(false, 1);
  opens_without_memory(true, 1);
  works_without_memory(1);
}

static const struct check_case cases[] = {
    {"short: opens after an error of the disk", opens_after_one_error},
    {"short: opens after a time of errors", opens_after_many_errors},
    {"short: is made after an error of the disk", is_made_after_one_error},
    {"short: is made after a time of errors", is_made_after_many_errors},
    {"short: opens after a time without memory", opens_when_memory_is_short},
    {"short: is made after a time without memory", is_made_when_memory_is_short},
    {"short: works after times without memory", works_when_memory_is_short},
    {"long: an error at every call, an allocation that fails at every one", fails_at_every_call},
};

int main(int argc, char **argv)
{
  if (fail_in_sqlite() != 0) { /* before anything else is asked of it */
    printf("Bail out! SQLite takes no other allocator\n");
    return 1;
  }
  return check_run(cases, sizeof(cases) / sizeof(cases[0]), argc, argv);
}
