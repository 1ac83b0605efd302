/* Reading and drawing of designs. */
#include "../check.h"

#include <unistd.h>

#include "designs.h"

static void every_form(void)
{
  struct designs designs = no_designs();
  char voxels[VOXELS + 1], text[2048], expected[1024];
  memset(voxels, '0', VOXELS);
  voxels[5] = '1';
  voxels[VOXELS] = 0;
  snprintf(
      text, sizeof(text),
      "# a comment\n{\"cells\": [[0,0,0],\n [1,0,0]], \"name\": "
      "\"two\"}\n%s\n0123456789abcdef0123456789ABCDEF0123, %s\n"
      "[[2,2,0],[2,3,0]]\n[{\"id\":\"x\"}, [[1,1,1]], \"0123456789abcdef0123456789abcdef0123\"]\n"
      "{\"designs\": [{\"cells\": [[3,3,3]]}], \"controller\": \"ignored\"}",
      voxels, voxels);
  designs_add_text(&designs, "test", text, strlen(text));
  CHECK_TEXT(json_string_value(json_array_get(designs.names, 0)), "two");
  CHECK(json_is_null(json_array_get(designs.names, 1)));
  /* The server reports what is wrong with the id "x". */
  snprintf(expected, sizeof(expected),
           "[{\"cells\":[[0,0,0],[1,0,0]]},{\"voxels\":\"%s\"},"
           "{\"id\":\"0123456789abcdef0123456789ABCDEF0123\"},{\"voxels\":\"%s\"},"
           "{\"cells\":[[2,2,0],[2,3,0]]},{\"id\":\"x\"},{\"cells\":[[1,1,1]]},"
           "{\"id\":\"0123456789abcdef0123456789abcdef0123\"},{\"cells\":[[3,3,3]]}]",
           voxels, voxels);
  char *made = json_dumps(designs.list, JSON_COMPACT);
  CHECK_TEXT(made, expected);
  free(made);
}

static void operands(void)
{
  struct designs designs = no_designs();
  char path[] = "/tmp/morphoctl-designs-XXXXXX";
  int fd = mkstemp(path);
  REQUIRE(fd >= 0);
  REQUIRE(write(fd, "[[0,0,0]]\n", 10) == 10);
  close(fd);
  designs_add_operand(&designs, path);
  designs_add_operand(&designs, "0123456789abcdef0123456789abcdef0123");
  designs_add_operand(&designs, "[[1,0,0]]");
  CHECK_INT(json_array_size(designs.list), 3);
  unlink(path);
}

static void drawing(void)
{
  char voxels[VOXELS + 1], *text = NULL;
  size_t length = 0;
  json_t *design = json_loads("{\"cells\": [[0,0,0],[0,0,1],[5,5,0]]}", 0, NULL);
  REQUIRE(design_voxels(design, voxels));
  json_decref(design);
  FILE *memory = open_memstream(&text, &length);
  REQUIRE(memory != NULL);
  draw_body(memory, voxels, false);
  fclose(memory);
  CHECK_TEXT(text, "   z = 0           z = 1        \n"
                   "y  . . . . . ##    . . . . . . \n"
                   "   . . . . . .     . . . . . . \n"
                   "   . . . . . .     . . . . . . \n"
                   "   . . . . . .     . . . . . . \n"
                   "   . . . . . .     . . . . . . \n"
                   "   ##. . . . .     ##. . . . . \n"
                   "   x ->\n");
  free(text);
}

static void ids(void)
{
  char voxels[VOXELS + 1];
  CHECK(robot_voxels("800000000000000000000000000000000001", voxels));
  CHECK(voxels[0] == '1' && voxels[1] == '0' && voxels[143] == '1' && voxels[142] == '0');
  CHECK(!robot_voxels("80000000000000000000000000000000000", voxels));
  CHECK(!robot_voxels("80000000000000000000000000000000000g", voxels));
  /* An L in the plane, along y: image 1 is mirrored in x, and image 5 is swapped first. */
  static const char form[] = "888000800000000000000000000000000000";
  static const char *const images[8] = {"0 4 8 24 ",  "0 24 28 32 ", "0 4 8 32 ",  "8 24 28 32 ",
                                        "0 4 24 48 ", "0 24 48 52 ", "0 4 28 52 ", "4 28 48 52 "};
  for (size_t k = 0; k < 8; k++) {
    char robot[64], places[64] = "";
    snprintf(robot, sizeof(robot), "%s%s@%zu", k % 2 ? "d" : "", form, k);
    CHECK(is_robot(robot, strlen(robot)) && !is_id(robot, strlen(robot)));
    CHECK(robot_voxels(robot, voxels));
    for (size_t v = 0; v < VOXELS; v++)
      if (voxels[v] == '1')
        snprintf(places + strlen(places), sizeof(places) - strlen(places), "%zu ", v);
    CHECK_TEXT(places, images[k]);
  }
  CHECK(!is_robot("800000000000000000000000000000000001@8", 38) &&
        !is_robot("800000000000000000000000000000000001@", 37) &&
        is_robot("d00000000000000000000000000000000001@0", 38));
  /* As written in CSV. */
  CHECK(robot_voxels("d800000000000000000000000000000000001", voxels) && voxels[0] == '1' &&
        voxels[143] == '1');
  CHECK(robot_voxels("d00000000000000000000000000000000001", voxels) &&
        voxels[1] == '1'); /* here d is a digit */
  char genotype[VOXELS + 2] = "g";
  memset(genotype + 1, '0', VOXELS);
  genotype[VOXELS] = '1';
  CHECK(is_voxels(genotype, VOXELS + 1) && !is_voxels(genotype, VOXELS) &&
        !is_voxels(genotype + 1, VOXELS - 1));
  json_t *body = json_pack("{s:s}", "voxels", genotype);
  CHECK(design_voxels(body, voxels) && strcmp(voxels, genotype + 1) == 0);
  json_decref(body);
  json_t *outside = json_loads("{\"cells\": [[0,0,4]]}", 0, NULL);
  CHECK(!design_voxels(outside, voxels));
  json_decref(outside);
}

static const struct check_case cases[] = {
    {"every form of input", every_form},
    {"operands", operands},
    {"drawing", drawing},
    {"ids", ids},
};
CHECK_MAIN(cases)
