/* folder.c: checks the owner of the state folder, and locks it for one process.
 *
 * A user who can write to the folder, or choose where its path leads, can make the service
 * overwrite files or trust data that it never stored. The folder and its contents must therefore
 * belong to the user of the process. The folder is opened once; the checks use that descriptor, and
 * so does the lock: a lock on a file in the folder is lost when the file is deleted. */
#include <errno.h>
#include <fcntl.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include "store/folder.h"

static const char *const file_names[] = {"lock",           "reserve",          "morphod.db",
                                         "morphod.db-wal", "morphod.db-shm",   "morphod.db-journal",
                                         "crash-marker",   "crash-marker.last"};
static const char *const folder_names[] = {"controllers", "trainings", "campaigns", "excluded",
                                           "atlases"};

/* Checks the owner of a link, who decides where it leads. Links of root are allowed, because
 * systemd creates one for StateDirectory=. */
static int check_link(const char *path, struct mo_message *message)
{
  struct stat status;
  size_t length = strlen(path);
  int error = MO_OK;
  while (length > 1 && path[length - 1] == '/')
    length--;
  char *name = strndup(path, length);
  if (name == NULL)
    return MO_ERR_NO_MEMORY;
  if (lstat(name, &status) == 0 && S_ISLNK(status.st_mode) && status.st_uid != 0 &&
      status.st_uid != geteuid())
    error = mo_fail(
        message, MO_ERR_INVALID,
        "the state folder %s is a symbolic link of uid %u; use the path of the folder itself", name,
        (unsigned)status.st_uid);
  free(name);
  return error;
}

static int check_entry(int fd, const char *path, const char *name, mode_t kind,
                       struct mo_message *message)
{
  struct stat status;
  if (fstatat(fd, name, &status, AT_SYMLINK_NOFOLLOW) != 0)
    return errno == ENOENT ? MO_OK
                           : mo_fail(message, MO_ERR_IO, "cannot read %s/%s: %s", path, name,
                                     strerrordesc_np(errno));
  if ((status.st_mode & S_IFMT) == kind && status.st_uid == geteuid())
    return MO_OK;
  return mo_fail(message, MO_ERR_INVALID,
                 "%s/%s must be a %s of uid %u, and not a link, but has uid %u and mode %06o; move "
                 "it away, or chown it",
                 path, name, kind == S_IFDIR ? "folder" : "regular file", (unsigned)geteuid(),
                 (unsigned)status.st_uid, (unsigned)status.st_mode);
}

static int check_folder(int fd, const char *path, struct stat *status, struct mo_message *message)
{
  int error = fstat(fd, status) == 0
                  ? check_link(path, message)
                  : mo_fail(message, MO_ERR_IO, "cannot read the state folder %s: %s", path,
                            strerrordesc_np(errno));
  if (error == MO_OK && status->st_uid != geteuid())
    error = mo_fail(message, MO_ERR_INVALID,
                    "the state folder %s belongs to uid %u (mode %04o), but morphod runs as uid "
                    "%u; run it as the owner, or run chown -R on the folder",
                    path, (unsigned)status->st_uid, (unsigned)status->st_mode & 07777,
                    (unsigned)geteuid());
  else if (error == MO_OK && (status->st_mode & (S_IWGRP | S_IWOTH)) != 0)
    error = mo_fail(
        message, MO_ERR_INVALID,
        "other users can write to the state folder %s of uid %u (mode %04o); run chmod go-w on it",
        path, (unsigned)status->st_uid, (unsigned)status->st_mode & 07777);
  for (size_t i = 0; i < sizeof(file_names) / sizeof(file_names[0]) && error == MO_OK; i++)
    error = check_entry(fd, path, file_names[i], S_IFREG, message);
  for (size_t i = 0; i < sizeof(folder_names) / sizeof(folder_names[0]) && error == MO_OK; i++)
    error = check_entry(fd, path, folder_names[i], S_IFDIR, message);
  return error;
}

/* Resolves the path to one without links, which SQLite does not follow. It must lead to the opened
 * folder. */
static int resolve(const char *path, const struct stat *opened, char **ret,
                   struct mo_message *message)
{
  struct stat status;
  char *real = realpath(path, NULL);
  if (real != NULL && lstat(real, &status) == 0 && status.st_dev == opened->st_dev &&
      status.st_ino == opened->st_ino) {
    *ret = real;
    return MO_OK;
  }
  free(real);
  return mo_fail(message, MO_ERR_IO, "cannot resolve the state folder %s", path);
}

int mo_state_folder_open(const char *path, char **real, struct mo_message *message)
{
  struct stat status;
  const int fd = open(path, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  if (fd < 0 && (errno == ENOENT || errno == ENOTDIR))
    return mo_fail(message, MO_ERR_NOT_FOUND,
                   "the state folder %s does not exist or is not a folder", path);
  if (fd < 0)
    return mo_fail(message, MO_ERR_IO, "cannot open the state folder %s: %s", path,
                   strerrordesc_np(errno));
  int error = check_folder(fd, path, &status, message);
  if (error == MO_OK && real != NULL)
    error = resolve(path, &status, real, message);
  if (error == MO_OK)
    return fd;
  close(fd);
  return error;
}

static int refuse_lock(const char *path, struct mo_message *message)
{
  if (errno == EWOULDBLOCK)
    return mo_fail(message, MO_ERR_BUSY, "another process is using the state folder %s", path);
  return mo_fail(message, MO_ERR_IO, "cannot lock the state folder %s: %s", path,
                 strerrordesc_np(errno));
}

int mo_state_folder_lock(int fd, const char *path, int *file_fd, struct mo_message *message)
{
  if (flock(fd, LOCK_EX | LOCK_NB) != 0)
    return refuse_lock(path, message);
  /* Creating this file also checks that the folder is writable. */
  *file_fd = openat(fd, "lock", O_RDWR | O_CREAT | O_CLOEXEC | O_NOFOLLOW, 0600);
  if (*file_fd < 0)
    return mo_fail(message, errno == ENOSPC ? MO_ERR_NO_SPACE : MO_ERR_IO,
                   "cannot write to the state folder %s: %s", path, strerrordesc_np(errno));
  if (flock(*file_fd, LOCK_EX | LOCK_NB) != 0)
    return refuse_lock(path, message);
  return MO_OK;
}
