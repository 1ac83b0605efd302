/* disk.h: a disk whose power can fail, below SQLite and below the files that the store writes
 * itself.
 *
 * The system's files are used as they are; beside them the disk keeps what is certain to be on it.
 * Data: what a file held at its last sync, and every write and truncation since. Names: every
 * creation, renaming and removal in a folder since the folder's last sync. When the power fails,
 * certain things stay; of the others anything may be there, whole, in part, or not at all. */
#ifndef MORPHO_TESTS_STORE_DISK_H
#define MORPHO_TESTS_STORE_DISK_H

#include <stdbool.h>
#include <stdint.h>

#include "store/files.h"

struct disk;

/* What it says to have synced and has not. */
enum disk_lie {
  DISK_HONEST = 0,
  DISK_FORGETS_DATABASE = 1,
  DISK_FORGETS_FILES = 2,
  DISK_FORGETS_FOLDERS = 4
};

struct disk *disk_new(uint64_t seed,
                      unsigned lies); /* with an empty state folder; NULL: it cannot be made */
void disk_free(struct disk *disk);    /* NULL-safe; the store is closed */
const char *disk_folder(const struct disk *disk); /* the state folder: another one after a cut */
const char *disk_vfs(const struct disk *disk);
/* The store's own files on a disk: on one at a time. */
const struct mo_file_operations *disk_files(struct disk *disk);
uint64_t disk_random(struct disk *disk); /* all chances are drawn from the seed */

/* After `n` changes from now on (writes, truncations, syncs, creations, renamings, removals)
 * everything fails; the nth is in flight. 0: none. */
void disk_stop_after(struct disk *disk, long n);
void disk_stop_at_sync(struct disk *disk, long n); /* the first sync at or after that */
void disk_stop(struct disk *disk);                 /* now: nothing is in flight */
bool disk_has_stopped(struct disk *disk);
/* The `n`th call from now on (reads and questions too) fails with an I/O error, or with `lasting`
 * all from there on. 0: none. */
void disk_fail_at(struct disk *disk, long n, bool lasting);
/* The `n`th opening of a file or folder by the store itself from now on finds no descriptor. 0:
 * none. */
void disk_lack_descriptor(struct disk *disk, long n);
bool disk_has_failed(struct disk *disk); /* it came to that */
/* After `n` more writes of the database, or creations, renamings and writes of the store's own
 * files, there is no room for those. Negative: there is. */
enum disk_part { DISK_DATABASE, DISK_FILES };
void disk_fill_after(struct disk *disk, enum disk_part part, long n);

/* After a stop, with the store closed: the process was killed, the machine goes on. */
void disk_go_on(struct disk *disk);
/* At any time with the store closed: the power fails and comes back. 0 or −1. */
enum disk_luck { DISK_ANY, DISK_WORST /* nothing but what is certain */ };
int disk_cut(struct disk *disk, enum disk_luck luck);

#endif
