/* file.c: see file.h. */
#include "base/file.h"

#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <sys/stat.h>
#include <unistd.h>

#define PIECE_BYTES ((size_t)1 << 30) /* for one system call */

int mo_file_open(const char *path, uint64_t *size, struct mo_message *message)
{
  /* O_NONBLOCK: opening a pipe must not wait for a writer. */
  const int fd = open(path, O_RDONLY | O_CLOEXEC | O_NONBLOCK);
  if (fd < 0)
    return mo_fail(message, errno == ENOENT ? MO_ERR_NOT_FOUND : MO_ERR_IO, "cannot open %s: %s",
                   path, strerrordesc_np(errno));
  struct stat status;
  int r = MO_OK;
  if (fstat(fd, &status) < 0)
    r = mo_fail(message, MO_ERR_IO, "reading failed: %s", strerrordesc_np(errno));
  else if (!S_ISREG(status.st_mode))
    r = mo_fail(message, MO_ERR_IO, "not a regular file");
  if (r < 0) {
    close(fd);
    return r;
  }
  *size = (uint64_t)status.st_size;
  return fd;
}

int mo_file_read_at(int fd, void *buffer, uint64_t size, uint64_t offset,
                    struct mo_message *message)
{
  uint8_t *to = buffer;
  while (size > 0) {
    const ssize_t n = pread(fd, to, size < PIECE_BYTES ? size : PIECE_BYTES, (off_t)offset);
    if (n < 0 && errno == EINTR)
      continue;
    if (n < 0)
      return mo_fail(message, MO_ERR_IO, "reading failed: %s", strerrordesc_np(errno));
    if (n == 0)
      return mo_fail(message, MO_ERR_IO, "the file became shorter while it was read");
    to += n;
    offset += (uint64_t)n;
    size -= (uint64_t)n;
  }
  return MO_OK;
}

static int fail_writing(const char *path, struct mo_message *message)
{
  const int error = errno;
  return mo_fail(message, error == ENOSPC || error == EDQUOT ? MO_ERR_NO_SPACE : MO_ERR_IO,
                 "cannot write %s: %s", path, strerrordesc_np(error));
}

static int write_all(int fd, const void *buffer, size_t size)
{
  const uint8_t *from = buffer;
  while (size > 0) {
    const ssize_t n = write(fd, from, size < PIECE_BYTES ? size : PIECE_BYTES);
    if (n < 0 && errno == EINTR)
      continue;
    if (n < 0)
      return -1;
    from += n;
    size -= (size_t)n;
  }
  return 0;
}

/* Syncs the folder of a file: only then is its new name durable. */
static int sync_folder(const char *path)
{
  const char *slash = strrchr(path, '/');
  char *folder =
      slash == NULL ? strdup(".") : strndup(path, slash == path ? 1 : (size_t)(slash - path));
  if (folder == NULL)
    return -1;
  const int fd = open(folder, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  free(folder);
  if (fd < 0)
    return -1;
  const int r = fsync(fd);
  close(fd);
  return r;
}

static int write_pieces(int fd, const struct mo_file_piece *pieces, size_t n)
{
  for (size_t i = 0; i < n; i++)
    if (write_all(fd, pieces[i].bytes, pieces[i].size) < 0)
      return -1;
  return fsync(fd);
}

static int write_temporary(const struct mo_file_piece *pieces, size_t n, const char *temporary,
                           const char *path, struct mo_message *message)
{
  const int fd = open(temporary, O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0666);
  if (fd < 0)
    return fail_writing(path, message);
  int r = MO_OK;
  if (write_pieces(fd, pieces, n) < 0)
    r = fail_writing(path, message);
  if (close(fd) < 0 && r == MO_OK)
    r = fail_writing(path, message);
  if (r == MO_OK && rename(temporary, path) < 0)
    r = fail_writing(path, message);
  if (r < 0)
    unlink(temporary);
  return r;
}

int mo_file_replace(const char *path, const struct mo_file_piece *pieces, size_t n,
                    struct mo_message *message)
{
  uint64_t unique = 0;
  if (getrandom(&unique, sizeof(unique), 0) != (ssize_t)sizeof(unique))
    unique = (uint64_t)getpid();
  char *temporary = NULL;
  if (asprintf(&temporary, "%s.%016" PRIx64 ".tmp", path, unique) < 0)
    return mo_fail(message, MO_ERR_NO_MEMORY, "cannot write %s: out of memory", path);
  int r = write_temporary(pieces, n, temporary, path, message);
  if (r == MO_OK && sync_folder(path) < 0)
    r = fail_writing(path, message);
  free(temporary);
  return r;
}
