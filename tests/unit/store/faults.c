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
#include "one_store.h"

static atomic_int fatal_calls;

static void on_fatal(void *context, const char *what)
{
  (void)context;
  (void)what;
  atomic_fetch_add(&fatal_calls, 1);
}

static void set_errors(int write_error, int sync_error, bool once)
{
  atomic_store(&fault_plan.writes_left, 0);
  atomic_store(&fault_plan.once, once);
  atomic_store(&fault_plan.write_error, write_error);
  atomic_store(&fault_plan.sync_error, sync_error);
}

/* A store on the failing file system. */
static int start_failing(void)
{
  set_errors(0, 0, false);
  atomic_store(&fatal_calls, 0);
  if (fault_vfs_register() != SQLITE_OK || fixture_folder() != 0)
    return -1;
  int error = reopen_with((struct mo_store_config){.vfs = "faults", .fatal = on_fatal});
  return error == MO_OK ? put_weights("default", 1, NULL) : error;
}

static void notices_that_there_is_room_again(void)
{
  const struct mo_evaluation_request submission = draw_evaluation(1, 3);
  struct mo_store_stats stats;
  REQUIRE_OK(start_failing());
  set_errors(SQLITE_FULL, 0, false);
  CHECK_INT(submit_evaluation(&submission), MO_ERR_NO_SPACE);
  usleep(1500000); /* returns no result */
  mo_store_get_stats(store, &stats);
  CHECK(stats.no_space && !stats.fatal);
  set_errors(0, 0, false);
  for (int i = 0; i < 1000 && stats.no_space; i++) { /* nothing is written */
    usleep(10000);
    mo_store_get_stats(store, &stats);
  }
  CHECK(!stats.no_space && !stats.fatal);
  CHECK(submit_evaluation(&submission) > 0);
  CHECK_OK(reopen());
  CHECK_OK(check_whole());
  fixture_end();
}

static void dies_of_a_failing_disk(void)
{
  /* The first write error is final: a second fsync after a failed one may succeed although the data
   * of the first is gone. */
  static const struct {
    int write, sync;
    bool once;
  } faults[] = {{SQLITE_IOERR_WRITE, 0, false},
                {0, SQLITE_IOERR_FSYNC, false},
                {SQLITE_IOERR_WRITE, 0, true},
                {0, SQLITE_IOERR_FSYNC, true}};
  const struct mo_evaluation_request submission = draw_evaluation(1, 3);
  for (size_t i = 0; i < COUNT(faults); i++) {
    struct mo_store_stats stats;
    printf("# fault %zu\n", i);
    REQUIRE_OK(start_failing());
    int64_t first = submit_evaluation(&submission);
    set_errors(faults[i].write, faults[i].sync, faults[i].once);
    CHECK_INT(submit_evaluation(&submission), MO_ERR_IO);
    CHECK_INT(atomic_load(&fatal_calls), 1);
    set_errors(0, 0, false);
    /* The store does not recover; the process must restart. */
    CHECK_INT(submit_evaluation(&submission), MO_ERR_IO);
    CHECK_INT(atomic_load(&fatal_calls), 1);
    mo_store_get_stats(store, &stats);
    CHECK(stats.fatal);
    close_store();
    CHECK_INT(access(path_of("morphod.db-wal"), F_OK), 0); /* the next start recovers from it */
    REQUIRE_OK(reopen());
    (void)job_of(first);
    CHECK_OK(check_whole());
    CHECK(submit_evaluation(&submission) > 0);
    fixture_end();
  }
}

/* Replaces the C library's function. */
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

/* The file of weights is in its folder, but perhaps not on the disk. No call may report it as
 * stored, even later. */
static void dies_of_a_folder_that_cannot_be_synced(void)
{
  REQUIRE_OK(start_failing());
  atomic_store(&folder_sync_fails, true);
  CHECK_INT(put_weights("other", 2, NULL), MO_ERR_IO);
  atomic_store(&folder_sync_fails, false);
  CHECK_INT(atomic_load(&fatal_calls), 1);
  CHECK_INT(put_weights("other", 2, NULL), MO_ERR_IO);
  REQUIRE_OK(reopen());
  CHECK_OK(put_weights("other", 2, NULL));
  fixture_end();
}

static void refuses_a_file_system_without_shared_memory(void)
{
  atomic_store(&fault_plan.no_shared_memory, true);
  CHECK_INT(start_failing(), MO_ERR_UNSUPPORTED);
  atomic_store(&fault_plan.no_shared_memory, false);
  CHECK_SAYS(fixture.message, "shared memory");
  fixture_end();
}

/* ---- group commit ---- */

struct submitter {
  struct mo_evaluation_request submission;
  int64_t ids[64];
  int failures;
};

static void *submit_many(void *context)
{
  struct submitter *submitter = context;
  for (int i = 0; i < 64; i++) {
    submitter->ids[i] = submit_evaluation(&submitter->submission);
    submitter->failures += submitter->ids[i] <= 0;
  }
  return NULL;
}

static void *submit_nonsense(void *context)
{
  struct submitter *submitter = context;
  submitter->submission.controller = "nobody";
  for (int i = 0; i < 64; i++)
    submitter->failures += submit_evaluation(&submitter->submission) != MO_ERR_NOT_FOUND;
  return NULL;
}

static void *read_many(void *context)
{
  struct submitter *submitter = context;
  static struct mo_job jobs[100];
  for (int i = 0; i < 200; i++) {
    const int64_t n = mo_store_jobs(store, &any_job, jobs, 100);
    for (int64_t k = 1; k < n; k++)
      submitter->failures += jobs[k].id >= jobs[k - 1].id;
    submitter->failures += n < 0;
  }
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
  const struct mo_evaluation_request submission = draw_evaluation(2, 2);
  struct mo_store_stats before, after;
  static struct submitter submitters[10];
  struct listened listened = {0};
  pthread_t threads[10];
  uint64_t counts[MO_JOB_STATES];
  bool seen[8 * 64 + 1] = {false};
  int handle;
  REQUIRE_OK(fixture_start());
  REQUIRE_OK(mo_store_subscribe(store, listen_in_order, &listened, &handle));
  mo_store_get_stats(store, &before);
  for (int i = 0; i < 10; i++) {
    submitters[i] = (struct submitter){.submission = submission};
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
  mo_store_get_stats(store, &after);
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
  mo_store_unsubscribe(store, handle);
  CHECK_INT(listened.n, 8 * 64);
  CHECK_INT(listened.failures, 0);
  CHECK_OK(mo_store_job_counts(store, counts));
  CHECK_INT(counts[MO_JOB_QUEUED], 8 * 64);
  fixture_end();
}

/* ---- overlapping readers ---- */

struct overlapping {
  atomic_bool reading, stop;
};

/* Two readers take turns: one begins before the other ends. At every moment one of them is inside a
 * transaction, but neither for long. */
static void *overlap(void *context)
{
  struct overlapping *overlapping = context;
  sqlite3 *readers[2] = {open_outside(), open_outside()};
  int turn = 0;
  int error = sqlite3_exec(readers[1], "BEGIN; SELECT count(*) FROM meta", NULL, NULL, NULL);
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
  struct overlapping overlapping = {.stop = false};
  char key[] = "note";
  struct mo_metadata_entry entry = {.key = key};
  struct mo_controller controller = {
      .workspace = MO_DEFAULT_WORKSPACE, .metadata = &entry, .n_metadata = 1};
  struct mo_controller_record record;
  struct mo_store_stats stats;
  pthread_t thread;
  char *note = make_zeros(NOTE + 1, 1);
  bool created;
  int puts = 0;
  REQUIRE_OK(fixture_start());
  REQUIRE(pthread_create(&thread, NULL, overlap, &overlapping) == 0);
  while (!atomic_load(&overlapping.reading))
    usleep(1000);
  memset(note, 'x', NOTE);
  entry.value = note;
  /* Writes rows of 1 MiB each. On a busy machine, one wait for the readers may be too short; then
   * the next one, a few seconds later, must suffice. Passive checkpoints never reset the log, no
   * matter how many there are. */
  do {
    CHECK_OK(mo_store_controller_put(store, "much", (const uint8_t *)&puts, sizeof(puts),
                                     &controller, &record, &created));
    mo_store_get_stats(store, &stats);
    if (++puts > PUTS)
      usleep(100000);
  } while (puts < PUTS || (stats.wal_bytes >= short_bytes && puts < PUTS_MAX));
  printf("# a log of %.1f MiB after %d MiB\n", (double)stats.wal_bytes / (1 << 20), puts);
  CHECK(stats.wal_bytes < short_bytes);
  atomic_store(&overlapping.stop, true);
  pthread_join(thread, NULL);
  fixture_end();
}

/* ---- real disks ---- */

static void refuses_an_unwritable_folder(void)
{
  int status = -1;
  REQUIRE(fixture_folder() == 0);
  chmod(fixture.path, 0500);
  CHECK(getuid() != 0 || chown(fixture.path, 65534, 65534) == 0);
  pid_t child = fork();
  if (child == 0) {
    if (getuid() == 0 && setuid(65534) != 0)
      _exit(2);
    _exit(reopen() == MO_ERR_IO && strstr(fixture.message.text, "cannot write") != NULL ? 0 : 1);
  }
  REQUIRE(waitpid(child, &status, 0) == child);
  chmod(fixture.path, 0700);
  /* Run as another user, the test may not even find its folder; then there is nothing to check. */
  CHECK(WIFEXITED(status) && WEXITSTATUS(status) == 0);
  fixture_end();
}

static const struct check_case cases[] = {
    {"notices when there is room again", notices_that_there_is_room_again},
    {"stops when the disk fails, and recovers", dies_of_a_failing_disk},
    {"stops when a folder cannot be synced", dies_of_a_folder_that_cannot_be_synced},
    {"refuses a file system without shared memory", refuses_a_file_system_without_shared_memory},
    {"keeps its log short with overlapping readers", keeps_its_log_short},
    {"shares commits among writers", shares_commits},
    {"refuses an unwritable folder", refuses_an_unwritable_folder},
};
CHECK_MAIN(cases)
