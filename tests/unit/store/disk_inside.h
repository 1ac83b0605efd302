/* disk_inside.h: the state of a simulated disk, and how a call takes its turn. Only for disk*.c.
 *
 * Every call holds the disk's mutex from taking its turn until it has recorded its changes. */
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
  struct name_change *pending; /* in order */
  size_t n_pending, pending_room;
  struct inode *inodes;
  struct {
    int fd; /* −1 = free */
    struct inode *inode;
    char folder[240]; /* if it is a folder */
    int64_t at;
  } files[FILES_MAX];
  sqlite3_vfs vfs, *real;
};

enum turn { TURN_OFF, TURN_LAST, TURN_GO };

/* Takes the turn of a call that changes nothing. Returns false if the call must fail. */
bool disk_ask(struct disk *disk);
/* Takes the turn of a change. TURN_OFF: it does not happen; TURN_LAST: it is in flight when
 * everything stops, and its caller never learns the result. */
enum turn disk_change(struct disk *disk, bool sync);

/* Uses up the room of one write. Returns false if the disk is full. */
bool disk_take_room(struct disk *disk, enum disk_part part);

/* Returns the path below the state folder; "" if it is not below it. */
const char *disk_below(const struct disk *disk, const char *path);
/* Records that names have just changed. to: for renames; inode: for creations and renames. */
void disk_note(struct disk *disk, enum name_kind kind, const char *path, const char *to,
               struct inode *inode);
struct inode *disk_create(struct disk *disk, const char *path);
void disk_sync_folder(struct disk *disk, const char *folder);

int disk_vfs_start(struct disk *disk); /* for SQLite, in disk_vfs.c; returns 0 or −1 */
void disk_vfs_end(struct disk *disk);

#endif
