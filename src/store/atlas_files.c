/* atlas_files.c: see atlas_files.h. */
#include "store/atlas_files.h"

#include <dirent.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "atlas/file.h"
#include "store/folder.h"

#define ENDING ".atlas"

/* ---- lists ---- */

static bool read_name(const char *file, struct mo_atlas_name *name)
{
  const size_t size = strlen(file), ending = sizeof(ENDING) - 1;
  if (size <= ending || size - ending > MO_ATLAS_NAME_MAX ||
      strcmp(file + size - ending, ENDING) != 0)
    return false;
  memcpy(name->text, file, size - ending);
  name->text[size - ending] = '\0';
  return mo_atlas_name_is_valid(name->text);
}

static int compare(const void *a, const void *b)
{
  return strcmp(((const struct mo_atlas_name *)a)->text, ((const struct mo_atlas_name *)b)->text);
}

int mo_store_atlas_names(const struct mo_store *store, struct mo_atlas_name **ret, uint32_t *n)
{
  DIR *folder = opendir(mo_store_atlases_path(store));
  const struct dirent *entry;
  struct mo_atlas_name *names = NULL, name;
  uint32_t found = 0;
  int error = folder != NULL ? MO_OK : mo_open_error();
  while (folder != NULL && error == MO_OK && (entry = readdir(folder)) != NULL) {
    if (!read_name(entry->d_name, &name))
      continue;
    struct mo_atlas_name *grown = realloc(names, ((size_t)found + 1) * sizeof(*names));
    if (grown == NULL)
      error = MO_ERR_NO_MEMORY;
    else
      names = grown;
    if (error == MO_OK)
      names[found++] = name;
  }
  if (folder != NULL)
    (void)closedir(folder);
  if (error != MO_OK) {
    free(names);
    return error;
  }
  if (found > 0)
    qsort(names, found, sizeof(*names), compare);
  *ret = names;
  *n = found;
  return MO_OK;
}

/* ---- opening ---- */

/* Opens a file with the store's workspace. folder: of a copy (nullable). */
static int open_own(const char *path, const char *folder, struct mo_atlas **atlas,
                    struct mo_message *message)
{
  const int error = mo_atlas_open_copy(path, folder, atlas, message);
  if (error != MO_OK)
    return error;
  const struct mo_workspace own = MO_STORE_WORKSPACE,
                            its = mo_atlas_source_of(*atlas)->scope.workspace;
  if (mo_workspace_equal(own, its))
    return MO_OK;
  mo_atlas_close(*atlas);
  *atlas = NULL;
  return mo_fail(message, MO_ERR_UNSUPPORTED,
                 "the atlas is for a workspace of %u × %u × %u voxels, but this service has "
                 "%u × %u × %u; read the file with the Python package",
                 its.nx, its.ny, its.nz, own.nx, own.ny, own.nz);
}

int mo_store_atlas_open(const struct mo_store *store, const char *path, struct mo_atlas **atlas,
                        struct mo_message *message)
{
  return open_own(path, atomic_load(&store->is_short) ? NULL : mo_store_atlases_path(store), atlas,
                  message);
}

/* ---- changes ---- */

struct put {
  struct mo_store *store;
  const char *name;
  bool is_new;
  struct mo_message *message;
};

/* Reads and checks a file that has no name yet. If the name was free, it may have been taken while
 * the file was written and read. */
static int check_file(void *context, const char *path)
{
  const struct put *put = context;
  struct mo_message *message = put->message;
  struct mo_atlas *atlas = NULL;
  const int error = open_own(path, NULL, &atlas, message);
  mo_atlas_close(atlas);
  return error == MO_OK && put->is_new ? mo_store_atlas_name_check(put->store, put->name, message)
                                       : error;
}

int mo_store_atlas_put(struct mo_store *store, const char *name, const void *bytes, size_t size,
                       bool *created, struct mo_message *message)
{
  char *path = mo_store_atlas_path(store, name);
  if (path == NULL)
    return MO_ERR_NO_MEMORY;
  const mode_t type = mo_store_atlas_type(path);
  *created = type == 0;
  int error = *created          ? mo_store_atlas_name_check(store, name, message)
              : type == S_IFDIR ? mo_fail(message, MO_ERR_CONFLICT,
                                          "atlases/%s.atlas is " MO_ATLAS_IS_FOLDER, name)
                                : MO_OK;
  if (error == MO_OK)
    error = mo_file_write_checked(store, mo_store_atlases_path(store), path, bytes, size,
                                  check_file, &(struct put){store, name, *created, message});
  free(path);
  return error;
}

int mo_store_atlas_delete(struct mo_store *store, const char *name)
{
  char *path = mo_store_atlas_path(store, name);
  if (path == NULL)
    return MO_ERR_NO_MEMORY;
  int error = mo_store_atlas_type(path) == S_IFDIR ? MO_ERR_CONFLICT : MO_OK;
  if (error == MO_OK && store->files->unlink(path) != 0)
    error = errno == ENOENT ? MO_ERR_NOT_FOUND : mo_file_error();
  free(path);
  return error == MO_OK ? mo_folder_sync(store, mo_store_atlases_path(store)) : error;
}
