/* members.h: the content of an archive as an input: for each member a line with its name and size,
 * then its bytes. Targets pack it into an archive; otherwise, the hashes and the compression would
 * reject almost all inputs. */
#ifndef MORPHO_TESTS_FUZZ_MEMBERS_H
#define MORPHO_TESTS_FUZZ_MEMBERS_H

#include <string.h>

#include "exchange/archive.h"
#include "target.h"

#define MEMBERS_MAX 64

/* Packs the members in the input: "<name> <size>\n<bytes>" each. */
static inline void pack(const uint8_t *data, size_t size, struct mo_text *archive)
{
  struct mo_archive_writer *writer = mo_archive_create();
  FUZZ_PROMISE(writer != NULL);
  for (int n = 0; n < MEMBERS_MAX && size > 0; n++) {
    const uint8_t *end = memchr(data, '\n', size);
    char head[160], name[MO_ARCHIVE_NAME_BYTES];
    size_t bytes = 0;
    if (end == NULL || (size_t)(end - data) >= sizeof(head))
      break;
    memcpy(head, data, (size_t)(end - data));
    head[end - data] = '\0';
    size -= (size_t)(end - data) + 1;
    data = end + 1;
    if (sscanf(head, "%99s %zu", name, &bytes) != 2) /* NOLINT(cert-err34-c): a wrong size is one */
      break;
    bytes = bytes < size ? bytes : size;
    FUZZ_PROMISE(mo_archive_add(writer, name, data, bytes, archive) == MO_OK);
    data += bytes;
    size -= bytes;
  }
  FUZZ_PROMISE(mo_archive_end(writer, archive) == MO_OK);
  mo_archive_writer_free(writer);
}

#endif
