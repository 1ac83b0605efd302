/* campaign_faults.c: jobs on disks that are full or fail, at every operation of every part of their
 * lives: all of a part is there, or nothing of it. */
#include <errno.h>
#include <stdatomic.h>

#include "../check.h"
#include "campaign_life.h"
#include "fault_vfs.h"

static atomic_int fatal_calls;

static void on_fatal(void *context, const char *what)
{
  (void)context;
  (void)what;
  atomic_fetch_add(&fatal_calls, 1);
}

/* ---- files that cannot be written ---- */

static struct {
  int error; /* errno; 0: all is well */
  int left;  /* so many operations succeed */
} file_plan;

static bool file_fails(void)
{
  if (file_plan.error == 0 || file_plan.left-- > 0)
    return false;
  errno = file_plan.error;
  return true;
}

static int faulty_open(const char *path, int flags, ...)
{
  return file_fails() ? -1 : mo_system_files.open(path, flags, 0600);
}

static ssize_t faulty_write(int fd, const void *bytes, size_t size)
{
  return file_fails() ? -1 : mo_system_files.write(fd, bytes, size);
}

static int faulty_rename(const char *from, const char *to)
{
  return file_fails() ? -1 : mo_system_files.rename(from, to);
}

static int faulty_mkdir(const char *path, mode_t mode)
{
  return file_fails() ? -1 : mo_system_files.mkdir(path, mode);
}

/* ---- a life on them ---- */

static int begin(struct life *life)
{
  static struct mo_file_operations files;
  const struct mo_store_config config = {.vfs = "faults", .files = &files, .fatal = on_fatal};
  memset(&file_plan, 0, sizeof(file_plan));
  atomic_store(&fault_plan.write_error, 0);
  atomic_store(&fault_plan.sync_error, 0);
  atomic_store(&fault_plan.once, false);
  atomic_store(&fatal_calls, 0);
  files = mo_system_files;
  files.open = faulty_open;
  files.write = faulty_write;
  files.rename = faulty_rename;
  files.mkdir = faulty_mkdir;
  return fault_vfs_register() == SQLITE_OK ? begin_life(life, &config) : MO_ERR_IO;
}

/* ---- cases ---- */

static void is_full_everywhere(void)
{
  struct life life;
  int failures = 0;
  REQUIRE(begin(&life) == MO_OK);
  for (int part = SUBMIT; part < LIFE; part++) {
    struct mo_store_stats stats;
    uint64_t before = 0;
    int error = MO_ERR_NO_SPACE;
    REQUIRE(prepare_life(&life, part) == MO_OK);
    before = digest(&life);
    for (long writes = 0; writes < 400 && error != MO_OK; writes++) {
      atomic_store(&fault_plan.writes_left, writes);
      atomic_store(&fault_plan.write_error, SQLITE_FULL);
      error = live_on(&life, part);
      atomic_store(&fault_plan.write_error, 0);
      if (error != MO_OK) {
        failures++;
        mo_store_get_stats(life.fixture.store, &stats);
        CHECK_INT(error, MO_ERR_NO_SPACE);
        CHECK(stats.no_space && !stats.fatal);
        CHECK(digest(&life) == before);
      }
    }
    CHECK_INT(error, MO_OK);
    CHECK(digest(&life) != before);
    note_life(&life, part);
    if (part >= FIRST_COMMIT)
      CHECK(made_is_stored(&life.made));
  }
  CHECK(failures >= 4 * LIFE);
  CHECK_INT(atomic_load(&fatal_calls), 0);
  CHECK_INT(mo_store_check(life.fixture.store, &life.fixture.message), MO_OK);
  end_life(&life);
}

/* The folder of checkpoints has no room, the database has. */
static void has_no_room_for_files(void)
{
  struct life life;
  int failures = 0;
  REQUIRE(begin(&life) == MO_OK);
  for (int part = SUBMIT; part < LIFE; part++) {
    uint64_t before;
    int error = MO_ERR_NO_SPACE;
    REQUIRE(prepare_life(&life, part) == MO_OK);
    before = digest(&life);
    for (int left = 0; left < 50 && error != MO_OK; left++) {
      file_plan.left = left;
      file_plan.error = ENOSPC;
      error = live_on(&life, part);
      file_plan.error = 0;
      if (error != MO_OK &&
          error != MO_ERR_NO_SPACE) { /* a folder that cannot even be opened is fatal */
        CHECK_INT(error, MO_ERR_IO);
        CHECK_INT(atomic_load(&fatal_calls), 1);
        atomic_store(&fatal_calls, 0);
        REQUIRE(open_life(&life) == MO_OK);
        CHECK(digest(&life) == before);
        REQUIRE(mo_store_requeue(life.fixture.store, 0, 3, "") == MO_OK);
        if (runs_before(&life, part) != 0)
          REQUIRE(mo_store_run_start(life.fixture.store, runs_before(&life, part)) == MO_OK);
        before = digest(&life);
      } else if (error != MO_OK) {
        CHECK(digest(&life) == before);
      }
      failures += error != MO_OK;
    }
    CHECK_INT(error, MO_OK);
    note_life(&life, part);
    if (part >= FIRST_COMMIT)
      CHECK(made_is_stored(&life.made));
  }
  CHECK(failures >= 5 * 4);
  end_life(&life);
}

static bool has_generation(const struct life *life)
{
  struct mo_campaign_state *state = NULL;
  bool has = mo_store_campaign_state(life->fixture.store, life->id, &state) == MO_OK;
  mo_campaign_state_free(state);
  return has;
}

/* The disk fails at some operation of a commit: the process ends, and the next one finds all of the
 * generation or nothing. */
static void fails_everywhere(bool at_sync)
{
  struct life life;
  int all = 0, nothing = 0, step = at_sync ? 1 : 5;
  REQUIRE(begin(&life) == MO_OK);
  for (int part = SUBMIT; part < FIRST_COMMIT; part++) {
    REQUIRE(prepare_life(&life, part) == MO_OK);
    REQUIRE(live_on(&life, part) == MO_OK);
    note_life(&life, part);
  }
  for (long at = 0; at < 400 && life.made.generation < 4; at += step) {
    int error;
    atomic_store(&fault_plan.writes_left, at);
    atomic_store(&fault_plan.once, true);
    atomic_store(at_sync ? &fault_plan.sync_error : &fault_plan.write_error,
                 at_sync ? SQLITE_IOERR_FSYNC : SQLITE_IOERR_WRITE);
    error = commit_life(&life);
    atomic_store(&fault_plan.write_error, 0);
    atomic_store(&fault_plan.sync_error, 0);
    if (error == MO_OK &&
        atomic_load(&fatal_calls) == 0) { /* all its operations came before the fault */
      made_apply(&life.made);
      REQUIRE(made_next(&life.made) == MO_OK);
      at = -step;
      continue;
    }
    CHECK(atomic_load(&fatal_calls) == 1);
    atomic_store(&fatal_calls, 0);
    REQUIRE(open_life(&life) == MO_OK);
    if (life.made.generation >= 0 && made_is_stored(&life.made)) {
      nothing++;
      CHECK_INT(error, MO_ERR_IO);
    } else if (life.made.generation < 0 && !has_generation(&life)) {
      nothing++;
    } else { /* its log was whole after all */
      made_apply(&life.made);
      CHECK(made_is_stored(&life.made));
      all++;
      REQUIRE(made_next(&life.made) == MO_OK);
    }
    CHECK_INT(mo_store_check(life.fixture.store, &life.fixture.message), MO_OK);
    REQUIRE(mo_store_requeue(life.fixture.store, 0, 3, "") == MO_OK);
    REQUIRE(mo_store_run_start(life.fixture.store, life.id) == MO_OK);
    if (at_sync && all + nothing == 4)
      break;
  }
  printf("# %d times nothing of a commit, %d times all of it\n", nothing, all);
  CHECK(all + nothing >= (at_sync ? 4 : 10));
  end_life(&life);
}

static void fails_at_writes(void)
{
  fails_everywhere(false);
}

static void fails_at_syncs(void)
{
  fails_everywhere(true);
}

static const struct check_case cases[] = {
    {"is full everywhere", is_full_everywhere},
    {"has no room for files", has_no_room_for_files},
    {"fails at writes", fails_at_writes},
    {"fails at syncs", fails_at_syncs},
};
CHECK_MAIN(cases)
