/* move.c: a genotype in another workspace, against doing it cell by cell. */
#include "../check.h"

#include <morpho/morphospace.h>

#include <stdbool.h>

static const struct mo_workspace workspaces[] = {{6, 6, 4}, {1, 1, 1}, {2, 1, 1},  {1, 2, 1},
                                                 {3, 5, 2}, {6, 3, 4}, {3, 6, 4},  {8, 2, 9},
                                                 {9, 9, 9}, {2, 2, 2}, {40, 3, 70}};
#define WORKSPACES (sizeof(workspaces) / sizeof(workspaces[0]))
#define WORDS_MAX  160

static bool get(struct mo_workspace w, const uint64_t *bits, uint32_t x, uint32_t y, uint32_t z)
{
  const uint32_t v = (x * w.ny + y) * w.nz + z;
  return bits[v / 64] >> v % 64 & 1;
}

struct cells {
  uint32_t n, low[3], high[3];
  uint32_t at[2048][3];
};

static void list(struct mo_workspace w, const uint64_t *bits, struct cells *cells)
{
  *cells = (struct cells){.low = {~0U, ~0U, ~0U}};
  for (uint32_t x = 0; x < w.nx; x++)
    for (uint32_t y = 0; y < w.ny; y++)
      for (uint32_t z = 0; z < w.nz; z++)
        if (get(w, bits, x, y, z) && cells->n < 2048) {
          const uint32_t at[3] = {x, y, z};
          memcpy(cells->at[cells->n++], at, sizeof(at));
          for (int axis = 0; axis < 3; axis++) {
            cells->low[axis] = at[axis] < cells->low[axis] ? at[axis] : cells->low[axis];
            cells->high[axis] = at[axis] > cells->high[axis] ? at[axis] : cells->high[axis];
          }
        }
}

/* Cell by cell: as it is, or turned about the z axis by 90°: x → −y, y → x. */
static int by_cells(struct mo_workspace from, const uint64_t *bits, struct mo_workspace to,
                    uint64_t *moved)
{
  static struct cells cells;
  list(from, bits, &cells);
  for (int turn = 0; turn < 2; turn++) {
    bool fits = true;
    memset(moved, 0, mo_workspace_words(to) * sizeof(uint64_t));
    for (uint32_t i = 0; i < cells.n && fits; i++) {
      const uint32_t x = cells.at[i][0] - cells.low[0], y = cells.at[i][1] - cells.low[1];
      const uint32_t new_x = turn ? cells.high[1] - cells.low[1] - y : x, new_y = turn ? x : y;
      const uint32_t z = cells.at[i][2] - cells.low[2], v = (new_x * to.ny + new_y) * to.nz + z;
      fits = new_x < to.nx && new_y < to.ny && z < to.nz;
      if (fits)
        moved[v / 64] |= UINT64_C(1) << v % 64;
    }
    if (fits) {
      mo_genotype_place(to, moved);
      return MO_OK;
    }
  }
  return MO_ERR_RANGE;
}

static void random_bodies(void)
{
  uint32_t moved_ones = 0, refused = 0;
  for (size_t a = 0; a < WORKSPACES; a++)
    for (size_t b = 0; b < WORKSPACES; b++)
      for (uint32_t i = 0; i < 40; i++) {
        uint64_t body[WORDS_MAX], moved[WORDS_MAX] = {0}, expected[WORDS_MAX] = {0},
                                  again[WORDS_MAX];
        struct mo_random random;
        mo_random_init(&random, 5, MO_PURPOSE_CHECK, i, a * WORKSPACES + b);
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
        CHECK(memcmp(moved, expected, mo_workspace_words(workspaces[b]) * sizeof(uint64_t)) == 0);
        /* And back it is the same design. */
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

/* Upright while that fits; turned without mirroring: an L of three arms shows it. */
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
