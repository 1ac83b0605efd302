/* disk_vfs.c: SQLite's files on a simulated disk: a VFS on top of the default one. */
#include <stdio.h>
#include <string.h>
#include <unistd.h>

#include "disk_inside.h"

/* Data stored before the default VFS's file. */
struct disk_file {
  struct disk *disk;
  struct inode *inode; /* NULL for a temporary file */
  const sqlite3_io_methods *real;
  sqlite3_io_methods methods; /* the default methods, except for those that take a turn */
};

/* Replaces the C library's function: durable data is kept in memory, so the real disk need not
 * sync. */
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

/* SQLite syncs the folder of a new log or journal with that file's first sync, and after some
 * removals. SQLite opens a folder only to sync it. The default VFS's system call is therefore
 * replaced by one that also records the sync. */
static int (*real_open_directory)(const char *path, int *fd);
static _Thread_local bool folder_was_synced;

static int open_directory(const char *path, int *fd)
{
  folder_was_synced = true;
  return real_open_directory(path, fd);
}

static struct disk_file *beside(sqlite3_file *file)
{
  return (struct disk_file *)((char *)file + sqlite3_vfs_find(NULL)->szOsFile);
}

/* Calls that change nothing on the disk: they can fail on demand, and still work after a stop. */
#define PASS(name, parameters, arguments, failure)                                                 \
  static int name parameters                                                                       \
  {                                                                                                \
    struct disk_file *disk_file = beside(file);                                                    \
    bool fails;                                                                                    \
    pthread_mutex_lock(&disk_file->disk->mutex);                                                   \
    fails = !disk_ask(disk_file->disk);                                                            \
    pthread_mutex_unlock(&disk_file->disk->mutex);                                                 \
    return fails ? (failure) : disk_file->real->name arguments;                                    \
  }
PASS(xRead, (sqlite3_file * file, void *to, int n, sqlite3_int64 at), (file, to, n, at),
     SQLITE_IOERR_READ)
PASS(xFileSize, (sqlite3_file * file, sqlite3_int64 *size), (file, size), SQLITE_IOERR_FSTAT)
PASS(xShmMap, (sqlite3_file * file, int page, int size, int extend, void volatile **to),
     (file, page, size, extend, to), SQLITE_IOERR_SHMMAP)
PASS(xLock, (sqlite3_file * file, int kind), (file, kind), SQLITE_IOERR_LOCK)

static int xWrite(sqlite3_file *file, const void *from, int n, sqlite3_int64 at)
{
  struct disk_file *disk_file = beside(file);
  struct disk *disk = disk_file->disk;
  int result = SQLITE_FULL;
  enum turn turn = TURN_OFF;
  pthread_mutex_lock(&disk->mutex);
  if (disk_take_room(disk, DISK_DATABASE)) {
    result = SQLITE_IOERR_WRITE;
    turn = disk_change(disk, false);
  }
  if (turn != TURN_OFF)
    result = disk_file->real->xWrite(file, from, n, at);
  if (result == SQLITE_OK && disk_file->inode != NULL)
    inode_write(disk_file->inode, at, from, (size_t)n);
  pthread_mutex_unlock(&disk->mutex);
  return turn == TURN_LAST ? SQLITE_IOERR_WRITE : result;
}

static int xTruncate(sqlite3_file *file, sqlite3_int64 size)
{
  struct disk_file *disk_file = beside(file);
  struct disk *disk = disk_file->disk;
  int result = SQLITE_IOERR_TRUNCATE;
  pthread_mutex_lock(&disk->mutex);
  enum turn turn = disk_change(disk, false);
  if (turn != TURN_OFF)
    result = disk_file->real->xTruncate(file, size);
  if (result == SQLITE_OK && disk_file->inode != NULL)
    inode_truncate(disk_file->inode, size);
  pthread_mutex_unlock(&disk->mutex);
  return turn == TURN_LAST ? SQLITE_IOERR_TRUNCATE : result;
}

static int xSync(sqlite3_file *file, int flags)
{
  struct disk_file *disk_file = beside(file);
  struct disk *disk = disk_file->disk;
  int result = SQLITE_IOERR_FSYNC;
  pthread_mutex_lock(&disk->mutex);
  if (disk_change(disk, true) == TURN_GO) {
    folder_was_synced = false;
    result = disk_file->real->xSync(file, flags);
    if (result == SQLITE_OK && disk_file->inode != NULL &&
        (disk->lies & DISK_FORGETS_DATABASE) == 0) {
      inode_sync(disk_file->inode);
      if (folder_was_synced)
        disk_sync_folder(disk, "");
    }
  }
  pthread_mutex_unlock(&disk->mutex);
  return result;
}

static int vfs_open(sqlite3_vfs *vfs, sqlite3_filename path, sqlite3_file *file, int flags,
                    int *out)
{
  struct disk_file *disk_file = beside(file);
  struct disk *disk = vfs->pAppData;
  const char *name = path != NULL ? disk_below(disk, path) : "";
  bool creates = false, fails = false;
  int result = SQLITE_CANTOPEN;
  file->pMethods = NULL;
  *disk_file = (struct disk_file){.disk = disk};
  pthread_mutex_lock(&disk->mutex);
  if (name[0] != '\0') {
    disk_file->inode = names_inode(&disk->now, name);
    creates = disk_file->inode == NULL && (flags & SQLITE_OPEN_CREATE) != 0;
    fails = creates ? disk_change(disk, false) != TURN_GO : disk->stopped || !disk_ask(disk);
  }
  if (!fails)
    result = disk->real->xOpen(disk->real, path, file, flags, out);
  if (result == SQLITE_OK && creates)
    disk_file->inode = disk_create(disk, name);
  if (file->pMethods != NULL) {
    disk_file->real = file->pMethods;
    disk_file->methods = *file->pMethods;
    disk_file->methods.iVersion = 2; /* no memory maps, because they would write unseen */
    disk_file->methods.xRead = xRead;
    disk_file->methods.xWrite = xWrite;
    disk_file->methods.xTruncate = xTruncate;
    disk_file->methods.xSync = xSync;
    disk_file->methods.xFileSize = xFileSize;
    disk_file->methods.xLock = xLock;
    disk_file->methods.xShmMap = xShmMap;
    file->pMethods = &disk_file->methods;
  }
  pthread_mutex_unlock(&disk->mutex);
  return result;
}

static int vfs_delete(sqlite3_vfs *vfs, const char *path, int sync)
{
  struct disk *disk = vfs->pAppData;
  int result = SQLITE_IOERR_DELETE;
  pthread_mutex_lock(&disk->mutex);
  enum turn turn = disk_change(disk, false);
  if (turn != TURN_OFF) {
    folder_was_synced = false;
    result = disk->real->xDelete(disk->real, path, sync);
  }
  if (result == SQLITE_OK)
    disk_note(disk, NAME_REMOVED, disk_below(disk, path), NULL, NULL);
  if (turn == TURN_GO && folder_was_synced)
    disk_sync_folder(disk, "");
  pthread_mutex_unlock(&disk->mutex);
  return turn == TURN_LAST ? SQLITE_IOERR_DELETE : result;
}

static int vfs_access(sqlite3_vfs *vfs, const char *path, int flags, int *result)
{
  struct disk *disk = vfs->pAppData;
  pthread_mutex_lock(&disk->mutex);
  bool fails = !disk_ask(disk);
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

int disk_vfs_start(struct disk *disk)
{
  disk->real = sqlite3_vfs_find(NULL);
  disk->vfs = *disk->real;
  disk->vfs.zName = "disk";
  disk->vfs.pNext = NULL;
  disk->vfs.pAppData = disk;
  disk->vfs.szOsFile = disk->real->szOsFile + (int)sizeof(struct disk_file);
  disk->vfs.xOpen = vfs_open;
  disk->vfs.xDelete = vfs_delete;
  disk->vfs.xAccess = vfs_access;
  disk->vfs.xRandomness = vfs_randomness;
  if (real_open_directory == NULL)
    real_open_directory =
        (int (*)(const char *, int *))disk->real->xGetSystemCall(disk->real, "openDirectory");
  if (real_open_directory == NULL ||
      disk->real->xSetSystemCall(disk->real, "openDirectory",
                                 (sqlite3_syscall_ptr)open_directory) != SQLITE_OK)
    return -1;
  return sqlite3_vfs_register(&disk->vfs, 0) == SQLITE_OK ? 0 : -1;
}

void disk_vfs_end(struct disk *disk)
{
  (void)disk->real->xSetSystemCall(disk->real, "openDirectory", NULL);
  (void)sqlite3_vfs_unregister(&disk->vfs);
}
