/* reserve.c: on a file system that is full, what people need to get out of that goes on working,
 * whatever else wants its room. */
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdatomic.h>
#include <sys/mount.h>
#include <sys/stat.h>

#include "../check.h"
#include "by_hand.h"
#include "store/internal.h"
#include "training_fixture.h"

#define JOBS        60
#define FRAME_BYTES (4096 + 24) /* of the log */

/* ---- a file system of its own ---- */

struct small {
  struct fixture fixture;
  struct mo_bits *forms, *genotypes;
  struct mo_submission submission;
  char filler[512], reserve[512];
};

static bool mount_small(const char *path, const char *size)
{
  char options[64];
  snprintf(options, sizeof(options), "size=%s,mode=0700", size);
  return mount("none", path, "tmpfs", 0, options) == 0;
}

static bool begin(struct small *small, const char *size)
{
  struct mo_controller_record record;
  memset(small, 0, sizeof(*small));
  const bool mounted =
      fixture_folder(&small->fixture) == 0 && mount_small(small->fixture.path, size);
  CHECK(mounted);
  if (!mounted) {
    fixture_end(&small->fixture);
    return false;
  }
  CHECK_INT(fixture_reopen(&small->fixture), MO_OK);
  CHECK_INT(fixture_controller(small->fixture.store, "default", 1, &record), MO_OK);
  CHECK_INT(fixture_bodies(3, 100, &small->forms, &small->genotypes), MO_OK);
  small->submission = fixture_submission(small->forms, small->genotypes, 100);
  snprintf(small->filler, sizeof(small->filler), "%s/filler", small->fixture.path);
  snprintf(small->reserve, sizeof(small->reserve), "%s/reserve", small->fixture.path);
  return true;
}

static void end(struct small *small)
{
  fixture_close(&small->fixture);
  umount(small->fixture.path);
  free(small->forms);
  free(small->genotypes);
  fixture_end(&small->fixture);
}

/* Appends to a file until nothing fits any more. */
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

/* Fills it, the last pages of the log included; returns the newest job. */
static int64_t fill_all(struct small *small)
{
  int64_t id = 0, last = 0;
  bool replayed;
  int error = MO_OK;
  fill_up(small->filler);
  for (int i = 0; i < 2000 && error == MO_OK; i++) {
    error = mo_store_submit(small->fixture.store, &small->submission, &id, &replayed);
    if (error == MO_OK)
      last = id;
  }
  CHECK_INT(error, MO_ERR_NO_SPACE);
  fill_up(small->filler);
  return last;
}

/* Until there is room, which is noticed within a tenth of a second when somebody writes. */
static int submit_soon(struct small *small, int64_t *id)
{
  bool replayed;
  int error = MO_ERR_NO_SPACE;
  for (int i = 0; i < 100 && error == MO_ERR_NO_SPACE; i++) {
    if (i > 0)
      usleep(20000);
    error = mo_store_submit(small->fixture.store, &small->submission, id, &replayed);
  }
  return error;
}

/* ---- cases ---- */

static void survives_a_small_file_system(void)
{
  struct small small;
  struct mo_controller_record record;
  struct mo_job job;
  int64_t id = 0, last = 0, whole;
  bool replayed;
  if (!begin(&small, "12m"))
    return;
  CHECK_INT(mo_store_submit(small.fixture.store, &small.submission, &last, &replayed), MO_OK);
  whole = size_of(small.reserve);
  CHECK(whole > 0);
  if ((id = fill_all(&small)) > last)
    last = id;
  /* Full to the last byte: what is running can be cancelled all the same. */
  CHECK_INT(mo_store_change_job(small.fixture.store, last, MO_CHANGE_CANCEL, NULL), MO_OK);
  CHECK(size_of(small.reserve) < whole);
  fill_up(small.filler);
  CHECK_INT(fixture_controller(small.fixture.store, "big", 2, &record), MO_ERR_NO_SPACE);
  CHECK_INT(mo_store_job(small.fixture.store, last + 1, &job), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_check(small.fixture.store, &small.fixture.message), MO_OK);
  unlink(small.filler);
  CHECK_INT(submit_soon(&small, &id), MO_OK);
  CHECK(id > last);
  CHECK_INT(size_of(small.reserve), whole); /* it comes first */
  CHECK_INT(fixture_reopen(&small.fixture), MO_OK);
  CHECK_INT(mo_store_job(small.fixture.store, id, &job), MO_OK);
  CHECK_INT(mo_store_check(small.fixture.store, &small.fixture.message), MO_OK);
  end(&small);
}

/* A copy of a state folder may have holes where the room was. */
static void fills_the_holes_of_a_copy(void)
{
  struct small small;
  struct stat status = {.st_blocks = 0};
  if (!begin(&small, "24m"))
    return;
  const int64_t whole = size_of(small.reserve);
  fixture_close(&small.fixture);
  CHECK_INT(truncate(small.reserve, 0), 0);
  CHECK_INT(truncate(small.reserve, whole), 0);
  CHECK_INT(fixture_reopen(&small.fixture), MO_OK);
  CHECK_INT(stat(small.reserve, &status), 0);
  CHECK_INT(status.st_size, whole);
  CHECK(status.st_blocks * 512 >= whole);
  end(&small);
}

struct retries {
  struct small *small;
  atomic_bool stop;
  atomic_int writes, unexpected;
};

static void note(struct retries *retries, int error)
{
  atomic_fetch_add(&retries->writes, 1);
  if (error != MO_ERR_NO_SPACE)
    atomic_fetch_add(&retries->unexpected, 1);
}

/* Jobs that wait for room write again and again: rows of many sizes, ... */
static void *write_rows(void *context)
{
  struct retries *retries = context;
  struct mo_submission submission = retries->small->submission;
  int64_t id;
  bool replayed;
  for (uint32_t n = 0; !atomic_load(&retries->stop); n++) {
    submission.n_designs = 1 + n % 100;
    note(retries, mo_store_submit(retries->small->fixture.store, &submission, &id, &replayed));
  }
  return NULL;
}

/* ... and files. */
static void *write_files(void *context)
{
  struct retries *retries = context;
  struct mo_controller_record record;
  for (uint64_t n = 2; !atomic_load(&retries->stop); n++)
    note(retries, fixture_controller(retries->small->fixture.store, "other", n, &record));
  return NULL;
}

/* Every job is paused, resumed in vain and cancelled while others try their writes all the time. */
static void keeps_it_for_people(void)
{
  struct small small;
  struct retries retries = {.small = &small};
  struct mo_controller_record record;
  struct mo_submission one;
  struct mo_job job;
  pthread_t threads[2];
  struct mo_training_submission training = submission_of(100);
  struct mo_checkpoints_removed removed = {.n = 0};
  struct mo_saved_trajectory saved = {.frames = 4000, .n_masses = 100};
  struct mo_save save = {.trajectories = &saved, .n_trajectories = 1};
  uint64_t bytes = 0;
  int64_t ids[JOBS], id = 0, whole, trained;
  enum mo_job_state before = MO_JOB_QUEUED;
  bool replayed;
  if (!begin(&small, "24m"))
    return;
  CHECK_INT(fixture_controller(small.fixture.store, "spare", 1, &record), MO_OK);
  one = small.submission;
  one.n_designs = 1;
  for (int i = 0; i < JOBS; i++)
    CHECK_INT(mo_store_submit(small.fixture.store, &one, &ids[i], &replayed), MO_OK);
  trained = submit(&small.fixture, &training);
  CHECK_INT(mo_store_run_start(small.fixture.store, trained), MO_OK);
  for (uint32_t step = 1; step <= 2; step++)
    CHECK_INT(mo_store_training_checkpoint(small.fixture.store, trained, step,
                                           (const uint8_t *)"state", 5, 2),
              MO_OK);
  saved.job = ids[0];
  CHECK_INT(
      mo_recording_create(&saved.recording, MO_RECORD_MASSES, 1, saved.frames, saved.n_masses, 0),
      MO_OK);
  CHECK_INT(save_and_wait(small.fixture.store, &save), MO_OK);
  mo_recording_free(&saved.recording);
  whole = size_of(small.reserve);
  fill_all(&small);
  CHECK_INT(mo_store_change_job(small.fixture.store, ids[0], MO_CHANGE_PAUSE, NULL), MO_OK);
  CHECK_INT(pthread_create(&threads[0], NULL, write_rows, &retries), 0);
  CHECK_INT(pthread_create(&threads[1], NULL, write_files, &retries), 0);
  for (int i = 0; i < JOBS; i++) {
    CHECK_INT(mo_store_change_job(small.fixture.store, ids[i], MO_CHANGE_RESUME, &before),
              i == 0 ? MO_ERR_NO_SPACE : MO_OK); /* the others are not paused: nothing to do */
    CHECK_INT(mo_store_change_job(small.fixture.store, ids[i], MO_CHANGE_PAUSE, NULL), MO_OK);
    CHECK_INT(mo_store_change_job(small.fixture.store, ids[i], MO_CHANGE_RESUME, NULL),
              MO_ERR_NO_SPACE);
    CHECK_INT(mo_store_set_weight(small.fixture.store, ids[i], 2), MO_ERR_NO_SPACE);
    usleep(10000);
    CHECK_INT(mo_store_change_job(small.fixture.store, ids[i], MO_CHANGE_CANCEL, NULL), MO_OK);
  }
  CHECK_INT(mo_store_controller_remove(small.fixture.store, "spare"), MO_OK);
  CHECK_INT(mo_store_checkpoints_remove(small.fixture.store, trained, MO_JOB_TRAINING, 1, &removed),
            MO_OK);
  CHECK_INT(removed.n, 1);
  CHECK_INT(mo_store_trajectories_remove(small.fixture.store, ids[0], &bytes), MO_OK);
  CHECK_INT(bytes, 4800000); /* more than the reserve */
  printf("# %d writes in vain\n", atomic_load(&retries.writes));
  atomic_store(&retries.stop, true);
  for (int i = 0; i < 2; i++)
    pthread_join(threads[i], NULL);
  CHECK(atomic_load(&retries.writes) > 100);
  CHECK_INT(atomic_load(&retries.unexpected), 0);
  for (int i = 0; i < JOBS; i++) {
    CHECK_INT(mo_store_job(small.fixture.store, ids[i], &job), MO_OK);
    CHECK_INT(job.state, MO_JOB_CANCELLED);
  }
  unlink(small.filler);
  for (int i = 0; i < 100 && size_of(small.reserve) < whole; i++) /* nobody writes */
    usleep(20000);
  CHECK_INT(size_of(small.reserve), whole);
  CHECK_INT(mo_store_check(small.fixture.store, &small.fixture.message), MO_OK);
  CHECK_INT(submit_soon(&small, &id), MO_OK);
  end(&small);
}

/* The log's index, a file too, grows by 32 KiB where the log passes its 4062nd frame: no room for
 * that is no room, and nothing worse. */
static void grows_the_index_of_the_log(void)
{
  struct small small;
  struct mo_store_stats stats = {.wal_bytes = 0};
  struct mo_submission one;
  int64_t ids[JOBS], id = 0;
  bool replayed;
  if (!begin(&small, "40m"))
    return;
  const struct mo_store_config config = {.path = small.fixture.path, .checkpoint_frames = 1000000};
  fixture_close(&small.fixture);
  REQUIRE(mo_store_open(&config, &small.fixture.store, &small.fixture.message) == MO_OK);
  one = small.submission;
  one.n_designs = 1;
  for (int i = 0; i < JOBS; i++)
    CHECK_INT(mo_store_submit(small.fixture.store, &one, &ids[i], &replayed), MO_OK);
  while (stats.wal_bytes < (int64_t)3950 * FRAME_BYTES) {
    REQUIRE(mo_store_submit(small.fixture.store, &small.submission, &id, &replayed) == MO_OK);
    mo_store_get_stats(small.fixture.store, &stats);
  }
  CHECK(stats.wal_bytes < (int64_t)4000 * FRAME_BYTES);
  fill_all(&small);
  unlink(small.reserve);
  for (int i = 0; i < JOBS; i++) {
    int error = MO_ERR_NO_SPACE;
    fill_up(small.filler);
    for (int pages = 0; pages < 40 && error == MO_ERR_NO_SPACE;
         pages++) { /* at some time there is room for the log, but not for its index */
      error = mo_store_change_job(small.fixture.store, ids[i], MO_CHANGE_CANCEL, NULL);
      if (error == MO_ERR_NO_SPACE)
        CHECK_INT(truncate(small.filler, size_of(small.filler) - 4096), 0);
    }
    CHECK_INT(error, MO_OK);
  }
  mo_store_get_stats(small.fixture.store, &stats);
  CHECK(stats.wal_bytes > (int64_t)4100 * FRAME_BYTES);
  CHECK(!stats.fatal);
  unlink(small.filler);
  CHECK_INT(submit_soon(&small, &id), MO_OK);
  CHECK_INT(fixture_reopen(&small.fixture), MO_OK);
  CHECK_INT(mo_store_check(small.fixture.store, &small.fixture.message), MO_OK);
  end(&small);
}

/* As a kill leaves it: the log stays as it is. */
static void kill_store(struct small *small)
{
  mo_store_declare_fatal(small->fixture.store, "the end of a test");
  fixture_close(&small->fixture);
}

/* Fills the file system until an urgent operation needs the reserve. */
static void use_reserve(struct small *small, int64_t cancelled)
{
  fill_all(small);
  CHECK_INT(mo_store_change_job(small->fixture.store, cancelled, MO_CHANGE_CANCEL, NULL), MO_OK);
}

static bool is_full(struct small *small)
{
  struct mo_store_stats stats;
  mo_store_get_stats(small->fixture.store, &stats);
  return stats.no_space;
}

/* Killed on a full disk it starts again, as often as it may be, and the way out is open. */
static void starts_when_it_is_full(void)
{
  enum { STARTS = 40 };
  struct small small;
  struct mo_submission one;
  struct mo_training_submission training = submission_of(100);
  struct mo_job job;
  int64_t ids[3], id = 0, whole, epoch, trained, fingerprint = 0;
  bool replayed;
  char index[512];
  if (!begin(&small, "24m"))
    return;
  one = small.submission;
  one.n_designs = 1;
  for (int i = 0; i < 3; i++)
    CHECK_INT(mo_store_submit(small.fixture.store, &one, &ids[i], &replayed), MO_OK);
  trained = submit(&small.fixture, &training);
  CHECK_INT(mo_store_run_start(small.fixture.store, trained), MO_OK);
  snprintf(index, sizeof(index), "%s/morphod.db-shm", small.fixture.path);
  whole = size_of(small.reserve);
  fill_all(&small);
  epoch = small.fixture.store->epoch;
  for (int n = 1; n <= STARTS; n++) {
    kill_store(&small);
    if (n == STARTS) /* 32 KiB, made again */
      CHECK_INT(unlink(index), 0);
    if (n == 1)
      fill_up(small.filler);
    REQUIRE(fixture_reopen(&small.fixture) == MO_OK);
    CHECK_INT(small.fixture.store->epoch, epoch + n);
    CHECK(is_full(&small));
    CHECK_INT(mo_store_requeue(small.fixture.store, n == 1 ? ids[1] : 0, 3, "signal 11"), MO_OK);
    CHECK_INT(mo_store_fingerprint(small.fixture.store, "of another program", &fingerprint), MO_OK);
    CHECK_INT(mo_store_submit(small.fixture.store, &one, &id, &replayed), MO_ERR_NO_SPACE);
  }
  CHECK_INT(size_of(small.reserve), 0);
  CHECK_INT(mo_store_job(small.fixture.store, trained, &job), MO_OK);
  CHECK_INT(job.state, MO_JOB_QUEUED);
  CHECK_INT(mo_store_job(small.fixture.store, ids[1], &job), MO_OK);
  CHECK_INT(job.attempts, 1);
  CHECK_INT(mo_store_change_job(small.fixture.store, ids[1], MO_CHANGE_CANCEL, NULL), MO_OK);
  CHECK_INT(mo_store_change_job(small.fixture.store, ids[2], MO_CHANGE_PAUSE, NULL), MO_OK);
  unlink(small.filler);
  CHECK_INT(submit_soon(&small, &id), MO_OK);
  CHECK_INT(size_of(small.reserve), whole);
  CHECK(!is_full(&small));
  CHECK_INT(mo_store_check(small.fixture.store, &small.fixture.message), MO_OK);
  end(&small);
}

/* What there is of room after a restart is for people and for the reserve, until that is whole. */
static void stays_short_over_a_restart(void)
{
  struct small small;
  int64_t id = 0, last, whole;
  bool replayed;
  if (!begin(&small, "24m"))
    return;
  CHECK_INT(mo_store_submit(small.fixture.store, &small.submission, &id, &replayed), MO_OK);
  CHECK_INT(mo_store_submit(small.fixture.store, &small.submission, &last, &replayed), MO_OK);
  whole = size_of(small.reserve);
  use_reserve(&small, id);
  kill_store(&small);
  REQUIRE(fixture_reopen(&small.fixture) == MO_OK);
  CHECK(is_full(&small));
  small.submission.n_designs = 1;
  CHECK_INT(mo_store_submit(small.fixture.store, &small.submission, &id, &replayed),
            MO_ERR_NO_SPACE);
  CHECK_INT(mo_store_change_job(small.fixture.store, last, MO_CHANGE_PAUSE, NULL), MO_OK);
  unlink(small.filler);
  CHECK_INT(fixture_reopen(&small.fixture), MO_OK); /* with room: nothing of that is left */
  CHECK_INT(size_of(small.reserve), whole);
  CHECK(!is_full(&small));
  CHECK_INT(mo_store_submit(small.fixture.store, &small.submission, &id, &replayed), MO_OK);
  end(&small);
}

static const struct check_case cases[] = {
    {"survives a small file system", survives_a_small_file_system},
    {"fills the holes of a copy", fills_the_holes_of_a_copy},
    {"keeps the room for people", keeps_it_for_people},
    {"grows the index of the log", grows_the_index_of_the_log},
    {"starts when it is full", starts_when_it_is_full},
    {"stays short over a restart", stays_short_over_a_restart},
};

/* Where nothing can be mounted, the whole program is skipped. */
int main(int argc, char **argv)
{
  struct fixture fixture;
  if (fixture_folder(&fixture) == 0) {
    const bool mounted = mount_small(fixture.path, "64k");
    const int error = errno;
    if (mounted)
      umount(fixture.path);
    fixture_end(&fixture);
    if (!mounted) {
      printf("1..0 # SKIP a small file system cannot be mounted: %s\n", strerrordesc_np(error));
      return 0;
    }
  }
  return check_run(cases, sizeof(cases) / sizeof(cases[0]), argc, argv);
}
