/* files.c: whole files, written so that a crash at any moment leaves the old file, the new one, or
 * none.
 *
 * A file is written beside its place, synced and renamed, and its folder is synced. Only then may a
 * row refer to it. */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "store/folder.h"

#define PIECE_BYTES ((size_t)1 << 20)

/* Lack of descriptors or memory is temporary, and the file is not to blame. */
static int open_error(void)
{
  return errno == EMFILE || errno == ENFILE || errno == ENOMEM ? MO_ERR_NO_MEMORY : MO_ERR_IO;
}

int mo_file_read(const char *path, size_t size, uint8_t **ret)
{
  /* O_NONBLOCK: opening a pipe must not wait for a writer. */
  int fd = open(path, O_RDONLY | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK);
  size_t filled = 0;
  uint8_t *bytes;
  struct stat status;
  if (fd < 0)
    return errno == ENOENT ? MO_ERR_NOT_FOUND : open_error();
  if (fstat(fd, &status) != 0 || (uint64_t)status.st_size != size) {
    close(fd);
    return MO_ERR_CORRUPT;
  }
  bytes = malloc(size > 0 ? size : 1);
  if (bytes == NULL) {
    close(fd);
    return MO_ERR_NO_MEMORY;
  }
  while (filled < size) {
    ssize_t n = read(fd, bytes + filled, size - filled);
    if (n < 0 && errno == EINTR)
      continue;
    if (n <= 0)
      break;
    filled += (size_t)n;
  }
  close(fd);
  if (filled < size) {
    free(bytes);
    return MO_ERR_IO;
  }
  *ret = bytes;
  return MO_OK;
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

/* ---- the system's operations ---- */

static int system_open(void *context, const char *path, int flags)
{
  (void)context;
  return open(path, flags, 0600);
}

static ssize_t system_write(void *context, int fd, const void *bytes, size_t size)
{
  (void)context;
  return write(fd, bytes, size);
}

static int system_sync(void *context, int fd)
{
  (void)context;
  return fsync(fd);
}

static int system_close(void *context, int fd)
{
  (void)context;
  return close(fd);
}

static int system_rename(void *context, const char *from, const char *to)
{
  (void)context;
  return rename(from, to);
}

static int system_unlink(void *context, const char *path)
{
  (void)context;
  return unlink(path);
}

static int system_mkdir(void *context, const char *path)
{
  (void)context;
  return mkdir(path, 0700);
}

static int system_rmdir(void *context, const char *path)
{
  (void)context;
  return rmdir(path);
}

const struct mo_file_operations *mo_file_operations_system(void)
{
  static const struct mo_file_operations operations = {.open = system_open,
                                                       .write = system_write,
                                                       .sync = system_sync,
                                                       .close = system_close,
                                                       .rename = system_rename,
                                                       .unlink = system_unlink,
                                                       .mkdir = system_mkdir,
                                                       .rmdir = system_rmdir};
  return &operations;
}

/* ---- whole files and folders ---- */

static int write_error(void)
{
  return errno == ENOSPC || errno == EDQUOT || errno == EFBIG ? MO_ERR_NO_SPACE : open_error();
}

static int write_and_sync(const struct mo_store *store, int fd, const uint8_t *bytes, size_t size)
{
  const struct mo_file_operations *files = store->files;
  size_t written = 0;
  while (written < size) {
    const size_t left = size - written;
    ssize_t n;
    if (atomic_load(&store->is_short)) /* freed space of the reserve is for urgent operations */
      return MO_ERR_NO_SPACE;
    n = files->write(files->context, fd, bytes + written, left < PIECE_BYTES ? left : PIECE_BYTES);
    if (n < 0 && errno == EINTR)
      continue;
    if (n < 0)
      return write_error();
    written += (size_t)n;
  }
  return files->sync(files->context, fd) == 0 ? MO_OK : write_error();
}

int mo_file_write(struct mo_store *store, const char *folder, const char *path,
                  const uint8_t *bytes, size_t size)
{
  const struct mo_file_operations *files = store->files;
  size_t temporary_size = strlen(folder) + 64;
  char *temporary = malloc(temporary_size);
  int fd;
  int error;
  if (temporary == NULL)
    return MO_ERR_NO_MEMORY;
  snprintf(temporary, temporary_size, "%s/.tmp-%u", folder,
           atomic_fetch_add(&store->file_counter, 1));
  fd =
      files->open(files->context, temporary, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC | O_NOFOLLOW);
  if (fd < 0) {
    error = write_error();
    free(temporary);
    return error;
  }
  error = write_and_sync(store, fd, bytes, size);
  if (files->close(files->context, fd) != 0 && error == MO_OK)
    error = write_error();
  if (error == MO_OK && files->rename(files->context, temporary, path) != 0)
    error = write_error();
  if (error != MO_OK)
    (void)files->unlink(files->context, temporary);
  free(temporary);
  return error == MO_OK ? mo_folder_sync(store, folder) : error;
}

/* A failure is fatal: a later fsync of the folder may succeed without the name that this one lost,
 * although the file is visible until then. */
int mo_folder_sync(struct mo_store *store, const char *path)
{
  const struct mo_file_operations *files = store->files;
  int fd = files->open(files->context, path, O_RDONLY | O_CLOEXEC | O_DIRECTORY);
  int error = MO_OK;
  if (fd < 0)
    error = open_error();
  else if (files->sync(files->context, fd) != 0)
    error = MO_ERR_IO;
  if (fd >= 0)
    (void)files->close(files->context, fd);
  if (error == MO_ERR_IO)
    mo_store_declare_fatal(store, "a folder of files cannot be synced");
  return error;
}

/* Also syncs a folder that exists already: the call that made it may have been killed, or may have
 * lacked a descriptor, before it synced the name. */
int mo_folder_make(struct mo_store *store, const char *parent, const char *path)
{
  if (store->files->mkdir(store->files->context, path) != 0 && errno != EEXIST)
    return write_error();
  return mo_folder_sync(store, parent);
}
