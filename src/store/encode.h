/* encode.h: encodes numbers and records as bytes for the database, little-endian everywhere. */
#ifndef MORPHO_STORE_ENCODE_H
#define MORPHO_STORE_ENCODE_H

#include <stdint.h>

#include "store/records.h"

#define MO_ENVIRONMENT_BYTES (8 * (2 + MO_TERRAIN_HEIGHTS))
#define MO_PHYSICS_BYTES     (1 + 9 * 8 + 5 * 4)
#define MO_BITS_BYTES        18

void mo_encode_u32(uint32_t value, uint8_t bytes[4]);
uint32_t mo_decode_u32(const uint8_t bytes[4]);
void mo_encode_double(double value, uint8_t bytes[8]);
double mo_decode_double(const uint8_t bytes[8]);
void mo_encode_doubles(const double *values, size_t n, uint8_t *bytes);
void mo_decode_doubles(const uint8_t *bytes, size_t n, double *values);
void mo_encode_floats(const float *values, size_t n, uint8_t *bytes);
void mo_decode_floats(const uint8_t *bytes, size_t n, float *values);

void mo_encode_environment(const struct mo_environment *environment,
                           uint8_t bytes[MO_ENVIRONMENT_BYTES]);
void mo_decode_environment(const uint8_t bytes[MO_ENVIRONMENT_BYTES],
                           struct mo_environment *environment);

void mo_encode_physics(const struct mo_physics *physics, enum mo_precision precision,
                       enum mo_sensor sensor, uint8_t bytes[MO_PHYSICS_BYTES]);
/* MO_ERR_CORRUPT: not an encoding of this version. */
int mo_decode_physics(const uint8_t *bytes, size_t size, struct mo_physics *physics,
                      enum mo_precision *precision, enum mo_sensor *sensor);

/* Encodes a genotype as ceil(voxels / 8) bytes, voxel 0 in the top bit of byte 0. */
void mo_encode_bits(const struct mo_bits *bits, uint8_t bytes[MO_BITS_BYTES]);
int mo_decode_bits(const uint8_t *bytes, size_t size, struct mo_bits *bits); /* MO_ERR_CORRUPT */

#endif
