/* file.c: see file.h. */
#include "base/file.h"

#include <errno.h>
#include <fcntl.h>
#include <string.h>
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
