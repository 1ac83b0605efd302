/* memory.c: no failed allocation leaks, crashes or changes what was there. */
#include "fixture.h"

#include "../failing.h"

#include <sys/mman.h>

void *__real_mmap64(void *at, size_t size, int protection, int flags, int fd, off_t offset);
void *__wrap_mmap64(void *at, size_t size, int protection, int flags, int fd, off_t offset);

/* Files are mapped, and large arrays are pages of their own. (mmap is a macro for this.) */
void *__wrap_mmap64(void *at, size_t size, int protection, int flags, int fd, off_t offset)
{
  return fails() ? MAP_FAILED : __real_mmap64(at, size, protection, flags, fd, offset);
}

static int stream(void)
{
  const struct mo_atlas_scope scope = {MO_DEFAULT_WORKSPACE, 7};
  struct mo_atlas_bodies *bodies = NULL;
  uint64_t form[MO_DEFAULT_WORDS], counts[MO_ATLAS_VOXELS_MAX];
  int error = mo_atlas_bodies_create(&scope, &bodies);
  if (error == MO_OK)
    error = mo_atlas_bodies_next(bodies, form);
  if (error == MO_OK)
    error = mo_atlas_bodies_seek(bodies, 3000);
  if (error == MO_OK)
    error = mo_atlas_bodies_count(bodies, counts);
  mo_atlas_bodies_free(bodies);
  return error;
}

static char path[FIXTURE_PATH];

static int write_and_open(void)
{
  const struct mo_atlas_source source = fixture_source(5);
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_atlas *atlas = NULL;
  mo_environment_paper_test(environments);
  int error = fixture_write(&mo_system_files, path, &source, environments, 3, 10, NULL);
  if (error == MO_OK || error == MO_ERR_CONFLICT) /* it failed after it had finished the file */
    error = mo_atlas_open(path, &atlas, NULL);
  mo_atlas_close(atlas);
  if (error == MO_OK)
    (void)unlink(path);
  return error;
}

static void files(void)
{
  snprintf(path, sizeof(path), "%s/a.atlas", fixture_folder());
  each_fails(write_and_open, 20);
}

static struct mo_atlas *opened;

static int query(void)
{
  struct mo_atlas_index *index = NULL;
  struct mo_atlas_basins *basins = NULL;
  int error = mo_atlas_index_create(opened, &index);
  if (error == MO_OK)
    error = mo_atlas_basins_create(opened, index, NULL, &basins);
  mo_atlas_basins_free(basins);
  mo_atlas_index_free(index);
  return error;
}

static void queries(void)
{
  const struct mo_atlas_source source = fixture_source(5);
  opened = fixture_atlas(&source, 10);
  each_fails(query, 8);
}

static void streams(void)
{
  each_fails(stream, 20);
}

static const struct check_case cases[] = {
    {"a stream of bodies", streams},
    {"writing and opening a file", files},
    {"index and basins", queries},
};
CHECK_MAIN(cases)
