/* place.c: placement against trying every shift. */
#include "../check.h"

#include <morpho/morphospace.h>

static const struct mo_workspace workspaces[] = {{6, 6, 4},   {1, 1, 1},  {2, 1, 1}, {3, 5, 2},
                                                 {6, 4, 4},   {2, 3, 7},  {5, 8, 8}, {9, 9, 9},
                                                 {64, 2, 31}, {1, 1, 70}, {3, 70, 1}};
#define WORKSPACES (sizeof(workspaces) / sizeof(workspaces[0]))
#define WORDS_MAX  64

static int get(const uint64_t *bits, uint32_t v)
{
  return (int)(bits[v / 64] >> v % 64 & 1);
}

/* The genotype moved by (dx, dy, dz); 0 if a voxel would leave the workspace. */
static int move(struct mo_workspace w, const uint64_t *bits, int dx, int dy, int dz,
                uint64_t *moved)
{
  memset(moved, 0, mo_workspace_words(w) * sizeof(uint64_t));
  for (int x = 0; x < w.nx; x++) {
    for (int y = 0; y < w.ny; y++) {
      for (int z = 0; z < w.nz; z++) {
        if (get(bits, (uint32_t)((x * w.ny + y) * w.nz + z))) {
          int p = x + dx;
          int q = y + dy;
          int r = z + dz;
          if (p < 0 || p >= w.nx || q < 0 || q >= w.ny || r < 0 || r >= w.nz) {
            return 0;
          }
          uint32_t v = (uint32_t)((p * w.ny + q) * w.nz + r);
          moved[v / 64] |= UINT64_C(1) << v % 64;
        }
      }
    }
  }
  return 1;
}

/* Twice n times the distance of the centroid from the middle, squared: exact. */
static long long distance(struct mo_workspace w, const uint64_t *bits)
{
  long long n = 0;
  long long x = 0;
  long long y = 0;
  for (uint32_t v = 0; v < mo_workspace_voxels(w); v++) {
    if (get(bits, v)) {
      n++;
      x += v / w.nz / w.ny;
      y += v / w.nz % w.ny;
    }
  }
  x = 2 * x - n * (w.nx - 1);
  y = 2 * y - n * (w.ny - 1);
  return x * x + y * y;
}

static void place_by_trying(struct mo_workspace w, const uint64_t *bits, uint64_t *best)
{
  uint64_t moved[WORDS_MAX];
  uint32_t low = w.nz;
  for (uint32_t v = 0; v < mo_workspace_voxels(w); v++) {
    if (get(bits, v) && v % w.nz < low) {
      low = v % w.nz;
    }
  }
  long long least = -1;
  for (int dx = -w.nx; dx <= w.nx; dx++) {
    for (int dy = -w.ny; dy <= w.ny; dy++) {
      if (move(w, bits, dx, dy, -(int)low, moved)) {
        long long d = distance(w, moved);
        if (least < 0 || d < least) {
          least = d;
          memcpy(best, moved, mo_workspace_words(w) * sizeof(uint64_t));
        }
      }
    }
  }
}

static void random_bits(struct mo_workspace w, struct mo_random *random, uint64_t *bits)
{
  memset(bits, 0, mo_workspace_words(w) * sizeof(uint64_t));
  uint32_t box[3] = {1 + mo_random_below(random, w.nx), 1 + mo_random_below(random, w.ny),
                     1 + mo_random_below(random, w.nz)};
  uint32_t one_in = 1 + mo_random_below(random, 4);
  for (uint32_t v = 0; v < mo_workspace_voxels(w); v++) {
    int inside = v / w.nz / w.ny < box[0] && v / w.nz % w.ny < box[1] && v % w.nz < box[2];
    if (inside && mo_random_below(random, one_in) == 0) {
      bits[v / 64] |= UINT64_C(1) << v % 64;
    }
  }
}

static void against_trying(void)
{
  struct mo_random random;
  mo_random_init(&random, 11, MO_PURPOSE_CHECK, 0, 0);
  for (size_t i = 0; i < WORKSPACES; i++) {
    struct mo_workspace w = workspaces[i];
    size_t bytes = mo_workspace_words(w) * sizeof(uint64_t);
    int wrong = 0;
    for (int round = 0; round < (mo_workspace_voxels(w) > 200 ? 5 : 60); round++) {
      uint64_t bits[WORDS_MAX];
      uint64_t placed[WORDS_MAX];
      uint64_t expected[WORDS_MAX] = {0};
      random_bits(w, &random, bits);
      memcpy(placed, bits, bytes);
      mo_genotype_place(w, placed);
      place_by_trying(w, bits, expected);
      wrong += memcmp(placed, expected, bytes) != 0;
      /* again, and from wherever it fits */
      mo_genotype_place(w, placed);
      wrong += memcmp(placed, expected, bytes) != 0;
      uint64_t moved[WORDS_MAX];
      int dx = (int)mo_random_below(&random, w.nx);
      int dy = (int)mo_random_below(&random, w.ny);
      int dz = (int)mo_random_below(&random, w.nz);
      if (move(w, bits, dx, dy, dz, moved)) {
        mo_genotype_place(w, moved);
        wrong += memcmp(moved, expected, bytes) != 0;
      }
    }
    CHECK_INT(wrong, 0);
  }
}

static void examples(void)
{
  struct mo_workspace w = MO_DEFAULT_WORKSPACE;
  /* One voxel: the middle is 2.5, both 2 and 3 are as near, the first is taken. */
  const int64_t one[1][3] = {{5, 0, 3}};
  uint64_t bits[3];
  REQUIRE(mo_genotype_from_cells(w, one, 1, bits, NULL) == MO_OK);
  mo_genotype_place(w, bits);
  uint32_t v = (2 * 6 + 2) * 4;
  CHECK(get(bits, v));
  CHECK_INT(mo_genotype_count(w, bits), 1);
  /* An empty one stays empty. */
  uint64_t empty[3] = {0};
  mo_genotype_place(w, empty);
  CHECK_INT(mo_genotype_count(w, empty), 0);
}

static const struct check_case cases[] = {
    {"placement equals the best of all shifts, again and from anywhere", against_trying},
    {"placement of single voxels", examples},
};
CHECK_MAIN(cases)
