/* reserve.c: disk space that is set aside, so that clients can still pause, cancel and delete when
 * the disk is full.
 *
 * The reserve is a file of 4 MiB; a change of a job's state takes some 20 KiB of the log. An urgent
 * operation that fails for lack of space frees a slice of the file and runs again. From then on the
 * store is short of space: only urgent operations may change anything, no file is written, and the
 * log is not copied into the database. Otherwise the jobs, which retry their writes every second,
 * would take the slice.
 *
 * That ends when the file is whole again, which has priority over all that waits for space. A
 * restart does not end it: an opening that cannot make the file whole starts short of space. An
 * opening frees small pieces for its own writes. It never frees the last slice, which is for
 * clients, however often the process restarts. On file systems that compress or share blocks the
 * file may hold less than its size. */
#include <errno.h>
#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include "store/internal.h"

#include "base/clock.h"

#define RESERVE_BYTES ((off_t)4 << 20)
#define SLICE_BYTES   ((off_t)256 << 10)
#define PIECE_BYTES   ((off_t)8 << 10) /* a page with its header, on two blocks of a disk */
#define PIECES_MAX    128              /* 1 MiB in one opening */
#define EVERY_US      INT64_C(5000000)
#define SHORT_US      INT64_C(100000) /* while writes wait for it */

static int open_reserve(const struct mo_store *store, int flags, off_t *size)
{
  struct stat status;
  int fd = open(store->reserve_path, O_WRONLY | O_CLOEXEC | O_NOFOLLOW | flags, 0600);
  if (fd < 0)
    return -1;
  if (fstat(fd, &status) != 0) {
    close(fd);
    return -1;
  }
  *size = status.st_size;
  return fd;
}

/* Makes the file whole. Returns 0 or the errno of posix_fallocate() or open(). */
static int make_whole(const struct mo_store *store)
{
  off_t size = 0;
  int error;
  int fd = open_reserve(store, O_CREAT, &size);
  if (fd < 0)
    return errno;
  error = posix_fallocate(
      fd, 0, RESERVE_BYTES); /* also at full size: in a copy of the folder it may be holes */
  if (error != 0 || size > RESERVE_BYTES) /* give back what a failed call took */
    (void)ftruncate(fd, error != 0 ? size : RESERVE_BYTES);
  close(fd);
  return error;
}

void mo_reserve_make(struct mo_store *store)
{
  const bool is_short = atomic_load(&store->is_short);
  int64_t now = mo_clock_us();
  int error;
  if (store->reserve_whole ||
      (store->reserve_us != 0 && now - store->reserve_us < (is_short ? SHORT_US : EVERY_US)))
    return;
  store->reserve_us = now;
  error = make_whole(store);
  store->reserve_whole = error == 0;
  if (error == 0 ||
      error == EFBIG) { /* a limit on file sizes does not pass, as lack of space does */
    atomic_store(&store->is_short, false);
  } else if (error == ENOSPC || error == EDQUOT) {
    atomic_store(&store->is_short, true);
    atomic_store(&store->no_space, true);
  }
}

static bool cut(struct mo_store *store, off_t bytes, off_t kept)
{
  off_t size = 0;
  bool was_cut;
  int fd = open_reserve(store, 0, &size);
  store->reserve_whole = false;
  if (fd < 0)
    return false;
  was_cut = size > kept && ftruncate(fd, size - bytes > kept ? size - bytes : kept) == 0;
  close(fd);
  if (was_cut) {
    atomic_store(&store->is_short, true);
    atomic_store(&store->no_space, true);
  }
  return was_cut;
}

bool mo_reserve_cut(struct mo_store *store)
{
  return cut(store, SLICE_BYTES, 0);
}

bool mo_reserve_cut_piece(struct mo_store *store)
{
  if (store->pieces_cut == PIECES_MAX)
    return false;
  store->pieces_cut++;
  return cut(store, PIECE_BYTES, SLICE_BYTES);
}
