/* reserve.c: on a full file system, everything that people need to free space keeps working, no
 * matter what else competes for the space. */
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdatomic.h>
#include <sys/mount.h>
#include <sys/stat.h>

#include "by_hand.h"
#include "one_store.h"
#include "store/deletion.h"
#include "store/internal.h"
#include "training_fixture.h"

#define JOBS        60
#define FRAME_BYTES (4096 + 24) /* of the log */

/* ---- a small file system ---- */

static struct mo_evaluation_request submission, one; /* payload of 100 designs; of one */
static char filler[512], reserve[512];

static bool mount_small(const char *path, const char *size)
{
  char options[64];
  snprintf(options, sizeof(options), "size=%s,mode=0700", size);
  return mount("none", path, "tmpfs", 0, options) == 0;
}

static void in_a_small_one(void (*run)(void))
{
  const bool mounted = fixture_folder() == 0 && mount_small(fixture.path, "40m");
  CHECK(mounted);
  if (mounted) {
    CHECK_OK(reopen());
    CHECK_OK(put_weights("default", 1, NULL));
    submission = one = draw_evaluation(3, 100);
    one.n_designs = 1;
    snprintf(filler, sizeof(filler), "%s/filler", fixture.path);
    snprintf(reserve, sizeof(reserve), "%s/reserve", fixture.path);
    run();
  }
  close_store();
  umount(fixture.path);
  fixture_end();
}

/* Appends to a file until the file system is full. */
static void fill_up(const char *path)
{
  static const char zeros[4096];
  int fd = open(path, O_WRONLY | O_CREAT | O_APPEND, 0600);
  for (size_t n = sizeof(zeros); fd >= 0 && n > 0; n /= 2)
    while (write(fd, zeros, n) == (ssize_t)n)
      ;
  if (fd >= 0)
    close(fd);
}

static int64_t size_of(const char *path)
{
  struct stat status;
  return stat(path, &status) == 0 ? status.st_size : -1;
}

/* Fills the file system, including the last pages of the log; returns the newest job. */
static int64_t fill_all(void)
{
  int64_t id = 0, last = 0;
  fill_up(filler);
  for (int i = 0; i < 2000 && id >= 0; i++) {
    id = submit_evaluation(&submission);
    last = id > 0 ? id : last;
  }
  CHECK_INT(id, MO_ERR_NO_SPACE);
  fill_up(filler);
  return last;
}

/* Waits until there is room. A write notices it within a tenth of a second. */
static int64_t submit_soon(void)
{
  int64_t id = submit_evaluation(&submission);
  for (int i = 0; i < 100 && id == MO_ERR_NO_SPACE; i++) {
    usleep(20000);
    id = submit_evaluation(&submission);
  }
  return id;
}

/* Stops like a kill: the log stays as it is. */
static void kill_store(void)
{
  mo_store_declare_fatal(store, "the end of a test");
  close_store();
}

static struct mo_store_stats stats_of_store(void)
{
  struct mo_store_stats stats;
  mo_store_get_stats(store, &stats);
  return stats;
}

/* Submits n jobs of one design each, and a training run that runs. */
static int64_t submit_jobs(int n, int64_t *ids)
{
  const struct mo_training_request training = submission_of(100);
  const int64_t trained = submit_training(&training);
  CHECK_OK(mo_store_run_start(store, trained));
  for (int i = 0; i < n; i++) {
    ids[i] = submit_evaluation(&one);
    CHECK(ids[i] > 0);
  }
  return trained;
}

/* ---- cases ---- */

static void survives_a_small_file_system(void)
{
  struct mo_job job;
  int64_t id, last = submit_evaluation(&submission);
  const int64_t whole = size_of(reserve);
  CHECK(last > 0 && whole > 0);
  if ((id = fill_all()) > last)
    last = id;
  /* Full to the last byte: a running job can still be cancelled. */
  CHECK_OK(change(last, MO_CHANGE_CANCEL));
  CHECK(size_of(reserve) < whole);
  fill_up(filler);
  CHECK_INT(put_weights("big", 2, NULL), MO_ERR_NO_SPACE);
  CHECK_INT(mo_store_job(store, last + 1, &job), MO_ERR_NOT_FOUND);
  CHECK_OK(check_whole());
  unlink(filler);
  id = submit_soon();
  CHECK(id > last);
  CHECK_INT(size_of(reserve), whole); /* it comes first */
  CHECK_OK(reopen());
  job = job_of(id);
  CHECK_OK(check_whole());
}

/* A copy of a state folder may have holes instead of the reserve. */
static void fills_the_holes_of_a_copy(void)
{
  struct stat status = {.st_blocks = 0};
  const int64_t whole = size_of(reserve);
  close_store();
  CHECK_INT(truncate(reserve, 0), 0);
  CHECK_INT(truncate(reserve, whole), 0);
  CHECK_OK(reopen());
  CHECK_INT(stat(reserve, &status), 0);
  CHECK_INT(status.st_size, whole);
  CHECK(status.st_blocks * 512 >= whole);
}

static struct {
  atomic_bool stop;
  atomic_int writes, unexpected;
} retries;

static void note(int64_t error)
{
  atomic_fetch_add(&retries.writes, 1);
  atomic_fetch_add(&retries.unexpected, error != MO_ERR_NO_SPACE);
}

/* Jobs that wait for room keep writing rows of many sizes ... */
static void *write_rows(void *context)
{
  struct mo_evaluation_request many = submission;
  for (uint32_t n = 0; !atomic_load(&retries.stop); n++) {
    many.n_designs = 1 + n % 100;
    note(submit_evaluation(&many));
  }
  return context;
}

/* ... and files. */
static void *write_files(void *context)
{
  for (uint64_t n = 2; !atomic_load(&retries.stop); n++)
    note(put_weights("other", n, NULL));
  return context;
}

/* Every job is paused, resumed in vain and cancelled while other threads keep trying to write. */
static void keeps_it_for_people(void)
{
  pthread_t threads[2];
  struct mo_checkpoints_removed removed = {.n = 0};
  struct mo_saved_trajectory saved = {.frames = 4000, .n_masses = 100};
  struct mo_save save = {.trajectories = &saved, .n_trajectories = 1};
  struct mo_deleted deleted;
  struct mo_message message;
  uint64_t bytes = 0;
  int64_t ids[JOBS];
  int n_paused = 0;
  enum mo_job_state before = MO_JOB_QUEUED;
  CHECK_OK(put_weights("spare", 1, NULL));
  const int64_t trained = submit_jobs(JOBS, ids), whole = size_of(reserve);
  for (uint32_t step = 1; step <= 2; step++)
    CHECK_OK(mo_store_training_checkpoint(store, trained, step, (const uint8_t *)"state", 5, 2));
  saved.job = ids[0];
  CHECK_OK(
      mo_recording_create(&saved.recording, MO_RECORD_MASSES, 1, saved.frames, saved.n_masses, 0));
  CHECK_OK(save_and_wait(&save));
  mo_recording_free(&saved.recording);
  fill_all();
  while (n_paused < JOBS && size_of(reserve) == whole) /* the log may have a few free pages */
    CHECK_OK(change(ids[n_paused++], MO_CHANGE_PAUSE));
  CHECK_INT(pthread_create(&threads[0], NULL, write_rows, NULL), 0);
  CHECK_INT(pthread_create(&threads[1], NULL, write_files, NULL), 0);
  for (int i = 0; i < JOBS; i++) {
    CHECK_INT(mo_store_change_job(store, ids[i], MO_CHANGE_RESUME, &before),
              i < n_paused ? MO_ERR_NO_SPACE
                           : MO_OK); /* the others are not paused: nothing to do */
    CHECK_OK(change(ids[i], MO_CHANGE_PAUSE));
    CHECK_INT(change(ids[i], MO_CHANGE_RESUME), MO_ERR_NO_SPACE);
    CHECK_INT(mo_store_set_weight(store, ids[i], 2), MO_ERR_NO_SPACE);
    usleep(10000);
    CHECK_OK(change(ids[i], MO_CHANGE_CANCEL));
  }
  CHECK_OK(mo_store_controller_remove(store, "spare"));
  CHECK_OK(mo_store_checkpoints_remove(store, trained, MO_JOB_TRAINING, 1, &removed));
  CHECK_INT(removed.n, 1);
  CHECK_OK(change(trained, MO_CHANGE_CANCEL));
  CHECK_OK(mo_store_delete_job(store, trained, &deleted, &message));
  CHECK(deleted.n_checkpoints == 1 && deleted.checkpoint_bytes == 5);
  CHECK_INT(files_of("trainings", trained), -1);
  CHECK_OK(mo_store_trajectories_remove(store, ids[0], &bytes));
  CHECK_INT(bytes, 4800000); /* more than the reserve holds */
  printf("# %d failed writes\n", atomic_load(&retries.writes));
  atomic_store(&retries.stop, true);
  for (int i = 0; i < 2; i++)
    pthread_join(threads[i], NULL);
  CHECK(atomic_load(&retries.writes) > 100);
  CHECK_INT(atomic_load(&retries.unexpected), 0);
  for (int i = 0; i < JOBS; i++)
    CHECK_INT(state_of(ids[i]), MO_JOB_CANCELLED);
  unlink(filler);
  for (int i = 0; i < 100 && size_of(reserve) < whole; i++) /* nothing is written */
    usleep(20000);
  CHECK_INT(size_of(reserve), whole);
  CHECK_OK(check_whole());
  CHECK(submit_soon() > 0);
}

/* The log's index is also a file. It grows by 32 KiB when the log passes its 4062nd frame; if there
 * is no room for that, the error is no-space and nothing worse. */
static void grows_the_index_of_the_log(void)
{
  int64_t ids[JOBS];
  REQUIRE_OK(reopen_with((struct mo_store_config){.checkpoint_frames = 1000000}));
  (void)submit_jobs(JOBS, ids);
  while (stats_of_store().wal_bytes < (int64_t)3950 * FRAME_BYTES)
    REQUIRE(submit_evaluation(&submission) > 0);
  CHECK(stats_of_store().wal_bytes < (int64_t)4000 * FRAME_BYTES);
  fill_all();
  unlink(reserve);
  for (int i = 0; i < JOBS; i++) {
    int error = MO_ERR_NO_SPACE;
    fill_up(filler);
    for (int pages = 0; pages < 40 && error == MO_ERR_NO_SPACE;
         pages++) { /* at some point there is room for the log, but not for its index */
      error = change(ids[i], MO_CHANGE_CANCEL);
      if (error == MO_ERR_NO_SPACE)
        CHECK_INT(truncate(filler, size_of(filler) - 4096), 0);
    }
    CHECK_OK(error);
  }
  CHECK(stats_of_store().wal_bytes > (int64_t)4100 * FRAME_BYTES);
  CHECK(!stats_of_store().fatal);
  unlink(filler);
  CHECK(submit_soon() > 0);
  CHECK_OK(reopen());
  CHECK_OK(check_whole());
}

/* Killed on a full disk, the store restarts any number of times, and space can still be freed. */
static void starts_when_it_is_full(void)
{
  enum { STARTS = 40 };
  struct mo_job job;
  int64_t ids[3], fingerprint = 0;
  const int64_t trained = submit_jobs(3, ids), whole = size_of(reserve), epoch = store->epoch;
  fill_all();
  for (int n = 1; n <= STARTS; n++) {
    kill_store();
    if (n == STARTS) /* 32 KiB, created again */
      CHECK_INT(unlink(path_of("morphod.db-shm")), 0);
    if (n == 1)
      fill_up(filler);
    REQUIRE_OK(reopen());
    CHECK_INT(store->epoch, epoch + n);
    CHECK(stats_of_store().no_space);
    CHECK_OK(mo_store_requeue(store, n == 1 ? ids[1] : 0, 3, "signal 11"));
    CHECK_OK(mo_store_fingerprint(store, "of another program", &fingerprint));
    CHECK_INT(submit_evaluation(&one), MO_ERR_NO_SPACE);
  }
  CHECK_INT(size_of(reserve), 0);
  CHECK_INT(state_of(trained), MO_JOB_QUEUED);
  CHECK_OK(mo_store_job(store, ids[1], &job));
  CHECK_INT(job.attempts, 1);
  CHECK_OK(change(ids[1], MO_CHANGE_CANCEL));
  CHECK_OK(change(ids[2], MO_CHANGE_PAUSE));
  unlink(filler);
  CHECK(submit_soon() > 0);
  CHECK_INT(size_of(reserve), whole);
  CHECK(!stats_of_store().no_space);
  CHECK_OK(check_whole());
}

/* After a restart, free space is for people and for the reserve until the reserve is complete. */
static void stays_short_over_a_restart(void)
{
  const int64_t whole = size_of(reserve), first = submit_evaluation(&submission),
                last = submit_evaluation(&submission);
  fill_all();
  CHECK_OK(change(first, MO_CHANGE_CANCEL)); /* uses part of the reserve */
  kill_store();
  REQUIRE_OK(reopen());
  CHECK(stats_of_store().no_space);
  CHECK_INT(submit_evaluation(&one), MO_ERR_NO_SPACE);
  CHECK_OK(change(last, MO_CHANGE_PAUSE));
  unlink(filler);
  CHECK_OK(reopen()); /* with enough room, everything works again */
  CHECK_INT(size_of(reserve), whole);
  CHECK(!stats_of_store().no_space);
  CHECK(submit_evaluation(&one) > 0);
}

static const struct check_case cases[] = {
    {"survives a small file system", survives_a_small_file_system},
    {"fills the holes of a copy", fills_the_holes_of_a_copy},
    {"keeps the reserve for people", keeps_it_for_people},
    {"grows the index of the log", grows_the_index_of_the_log},
    {"starts when it is full", starts_when_it_is_full},
    {"stays short of space across a restart", stays_short_over_a_restart},
};

/* If nothing can be mounted, the whole program is skipped. */
int main(int argc, char **argv)
{
  const bool mounted = fixture_folder() == 0 && mount_small(fixture.path, "64k");
  const int error = errno;
  if (mounted)
    umount(fixture.path);
  fixture_end();
  if (!mounted) {
    printf("1..0 # SKIP a small file system cannot be mounted: %s\n", strerrordesc_np(error));
    return 0;
  }
  check_around = in_a_small_one;
  return check_run(cases, COUNT(cases), argc, argv);
}
