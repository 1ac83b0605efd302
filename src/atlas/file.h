/* file.h: an open atlas. */
#ifndef MORPHO_ATLAS_FILE_H
#define MORPHO_ATLAS_FILE_H

#include "atlas/format.h"

#include <sys/stat.h>

#define MO_ATLAS_IS_FOLDER "a directory, not a file: move it elsewhere"

struct mo_atlas {
  struct mo_atlas_source source;
  struct mo_atlas_layout layout;
  struct mo_atlas_sets sets;
  struct mo_environment *environments;
  struct mo_sha256 environments_sha256; /* of their bytes in the file */
  struct mo_atlas_block *blocks;        /* all */
  uint64_t *first_keys;                 /* (blocks) */
  uint8_t *mapped;                      /* the file, read-only */
  size_t bytes;
};

/* Opens a file for reading. MO_ERR_NOT_FOUND; MO_ERR_IO: it cannot be read, or is not a file, and
 * the message says what it is and what to do; MO_ERR_NO_MEMORY. Never waits, also not for a pipe.
 */
int mo_atlas_file_open(const char *path, int *fd, struct stat *status, struct mo_message *message);

/* Checks a header: what it is, its version, its checksum, and that its numbers are within their
 * bounds and match the file's size. MO_ERR_FORMAT, MO_ERR_UNSUPPORTED, MO_ERR_CORRUPT. */
int mo_atlas_header_check(const struct mo_atlas_header *header, uint64_t file_bytes,
                          struct mo_message *message);

/* Determines whether a file has this source and these environments. MO_ERR_NO_MEMORY. */
int mo_atlas_is_of(const struct mo_atlas *atlas, const struct mo_atlas_source *source,
                   const struct mo_environment *environments, uint32_t n, bool *is_of);

/* Finds the body with a key. MO_ERR_NOT_FOUND. */
int mo_atlas_find_key(const struct mo_atlas *atlas, uint32_t n_voxels, uint64_t key,
                      uint64_t *position);
/* Returns a measure's column in the file, or −1. */
int mo_atlas_column_of(const struct mo_atlas *atlas, enum mo_measure measure);
/* Returns the values (n) of a measure in a block. column: below layout.n_measures. */
const float *mo_atlas_column(const struct mo_atlas *atlas, const struct mo_atlas_block *block,
                             uint32_t column);
float mo_atlas_in_column(const struct mo_atlas *atlas, uint64_t position, uint32_t column);
/* Reads the key at a position. Returns the body's number of voxels. */
uint32_t mo_atlas_key_at(const struct mo_atlas *atlas, uint64_t position, uint64_t *key);

#endif
