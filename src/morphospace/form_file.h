/* form_file.h: an exact set of forms as a file, which can be used without loading it. */
#ifndef MORPHO_MORPHOSPACE_FORM_FILE_H
#define MORPHO_MORPHOSPACE_FORM_FILE_H

#include <morpho/morphospace.h>

#define MO_FORM_KEY_MAX 512

/* What the forms depend on in addition to the workspace. A file with a different key is not
 * used. */
struct mo_form_key {
  uint8_t bytes[MO_FORM_KEY_MAX]; /* zeros after the first n */
  size_t n;
};

uint64_t mo_form_file_bytes(const struct mo_form_set *set);
/* Writes the file of a set, from its beginning, with calls of `put`, and returns the first error of
 * `put` or MO_ERR_NO_MEMORY. */
int mo_form_file_write(const struct mo_form_set *set, const struct mo_form_key *key,
                       int (*put)(void *context, const void *bytes, size_t size), void *context);
/* Reads the whole file once, on up to n_threads threads, to check its sums, and maps it as a
 * read-only set. The caller still owns `fd` and may close it. The file must not change as long as
 * the set exists. MO_ERR_CORRUPT: truncated or altered; MO_ERR_NOT_FOUND: a different key,
 * workspace or version; MO_ERR_IO, MO_ERR_NO_MEMORY. */
int mo_form_file_map(int fd, struct mo_workspace workspace, const struct mo_form_key *key,
                     uint32_t n_threads, struct mo_form_set **set);

#endif
