/* files.h: the system calls that change the store's own files: weights and checkpoints.
 *
 * They are in a table, so that tests can simulate a disk, as they do for SQLite with a VFS. The
 * lock and the reserve do not use it, because they have no meaningful content. */
#ifndef MORPHO_STORE_FILES_H
#define MORPHO_STORE_FILES_H

#include <stddef.h>
#include <sys/types.h>

/* Each behaves like the system call of its name: −1 and errno on failure. Called from any
 * thread. */
struct mo_file_operations {
  int (*open)(const char *path, int flags, ...); /* also opens folders, to sync them */
  ssize_t (*write)(int fd, const void *bytes, size_t size);
  int (*sync)(int fd); /* of a file or folder */
  int (*close)(int fd);
  int (*rename)(const char *from, const char *to);
  int (*unlink)(const char *path);
  int (*mkdir)(const char *path, mode_t mode);
  int (*rmdir)(const char *path);
};
extern const struct mo_file_operations mo_system_files;

#endif
