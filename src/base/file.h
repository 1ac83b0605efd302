/* file.h: reads files with bounds and replaces them atomically. */
#ifndef MORPHO_BASE_FILE_H
#define MORPHO_BASE_FILE_H

#include <stddef.h>
#include <stdint.h>

#include <morpho/error.h>

/* Opens a regular file for reading. Returns its descriptor (≥ 0) and its size, or MO_ERR_NOT_FOUND,
 * MO_ERR_IO. Never blocks, not even on a pipe. */
int mo_file_open(const char *path, uint64_t *size, struct mo_message *message);
/* Reads exactly `size` bytes at `offset`. MO_ERR_IO. */
int mo_file_read_at(int fd, void *buffer, uint64_t size, uint64_t offset,
                    struct mo_message *message);

struct mo_file_piece {
  const void *bytes;
  size_t size;
};
/* Writes the pieces to `path`: to a temporary file, which is synced and renamed; then the folder is
 * synced. Readers see the whole old or the whole new file. MO_ERR_NO_SPACE, MO_ERR_IO,
 * MO_ERR_NO_MEMORY: the old file stays, unless only the sync of the folder failed. */
int mo_file_replace(const char *path, const struct mo_file_piece *pieces, size_t n,
                    struct mo_message *message);

#endif
