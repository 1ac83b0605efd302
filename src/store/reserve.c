/* reserve.c: disk space that is set aside so that, on a full disk, clients can still pause, cancel
 * and delete, and the service can start.
 *
 * The reserve is a file of 4 MiB; a change of a job's state takes about 20 KiB of the log. An
 * urgent operation that fails for lack of space empties the file and is rerun. From then on, the
 * store is short of space, even after a restart: only urgent operations may change anything, no
 * file is written, and the log is not copied into the database. Otherwise the jobs, which retry
 * their writes every second, would use up the space. This state ends when the file is restored. */
#include <errno.h>
#include <fcntl.h>
#include <unistd.h>

#include "store/internal.h"

#include "base/clock.h"

#define RESERVE_BYTES ((off_t)4 << 20)
#define RETRY_US      INT64_C(100000)

void mo_reserve_make(struct mo_store *store)
{
  const int64_t now = mo_clock_us();
  if (store->reserve_whole || now < store->next_reserve_us)
    return;
  store->next_reserve_us = now + RETRY_US;
  int fd = open(store->reserve_path, O_WRONLY | O_CREAT | O_CLOEXEC | O_NOFOLLOW, 0600);
  /* This also fills holes, which the file may have in a copy of the folder. */
  int error = fd < 0 ? errno : posix_fallocate(fd, 0, RESERVE_BYTES);
  if (fd >= 0 && error != 0)
    (void)ftruncate(fd, 0); /* release what the failed call allocated */
  if (fd >= 0)
    close(fd);
  store->reserve_whole = error == 0;
  bool is_full = error == ENOSPC || error == EDQUOT;
  atomic_store(&store->is_short, is_full);
  if (is_full)
    atomic_store(&store->no_space, true);
}

bool mo_reserve_free(struct mo_store *store)
{
  store->reserve_whole = false;
  if (truncate(store->reserve_path, 0) != 0)
    return false;
  atomic_store(&store->is_short, true);
  atomic_store(&store->no_space, true);
  return true;
}
