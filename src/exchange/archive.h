/* archive.h: the archive of a bundle, or of a block of scores: tar (ustar), compressed with zstd.
 * Its last member, SHA256SUMS, has a line for each member before it, in the format of sha256sum.
 *
 * An archive of given members has exactly one form, and the reader accepts no other: no links, no
 * folders, no other owner or time, and nothing after the end. */
#ifndef MORPHO_EXCHANGE_ARCHIVE_H
#define MORPHO_EXCHANGE_ARCHIVE_H

#include <morpho/error.h>

#include "base/sha256.h"
#include "base/text.h"

#define MO_ARCHIVE_TYPE       "application/zstd"
#define MO_ARCHIVE_NAME_BYTES 100                /* of a member, with its NUL */
#define MO_ARCHIVE_MEMBER_MAX ((size_t)64 << 20) /* bytes of a member */
#define MO_ARCHIVE_MEMBERS    200000
/* Largest mean number of bytes that one byte of the archive may unpack to. */
#define MO_ARCHIVE_RATIO 200
#define MO_ARCHIVE_FREE  MO_ARCHIVE_MEMBER_MAX /* this many bytes are always allowed */

struct mo_archive_writer;
struct mo_archive_writer *mo_archive_create(void); /* Returns NULL if memory runs out. */
/* Adds a member. Appends the part of the archive that is finished, possibly nothing, to `out`. */
int mo_archive_add(struct mo_archive_writer *writer, const char *name, const void *bytes,
                   size_t size, struct mo_text *out);
/* Adds SHA256SUMS and appends the rest. MO_ERR_LIMIT: the archive is compressed so strongly that no
 * reader would accept it. */
int mo_archive_end(struct mo_archive_writer *writer, struct mo_text *out);
void mo_archive_writer_free(struct mo_archive_writer *writer); /* NULL-safe */

struct mo_archive_member {
  char name[MO_ARCHIVE_NAME_BYTES];
  char *bytes; /* valid until the next member; a NUL follows the last byte; may be modified */
  size_t size;
  struct mo_sha256 sha256;
};
struct mo_archive_reader;
/* Reads an archive in memory, which must stay valid. Returns NULL if memory runs out. */
struct mo_archive_reader *mo_archive_open(const void *bytes, size_t size);
/* Reads the next member. Returns 1, or 0 after the last one: the archive is then complete, and
 * SHA256SUMS matches. MO_ERR_FORMAT: it is not an archive, it is damaged, or it ends early.
 * MO_ERR_NO_MEMORY. */
int mo_archive_next(struct mo_archive_reader *reader, struct mo_archive_member *member,
                    struct mo_message *message);
/* Finds the line that begins at *at, and terminates it with a NUL. Returns false if there is no
 * line. */
bool mo_archive_line(struct mo_archive_member *member, size_t *at, char **line, size_t *size);
/* Fills the message with a fault in a line of a member (line 0: in the member). Returns
 * MO_ERR_FORMAT. */
int mo_archive_refuse(const struct mo_archive_member *member, uint32_t line, const char *words,
                      struct mo_message *message);
void mo_archive_close(struct mo_archive_reader *reader); /* NULL-safe */

#endif
