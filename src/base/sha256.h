/* sha256.h: SHA-256, which identifies everything that is stored by content, and protects data in
 * transfer. */
#ifndef MORPHO_BASE_SHA256_H
#define MORPHO_BASE_SHA256_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define MO_SHA256_DIGITS 64

struct mo_sha256 {
  uint8_t bytes[32];
};

void mo_sha256_of(const void *data, size_t size, struct mo_sha256 *hash);
/* Hashes two pieces as if they were one. */
void mo_sha256_of_both(const void *first, size_t first_size, const void *second, size_t second_size,
                       struct mo_sha256 *hash);
/* Writes a hash in lower case; returns `digits`. */
char *mo_sha256_to_hex(const struct mo_sha256 *hash, char digits[MO_SHA256_DIGITS + 1]);
/* Makes the same text as an argument of "%s"; valid until the end of the block. */
#define MO_SHA256_HEX(hash) mo_sha256_to_hex((hash), (char[MO_SHA256_DIGITS + 1]){0})
int mo_sha256_from_hex(const char *digits, size_t length,
                       struct mo_sha256 *hash);                            /* MO_ERR_FORMAT */
int mo_sha256_equal(const struct mo_sha256 *a, const struct mo_sha256 *b); /* 1 or 0 */

/* Writes the value of a Content-Digest field (RFC 9530): "sha-256=:BASE64:". */
#define MO_CONTENT_DIGEST_BYTES 56
void mo_sha256_to_content_digest(const struct mo_sha256 *hash, char text[MO_CONTENT_DIGEST_BYTES]);
/* Returns whether a Content-Digest field (nullable) is this hash of the data. Other algorithms, and
 * lists of several digests, do not match. */
bool mo_content_digest_matches(const char *field, const void *data, size_t size);

#endif
