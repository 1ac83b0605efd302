/* encode.c: fixed little-endian layouts. */
#include "store/encode.h"

#include <string.h>

void mo_encode_u32(uint32_t value, uint8_t bytes[4])
{
  for (int i = 0; i < 4; i++)
    bytes[i] = (uint8_t)(value >> (8 * i));
}

uint32_t mo_decode_u32(const uint8_t bytes[4])
{
  uint32_t value = 0;
  for (int i = 3; i >= 0; i--)
    value = (value << 8) | bytes[i];
  return value;
}

void mo_encode_double(double value, uint8_t bytes[8])
{
  uint64_t word;
  memcpy(&word, &value, sizeof(word));
  for (int i = 0; i < 8; i++)
    bytes[i] = (uint8_t)(word >> (8 * i));
}

double mo_decode_double(const uint8_t bytes[8])
{
  uint64_t word = 0;
  double value;
  for (int i = 7; i >= 0; i--)
    word = (word << 8) | bytes[i];
  memcpy(&value, &word, sizeof(value));
  return value;
}

void mo_encode_doubles(const double *values, size_t n, uint8_t *bytes)
{
  for (size_t i = 0; i < n; i++)
    mo_encode_double(values[i], bytes + 8 * i);
}

void mo_decode_doubles(const uint8_t *bytes, size_t n, double *values)
{
  for (size_t i = 0; i < n; i++)
    values[i] = mo_decode_double(bytes + 8 * i);
}

void mo_encode_floats(const float *values, size_t n, uint8_t *bytes)
{
  for (size_t i = 0; i < n; i++) {
    uint32_t word;
    memcpy(&word, &values[i], sizeof(word));
    mo_encode_u32(word, bytes + 4 * i);
  }
}

void mo_decode_floats(const uint8_t *bytes, size_t n, float *values)
{
  for (size_t i = 0; i < n; i++) {
    uint32_t word = mo_decode_u32(bytes + 4 * i);
    memcpy(&values[i], &word, sizeof(word));
  }
}

/* Writes −0 as 0, so that equal environments have one row and are computed once. */
void mo_encode_environment(const struct mo_environment *environment,
                           uint8_t bytes[MO_ENVIRONMENT_BYTES])
{
  for (size_t i = 0; i < 2 + MO_TERRAIN_HEIGHTS; i++) {
    double value = i < 2 ? environment->light_xy_m[i] : environment->terrain_heights_m[i - 2];
    mo_encode_double(value == 0.0 ? 0.0 : value, bytes + 8 * i);
  }
}

void mo_decode_environment(const uint8_t bytes[MO_ENVIRONMENT_BYTES],
                           struct mo_environment *environment)
{
  mo_decode_doubles(bytes, 2, environment->light_xy_m);
  mo_decode_doubles(bytes + 16, MO_TERRAIN_HEIGHTS, environment->terrain_heights_m);
}

void mo_encode_physics(const struct mo_physics *physics, enum mo_precision precision,
                       enum mo_sensor sensor, uint8_t bytes[MO_PHYSICS_BYTES])
{
  const double values[9] = {
      physics->dt_s,       physics->stiffness_n_per_m, physics->mass_kg,
      physics->drag_per_s, physics->gravity_m_per_s2,  physics->actuation,
      physics->friction,   physics->friction_cap,      physics->drop_height_m};
  uint8_t *words = bytes + 1 + 9 * 8;
  bytes[0] = 1;
  for (size_t i = 0; i < 9; i++)
    mo_encode_double(values[i] == 0.0 ? 0.0 : values[i], bytes + 1 + 8 * i);
  mo_encode_u32(physics->n_steps, words);
  mo_encode_u32((uint32_t)physics->impact, words + 4);
  mo_encode_u32(physics->impact == MO_IMPACT_BISECTION ? physics->bisections : 0, words + 8);
  mo_encode_u32((uint32_t)precision, words + 12);
  mo_encode_u32((uint32_t)sensor, words + 16);
}

int mo_decode_physics(const uint8_t *bytes, size_t size, struct mo_physics *physics,
                      enum mo_precision *precision, enum mo_sensor *sensor)
{
  const uint8_t *words;
  uint32_t impact, chosen_precision, chosen_sensor;
  if (size != MO_PHYSICS_BYTES || bytes[0] != 1)
    return MO_ERR_CORRUPT;
  words = bytes + 1 + 9 * 8;
  impact = mo_decode_u32(words + 4);
  chosen_precision = mo_decode_u32(words + 12);
  chosen_sensor = mo_decode_u32(words + 16);
  if (impact > MO_IMPACT_BISECTION || chosen_precision > MO_FLOAT64 ||
      chosen_sensor > MO_SENSOR_INVERSE_SQUARE)
    return MO_ERR_CORRUPT;
  *physics = (struct mo_physics){
      .dt_s = mo_decode_double(bytes + 1),
      .n_steps = mo_decode_u32(words),
      .stiffness_n_per_m = mo_decode_double(bytes + 9),
      .mass_kg = mo_decode_double(bytes + 17),
      .drag_per_s = mo_decode_double(bytes + 25),
      .gravity_m_per_s2 = mo_decode_double(bytes + 33),
      .actuation = mo_decode_double(bytes + 41),
      .friction = mo_decode_double(bytes + 49),
      .friction_cap = mo_decode_double(bytes + 57),
      .drop_height_m = mo_decode_double(bytes + 65),
      .impact = (enum mo_impact)impact,
      .bisections = impact == MO_IMPACT_BISECTION ? mo_decode_u32(words + 8) : 8,
  };
  *precision = (enum mo_precision)chosen_precision;
  *sensor = (enum mo_sensor)chosen_sensor;
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
