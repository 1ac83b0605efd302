/* draw.c: draws a body as text. Each layer is a grid seen from above: x to the right, y up. */
#include <string.h>

#include "designs.h"

static bool filled(const char *voxels, int x, int y, int z)
{
  return voxels[(x * WORKSPACE_Y + y) * WORKSPACE_Z + z] == '1';
}

void draw_body(FILE *file, const char voxels[VOXELS + 1], bool utf8)
{
  int highest = 0;
  for (int x = 0; x < WORKSPACE_X; x++)
    for (int y = 0; y < WORKSPACE_Y; y++)
      for (int z = 0; z < WORKSPACE_Z; z++)
        if (filled(voxels, x, y, z) && z > highest)
          highest = z;
  const char *full = utf8 ? "██" : "##";
  const char *empty = utf8 ? "· " : ". ";
  for (int z = 0; z <= highest; z++)
    fprintf(file, "   z = %d        %s", z, z == highest ? "\n" : "");
  for (int y = WORKSPACE_Y - 1; y >= 0; y--) {
    for (int z = 0; z <= highest; z++) {
      fprintf(file, "%s", z == 0 ? (y == WORKSPACE_Y - 1 ? "y  " : "   ") : "   ");
      for (int x = 0; x < WORKSPACE_X; x++)
        fputs(filled(voxels, x, y, z) ? full : empty, file);
      if (z < highest)
        fputc(' ', file);
    }
    fputc('\n', file);
  }
  fputs(utf8 ? "   x →\n" : "   x ->\n", file);
}
