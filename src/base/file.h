/* file.h: whole files, read with bounds and replaced at once. */
#ifndef MORPHO_BASE_FILE_H
#define MORPHO_BASE_FILE_H

#include <stddef.h>
#include <stdint.h>

#include <morpho/error.h>

/* Opens a regular file for reading: its descriptor (≥ 0) and size, or MO_ERR_NOT_FOUND, MO_ERR_IO.
 * Never waits, as for the writer of a pipe. */
int mo_file_open(const char *path, uint64_t *size, struct mo_message *message);
/* Reads exactly `size` bytes at `offset`. MO_ERR_IO. */
int mo_file_read_at(int fd, void *buffer, uint64_t size, uint64_t offset,
                    struct mo_message *message);

struct mo_file_piece {
  const void *bytes;
  size_t size;
};
/* Makes `path` a file of these pieces: written beside its destination, synced, renamed over it, and
 * its folder synced. Readers see the old or the new file, never a part. MO_ERR_NO_SPACE, MO_ERR_IO,
 * MO_ERR_NO_MEMORY: the old file stands, unless syncing the folder was what failed. */
int mo_file_replace(const char *path, const struct mo_file_piece *pieces, size_t n,
                    struct mo_message *message);

#endif
