/* file.h: reads files with bounds. */
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

#endif
