/* mapping.c: allocates disk space for the file that SQLite maps.
 *
 * SQLite extends its log's index by writing one byte per 4 KiB, and then writes to the index
 * through a mapping. On a file system with smaller blocks, the rest of the file is holes, and on a
 * full disk a write to a hole kills the process with SIGBUS. The functions below allocate the space
 * before the mapping, so that a full disk becomes an ordinary error. */
#include <errno.h>
#include <fcntl.h>
#include <sys/mman.h>

#include "store/internal.h"

static _Thread_local int map_error; /* of this thread's last mapping; SQLite does not keep it */

static void *map_with_room(void *at, size_t size, int protection, int flags, int fd, off_t offset)
{
  void *mapped = MAP_FAILED;
  map_error = (flags & MAP_SHARED) != 0 && (protection & PROT_WRITE) != 0
                  ? posix_fallocate(fd, offset, (off_t)size)
                  : 0;
  if (map_error != ENOSPC &&
      map_error != EDQUOT) { /* other errors mean that the file system cannot allocate space */
    mapped = mmap(at, size, protection, flags, fd, offset);
    map_error = mapped == MAP_FAILED ? errno : 0;
  }
  if (map_error != 0)
    errno = map_error;
  return mapped;
}

static void install(void)
{
  sqlite3_vfs *vfs = sqlite3_vfs_find("unix");
  if (vfs != NULL && vfs->iVersion >= 3)
    (void)vfs->xSetSystemCall(vfs, "mmap", (sqlite3_syscall_ptr)map_with_room);
}

void mo_mapping_init(void)
{
  static pthread_once_t once = PTHREAD_ONCE_INIT;
  pthread_once(&once, install);
}

int mo_mapping_error(void)
{
  return map_error == ENOSPC || map_error == EDQUOT ? MO_ERR_NO_SPACE
         : map_error == ENOMEM                      ? MO_ERR_NO_MEMORY
                                                    : MO_ERR_IO;
}
