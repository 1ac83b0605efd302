/* faults.c: full disks, failing disks, many writers at once. */
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <time.h>

#include "../check.h"
#include "by_hand.h"
#include "fault_vfs.h"
#include "fixture.h"
#include "store/trainings.h"

static atomic_int fatal_calls;

static void on_fatal(void *context, const char *what)
{
  (void)context;
  (void)what;
  atomic_fetch_add(&fatal_calls, 1);
}

/* A store on the failing file system. */
static int start_failing(struct fixture *fixture)
{
  struct mo_store_config config = {.vfs = "faults", .fatal = on_fatal};
  struct mo_controller_record record;
  int error;
  atomic_store(&fault_plan.write_error, 0);
  atomic_store(&fault_plan.sync_error, 0);
  atomic_store(&fault_plan.once, false);
  atomic_store(&fatal_calls, 0);
  if (fault_vfs_register() != SQLITE_OK || fixture_folder(fixture) != 0)
    return -1;
  config.path = fixture->path;
  error = mo_store_open(&config, &fixture->store, &fixture->message);
  return error == MO_OK ? fixture_controller(fixture->store, "default", 1, &record) : error;
}

static void notices_that_there_is_room_again(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes;
  struct mo_submission submission;
  struct mo_store_stats stats;
  int64_t id = 0;
  bool replayed;
  REQUIRE(start_failing(&fixture) == MO_OK);
  REQUIRE(fixture_bodies(1, 3, &forms, &genotypes) == MO_OK);
  submission = fixture_submission(forms, genotypes, 3);
  atomic_store(&fault_plan.writes_left, 0);
  atomic_store(&fault_plan.write_error, SQLITE_FULL);
  CHECK_INT(mo_store_submit(fixture.store, &submission, &id, &replayed), MO_ERR_NO_SPACE);
  usleep(1500000); /* asking does not answer */
  mo_store_get_stats(fixture.store, &stats);
  CHECK(stats.no_space && !stats.fatal);
  atomic_store(&fault_plan.write_error, 0);
  for (int i = 0; i < 1000 && stats.no_space; i++) { /* nobody writes */
    usleep(10000);
    mo_store_get_stats(fixture.store, &stats);
  }
  CHECK(!stats.no_space && !stats.fatal);
  CHECK_INT(mo_store_submit(fixture.store, &submission, &id, &replayed), MO_OK);
  CHECK_INT(fixture_reopen(&fixture), MO_OK);
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

static void dies_of_a_failing_disk(void)
{
  /* Once: a second fsync after a failed one may succeed although what the first should have kept is
   * gone. */
  static const struct {
    int write, sync;
    bool once;
  } faults[] = {{SQLITE_IOERR_WRITE, 0, false},
                {0, SQLITE_IOERR_FSYNC, false},
                {SQLITE_IOERR_WRITE, 0, true},
                {0, SQLITE_IOERR_FSYNC, true}};
  for (size_t i = 0; i < sizeof(faults) / sizeof(faults[0]); i++) {
    struct fixture fixture;
    struct mo_bits *forms, *genotypes;
    struct mo_submission submission;
    struct mo_store_stats stats;
    struct mo_job job;
    int64_t first = 0, id = 0;
    bool replayed;
    char log_path[512];
    REQUIRE(start_failing(&fixture) == MO_OK);
    REQUIRE(fixture_bodies(1, 3, &forms, &genotypes) == MO_OK);
    submission = fixture_submission(forms, genotypes, 3);
    CHECK_INT(mo_store_submit(fixture.store, &submission, &first, &replayed), MO_OK);
    atomic_store(&fault_plan.writes_left, 0);
    atomic_store(&fault_plan.once, faults[i].once);
    atomic_store(&fault_plan.write_error, faults[i].write);
    atomic_store(&fault_plan.sync_error, faults[i].sync);
    CHECK_INT(mo_store_submit(fixture.store, &submission, &id, &replayed), MO_ERR_IO);
    CHECK_INT(atomic_load(&fatal_calls), 1);
    atomic_store(&fault_plan.write_error, 0);
    atomic_store(&fault_plan.sync_error, 0);
    /* It does not come back to life: the process has to. */
    CHECK_INT(mo_store_submit(fixture.store, &submission, &id, &replayed), MO_ERR_IO);
    CHECK_INT(atomic_load(&fatal_calls), 1);
    mo_store_get_stats(fixture.store, &stats);
    CHECK(stats.fatal);
    fixture_close(&fixture);
    snprintf(log_path, sizeof(log_path), "%s/morphod.db-wal", fixture.path);
    CHECK_INT(access(log_path, F_OK), 0); /* the next opening recovers from it */
    REQUIRE(fixture_reopen(&fixture) == MO_OK);
    CHECK_INT(mo_store_job(fixture.store, first, &job), MO_OK);
    CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
    CHECK_INT(mo_store_submit(fixture.store, &submission, &id, &replayed), MO_OK);
    free(forms);
    free(genotypes);
    fixture_end(&fixture);
  }
}

/* In place of the C library's. */
static atomic_bool folder_sync_fails;

int fsync(int fd)
{
  struct stat status;
  if (atomic_load(&folder_sync_fails) && fstat(fd, &status) == 0 && S_ISDIR(status.st_mode)) {
    errno = EIO;
    return -1;
  }
  return (int)syscall(SYS_fsync, fd);
}

/* The file of weights is in its folder, but perhaps not on the disk: no caller may learn that it
 * is, not even later. */
static void dies_of_a_folder_that_cannot_be_synced(void)
{
  struct fixture fixture;
  struct mo_controller_record record;
  REQUIRE(start_failing(&fixture) == MO_OK);
  atomic_store(&folder_sync_fails, true);
  CHECK_INT(fixture_controller(fixture.store, "other", 2, &record), MO_ERR_IO);
  atomic_store(&folder_sync_fails, false);
  CHECK_INT(atomic_load(&fatal_calls), 1);
  CHECK_INT(fixture_controller(fixture.store, "other", 2, &record), MO_ERR_IO);
  REQUIRE(fixture_reopen(&fixture) == MO_OK);
  CHECK_INT(fixture_controller(fixture.store, "other", 2, &record), MO_OK);
  fixture_end(&fixture);
}

static void refuses_a_file_system_without_shared_memory(void)
{
  struct fixture fixture;
  atomic_store(&fault_plan.no_shared_memory, true);
  CHECK_INT(start_failing(&fixture), MO_ERR_UNSUPPORTED);
  atomic_store(&fault_plan.no_shared_memory, false);
  CHECK(strstr(fixture.message.text, "shared memory") != NULL);
  fixture_end(&fixture);
}

/* ---- group commit ---- */

struct submitter {
  struct mo_store *store;
  const struct mo_submission *submission;
  int64_t ids[64];
  int failures;
};

static void *submit_many(void *context)
{
  struct submitter *submitter = context;
  for (int i = 0; i < 64; i++) {
    bool replayed;
    if (mo_store_submit(submitter->store, submitter->submission, &submitter->ids[i], &replayed) !=
        MO_OK)
      submitter->failures++;
  }
  return NULL;
}

static void *submit_nonsense(void *context)
{
  struct submitter *submitter = context;
  struct mo_submission bad = *submitter->submission;
  bad.controller = "nobody";
  for (int i = 0; i < 64; i++) {
    bool replayed;
    if (mo_store_submit(submitter->store, &bad, &submitter->ids[i], &replayed) != MO_ERR_NOT_FOUND)
      submitter->failures++;
  }
  return NULL;
}

static void *read_many(void *context)
{
  struct submitter *submitter = context;
  struct mo_job *jobs = calloc(100, sizeof(*jobs));
  for (int i = 0; i < 200; i++) {
    struct mo_job_query query = {.state = -1, .kind = -1};
    int64_t n = mo_store_jobs(submitter->store, &query, jobs, 100);
    for (int64_t k = 1; k < n; k++)
      submitter->failures += jobs[k].id >= jobs[k - 1].id;
    submitter->failures += n < 0;
  }
  free(jobs);
  return NULL;
}

struct listened {
  int64_t last;
  int64_t n;
  int failures;
};

static void listen_in_order(void *context, const struct mo_event *events, size_t n)
{
  struct listened *listened = context;
  for (size_t i = 0; i < n; i++) {
    listened->failures += events[i].sequence <= listened->last;
    listened->last = events[i].sequence;
    listened->n++;
  }
}

static void shares_commits(void)
{
  struct fixture fixture;
  struct mo_bits *forms, *genotypes;
  struct mo_submission submission;
  struct mo_store_stats before, after;
  struct submitter submitters[10];
  struct listened listened = {0};
  pthread_t threads[10];
  uint64_t counts[MO_JOB_STATES];
  bool *seen = calloc(8 * 64 + 1, sizeof(*seen));
  int handle;
  REQUIRE(fixture_start(&fixture) == 0);
  REQUIRE(fixture_bodies(2, 2, &forms, &genotypes) == MO_OK);
  submission = fixture_submission(forms, genotypes, 2);
  REQUIRE(mo_store_subscribe(fixture.store, listen_in_order, &listened, &handle) == MO_OK);
  mo_store_get_stats(fixture.store, &before);
  for (int i = 0; i < 10; i++) {
    submitters[i] = (struct submitter){.store = fixture.store, .submission = &submission};
    REQUIRE(pthread_create(&threads[i], NULL,
                           i < 8    ? submit_many
                           : i == 8 ? submit_nonsense
                                    : read_many,
                           &submitters[i]) == 0);
  }
  for (int i = 0; i < 10; i++) {
    pthread_join(threads[i], NULL);
    CHECK_INT(submitters[i].failures, 0);
  }
  mo_store_get_stats(fixture.store, &after);
  CHECK_INT(after.operations - before.operations, 9 * 64);
  CHECK_INT(after.operations_failed - before.operations_failed, 64);
  CHECK(after.commits - before.commits < 9 * 64);
  printf("# %llu operations in %llu commits\n",
         (unsigned long long)(after.operations - before.operations),
         (unsigned long long)(after.commits - before.commits));
  for (int i = 0; i < 8; i++)
    for (int k = 0; k < 64; k++) {
      int64_t id = submitters[i].ids[k];
      REQUIRE(id >= 1 && id <= 8 * 64);
      CHECK(!seen[id]);
      seen[id] = true;
    }
  mo_store_unsubscribe(fixture.store, handle);
  CHECK_INT(listened.n, 8 * 64);
  CHECK_INT(listened.failures, 0);
  CHECK_INT(mo_store_job_counts(fixture.store, counts), MO_OK);
  CHECK_INT(counts[MO_JOB_QUEUED], 8 * 64);
  free(seen);
  free(forms);
  free(genotypes);
  fixture_end(&fixture);
}

/* ---- readers that overlap ---- */

struct overlapping {
  const char *path;
  atomic_bool reading, stop;
};

/* Two readers in turn: one begins before the other ends, so that at every moment one is inside a
 * transaction, and none for long. */
static void *overlap(void *context)
{
  struct overlapping *overlapping = context;
  char path[512];
  sqlite3 *readers[2] = {NULL, NULL};
  int error = SQLITE_OK, turn = 0;
  snprintf(path, sizeof(path), "%s/morphod.db", overlapping->path);
  for (int i = 0; i < 2 && error == SQLITE_OK; i++)
    error = sqlite3_open_v2(path, &readers[i], SQLITE_OPEN_READONLY, NULL);
  if (error == SQLITE_OK)
    error = sqlite3_exec(readers[1], "BEGIN; SELECT count(*) FROM meta", NULL, NULL, NULL);
  while (error == SQLITE_OK) {
    error = sqlite3_exec(readers[turn], "BEGIN; SELECT count(*) FROM meta", NULL, NULL, NULL);
    if (error == SQLITE_OK)
      error = sqlite3_exec(readers[1 - turn], "COMMIT", NULL, NULL, NULL);
    turn = 1 - turn;
    atomic_store(&overlapping->reading, true);
    if (atomic_load(&overlapping->stop))
      break;
    usleep(20000);
  }
  CHECK_INT(error, SQLITE_OK);
  for (int i = 0; i < 2; i++)
    sqlite3_close(readers[i]);
  return NULL;
}

static void keeps_its_log_short(void)
{
  enum { PUTS = 60, PUTS_MAX = 600, NOTE = 1 << 20 };
  const int64_t short_bytes = (int64_t)45 << 20;
  struct fixture fixture;
  struct overlapping overlapping;
  char key[] = "note";
  struct mo_metadata_entry entry = {.key = key};
  struct mo_controller controller = {
      .workspace = MO_DEFAULT_WORKSPACE, .metadata = &entry, .n_metadata = 1};
  struct mo_controller_record record;
  struct mo_store_stats stats;
  pthread_t thread;
  char *note = malloc(NOTE + 1);
  bool created;
  int puts = 0;
  REQUIRE(note != NULL);
  REQUIRE(fixture_start(&fixture) == MO_OK);
  overlapping = (struct overlapping){.path = fixture.path};
  REQUIRE(pthread_create(&thread, NULL, overlap, &overlapping) == 0);
  while (!atomic_load(&overlapping.reading))
    usleep(1000);
  memset(note, 'x', NOTE);
  note[NOTE] = '\0';
  entry.value = note;
  /* Rows of 1 MiB each; the store leaves the bytes to its caller. One wait for the readers may be
   * too short on a machine that has much else to do: then the next must do, a few seconds later.
   * Passive checkpoints never come to it, however long they go on. */
  do {
    CHECK_INT(mo_store_controller_put(fixture.store, "much", (const uint8_t *)&puts, sizeof(puts),
                                      &controller, &record, &created),
              MO_OK);
    mo_store_get_stats(fixture.store, &stats);
    if (++puts > PUTS)
      usleep(100000);
  } while (puts < PUTS || (stats.wal_bytes >= short_bytes && puts < PUTS_MAX));
  printf("# a log of %.1f MiB after %d MiB\n", (double)stats.wal_bytes / (1 << 20), puts);
  CHECK(stats.wal_bytes < short_bytes);
  atomic_store(&overlapping.stop, true);
  pthread_join(thread, NULL);
  free(note);
  fixture_end(&fixture);
}

/* ---- real disks ---- */

static void refuses_an_unwritable_folder(void)
{
  struct fixture fixture;
  struct mo_store_config config;
  pid_t child;
  int status = -1;
  REQUIRE(fixture_folder(&fixture) == 0);
  chmod(fixture.path, 0500);
  CHECK(getuid() != 0 || chown(fixture.path, 65534, 65534) == 0);
  child = fork();
  if (child == 0) {
    struct mo_store *store = NULL;
    struct mo_message message;
    int error;
    if (getuid() == 0 && setuid(65534) != 0)
      _exit(2);
    config = (struct mo_store_config){.path = fixture.path};
    error = mo_store_open(&config, &store, &message);
    _exit(error == MO_ERR_IO && strstr(message.text, "cannot write") != NULL ? 0 : 1);
  }
  REQUIRE(waitpid(child, &status, 0) == child);
  chmod(fixture.path, 0700);
  /* As another user the folder of the test is perhaps not even found: then there is nothing to see.
   */
  CHECK(WIFEXITED(status) && WEXITSTATUS(status) == 0);
  fixture_end(&fixture);
}

static const struct check_case cases[] = {
    {"notices that there is room again", notices_that_there_is_room_again},
    {"dies of a disk that fails, and recovers", dies_of_a_failing_disk},
    {"dies of a folder that cannot be synced", dies_of_a_folder_that_cannot_be_synced},
    {"refuses a file system without shared memory", refuses_a_file_system_without_shared_memory},
    {"keeps its log short under readers that overlap", keeps_its_log_short},
    {"shares commits among writers", shares_commits},
    {"refuses an unwritable folder", refuses_an_unwritable_folder},
};
CHECK_MAIN(cases)
