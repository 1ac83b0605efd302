/* shape.c: components, placement, canonical forms. Chooses between words of voxels (slabs.inc) and
 * single voxels (grid.h). */
#include "morphospace/bits.h"
#include "morphospace/grid.h"
#include "morphospace/slabs.inc"

/* Runs STATEMENTS with `s` as the slab shape, as a constant if the workspace is the default one. */
#define WITH_SLABS(workspace, statements)                                                          \
  do {                                                                                             \
    uint64_t slab[MO_SLABS_MAX];                                                                   \
    if (mo_workspace_equal(workspace, MO_DEFAULT_WORKSPACE)) {                                     \
      const struct mo_slab_shape s = MO_SLAB_SHAPE_DEFAULT;                                        \
      statements                                                                                   \
    } else {                                                                                       \
      const struct mo_slab_shape s = mo_slabs_shape(workspace);                                    \
      statements                                                                                   \
    }                                                                                              \
  } while (0)

int mo_shape_component(struct mo_workspace workspace, const uint64_t *bits, uint32_t start,
                       uint64_t *reached)
{
  if (!mo_slabs_fit(workspace))
    return mo_grid_component(workspace, bits, start, reached);
  uint64_t part[MO_SLABS_MAX] = {0};
  uint32_t length = (uint32_t)workspace.ny * workspace.nz;
  part[start / length] = UINT64_C(1) << start % length;
  WITH_SLABS(workspace, {
    mo_slabs_load(s, bits, slab);
    mo_slabs_flood(s, slab, part);
    mo_slabs_store(s, part, reached);
  });
  return MO_OK;
}

int mo_genotype_keep_largest(struct mo_workspace workspace, uint64_t *bits)
{
  if (!mo_slabs_fit(workspace))
    return mo_grid_keep_largest(workspace, bits);
  WITH_SLABS(workspace, {
    mo_slabs_load(s, bits, slab);
    mo_slabs_keep_largest(s, slab);
    mo_slabs_store(s, slab, bits);
  });
  return MO_OK;
}

void mo_genotype_place(struct mo_workspace workspace, uint64_t *bits)
{
  if (!mo_slabs_fit(workspace)) {
    mo_grid_place(workspace, bits);
    return;
  }
  WITH_SLABS(workspace, {
    mo_slabs_load(s, bits, slab);
    mo_slabs_place(s, slab);
    mo_slabs_store(s, slab, bits);
  });
}

int mo_genotype_move(struct mo_workspace from, const uint64_t *bits, struct mo_workspace to,
                     uint64_t *moved)
{
  int error = mo_grid_move(from, bits, to, moved);
  if (error == MO_OK)
    mo_genotype_place(to, moved);
  return error;
}

void mo_genotype_canonical(struct mo_workspace workspace, const uint64_t *bits, uint64_t *form)
{
  uint32_t words = mo_workspace_words(workspace);
  if (mo_bits_empty(bits, words)) {
    memset(form, 0, words * sizeof(uint64_t));
    return;
  }
  if (!mo_slabs_fit(workspace)) {
    struct mo_grid_view view;
    mo_grid_view_canonical(workspace, bits, &view);
    mo_grid_view_write(workspace, bits, &view, form);
    return;
  }
  WITH_SLABS(workspace, {
    mo_slabs_load(s, bits, slab);
    mo_slabs_canonical(s, slab);
    mo_slabs_store(s, slab, form);
  });
}

int mo_shape_image(struct mo_workspace workspace, const uint64_t *bits, unsigned k, uint64_t *image)
{
  if (!mo_slabs_fit(workspace)) {
    struct mo_grid_view view;
    const int error = mo_grid_view_image(workspace, bits, k, &view);
    if (error == MO_OK)
      mo_grid_view_write(workspace, bits, &view, image);
    return error;
  }
  WITH_SLABS(workspace, {
    struct mo_slab_image upright;
    mo_slabs_load(s, bits, slab);
    mo_slabs_align(s, slab, &upright);
    if (k & 4 && (upright.dx > s.ny || upright.dy > s.nx))
      return MO_ERR_RANGE;
    mo_slabs_image(s, &upright, k, slab);
    mo_slabs_store(s, slab, image);
  });
  return MO_OK;
}

/* ---- notations ---- */

static void spell(struct mo_workspace workspace, const uint64_t *form, char *id)
{
  static const char digits[] = "0123456789abcdef";
  const uint32_t n = (mo_workspace_voxels(workspace) + 3) / 4;
  for (uint32_t i = 0; i < n; i++) {
    uint64_t nibble = form[i / 16] >> i % 16 * 4;
    id[i] = digits[(nibble & 1) << 3 | (nibble & 2) << 1 | (nibble & 4) >> 1 | (nibble & 8) >> 3];
  }
  id[n] = '\0';
}

int mo_genotype_id(struct mo_workspace workspace, const uint64_t *bits, char *id)
{
  struct mo_scratch form;
  if (mo_scratch_open(&form, mo_workspace_words(workspace)) != MO_OK)
    return MO_ERR_NO_MEMORY;
  mo_genotype_canonical(workspace, bits, form.bits);
  spell(workspace, form.bits, id);
  mo_scratch_close(&form);
  return MO_OK;
}

int mo_genotype_robot(struct mo_workspace workspace, const uint64_t *bits, char *robot)
{
  const uint32_t words = mo_workspace_words(workspace);
  struct mo_scratch form;
  unsigned k = 0;
  if (mo_bits_empty(bits, words))
    return MO_ERR_EMPTY;
  if (mo_scratch_open(&form, 3 * words) != MO_OK)
    return MO_ERR_NO_MEMORY;
  uint64_t *aligned = form.bits + words, *image = aligned + words;
  mo_genotype_canonical(workspace, bits, form.bits);
  (void)mo_shape_image(workspace, bits, 0, aligned); /* image 0 always fits */
  while (mo_shape_image(workspace, form.bits, k, image) != MO_OK ||
         memcmp(image, aligned, words * sizeof(uint64_t)) != 0)
    k++; /* terminates, because the genotype is an image of its form */
  spell(workspace, form.bits, robot);
  robot += strlen(robot);
  robot[0] = '@';
  robot[1] = (char)('0' + k);
  robot[2] = '\0';
  mo_scratch_close(&form);
  return MO_OK;
}
