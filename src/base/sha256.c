/* sha256.c: see sha256.h. */
#include "base/sha256.h"

#include <string.h>

#include <morpho/error.h>
#include <nettle/base16.h>
#include <nettle/base64.h>
#include <nettle/sha2.h>

void mo_sha256_of(const void *data, size_t size, struct mo_sha256 *hash)
{
  mo_sha256_of_both(data, size, NULL, 0, hash);
}

void mo_sha256_of_both(const void *first, size_t first_size, const void *second, size_t second_size,
                       struct mo_sha256 *hash)
{
  struct sha256_ctx context;
  sha256_init(&context);
  if (first_size > 0)
    sha256_update(&context, first_size, first);
  if (second_size > 0)
    sha256_update(&context, second_size, second);
  sha256_digest(&context, sizeof(hash->bytes), hash->bytes);
}

char *mo_sha256_to_hex(const struct mo_sha256 *hash, char digits[MO_SHA256_DIGITS + 1])
{
  base16_encode_update(digits, sizeof(hash->bytes), hash->bytes);
  digits[MO_SHA256_DIGITS] = '\0';
  return digits;
}

int mo_sha256_from_hex(const char *digits, size_t length, struct mo_sha256 *hash)
{
  struct base16_decode_ctx context;
  struct mo_sha256 result;
  size_t size = sizeof(result.bytes);
  base16_decode_init(&context);
  if (length != MO_SHA256_DIGITS ||
      !base16_decode_update(&context, &size, result.bytes, length, digits) ||
      size != sizeof(result.bytes))
    return MO_ERR_FORMAT;
  *hash = result;
  return MO_OK;
}

int mo_sha256_equal(const struct mo_sha256 *a, const struct mo_sha256 *b)
{
  return memcmp(a->bytes, b->bytes, sizeof(a->bytes)) == 0;
}

void mo_sha256_to_content_digest(const struct mo_sha256 *hash, char text[MO_CONTENT_DIGEST_BYTES])
{
  char *end = stpcpy(text, "sha-256=:");
  base64_encode_raw(end, sizeof(hash->bytes), hash->bytes);
  memcpy(end + BASE64_ENCODE_RAW_LENGTH(sizeof(hash->bytes)), ":", 2);
}

bool mo_content_digest_matches(const char *field, const void *data, size_t size)
{
  struct mo_sha256 hash;
  char expected[MO_CONTENT_DIGEST_BYTES];
  mo_sha256_of(data, size, &hash);
  mo_sha256_to_content_digest(&hash, expected);
  return field != NULL && strcmp(field, expected) == 0;
}
