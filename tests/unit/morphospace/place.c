/* place.c: placement compared with trying every shift. */
#include "plain.h"

static const struct mo_workspace workspaces[] = {{6, 6, 4},   {1, 1, 1},  {2, 1, 1}, {3, 5, 2},
                                                 {6, 4, 4},   {2, 3, 7},  {5, 8, 8}, {9, 9, 9},
                                                 {64, 2, 31}, {1, 1, 70}, {3, 70, 1}};

/* Of all positions on the ground that fit, returns the one whose centroid is nearest to the middle.
 * The distance is exact: squared, times twice the number of cells. */
static void place_by_trying(struct mo_workspace w, const struct cells *cells, uint64_t *best)
{
  uint64_t moved[WORDS_MAX];
  int low = w.nz;
  long long sum[2] = {0, 0}, least = -1;
  for (int i = 0; i < cells->n; i++) {
    low = cells->at[i][2] < low ? cells->at[i][2] : low;
    sum[0] += cells->at[i][0];
    sum[1] += cells->at[i][1];
  }
  for (int dx = -w.nx; dx <= w.nx; dx++)
    for (int dy = -w.ny; dy <= w.ny; dy++) {
      const long long x = 2 * sum[0] + cells->n * (2 * dx - (w.nx - 1)),
                      y = 2 * sum[1] + cells->n * (2 * dy - (w.ny - 1)), d = x * x + y * y;
      if (pack(w, cells, (const int[]){dx, dy, -low}, moved) && (least < 0 || d < least)) {
        least = d;
        memcpy(best, moved, mo_workspace_words(w) * sizeof(uint64_t));
      }
    }
}

static void against_trying(void)
{
  struct mo_random random = dice(11, 0, 0);
  for (size_t i = 0; i < COUNT(workspaces); i++) {
    const struct mo_workspace w = workspaces[i];
    const size_t words = mo_workspace_words(w);
    static struct cells cells;
    int wrong = 0;
    for (int round = 0; round < (mo_workspace_voxels(w) > 200 ? 5 : 60); round++) {
      uint64_t bits[WORDS_MAX], moved[WORDS_MAX], expected[WORDS_MAX] = {0};
      random_bits(w, &random, bits);
      unpack(w, bits, &cells);
      place_by_trying(w, &cells, expected);
      mo_genotype_place(w, bits);
      wrong += !SAME(bits, expected, words) || !is_placed(w, bits);
      /* and from any position where it fits */
      const int shift[3] = {(int)mo_random_below(&random, w.nx),
                            (int)mo_random_below(&random, w.ny),
                            (int)mo_random_below(&random, w.nz)};
      if (pack(w, &cells, shift, moved)) {
        mo_genotype_place(w, moved);
        wrong += !SAME(moved, expected, words);
      }
    }
    CHECK_INT(wrong, 0);
  }
}

static void examples(void)
{
  const struct mo_workspace w = MO_DEFAULT_WORKSPACE;
  /* One voxel: the middle is 2.5, so 2 and 3 are equally near; the first is chosen. */
  const int64_t one[1][3] = {{5, 0, 3}};
  uint64_t bits[3], empty[3] = {0};
  REQUIRE(mo_genotype_from_cells(w, one, 1, bits, NULL) == MO_OK);
  mo_genotype_place(w, bits);
  CHECK(has(bits, (2 * 6 + 2) * 4));
  CHECK_INT(mo_genotype_count(w, bits), 1);
  mo_genotype_place(w, empty);
  CHECK_INT(mo_genotype_count(w, empty), 0);
}

static const struct check_case cases[] = {
    {"placement equals the best of all shifts, again and from anywhere", against_trying},
    {"placement of single voxels", examples},
};
CHECK_MAIN(cases)
