/* disk_inside.h: what the files of a disk share: its state, and how a call takes its turn. For
 * disk*.c alone.
 *
 * Every call holds the disk's mutex from its turn to what it notes. */
#ifndef MORPHO_TESTS_STORE_DISK_INSIDE_H
#define MORPHO_TESTS_STORE_DISK_INSIDE_H

#include <pthread.h>
#include <sqlite3.h>

#include "disk.h"
#include "disk_state.h"

enum { FILES_MAX = 64 };

struct disk {
  pthread_mutex_t mutex;
  char base[256], folder[280];
  unsigned lies, cuts;
  uint64_t chance;
  long changes, stop_at, calls, fail_at, descriptors, room[2]; /* by enum disk_part */
  bool stopped, at_sync, lasting, failed;
  struct names durable, now;
  struct name_change *pending; /* in their order */
  size_t n_pending, pending_room;
  struct inode *inodes;
  struct {
    int fd; /* −1: free */
    struct inode *inode;
    char folder[240]; /* when it is one */
    int64_t at;
  } files[FILES_MAX];
  sqlite3_vfs vfs, *real;
};

enum turn { TURN_OFF, TURN_LAST, TURN_GO };

/* A call that changes nothing. False: it fails. */
bool disk_ask(struct disk *disk);
/* A change: off: it does not happen; last: it is in flight when everything stops, and its caller
 * never learns its result. */
enum turn disk_change(struct disk *disk, bool sync);

/* Takes the room of one write. False: there is none. */
bool disk_take_room(struct disk *disk, enum disk_part part);

/* The name below the state folder; "": it is not there. */
const char *disk_below(const struct disk *disk, const char *path);
/* Names that changed just now. to: renamed; inode: created, renamed. */
void disk_note(struct disk *disk, enum name_kind kind, const char *path, const char *to,
               struct inode *inode);
struct inode *disk_create(struct disk *disk, const char *path);
void disk_sync_folder(struct disk *disk, const char *folder);

int disk_vfs_start(struct disk *disk); /* SQLite's: disk_vfs.c. 0 or −1 */
void disk_vfs_end(struct disk *disk);

#endif
