/* campaign_faults.c: a campaign on disks that are full or fail, at every operation of every part of its life: all of a part is there, or
 * nothing of it. */
#include <dirent.h>
#include <errno.h>
#include <sqlite3.h>
#include <stdatomic.h>

#include "../check.h"
#include "campaign_fixture.h"
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

static int faulty_open(void *context, const char *path, int flags)
{
  return file_fails() ? -1 : mo_file_operations_system()->open(context, path, flags);
}

static ssize_t faulty_write(void *context, int fd, const void *bytes, size_t size)
{
  return file_fails() ? -1 : mo_file_operations_system()->write(context, fd, bytes, size);
}

static int faulty_rename(void *context, const char *from, const char *to, bool replace)
{
  return file_fails() ? -1 : mo_file_operations_system()->rename(context, from, to, replace);
}

static int faulty_mkdir(void *context, const char *path)
{
  return file_fails() ? -1 : mo_file_operations_system()->mkdir(context, path);
}

/* ---- a life in parts ---- */

struct life {
  struct fixture fixture;
  struct mo_file_operations files;
  struct mo_bits *forms, *genotypes;
  struct mo_controller *controller;
  uint8_t *weights;
  size_t size;
  struct made made;
  int64_t id;
};

enum {
  SUBMIT,
  START,
  SAVE_LOSSES,
  CHECKPOINT,
  FIRST_COMMIT,
  SECOND_CHECKPOINT,
  SECOND_COMMIT,
  PARK,
  START_AGAIN,
  THIRD_COMMIT,
  EXTEND,
  FINISH,
  LIFE
};

static int open_life(struct life *life)
{
  struct mo_store_config config = {
      .path = life->fixture.path, .vfs = "faults", .files = &life->files, .fatal = on_fatal};
  int error;
  mo_store_close(life->fixture.store);
  life->fixture.store = NULL;
  error = mo_store_open(&config, &life->fixture.store, &life->fixture.message);
  life->made.store = life->fixture.store;
  return error;
}

static int begin(struct life *life)
{
  struct mo_controller_record record;
  int error;
  memset(life, 0, sizeof(*life));
  memset(&file_plan, 0, sizeof(file_plan));
  atomic_store(&fault_plan.write_error, 0);
  atomic_store(&fault_plan.sync_error, 0);
  atomic_store(&fault_plan.once, false);
  atomic_store(&fatal_calls, 0);
  life->files = *mo_file_operations_system();
  life->files.open = faulty_open;
  life->files.write = faulty_write;
  life->files.rename = faulty_rename;
  life->files.mkdir = faulty_mkdir;
  if (fault_vfs_register() != SQLITE_OK || fixture_folder(&life->fixture) != 0)
    return MO_ERR_IO;
  error = open_life(life);
  if (error == MO_OK)
    error = fixture_controller(life->fixture.store, "default", 1, &record);
  if (error == MO_OK)
    error = fixture_bodies(55, 3, &life->forms, &life->genotypes);
  if (error == MO_OK)
    error = mo_controller_create(MO_DEFAULT_WORKSPACE, MO_SENSOR_INVERSE_SQRT, &life->controller);
  if (error == MO_OK) {
    mo_controller_randomize(life->controller, 7);
    error = mo_controller_encode(life->controller, &life->weights, &life->size);
  }
  if (error == MO_OK)
    error = made_start(&life->made, life->fixture.store, 0, MO_ZERO_SHOT, MADE_POPULATION, 9);
  return error;
}

static void end(struct life *life)
{
  made_free(&life->made);
  free(life->forms);
  free(life->genotypes);
  free(life->weights);
  mo_controller_free(life->controller);
  fixture_end(&life->fixture);
}

static int commit(struct life *life)
{
  life->made.commit.checkpoint = (const uint8_t *)"the state after a generation";
  life->made.commit.checkpoint_size = 28;
  life->made.commit.checkpoint_step = 5;
  life->made.commit.collapse_data = "{}";
  life->made.commit.steps = life->made.steps;
  life->made.commit.n_steps = 1;
  life->made.steps[0] = (struct mo_campaign_step){.generation = life->made.commit.row.generation, .step = 1};
  return mo_store_campaign_commit(life->fixture.store, life->id, &life->made.commit);
}

/* What a part needs that cannot fail. */
static int prepare(struct life *life, int part)
{
  return part == SAVE_LOSSES || part == SECOND_CHECKPOINT || part == THIRD_COMMIT ? made_next(&life->made) : MO_OK;
}

static int live_on(struct life *life, int part)
{
  struct mo_store *store = life->fixture.store;
  struct mo_campaign_submission submission = campaign_submission(MO_ZERO_SHOT, MADE_POPULATION, 1);
  enum mo_job_state state;
  bool replayed;
  switch (part) {
  case SUBMIT:
    submission.record.replicates = 2;
    submission.forms = life->forms;
    submission.genotypes = life->genotypes;
    submission.record.n_listed = 3;
    submission.idempotency_key = "once";
    return mo_store_submit_campaign(store, &submission, &life->id, &replayed);
  case START:
  case START_AGAIN: return mo_store_campaign_start(store, life->id);
  case SAVE_LOSSES: return mo_store_campaign_save_losses(store, life->id, 0, life->made.losses, 4, "{}");
  case CHECKPOINT: return mo_store_campaign_checkpoint(store, life->id, 0, 1, (const uint8_t *)"state", 5, NULL, 0);
  case SECOND_CHECKPOINT:
    return mo_store_campaign_checkpoint(store, life->id, 1, 1, (const uint8_t *)"state", 5, NULL, 0);
  case FIRST_COMMIT:
  case SECOND_COMMIT:
  case THIRD_COMMIT: return commit(life);
  case PARK: return mo_store_campaign_park(store, life->id, MO_ERR_NO_MEMORY, "out of memory", 3, &state);
  case EXTEND: return mo_store_extend_campaign(store, life->id, 3, &state);
  default:
    return mo_store_campaign_finish(store, life->id, MO_CAMPAIGN_COMPLETED, 4, "walker", life->weights, life->size,
                                    life->controller);
  }
}

static void note(struct life *life, int part)
{
  life->made.id = life->id;
  if (part == FIRST_COMMIT || part == SECOND_COMMIT || part == THIRD_COMMIT)
    made_apply(&life->made);
}

/* ---- all that is stored, as a number ---- */

static uint64_t mix(uint64_t hash, const void *bytes, size_t n)
{
  for (size_t i = 0; i < n; i++)
    hash = (hash ^ ((const uint8_t *)bytes)[i]) * UINT64_C(0x100000001B3);
  return hash * 31 + n;
}

static uint64_t table_digest(sqlite3 *db, const char *name, uint64_t hash)
{
  char sql[200];
  sqlite3_stmt *rows = NULL;
  snprintf(sql, sizeof(sql), "SELECT * FROM \"%s\"", name);
  if (sqlite3_prepare_v2(db, sql, -1, &rows, NULL) != SQLITE_OK)
    return 0;
  while (sqlite3_step(rows) == SQLITE_ROW)
    for (int i = 0; i < sqlite3_column_count(rows); i++) {
      const void *value = sqlite3_column_blob(rows, i);
      hash = mix(hash, value, value != NULL ? (size_t)sqlite3_column_bytes(rows, i) : 0);
    }
  sqlite3_finalize(rows);
  return hash;
}

static uint64_t files_digest(const struct life *life, uint64_t hash)
{
  char path[512];
  uint64_t sum = 0; /* in whatever order they come */
  DIR *folder;
  snprintf(path, sizeof(path), "%s/campaigns/%lld", life->fixture.path, (long long)life->id);
  folder = opendir(path);
  for (struct dirent *entry; folder != NULL && (entry = readdir(folder)) != NULL;)
    if (strncmp(entry->d_name, ".", 1) != 0)
      sum += mix(1, entry->d_name, strlen(entry->d_name));
  if (folder != NULL)
    closedir(folder);
  return mix(hash, &sum, sizeof(sum));
}

/* Every row of every table but `meta`, which counts openings, and the names of the campaign's files. */
static uint64_t digest(const struct life *life)
{
  char path[512];
  uint64_t hash = 7;
  sqlite3 *db = NULL;
  sqlite3_stmt *tables = NULL;
  snprintf(path, sizeof(path), "%s/morphod.db", life->fixture.path);
  if (sqlite3_open_v2(path, &db, SQLITE_OPEN_READONLY, NULL) == SQLITE_OK &&
      sqlite3_prepare_v2(db,
                         "SELECT name FROM sqlite_schema WHERE type='table' AND name NOT IN ('meta','sqlite_sequence')"
                         " AND name NOT LIKE 'sqlite_stat%' ORDER BY name",
                         -1, &tables, NULL) == SQLITE_OK)
    while (sqlite3_step(tables) == SQLITE_ROW)
      hash = table_digest(db, (const char *)sqlite3_column_text(tables, 0), hash);
  sqlite3_finalize(tables);
  sqlite3_close(db);
  return files_digest(life, hash);
}

/* ---- cases ---- */

static void is_full_everywhere(void)
{
  struct life life;
  int failures = 0;
  REQUIRE(begin(&life) == MO_OK);
  for (int part = SUBMIT; part < LIFE; part++) {
    uint64_t before = 0;
    int error = MO_ERR_NO_SPACE;
    REQUIRE(prepare(&life, part) == MO_OK);
    before = digest(&life);
    for (long writes = 0; writes < 300 && error != MO_OK; writes++) {
      atomic_store(&fault_plan.writes_left, writes);
      atomic_store(&fault_plan.write_error, SQLITE_FULL);
      error = live_on(&life, part);
      atomic_store(&fault_plan.write_error, 0);
      if (error != MO_OK) {
        failures++;
        CHECK_INT(error, MO_ERR_NO_SPACE);
        CHECK(digest(&life) == before);
      }
    }
    CHECK_INT(error, MO_OK);
    CHECK(digest(&life) != before);
    note(&life, part);
    if (part >= FIRST_COMMIT)
      CHECK(made_is_stored(&life.made));
  }
  CHECK(failures >= 4 * LIFE);
  CHECK_INT(atomic_load(&fatal_calls), 0);
  CHECK_INT(mo_store_check(life.fixture.store, &life.fixture.message), MO_OK);
  end(&life);
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
    REQUIRE(prepare(&life, part) == MO_OK);
    before = digest(&life);
    for (int left = 0; left < 50 && error != MO_OK; left++) {
      file_plan.left = left;
      file_plan.error = ENOSPC;
      error = live_on(&life, part);
      file_plan.error = 0;
      if (error != MO_OK && error != MO_ERR_NO_SPACE) { /* a folder that cannot even be opened is fatal */
        CHECK_INT(error, MO_ERR_IO);
        CHECK_INT(atomic_load(&fatal_calls), 1);
        atomic_store(&fatal_calls, 0);
        REQUIRE(open_life(&life) == MO_OK);
        CHECK(digest(&life) == before);
        REQUIRE(mo_store_requeue(life.fixture.store, 0, 3, "") == MO_OK);
        if (part > START && part != START_AGAIN)
          REQUIRE(mo_store_campaign_start(life.fixture.store, life.id) == MO_OK);
        before = digest(&life);
      } else if (error != MO_OK) {
        CHECK(digest(&life) == before);
      }
      failures += error != MO_OK;
    }
    CHECK_INT(error, MO_OK);
    note(&life, part);
    if (part >= FIRST_COMMIT)
      CHECK(made_is_stored(&life.made));
  }
  CHECK(failures >= 5 * 4);
  end(&life);
}

static bool has_generation(const struct life *life)
{
  struct mo_campaign_state *state = NULL;
  bool has = mo_store_campaign_state(life->fixture.store, life->id, &state) == MO_OK;
  mo_campaign_state_free(state);
  return has;
}

/* The disk fails at some operation of a commit: the process ends, and the next one finds all of the generation or nothing. */
static void fails_everywhere(bool at_sync)
{
  struct life life;
  int all = 0, nothing = 0, step = at_sync ? 1 : 5;
  REQUIRE(begin(&life) == MO_OK);
  for (int part = SUBMIT; part < FIRST_COMMIT; part++) {
    REQUIRE(prepare(&life, part) == MO_OK);
    REQUIRE(live_on(&life, part) == MO_OK);
    note(&life, part);
  }
  for (long at = 0; at < 400 && life.made.generation < 4; at += step) {
    int error;
    atomic_store(&fault_plan.writes_left, at);
    atomic_store(&fault_plan.once, true);
    atomic_store(at_sync ? &fault_plan.sync_error : &fault_plan.write_error,
                 at_sync ? SQLITE_IOERR_FSYNC : SQLITE_IOERR_WRITE);
    error = commit(&life);
    atomic_store(&fault_plan.write_error, 0);
    atomic_store(&fault_plan.sync_error, 0);
    if (error == MO_OK && atomic_load(&fatal_calls) == 0) { /* all its operations came before the fault */
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
    REQUIRE(mo_store_campaign_start(life.fixture.store, life.id) == MO_OK);
    if (at_sync && all + nothing == 4)
      break;
  }
  printf("# %d times nothing of a commit, %d times all of it\n", nothing, all);
  CHECK(all + nothing >= (at_sync ? 4 : 10));
  end(&life);
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
