/* disk.h: a simulated disk that can lose power. It lies below SQLite and below the files that the
 * store writes itself.
 *
 * It uses ordinary files of the system, and keeps a record of what is durable. Data: the contents
 * of a file at its last sync, and every write and truncation since. Names: every creation, rename
 * and removal in a folder since the folder's last sync. When the power fails, durable things stay.
 * Anything else may survive whole, in part, or not at all. */
#ifndef MORPHO_TESTS_STORE_DISK_H
#define MORPHO_TESTS_STORE_DISK_H

#include <stdbool.h>
#include <stdint.h>

#include "base/files.h"

struct disk;

/* Parts for which the disk claims to have synced and has not. */
enum disk_lie {
  DISK_HONEST = 0,
  DISK_FORGETS_DATABASE = 1,
  DISK_FORGETS_FILES = 2,
  DISK_FORGETS_FOLDERS = 4
};

struct disk *disk_new(uint64_t seed,
                      unsigned lies); /* with an empty state folder; NULL if it cannot be created */
void disk_free(struct disk *disk);    /* NULL-safe; the store must be closed */
const char *
disk_folder(const struct disk *disk); /* path of the state folder, which changes after a cut */
const char *disk_vfs(const struct disk *disk);
/* Puts the store's own files on a disk; one disk at a time. */
const struct mo_file_operations *disk_files(struct disk *disk);
uint64_t disk_random(struct disk *disk); /* all random choices are drawn from this seed */

/* Everything fails after `n` more changes (writes, truncations, syncs, creations, renames,
 * removals); the nth is in flight. 0 = never. */
void disk_stop_after(struct disk *disk, long n);
void disk_stop_at_sync(struct disk *disk, long n); /* the same, at the first sync from there on */
void disk_stop(struct disk *disk);                 /* now; nothing is in flight */
bool disk_has_stopped(struct disk *disk);
/* The `n`th call from now on (including reads and queries) fails with an I/O error; with `lasting`,
 * so do all calls after it. 0 = never. */
void disk_fail_at(struct disk *disk, long n, bool lasting);
/* The `n`th time that the store itself opens a file or folder, no descriptor is available. 0 =
 * never. */
void disk_lack_descriptor(struct disk *disk, long n);
bool disk_has_failed(struct disk *disk); /* whether that fault has occurred */
/* After `n` more writes to the database, or creations, renames and writes of the store's own files,
 * the disk is full for that part. Negative = never. */
enum disk_part { DISK_DATABASE, DISK_FILES };
void disk_fill_after(struct disk *disk, enum disk_part part, long n);

/* After a stop, with the store closed: the process was killed, but the machine keeps running. */
void disk_go_on(struct disk *disk);
/* At any time with the store closed: the power fails and comes back. Returns 0 or −1. */
enum disk_luck { DISK_ANY, DISK_WORST /* only durable data survives */ };
int disk_cut(struct disk *disk, enum disk_luck luck);

#endif
