/* disk_files.c: the store's own files on a simulated disk: the table of file operations. */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <unistd.h>

#include "disk_inside.h"

static struct disk *disk; /* the disk that the store of this process writes to */

/* Takes the turn of a change; sets errno in case the change fails. */
static enum turn change(bool is_sync, bool needs_room)
{
  errno = ENOSPC;
  if (needs_room && !disk_take_room(disk, DISK_FILES))
    return TURN_OFF;
  errno = EIO;
  return disk_change(disk, is_sync);
}

/* Ends a call that holds the mutex. The caller of the last change gets no result. */
static int end(enum turn turn, ssize_t result)
{
  pthread_mutex_unlock(&disk->mutex);
  if (turn == TURN_LAST)
    errno = EIO;
  return turn == TURN_GO ? (int)result : -1;
}

static size_t slot_of(int fd)
{
  size_t slot = 0;
  while (slot < FILES_MAX && disk->files[slot].fd != fd)
    slot++;
  if (slot == FILES_MAX)
    abort();
  return slot;
}

static int disk_open(const char *path, int flags, ...)
{
  const char *name = disk_below(disk, path);
  enum turn turn = TURN_GO;
  int fd = -1;
  pthread_mutex_lock(&disk->mutex);
  struct inode *inode = names_inode(&disk->now, name);
  errno = EIO;
  if (disk->descriptors > 0 && --disk->descriptors == 0) {
    disk->failed = true;
    errno = EMFILE;
    turn = TURN_OFF;
  } else if ((flags & O_CREAT) != 0) {
    turn = change(false, true);
  } else if (disk->stopped || !disk_ask(disk)) {
    turn = TURN_OFF;
  }
  if (turn != TURN_OFF)
    fd = open(path, flags, 0600);
  if (fd >= 0 && inode == NULL && (flags & O_CREAT) != 0)
    inode = disk_create(disk, name);
  else if (fd >= 0 && inode != NULL && (flags & O_TRUNC) != 0)
    inode_truncate(inode, 0);
  if (fd >= 0 && turn == TURN_LAST) {
    (void)close(fd);
  } else if (fd >= 0) {
    const size_t slot = slot_of(-1);
    disk->files[slot].fd = fd;
    disk->files[slot].inode = inode;
    disk->files[slot].at = 0;
    snprintf(disk->files[slot].folder, sizeof(disk->files[slot].folder), "%s", name);
  }
  return end(turn, fd);
}

static ssize_t disk_write(int fd, const void *bytes, size_t size)
{
  ssize_t written = -1;
  pthread_mutex_lock(&disk->mutex);
  size_t slot = slot_of(fd);
  enum turn turn = change(false, true);
  if (turn != TURN_OFF)
    written = write(fd, bytes, size);
  if (written > 0) {
    inode_write(disk->files[slot].inode, disk->files[slot].at, bytes, (size_t)written);
    disk->files[slot].at += written;
  }
  return end(turn, written);
}

static int disk_sync(int fd)
{
  pthread_mutex_lock(&disk->mutex);
  size_t slot = slot_of(fd);
  enum turn turn = change(true, false);
  if (turn == TURN_GO) {
    if (disk->files[slot].inode == NULL && (disk->lies & DISK_FORGETS_FOLDERS) == 0)
      disk_sync_folder(disk, disk->files[slot].folder);
    if (disk->files[slot].inode != NULL && (disk->lies & DISK_FORGETS_FILES) == 0)
      inode_sync(disk->files[slot].inode);
  }
  return end(turn, 0);
}

static int disk_close(int fd)
{
  pthread_mutex_lock(&disk->mutex);
  disk->files[slot_of(fd)].fd = -1;
  pthread_mutex_unlock(&disk->mutex);
  return close(fd);
}

/* Adds or removes a name. to: the new name of a rename; is_new: it must not exist. */
static int change_name(enum name_kind kind, bool is_new, const char *path, const char *to)
{
  int result = -1;
  pthread_mutex_lock(&disk->mutex);
  enum turn turn = change(false, kind == NAME_RENAMED || kind == NAME_MADE);
  if (turn != TURN_OFF)
    result = kind == NAME_RENAMED   ? (is_new ? mo_system_files.rename_new : rename)(path, to)
             : kind == NAME_MADE    ? mkdir(path, 0700)
             : kind == NAME_REMOVED ? unlink(path)
                                    : rmdir(path);
  if (result == 0)
    disk_note(disk, kind, disk_below(disk, path), to != NULL ? disk_below(disk, to) : NULL,
              kind == NAME_RENAMED ? names_inode(&disk->now, disk_below(disk, path)) : NULL);
  return end(turn, result);
}

static int disk_rename(const char *from, const char *to)
{
  return change_name(NAME_RENAMED, false, from, to);
}

static int disk_rename_new(const char *from, const char *to)
{
  return change_name(NAME_RENAMED, true, from, to);
}

static int disk_unlink(const char *path)
{
  return change_name(NAME_REMOVED, false, path, NULL);
}

static int disk_mkdir(const char *path, mode_t mode)
{
  (void)mode;
  return change_name(NAME_MADE, false, path, NULL);
}

static int disk_rmdir(const char *path)
{
  return change_name(NAME_FOLDER_REMOVED, false, path, NULL);
}

const struct mo_file_operations *disk_files(struct disk *used)
{
  static const struct mo_file_operations operations = {disk_open,   disk_write,  disk_sync,
                                                       disk_close,  disk_rename, disk_rename_new,
                                                       disk_unlink, disk_mkdir,  disk_rmdir};
  disk = used;
  return &operations;
}
