/* format.c: see format.h. */
#include "atlas/format.h"

#include "atlas/losses.h"
#include "morphospace/form_set.h"
#include "world/environment.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* ---- layout ---- */

uint64_t mo_atlas_header_hash(const struct mo_atlas_header *header)
{
  return mo_form_hash((const uint8_t *)header, mo_atlas_header_bytes(header) - sizeof(uint64_t));
}

void mo_atlas_layout_fill(const struct mo_atlas_header *header, struct mo_atlas_layout *layout)
{
  *layout = (struct mo_atlas_layout){
      .n_environments = header->n_environments,
      .n_measures = (uint32_t)__builtin_popcountll(mo_atlas_header_measures(header)),
      .voxels_max = header->voxels_max};
  layout->begins[0] = mo_atlas_header_bytes(header) + header->environments_bytes;
  for (uint32_t i = 0; i < MO_ATLAS_VOXELS_MAX; i++) {
    const uint64_t count = header->counts[i], whole = count / MO_ATLAS_BLOCK;
    const uint32_t rest = (uint32_t)(count % MO_ATLAS_BLOCK);
    layout->counts[i] = count;
    layout->firsts[i + 1] = layout->firsts[i] + count;
    layout->blocks[i + 1] = layout->blocks[i] + whole + (rest > 0);
    layout->begins[i + 1] =
        layout->begins[i] + whole * mo_atlas_block_bytes(layout, MO_ATLAS_BLOCK);
    if (rest > 0)
      layout->begins[i + 1] += mo_atlas_block_bytes(layout, rest);
  }
}

struct mo_atlas_block mo_atlas_block_of(const struct mo_atlas_layout *layout, uint64_t i)
{
  uint32_t size = 0; /* minus 1 */
  while (i >= layout->blocks[size + 1])
    size++;
  const uint64_t before = (i - layout->blocks[size]) * MO_ATLAS_BLOCK;
  const uint64_t left = layout->counts[size] - before;
  struct mo_atlas_block block = {.n_voxels = size + 1,
                                 .n = left < MO_ATLAS_BLOCK ? (uint32_t)left : MO_ATLAS_BLOCK,
                                 .position = layout->firsts[size] + before};
  block.begin = layout->begins[size] +
                (i - layout->blocks[size]) * mo_atlas_block_bytes(layout, MO_ATLAS_BLOCK);
  block.bytes = mo_atlas_block_bytes(layout, block.n);
  return block;
}

/* ---- environments ---- */

static size_t padded(size_t bytes)
{
  return (bytes + 7) / 8 * 8;
}

/* Returns an environment with −0 as 0, so that equal ones have equal bytes. Borrows its grid. */
static struct mo_environment cleared(const struct mo_environment *environment,
                                     struct mo_atlas_environment_header *header)
{
  struct mo_environment clear = *environment;
  mo_fields_clear_minus(&mo_environment_fields, &clear);
  header->version = mo_environment_version(&clear);
  header->bytes = (uint32_t)mo_environment_packed_bytes(&clear, header->version);
  return clear;
}

int mo_atlas_environments_pack(const struct mo_environment *environments, uint32_t n,
                               uint8_t **bytes, size_t *size)
{
  struct mo_atlas_environment_header header;
  size_t all = 0;
  for (uint32_t i = 0; i < n; i++) {
    (void)cleared(&environments[i], &header);
    all += sizeof(header) + padded(header.bytes);
  }
  uint8_t *packed = calloc(1, all > 0 ? all : 1), *to = packed;
  if (packed == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < n; i++) {
    const struct mo_environment environment = cleared(&environments[i], &header);
    memcpy(to, &header, sizeof(header));
    mo_environment_pack(&environment, header.version, to + sizeof(header));
    to += sizeof(header) + padded(header.bytes);
  }
  *bytes = packed;
  *size = all;
  return MO_OK;
}

/* Reads an environment from the beginning of `bytes`. *used: the bytes that it takes. */
static int unpack(const uint8_t *bytes, size_t size, struct mo_environment *environment,
                  size_t *used)
{
  struct mo_atlas_environment_header header;
  size_t packed = 0;
  if (size < sizeof(header))
    return MO_ERR_CORRUPT;
  memcpy(&header, bytes, sizeof(header));
  if (header.bytes > size - sizeof(header) || padded(header.bytes) > size - sizeof(header))
    return MO_ERR_CORRUPT;
  *used = sizeof(header) + padded(header.bytes);
  *environment = mo_environment_defaults;
  if (header.version < 1 || header.version > MO_ENVIRONMENT_VERSION)
    return MO_ERR_CORRUPT;
  int error = mo_environment_unpack(header.version, bytes + sizeof(header), header.bytes,
                                    environment, &packed);
  if (error == MO_OK &&
      (packed != header.bytes || mo_environment_version(environment) != header.version ||
       mo_environment_check(environment, NULL) != MO_OK))
    error = MO_ERR_FORMAT;
  if (error != MO_OK)
    mo_environments_drop(environment, 1);
  return error == MO_OK || error == MO_ERR_NO_MEMORY ? error : MO_ERR_CORRUPT;
}

int mo_atlas_environments_unpack(const uint8_t *bytes, size_t size, uint32_t n,
                                 struct mo_environment **environments)
{
  struct mo_environment *read = calloc(n, sizeof(*read));
  uint32_t done = 0;
  int error = read != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  while (error == MO_OK && done < n) {
    size_t used = 0;
    error = unpack(bytes, size, &read[done], &used);
    if (error == MO_OK) {
      bytes += used;
      size -= used;
      done++;
    }
  }
  if (error == MO_OK && size > 0)
    error = MO_ERR_CORRUPT;
  if (error == MO_OK)
    *environments = read;
  else
    mo_environments_free(read, done);
  return error;
}

/* ---- blocks ---- */

/* Returns whether a block has impossible numbers. */
static bool has_wrong(const struct mo_atlas_layout *layout, const uint8_t *bytes, uint32_t n)
{
  for (uint32_t i = 0; i < n; i++) {
    float score;
    memcpy(&score, bytes + mo_atlas_scores_at(n) + 4 * (size_t)i, sizeof(score));
    if (isnan(score))
      return true;
  }
  for (size_t i = 0; i < (size_t)n * layout->n_environments; i++) {
    uint16_t loss;
    memcpy(&loss, bytes + mo_atlas_losses_at(n) + 2 * i, sizeof(loss));
    if (mo_atlas_loss_is_nan(loss))
      return true;
  }
  for (size_t i = 0; i < (size_t)n * layout->n_measures; i++) {
    uint32_t measure;
    memcpy(&measure, bytes + mo_atlas_measures_at(layout, n) + 4 * i, sizeof(measure));
    if ((measure & 0x7f800000) == 0x7f800000 && measure != MO_ATLAS_NO_VALUE)
      return true;
  }
  return false;
}

int mo_atlas_block_check(const struct mo_atlas_layout *layout, const struct mo_atlas_block *block,
                         const struct mo_atlas_sets *sets, const uint8_t *bytes, bool has_last,
                         uint64_t *last)
{
  const uint64_t end = sets->of[sets->voxels][block->n_voxels];
  const size_t checked = mo_atlas_checksum_at(layout, block->n);
  struct mo_atlas_block_header header;
  uint64_t checksum, before = *last;
  memcpy(&header, bytes, sizeof(header));
  memcpy(&checksum, bytes + checked, sizeof(checksum));
  if (header.n_voxels != block->n_voxels || header.n != block->n ||
      header.position != block->position || checksum != mo_form_hash(bytes, checked) ||
      has_wrong(layout, bytes, block->n))
    return MO_ERR_CORRUPT;
  for (uint32_t i = 0; i < block->n; i++) {
    uint64_t key;
    memcpy(&key, bytes + sizeof(header) + 8 * (size_t)i, sizeof(key));
    if (key >= end || ((has_last || i > 0) && key <= before))
      return MO_ERR_CORRUPT;
    before = key;
  }
  *last = before;
  return MO_OK;
}
