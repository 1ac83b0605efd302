/* shape.c: components, contiguity and canonical forms against slow and plain versions, in small,
 * odd and large workspaces; and the two implementations (words of voxels, single voxels) against
 * each other. */
#include "../check.h"

#include "morphospace/grid.h"

#include <morpho/morphospace.h>

static const struct mo_workspace workspaces[] = {
    {6, 6, 4},  {1, 1, 1},  {2, 1, 1},  {1, 2, 1}, {1, 1, 5},  {3, 5, 2},
    {6, 4, 4},  {4, 6, 4},  {2, 3, 7},  {8, 8, 8}, {64, 1, 1}, {1, 64, 1},
    {1, 1, 64}, {1, 1, 63}, {3, 33, 2}, {9, 9, 9}, {70, 2, 2}, {5, 13, 5}};
#define WORKSPACES (sizeof(workspaces) / sizeof(workspaces[0]))
#define VOXELS     1024
#define WORDS      16

struct cells {
  int at[VOXELS][3];
  int n;
};

static struct cells unpack(struct mo_workspace w, const uint64_t *bits)
{
  struct cells cells;
  cells.n = 0;
  for (uint32_t v = 0; v < mo_workspace_voxels(w); v++) {
    if (bits[v / 64] >> v % 64 & 1) {
      cells.at[cells.n][0] = (int)(v / w.nz / w.ny);
      cells.at[cells.n][1] = (int)(v / w.nz % w.ny);
      cells.at[cells.n][2] = (int)(v % w.nz);
      cells.n++;
    }
  }
  return cells;
}

static void pack(struct mo_workspace w, const struct cells *cells, uint64_t *bits)
{
  memset(bits, 0, mo_workspace_words(w) * sizeof(uint64_t));
  for (int i = 0; i < cells->n; i++) {
    uint32_t v = ((uint32_t)cells->at[i][0] * w.ny + (uint32_t)cells->at[i][1]) * w.nz +
                 (uint32_t)cells->at[i][2];
    bits[v / 64] |= UINT64_C(1) << v % 64;
  }
}

static void random_bits(struct mo_workspace w, struct mo_random *random, uint64_t *bits)
{
  memset(bits, 0, mo_workspace_words(w) * sizeof(uint64_t));
  uint32_t box[3] = {1 + mo_random_below(random, w.nx), 1 + mo_random_below(random, w.ny),
                     1 + mo_random_below(random, w.nz)};
  uint32_t percent = 10 + mo_random_below(random, 90);
  for (uint32_t v = 0; v < mo_workspace_voxels(w); v++) {
    int inside = v / w.nz / w.ny < box[0] && v / w.nz % w.ny < box[1] && v % w.nz < box[2];
    if (inside && mo_random_below(random, 100) < percent) {
      bits[v / 64] |= UINT64_C(1) << v % 64;
    }
  }
}

/* Labels spread to neighbors until nothing changes. */
static int largest_by_labels(struct mo_workspace w, const uint64_t *bits, uint64_t *largest)
{
  struct cells cells = unpack(w, bits);
  static int label[VOXELS];
  static int size[VOXELS];
  for (int i = 0; i < cells.n; i++) {
    label[i] = i;
    size[i] = 0;
  }
  for (int changed = 1; changed;) {
    changed = 0;
    for (int i = 0; i < cells.n; i++) {
      for (int j = 0; j < i; j++) {
        int far = 0;
        for (int axis = 0; axis < 3; axis++) {
          far += abs(cells.at[i][axis] - cells.at[j][axis]);
        }
        if (far == 1 && label[i] != label[j]) {
          int low = label[i] < label[j] ? label[i] : label[j];
          label[i] = low;
          label[j] = low;
          changed = 1;
        }
      }
    }
  }
  int components = 0;
  int best = 0;
  for (int i = 0; i < cells.n; i++) {
    size[label[i]]++;
  }
  for (int i = 0; i < cells.n; i++) {
    components += label[i] == i;
    best = size[i] > size[best] ? i : best;
  }
  struct cells kept;
  kept.n = 0;
  for (int i = 0; i < cells.n; i++) {
    if (label[i] == best) {
      memcpy(kept.at[kept.n++], cells.at[i], sizeof(cells.at[i]));
    }
  }
  pack(w, &kept, largest);
  return components;
}

static void components(void)
{
  struct mo_random random;
  mo_random_init(&random, 31, MO_PURPOSE_CHECK, 0, 0);
  for (size_t i = 0; i < WORKSPACES; i++) {
    struct mo_workspace w = workspaces[i];
    size_t bytes = mo_workspace_words(w) * sizeof(uint64_t);
    int wrong = 0;
    for (int round = 0; round < (i == 0 ? 1500 : 40); round++) {
      uint64_t bits[WORDS];
      uint64_t expected[WORDS];
      uint64_t kept[WORDS];
      random_bits(w, &random, bits);
      int n = largest_by_labels(w, bits, expected);
      wrong += mo_genotype_is_contiguous(w, bits) != (n == 1);
      memcpy(kept, bits, bytes);
      wrong += mo_genotype_keep_largest(w, kept) != MO_OK || memcmp(kept, expected, bytes) != 0;
      memcpy(kept, bits, bytes);
      wrong += mo_grid_keep_largest(w, kept) != MO_OK || memcmp(kept, expected, bytes) != 0;
    }
    CHECK_INT(wrong, 0);
  }
}

/* Image k by moving cells about; 0 if it does not fit. */
static int image_by_cells(struct mo_workspace w, const uint64_t *bits, unsigned k, uint64_t *image,
                          int side[3])
{
  struct cells cells = unpack(w, bits);
  int low[3] = {VOXELS, VOXELS, VOXELS};
  int high[3] = {-VOXELS, -VOXELS, -VOXELS};
  for (int i = 0; i < cells.n; i++) {
    int *at = cells.at[i];
    if (k & 4) {
      int swapped = at[0];
      at[0] = at[1];
      at[1] = swapped;
    }
    at[0] = k & 1 ? -at[0] : at[0];
    at[1] = k & 2 ? -at[1] : at[1];
    for (int axis = 0; axis < 3; axis++) {
      low[axis] = at[axis] < low[axis] ? at[axis] : low[axis];
      high[axis] = at[axis] > high[axis] ? at[axis] : high[axis];
    }
  }
  const int limit[3] = {w.nx, w.ny, w.nz};
  for (int axis = 0; axis < 3; axis++) {
    side[axis] = high[axis] - low[axis] + 1;
    if (side[axis] > limit[axis]) {
      return 0;
    }
  }
  for (int i = 0; i < cells.n; i++) {
    for (int axis = 0; axis < 3; axis++) {
      cells.at[i][axis] -= low[axis];
    }
  }
  pack(w, &cells, image);
  return 1;
}

static int smaller(struct mo_workspace w, const uint64_t *a, const int a_side[3], const uint64_t *b,
                   const int b_side[3])
{
  for (int axis = 0; axis < 3; axis++) {
    if (a_side[axis] != b_side[axis]) {
      return a_side[axis] < b_side[axis];
    }
  }
  for (uint32_t v = 0; v < mo_workspace_voxels(w); v++) {
    int p = (int)(a[v / 64] >> v % 64 & 1);
    int q = (int)(b[v / 64] >> v % 64 & 1);
    if (p != q) {
      return p < q;
    }
  }
  return 0;
}

static void canonical_forms(void)
{
  struct mo_random random;
  mo_random_init(&random, 32, MO_PURPOSE_CHECK, 0, 0);
  for (size_t i = 0; i < WORKSPACES; i++) {
    struct mo_workspace w = workspaces[i];
    size_t bytes = mo_workspace_words(w) * sizeof(uint64_t);
    int wrong = 0;
    for (int round = 0; round < (i == 0 ? 3000 : 100); round++) {
      uint64_t bits[WORDS];
      uint64_t best[WORDS];
      uint64_t image[WORDS];
      uint64_t form[WORDS];
      int best_side[3];
      int side[3];
      random_bits(w, &random, bits);
      if (mo_genotype_count(w, bits) == 0) {
        continue;
      }
      image_by_cells(w, bits, 0, best, best_side);
      for (unsigned k = 0; k < 8; k++) {
        uint64_t made[WORDS];
        int fits = image_by_cells(w, bits, k, image, side);
        int code = mo_genotype_image(w, bits, k, made);
        wrong += fits ? code != MO_OK || memcmp(made, image, bytes) != 0 : code != MO_ERR_RANGE;
        if (fits && smaller(w, image, side, best, best_side)) {
          memcpy(best, image, bytes);
          memcpy(best_side, side, sizeof(side));
        }
      }
      mo_genotype_canonical(w, bits, form);
      wrong += memcmp(form, best, bytes) != 0;
      struct mo_grid_view view;
      mo_grid_view_canonical(w, bits, &view);
      mo_grid_view_write(w, bits, &view, form);
      wrong += memcmp(form, best, bytes) != 0;
      for (uint32_t v = 0; v < mo_workspace_voxels(w); v++) {
        wrong += mo_grid_view_get(w, bits, &view, v) != (int)(best[v / 64] >> v % 64 & 1);
      }
    }
    CHECK_INT(wrong, 0);
    uint64_t image[WORDS];
    uint64_t one[WORDS] = {1};
    CHECK_INT(mo_genotype_image(w, one, 8, image), MO_ERR_RANGE);
  }
}

/* All images that fit share one id, and so do all places. */
static void one_id_for_all_images(void)
{
  struct mo_random random;
  mo_random_init(&random, 33, MO_PURPOSE_CHECK, 0, 0);
  for (size_t i = 0; i < WORKSPACES; i++) {
    struct mo_workspace w = workspaces[i];
    for (int round = 0; round < (i == 0 ? 2000 : 50); round++) {
      uint64_t bits[WORDS];
      uint64_t image[WORDS];
      char id[VOXELS / 4 + 1];
      char other[VOXELS / 4 + 1];
      REQUIRE(mo_genotype_random(w, &random, bits) == MO_OK);
      mo_genotype_id(w, bits, id);
      int fitting = 0;
      for (unsigned k = 0; k < 8; k++) {
        if (mo_genotype_image(w, bits, k, image) == MO_OK) {
          fitting++;
          mo_genotype_id(w, image, other);
          CHECK_TEXT(other, id);
          mo_genotype_place(w, image);
          mo_genotype_id(w, image, other);
          CHECK_TEXT(other, id);
        }
      }
      CHECK(fitting == 8 || (fitting == 4 && w.nx != w.ny));
    }
  }
}

static void placing_in_both_ways(void)
{
  struct mo_random random;
  mo_random_init(&random, 34, MO_PURPOSE_CHECK, 0, 0);
  for (size_t i = 0; i < WORKSPACES; i++) {
    struct mo_workspace w = workspaces[i];
    size_t bytes = mo_workspace_words(w) * sizeof(uint64_t);
    int wrong = 0;
    for (int round = 0; round < 300; round++) {
      uint64_t a[WORDS];
      uint64_t b[WORDS];
      random_bits(w, &random, a);
      memcpy(b, a, bytes);
      mo_genotype_place(w, a);
      mo_grid_place(w, b);
      wrong += memcmp(a, b, bytes) != 0;
    }
    CHECK_INT(wrong, 0);
  }
}

static void empty(void)
{
  for (size_t i = 0; i < WORKSPACES; i++) {
    struct mo_workspace w = workspaces[i];
    uint64_t bits[WORDS] = {0};
    uint64_t form[WORDS] = {1};
    char id[VOXELS / 4 + 1];
    CHECK_INT(mo_genotype_is_contiguous(w, bits), 0);
    CHECK_INT(mo_genotype_keep_largest(w, bits), MO_OK);
    mo_genotype_place(w, bits);
    CHECK_INT(mo_genotype_count(w, bits), 0);
    mo_genotype_canonical(w, bits, form);
    CHECK_INT(mo_genotype_count(w, form), 0);
    mo_genotype_id(w, bits, id);
    CHECK_INT(strspn(id, "0"), (mo_workspace_voxels(w) + 3) / 4);
    CHECK_INT(mo_genotype_image(w, bits, 5, form), MO_OK);
    CHECK_INT(mo_genotype_count(w, form), 0);
  }
}

static const struct check_case cases[] = {
    {"components and contiguity", components},
    {"images and canonical forms", canonical_forms},
    {"all images of a body share one id", one_id_for_all_images},
    {"both ways of placing agree", placing_in_both_ways},
    {"nothing stays nothing", empty},
};
CHECK_MAIN(cases)
