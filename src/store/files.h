/* files.h: the system calls by which the store changes files that it writes itself: weights,
 * checkpoints, the names of backups.
 *
 * A table, so that tests can put a disk of their own below the store, as they do with SQLite's file
 * system. The lock and the reserve are not written through it: their content means nothing. */
#ifndef MORPHO_STORE_FILES_H
#define MORPHO_STORE_FILES_H

#include <stdbool.h>
#include <stddef.h>
#include <sys/types.h>

/* Each as the call of its name: −1 and errno. From any thread. */
struct mo_file_operations {
  int (*open)(void *context, const char *path,
              int flags); /* new files: mode 0600; folders, to be synced */
  ssize_t (*write)(void *context, int fd, const void *bytes, size_t size);
  int (*sync)(void *context, int fd); /* of a file or folder */
  int (*close)(void *context, int fd);
  int (*rename)(void *context, const char *from, const char *to,
                bool replace); /* else EEXIST if `to` is there */
  int (*unlink)(void *context, const char *path);
  int (*mkdir)(void *context, const char *path); /* mode 0700 */
  int (*rmdir)(void *context, const char *path);
  void *context;
};
const struct mo_file_operations *mo_file_operations_system(void);

#endif
