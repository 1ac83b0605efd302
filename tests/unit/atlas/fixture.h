/* fixture.h: atlas files with invented losses, in a folder of their own. */
#ifndef MORPHO_TESTS_ATLAS_FIXTURE_H
#define MORPHO_TESTS_ATLAS_FIXTURE_H

#include "../make.h"

#include "atlas/file.h"
#include "atlas/writer.h"
#include "morphospace/form_set.h"

#include <dirent.h>
#include <math.h>
#include <morpho/atlas.h>
#include <unistd.h>

#define FIXTURE_PATH 256

static inline void fixture_drop_folder(void *path)
{
  DIR *folder = opendir(path);
  const struct dirent *entry;
  while (folder != NULL && (entry = readdir(folder)) != NULL)
    (void)unlinkat(dirfd(folder), entry->d_name, 0);
  if (folder != NULL)
    (void)closedir(folder);
  (void)rmdir(path);
  free(path);
}

static inline const char *fixture_folder(void)
{
  char *path = strdup("/tmp/atlas-XXXXXX");
  if (path == NULL || mkdtemp(path) == NULL) {
    printf("Bail out! no folder\n");
    exit(1);
  }
  return check_keep(path, fixture_drop_folder);
}

static inline struct mo_atlas_source fixture_source(uint32_t voxels_max)
{
  struct mo_atlas_source source = {.scope = {MO_DEFAULT_WORKSPACE, voxels_max},
                                   .fingerprint = "invented losses"};
  for (int i = 0; i < 32; i++) {
    source.controller_sha256[i] = (uint8_t)(3 * i);
    source.physics_sha256[i] = (uint8_t)(7 * i);
  }
  return source;
}

/* A loss that depends on nothing but the body's form and the environment. With few levels, many
 * bodies have equal scores. */
static inline double fixture_loss(const uint64_t *form, uint32_t environment, uint64_t levels)
{
  const uint64_t words[] = {form[0], form[1], form[2], environment};
  return (double)(mo_form_hash((const uint8_t *)words, sizeof(words)) % levels) / (double)levels;
}

/* The same for a measure; some have no value. */
static inline double fixture_measure(const uint64_t *form, uint32_t m, uint64_t levels)
{
  return fixture_loss(form, 100 + m, 13) == 0 ? (double)NAN
                                              : 8 * fixture_loss(form, 200 + m, levels) - 3;
}

/* Adds bodies with invented losses until `end`, or all. */
static inline int fixture_add(struct mo_atlas_writer *writer, const struct mo_atlas_source *source,
                              uint32_t n_environments, uint64_t levels, uint64_t end)
{
  struct mo_atlas_bodies *bodies = NULL;
  uint64_t form[MO_DEFAULT_WORDS] = {0};
  double losses[MO_ATLAS_ENVIRONMENTS_MAX], measures[MO_MEASURES];
  int error = mo_atlas_bodies_create(&source->scope, &bodies);
  if (error == MO_OK)
    error = mo_atlas_bodies_seek(bodies, mo_atlas_writer_position(writer));
  while (error == MO_OK && mo_atlas_writer_position(writer) < end &&
         mo_atlas_writer_position(writer) < mo_atlas_writer_bodies(writer)) {
    error = mo_atlas_bodies_next(bodies, form);
    for (uint32_t e = 0; e < n_environments; e++)
      losses[e] = fixture_loss(form, e, levels);
    for (uint32_t m = 0; m < (uint32_t)__builtin_popcount(source->measures); m++)
      measures[m] = fixture_measure(form, m, levels);
    if (error == MO_OK)
      error = mo_atlas_writer_add(writer, form, losses, measures);
  }
  mo_atlas_bodies_free(bodies);
  return error;
}

/* Writes a whole file. */
static inline int fixture_write(const struct mo_file_operations *files, const char *path,
                                const struct mo_atlas_source *source,
                                const struct mo_environment *environments, uint32_t n,
                                uint64_t levels, struct mo_message *message)
{
  struct mo_atlas_writer *writer = NULL;
  int error = mo_atlas_writer_create_with(files, path, source, environments, n, &writer, message);
  if (error == MO_OK)
    error = fixture_add(writer, source, n, levels, UINT64_MAX);
  if (error == MO_OK)
    error = mo_atlas_writer_finish(writer, message);
  mo_atlas_writer_free(writer);
  return error;
}

static inline void fixture_drop_atlas(void *atlas)
{
  mo_atlas_close(atlas);
}

static inline struct mo_atlas *fixture_open(const char *path)
{
  struct mo_atlas *atlas = NULL;
  struct mo_message message = {""};
  const int error = mo_atlas_open(path, &atlas, &message);
  make_check(error, message.text);
  return check_keep(atlas, fixture_drop_atlas);
}

/* Writes and opens an atlas of the paper's test set. */
static inline struct mo_atlas *fixture_atlas(const struct mo_atlas_source *source, uint64_t levels)
{
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_message message = {""};
  char path[FIXTURE_PATH];
  snprintf(path, sizeof(path), "%s/a.atlas", fixture_folder());
  mo_environment_paper_test(environments);
  make_check(fixture_write(&mo_system_files, path, source, environments, MO_PAPER_TEST_COUNT,
                           levels, &message),
             message.text);
  return fixture_open(path);
}

static inline uint8_t *fixture_bytes(const char *path, size_t *size)
{
  FILE *file = fopen(path, "rb");
  *size = 0;
  if (file == NULL)
    return make_zeros(1, 1);
  (void)fseek(file, 0, SEEK_END);
  *size = (size_t)ftell(file);
  rewind(file);
  uint8_t *bytes = make_zeros(*size, 1);
  if (fread(bytes, 1, *size, file) != *size)
    *size = 0;
  (void)fclose(file);
  return bytes;
}

#endif
