/* genotype.c: the readers of genotypes: text, id, bytes, cells.
 *
 * Byte 0 chooses the reader, byte 1 the workspace, the rest is the input. An accepted genotype must
 * be valid, must be written back unchanged by the matching writer, and must keep its id under
 * placement and in all images that fit. */
#include "../unit/image.h"
#include "target.h"

#include <morpho/morphospace.h>
#include <string.h>

#define WORDS_MAX  24
#define VOXELS_MAX (WORDS_MAX * 64)

static const struct mo_workspace workspaces[] = {{6, 6, 4}, {1, 1, 1}, {2, 1, 1},  {3, 5, 2},
                                                 {6, 4, 4}, {9, 9, 9}, {1, 70, 1}, {16, 12, 8}};

static void check_body(struct mo_workspace workspace, const uint64_t *bits)
{
  size_t bytes = mo_workspace_words(workspace) * sizeof(uint64_t);
  uint64_t placed[WORDS_MAX];
  uint64_t again[WORDS_MAX];
  char id[VOXELS_MAX / 4 + 1];
  char other[VOXELS_MAX / 4 + 1];
  uint32_t count = mo_genotype_count(workspace, bits);
  FUZZ_PROMISE(mo_genotype_is_contiguous(workspace, bits) == 1);
  FUZZ_PROMISE(count > 0);
  memcpy(placed, bits, bytes);
  mo_genotype_place(workspace, placed);
  memcpy(again, placed, bytes);
  mo_genotype_place(workspace, again);
  FUZZ_PROMISE(memcmp(placed, again, bytes) == 0);
  FUZZ_PROMISE(mo_genotype_count(workspace, placed) == count);
  mo_genotype_id(workspace, bits, id);
  mo_genotype_id(workspace, placed, other);
  FUZZ_PROMISE(strcmp(id, other) == 0);
  FUZZ_PROMISE(mo_genotype_from_id(workspace, id, strlen(id), again) == MO_OK);
  FUZZ_PROMISE(mo_genotype_count(workspace, again) == count);
  for (unsigned k = 0; k < 8; k++) {
    if (make_image(workspace, bits, k, again) == MO_OK) {
      mo_genotype_id(workspace, again, other);
      FUZZ_PROMISE(strcmp(id, other) == 0);
    }
  }
  FUZZ_PROMISE(mo_genotype_keep_largest(workspace, placed) == MO_OK &&
               mo_genotype_count(workspace, placed) == count);
}

static void read_text(struct mo_workspace workspace, const uint8_t *data, size_t size)
{
  uint64_t bits[WORDS_MAX];
  struct mo_cell_fault fault;
  int code = mo_genotype_from_text(workspace, (const char *)data, size, bits, &fault);
  if (code == MO_OK) {
    char text[VOXELS_MAX + 1];
    mo_genotype_to_text(workspace, bits, text);
    FUZZ_PROMISE(strlen(text) == size && memcmp(text, data, size) == 0);
    check_body(workspace, bits);
  } else if (code == MO_ERR_FORMAT || code == MO_ERR_NOT_CONTIGUOUS) {
    FUZZ_PROMISE(fault.cell < size);
  }
}

static void read_id(struct mo_workspace workspace, const uint8_t *data, size_t size)
{
  uint64_t form[WORDS_MAX];
  if (mo_genotype_from_id(workspace, (const char *)data, size, form) == MO_OK) {
    char id[VOXELS_MAX / 4 + 1];
    mo_genotype_id(workspace, form, id);
    FUZZ_PROMISE(strlen(id) == size);
    for (size_t i = 0; i < size; i++) {
      int lower = data[i] >= 'A' && data[i] <= 'F' ? data[i] - 'A' + 'a' : data[i];
      FUZZ_PROMISE(id[i] == lower);
    }
    check_body(workspace, form);
  }
}

static void read_bytes(struct mo_workspace workspace, const uint8_t *data, size_t size)
{
  uint64_t bits[WORDS_MAX];
  uint32_t voxels = mo_workspace_voxels(workspace);
  if (size == (voxels + 7) / 8) {
    memset(bits, 0, sizeof(bits));
    for (uint32_t v = 0; v < voxels; v++)
      bits[v / 64] |= (uint64_t)(data[v / 8] >> v % 8 & 1) << v % 64;
    if (mo_genotype_is_contiguous(workspace, bits) == 1)
      check_body(workspace, bits);
    uint32_t before = mo_genotype_count(workspace, bits);
    FUZZ_PROMISE(mo_genotype_keep_largest(workspace, bits) == MO_OK);
    FUZZ_PROMISE(mo_genotype_count(workspace, bits) <= before);
    if (before > 0)
      check_body(workspace, bits);
  }
}

/* Three bytes per cell, signed, so that near misses are common; the highest values stand for far
 * ones. */
static void read_cells(struct mo_workspace workspace, const uint8_t *data, size_t size)
{
  int64_t cells[512][3];
  uint64_t bits[WORDS_MAX];
  struct mo_cell_fault fault;
  size_t n = size / 3 < 512 ? size / 3 : 512;
  for (size_t i = 0; i < 3 * n; i++) {
    int8_t value = (int8_t)data[i];
    cells[i / 3][i % 3] = value == INT8_MAX ? INT64_MAX : value == INT8_MIN ? INT64_MIN : value;
  }
  int code = mo_genotype_from_cells(workspace, (const int64_t(*)[3])cells, n, bits, &fault);
  if (code == MO_OK) {
    FUZZ_PROMISE(mo_genotype_count(workspace, bits) == n);
    check_body(workspace, bits);
  } else if (code == MO_ERR_RANGE) {
    FUZZ_PROMISE(fault.cell < n && fault.axis >= 0 && fault.axis < 3);
  } else if (code == MO_ERR_DUPLICATE) {
    FUZZ_PROMISE(fault.cell < n && fault.other < fault.cell &&
                 memcmp(cells[fault.cell], cells[fault.other], sizeof(cells[0])) == 0);
  } else if (code == MO_ERR_NOT_CONTIGUOUS) {
    FUZZ_PROMISE(fault.cell > 0 && fault.cell < n);
  } else {
    FUZZ_PROMISE(code == MO_ERR_EMPTY && n == 0);
  }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  if (size < 2)
    return 0;
  struct mo_workspace workspace =
      workspaces[data[1] % (sizeof(workspaces) / sizeof(workspaces[0]))];
  switch (data[0] & 3) {
  case 0: read_text(workspace, data + 2, size - 2); break;
  case 1: read_id(workspace, data + 2, size - 2); break;
  case 2: read_bytes(workspace, data + 2, size - 2); break;
  default: read_cells(workspace, data + 2, size - 2); break;
  }
  return 0;
}
