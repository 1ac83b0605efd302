/* designs.c: see designs.h. The server checks bodies; this code rejects only what cannot be sent,
 * with file and line. */
#include "designs.h"

#include <ctype.h>
#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "base/text.h"
#include "base/words.h"
#include "commands.h"

/* Ends a message about something that is not a design. */
#define OTHER_PROGRAMS                                                                             \
  "; morphod.read_bodies in the Python package reads EvoGym, voxcraft and NumPy files"

char *read_input(const char *path, size_t limit, size_t *length)
{
  bool standard = strcmp(path, "-") == 0;
  FILE *file = standard ? stdin : fopen(path, "re");
  const char *name = standard ? "standard input" : path;
  char block[65536], *text = NULL;
  size_t n = 0;
  if (file == NULL)
    fail(STATUS_USAGE, "%s: %s", path, strerror(errno));
  FILE *memory = need(open_memstream(&text, length));
  do {
    n = fread(block, 1, sizeof(block), file);
    need(fwrite(block, 1, n, memory) == n && fflush(memory) == 0 ? memory : NULL);
  } while (n > 0 && *length <= limit);
  const int error = ferror(file) ? errno : 0;
  close_text(memory);
  keep(text);
  if (!standard)
    fclose(file);
  if (*length > limit)
    fail(STATUS_USAGE, "%s is larger than %zu MiB", name, limit >> 20);
  if (error != 0)
    fail(STATUS_USAGE, "%s: %s", name, strerror(error));
  return text;
}

/* Finds the digits of the id of a robot (ID@K), and K, or −1 for an id without K. Returns NULL if
 * it is not an id. */
static const char *find_id(const char *text, size_t length, int *orientation)
{
  *orientation = -1;
  if (length >= ID_DIGITS + 2 && text[length - 2] == '@' && text[length - 1] >= '0' &&
      text[length - 1] <= '7') {
    *orientation = text[length - 1] - '0';
    length -= 2;
  }
  if (length == ID_DIGITS + 1 && *text == 'd') { /* as in the CSV files */
    text++;
    length--;
  }
  return length == ID_DIGITS && strspn(text, "0123456789abcdefABCDEF") >= length ? text : NULL;
}

bool is_robot(const char *text, size_t length)
{
  int orientation;
  return find_id(text, length, &orientation) != NULL;
}

bool is_id(const char *text, size_t length)
{
  int orientation;
  return find_id(text, length, &orientation) != NULL && orientation < 0;
}

bool is_voxels(const char *text, size_t length)
{
  const size_t letter = length == VOXELS + 1 && *text == 'g' ? 1 : 0; /* as in the CSV files */
  return length == VOXELS + letter && strspn(text + letter, "01") >= VOXELS;
}

struct designs no_designs(void)
{
  return (struct designs){keep(json_array()), keep(json_array())};
}

/* Takes the reference to the design. name: nullable. */
static void add(struct designs *designs, json_t *design, const char *name)
{
  if (json_array_size(designs->list) >= LARGE_MAX)
    fail(STATUS_USAGE, "more than %d designs in one request; split them", LARGE_MAX);
  json_array_append_new(designs->list, need(design));
  json_array_append_new(designs->names, name != NULL ? json_string(name) : json_null());
}

void designs_pack(struct designs *designs)
{
  size_t n;
  json_t *design;
  json_array_foreach(designs->list, n, design)
  {
    char voxels[VOXELS + 1], digits[ID_DIGITS + 1] = "";
    if (json_object_get(design, "id") != NULL || !design_voxels(design, voxels))
      continue;
    for (size_t i = 0; i < ID_DIGITS; i++) {
      const char *four = &voxels[4 * i];
      digits[i] = "0123456789abcdef"[(four[0] & 1) << 3 | (four[1] & 1) << 2 | (four[2] & 1) << 1 |
                                     (four[3] & 1)];
    }
    json_object_clear(design);
    json_object_set_new(design, "voxels", json_string(digits));
  }
}

static bool is_point(const json_t *json)
{
  return json_array_size(json) == 3 && json_is_number(json_array_get(json, 0));
}

#define MATERIAL_MAX 4 /* of a robot of EvoGym */
#define CELLS_MAX    ((MATERIAL_MAX + 1) * (MATERIAL_MAX + 1) * (MATERIAL_MAX + 1))

static bool are_adjacent(const int a[3], const int b[3])
{
  return abs(a[0] - b[0]) + abs(a[1] - b[1]) + abs(a[2] - b[2]) == 1;
}

/* Returns whether these rows, which are not in one piece if they are cells, can be an EvoGym robot
 * with three columns: materials up to 4, with at least one in the highest row. */
static bool can_be_robot(const json_t *rows)
{
  const size_t n = json_array_size(rows);
  int cells[CELLS_MAX][3];
  size_t n_reached = 1;
  for (size_t i = 0; i < n; i++) {
    const json_t *row = json_array_get(rows, i);
    int cell[3];
    for (size_t k = 0; k < 3; k++) {
      const json_t *number = json_array_get(row, k);
      if (json_array_size(row) != 3 || !json_is_integer(number) || json_integer_value(number) < 0 ||
          json_integer_value(number) > MATERIAL_MAX)
        return false;
      cell[k] = (int)json_integer_value(number);
    }
    if (i < CELLS_MAX)
      memcpy(cells[i], cell, sizeof(cell));
  }
  if (n < 2 || (cells[0][0] == 0 && cells[0][1] == 0 && cells[0][2] == 0))
    return false;
  if (n > CELLS_MAX)
    return true; /* a cell is given twice */
  for (size_t i = 0; i < n; i++)
    for (size_t j = 0; j < i; j++)
      if (memcmp(cells[i], cells[j], sizeof(cells[i])) == 0)
        return true;
  for (size_t from = 0; from < n_reached; from++) /* the reached cells come first */
    for (size_t i = n_reached; i < n; i++)
      if (are_adjacent(cells[from], cells[i])) {
        int reached[3];
        memcpy(reached, cells[i], sizeof(reached));
        memcpy(cells[i], cells[n_reached], sizeof(reached));
        memcpy(cells[n_reached++], reached, sizeof(reached));
      }
  return n_reached < n;
}

static void add_json(struct designs *designs, const char *source, size_t line, json_t *json,
                     int depth)
{
  static const char *const forms[] = {"cells", "voxels", "id", NULL};
  if (json_is_string(json)) {
    const char *text = json_string_value(json);
    size_t length = json_string_length(json);
    if (!is_robot(text, length) && !is_voxels(text, length))
      fail(STATUS_USAGE,
           "%s:%zu: a text must be 144 digits 0 or 1, or an id, optionally with @0 to @7", source,
           line);
    add(designs, json_pack("{s:s}", is_robot(text, length) ? "id" : "voxels", text), NULL);
    return;
  }
  if (json_is_array(json) && json_array_size(json) > 0 && is_point(json_array_get(json, 0))) {
    if (can_be_robot(json))
      fail(STATUS_USAGE,
           "%s:%zu: this list could be cells [x, y, z] or EvoGym rows: write {\"cells\": [...]} "
           "for cells; Body.evogym in the Python package reads rows",
           source, line);
    add(designs, json_pack("{s:O}", "cells", json), NULL);
    return;
  }
  if (json_is_array(json) && depth <= 1) {
    size_t i;
    json_t *entry;
    json_array_foreach(json, i, entry)
    {
      add_json(designs, source, line, entry, depth + 1);
    }
    return;
  }
  if (!json_is_object(json))
    fail(STATUS_USAGE, "%s:%zu: a design must be an object with cells, voxels or id" OTHER_PROGRAMS,
         source, line);
  json_t *many = json_object_get(json, "designs");
  if (many != NULL && depth == 0) {
    add_json(designs, source, line, many, 0);
    return;
  }
  if (json_object_get(json, "grid_width") != NULL)
    fail(STATUS_USAGE, "%s:%zu: an EvoGym world is not a design" OTHER_PROGRAMS, source, line);
  json_t *design = keep(json_object());
  const char *key;
  json_t *value;
  json_object_foreach(json, key, value)
  {
    if (strcmp(key, "name") == 0 || strcmp(key, "description") == 0)
      continue;
    if (mo_word_index(forms, key) < 0)
      fail(STATUS_USAGE,
           "%s:%zu: a design has cells, voxels or id, optionally a name, but no \"%s\"%s", source,
           line, key, did_you_mean("", key, forms, 3, sizeof(*forms)));
    json_object_set(design, key, value);
  }
  if (json_object_size(design) != 1)
    fail(STATUS_USAGE, "%s:%zu: a design must have exactly one of cells, voxels and id", source,
         line);
  add(designs, json_incref(design), json_string_value(json_object_get(json, "name")));
}

static size_t count_lines(const char *text, size_t n)
{
  size_t lines = 0;
  for (size_t i = 0; i < n; i++)
    lines += text[i] == '\n';
  return lines;
}

void designs_add_text(struct designs *designs, const char *source, const char *text, size_t length)
{
  size_t line = 1;
  for (size_t i = 0; i < length;) {
    if (text[i] == '\n')
      line++;
    if (isspace((unsigned char)text[i]) || text[i] == ',') {
      i++;
    } else if (text[i] == '#') {
      while (i < length && text[i] != '\n')
        i++;
    } else if (text[i] == '{' || text[i] == '[') {
      json_error_t error;
      json_t *json =
          json_loadb(text + i, length - i, JSON_REJECT_DUPLICATES | JSON_DISABLE_EOF_CHECK, &error);
      if (json == NULL)
        fail(STATUS_USAGE, "%s:%zu: %s", source,
             line + (size_t)(error.line > 0 ? error.line - 1 : 0), error.text);
      add_json(designs, source, line, keep(json), 0);
      line += count_lines(text + i, (size_t)error.position);
      i += (size_t)error.position;
    } else {
      size_t n = 0;
      while (i + n < length && !isspace((unsigned char)text[i + n]) && text[i + n] != ',')
        n++;
      if (is_robot(text + i, n))
        add(designs, json_pack("{s:s%}", "id", text + i, n), NULL);
      else if (is_voxels(text + i, n))
        add(designs, json_pack("{s:s%}", "voxels", text + i, n), NULL);
      else if (n == strspn(text + i, "01") && n > ID_DIGITS)
        fail(STATUS_USAGE, "%s:%zu: got %zu digits; voxels must have 144", source, line, n);
      else
        fail(STATUS_USAGE,
             "%s:%zu: \"%.*s%s\" is not a design: JSON, 144 digits 0 or 1, or an id of 36 "
             "hexadecimal digits, optionally with an orientation, @0 to @7" OTHER_PROGRAMS,
             source, line, (int)(n < 40 ? n : 40), text + i, n < 40 ? "" : "…");
      i += n;
    }
  }
}

void designs_add_genotypes(struct designs *designs, const json_t *objects)
{
  size_t i;
  const json_t *object;
  json_array_foreach(objects, i, object)
  {
    const char *genotype = text_of(object, "genotype");
    designs_add_text(designs, "the server's reply", genotype, strlen(genotype));
  }
}

void designs_add_operand(struct designs *designs, const char *operand)
{
  size_t length = strlen(operand);
  if (strcmp(operand, "-") != 0 && access(operand, F_OK) != 0 &&
      (is_robot(operand, length) || is_voxels(operand, length) || *operand == '{' ||
       *operand == '[')) {
    designs_add_text(designs, "operand", operand, length);
    return;
  }
  const char *text = read_input(operand, INPUT_BYTES_MAX, &length);
  const size_t before = json_array_size(designs->list);
  const char *source = strcmp(operand, "-") == 0 ? "standard input" : operand;
  designs_add_text(designs, source, text, length);
  if (json_array_size(designs->list) == before)
    fail(STATUS_USAGE, "%s contains no design", source);
}

/* ---- voxels of a design ---- */

static int voxel_index(int x, int y, int z)
{
  return (x * WORKSPACE_Y + y) * WORKSPACE_Z + z;
}

bool robot_voxels(const char *robot, char voxels[VOXELS + 1])
{
  int k, side[2] = {0, 0};
  const char *id = find_id(robot, strlen(robot), &k);
  if (id == NULL)
    return false;
  memset(voxels, '0', VOXELS);
  voxels[VOXELS] = 0;
  /* The sides of the canonical form first, which lies in the corner; then image k. */
  for (int pass = 0; pass < 2; pass++)
    for (int i = 0; i < VOXELS; i++) {
      int at[2] = {i / WORKSPACE_Z / WORKSPACE_Y, i / WORKSPACE_Z % WORKSPACE_Y};
      if ((mo_hex_digit(id[i / 4]) >> (3 - i % 4) & 1) == 0)
        continue;
      for (int axis = 0; axis < 2 && pass == 0; axis++)
        side[axis] = at[axis] >= side[axis] ? at[axis] + 1 : side[axis];
      if (pass == 0)
        continue;
      const bool swaps = k > 0 && k & 4;
      int x = at[swaps], y = at[!swaps];
      x = k > 0 && k & 1 ? side[swaps] - 1 - x : x;
      y = k > 0 && k & 2 ? side[!swaps] - 1 - y : y;
      voxels[voxel_index(x, y, i % WORKSPACE_Z)] = '1';
    }
  return true;
}

bool design_voxels(const json_t *design, char voxels[VOXELS + 1])
{
  const char *text = json_string_value(json_object_get(design, "voxels"));
  if (text != NULL && is_voxels(text, strlen(text))) {
    memcpy(voxels, text + (*text == 'g'), VOXELS + 1);
    return true;
  }
  const json_t *cells = json_object_get(design, "cells");
  if (!json_is_array(cells) || json_array_size(cells) == 0)
    return false;
  memset(voxels, '0', VOXELS);
  voxels[VOXELS] = 0;
  for (size_t i = 0; i < json_array_size(cells); i++) {
    static const json_int_t sides[3] = {WORKSPACE_X, WORKSPACE_Y, WORKSPACE_Z};
    int point[3];
    for (size_t k = 0; k < 3; k++) {
      const json_t *coordinate = json_array_get(json_array_get(cells, i), k);
      if (!json_is_integer(coordinate) || json_integer_value(coordinate) < 0 ||
          json_integer_value(coordinate) >= sides[k])
        return false;
      point[k] = (int)json_integer_value(coordinate);
    }
    voxels[voxel_index(point[0], point[1], point[2])] = '1';
  }
  return true;
}

/* ---- drawing: each layer is a grid seen from above, x to the right, y up ---- */

void draw_body(FILE *file, const char voxels[VOXELS + 1], bool utf8)
{
  int highest = 0;
  for (int i = 0; i < VOXELS; i++)
    if (voxels[i] == '1' && i % WORKSPACE_Z > highest)
      highest = i % WORKSPACE_Z;
  const char *full = utf8 ? "██" : "##";
  const char *empty = utf8 ? "· " : ". ";
  for (int z = 0; z <= highest; z++)
    fprintf(file, "   z = %d        %s", z, z == highest ? "\n" : "");
  for (int y = WORKSPACE_Y - 1; y >= 0; y--) {
    for (int z = 0; z <= highest; z++) {
      fprintf(file, "%s", z == 0 ? (y == WORKSPACE_Y - 1 ? "y  " : "   ") : "   ");
      for (int x = 0; x < WORKSPACE_X; x++)
        fputs(voxels[voxel_index(x, y, z)] == '1' ? full : empty, file);
      if (z < highest)
        fputc(' ', file);
    }
    fputc('\n', file);
  }
  fputs(utf8 ? "   x →\n" : "   x ->\n", file);
}
