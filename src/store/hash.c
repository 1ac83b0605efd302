/* hash.c: hashes of physics and environments, in the encodings of encode.h. */
#include "store/hash.h"

#include "store/encode.h"
#include "world/environment.h"

void mo_physics_hash(const struct mo_physics *physics, enum mo_precision precision,
                     enum mo_sensor sensor, struct mo_sha256 *hash)
{
  uint8_t bytes[MO_PHYSICS_BYTES_MAX];
  mo_sha256_of(bytes, mo_encode_physics(physics, precision, sensor, bytes), hash);
}

void mo_environment_hash(const struct mo_environment *environment, struct mo_sha256 *hash)
{
  mo_environment_digest(environment, hash);
}
