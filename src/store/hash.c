/* hash.c: SHA-256 of contents, and the byte encodings that are hashed.
 *
 * Physics encoding, version 1: the byte 1, then little-endian: eight doubles (dt, stiffness, mass,
 * drag, gravity, actuation, friction, friction cap), the double drop height, and the 32-bit words
 * steps, impact, bisections (0 for exact), precision, sensor. Equal values have one encoding: −0 is
 * written as 0. */
#include "store/hash.h"

#include <string.h>

#include <nettle/sha2.h>

#include "base/text.h"
#include "store/encode.h"

void mo_sha256_of(const void *data, size_t size, struct mo_sha256 *hash)
{
  struct sha256_ctx context;
  sha256_init(&context);
  if (size > 0)
    sha256_update(&context, size, data);
  sha256_digest(&context, sizeof(hash->bytes), hash->bytes);
}

void mo_sha256_to_hex(const struct mo_sha256 *hash, char digits[MO_SHA256_DIGITS + 1])
{
  static const char hex[] = "0123456789abcdef";
  for (size_t i = 0; i < sizeof(hash->bytes); i++) {
    digits[2 * i] = hex[hash->bytes[i] >> 4];
    digits[2 * i + 1] = hex[hash->bytes[i] & 15];
  }
  digits[MO_SHA256_DIGITS] = '\0';
}

int mo_sha256_from_hex(const char *digits, size_t length, struct mo_sha256 *hash)
{
  struct mo_sha256 result;
  if (length != MO_SHA256_DIGITS)
    return MO_ERR_FORMAT;
  for (size_t i = 0; i < sizeof(result.bytes); i++) {
    int high = mo_hex_digit(digits[2 * i]);
    int low = mo_hex_digit(digits[2 * i + 1]);
    if (high < 0 || low < 0)
      return MO_ERR_FORMAT;
    result.bytes[i] = (uint8_t)(high * 16 + low);
  }
  *hash = result;
  return MO_OK;
}

int mo_sha256_equal(const struct mo_sha256 *a, const struct mo_sha256 *b)
{
  return memcmp(a->bytes, b->bytes, sizeof(a->bytes)) == 0;
}

void mo_physics_hash(const struct mo_physics *physics, enum mo_precision precision,
                     enum mo_sensor sensor, struct mo_sha256 *hash)
{
  uint8_t bytes[MO_PHYSICS_BYTES];
  mo_encode_physics(physics, precision, sensor, bytes);
  mo_sha256_of(bytes, sizeof(bytes), hash);
}
