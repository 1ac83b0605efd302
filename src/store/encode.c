/* encode.c: see encode.h. */
#include "store/encode.h"

#include <string.h>

_Static_assert(sizeof(struct mo_environment) == 8 * (2 + MO_TERRAIN_HEIGHTS),
               "nothing but doubles");

void mo_encode_environment(const struct mo_environment *environment,
                           uint8_t bytes[MO_ENVIRONMENT_BYTES])
{
  struct mo_environment encoded = *environment;
  for (int i = 0; i < 2; i++)
    encoded.light_xy_m[i] += 0.0; /* −0 + 0 is 0 */
  for (int i = 0; i < MO_TERRAIN_HEIGHTS; i++)
    encoded.terrain_heights_m[i] += 0.0;
  memcpy(bytes, &encoded, sizeof(encoded));
}

struct physics_encoding {
  uint8_t version;
  double values[9];
  uint32_t n_steps, impact, bisections, precision, sensor;
} __attribute__((packed));
_Static_assert(sizeof(struct physics_encoding) == MO_PHYSICS_BYTES, "hash.c describes the bytes");

void mo_encode_physics(const struct mo_physics *physics, enum mo_precision precision,
                       enum mo_sensor sensor, uint8_t bytes[MO_PHYSICS_BYTES])
{
  struct physics_encoding encoded = {
      .version = 1,
      .values = {physics->dt_s, physics->stiffness_n_per_m, physics->mass_kg, physics->drag_per_s,
                 physics->gravity_m_per_s2, physics->actuation, physics->friction,
                 physics->friction_cap, physics->drop_height_m},
      .n_steps = physics->n_steps,
      .impact = (uint32_t)physics->impact,
      .bisections = physics->impact == MO_IMPACT_BISECTION ? physics->bisections : 0,
      .precision = (uint32_t)precision,
      .sensor = (uint32_t)sensor};
  for (int i = 0; i < 9; i++)
    encoded.values[i] += 0.0; /* −0 + 0 is 0 */
  memcpy(bytes, &encoded, sizeof(encoded));
}

int mo_decode_physics(const uint8_t *bytes, size_t size, struct mo_physics *physics,
                      enum mo_precision *precision, enum mo_sensor *sensor)
{
  struct physics_encoding found;
  if (size != sizeof(found))
    return MO_ERR_CORRUPT;
  memcpy(&found, bytes, sizeof(found));
  if (found.version != 1 || found.impact > MO_IMPACT_BISECTION || found.precision > MO_FLOAT64 ||
      found.sensor > MO_SENSOR_INVERSE_SQUARE)
    return MO_ERR_CORRUPT;
  *physics = (struct mo_physics){
      .dt_s = found.values[0],
      .n_steps = found.n_steps,
      .stiffness_n_per_m = found.values[1],
      .mass_kg = found.values[2],
      .drag_per_s = found.values[3],
      .gravity_m_per_s2 = found.values[4],
      .actuation = found.values[5],
      .friction = found.values[6],
      .friction_cap = found.values[7],
      .drop_height_m = found.values[8],
      .impact = (enum mo_impact)found.impact,
      .bisections = found.impact == MO_IMPACT_BISECTION ? found.bisections : 8,
  };
  *precision = (enum mo_precision)found.precision;
  *sensor = (enum mo_sensor)found.sensor;
  return MO_OK;
}

/* Reverses the bits of a byte: genotypes have their first voxel in the top bit. */
static uint8_t reversed(uint8_t byte)
{
  return (uint8_t)((byte * UINT64_C(0x0202020202) & UINT64_C(0x010884422010)) % 1023);
}

_Static_assert(MO_DEFAULT_VOXELS == 8 * MO_BITS_BYTES, "every bit of the bytes is a voxel");

void mo_encode_bits(const struct mo_bits *bits, uint8_t bytes[MO_BITS_BYTES])
{
  for (unsigned i = 0; i < MO_BITS_BYTES; i++)
    bytes[i] = reversed((uint8_t)(bits->words[i >> 3] >> 8 * (i & 7)));
}

int mo_decode_bits(const uint8_t *bytes, size_t size, struct mo_bits *bits)
{
  if (size != MO_BITS_BYTES || bytes == NULL)
    return MO_ERR_CORRUPT;
  memset(bits, 0, sizeof(*bits));
  for (unsigned i = 0; i < MO_BITS_BYTES; i++)
    bits->words[i >> 3] |= (uint64_t)reversed(bytes[i]) << 8 * (i & 7);
  return MO_OK;
}
