/* disk.c: what is certain to be on the disk, and what is there after a cut.
 *
 * Names are paths below the state folder. A change of a name belongs to the folder that holds it: syncing that folder makes all of its changes
 * certain, in their order; at a cut all, none, the first ones, or any of the others have happened. A renaming happens whole or not at all, as
 * file systems with a journal promise. What is in a folder that is not there is lost.
 *
 * Data is torn at 512 bytes: every such sector of every unsynced write is there or not. The size is one that the file had since its
 * last sync, or what the sectors need; what was never written below it is zeros or stale. */
#include "disk.h"

#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <sqlite3.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "disk_state.h"
#include "fixture.h"

enum { FILES_MAX = 64 };

struct disk {
  pthread_mutex_t mutex;
  char base[256], folder[280];
  unsigned lies, cuts;
  uint64_t chance;
  long changes, stop_at, calls, fail_at, descriptors;
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
  struct mo_file_operations operations;
  sqlite3_vfs vfs, *real;
};

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

/* ---- stopping and failing ---- */

enum turn { TURN_OFF, TURN_LAST, TURN_GO };

/* A call that changes nothing. False: it fails. */
static bool ask(struct disk *disk)
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

/* A change: off: it does not happen; last: it is under way when everything stops, and its caller never hears of it. */
static enum turn change(struct disk *disk, bool sync)
{
  if (disk->stopped || !ask(disk))
    return TURN_OFF;
  disk->changes++;
  if (disk->stop_at == 0 || disk->changes < disk->stop_at || (disk->at_sync && !sync))
    return TURN_GO;
  disk->stopped = true;
  return TURN_LAST;
}

static const char *below(const struct disk *disk, const char *path)
{
  size_t n = strlen(disk->folder);
  return strncmp(path, disk->folder, n) == 0 && path[n] == '/' ? path + n + 1 : "";
}

static void note(struct disk *disk, enum name_kind kind, const char *path, const char *to, struct inode *inode)
{
  struct name_change *entry;
  if (disk->n_pending == disk->pending_room) {
    disk->pending_room = 2 * disk->pending_room + 16;
    disk->pending = realloc(disk->pending, disk->pending_room * sizeof(*disk->pending));
    if (disk->pending == NULL)
      abort();
  }
  entry = &disk->pending[disk->n_pending++];
  *entry = (struct name_change){.kind = kind, .inode = inode};
  snprintf(entry->path, sizeof(entry->path), "%s", path);
  snprintf(entry->to, sizeof(entry->to), "%s", to != NULL ? to : "");
  names_apply(&disk->now, entry);
}

static struct inode *create(struct disk *disk, const char *path)
{
  struct inode *inode = inode_new(&disk->inodes);
  note(disk, NAME_CREATED, path, NULL, inode);
  return inode;
}

static void sync_folder(struct disk *disk, const char *folder)
{
  size_t left = 0;
  for (size_t i = 0; i < disk->n_pending; i++)
    if (name_is_in(disk->pending[i].path, folder))
      names_apply(&disk->durable, &disk->pending[i]);
    else
      disk->pending[left++] = disk->pending[i];
  disk->n_pending = left;
}

/* ---- the store's own files ---- */

static int fail(int error)
{
  errno = error;
  return -1;
}

/* Ends a change that was made: the last one is not heard of. */
static int end(enum turn turn, int result)
{
  return turn == TURN_LAST ? fail(EIO) : result;
}

static int disk_open(void *context, const char *path, int flags)
{
  struct disk *disk = context;
  const char *name = below(disk, path);
  enum turn turn = TURN_GO;
  struct inode *inode;
  int fd = -1;
  size_t slot = 0;
  pthread_mutex_lock(&disk->mutex);
  inode = names_inode(&disk->now, name);
  if (disk->descriptors > 0 && --disk->descriptors == 0) {
    disk->failed = true;
    pthread_mutex_unlock(&disk->mutex);
    return fail(EMFILE);
  }
  if ((flags & O_CREAT) != 0)
    turn = change(disk, false);
  else if (disk->stopped || !ask(disk))
    turn = TURN_OFF;
  if (turn != TURN_OFF)
    fd = open(path, flags, 0600);
  while (slot < FILES_MAX && disk->files[slot].fd >= 0)
    slot++;
  if (fd >= 0 && slot < FILES_MAX) {
    if (inode == NULL && (flags & O_CREAT) != 0)
      inode = create(disk, name);
    else if (inode != NULL && (flags & O_TRUNC) != 0)
      inode_truncate(inode, 0);
    disk->files[slot].fd = fd;
    disk->files[slot].inode = inode;
    disk->files[slot].at = 0;
    snprintf(disk->files[slot].folder, sizeof(disk->files[slot].folder), "%s", name);
  }
  pthread_mutex_unlock(&disk->mutex);
  if (turn == TURN_LAST && fd >= 0) {
    (void)disk->operations.close(disk, fd);
    fd = -1;
  }
  return turn == TURN_GO ? fd : fail(EIO);
}

static size_t slot_of(const struct disk *disk, int fd)
{
  size_t slot = 0;
  while (slot < FILES_MAX && disk->files[slot].fd != fd)
    slot++;
  if (slot == FILES_MAX)
    abort();
  return slot;
}

static ssize_t disk_write(void *context, int fd, const void *bytes, size_t size)
{
  struct disk *disk = context;
  ssize_t written = -1;
  enum turn turn;
  size_t slot;
  pthread_mutex_lock(&disk->mutex);
  slot = slot_of(disk, fd);
  turn = change(disk, false);
  if (turn != TURN_OFF)
    written = write(fd, bytes, size);
  if (written > 0) {
    inode_write(disk->files[slot].inode, disk->files[slot].at, bytes, (size_t)written);
    disk->files[slot].at += written;
  }
  pthread_mutex_unlock(&disk->mutex);
  return turn == TURN_GO ? written : fail(EIO);
}

static int disk_sync(void *context, int fd)
{
  struct disk *disk = context;
  enum turn turn;
  size_t slot;
  pthread_mutex_lock(&disk->mutex);
  slot = slot_of(disk, fd);
  turn = change(disk, true);
  if (turn == TURN_GO) {
    if (disk->files[slot].inode == NULL && (disk->lies & DISK_FORGETS_FOLDERS) == 0)
      sync_folder(disk, disk->files[slot].folder);
    if (disk->files[slot].inode != NULL && (disk->lies & DISK_FORGETS_FILES) == 0)
      inode_sync(disk->files[slot].inode);
  }
  pthread_mutex_unlock(&disk->mutex);
  return turn == TURN_GO ? 0 : fail(EIO);
}

static int disk_close(void *context, int fd)
{
  struct disk *disk = context;
  pthread_mutex_lock(&disk->mutex);
  disk->files[slot_of(disk, fd)].fd = -1;
  pthread_mutex_unlock(&disk->mutex);
  return close(fd);
}

static int disk_rename(void *context, const char *from, const char *to, bool replace)
{
  struct disk *disk = context;
  enum turn turn;
  int result = -1;
  pthread_mutex_lock(&disk->mutex);
  turn = change(disk, false);
  if (turn != TURN_OFF)
    result = replace ? rename(from, to) : renameat2(AT_FDCWD, from, AT_FDCWD, to, RENAME_NOREPLACE);
  else
    errno = EIO;
  if (result == 0)
    note(disk, NAME_RENAMED, below(disk, from), below(disk, to), names_inode(&disk->now, below(disk, from)));
  pthread_mutex_unlock(&disk->mutex);
  return end(turn, result);
}

/* A removal, or a new folder. */
static int change_name(struct disk *disk, enum name_kind kind, const char *path)
{
  enum turn turn;
  int result = -1;
  pthread_mutex_lock(&disk->mutex);
  turn = change(disk, false);
  if (turn == TURN_OFF)
    errno = EIO;
  else
    result = kind == NAME_MADE ? mkdir(path, 0700) : kind == NAME_REMOVED ? unlink(path) : rmdir(path);
  if (result == 0)
    note(disk, kind, below(disk, path), NULL, NULL);
  pthread_mutex_unlock(&disk->mutex);
  return end(turn, result);
}

static int disk_unlink(void *context, const char *path)
{
  return change_name(context, NAME_REMOVED, path);
}

static int disk_mkdir(void *context, const char *path)
{
  return change_name(context, NAME_MADE, path);
}

static int disk_rmdir(void *context, const char *path)
{
  return change_name(context, NAME_FOLDER_REMOVED, path);
}

/* ---- SQLite's files ---- */

struct disk_file {
  sqlite3_file base;
  struct disk *disk;
  struct inode *inode; /* NULL: a temporary file */
  char name[240];
  sqlite3_file *real;
};

/* In place of the C library's: what is certain is in memory, and the true disk may take its time. */
__attribute__((visibility("default"))) int fsync(int fd)
{
  (void)fd;
  return 0;
}

__attribute__((visibility("default"))) int fdatasync(int fd)
{
  (void)fd;
  return 0;
}

/* SQLite syncs the folder of a new log or journal with that file's first sync, and after some removals. It asks for a folder only to sync it:
 * the default file system's call is replaced by one that also notes that. */
static int (*real_open_directory)(const char *path, int *fd);
static _Thread_local bool folder_was_synced;

static int open_directory(const char *path, int *fd)
{
  folder_was_synced = true;
  return real_open_directory(path, fd);
}

#define FILE_OF(file)                                                                                                  \
  struct disk_file *disk_file = (struct disk_file *)(file);                                                            \
  sqlite3_file *real = disk_file->real

/* Calls that change nothing on the disk: they fail on demand, and go on after a stop. */
#define PASS(name, parameters, arguments, failure)                                                                     \
  static int name parameters                                                                                           \
  {                                                                                                                    \
    FILE_OF(file);                                                                                                     \
    bool fails;                                                                                                        \
    pthread_mutex_lock(&disk_file->disk->mutex);                                                                       \
    fails = !ask(disk_file->disk);                                                                                     \
    pthread_mutex_unlock(&disk_file->disk->mutex);                                                                     \
    return fails ? (failure) : real->pMethods->name arguments;                                                         \
  }
PASS(xRead, (sqlite3_file * file, void *to, int n, sqlite3_int64 at), (real, to, n, at), SQLITE_IOERR_READ)
PASS(xFileSize, (sqlite3_file * file, sqlite3_int64 *size), (real, size), SQLITE_IOERR_FSTAT)
PASS(xShmMap, (sqlite3_file * file, int page, int size, int extend, void volatile **to), (real, page, size, extend, to),
     SQLITE_IOERR_SHMMAP)
PASS(xLock, (sqlite3_file * file, int kind), (real, kind), SQLITE_IOERR_LOCK)

#define FORWARD(name, parameters, arguments)                                                                           \
  static int name parameters                                                                                           \
  {                                                                                                                    \
    FILE_OF(file);                                                                                                     \
    return real->pMethods->name arguments;                                                                             \
  }
FORWARD(xUnlock, (sqlite3_file * file, int kind), (real, kind))
FORWARD(xCheckReservedLock, (sqlite3_file * file, int *result), (real, result))
FORWARD(xFileControl, (sqlite3_file * file, int op, void *argument), (real, op, argument))
FORWARD(xSectorSize, (sqlite3_file * file), (real))
FORWARD(xDeviceCharacteristics, (sqlite3_file * file), (real))
FORWARD(xShmLock, (sqlite3_file * file, int offset, int n, int flags), (real, offset, n, flags))
FORWARD(xShmUnmap, (sqlite3_file * file, int remove), (real, remove))
FORWARD(xClose, (sqlite3_file * file), (real))

static void xShmBarrier(sqlite3_file *file)
{
  FILE_OF(file);
  real->pMethods->xShmBarrier(real);
}

static int xWrite(sqlite3_file *file, const void *from, int n, sqlite3_int64 at)
{
  FILE_OF(file);
  struct disk *disk = disk_file->disk;
  int result = SQLITE_IOERR_WRITE;
  enum turn turn;
  pthread_mutex_lock(&disk->mutex);
  turn = change(disk, false);
  if (turn != TURN_OFF)
    result = real->pMethods->xWrite(real, from, n, at);
  if (result == SQLITE_OK && disk_file->inode != NULL)
    inode_write(disk_file->inode, at, from, (size_t)n);
  pthread_mutex_unlock(&disk->mutex);
  return turn == TURN_LAST ? SQLITE_IOERR_WRITE : result;
}

static int xTruncate(sqlite3_file *file, sqlite3_int64 size)
{
  FILE_OF(file);
  struct disk *disk = disk_file->disk;
  int result = SQLITE_IOERR_TRUNCATE;
  enum turn turn;
  pthread_mutex_lock(&disk->mutex);
  turn = change(disk, false);
  if (turn != TURN_OFF)
    result = real->pMethods->xTruncate(real, size);
  if (result == SQLITE_OK && disk_file->inode != NULL)
    inode_truncate(disk_file->inode, size);
  pthread_mutex_unlock(&disk->mutex);
  return turn == TURN_LAST ? SQLITE_IOERR_TRUNCATE : result;
}

static int xSync(sqlite3_file *file, int flags)
{
  FILE_OF(file);
  struct disk *disk = disk_file->disk;
  int result = SQLITE_IOERR_FSYNC;
  pthread_mutex_lock(&disk->mutex);
  if (change(disk, true) == TURN_GO) {
    folder_was_synced = false;
    result = real->pMethods->xSync(real, flags);
    if (result == SQLITE_OK && disk_file->inode != NULL && (disk->lies & DISK_FORGETS_DATABASE) == 0) {
      inode_sync(disk_file->inode);
      if (folder_was_synced)
        sync_folder(disk, "");
    }
  }
  pthread_mutex_unlock(&disk->mutex);
  return result;
}

static int vfs_open(sqlite3_vfs *vfs, sqlite3_filename path, sqlite3_file *file, int flags, int *out)
{
  static const sqlite3_io_methods methods = {2,
                                             xClose,
                                             xRead,
                                             xWrite,
                                             xTruncate,
                                             xSync,
                                             xFileSize,
                                             xLock,
                                             xUnlock,
                                             xCheckReservedLock,
                                             xFileControl,
                                             xSectorSize,
                                             xDeviceCharacteristics,
                                             xShmMap,
                                             xShmLock,
                                             xShmBarrier,
                                             xShmUnmap,
                                             NULL,
                                             NULL};
  struct disk_file *disk_file = (struct disk_file *)file;
  struct disk *disk = vfs->pAppData;
  const char *name = path != NULL ? below(disk, path) : "";
  bool creates = false, fails = false;
  int result = SQLITE_CANTOPEN;
  file->pMethods = NULL;
  *disk_file = (struct disk_file){.disk = disk, .real = (sqlite3_file *)(disk_file + 1)};
  snprintf(disk_file->name, sizeof(disk_file->name), "%s", name);
  memset(disk_file->real, 0, (size_t)disk->real->szOsFile);
  pthread_mutex_lock(&disk->mutex);
  if (name[0] != '\0') {
    disk_file->inode = names_inode(&disk->now, name);
    creates = disk_file->inode == NULL && (flags & SQLITE_OPEN_CREATE) != 0;
    fails = creates ? change(disk, false) != TURN_GO : disk->stopped || !ask(disk);
  }
  if (!fails)
    result = disk->real->xOpen(disk->real, path, disk_file->real, flags, out);
  if (result == SQLITE_OK && creates)
    disk_file->inode = create(disk, name);
  if (disk_file->real->pMethods != NULL)
    file->pMethods = &methods;
  pthread_mutex_unlock(&disk->mutex);
  return result;
}

static int vfs_delete(sqlite3_vfs *vfs, const char *path, int sync)
{
  struct disk *disk = vfs->pAppData;
  int result = SQLITE_IOERR_DELETE;
  enum turn turn;
  pthread_mutex_lock(&disk->mutex);
  turn = change(disk, false);
  if (turn != TURN_OFF) {
    folder_was_synced = false;
    result = disk->real->xDelete(disk->real, path, sync);
  }
  if (result == SQLITE_OK)
    note(disk, NAME_REMOVED, below(disk, path), NULL, NULL);
  if (turn == TURN_GO && folder_was_synced)
    sync_folder(disk, "");
  pthread_mutex_unlock(&disk->mutex);
  return turn == TURN_LAST ? SQLITE_IOERR_DELETE : result;
}

static int vfs_access(sqlite3_vfs *vfs, const char *path, int flags, int *result)
{
  struct disk *disk = vfs->pAppData;
  bool fails;
  pthread_mutex_lock(&disk->mutex);
  fails = !ask(disk);
  pthread_mutex_unlock(&disk->mutex);
  return fails ? SQLITE_IOERR_ACCESS : disk->real->xAccess(disk->real, path, flags, result);
}

static int vfs_randomness(sqlite3_vfs *vfs, int n, char *bytes)
{
  struct disk *disk = vfs->pAppData;
  for (int i = 0; i < n; i++)
    bytes[i] = (char)disk_random(disk);
  return n;
}

/* ---- a disk's life ---- */

static int register_vfs(struct disk *disk)
{
  disk->real = sqlite3_vfs_find(NULL);
  disk->vfs = *disk->real;
  disk->vfs.zName = "disk";
  disk->vfs.pNext = NULL;
  disk->vfs.pAppData = disk;
  disk->vfs.szOsFile = (int)sizeof(struct disk_file) + disk->real->szOsFile;
  disk->vfs.xOpen = vfs_open;
  disk->vfs.xDelete = vfs_delete;
  disk->vfs.xAccess = vfs_access;
  disk->vfs.xRandomness = vfs_randomness;
  if (real_open_directory == NULL)
    real_open_directory = (int (*)(const char *, int *))disk->real->xGetSystemCall(disk->real, "openDirectory");
  if (real_open_directory == NULL ||
      disk->real->xSetSystemCall(disk->real, "openDirectory", (sqlite3_syscall_ptr)open_directory) != SQLITE_OK)
    return -1;
  return sqlite3_vfs_register(&disk->vfs, 0) == SQLITE_OK ? 0 : -1;
}

static int make_folder(struct disk *disk)
{
  snprintf(disk->folder, sizeof(disk->folder), "%s/%u", disk->base, disk->cuts);
  return mkdir(disk->folder, 0700);
}

/* In memory, where the system has a folder for that: a disk that is busy takes seconds for so many files. */
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
  disk->operations = (struct mo_file_operations){disk_open,   disk_write, disk_sync,  disk_close, disk_rename,
                                                 disk_unlink, disk_mkdir, disk_rmdir, disk};
  for (size_t i = 0; i < FILES_MAX; i++)
    disk->files[i].fd = -1;
  if (make_base(disk) != 0) {
    free(disk);
    return NULL;
  }
  if (make_folder(disk) != 0 || register_vfs(disk) != 0) {
    disk_free(disk);
    return NULL;
  }
  return disk;
}

void disk_free(struct disk *disk)
{
  if (disk == NULL)
    return;
  (void)disk->real->xSetSystemCall(disk->real, "openDirectory", NULL);
  (void)sqlite3_vfs_unregister(&disk->vfs);
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

const struct mo_file_operations *disk_files(const struct disk *disk)
{
  return &disk->operations;
}

void disk_stop_after(struct disk *disk, long n)
{
  pthread_mutex_lock(&disk->mutex);
  disk->stop_at = n > 0 ? disk->changes + n : 0;
  disk->at_sync = false;
  pthread_mutex_unlock(&disk->mutex);
}

void disk_stop_at_sync(struct disk *disk, long n)
{
  disk_stop_after(disk, n);
  pthread_mutex_lock(&disk->mutex);
  disk->at_sync = true;
  pthread_mutex_unlock(&disk->mutex);
}

void disk_stop(struct disk *disk)
{
  pthread_mutex_lock(&disk->mutex);
  disk->stopped = true;
  pthread_mutex_unlock(&disk->mutex);
}

bool disk_has_stopped(struct disk *disk)
{
  bool stopped;
  pthread_mutex_lock(&disk->mutex);
  stopped = disk->stopped;
  pthread_mutex_unlock(&disk->mutex);
  return stopped;
}

void disk_fail_at(struct disk *disk, long n, bool lasting)
{
  pthread_mutex_lock(&disk->mutex);
  disk->fail_at = n > 0 ? disk->calls + n : 0;
  disk->failed = disk->failed && n == 0;
  disk->lasting = lasting;
  pthread_mutex_unlock(&disk->mutex);
}

void disk_lack_descriptor(struct disk *disk, long n)
{
  pthread_mutex_lock(&disk->mutex);
  disk->descriptors = n;
  disk->failed = false;
  pthread_mutex_unlock(&disk->mutex);
}

bool disk_has_failed(struct disk *disk)
{
  bool failed;
  pthread_mutex_lock(&disk->mutex);
  failed = disk->failed;
  pthread_mutex_unlock(&disk->mutex);
  return failed;
}

void disk_go_on(struct disk *disk)
{
  disk->stopped = false;
  disk->stop_at = 0;
}

/* Which of the changes that are not certain have happened. */
static void choose_names(struct disk *disk, enum disk_luck luck, struct names *names)
{
  size_t n_first = disk->n_pending > 0 ? disk_random(disk) % (disk->n_pending + 1) : 0;
  const unsigned mode = luck == DISK_WORST ? 3 : (unsigned)(disk_random(disk) % 4); /* all, first ones, some, none */
  for (size_t i = 0; i < disk->n_pending; i++)
    if (mode == 0 || (mode == 1 && i < n_first) || (mode == 2 && chance(disk, 2)))
      names_apply(names, &disk->pending[i]);
  names_drop_orphans(names);
}

/* Which sectors of the writes that are not certain are there, and how long the file is. */
static void choose_data(struct disk *disk, enum disk_luck luck, const struct inode *inode, struct content *content)
{
  const unsigned mode = luck == DISK_WORST ? 0 : (unsigned)(disk_random(disk) % 6); /* none, all, some */
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
      for (int64_t at = piece->at, end_at = piece->at + (int64_t)piece->size, next; at < end_at; at = next) {
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
  FILE *file;
  int result;
  snprintf(path, sizeof(path), "%s/%s", folder, name);
  file = fopen(path, "wb");
  if (file == NULL)
    return -1;
  result = fwrite(content->bytes, 1, (size_t)content->size, file) == (size_t)content->size ? 0 : -1;
  return fclose(file) == 0 ? result : -1;
}

int disk_cut(struct disk *disk, enum disk_luck luck)
{
  struct names after = {0};
  struct inode *inodes = NULL;
  char old[280], path[560];
  int result;
  names_copy(&after, &disk->durable);
  choose_names(disk, luck, &after);
  snprintf(old, sizeof(old), "%s", disk->folder);
  disk->cuts++;
  result = make_folder(disk);
  for (size_t i = 0; i < after.n && result == 0; i++) { /* folders come before what is in them */
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
