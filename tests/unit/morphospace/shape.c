/* shape.c: components, contiguity and canonical forms compared with slow, plain versions, in small,
 * odd and large workspaces; and the two implementations (words of voxels, single voxels) compared
 * with each other. */
#include "../image.h"
#include "plain.h"

#include "morphospace/grid.h"

static const struct mo_workspace workspaces[] = {
    {6, 6, 4},  {1, 1, 1},  {2, 1, 1},  {1, 2, 1}, {1, 1, 5},  {3, 5, 2},
    {6, 4, 4},  {4, 6, 4},  {2, 3, 7},  {8, 8, 8}, {64, 1, 1}, {1, 64, 1},
    {1, 1, 64}, {1, 1, 63}, {3, 33, 2}, {9, 9, 9}, {70, 2, 2}, {5, 13, 5}};
#define WORKSPACES COUNT(workspaces)
#define VOXELS     1024
#define WORDS      16

/* Spreads labels to neighbors until nothing changes. */
static int largest_by_labels(struct mo_workspace w, const uint64_t *bits, uint64_t *largest)
{
  static struct cells cells, kept;
  static int label[VOXELS], size[VOXELS];
  unpack(w, bits, &cells);
  for (int i = 0; i < cells.n; i++) {
    label[i] = i;
    size[i] = 0;
  }
  for (int changed = 1; changed;) {
    changed = 0;
    for (int i = 0; i < cells.n; i++) {
      for (int j = 0; j < i; j++) {
        int far = 0;
        for (int axis = 0; axis < 3; axis++)
          far += abs(cells.at[i][axis] - cells.at[j][axis]);
        if (far == 1 && label[i] != label[j]) {
          label[i] = label[j] = label[i] < label[j] ? label[i] : label[j];
          changed = 1;
        }
      }
    }
  }
  int components = 0, best = 0;
  for (int i = 0; i < cells.n; i++)
    size[label[i]]++;
  for (int i = 0; i < cells.n; i++) {
    components += label[i] == i;
    best = size[i] > size[best] ? i : best;
  }
  kept.n = 0;
  for (int i = 0; i < cells.n; i++)
    if (label[i] == best)
      memcpy(kept.at[kept.n++], cells.at[i], sizeof(cells.at[i]));
  pack(w, &kept, (const int[3]){0}, largest);
  return components;
}

static void components(void)
{
  struct mo_random random = dice(31, 0, 0);
  for (size_t i = 0; i < WORKSPACES; i++) {
    struct mo_workspace w = workspaces[i];
    const size_t words = mo_workspace_words(w);
    int wrong = 0;
    for (int round = 0; round < (i == 0 ? 1500 : 40); round++) {
      uint64_t bits[WORDS], expected[WORDS], kept[WORDS];
      random_bits(w, &random, bits);
      int n = largest_by_labels(w, bits, expected);
      wrong += mo_genotype_is_contiguous(w, bits) != (n == 1);
      memcpy(kept, bits, words * sizeof(uint64_t));
      wrong += mo_genotype_keep_largest(w, kept) != MO_OK || !SAME(kept, expected, words);
      memcpy(kept, bits, words * sizeof(uint64_t));
      wrong += mo_grid_keep_largest(w, kept) != MO_OK || !SAME(kept, expected, words);
    }
    CHECK_INT(wrong, 0);
  }
}

static int smaller(struct mo_workspace w, const uint64_t *a, const int a_side[3], const uint64_t *b,
                   const int b_side[3])
{
  for (int axis = 0; axis < 3; axis++)
    if (a_side[axis] != b_side[axis])
      return a_side[axis] < b_side[axis];
  for (uint32_t v = 0; v < mo_workspace_voxels(w); v++)
    if (has(a, v) != has(b, v))
      return has(b, v);
  return 0;
}

static void canonical_forms(void)
{
  struct mo_random random = dice(32, 0, 0);
  for (size_t i = 0; i < WORKSPACES; i++) {
    struct mo_workspace w = workspaces[i];
    const size_t words = mo_workspace_words(w);
    int wrong = 0;
    for (int round = 0; round < (i == 0 ? 3000 : 100); round++) {
      uint64_t bits[WORDS], best[WORDS], image[WORDS], made[WORDS], form[WORDS];
      int best_side[3], side[3];
      random_bits(w, &random, bits);
      if (mo_genotype_count(w, bits) == 0)
        continue;
      image_by_cells(w, bits, 0, w, best, best_side);
      for (unsigned k = 0; k < 8; k++) {
        int fits = image_by_cells(w, bits, k, w, image, side);
        int code = make_image(w, bits, k, made);
        wrong += fits ? code != MO_OK || !SAME(made, image, words) : code != MO_ERR_RANGE;
        if (fits && smaller(w, image, side, best, best_side)) {
          memcpy(best, image, words * sizeof(uint64_t));
          memcpy(best_side, side, sizeof(side));
        }
      }
      mo_genotype_canonical(w, bits, form);
      wrong += !SAME(form, best, words);
      struct mo_grid_view view;
      mo_grid_view_canonical(w, bits, &view);
      mo_grid_view_write(w, bits, &view, form);
      wrong += !SAME(form, best, words);
    }
    CHECK_INT(wrong, 0);
  }
}

/* All images that fit have the same id, and so do all positions. */
static void one_id_for_all_images(void)
{
  struct mo_random random = dice(33, 0, 0);
  for (size_t i = 0; i < WORKSPACES; i++) {
    struct mo_workspace w = workspaces[i];
    for (int round = 0; round < (i == 0 ? 2000 : 50); round++) {
      uint64_t bits[WORDS], image[WORDS];
      char id[VOXELS / 4 + 1], other[VOXELS / 4 + 1];
      REQUIRE(mo_genotype_random(w, &random, bits) == MO_OK);
      mo_genotype_id(w, bits, id);
      int fitting = 0;
      for (unsigned k = 0; k < 8; k++) {
        if (make_image(w, bits, k, image) == MO_OK) {
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
  struct mo_random random = dice(34, 0, 0);
  for (size_t i = 0; i < WORKSPACES; i++) {
    struct mo_workspace w = workspaces[i];
    const size_t words = mo_workspace_words(w);
    int wrong = 0;
    for (int round = 0; round < 300; round++) {
      uint64_t a[WORDS], b[WORDS];
      random_bits(w, &random, a);
      memcpy(b, a, words * sizeof(uint64_t));
      mo_genotype_place(w, a);
      mo_grid_place(w, b);
      wrong += !SAME(a, b, words);
    }
    CHECK_INT(wrong, 0);
  }
}

static void empty(void)
{
  for (size_t i = 0; i < WORKSPACES; i++) {
    struct mo_workspace w = workspaces[i];
    uint64_t bits[WORDS] = {0}, form[WORDS] = {1};
    char id[VOXELS / 4 + 1];
    CHECK_INT(mo_genotype_is_contiguous(w, bits), 0);
    CHECK_INT(mo_genotype_keep_largest(w, bits), MO_OK);
    mo_genotype_place(w, bits);
    CHECK_INT(mo_genotype_count(w, bits), 0);
    mo_genotype_canonical(w, bits, form);
    CHECK_INT(mo_genotype_count(w, form), 0);
    mo_genotype_id(w, bits, id);
    CHECK_INT(strspn(id, "0"), (mo_workspace_voxels(w) + 3) / 4);
    CHECK_INT(make_image(w, bits, 5, form), MO_OK);
    CHECK_INT(mo_genotype_count(w, form), 0);
  }
}

static const struct check_case cases[] = {
    {"components and contiguity", components},
    {"images and canonical forms", canonical_forms},
    {"all images of a body share one id", one_id_for_all_images},
    {"both ways of placing agree", placing_in_both_ways},
    {"empty stays empty", empty},
};
CHECK_MAIN(cases)
