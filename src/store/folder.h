/* folder.h: files and folders of the state folder. Only for this room. */
#ifndef MORPHO_STORE_FOLDER_H
#define MORPHO_STORE_FOLDER_H

#include <inttypes.h>

#include "store/internal.h"

/* Locks the state folder. The caller closes *file_fd in any case, unless it is −1. MO_ERR_BUSY:
 * another process holds the lock. */
int mo_state_folder_lock(int fd, const char *path, int *file_fd, struct mo_message *message);

/* Reads a file of `size` bytes (malloc). MO_ERR_NOT_FOUND; MO_ERR_CORRUPT: the size differs;
 * MO_ERR_IO; MO_ERR_NO_MEMORY: not enough memory or descriptors. */
int mo_file_read(const char *path, size_t size, uint8_t **bytes);
/* Like mo_file_read, for a file that a row refers to. Returns MO_ERR_CORRUPT also if the file is
 * missing or its hash differs. */
int mo_file_read_checked(const char *path, size_t size, const struct mo_sha256 *sha256,
                         uint8_t **bytes);
/* Writes a file, atomically and durably, unless it already has these bytes. `path` must be in
 * `folder`. MO_ERR_NO_SPACE: nothing was changed. */
int mo_file_write(struct mo_store *store, const char *folder, const char *path,
                  const uint8_t *bytes, size_t size);
/* Does the same, but the file is given its name only if `check` (nullable), which reads it under a
 * temporary name, returns MO_OK. */
int mo_file_write_checked(struct mo_store *store, const char *folder, const char *path,
                          const uint8_t *bytes, size_t size,
                          int (*check)(void *context, const char *path), void *context);
/* Parses the name of a file in the folder "excluded": its controller and its key. */
#define MO_EXCLUDED_NAME       "%s-%016" PRIx64 ".forms"
#define MO_EXCLUDED_NAME_BYTES (MO_SHA256_DIGITS + 1 + 16 + 6 + 1)
bool mo_excluded_name_read(const char *name, struct mo_sha256 *controller, uint64_t *key);
/* MO_ERR_NO_MEMORY: the folder cannot be opened now; MO_ERR_IO is fatal to the store. */
int mo_folder_sync(struct mo_store *store, const char *path);
/* Creates a folder if it is missing, and makes its name durable in any case. */
int mo_folder_make(struct mo_store *store, const char *parent, const char *path);
/* Counts files without rows in store->orphans, and removes the files that this program left behind.
 * connection NULL: finds only unfinished files. Called before the writer starts. */
int mo_files_sort_out(struct mo_store *store, struct mo_connection *connection, bool removes);

#endif
