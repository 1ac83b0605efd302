/* atlas_names.c: see atlas_names.h. */
#include "store/atlas_names.h"

#include <dirent.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "store/atlas_rows.h"

#define PART ".atlas.part"

bool mo_atlas_name_is_valid(const char *name)
{
  const size_t length = strlen(name);
  return length >= 1 && length <= MO_ATLAS_NAME_MAX && name[0] != '-' && name[length - 1] != '-' &&
         strspn(name, "abcdefghijklmnopqrstuvwxyz0123456789-") == length;
}

const char *mo_store_atlases_path(const struct mo_store *store)
{
  return store->atlases_path;
}

char *mo_store_atlas_path(const struct mo_store *store, const char *name)
{
  char *path;
  return asprintf(&path, "%s/%s.atlas", store->atlases_path, name) >= 0 ? path : NULL;
}

mode_t mo_store_atlas_type(const char *path)
{
  struct stat status;
  return lstat(path, &status) == 0 ? status.st_mode & S_IFMT : 0;
}

/* ---- names that are taken ---- */

int mo_atlas_builder(struct mo_connection *connection, const char *name, int64_t *id)
{
  static const char sql[] =
      "SELECT a.job FROM atlases a JOIN jobs j ON j.id=a.job WHERE a.name=?1 AND j.state IN"
      "(0,1,2,4) LIMIT 1";
  const int error = mo_sql_find(connection, id, sql, mo_string(name));
  if (error == MO_ERR_NOT_FOUND)
    *id = 0;
  return error == MO_ERR_NOT_FOUND ? MO_OK : error;
}

int mo_atlas_name_find(const struct mo_store *store, struct mo_connection *connection,
                       const char *name, struct mo_message *message)
{
  int64_t id = 0;
  char *path = mo_store_atlas_path(store, name);
  const bool is_there = path != NULL && mo_store_atlas_type(path) != 0;
  const int error = path != NULL ? mo_atlas_builder(connection, name, &id) : MO_ERR_NO_MEMORY;
  free(path);
  if (error != MO_OK)
    return error;
  if (id != 0)
    return mo_fail(message, MO_ERR_CONFLICT,
                   "job %lld builds the atlas \"%.64s\"; choose another name, or cancel or delete "
                   "that job",
                   (long long)id, name);
  return is_there
             ? mo_fail(message, MO_ERR_CONFLICT,
                       "an atlas \"%.64s\" already exists; choose another name, or delete it", name)
             : MO_OK;
}

int mo_store_atlas_name_check(struct mo_store *store, const char *name, struct mo_message *message)
{
  MO_SCOPED struct mo_connection *reader = mo_reader_acquire(store);
  return mo_atlas_name_find(store, reader, name, message);
}

/* ---- files that nothing needs ---- */

/* Reads the name of an unfinished atlas from that of its file. */
static bool read_part(const char *file, char name[MO_ATLAS_NAME_MAX + 1])
{
  const size_t size = strlen(file), ending = sizeof(PART) - 1;
  if (size <= ending || size - ending > MO_ATLAS_NAME_MAX ||
      strcmp(file + size - ending, PART) != 0)
    return false;
  memcpy(name, file, size - ending);
  name[size - ending] = '\0';
  return mo_atlas_name_is_valid(name);
}

/* Returns whether the file belongs to jobs that have ended. A file with a name that belongs to no
 * job, for example after an older database was restored, is kept, because it may contain hours of
 * work. */
static int is_over(struct mo_store *store, const char *name, bool *over)
{
  static const char sql[] = "SELECT count(*)>0 AND sum(j.state IN(0,1,2,4))=0 FROM atlases a"
                            " JOIN jobs j ON j.id=a.job WHERE a.name=?1";
  int64_t is = 0;
  const int error = mo_sql_find(&store->writer, &is, sql, mo_string(name));
  *over = error == MO_OK && is != 0;
  return error;
}

int mo_atlases_sort_out(struct mo_store *store)
{
  DIR *folder = opendir(store->atlases_path);
  const struct dirent *entry;
  int error = MO_OK;
  while (folder != NULL && error == MO_OK && (entry = readdir(folder)) != NULL) {
    char name[MO_ATLAS_NAME_MAX + 1], path[PATH_MAX];
    bool is_left_over = strncmp(entry->d_name, ".tmp-", 5) == 0;
    if (read_part(entry->d_name, name))
      error = is_over(store, name, &is_left_over);
    snprintf(path, sizeof(path), "%s/%s", store->atlases_path, entry->d_name);
    if (is_left_over)
      (void)store->files->unlink(path);
  }
  if (folder != NULL)
    (void)closedir(folder);
  return error;
}
