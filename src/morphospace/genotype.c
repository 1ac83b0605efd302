/* genotype.c: converts genotypes from and to lists of cells, text and bytes; counts and compares
 * genotypes. */
#include <morpho/morphospace.h>

#include "base/text.h"
#include "morphospace/bits.h"
#include "morphospace/grid.h"

#include <string.h>

static uint32_t voxel_of(struct mo_workspace workspace, const int64_t cell[3])
{
  return ((uint32_t)cell[0] * workspace.ny + (uint32_t)cell[1]) * workspace.nz + (uint32_t)cell[2];
}

static void report_fault(struct mo_cell_fault *fault, size_t cell, size_t other, int axis)
{
  if (fault != NULL)
    *fault = (struct mo_cell_fault){.cell = cell, .other = other, .axis = axis};
}

/* Sets the cells in `bits`; stops at the first cell outside the workspace or already set. */
static int set_cells(struct mo_workspace workspace, const int64_t (*cells)[3], size_t n,
                     uint64_t *bits, struct mo_cell_fault *fault)
{
  const int64_t side[3] = {workspace.nx, workspace.ny, workspace.nz};
  for (size_t i = 0; i < n; i++) {
    for (int axis = 0; axis < 3; axis++) {
      if (cells[i][axis] < 0 || cells[i][axis] >= side[axis]) {
        report_fault(fault, i, 0, axis);
        return MO_ERR_RANGE;
      }
    }
    uint32_t voxel = voxel_of(workspace, cells[i]);
    if (mo_bits_get(bits, voxel)) {
      size_t earlier = 0;
      while (voxel_of(workspace, cells[earlier]) != voxel)
        earlier++;
      report_fault(fault, i, earlier, 0);
      return MO_ERR_DUPLICATE;
    }
    mo_bits_set(bits, voxel);
  }
  return MO_OK;
}

int mo_genotype_from_cells(struct mo_workspace workspace, const int64_t (*cells)[3], size_t n,
                           uint64_t *bits, struct mo_cell_fault *fault)
{
  uint32_t words = mo_workspace_words(workspace);
  if (n == 0) {
    report_fault(fault, 0, 0, 0);
    return MO_ERR_EMPTY;
  }
  struct mo_scratch all;
  if (mo_scratch_open(&all, 2 * words) != MO_OK)
    return MO_ERR_NO_MEMORY;
  uint64_t *reached = all.bits + words;
  int code = set_cells(workspace, cells, n, all.bits, fault);
  if (code == MO_OK)
    code = mo_shape_component(workspace, all.bits, voxel_of(workspace, cells[0]), reached);
  for (size_t i = 1; code == MO_OK && i < n; i++) {
    if (!mo_bits_get(reached, voxel_of(workspace, cells[i]))) {
      report_fault(fault, i, 0, 0);
      code = MO_ERR_NOT_CONTIGUOUS;
    }
  }
  if (code == MO_OK || code == MO_ERR_NOT_CONTIGUOUS)
    memcpy(bits, all.bits, words * sizeof(uint64_t));
  mo_scratch_close(&all);
  return code;
}

/* Finds the first voxel that is not connected to the lowest one. MO_OK: all are connected. */
static int find_apart(struct mo_workspace workspace, const uint64_t *bits, uint32_t *apart)
{
  uint32_t words = mo_workspace_words(workspace);
  uint32_t first = 0;
  while (first < words && bits[first] == 0)
    first++;
  if (first == words) {
    *apart = 0;
    return MO_ERR_EMPTY;
  }
  struct mo_scratch reached;
  if (mo_scratch_open(&reached, words) != MO_OK)
    return MO_ERR_NO_MEMORY;
  int code = mo_shape_component(workspace, bits,
                                first * 64 + (uint32_t)__builtin_ctzll(bits[first]), reached.bits);
  for (uint32_t w = 0; code == MO_OK && w < words; w++) {
    uint64_t rest = bits[w] & ~reached.bits[w];
    if (rest != 0) {
      *apart = w * 64 + (uint32_t)__builtin_ctzll(rest);
      code = MO_ERR_NOT_CONTIGUOUS;
    }
  }
  mo_scratch_close(&reached);
  return code;
}

int mo_genotype_is_contiguous(struct mo_workspace workspace, const uint64_t *bits)
{
  uint32_t apart;
  int code = find_apart(workspace, bits, &apart);
  return code == MO_OK ? 1 : code == MO_ERR_NO_MEMORY ? code : 0;
}

int mo_genotype_from_text(struct mo_workspace workspace, const char *text, size_t length,
                          uint64_t *bits, struct mo_cell_fault *fault)
{
  uint32_t voxels = mo_workspace_voxels(workspace);
  uint32_t words = mo_workspace_words(workspace);
  if (length != voxels) {
    report_fault(fault, length, 0, 0);
    return MO_ERR_RANGE;
  }
  struct mo_scratch scratch;
  if (mo_scratch_open(&scratch, words) != MO_OK)
    return MO_ERR_NO_MEMORY;
  int code = MO_OK;
  uint32_t place = 0;
  for (uint32_t v = 0; code == MO_OK && v < voxels; v++) {
    if (text[v] == '1') {
      mo_bits_set(scratch.bits, v);
    } else if (text[v] != '0') {
      place = v;
      code = MO_ERR_FORMAT;
    }
  }
  if (code == MO_OK)
    code = find_apart(workspace, scratch.bits, &place);
  if (code == MO_OK || code == MO_ERR_NOT_CONTIGUOUS)
    memcpy(bits, scratch.bits, words * sizeof(uint64_t));
  if (code != MO_OK && code != MO_ERR_NO_MEMORY)
    report_fault(fault, place, 0, 0);
  mo_scratch_close(&scratch);
  return code;
}

void mo_genotype_to_text(struct mo_workspace workspace, const uint64_t *bits, char *text)
{
  uint32_t voxels = mo_workspace_voxels(workspace);
  for (uint32_t v = 0; v < voxels; v++)
    text[v] = mo_bits_get(bits, v) ? '1' : '0';
  text[voxels] = '\0';
}

uint32_t mo_genotype_count(struct mo_workspace workspace, const uint64_t *bits)
{
  return mo_bits_count(bits, mo_workspace_words(workspace));
}

struct mo_genotype mo_genotype_of(struct mo_workspace workspace, const struct mo_bits *bits)
{
  struct mo_genotype genotype = {.workspace = workspace};
  memcpy(genotype.words, bits->words, sizeof(genotype.words));
  return genotype;
}

bool mo_genotype_equal(const struct mo_genotype *a, const struct mo_genotype *b)
{
  return mo_workspace_equal(a->workspace, b->workspace) &&
         memcmp(a->words, b->words, sizeof(a->words)) == 0;
}

struct mo_genotype mo_genotype_form(const struct mo_genotype *genotype)
{
  struct mo_genotype form = {.workspace = genotype->workspace};
  mo_genotype_canonical(genotype->workspace, genotype->words, form.words);
  return form;
}

/* ---- ids ---- */

/* Reads bits from the digits. MO_ERR_FORMAT: any other character, or bits past the last voxel. */
static int read_digits(uint32_t voxels, const char *id, size_t n, uint64_t *bits)
{
  for (size_t i = 0; i < n; i++) {
    const int value = mo_hex_digit(id[i]);
    if (value < 0)
      return MO_ERR_FORMAT;
    uint64_t nibble =
        (uint64_t)((value & 1) << 3 | (value & 2) << 1 | (value & 4) >> 1 | (value & 8) >> 3);
    if (i + 1 == n && voxels % 4 != 0 && nibble >> voxels % 4 != 0)
      return MO_ERR_FORMAT;
    bits[i / 16] |= nibble << i % 16 * 4;
  }
  return MO_OK;
}

int mo_genotype_from_id(struct mo_workspace workspace, const char *id, size_t length,
                        uint64_t *form)
{
  uint32_t voxels = mo_workspace_voxels(workspace);
  uint32_t words = mo_workspace_words(workspace);
  if (length != (voxels + 3) / 4)
    return MO_ERR_FORMAT;
  struct mo_scratch given;
  if (mo_scratch_open(&given, 2 * words) != MO_OK)
    return MO_ERR_NO_MEMORY;
  uint64_t *canonical = given.bits + words;
  uint32_t apart;
  int code = read_digits(voxels, id, length, given.bits);
  if (code == MO_OK)
    code = find_apart(workspace, given.bits, &apart);
  if (code == MO_OK) {
    mo_genotype_canonical(workspace, given.bits, canonical);
    if (memcmp(given.bits, canonical, words * sizeof(uint64_t)) != 0)
      code = MO_ERR_FORMAT;
    else
      memcpy(form, given.bits, words * sizeof(uint64_t));
  }
  mo_scratch_close(&given);
  return code;
}

int mo_genotype_from_robot(struct mo_workspace workspace, const char *robot, size_t length,
                           uint64_t *bits, int *orientation)
{
  const uint32_t words = mo_workspace_words(workspace);
  const size_t digits = (mo_workspace_voxels(workspace) + 3) / 4;
  int k = -1;
  if (length == digits + 2 && robot[digits] == '@')
    k = robot[digits + 1] - '0';
  if (k < 0 ? length != digits : k >= MO_ORIENTATIONS)
    return MO_ERR_FORMAT;
  struct mo_scratch form;
  if (mo_scratch_open(&form, 2 * words) != MO_OK)
    return MO_ERR_NO_MEMORY;
  uint64_t *image = form.bits + words;
  int code = mo_genotype_from_id(workspace, robot, digits, form.bits);
  if (code == MO_OK && mo_shape_image(workspace, form.bits, k < 0 ? 0 : (unsigned)k, image) != 0)
    code = MO_ERR_FORMAT;
  if (code == MO_OK) {
    mo_genotype_place(workspace, image);
    memcpy(bits, image, words * sizeof(uint64_t));
    *orientation = k;
  }
  mo_scratch_close(&form);
  return code;
}
