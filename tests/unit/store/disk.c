/* disk.c: tracks what is guaranteed to be on the disk, and chooses what survives a power cut.
 *
 * Names are paths below the state folder. A name change belongs to the folder that contains the
 * name. Syncing that folder makes all of its changes durable, in order. At a cut, all, none, the
 * first few, or any subset of the unsynced changes have happened. A rename is atomic, as journaling
 * file systems promise. The contents of a lost folder are lost.
 *
 * Data is torn at 512 bytes: each sector of each unsynced write is either on the disk or not. The
 * size is one that the file had since its last sync, or as large as the surviving sectors need.
 * Bytes below it that were never written are zero or stale. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "disk_inside.h"
#include "fixture.h"

uint64_t disk_random(struct disk *disk)
{
  uint64_t z = disk->chance += UINT64_C(0x9E3779B97F4A7C15); /* SplitMix64 */
  z = (z ^ (z >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
  z = (z ^ (z >> 27)) * UINT64_C(0x94D049BB133111EB);
  return z ^ (z >> 31);
}

static bool chance(struct disk *disk, unsigned of)
{
  return disk_random(disk) % of == 0;
}

/* ---- stops and faults ---- */

bool disk_ask(struct disk *disk)
{
  disk->calls++;
  if (disk->fail_at > 0 && disk->calls >= disk->fail_at) {
    if (!disk->lasting)
      disk->fail_at = 0;
    disk->failed = true;
    return false;
  }
  return true;
}

enum turn disk_change(struct disk *disk, bool sync)
{
  if (disk->stopped || !disk_ask(disk))
    return TURN_OFF;
  disk->changes++;
  if (disk->stop_at == 0 || disk->changes < disk->stop_at || (disk->at_sync && !sync))
    return TURN_GO;
  disk->stopped = true;
  return TURN_LAST;
}

bool disk_take_room(struct disk *disk, enum disk_part part)
{
  const bool has_room = disk->room[part] != 0;
  disk->room[part] -= disk->room[part] > 0;
  return has_room;
}

const char *disk_below(const struct disk *disk, const char *path)
{
  size_t n = strlen(disk->folder);
  return strncmp(path, disk->folder, n) == 0 && path[n] == '/' ? path + n + 1 : "";
}

void disk_note(struct disk *disk, enum name_kind kind, const char *path, const char *to,
               struct inode *inode)
{
  if (disk->n_pending == disk->pending_room) {
    disk->pending_room = 2 * disk->pending_room + 16;
    disk->pending = disk_memory(disk->pending, disk->pending_room * sizeof(*disk->pending));
  }
  struct name_change *entry = &disk->pending[disk->n_pending++];
  *entry = (struct name_change){.kind = kind, .inode = inode};
  snprintf(entry->path, sizeof(entry->path), "%s", path);
  snprintf(entry->to, sizeof(entry->to), "%s", to != NULL ? to : "");
  names_apply(&disk->now, entry);
}

struct inode *disk_create(struct disk *disk, const char *path)
{
  struct inode *inode = inode_new(&disk->inodes);
  disk_note(disk, NAME_CREATED, path, NULL, inode);
  return inode;
}

void disk_sync_folder(struct disk *disk, const char *folder)
{
  size_t left = 0;
  for (size_t i = 0; i < disk->n_pending; i++)
    if (name_is_in(disk->pending[i].path, folder))
      names_apply(&disk->durable, &disk->pending[i]);
    else
      disk->pending[left++] = disk->pending[i];
  disk->n_pending = left;
}

/* ---- creation and end ---- */

static int make_folder(struct disk *disk)
{
  snprintf(disk->folder, sizeof(disk->folder), "%s/%u", disk->base, disk->cuts);
  return mkdir(disk->folder, 0700);
}

/* In memory, if the system has a folder for that: a busy disk takes seconds for this many files. */
static int make_base(struct disk *disk)
{
  const char *given = getenv("TMPDIR");
  const char *base = given != NULL ? given : access("/dev/shm", W_OK) == 0 ? "/dev/shm" : "/tmp";
  snprintf(disk->base, sizeof(disk->base), "%s/morpho-disk-XXXXXX", base);
  return mkdtemp(disk->base) != NULL ? 0 : -1;
}

struct disk *disk_new(uint64_t seed, unsigned lies)
{
  struct disk *disk = calloc(1, sizeof(*disk));
  if (disk == NULL)
    return NULL;
  pthread_mutex_init(&disk->mutex, NULL);
  disk->chance = seed;
  disk->lies = lies;
  disk->room[DISK_DATABASE] = disk->room[DISK_FILES] = -1;
  for (size_t i = 0; i < FILES_MAX; i++)
    disk->files[i].fd = -1;
  if (make_base(disk) != 0) {
    free(disk);
    return NULL;
  }
  if (make_folder(disk) != 0 || disk_vfs_start(disk) != 0) {
    disk_free(disk);
    return NULL;
  }
  return disk;
}

void disk_free(struct disk *disk)
{
  if (disk == NULL)
    return;
  disk_vfs_end(disk);
  fixture_remove(disk->base);
  inodes_free(&disk->inodes);
  names_free(&disk->durable);
  names_free(&disk->now);
  free(disk->pending);
  pthread_mutex_destroy(&disk->mutex);
  free(disk);
}

const char *disk_folder(const struct disk *disk)
{
  return disk->folder;
}

const char *disk_vfs(const struct disk *disk)
{
  return disk->vfs.zName;
}

/* Statements that other calls on the disk see only as a whole. */
#define LOCKED(disk, ...)                                                                          \
  do {                                                                                             \
    pthread_mutex_lock(&(disk)->mutex);                                                            \
    __VA_ARGS__;                                                                                   \
    pthread_mutex_unlock(&(disk)->mutex);                                                          \
  } while (0)

static void stop_after(struct disk *disk, long n, bool at_sync)
{
  LOCKED(disk, disk->stop_at = n > 0 ? disk->changes + n : 0; disk->at_sync = at_sync);
}

void disk_stop_after(struct disk *disk, long n)
{
  stop_after(disk, n, false);
}

void disk_stop_at_sync(struct disk *disk, long n)
{
  stop_after(disk, n, true);
}

void disk_stop(struct disk *disk)
{
  LOCKED(disk, disk->stopped = true);
}

bool disk_has_stopped(struct disk *disk)
{
  bool stopped;
  LOCKED(disk, stopped = disk->stopped);
  return stopped;
}

void disk_fail_at(struct disk *disk, long n, bool lasting)
{
  LOCKED(disk, disk->fail_at = n > 0 ? disk->calls + n : 0; disk->failed = disk->failed && n == 0;
         disk->lasting = lasting);
}

void disk_lack_descriptor(struct disk *disk, long n)
{
  LOCKED(disk, disk->descriptors = n; disk->failed = false);
}

void disk_fill_after(struct disk *disk, enum disk_part part, long n)
{
  LOCKED(disk, disk->room[part] = n);
}

bool disk_has_failed(struct disk *disk)
{
  bool failed;
  LOCKED(disk, failed = disk->failed);
  return failed;
}

void disk_go_on(struct disk *disk)
{
  disk->stopped = disk->failed = false;
  disk->stop_at = disk->fail_at = 0;
}

/* Chooses which of the uncertain changes have happened. */
static void choose_names(struct disk *disk, enum disk_luck luck, struct names *names)
{
  size_t n_first = disk->n_pending > 0 ? disk_random(disk) % (disk->n_pending + 1) : 0;
  const unsigned mode =
      luck == DISK_WORST ? 3
                         : (unsigned)(disk_random(disk) % 4); /* all, the first ones, some, none */
  for (size_t i = 0; i < disk->n_pending; i++)
    if (mode == 0 || (mode == 1 && i < n_first) || (mode == 2 && chance(disk, 2)))
      names_apply(names, &disk->pending[i]);
  names_drop_orphans(names);
}

/* Chooses which sectors of the uncertain writes are on the disk, and how long the file is. */
static void choose_data(struct disk *disk, enum disk_luck luck, const struct inode *inode,
                        struct content *content)
{
  const unsigned mode =
      luck == DISK_WORST ? 0 : (unsigned)(disk_random(disk) % 6); /* none, all, some */
  const unsigned kept = 2 + (unsigned)(disk_random(disk) % 3);
  const bool stale = chance(disk, 2);
  content_start(content, inode);
  for (size_t i = 0; i < inode->n && mode != 0; i++) {
    const struct piece *piece = &inode->pending[i];
    const bool torn = mode != 1 && chance(disk, 3);
    if (mode != 1 && disk_random(disk) % 4 >= kept - 1)
      continue;
    if (piece->bytes == NULL)
      content_truncate(content, piece->at);
    else
      for (int64_t at = piece->at, end_at = piece->at + (int64_t)piece->size, next; at < end_at;
           at = next) {
        next = at / SECTOR * SECTOR + SECTOR < end_at ? at / SECTOR * SECTOR + SECTOR : end_at;
        if (!torn || chance(disk, 2))
          content_write(content, at, piece->bytes + (at - piece->at), (size_t)(next - at));
      }
  }
  if (mode > 1 && inode->n > 0 && chance(disk, 2)) {
    const struct piece *piece = &inode->pending[disk_random(disk) % inode->n];
    const int64_t size = piece->at + (int64_t)piece->size;
    if (size > inode->size)
      content_resize(content, size);
  }
  if (stale)
    for (int64_t at = 0; at < content->size; at++)
      if (!content->written[at / SECTOR] && at >= inode->size)
        content->bytes[at] = (uint8_t)disk_random(disk);
}

static int write_out(const char *folder, const char *name, const struct content *content)
{
  char path[560];
  int result = 0;
  snprintf(path, sizeof(path), "%s/%s", folder, name);
  FILE *file = fopen(path, "wb");
  if (file == NULL)
    return -1;
  if (content->size > 0 &&
      fwrite(content->bytes, 1, (size_t)content->size, file) != (size_t)content->size)
    result = -1;
  return fclose(file) == 0 ? result : -1;
}

int disk_cut(struct disk *disk, enum disk_luck luck)
{
  struct names after = {0};
  struct inode *inodes = NULL;
  char old[280], path[560];
  names_copy(&after, &disk->durable);
  choose_names(disk, luck, &after);
  snprintf(old, sizeof(old), "%s", disk->folder);
  disk->cuts++;
  int result = make_folder(disk);
  for (size_t i = 0; i < after.n && result == 0; i++) { /* folders come before their contents */
    struct content content = {0};
    if (after.list[i].inode == NULL) {
      snprintf(path, sizeof(path), "%s/%s", disk->folder, after.list[i].path);
      result = mkdir(path, 0700);
      continue;
    }
    choose_data(disk, luck, after.list[i].inode, &content);
    result = write_out(disk->folder, after.list[i].path, &content);
    after.list[i].inode = inode_new(&inodes);
    inode_set(after.list[i].inode, &content);
  }
  inodes_free(&disk->inodes);
  names_free(&disk->durable);
  names_free(&disk->now);
  disk->inodes = inodes;
  disk->durable = after;
  names_copy(&disk->now, &after);
  disk->n_pending = 0;
  disk_go_on(disk);
  fixture_remove(old);
  return result;
}
