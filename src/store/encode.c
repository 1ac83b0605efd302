/* encode.c: see encode.h. */
#include "store/encode.h"

#include <string.h>

#include "rollout/physics.h"
#include "world/environment.h"

size_t mo_encoded_environment_bytes(const struct mo_environment *environment)
{
  return mo_environment_packed_bytes(environment, mo_environment_version(environment));
}

size_t mo_encode_environment(const struct mo_environment *environment, uint8_t *bytes)
{
  struct mo_environment encoded = *environment;
  mo_fields_clear_minus(&mo_environment_fields, &encoded);
  mo_environment_pack(&encoded, mo_environment_version(environment), bytes);
  return mo_encoded_environment_bytes(environment);
}

int mo_decode_environment(const uint8_t *bytes, size_t size, struct mo_environment *environment)
{
  int error = MO_ERR_FORMAT;
  *environment = mo_environment_defaults;
  if (bytes == NULL)
    return MO_ERR_CORRUPT;
  /* The size does not identify the version, because a grid can have any size. */
  for (unsigned version = 1; version <= MO_ENVIRONMENT_VERSION && error == MO_ERR_FORMAT;
       version++) {
    size_t used = 0;
    error = mo_environment_unpack(version, bytes, size, environment, &used);
    if (error == MO_OK && (used != size || mo_environment_version(environment) != version ||
                           mo_environment_check(environment, NULL) != MO_OK))
      error = MO_ERR_FORMAT;
    if (error != MO_OK)
      mo_environments_drop(environment, 1);
  }
  return error == MO_OK || error == MO_ERR_NO_MEMORY ? error : MO_ERR_CORRUPT;
}

#define TAIL_BYTES (2 * sizeof(uint32_t)) /* precision, sensor */

size_t mo_encode_physics(const struct mo_physics *physics, enum mo_precision precision,
                         enum mo_sensor sensor, uint8_t bytes[MO_PHYSICS_BYTES_MAX])
{
  const uint32_t tail[] = {(uint32_t)precision, (uint32_t)sensor};
  struct mo_physics encoded = *physics;
  mo_fields_clear_minus(&mo_physics_fields, &encoded);
  if (encoded.scheme.impact == MO_IMPACT_EXACT)
    encoded.scheme.bisections = 0;
  const unsigned version = mo_physics_version(&encoded);
  const size_t size = mo_fields_packed_bytes(&mo_physics_fields, version);
  bytes[0] = (uint8_t)version;
  mo_fields_pack(&mo_physics_fields, version, &encoded, bytes + 1);
  memcpy(bytes + 1 + size, tail, TAIL_BYTES);
  return 1 + size + TAIL_BYTES;
}

int mo_decode_physics(const uint8_t *bytes, size_t size, struct mo_physics *physics,
                      enum mo_precision *precision, enum mo_sensor *sensor)
{
  uint32_t tail[2];
  *physics = mo_paper_physics();
  if (size < 1 || size != 1 + mo_fields_packed_bytes(&mo_physics_fields, bytes[0]) + TAIL_BYTES ||
      !mo_fields_unpack(&mo_physics_fields, bytes[0], bytes + 1, physics) ||
      mo_physics_version(physics) != bytes[0])
    return MO_ERR_CORRUPT;
  memcpy(tail, bytes + size - TAIL_BYTES, TAIL_BYTES);
  if (tail[0] > MO_FLOAT64 || tail[1] > MO_SENSOR_INVERSE_SQUARE)
    return MO_ERR_CORRUPT;
  if (physics->scheme.impact == MO_IMPACT_EXACT)
    physics->scheme.bisections = mo_paper_physics().scheme.bisections;
  *precision = (enum mo_precision)tail[0];
  *sensor = (enum mo_sensor)tail[1];
  return MO_OK;
}

/* Reverses the bits of a byte: genotypes have their first voxel in the top bit. */
static uint8_t reversed(uint8_t byte)
{
  return (uint8_t)((byte * UINT64_C(0x0202020202) & UINT64_C(0x010884422010)) % 1023);
}

_Static_assert(MO_DEFAULT_VOXELS == 8 * MO_BITS_BYTES, "every bit of the bytes is a voxel");

void mo_encode_genotype(const uint64_t words[MO_DEFAULT_WORDS], uint8_t bytes[MO_BITS_BYTES])
{
  for (unsigned i = 0; i < MO_BITS_BYTES; i++)
    bytes[i] = reversed((uint8_t)(words[i >> 3] >> 8 * (i & 7)));
}

int mo_decode_genotype(const uint8_t *bytes, size_t size, struct mo_genotype *genotype)
{
  if (size != MO_BITS_BYTES || bytes == NULL)
    return MO_ERR_CORRUPT;
  *genotype = (struct mo_genotype){.workspace = MO_STORE_WORKSPACE};
  for (unsigned i = 0; i < MO_BITS_BYTES; i++)
    genotype->words[i >> 3] |= (uint64_t)reversed(bytes[i]) << 8 * (i & 7);
  return MO_OK;
}
