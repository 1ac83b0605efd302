/* files.c: see files.h. */
#include "base/files.h"

#include <morpho/error.h>

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <sys/stat.h>
#include <unistd.h>

/* Renames by link and unlink if necessary: some file systems, such as network file systems, support
 * only links. */
static int rename_new(const char *from, const char *to)
{
  if (renameat2(AT_FDCWD, from, AT_FDCWD, to, RENAME_NOREPLACE) == 0)
    return 0;
  if (errno != EINVAL && errno != ENOSYS)
    return -1;
  return link(from, to) == 0 ? unlink(from) : -1;
}

const struct mo_file_operations mo_system_files = {open,       write,  fsync, close, rename,
                                                   rename_new, unlink, mkdir, rmdir};

int mo_open_error(void)
{
  return errno == EMFILE || errno == ENFILE || errno == ENOMEM ? MO_ERR_NO_MEMORY : MO_ERR_IO;
}

int mo_file_error(void)
{
  return errno == ENOSPC || errno == EDQUOT || errno == EFBIG ? MO_ERR_NO_SPACE : mo_open_error();
}

int mo_file_read_at(int fd, uint64_t from, size_t size, void *bytes)
{
  for (size_t filled = 0; filled < size;) {
    const ssize_t n = pread(fd, (uint8_t *)bytes + filled, size - filled, (off_t)(from + filled));
    if (n == 0)
      return MO_ERR_CORRUPT;
    if (n < 0 && errno != EINTR)
      return MO_ERR_IO;
    filled += n > 0 ? (size_t)n : 0;
  }
  return MO_OK;
}
