/* format.h: the layout of an atlas file (docs/atlas.md). Numbers are little-endian, as in memory.
 *
 * A file is a header, the environments, and blocks. The header has the number of bodies of each
 * size, from which the place and size of every block follow. A file without measures has version 1,
 * one with measures version 2. */
#ifndef MORPHO_ATLAS_FORMAT_H
#define MORPHO_ATLAS_FORMAT_H

#include "atlas/key.h"
#include "base/sha256.h"

#include <morpho/measure.h>

_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "files are little-endian");

#define MO_ATLAS_MAGIC    "morphod atlas\r\n"
#define MO_ATLAS_VERSION  1
#define MO_ATLAS_MEASURED 2 /* the version of files with measures */
#define MO_ATLAS_ORDER    UINT32_C(0x01020304)
#define MO_ATLAS_BLOCK    4096 /* bodies of a block; the last block of a size may have fewer */

struct mo_atlas_header {
  char magic[16];
  uint32_t byte_order, version;
  uint32_t sides[3], voxels_max;
  uint32_t orientations, n_environments;
  uint32_t block_bodies, environments_bytes;
  uint64_t counts[MO_ATLAS_VOXELS_MAX]; /* bodies of 1, 2, … voxels */
  struct mo_sha256 controller, physics;
  struct mo_sha256 environments; /* of their bytes in the file */
  char fingerprint[MO_ATLAS_FINGERPRINT];
  uint64_t end[2]; /* version 1: the checksum of the header before this member, and nothing more;
                      version 2: the measures, bit k for measure k of enum mo_measure, and the
                      checksum of everything before it */
};
_Static_assert(sizeof(struct mo_atlas_header) % 8 == 0, "no padding, and blocks are aligned");
_Static_assert(MO_ATLAS_VOXELS_MAX == 10, "a different number of counts needs a new version");

/* Returns the bytes of a header in the file. */
static inline size_t mo_atlas_header_bytes(const struct mo_atlas_header *header)
{
  return sizeof(*header) - (header->version < MO_ATLAS_MEASURED ? sizeof(header->end[1]) : 0);
}
static inline uint64_t mo_atlas_header_measures(const struct mo_atlas_header *header)
{
  return header->version < MO_ATLAS_MEASURED ? 0 : header->end[0];
}
/* Returns the offset of the checksum in a header. */
static inline uint64_t *mo_atlas_header_checksum(struct mo_atlas_header *header)
{
  return &header->end[header->version < MO_ATLAS_MEASURED ? 0 : 1];
}
/* Computes the checksum of a header. */
uint64_t mo_atlas_header_hash(const struct mo_atlas_header *header);

/* Before each environment: the version and size of its packed form (world/environment.h), which
 * follows, zero-padded to a multiple of 8 bytes. */
struct mo_atlas_environment_header {
  uint32_t version, bytes;
};

/* A block: this, then (n) keys of uint64_t, (n) scores of float, (n, n_environments) losses of
 * uint16_t (losses.h), (n_measures, n) measures of float, each zero-padded to a multiple of 8
 * bytes, and the checksum of all of it. A measure without a value is MO_ATLAS_NO_VALUE. */
#define MO_ATLAS_NO_VALUE UINT32_C(0x7fc00000) /* the bits of a NaN */
struct mo_atlas_block_header {
  uint32_t n_voxels, n;
  uint64_t position; /* of the first body */
};

/* Where things are in a file. */
struct mo_atlas_layout {
  uint32_t n_environments, n_measures, voxels_max;
  uint64_t counts[MO_ATLAS_VOXELS_MAX];
  uint64_t firsts[MO_ATLAS_VOXELS_MAX + 1]; /* position of the first body of a size; of the end */
  uint64_t blocks[MO_ATLAS_VOXELS_MAX + 1]; /* index of the first block of a size; of the end */
  uint64_t begins[MO_ATLAS_VOXELS_MAX + 1]; /* where the blocks of a size begin; the file's size */
};
void mo_atlas_layout_fill(const struct mo_atlas_header *header, struct mo_atlas_layout *layout);

/* A block, by its number in the file. */
struct mo_atlas_block {
  uint32_t n_voxels, n;
  uint64_t position, begin;
  size_t bytes;
};
struct mo_atlas_block mo_atlas_block_of(const struct mo_atlas_layout *layout, uint64_t i);

/* Offsets in a block of n bodies; the checksum's is also that of the end of the data. */
static inline size_t mo_atlas_scores_at(uint32_t n)
{
  return sizeof(struct mo_atlas_block_header) + 8 * (size_t)n;
}
static inline size_t mo_atlas_losses_at(uint32_t n)
{
  return mo_atlas_scores_at(n) + (4 * (size_t)n + 7) / 8 * 8;
}
static inline size_t mo_atlas_measures_at(const struct mo_atlas_layout *layout, uint32_t n)
{
  return mo_atlas_losses_at(n) + (2 * (size_t)n * layout->n_environments + 7) / 8 * 8;
}
static inline size_t mo_atlas_checksum_at(const struct mo_atlas_layout *layout, uint32_t n)
{
  return mo_atlas_measures_at(layout, n) + (4 * (size_t)n * layout->n_measures + 7) / 8 * 8;
}
static inline size_t mo_atlas_block_bytes(const struct mo_atlas_layout *layout, uint32_t n)
{
  return mo_atlas_checksum_at(layout, n) + sizeof(uint64_t);
}

/* Writes the bytes of environments as in a file (malloc). MO_ERR_NO_MEMORY. */
int mo_atlas_environments_pack(const struct mo_environment *environments, uint32_t n,
                               uint8_t **bytes, size_t *size);
/* Reads n environments. The caller frees them with mo_environments_free. MO_ERR_CORRUPT,
 * MO_ERR_NO_MEMORY. */
int mo_atlas_environments_unpack(const uint8_t *bytes, size_t size, uint32_t n,
                                 struct mo_environment **environments);

/* Checks the bytes of a block: its header, its checksum, keys that ascend from above *last (which
 * becomes the last key; *has_last: whether there is one), scores and losses that are not NaN, and
 * measures that are finite or without a value. MO_ERR_CORRUPT. */
int mo_atlas_block_check(const struct mo_atlas_layout *layout, const struct mo_atlas_block *block,
                         const struct mo_atlas_sets *sets, const uint8_t *bytes, bool has_last,
                         uint64_t *last);

#endif
