/* files.c: complete files, written so that a crash at any moment leaves the old file, the new file,
 * or no file.
 *
 * A file is written under a temporary name, synced and renamed, and its folder is synced. Only then
 * may a row refer to it. */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "store/folder.h"

#define PIECE_BYTES ((size_t)1 << 20)

static int read_all(int fd, size_t size, uint8_t *bytes)
{
  for (size_t filled = 0; filled < size;) {
    const ssize_t n = read(fd, bytes + filled, size - filled);
    if (n <= 0 && !(n < 0 && errno == EINTR))
      return MO_ERR_IO;
    filled += n > 0 ? (size_t)n : 0;
  }
  return MO_OK;
}

int mo_file_read(const char *path, size_t size, uint8_t **ret)
{
  /* O_NONBLOCK: opening a pipe must not wait for a writer. */
  const int fd = open(path, O_RDONLY | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK);
  uint8_t *bytes = NULL;
  struct stat status;
  int error = MO_OK;
  if (fd < 0)
    return errno == ENOENT ? MO_ERR_NOT_FOUND : mo_open_error();
  if (fstat(fd, &status) != 0 || (uint64_t)status.st_size != size)
    error = MO_ERR_CORRUPT;
  else if ((bytes = malloc(size > 0 ? size : 1)) == NULL)
    error = MO_ERR_NO_MEMORY;
  else
    error = read_all(fd, size, bytes);
  close(fd);
  if (error == MO_OK)
    *ret = bytes;
  else
    free(bytes);
  return error;
}

int mo_file_read_checked(const char *path, size_t size, const struct mo_sha256 *sha256,
                         uint8_t **ret)
{
  struct mo_sha256 found;
  int error = mo_file_read(path, size, ret);
  if (error != MO_OK)
    return error == MO_ERR_NOT_FOUND ? MO_ERR_CORRUPT : error;
  mo_sha256_of(*ret, size, &found);
  if (mo_sha256_equal(&found, sha256))
    return MO_OK;
  free(*ret);
  *ret = NULL;
  return MO_ERR_CORRUPT;
}

/* ---- writing ---- */

static int write_and_sync(const struct mo_store *store, int fd, const uint8_t *bytes, size_t size)
{
  const struct mo_file_operations *files = store->files;
  size_t written = 0;
  while (written < size) {
    const size_t left = size - written;
    ssize_t n;
    if (atomic_load(&store->is_short)) /* the freed reserve is for urgent operations only */
      return MO_ERR_NO_SPACE;
    n = files->write(fd, bytes + written, left < PIECE_BYTES ? left : PIECE_BYTES);
    if (n < 0 && errno == EINTR)
      continue;
    if (n < 0)
      return mo_file_error();
    written += (size_t)n;
  }
  return files->sync(fd) == 0 ? MO_OK : mo_file_error();
}

/* Returns whether a file has these bytes. */
static bool has_bytes(const char *path, const uint8_t *bytes, size_t size)
{
  uint8_t *there = NULL;
  const bool same =
      mo_file_read(path, size, &there) == MO_OK && there != NULL && memcmp(there, bytes, size) == 0;
  free(there);
  return same;
}

int mo_file_write(struct mo_store *store, const char *folder, const char *path,
                  const uint8_t *bytes, size_t size)
{
  return mo_file_write_checked(store, folder, path, bytes, size, NULL, NULL);
}

int mo_file_write_checked(struct mo_store *store, const char *folder, const char *path,
                          const uint8_t *bytes, size_t size,
                          int (*check)(void *context, const char *path), void *context)
{
  const struct mo_file_operations *files = store->files;
  char *temporary;
  /* A crash may have left the file without its row. */
  if (check == NULL && has_bytes(path, bytes, size))
    return mo_folder_sync(store, folder);
  if (asprintf(&temporary, "%s/.tmp-%u", folder, atomic_fetch_add(&store->file_counter, 1)) < 0)
    return MO_ERR_NO_MEMORY;
  int fd = files->open(temporary, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC | O_NOFOLLOW, 0600);
  int error = fd < 0 ? mo_file_error() : write_and_sync(store, fd, bytes, size);
  if (fd >= 0 && files->close(fd) != 0 && error == MO_OK)
    error = mo_file_error();
  if (error == MO_OK && check != NULL)
    error = check(context, temporary);
  if (error == MO_OK && files->rename(temporary, path) != 0)
    error = mo_file_error();
  if (error != MO_OK && fd >= 0)
    (void)files->unlink(temporary);
  free(temporary);
  return error == MO_OK ? mo_folder_sync(store, folder) : error;
}

/* A failure is fatal: a later fsync of the folder may succeed without writing the name that this
 * one lost, although the file is visible until then. */
int mo_folder_sync(struct mo_store *store, const char *path)
{
  const struct mo_file_operations *files = store->files;
  int fd = files->open(path, O_RDONLY | O_CLOEXEC | O_DIRECTORY);
  int error = MO_OK;
  if (fd < 0)
    error = mo_open_error();
  else if (files->sync(fd) != 0)
    error = MO_ERR_IO;
  if (fd >= 0)
    (void)files->close(fd);
  if (error == MO_ERR_IO)
    mo_store_declare_fatal(store, "cannot sync a folder of data files");
  return error;
}

/* Also syncs a folder that already exists: the call that created it may have been killed, or may
 * have run out of descriptors, before it synced the name. */
int mo_folder_make(struct mo_store *store, const char *parent, const char *path)
{
  if (store->files->mkdir(path, 0700) != 0 && errno != EEXIST)
    return mo_file_error();
  return mo_folder_sync(store, parent);
}
