/* archive.c: see archive.h. The sizes of members and the compression window are bounded, so that a
 * small file cannot use much memory. The compression ratio is bounded, so that unpacking cannot
 * take hours. */
#include "exchange/archive.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <zstd.h>

#define BLOCK      512
#define LEVEL      3
#define WINDOW_LOG 23 /* 8 MiB, which is 2^23; level 3 uses 2^21 */
#define SUMS       "SHA256SUMS"

/* ---- shared by writing and reading ---- */

struct header { /* ustar; octal digits */
  char name[100], mode[8], uid[8], gid[8], size[12], mtime[12], checksum[8], type, link[100],
      magic[6], version[2], user[32], group[32], major[8], minor[8], prefix[155], rest[12];
};
_Static_assert(sizeof(struct header) == BLOCK, "a header is one block");

/* Makes the header of a member. A header has only one form. */
static void make_header(const char *name, size_t size, struct header *header)
{
  unsigned sum = 0;
  memset(header, 0, sizeof(*header));
  snprintf(header->name, sizeof(header->name), "%s", name);
  memcpy(header->mode, "0000644", 8);
  memcpy(header->uid, "0000000", 8);
  memcpy(header->gid, "0000000", 8);
  snprintf(header->size, sizeof(header->size), "%011zo", size);
  memcpy(header->mtime, "00000000000", 12);
  memset(header->checksum, ' ', sizeof(header->checksum));
  header->type = '0';
  memcpy(header->magic, "ustar", 6);
  memcpy(header->version, "00", 2);
  for (size_t i = 0; i < sizeof(*header); i++)
    sum += ((const unsigned char *)header)[i];
  snprintf(header->checksum, sizeof(header->checksum), "%06o", sum);
}

static size_t padding_of(size_t size)
{
  return (BLOCK - size % BLOCK) % BLOCK;
}

/* Returns the number of bytes that an archive of this size may unpack to. */
static uint64_t most_bytes(uint64_t size)
{
  return MO_ARCHIVE_FREE + MO_ARCHIVE_RATIO * size;
}

static void add_sum(struct mo_text *sums, const struct mo_sha256 *sha256, const char *name)
{
  mo_text_format(sums, "%s  %s\n", MO_SHA256_HEX(sha256), name);
}

/* ---- writing ---- */

struct mo_archive_writer {
  ZSTD_CCtx *stream;
  uint64_t taken, made; /* bytes before and after compression */
  struct mo_text sums;
};

struct mo_archive_writer *mo_archive_create(void)
{
  struct mo_archive_writer *writer = calloc(1, sizeof(*writer));
  if (writer == NULL || (writer->stream = ZSTD_createCCtx()) == NULL ||
      ZSTD_isError(ZSTD_CCtx_setParameter(writer->stream, ZSTD_c_compressionLevel, LEVEL)) ||
      ZSTD_isError(ZSTD_CCtx_setParameter(writer->stream, ZSTD_c_checksumFlag, 1))) {
    mo_archive_writer_free(writer);
    return NULL;
  }
  return writer;
}

void mo_archive_writer_free(struct mo_archive_writer *writer)
{
  if (writer == NULL)
    return;
  ZSTD_freeCCtx(writer->stream);
  mo_text_free(&writer->sums);
  free(writer);
}

static int compress(struct mo_archive_writer *writer, const void *bytes, size_t size, bool last,
                    struct mo_text *out)
{
  char piece[16384];
  ZSTD_inBuffer in = {bytes, size, 0};
  size_t left = 1;
  while (in.pos < in.size || (last && left > 0)) {
    ZSTD_outBuffer made = {piece, sizeof(piece), 0};
    left = ZSTD_compressStream2(writer->stream, &made, &in, last ? ZSTD_e_end : ZSTD_e_continue);
    if (ZSTD_isError(left))
      return MO_ERR_NO_MEMORY;
    mo_text_bytes(out, piece, made.pos);
    writer->made += made.pos;
  }
  writer->taken += size;
  return out->failed ? MO_ERR_NO_MEMORY : MO_OK;
}

int mo_archive_add(struct mo_archive_writer *writer, const char *name, const void *bytes,
                   size_t size, struct mo_text *out)
{
  static const char zeros[BLOCK];
  struct mo_sha256 sha256;
  struct header header;
  if (size > MO_ARCHIVE_MEMBER_MAX)
    return MO_ERR_LIMIT;
  make_header(name, size, &header);
  mo_sha256_of(bytes, size, &sha256);
  add_sum(&writer->sums, &sha256, name);
  int error = compress(writer, &header, sizeof(header), false, out);
  if (error == MO_OK)
    error = compress(writer, bytes, size, false, out);
  return error == MO_OK ? compress(writer, zeros, padding_of(size), false, out) : error;
}

int mo_archive_end(struct mo_archive_writer *writer, struct mo_text *out)
{
  static const char zeros[2 * BLOCK];
  struct mo_text sums = writer->sums;
  writer->sums = (struct mo_text){0}; /* SHA256SUMS has no line for itself */
  int error =
      sums.failed ? MO_ERR_NO_MEMORY : mo_archive_add(writer, SUMS, sums.data, sums.size, out);
  mo_text_free(&sums);
  if (error == MO_OK)
    error = compress(writer, zeros, sizeof(zeros), true, out);
  return error == MO_OK && writer->taken > most_bytes(writer->made) ? MO_ERR_LIMIT : error;
}

/* ---- reading ---- */

struct mo_archive_reader {
  ZSTD_DCtx *stream;
  ZSTD_inBuffer in;
  uint64_t left; /* bytes that the rest may unpack to */
  bool ended;    /* the frame ended */
  bool summed;   /* SHA256SUMS was read and matches */
  uint32_t n;    /* members */
  char *bytes;   /* of the member */
  struct mo_text sums;
};

struct mo_archive_reader *mo_archive_open(const void *bytes, size_t size)
{
  struct mo_archive_reader *reader = calloc(1, sizeof(*reader));
  if (reader == NULL || (reader->stream = ZSTD_createDCtx()) == NULL ||
      ZSTD_isError(ZSTD_DCtx_setParameter(reader->stream, ZSTD_d_windowLogMax, WINDOW_LOG))) {
    mo_archive_close(reader);
    return NULL;
  }
  reader->in = (ZSTD_inBuffer){bytes, size, 0};
  reader->left = most_bytes(size);
  return reader;
}

void mo_archive_close(struct mo_archive_reader *reader)
{
  if (reader == NULL)
    return;
  ZSTD_freeDCtx(reader->stream);
  mo_text_free(&reader->sums);
  free(reader->bytes);
  free(reader);
}

/* Checks that the frame is an ordinary one and ends with a checksum: a flag in its first byte. */
static int check_frame(const struct mo_archive_reader *reader, struct mo_message *message)
{
  static const unsigned char magic[] = {0x28, 0xb5, 0x2f, 0xfd};
  const unsigned char *bytes = reader->in.src;
  if (reader->in.size <= sizeof(magic) || memcmp(bytes, magic, sizeof(magic)) != 0)
    return mo_fail(message, MO_ERR_FORMAT, "the file is damaged, or is not in zstd format");
  return bytes[sizeof(magic)] >> 2 & 1
             ? MO_OK
             : mo_fail(message, MO_ERR_FORMAT,
                       "the zstd checksum at the end of the file is missing");
}

/* Decompresses exactly n bytes. */
static int pull(struct mo_archive_reader *reader, void *bytes, size_t n, struct mo_message *message)
{
  ZSTD_outBuffer out = {bytes, n, 0};
  const int error = reader->in.pos == 0 ? check_frame(reader, message) : MO_OK;
  if (error != MO_OK)
    return error;
  if (n > reader->left)
    return mo_fail(message, MO_ERR_FORMAT, "the file unpacks to more than %d times its size",
                   MO_ARCHIVE_RATIO);
  reader->left -= n;
  while (out.pos < n) {
    const size_t before = out.pos, at = reader->in.pos;
    const size_t left =
        reader->ended ? 0 : ZSTD_decompressStream(reader->stream, &out, &reader->in);
    if (ZSTD_isError(left))
      return mo_fail(message, MO_ERR_FORMAT, "the file is damaged, or is not in zstd format: %s",
                     ZSTD_getErrorName(left));
    if (out.pos == before && reader->in.pos == at)
      return mo_fail(message, MO_ERR_FORMAT, "the file ends early");
    reader->ended = left == 0;
  }
  return MO_OK;
}

static bool is_zero(const char *bytes, size_t n)
{
  for (size_t i = 0; i < n; i++)
    if (bytes[i] != 0)
      return false;
  return true;
}

/* Checks the end: a second block of zeros, then the end of the frame and of the data. */
static int finish(struct mo_archive_reader *reader, struct mo_message *message)
{
  char block[BLOCK] = {0}, one;
  ZSTD_outBuffer out = {&one, 1, 0};
  int error = pull(reader, block, sizeof(block), message);
  if (error != MO_OK)
    return error;
  while (!reader->ended && out.pos == 0) {
    const size_t at = reader->in.pos;
    const size_t left = ZSTD_decompressStream(reader->stream, &out, &reader->in);
    if (ZSTD_isError(left) || (left > 0 && reader->in.pos == at))
      return mo_fail(message, MO_ERR_FORMAT, "the file ends early, or is damaged at its end");
    reader->ended = left == 0;
  }
  if (out.pos > 0 || reader->in.pos < reader->in.size || !is_zero(block, sizeof(block)))
    return mo_fail(message, MO_ERR_FORMAT, "trailing data after the archive");
  return reader->summed ? 0 : mo_fail(message, MO_ERR_FORMAT, "the file lacks " SUMS);
}

/* Reads name and size from a header, which must equal the header that make_header makes for
 * them. */
static bool read_header(const struct header *header, struct mo_archive_member *member)
{
  static const char characters[] = "abcdefghijklmnopqrstuvwxyz0123456789._-/";
  struct header made;
  size_t size = 0;
  if (memchr(header->name, 0, sizeof(header->name)) == NULL)
    return false;
  memcpy(member->name, header->name, sizeof(member->name));
  for (int i = 0; i < 11; i++) {
    if (header->size[i] < '0' || header->size[i] > '7')
      return false;
    size = size << 3 | (size_t)(header->size[i] - '0');
  }
  member->size = size;
  make_header(member->name, size, &made);
  return memcmp(&made, header, sizeof(made)) == 0 && size <= MO_ARCHIVE_MEMBER_MAX &&
         ((member->name[0] != '\0' && strspn(member->name, characters) == strlen(member->name)) ||
          strcmp(member->name, SUMS) == 0);
}

int mo_archive_next(struct mo_archive_reader *reader, struct mo_archive_member *member,
                    struct mo_message *message)
{
  struct header header = {0};
  char padding[BLOCK] = {0};
  int error = pull(reader, &header, sizeof(header), message);
  if (error != MO_OK)
    return error;
  if (is_zero((const char *)&header, sizeof(header)))
    return finish(reader, message);
  if (reader->summed || !read_header(&header, member) || reader->n == MO_ARCHIVE_MEMBERS)
    return mo_fail(message, MO_ERR_FORMAT, "the header of member %u is invalid", reader->n);
  reader->n++;
  free(reader->bytes);
  reader->bytes = malloc(member->size + 1);
  if (reader->bytes == NULL)
    return MO_ERR_NO_MEMORY;
  member->bytes = reader->bytes;
  member->bytes[member->size] = '\0';
  error = pull(reader, member->bytes, member->size, message);
  if (error == MO_OK)
    error = pull(reader, padding, padding_of(member->size), message);
  if (error != MO_OK)
    return error;
  if (!is_zero(padding, padding_of(member->size)))
    return mo_fail(message, MO_ERR_FORMAT, "%s: the padding is not zero", member->name);
  if (strcmp(member->name, SUMS) == 0) {
    reader->summed =
        member->size == reader->sums.size &&
        (member->size == 0 || memcmp(member->bytes, reader->sums.data, member->size) == 0);
    return reader->summed ? mo_archive_next(reader, member, message)
                          : mo_fail(message, MO_ERR_FORMAT, SUMS " does not match the members");
  }
  mo_sha256_of(member->bytes, member->size, &member->sha256);
  add_sum(&reader->sums, &member->sha256, member->name);
  return reader->sums.failed ? MO_ERR_NO_MEMORY : 1;
}

bool mo_archive_line(struct mo_archive_member *member, size_t *at, char **line, size_t *size)
{
  if (*at >= member->size)
    return false;
  *line = member->bytes + *at;
  char *end = memchr(*line, '\n', member->size - *at);
  *size = end != NULL ? (size_t)(end - *line) : member->size - *at;
  *at += *size + 1;
  if (end != NULL)
    *end = '\0';
  return true;
}

int mo_archive_refuse(const struct mo_archive_member *member, uint32_t line, const char *words,
                      struct mo_message *message)
{
  struct mo_message inner; /* `words` may point into the message */
  snprintf(inner.text, sizeof(inner.text), "%s", words);
  return line == 0 ? mo_fail(message, MO_ERR_FORMAT, "%.90s: %.150s", member->name, inner.text)
                   : mo_fail(message, MO_ERR_FORMAT, "%.90s, line %u: %.140s", member->name, line,
                             inner.text);
}
