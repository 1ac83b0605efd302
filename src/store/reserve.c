/* reserve.c: a little room that is set aside, so that people can still say "cancel" when the disk is full.
 *
 * A file of 512 KiB holds the room. A change of a job's state that finds none gives it back and tries once more; the writer sets
 * it aside again when there is room. On file systems that compress or share blocks it may hold less than its size. */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "store/internal.h"

#define RESERVE_BYTES (512 << 10)
#define EVERY_US      INT64_C(5000000)

static bool is_there(const char *path)
{
  struct stat status;
  return stat(path, &status) == 0 && status.st_size == RESERVE_BYTES;
}

void mo_reserve_make(struct mo_store *store)
{
  int64_t now = mo_monotonic_us();
  int fd;
  bool whole;
  if (atomic_load(&store->reserve_held) || (store->reserve_us != 0 && now - store->reserve_us < EVERY_US))
    return;
  store->reserve_us = now;
  whole = is_there(store->reserve_path);
  if (!whole) {
    fd = open(store->reserve_path, O_WRONLY | O_CREAT | O_CLOEXEC, 0600);
    if (fd < 0)
      return;
    whole = posix_fallocate(fd, 0, RESERVE_BYTES) == 0;
    close(fd);
    if (!whole)
      (void)unlink(store->reserve_path);
  }
  atomic_store(&store->reserve_held, whole);
}

bool mo_reserve_use(struct mo_store *store)
{
  return atomic_exchange(&store->reserve_held, false) && unlink(store->reserve_path) == 0;
}
