/* move.c: moving a genotype to another workspace, compared with a cell-by-cell version. */
#include "plain.h"

static const struct mo_workspace workspaces[] = {{6, 6, 4}, {1, 1, 1}, {2, 1, 1},  {1, 2, 1},
                                                 {3, 5, 2}, {6, 3, 4}, {3, 6, 4},  {8, 2, 9},
                                                 {9, 9, 9}, {2, 2, 2}, {40, 3, 70}};
#define WORKSPACES COUNT(workspaces)

/* Cell by cell: as it is, or turned about the z axis by 90°: x → −y, y → x. */
static int by_cells(struct mo_workspace from, const uint64_t *bits, struct mo_workspace to,
                    uint64_t *moved)
{
  int side[3];
  if (!image_by_cells(from, bits, 0, to, moved, side) &&
      !image_by_cells(from, bits, 5, to, moved, side))
    return MO_ERR_RANGE;
  mo_genotype_place(to, moved);
  return MO_OK;
}

static void random_bodies(void)
{
  uint32_t moved_ones = 0, refused = 0;
  for (size_t a = 0; a < WORKSPACES; a++)
    for (size_t b = 0; b < WORKSPACES; b++)
      for (uint32_t i = 0; i < 40; i++) {
        uint64_t body[WORDS_MAX], moved[WORDS_MAX] = {0}, expected[WORDS_MAX] = {0},
                                  again[WORDS_MAX];
        struct mo_random random = dice(5, i, a * WORKSPACES + b);
        REQUIRE(mo_genotype_random(workspaces[a], &random, body) == MO_OK);
        const int r = by_cells(workspaces[a], body, workspaces[b], expected);
        moved[0] = 77;
        CHECK_INT(mo_genotype_move(workspaces[a], body, workspaces[b], moved), r);
        refused += r != MO_OK;
        if (r != MO_OK) {
          CHECK(moved[0] == 77);
          continue;
        }
        moved_ones++;
        CHECK(SAME(moved, expected, mo_workspace_words(workspaces[b])));
        /* Moved back, it is the same design. */
        char before[3000], after[3000];
        if (mo_genotype_move(workspaces[b], moved, workspaces[a], again) == MO_OK &&
            workspaces[a].nx == workspaces[a].ny) {
          mo_genotype_id(workspaces[a], body, before);
          mo_genotype_id(workspaces[a], again, after);
          CHECK_TEXT(after, before);
        }
      }
  printf("# %u moved, %u do not fit\n", moved_ones, refused);
  CHECK(moved_ones > 1000 && refused > 500);
}

/* Not turned if it fits that way, and turned without mirroring, as an L with three arms shows. */
static void turned(void)
{
  const struct mo_workspace wide = {3, 2, 1}, deep = {2, 3, 1};
  uint64_t body = 0, moved = 0;
  /* y = 1: . . X      x = 1: . X
   * y = 0: X X X      x = 0: . .  … turned left: (x, y) → (1 − y, x) */
  const int64_t cells[][3] = {{0, 0, 0}, {1, 0, 0}, {2, 0, 0}, {2, 1, 0}};
  const int64_t left[][3] = {{1, 0, 0}, {1, 1, 0}, {1, 2, 0}, {0, 2, 0}};
  uint64_t expected = 0;
  REQUIRE(mo_genotype_from_cells(wide, cells, 4, &body, NULL) == MO_OK);
  REQUIRE(mo_genotype_from_cells(deep, left, 4, &expected, NULL) == MO_OK);
  CHECK_INT(mo_genotype_move(wide, &body, deep, &moved), MO_OK);
  CHECK(moved == expected);
  CHECK_INT(mo_genotype_move(wide, &body, wide, &moved), MO_OK);
  CHECK(moved == body);
  uint64_t nothing = 0;
  moved = 9;
  CHECK_INT(mo_genotype_move(wide, &nothing, deep, &moved), MO_OK);
  CHECK(moved == 0);
}

static const struct check_case cases[] = {
    {"random bodies, cell by cell", random_bodies},
    {"turned, not mirrored", turned},
};
CHECK_MAIN(cases)
