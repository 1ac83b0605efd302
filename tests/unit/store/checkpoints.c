/* checkpoints.c: checkpoints of training runs: rows and files stay consistent, whatever happens in
 * between. */
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

/* Submits a training run and starts it. */
static int64_t start_training(void)
{
  const struct mo_training_request submission = submission_of(1000);
  const int64_t id = submit_training(&submission);
  CHECK_OK(mo_store_run_start(store, id));
  return id;
}

static int put(int64_t id, uint32_t step, const char *state, uint32_t keep)
{
  return mo_store_training_checkpoint(store, id, step, (const uint8_t *)state, strlen(state), keep);
}

/* Reads a checkpoint and compares it with `text` (NULL: any content). */
static int get(int64_t id, uint32_t step, const char *text)
{
  uint8_t *bytes = NULL;
  size_t size = 0;
  const int error = mo_store_training_checkpoint_bytes(store, id, step, &bytes, &size);
  if (error == MO_OK && text != NULL)
    CHECK(size == strlen(text) && memcmp(bytes, text, size) == 0);
  if (error == MO_OK)
    free(bytes);
  return error;
}

static void keeps_checkpoints(void)
{
  struct mo_checkpoint_row rows[5];
  char text[32];
  const int64_t id = start_training();
  const long long folder = id;
  CHECK_INT(get(id, 0, NULL), MO_ERR_NOT_FOUND);
  for (uint32_t step = 10; step <= 40; step += 10) {
    snprintf(text, sizeof(text), "state after %u", step);
    CHECK_OK(put(id, step, text, 2));
  }
  CHECK_INT(mo_store_checkpoints(store, id, rows, 5), 2);
  CHECK(rows[0].step == 40 && rows[1].step == 30 && rows[0].size == 14 && rows[0].stored_us > 0);
  CHECK_INT(files_of("trainings", id), 2);
  CHECK_OK(get(id, 0, "state after 40"));
  CHECK_OK(get(id, 30, "state after 30"));
  CHECK_INT(get(id, 20, NULL), MO_ERR_NOT_FOUND);
  /* Damage is detected: a changed byte, a changed length, a missing file. */
  REQUIRE_OK(put_file(path_of("trainings/%lld/40.checkpoint", folder), "state after 41"));
  CHECK_INT(get(id, 0, NULL), MO_ERR_CORRUPT);
  REQUIRE_OK(put_file(path_of("trainings/%lld/40.checkpoint", folder), "state"));
  CHECK_INT(get(id, 0, NULL), MO_ERR_CORRUPT);
  /* The run continues from 30. Its next checkpoint removes the damaged one and keeps the good
   * one. */
  CHECK_OK(put(id, 35, "35", 2));
  CHECK_INT(mo_store_checkpoints(store, id, rows, 5), 2);
  CHECK(rows[0].step == 35 && rows[1].step == 30);
  CHECK_INT(training_of(id).checkpoint_step, 35);
  /* A file that a crash left without a row, an unfinished file, and foreign files, which stay. */
  REQUIRE_OK(put_file(path_of("trainings/%lld/36.checkpoint", folder), "36"));
  REQUIRE_OK(put_file(path_of("trainings/%lld/.tmp-7", folder), "half"));
  REQUIRE_OK(put_file(path_of("trainings/%lld/036.checkpoint", folder), "not as we write it"));
  REQUIRE(mkdir(path_of("trainings/77"), 0700) == 0);
  REQUIRE_OK(put_file(path_of("trainings/77/5.checkpoint"), "5"));
  CHECK_INT(files_of("trainings", id), 5);
  CHECK_OK(reopen());
  CHECK_INT(files_of("trainings", id), 3);
  CHECK_INT(files_of("trainings", 77), 1);
  CHECK_INT(mo_store_orphans(store)->n, 2);
  CHECK_INT(mo_store_orphans(store)->bytes, 19);
  CHECK_OK(mo_store_clean(store, NULL, NULL));
  CHECK_INT(files_of("trainings", id), 2);
  CHECK_INT(files_of("trainings", 77), -1);
  CHECK_OK(get(id, 35, "35"));
  /* A run started by an earlier process can no longer write. */
  CHECK_INT(put(id, 50, "50", 2), MO_ERR_CONFLICT);
  CHECK_INT(files_of("trainings", id), 2);
}

struct checkpointer {
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
    error = mo_store_training_checkpoint(store, writer->id, step, bytes, sizeof(bytes), 1);
  }
  CHECK_OK(error);
  atomic_store(&writer->ended, true);
  return NULL;
}

/* A reader of the newest checkpoint gets a whole one, no matter how fast new ones are written. */
static void reads_checkpoints_while_they_go(void)
{
  struct checkpointer writer = {.ended = false};
  pthread_t thread;
  int bad = 0;
  writer.id = start_training();
  REQUIRE_OK(put(writer.id, 1, "1", 1));
  REQUIRE(pthread_create(&thread, NULL, write_checkpoints, &writer) == 0);
  while (!atomic_load(&writer.ended)) {
    int error = get(writer.id, 0, NULL);
    bad += error != MO_OK;
  }
  pthread_join(thread, NULL);
  CHECK_INT(bad, 0);
  CHECK_INT(get(writer.id, 299, NULL), MO_ERR_NOT_FOUND);
}

/* A process that runs out of descriptors has not lost a checkpoint. If it mistook this for damage,
 * the training run would restart from the beginning. */
static void keeps_apart_damage_and_want_of_descriptors(void)
{
  struct rlimit before, small;
  int64_t id = start_training();
  REQUIRE_OK(put(id, 10, "ten", 2));
  CHECK_OK(get(id, 0, NULL));
  int next = open("/dev/null", O_RDONLY | O_CLOEXEC);
  REQUIRE(next >= 0 && close(next) == 0 && getrlimit(RLIMIT_NOFILE, &before) == 0);
  small = before;
  small.rlim_cur = (rlim_t)next;
  setrlimit(RLIMIT_NOFILE, &small);
  CHECK_INT(get(id, 0, NULL), MO_ERR_NO_MEMORY);
  setrlimit(RLIMIT_NOFILE, &before);
  CHECK_OK(get(id, 0, NULL));
}

/* Limits the size of files, which acts like a full disk that still has room for small files. */
static void survives_a_full_disk(void)
{
  struct mo_checkpoint_row rows[5];
  struct rlimit before, small;
  size_t size = 4 << 20;
  uint8_t *bytes = calloc(1, size);
  REQUIRE(bytes != NULL);
  int64_t id = start_training();
  CHECK_OK(mo_store_training_checkpoint(store, id, 1, bytes, 1000, 2));
  signal(SIGXFSZ, SIG_IGN);
  getrlimit(RLIMIT_FSIZE, &before);
  small = before;
  small.rlim_cur = 3 << 20;
  setrlimit(RLIMIT_FSIZE, &small);
  CHECK_INT(mo_store_training_checkpoint(store, id, 2, bytes, size, 2), MO_ERR_NO_SPACE);
  CHECK_INT(files_of("trainings", id), 1);
  CHECK_INT(mo_store_checkpoints(store, id, rows, 5), 1);
  setrlimit(RLIMIT_FSIZE, &before);
  CHECK_OK(mo_store_training_checkpoint(store, id, 2, bytes, size, 2));
  CHECK_INT(mo_store_checkpoints(store, id, rows, 5), 2);
  free(bytes);
}

static int drop(int64_t id, uint32_t step, struct mo_checkpoints_removed *removed)
{
  return mo_store_checkpoints_remove(store, id, MO_JOB_TRAINING, step, removed);
}

/* Checkpoints that are needed to continue stay; a training run that has ended needs none. */
static void removes_what_is_not_needed(void)
{
  struct mo_training_request submission = submission_of(1000);
  struct mo_checkpoints_removed removed = {.n = 99};
  char folder[512];
  int64_t id, version;
  id = submit_training(&submission);
  snprintf(folder, sizeof(folder), "%s/trainings/%lld", fixture.path, (long long)id);
  CHECK_OK(drop(id, 0, &removed)); /* none yet */
  CHECK_INT(removed.n, 0);
  REQUIRE_OK(mo_store_run_start(store, id));
  for (uint32_t step = 10; step <= 50; step += 10)
    REQUIRE_OK(put(id, step, "state", 9));
  struct mo_training_status status = training_of(id);
  version = status.job.version;
  removed.n = 99;
  CHECK_INT(drop(id, 50, &removed), MO_ERR_CONFLICT);
  CHECK_INT(drop(id, 15, &removed), MO_ERR_NOT_FOUND);
  CHECK_INT(drop(id + 1, 0, &removed), MO_ERR_NOT_FOUND);
  CHECK_INT(removed.n, 99);
  CHECK_INT(files_of("trainings", id), 5);
  CHECK_OK(drop(id, 20, &removed));
  CHECK(removed.n == 1 && removed.places[0].step == 20 && removed.bytes == 5);
  CHECK_INT(files_of("trainings", id), 4);
  CHECK_INT(get(id, 20, NULL), MO_ERR_NOT_FOUND);
  CHECK_OK(change(id, MO_CHANGE_PAUSE)); /* it will continue later */
  CHECK_INT(drop(id, 50, &removed), MO_ERR_CONFLICT);
  CHECK_OK(drop(id, 0, &removed));
  CHECK(removed.n == 3 && removed.places[0].step == 40 && removed.places[2].step == 10 &&
        removed.bytes == 15);
  CHECK_INT(files_of("trainings", id), 1);
  CHECK_OK(get(id, 0, NULL));
  CHECK_OK(change(id, MO_CHANGE_CANCEL));
  CHECK_OK(drop(id, 0, &removed));
  CHECK(removed.n == 1 && removed.places[0].step == 50);
  CHECK(access(folder, F_OK) != 0);
  /* A run that notices its end too late leaves no file. */
  CHECK_INT(put(id, 60, "late", 9), MO_ERR_CONFLICT);
  CHECK(access(folder, F_OK) != 0);
  status = training_of(id);
  CHECK(status.checkpoint_step == 0 && status.job.version > version);
  CHECK_OK(check_whole());
}

static void *remove_checkpoints(void *context)
{
  struct checkpointer *writer = context;
  struct mo_checkpoints_removed removed;
  while (!atomic_load(&writer->ended))
    for (uint32_t step = 1; step <= 3; step++)
      (void)mo_store_checkpoints_remove(store, writer->id, MO_JOB_TRAINING, step, &removed);
  return NULL;
}

/* A training run with damaged newest checkpoints writes earlier steps again, while another thread
 * deletes those. Every remaining row must have its file. */
static void writes_again_what_is_removed(void)
{
  struct checkpointer remover = {.ended = false};
  struct mo_checkpoint_row rows[9];
  pthread_t thread;
  remover.id = start_training();
  REQUIRE(pthread_create(&thread, NULL, remove_checkpoints, &remover) == 0);
  for (int i = 0; i < 150; i++) {
    uint32_t step = (uint32_t)(1 + i % 3);
    CHECK_OK(put(remover.id, step, "state", 9));
    int error = get(remover.id, step, NULL);
    CHECK(error == MO_OK || error == MO_ERR_NOT_FOUND); /* MO_ERR_CORRUPT: a row without its file */
  }
  atomic_store(&remover.ended, true);
  pthread_join(thread, NULL);
  int64_t n = mo_store_checkpoints(store, remover.id, rows, 9);
  CHECK_INT(files_of("trainings", remover.id), n);
}

static const struct check_case cases[] = {
    {"keeps checkpoints", keeps_checkpoints},
    {"reads checkpoints while they are replaced", reads_checkpoints_while_they_go},
    {"distinguishes damage from a lack of descriptors", keeps_apart_damage_and_want_of_descriptors},
    {"survives a full disk", survives_a_full_disk},
    {"removes checkpoints that are not needed", removes_what_is_not_needed},
    {"rewrites removed checkpoints", writes_again_what_is_removed},
};
CHECK_MAIN_AROUND(cases, with_a_store)
