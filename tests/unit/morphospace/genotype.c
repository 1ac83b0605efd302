/* genotype.c: reading and writing cells, text and ids, and what is refused. */
#include "../image.h"
#include "../make.h"

#include <morpho/morphospace.h>

static const struct mo_workspace home = {6, 6, 4};

static void from_cells(void)
{
  static const struct {
    size_t n;
    int64_t cells[4][3];
    int code;
    size_t cell;
    int axis; /* −1 = not set */
    size_t other;
  } refused[] = {
      {0, {{0}}, MO_ERR_EMPTY, 99, -1, 99},
      {3, {{0, 0, 0}, {1, 0, 4}, {9, 9, 9}}, MO_ERR_RANGE, 1, 2, 99},
      {1, {{0, INT64_MIN, 0}}, MO_ERR_RANGE, 0, 1, 99},
      {1, {{INT64_C(1) << 32, 0, 0}}, MO_ERR_RANGE, 0, 0, 99},
      {4, {{0, 0, 0}, {1, 0, 0}, {2, 0, 0}, {1, 0, 0}}, MO_ERR_DUPLICATE, 3, -1, 1},
      {4, {{3, 3, 3}, {3, 3, 2}, {0, 0, 0}, {0, 0, 1}}, MO_ERR_NOT_CONTIGUOUS, 2, -1, 99},
      {2, {{3, 3, 3}, {3, 2, 2}}, MO_ERR_NOT_CONTIGUOUS, 1, -1, 99}, /* an edge does not connect */
      {2, {{0, 0, 3}, {0, 1, 0}}, MO_ERR_NOT_CONTIGUOUS, 1, -1, 99}, /* nor is the end of a column
                                                                        connected */
      {2, {{0, 5, 0}, {1, 0, 0}}, MO_ERR_NOT_CONTIGUOUS, 1, -1, 99}, /* to the start of the next */
  };
  const int64_t good[3][3] = {{0, 0, 0}, {1, 0, 0}, {1, 1, 0}};
  uint64_t bits[3];
  CHECK_INT(mo_genotype_from_cells(home, good, 3, bits, NULL), MO_OK);
  CHECK(bits[0] == (1 | UINT64_C(1) << 24 | UINT64_C(1) << 28) && bits[1] == 0 && bits[2] == 0);
  for (size_t i = 0; i < COUNT(refused); i++) {
    struct mo_cell_fault fault = {99, 99, 99};
    bits[0] = 7;
    CHECK_INT(mo_genotype_from_cells(home, refused[i].cells, refused[i].n, bits, &fault),
              refused[i].code);
    /* Outputs are unchanged, except for cells that can be repaired. */
    CHECK((bits[0] == 7) == (refused[i].code != MO_ERR_NOT_CONTIGUOUS));
    CHECK(refused[i].code == MO_ERR_EMPTY || fault.cell == refused[i].cell);
    CHECK(refused[i].axis < 0 || (int)fault.axis == refused[i].axis);
    CHECK(refused[i].code != MO_ERR_DUPLICATE || fault.other == refused[i].other);
  }
}

static void from_text(void)
{
  char text[145];
  uint64_t bits[3], same[3];
  struct mo_cell_fault fault;
  memset(text, '1', 144);
  CHECK_INT(mo_genotype_from_text(home, text, 144, bits, &fault), MO_OK);
  CHECK_INT(mo_genotype_count(home, bits), 144);
  CHECK(bits[2] == 0xffff);
  memset(text, '0', 144);
  CHECK_INT(mo_genotype_from_text(home, text, 144, bits, &fault), MO_ERR_EMPTY);
  text[143] = '1';
  CHECK_INT(mo_genotype_from_text(home, text, 144, bits, NULL), MO_OK);
  CHECK(bits[0] == 0 && bits[1] == 0 && bits[2] == 0x8000);
  text[7] = '1';
  CHECK_INT(mo_genotype_from_text(home, text, 144, bits, &fault), MO_ERR_NOT_CONTIGUOUS);
  CHECK_INT(fault.cell, 143);
  CHECK(bits[0] == 1 << 7 && bits[2] == 0x8000); /* can be repaired */
  text[100] = '2';
  CHECK_INT(mo_genotype_from_text(home, text, 144, bits, &fault), MO_ERR_FORMAT);
  CHECK_INT(fault.cell, 100);
  CHECK_INT(mo_genotype_from_text(home, text, 143, bits, &fault), MO_ERR_RANGE);
  CHECK_INT(fault.cell, 143);
  CHECK_INT(mo_genotype_from_text(home, text, 145, bits, &fault), MO_ERR_RANGE);
  CHECK_INT(mo_genotype_from_text(home, "", 0, bits, NULL), MO_ERR_RANGE);
  CHECK(bits[0] == 1 << 7 && bits[1] == 0 && bits[2] == 0x8000);

  struct mo_random random = dice(3, 0, 0);
  for (int i = 0; i < 1000; i++) {
    REQUIRE(mo_genotype_random(home, &random, bits) == MO_OK);
    mo_genotype_to_text(home, bits, text);
    CHECK_INT(strlen(text), 144);
    REQUIRE(mo_genotype_from_text(home, text, 144, same, NULL) == MO_OK);
    CHECK(memcmp(bits, same, sizeof(bits)) == 0);
  }
}

static void ids(void)
{
  struct mo_random random = dice(5, 0, 0);
  static const struct mo_workspace several[] = {{6, 6, 4}, {3, 5, 2}, {1, 1, 1},
                                                {2, 1, 1}, {7, 3, 1}, {12, 11, 10}};
  for (size_t i = 0; i < COUNT(several); i++) {
    struct mo_workspace w = several[i];
    size_t digits = (mo_workspace_voxels(w) + 3) / 4;
    for (int round = 0; round < 300; round++) {
      uint64_t bits[21], form[21], same[21] = {0};
      char id[400];
      REQUIRE(mo_genotype_random(w, &random, bits) == MO_OK);
      mo_genotype_id(w, bits, id);
      CHECK_INT(strlen(id), digits);
      mo_genotype_canonical(w, bits, form);
      REQUIRE(mo_genotype_from_id(w, id, digits, same) == MO_OK);
      CHECK(memcmp(form, same, mo_workspace_words(w) * sizeof(uint64_t)) == 0);
      for (size_t v = 0; v < mo_workspace_voxels(w); v++) {
        unsigned digit = (unsigned)(id[v / 4] <= '9' ? id[v / 4] - '0' : id[v / 4] - 'a' + 10);
        CHECK_INT(digit >> (3 - v % 4) & 1, form[v / 64] >> v % 64 & 1);
      }
    }
  }
}

static void bad_ids(void)
{
  static const struct {
    const char *id;
    int code;
  } refused[] = {
      {"80000000000000000000000000000000000", MO_ERR_FORMAT},
      {"8000000000000000000000000000000000000", MO_ERR_FORMAT},
      {"80000000000000000000000000000000000g", MO_ERR_FORMAT},
      {"000000000000000000000000000000000000", MO_ERR_EMPTY},
      {"a00000000000000000000000000000000000", MO_ERR_NOT_CONTIGUOUS},
      {"400000000000000000000000000000000000", MO_ERR_FORMAT}, /* not aligned */
      {"800000800000000000000000000000000000", MO_ERR_FORMAT}, /* lies along x */
  };
  uint64_t form[3] = {7, 7, 7}, upper[3], lower[3];
  for (size_t i = 0; i < COUNT(refused); i++)
    CHECK_INT(mo_genotype_from_id(home, refused[i].id, strlen(refused[i].id), form),
              refused[i].code);
  CHECK(form[0] == 7 && form[1] == 7 && form[2] == 7);
  CHECK_INT(mo_genotype_from_id(home, "800000000000000000000000000000000000", 36, form), MO_OK);
  CHECK(form[0] == 1 && form[1] == 0 && form[2] == 0);
  CHECK_INT(mo_genotype_from_id(home, "F00000000000000000000000000000000000", 36, upper), MO_OK);
  CHECK_INT(mo_genotype_from_id(home, "f00000000000000000000000000000000000", 36, lower), MO_OK);
  CHECK(SAME(upper, lower, 3));
  const struct mo_workspace odd = {3, 1, 1};
  CHECK_INT(mo_genotype_from_id(odd, "e", 1, form), MO_OK);
  CHECK_INT(mo_genotype_from_id(odd, "f", 1, form), MO_ERR_FORMAT); /* a bit past the last voxel */
}

/* Every image of a body has the notation of the smallest K that produces it, and that notation is
 * read back as the placed image. So two images have the same notation only if they are the same
 * robot. */
static void robots(void)
{
  struct mo_random random = dice(6, 0, 0);
  static const struct mo_workspace several[] = {{6, 6, 4}, {3, 5, 2},  {1, 1, 1},
                                                {7, 3, 1}, {2, 40, 3}, {12, 11, 10}};
  for (size_t i = 0; i < COUNT(several); i++) {
    const struct mo_workspace w = several[i];
    const uint32_t words = mo_workspace_words(w);
    const size_t digits = (mo_workspace_voxels(w) + 3) / 4;
    for (int round = 0; round < 300; round++) {
      uint64_t bits[21], image[21], form[21], same[21] = {0}, alone[21] = {0};
      char id[400], robot[400], other[400];
      int k = 9;
      REQUIRE(mo_genotype_random(w, &random, bits) == MO_OK);
      mo_genotype_id(w, bits, id);
      mo_genotype_canonical(w, bits, form);
      for (unsigned turn = 0; turn < MO_ORIENTATIONS; turn++) {
        if (make_image(w, form, turn, image) != MO_OK)
          continue;
        CHECK_INT(mo_genotype_robot(w, image, robot), MO_OK); /* as if it had not been placed */
        mo_genotype_place(w, image);
        CHECK_INT(mo_genotype_robot(w, image, other), MO_OK);
        CHECK_TEXT(other, robot);
        CHECK(strncmp(robot, id, digits) == 0 && strlen(robot) == digits + 2);
        REQUIRE(mo_genotype_from_robot(w, robot, digits + 2, same, &k) == MO_OK);
        CHECK(memcmp(image, same, words * sizeof(uint64_t)) == 0);
        CHECK(k <= (int)turn && robot[digits + 1] == '0' + k);
        for (int less = 0; less < k; less++) {
          const bool fits = make_image(w, form, (unsigned)less, same) == MO_OK;
          if (fits)
            mo_genotype_place(w, same);
          CHECK(!fits || memcmp(image, same, words * sizeof(uint64_t)) != 0);
        }
        if (turn == 0) {
          CHECK_INT(mo_genotype_from_robot(w, id, digits, alone, &k), MO_OK);
          CHECK(k == -1 && memcmp(image, alone, words * sizeof(uint64_t)) == 0);
        }
      }
    }
  }
}

static void bad_robots(void)
{
#define ONE "800000000000000000000000000000000000"
  static const char *const refused[] = {ONE "@",
                                        ONE "@8",
                                        ONE "@-1",
                                        ONE "@00",
                                        ONE "@a",
                                        ONE "@/",
                                        ONE "0",
                                        ONE "#0",
                                        "@0",
                                        "",
                                        "400000000000000000000000000000000000@0"};
  uint64_t bits[3] = {7, 7, 7};
  int k = 9;
  for (size_t i = 0; i < COUNT(refused); i++)
    CHECK_INT(mo_genotype_from_robot(home, refused[i], strlen(refused[i]), bits, &k),
              MO_ERR_FORMAT);
  CHECK_INT(mo_genotype_from_robot(home, "a00000000000000000000000000000000000@0", 38, bits, &k),
            MO_ERR_NOT_CONTIGUOUS);
  CHECK_INT(mo_genotype_from_robot(home, "000000000000000000000000000000000000@0", 38, bits, &k),
            MO_ERR_EMPTY);
  CHECK(bits[0] == 7 && bits[1] == 7 && bits[2] == 7 && k == 9);
  CHECK_INT(mo_genotype_from_robot(home, ONE "@7", 38, bits, &k), MO_OK); /* the same as 0 */
  char robot[MO_DEFAULT_ROBOT_DIGITS + 1];
  CHECK_INT(mo_genotype_robot(home, bits, robot), MO_OK);
  CHECK_TEXT(robot, ONE "@0");
  bits[0] = bits[1] = bits[2] = 0;
  CHECK_INT(mo_genotype_robot(home, bits, robot), MO_ERR_EMPTY);
  /* A row along y fits 1 × 3 × 1 as it is, but not turned. */
  const struct mo_workspace narrow = {1, 3, 1};
  CHECK_INT(mo_genotype_from_robot(narrow, "e@3", 3, bits, &k), MO_OK);
  CHECK_INT(mo_genotype_from_robot(narrow, "e@4", 3, bits, &k), MO_ERR_FORMAT);
#undef ONE
}

static const struct check_case test_cases[] = {
    {"cells are read, or refused with the position of the fault", from_cells},
    {"text is read, or refused with the position of the fault", from_text},
    {"ids spell canonical forms and can be read back", ids},
    {"ids that are not canonical are refused", bad_ids},
    {"robots: every image has one notation, and can be read back", robots},
    {"invalid notations are refused", bad_robots},
};
CHECK_MAIN(test_cases)
