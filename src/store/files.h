/* files.h: the system calls that change the store's own files: weights and checkpoints.
 *
 * They are in a table, so that tests can simulate a disk, as they do for SQLite with a VFS. The
 * lock and the reserve do not use it: their content means nothing. */
#ifndef MORPHO_STORE_FILES_H
#define MORPHO_STORE_FILES_H

#include <stdbool.h>
#include <stddef.h>
#include <sys/types.h>

/* Each is like the system call of its name: −1 and errno. Called from any thread. */
struct mo_file_operations {
  int (*open)(void *context, const char *path,
              int flags); /* new files get mode 0600; also opens folders, to sync them */
  ssize_t (*write)(void *context, int fd, const void *bytes, size_t size);
  int (*sync)(void *context, int fd); /* of a file or folder */
  int (*close)(void *context, int fd);
  int (*rename)(void *context, const char *from, const char *to);
  int (*unlink)(void *context, const char *path);
  int (*mkdir)(void *context, const char *path); /* mode 0700 */
  int (*rmdir)(void *context, const char *path);
  void *context;
};
const struct mo_file_operations *mo_file_operations_system(void);

#endif
