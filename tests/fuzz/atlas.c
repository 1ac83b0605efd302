/* atlas.c: the reader of atlas files, and queries of what it accepts.
 *
 * Byte 0 even: the rest is a file. Odd: the rest is a file whose hash of the environments and
 * checksums are fixed first; otherwise they would reject almost all inputs. Every refusal must be
 * explained. Queries of an accepted file must stay within it, and find each body again. */
#include "target.h"

#include "atlas/file.h"
#include "morphospace/form_set.h"

#include <math.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

static void repair(uint8_t *file, size_t size)
{
  struct mo_atlas_header header;
  struct mo_atlas_layout layout;
  if (size < sizeof(header))
    return;
  memcpy(&header, file, sizeof(header));
  if (header.environments_bytes <= size - mo_atlas_header_bytes(&header))
    mo_sha256_of(file + mo_atlas_header_bytes(&header), header.environments_bytes,
                 &header.environments);
  *mo_atlas_header_checksum(&header) = mo_atlas_header_hash(&header);
  memcpy(file, &header, sizeof(header));
  if (mo_atlas_header_check(&header, size, NULL) != MO_OK)
    return;
  mo_atlas_layout_fill(&header, &layout);
  for (uint64_t i = 0; i < layout.blocks[MO_ATLAS_VOXELS_MAX]; i++) {
    const struct mo_atlas_block block = mo_atlas_block_of(&layout, i);
    const size_t checked = mo_atlas_checksum_at(&layout, block.n);
    FUZZ_PROMISE(block.begin + block.bytes <= size && checked + 8 == block.bytes);
    const uint64_t checksum = mo_form_hash(file + block.begin, checked);
    memcpy(file + block.begin + checked, &checksum, sizeof(checksum));
  }
}

static void use(const struct mo_atlas *atlas)
{
  uint32_t n = 0;
  float losses[MO_ATLAS_ENVIRONMENTS_MAX];
  const struct mo_environment *environments = mo_atlas_environments(atlas, &n);
  FUZZ_PROMISE(n >= 1 && n <= MO_ATLAS_ENVIRONMENTS_MAX);
  for (uint32_t i = 0; i < n; i++)
    FUZZ_PROMISE(mo_environment_check(&environments[i], NULL) == MO_OK);
  for (uint64_t i = 0; i < mo_atlas_bodies_of(atlas); i++) {
    uint64_t form[MO_DEFAULT_WORDS], key = 0, position = 0;
    const uint32_t voxels = mo_atlas_form(atlas, i, form);
    FUZZ_PROMISE(mo_genotype_count(mo_atlas_source_of(atlas)->scope.workspace, form) == voxels);
    FUZZ_PROMISE(mo_atlas_key_at(atlas, i, &key) == voxels);
    FUZZ_PROMISE(mo_atlas_find_key(atlas, voxels, key, &position) == MO_OK && position == i);
    (void)mo_atlas_find(atlas, form, &position); /* a key need not be of a body */
    FUZZ_PROMISE(!isnan(mo_atlas_score(atlas, i)));
    mo_atlas_losses(atlas, i, losses);
    for (uint32_t e = 0; e < n; e++)
      FUZZ_PROMISE(!isnan(losses[e]));
    for (int m = 0; m < MO_MEASURES; m++) {
      const float value = mo_atlas_measure(atlas, i, (enum mo_measure)m);
      const double percentile = mo_atlas_measure_percentile(atlas, i, (enum mo_measure)m);
      FUZZ_PROMISE(!isinf(value) && isnan(percentile) == isnan(value));
      FUZZ_PROMISE(isnan(percentile) || (percentile >= 0 && percentile <= 100));
    }
  }
}

static void read_file(const uint8_t *file, size_t size)
{
  struct mo_message message = {""};
  struct mo_atlas *atlas = NULL;
  char path[64];
  const int fd = memfd_create("atlas", MFD_CLOEXEC);
  FUZZ_PROMISE(fd >= 0 && write(fd, file, size) == (ssize_t)size);
  snprintf(path, sizeof(path), "/proc/self/fd/%d", fd);
  const int error = mo_atlas_open(path, &atlas, &message);
  FUZZ_PROMISE((error == MO_OK) == (atlas != NULL));
  FUZZ_PROMISE((error == MO_OK) == (message.text[0] == '\0'));
  if (atlas != NULL)
    use(atlas);
  mo_atlas_close(atlas);
  (void)close(fd);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  if (size == 0)
    return 0;
  uint8_t *file = malloc(size);
  if (file == NULL)
    return 0;
  memcpy(file, data + 1, size - 1);
  if (data[0] % 2 != 0)
    repair(file, size - 1);
  read_file(file, size - 1);
  free(file);
  return 0;
}
