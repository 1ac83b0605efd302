/* disk_files.c: the store's own files on a disk: its table of file operations. */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <unistd.h>

#include "disk_inside.h"

static struct disk *disk; /* whose files the store of this process writes */

static int fail(int error)
{
  errno = error;
  return -1;
}

/* Ends a change that was made: the caller of the last one gets no result. */
static int end(enum turn turn, int result)
{
  return turn == TURN_LAST ? fail(EIO) : result;
}

static int disk_close(int fd);

static int disk_open(const char *path, int flags, ...)
{
  const char *name = disk_below(disk, path);
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
    turn = disk_change(disk, false);
  else if (disk->stopped || !disk_ask(disk))
    turn = TURN_OFF;
  if (turn != TURN_OFF)
    fd = open(path, flags, 0600);
  while (slot < FILES_MAX && disk->files[slot].fd >= 0)
    slot++;
  if (fd >= 0 && slot < FILES_MAX) {
    if (inode == NULL && (flags & O_CREAT) != 0)
      inode = disk_create(disk, name);
    else if (inode != NULL && (flags & O_TRUNC) != 0)
      inode_truncate(inode, 0);
    disk->files[slot].fd = fd;
    disk->files[slot].inode = inode;
    disk->files[slot].at = 0;
    snprintf(disk->files[slot].folder, sizeof(disk->files[slot].folder), "%s", name);
  }
  pthread_mutex_unlock(&disk->mutex);
  if (turn == TURN_LAST && fd >= 0)
    (void)disk_close(fd);
  return turn == TURN_GO ? fd : fail(EIO);
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

static ssize_t disk_write(int fd, const void *bytes, size_t size)
{
  ssize_t written = -1;
  enum turn turn;
  size_t slot;
  pthread_mutex_lock(&disk->mutex);
  slot = slot_of(fd);
  turn = disk_change(disk, false);
  if (turn != TURN_OFF)
    written = write(fd, bytes, size);
  if (written > 0) {
    inode_write(disk->files[slot].inode, disk->files[slot].at, bytes, (size_t)written);
    disk->files[slot].at += written;
  }
  pthread_mutex_unlock(&disk->mutex);
  return turn == TURN_GO ? written : fail(EIO);
}

static int disk_sync(int fd)
{
  enum turn turn;
  size_t slot;
  pthread_mutex_lock(&disk->mutex);
  slot = slot_of(fd);
  turn = disk_change(disk, true);
  if (turn == TURN_GO) {
    if (disk->files[slot].inode == NULL && (disk->lies & DISK_FORGETS_FOLDERS) == 0)
      disk_sync_folder(disk, disk->files[slot].folder);
    if (disk->files[slot].inode != NULL && (disk->lies & DISK_FORGETS_FILES) == 0)
      inode_sync(disk->files[slot].inode);
  }
  pthread_mutex_unlock(&disk->mutex);
  return turn == TURN_GO ? 0 : fail(EIO);
}

static int disk_close(int fd)
{
  pthread_mutex_lock(&disk->mutex);
  disk->files[slot_of(fd)].fd = -1;
  pthread_mutex_unlock(&disk->mutex);
  return close(fd);
}

static int disk_rename(const char *from, const char *to)
{
  enum turn turn;
  int result = -1;
  pthread_mutex_lock(&disk->mutex);
  turn = disk_change(disk, false);
  if (turn != TURN_OFF)
    result = rename(from, to);
  else
    errno = EIO;
  if (result == 0)
    disk_note(disk, NAME_RENAMED, disk_below(disk, from), disk_below(disk, to),
              names_inode(&disk->now, disk_below(disk, from)));
  pthread_mutex_unlock(&disk->mutex);
  return end(turn, result);
}

/* A removal, or a new folder. */
static int change_name(enum name_kind kind, const char *path)
{
  enum turn turn;
  int result = -1;
  pthread_mutex_lock(&disk->mutex);
  turn = disk_change(disk, false);
  if (turn == TURN_OFF)
    errno = EIO;
  else
    result = kind == NAME_MADE      ? mkdir(path, 0700)
             : kind == NAME_REMOVED ? unlink(path)
                                    : rmdir(path);
  if (result == 0)
    disk_note(disk, kind, disk_below(disk, path), NULL, NULL);
  pthread_mutex_unlock(&disk->mutex);
  return end(turn, result);
}

static int disk_unlink(const char *path)
{
  return change_name(NAME_REMOVED, path);
}

static int disk_mkdir(const char *path, mode_t mode)
{
  (void)mode;
  return change_name(NAME_MADE, path);
}

static int disk_rmdir(const char *path)
{
  return change_name(NAME_FOLDER_REMOVED, path);
}

const struct mo_file_operations *disk_files(struct disk *used)
{
  static const struct mo_file_operations operations = {disk_open,  disk_write,  disk_sync,
                                                       disk_close, disk_rename, disk_unlink,
                                                       disk_mkdir, disk_rmdir};
  disk = used;
  return &operations;
}
