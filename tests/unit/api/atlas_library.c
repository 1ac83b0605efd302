/* atlas_library.c: while a file is being opened, only the requests for that file wait. The linker
 * replaces mo_store_atlas_open, so that files named slow open when the test lets them. */
#include <pthread.h>
#include <semaphore.h>
#include <stdatomic.h>

#include "../store/fixture.h"

#include "api/atlas_library.h"

#define HANGS_AFTER_S 60

static struct mo_atlas_library library;
static atomic_int n_opened; /* slow files */
static sem_t entered, gate;

int __real_mo_store_atlas_open(const struct mo_store *of, const char *path, struct mo_atlas **atlas,
                               struct mo_message *message);
int __wrap_mo_store_atlas_open(const struct mo_store *of, const char *path, struct mo_atlas **atlas,
                               struct mo_message *message);
int __wrap_mo_store_atlas_open(const struct mo_store *of, const char *path, struct mo_atlas **atlas,
                               struct mo_message *message)
{
  const int error = __real_mo_store_atlas_open(of, path, atlas, message);
  if (strstr(path, "slow") != NULL) {
    atomic_fetch_add(&n_opened, 1);
    sem_post(&entered);
    sem_wait(&gate);
  }
  return error;
}

static int describe(const struct mo_atlas_use *use, const struct mo_atlas_facts *facts,
                    struct mo_text *text)
{
  mo_text_format(text, "%s: %llu", facts->name, (unsigned long long)mo_atlas_bodies_of(use->atlas));
  return MO_OK;
}

/* Writes an atlas of all bodies of at most so many voxels. */
static void write_atlas(const char *path, uint32_t voxels)
{
  const struct mo_atlas_source source = {.scope = {MO_DEFAULT_WORKSPACE, voxels}};
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_atlas_writer *writer = NULL;
  struct mo_atlas_bodies *bodies = NULL;
  uint64_t form[MO_DEFAULT_WORDS] = {0};
  mo_environment_paper_test(environments);
  REQUIRE(mo_atlas_writer_create(path, &source, environments, 1, &writer, NULL) == MO_OK &&
          mo_atlas_bodies_create(&source.scope, &bodies) == MO_OK);
  while (mo_atlas_bodies_next(bodies, form) == MO_OK)
    CHECK_OK(mo_atlas_writer_add(writer, form, &(double){0.5}, NULL));
  CHECK_OK(mo_atlas_writer_finish(writer, NULL));
  mo_atlas_bodies_free(bodies);
  mo_atlas_writer_free(writer);
}

static void store_atlas(const char *name, uint32_t voxels)
{
  char *path = mo_store_atlas_path(store, name);
  write_atlas(path, voxels);
  free(path);
}

struct reader {
  pthread_t thread;
  struct mo_atlas_use use;
  int error;
};

static void *use_slow(void *context)
{
  struct reader *reader = context;
  struct mo_message message;
  reader->error = mo_atlas_use(&library, "slow", MO_ATLAS_NEED_INDEX, &reader->use, &message);
  return NULL;
}

static void begin(struct reader *reader)
{
  REQUIRE(pthread_create(&reader->thread, NULL, use_slow, reader) == 0);
}

/* Returns the bodies of the atlas that a reader got. */
static uint64_t end(struct reader *reader)
{
  pthread_join(reader->thread, NULL);
  CHECK_OK(reader->error);
  const uint64_t n = reader->error == MO_OK ? mo_atlas_bodies_of(reader->use.atlas) : 0;
  if (reader->error == MO_OK)
    mo_atlas_release(&library, &reader->use);
  return n;
}

static void start(void)
{
  alarm(HANGS_AFTER_S); /* a test that waits for the gate itself would hang */
  sem_init(&entered, 0, 0);
  sem_init(&gate, 0, 0);
  atomic_store(&n_opened, 0);
  CHECK_OK(fixture_start());
  store_atlas("quick", 2);
  store_atlas("slow", 3);
  mo_atlas_library_init(&library, store, describe);
}

static void finish(void)
{
  mo_atlas_library_free(&library);
  fixture_end();
  alarm(0);
}

static void others_do_not_wait(void)
{
  struct reader first = {.error = -1}, second = {.error = -1};
  struct mo_atlas_use use;
  struct mo_message message;
  struct mo_text text = {0};
  uint64_t optima;
  start();
  begin(&first);
  sem_wait(&entered);
  begin(&second);
  CHECK_OK(mo_atlas_use(&library, "quick", MO_ATLAS_NEED_BASINS, &use, &message));
  CHECK_INT(mo_atlas_bodies_of(use.atlas), 3);
  mo_atlas_release(&library, &use);
  CHECK_OK(mo_atlas_describe(&library, "quick", &text, &optima, &message));
  CHECK(text.data != NULL && strcmp(text.data, "quick: 3") == 0);
  mo_text_free(&text);
  sem_post(&gate);
  CHECK_INT(end(&first), 8);
  CHECK_INT(end(&second), 8);
  CHECK_INT(atomic_load(&n_opened), 1);
  finish();
}

/* A file that is replaced while it is opened is opened again. */
static void replaced(void)
{
  struct reader reader = {.error = -1};
  char *path;
  start();
  path = mo_store_atlas_path(store, "slow");
  begin(&reader);
  sem_wait(&entered);
  write_atlas(path_of("other"), 4);
  CHECK_INT(rename(path_of("other"), path), 0);
  mo_atlas_forget(&library, "slow");
  sem_post(&gate);
  sem_post(&gate);
  CHECK_INT(end(&reader), 29);
  CHECK_INT(atomic_load(&n_opened), 2);
  free(path);
  finish();
}

/* A file that is deleted while it is opened can still be used by those who opened it. */
static void deleted(void)
{
  struct reader reader = {.error = -1};
  struct mo_atlas_use use;
  struct mo_message message;
  start();
  begin(&reader);
  sem_wait(&entered);
  CHECK_OK(mo_store_atlas_delete(store, "slow"));
  mo_atlas_forget(&library, "slow");
  CHECK_INT(mo_atlas_use(&library, "slow", MO_ATLAS_NEED_FILE, &use, &message), MO_ERR_NOT_FOUND);
  sem_post(&gate);
  CHECK_INT(end(&reader), 8);
  finish();
}

static const struct check_case cases[] = {
    {"a slow file delays no request for another", others_do_not_wait},
    {"a file that is replaced while it is opened", replaced},
    {"a file that is deleted while it is opened", deleted},
};
CHECK_MAIN(cases)
