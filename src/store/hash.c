/* hash.c: see hash.h.
 *
 * Physics encoding, version 1: the byte 1, then little-endian: eight doubles (dt, stiffness, mass,
 * drag, gravity, actuation, friction, friction cap), the double drop height, and the 32-bit words
 * steps, impact, bisections (0 for exact), precision, sensor. Equal values have one encoding: −0 is
 * written as 0. */
#include "store/hash.h"

#include "store/encode.h"

void mo_physics_hash(const struct mo_physics *physics, enum mo_precision precision,
                     enum mo_sensor sensor, struct mo_sha256 *hash)
{
  uint8_t bytes[MO_PHYSICS_BYTES];
  mo_encode_physics(physics, precision, sensor, bytes);
  mo_sha256_of(bytes, sizeof(bytes), hash);
}

void mo_environment_hash(const struct mo_environment *environment, struct mo_sha256 *hash)
{
  uint8_t bytes[MO_ENVIRONMENT_BYTES];
  mo_encode_environment(environment, bytes);
  mo_sha256_of(bytes, sizeof(bytes), hash);
}
