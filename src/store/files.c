/* files.c: whole files, written so that a crash at any moment leaves the old file, the new one, or none.
 *
 * A file is written beside its place, synced, renamed, and its folder synced. Only then may a row speak of it. */
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "store/internal.h"

int mo_file_read(const char *path, size_t size, uint8_t **ret)
{
  int fd = open(path, O_RDONLY | O_CLOEXEC);
  size_t filled = 0;
  uint8_t *bytes;
  struct stat status;
  if (fd < 0) /* want of descriptors or memory passes: the file is as good as it was */
    return errno == ENOENT                                         ? MO_ERR_NOT_FOUND
           : errno == EMFILE || errno == ENFILE || errno == ENOMEM ? MO_ERR_NO_MEMORY
                                                                   : MO_ERR_IO;
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

static int write_error(void)
{
  return errno == ENOSPC || errno == EDQUOT || errno == EFBIG ? MO_ERR_NO_SPACE : MO_ERR_IO;
}

static int write_and_sync(int fd, const uint8_t *bytes, size_t size)
{
  size_t written = 0;
  while (written < size) {
    ssize_t n = write(fd, bytes + written, size - written);
    if (n < 0 && errno == EINTR)
      continue;
    if (n < 0)
      return write_error();
    written += (size_t)n;
  }
  return fsync(fd) == 0 ? MO_OK : write_error();
}

static int sync_folder(const char *path)
{
  int fd = open(path, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  int error = MO_OK;
  if (fd < 0)
    return errno == EMFILE || errno == ENFILE || errno == ENOMEM ? MO_ERR_NO_MEMORY : MO_ERR_IO;
  if (fsync(fd) != 0)
    error = MO_ERR_IO;
  close(fd);
  return error;
}

int mo_file_write(struct mo_store *store, const char *folder, const char *path, const uint8_t *bytes, size_t size)
{
  size_t temporary_size = strlen(folder) + 64;
  char *temporary = malloc(temporary_size);
  int fd;
  int error;
  if (temporary == NULL)
    return MO_ERR_NO_MEMORY;
  snprintf(temporary, temporary_size, "%s/.tmp-%u", folder, atomic_fetch_add(&store->file_counter, 1));
  fd = open(temporary, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
  if (fd < 0) {
    error = write_error();
    free(temporary);
    return error;
  }
  error = write_and_sync(fd, bytes, size);
  if (close(fd) != 0 && error == MO_OK)
    error = write_error();
  if (error == MO_OK && rename(temporary, path) != 0)
    error = write_error();
  if (error != MO_OK)
    (void)unlink(temporary);
  free(temporary);
  return error == MO_OK ? mo_folder_sync(store, folder) : error;
}

/* A later fsync of the folder may succeed without the name that this one lost, and the file is there for who looks. */
int mo_folder_sync(struct mo_store *store, const char *path)
{
  int error = sync_folder(path);
  if (error == MO_ERR_IO)
    mo_store_declare_fatal(store, "a folder of files cannot be synced");
  return error;
}

int mo_folder_make(struct mo_store *store, const char *parent, const char *path)
{
  if (mkdir(path, 0700) == 0)
    return mo_folder_sync(store, parent);
  return errno == EEXIST ? MO_OK : write_error();
}

int mo_folder_clean(const char *path, bool (*keep)(void *context, const char *name), void *context)
{
  struct dirent *entry;
  DIR *folder = opendir(path);
  if (folder == NULL)
    return MO_ERR_IO;
  while ((entry = readdir(folder)) != NULL) /* NOLINT(concurrency-mt-unsafe): the stream is this thread's own */
    if (strncmp(entry->d_name, ".tmp-", 5) == 0 ||
        (keep != NULL && entry->d_name[0] != '.' && !keep(context, entry->d_name)))
      (void)unlinkat(dirfd(folder), entry->d_name, 0);
  closedir(folder);
  return MO_OK;
}
