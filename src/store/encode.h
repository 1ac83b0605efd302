/* encode.h: records as bytes in the database. Numbers are little-endian, as in memory. */
#ifndef MORPHO_STORE_ENCODE_H
#define MORPHO_STORE_ENCODE_H

#include <stdint.h>

#include "store/records.h"

_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "rows are little-endian");

/* Without a custom grid. */
#define MO_ENVIRONMENT_BYTES_MAX sizeof(struct mo_environment)
#define MO_PHYSICS_BYTES_MAX     (1 + sizeof(struct mo_physics) + 2 * sizeof(uint32_t))
#define MO_BITS_BYTES            18

/* Returns the number of bytes written: the packed form (world/environment.h), which has a different
 * size in each version. Writes −0 as 0, so that equal environments have one row and are computed
 * once. bytes: mo_encoded_environment_bytes. */
size_t mo_encode_environment(const struct mo_environment *environment, uint8_t *bytes);
size_t mo_encoded_environment_bytes(const struct mo_environment *environment);
/* The caller drops the environment's grid (mo_environments_drop); after an error, it has no grid.
 * MO_ERR_CORRUPT: invalid encoding; MO_ERR_NO_MEMORY. */
int mo_decode_environment(const uint8_t *bytes, size_t size, struct mo_environment *environment);

/* Returns the number of bytes written: the version of the packed form (rollout/physics.h) in a
 * byte, the packed form, then precision and sensor in 32 bits. Equal values have one encoding: −0
 * is written as 0, and the bisections of an exact impact as 0. */
size_t mo_encode_physics(const struct mo_physics *physics, enum mo_precision precision,
                         enum mo_sensor sensor, uint8_t bytes[MO_PHYSICS_BYTES_MAX]);
/* MO_ERR_CORRUPT: invalid encoding. */
int mo_decode_physics(const uint8_t *bytes, size_t size, struct mo_physics *physics,
                      enum mo_precision *precision, enum mo_sensor *sensor);

/* Encodes the words of a genotype of the store's workspace as ceil(voxels / 8) bytes, voxel 0 in
 * the top bit of byte 0. */
void mo_encode_genotype(const uint64_t words[MO_DEFAULT_WORDS], uint8_t bytes[MO_BITS_BYTES]);
/* MO_ERR_CORRUPT. */
int mo_decode_genotype(const uint8_t *bytes, size_t size, struct mo_genotype *genotype);

#endif
