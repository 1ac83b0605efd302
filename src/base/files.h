/* files.h: reading at an offset, and the system calls that change files.
 *
 * These calls are in a table, so that tests can simulate a disk, as they do for SQLite with a VFS.
 * The store's lock file and reserve file do not use the table, because their content has no
 * meaning. */
#ifndef MORPHO_BASE_FILES_H
#define MORPHO_BASE_FILES_H

#include <stddef.h>
#include <stdint.h>
#include <sys/types.h>

/* Each function behaves like the system call with its name: −1 and errno on failure. Called from
 * any
 * thread. */
struct mo_file_operations {
  int (*open)(const char *path, int flags, ...); /* also opens folders, to sync them */
  ssize_t (*write)(int fd, const void *bytes, size_t size);
  int (*sync)(int fd); /* of a file or folder */
  int (*close)(int fd);
  int (*rename)(const char *from, const char *to);
  int (*rename_new)(const char *from, const char *to); /* fails with EEXIST if `to` exists */
  int (*unlink)(const char *path);
  int (*mkdir)(const char *path, mode_t mode);
  int (*rmdir)(const char *path);
};
extern const struct mo_file_operations mo_system_files;

/* Converts errno after a call that opened a file to an error. Lack of descriptors or memory is
 * temporary, and not a fault of the file: MO_ERR_NO_MEMORY. */
int mo_open_error(void);
/* Does the same after a call that opened or changed a file. */
int mo_file_error(void);

/* Reads bytes at an offset. MO_ERR_CORRUPT: the file ends before them; MO_ERR_IO. */
int mo_file_read_at(int fd, uint64_t from, size_t size, void *bytes);

#endif
