/* checkpoints.c: the checkpoints of trainings: rows and files go together, whatever comes between.
 */
#include <dirent.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <stdatomic.h>
#include <sys/resource.h>
#include <sys/stat.h>

#include "../check.h"
#include "one_store.h"
#include "training_fixture.h"

static int files_of(int64_t id)
{
  char path[512];
  struct dirent *entry;
  DIR *folder;
  int n = 0;
  snprintf(path, sizeof(path), "%s/trainings/%lld", fixture.path, (long long)id);
  folder = opendir(path);
  while (folder != NULL && (entry = readdir(folder)) != NULL)
    n += entry->d_name[0] != '.' || strncmp(entry->d_name, ".tmp-", 5) == 0;
  if (folder != NULL)
    closedir(folder);
  return n;
}

/* Submits a training and starts it. */
static int64_t start_training(void)
{
  const struct mo_training_submission submission = submission_of(1000);
  const int64_t id = submit(&fixture, &submission);
  CHECK_INT(mo_store_run_start(fixture.store, id), MO_OK);
  return id;
}

static int put(int64_t id, uint32_t step, const char *state, uint32_t keep)
{
  return mo_store_training_checkpoint(fixture.store, id, step, (const uint8_t *)state,
                                      strlen(state), keep);
}

static int put_file(const char *name, const char *text)
{
  char path[512];
  FILE *file;
  snprintf(path, sizeof(path), "%s/trainings/%s", fixture.path, name);
  file = fopen(path, "w");
  if (file == NULL)
    return -1;
  fputs(text, file);
  return fclose(file);
}

static void keeps_checkpoints(void)
{
  struct mo_checkpoint_row rows[5];
  struct mo_training_status status;
  uint8_t *bytes = NULL;
  size_t size = 0;
  char name[512];
  int64_t id;
  id = start_training();
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size),
            MO_ERR_NOT_FOUND);
  for (uint32_t step = 10; step <= 40; step += 10) {
    snprintf(name, sizeof(name), "state after %u", (unsigned)step);
    CHECK_INT(put(id, step, name, 2), MO_OK);
  }
  CHECK_INT(mo_store_checkpoints(fixture.store, id, rows, 5), 2);
  CHECK(rows[0].step == 40 && rows[1].step == 30 && rows[0].size == 14 && rows[0].stored_us > 0);
  CHECK_INT(files_of(id), 2);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size), MO_OK);
  CHECK(size == 14 && memcmp(bytes, "state after 40", 14) == 0);
  free(bytes);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 30, &bytes, &size), MO_OK);
  free(bytes);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 20, &bytes, &size),
            MO_ERR_NOT_FOUND);
  /* Damage is noticed: another byte, another length, no file. */
  snprintf(name, sizeof(name), "%lld/40.checkpoint", (long long)id);
  REQUIRE(put_file(name, "state after 41") == 0);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size),
            MO_ERR_CORRUPT);
  REQUIRE(put_file(name, "state") == 0);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size),
            MO_ERR_CORRUPT);
  /* The run goes on from 30: its next checkpoint makes the damaged one go, not the good one. */
  CHECK_INT(put(id, 35, "35", 2), MO_OK);
  CHECK_INT(mo_store_checkpoints(fixture.store, id, rows, 5), 2);
  CHECK(rows[0].step == 35 && rows[1].step == 30);
  CHECK_INT(mo_store_training(fixture.store, id, &status), MO_OK);
  CHECK_INT(status.checkpoint_step, 35);
  /* A file that a crash left without its row, an unfinished one, and those of nobody, which stay.
   */
  snprintf(name, sizeof(name), "%lld/36.checkpoint", (long long)id);
  REQUIRE(put_file(name, "36") == 0);
  snprintf(name, sizeof(name), "%lld/.tmp-7", (long long)id);
  REQUIRE(put_file(name, "half") == 0);
  snprintf(name, sizeof(name), "%s/trainings/77", fixture.path);
  REQUIRE(mkdir(name, 0700) == 0 && put_file("77/5.checkpoint", "5") == 0);
  snprintf(name, sizeof(name), "%lld/036.checkpoint", (long long)id);
  REQUIRE(put_file(name, "not as we write it") == 0);
  CHECK_INT(files_of(id), 5);
  CHECK_INT(fixture_reopen(&fixture), MO_OK);
  CHECK_INT(files_of(id), 3);
  CHECK_INT(files_of(77), 1);
  CHECK_INT(mo_store_orphans(fixture.store)->n, 2);
  CHECK_INT(mo_store_orphans(fixture.store)->bytes, 19);
  CHECK_INT(mo_store_clean(fixture.store, NULL, NULL), MO_OK);
  CHECK_INT(files_of(id), 2);
  CHECK_INT(files_of(77), 0);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 35, &bytes, &size), MO_OK);
  free(bytes);
  /* Of an earlier life of the process: not this one's to write. */
  CHECK_INT(put(id, 50, "50", 2), MO_ERR_CONFLICT);
  CHECK_INT(files_of(id), 2);
}

struct checkpointer {
  struct mo_store *store;
  int64_t id;
  atomic_bool ended;
};

static void *write_checkpoints(void *context)
{
  struct checkpointer *writer = context;
  uint8_t bytes[1000] = {0};
  int error = MO_OK;
  for (uint32_t step = 2; step <= 300 && error == MO_OK; step++) {
    bytes[0] = (uint8_t)step;
    error = mo_store_training_checkpoint(writer->store, writer->id, step, bytes, sizeof(bytes), 1);
  }
  CHECK_INT(error, MO_OK);
  atomic_store(&writer->ended, true);
  return NULL;
}

/* A reader of the newest checkpoint gets a whole one, however fast they follow each other. */
static void reads_checkpoints_while_they_go(void)
{
  struct checkpointer writer = {.ended = false};
  uint8_t *bytes = NULL;
  size_t size = 0;
  pthread_t thread;
  int bad = 0;
  writer.store = fixture.store;
  writer.id = start_training();
  REQUIRE(put(writer.id, 1, "1", 1) == MO_OK);
  REQUIRE(pthread_create(&thread, NULL, write_checkpoints, &writer) == 0);
  while (!atomic_load(&writer.ended)) {
    int error = mo_store_training_checkpoint_bytes(fixture.store, writer.id, 0, &bytes, &size);
    bad += error != MO_OK;
    if (error == MO_OK)
      free(bytes);
  }
  pthread_join(thread, NULL);
  CHECK_INT(bad, 0);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, writer.id, 299, &bytes, &size),
            MO_ERR_NOT_FOUND);
}

/* A process that can open no more files has lost no checkpoint. If that were taken for damage, the
 * training would start over. */
static void keeps_apart_damage_and_want_of_descriptors(void)
{
  struct rlimit before, small;
  uint8_t *bytes = NULL;
  size_t size = 0;
  int64_t id;
  int next;
  id = start_training();
  REQUIRE(put(id, 10, "ten", 2) == MO_OK);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size), MO_OK);
  free(bytes);
  next = open("/dev/null", O_RDONLY | O_CLOEXEC);
  REQUIRE(next >= 0 && close(next) == 0 && getrlimit(RLIMIT_NOFILE, &before) == 0);
  small = before;
  small.rlim_cur = (rlim_t)next;
  setrlimit(RLIMIT_NOFILE, &small);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size),
            MO_ERR_NO_MEMORY);
  setrlimit(RLIMIT_NOFILE, &before);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size), MO_OK);
  free(bytes);
}

/* Files larger than a limit cannot be written: as on a full disk, but for small ones. */
static void survives_a_full_disk(void)
{
  struct mo_checkpoint_row rows[5];
  struct rlimit before, small;
  size_t size = 4 << 20;
  uint8_t *bytes = calloc(1, size);
  int64_t id;
  REQUIRE(bytes != NULL);
  id = start_training();
  CHECK_INT(mo_store_training_checkpoint(fixture.store, id, 1, bytes, 1000, 2), MO_OK);
  signal(SIGXFSZ, SIG_IGN);
  getrlimit(RLIMIT_FSIZE, &before);
  small = before;
  small.rlim_cur = 3 << 20;
  setrlimit(RLIMIT_FSIZE, &small);
  CHECK_INT(mo_store_training_checkpoint(fixture.store, id, 2, bytes, size, 2), MO_ERR_NO_SPACE);
  CHECK_INT(files_of(id), 1);
  CHECK_INT(mo_store_checkpoints(fixture.store, id, rows, 5), 1);
  setrlimit(RLIMIT_FSIZE, &before);
  CHECK_INT(mo_store_training_checkpoint(fixture.store, id, 2, bytes, size, 2), MO_OK);
  CHECK_INT(mo_store_checkpoints(fixture.store, id, rows, 5), 2);
  free(bytes);
}

/* What is needed to go on stays; of a training that has ended nothing is. */
static void removes_what_is_not_needed(void)
{
  struct mo_training_submission submission = submission_of(1000);
  struct mo_checkpoints_removed removed = {.n = 99};
  struct mo_training_status status;
  uint8_t *bytes = NULL;
  size_t size = 0;
  char folder[512];
  int64_t id, version;
  id = submit(&fixture, &submission);
  snprintf(folder, sizeof(folder), "%s/trainings/%lld", fixture.path, (long long)id);
  CHECK_INT(mo_store_checkpoints_remove(fixture.store, id, MO_JOB_TRAINING, 0, &removed),
            MO_OK); /* none yet */
  CHECK_INT(removed.n, 0);
  REQUIRE(mo_store_run_start(fixture.store, id) == MO_OK);
  for (uint32_t step = 10; step <= 50; step += 10)
    REQUIRE(put(id, step, "state", 9) == MO_OK);
  REQUIRE(mo_store_training(fixture.store, id, &status) == MO_OK);
  version = status.job.version;
  removed.n = 99;
  CHECK_INT(mo_store_checkpoints_remove(fixture.store, id, MO_JOB_TRAINING, 50, &removed),
            MO_ERR_CONFLICT);
  CHECK_INT(mo_store_checkpoints_remove(fixture.store, id, MO_JOB_TRAINING, 15, &removed),
            MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_checkpoints_remove(fixture.store, id + 1, MO_JOB_TRAINING, 0, &removed),
            MO_ERR_NOT_FOUND);
  CHECK_INT(removed.n, 99);
  CHECK_INT(files_of(id), 5);
  CHECK_INT(mo_store_checkpoints_remove(fixture.store, id, MO_JOB_TRAINING, 20, &removed), MO_OK);
  CHECK(removed.n == 1 && removed.places[0].step == 20 && removed.bytes == 5);
  CHECK_INT(files_of(id), 4);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 20, &bytes, &size),
            MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_PAUSE, NULL),
            MO_OK); /* it is to go on some time */
  CHECK_INT(mo_store_checkpoints_remove(fixture.store, id, MO_JOB_TRAINING, 50, &removed),
            MO_ERR_CONFLICT);
  CHECK_INT(mo_store_checkpoints_remove(fixture.store, id, MO_JOB_TRAINING, 0, &removed), MO_OK);
  CHECK(removed.n == 3 && removed.places[0].step == 40 && removed.places[2].step == 10 &&
        removed.bytes == 15);
  CHECK_INT(files_of(id), 1);
  CHECK_INT(mo_store_training_checkpoint_bytes(fixture.store, id, 0, &bytes, &size), MO_OK);
  free(bytes);
  CHECK_INT(mo_store_change_job(fixture.store, id, MO_CHANGE_CANCEL, NULL), MO_OK);
  CHECK_INT(mo_store_checkpoints_remove(fixture.store, id, MO_JOB_TRAINING, 0, &removed), MO_OK);
  CHECK(removed.n == 1 && removed.places[0].step == 50);
  CHECK(access(folder, F_OK) != 0);
  /* A run that learns late of its end leaves nothing. */
  CHECK_INT(put(id, 60, "late", 9), MO_ERR_CONFLICT);
  CHECK(access(folder, F_OK) != 0);
  CHECK_INT(mo_store_training(fixture.store, id, &status), MO_OK);
  CHECK(status.checkpoint_step == 0 && status.job.version > version);
  CHECK_INT(mo_store_check(fixture.store, &fixture.message), MO_OK);
}

static void *remove_checkpoints(void *context)
{
  struct checkpointer *writer = context;
  struct mo_checkpoints_removed removed;
  while (!atomic_load(&writer->ended))
    for (uint32_t step = 1; step <= 3; step++)
      (void)mo_store_checkpoints_remove(writer->store, writer->id, MO_JOB_TRAINING, step, &removed);
  return NULL;
}

/* A training whose newest checkpoints are damaged writes old steps again, while another
 * thread deletes those: what is there has its file. */
static void writes_again_what_is_removed(void)
{
  struct checkpointer remover = {.ended = false};
  struct mo_checkpoint_row rows[9];
  uint8_t *bytes = NULL;
  size_t size = 0;
  pthread_t thread;
  int64_t n;
  remover.store = fixture.store;
  remover.id = start_training();
  REQUIRE(pthread_create(&thread, NULL, remove_checkpoints, &remover) == 0);
  for (int i = 0; i < 150; i++) {
    uint32_t step = (uint32_t)(1 + i % 3);
    CHECK_INT(put(remover.id, step, "state", 9), MO_OK);
    int error = mo_store_training_checkpoint_bytes(fixture.store, remover.id, step, &bytes, &size);
    CHECK(error == MO_OK || error == MO_ERR_NOT_FOUND); /* MO_ERR_CORRUPT: a row without its file */
    if (error == MO_OK)
      free(bytes);
  }
  atomic_store(&remover.ended, true);
  pthread_join(thread, NULL);
  n = mo_store_checkpoints(fixture.store, remover.id, rows, 9);
  CHECK_INT(files_of(remover.id), n);
}

static const struct check_case cases[] = {
    {"keeps checkpoints", keeps_checkpoints},
    {"reads checkpoints while they go", reads_checkpoints_while_they_go},
    {"keeps apart damage and want of descriptors", keeps_apart_damage_and_want_of_descriptors},
    {"survives a full disk", survives_a_full_disk},
    {"removes what is not needed", removes_what_is_not_needed},
    {"writes again what is removed", writes_again_what_is_removed},
};
CHECK_MAIN_AROUND(cases, with_a_store)
