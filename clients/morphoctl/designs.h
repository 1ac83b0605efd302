/* designs.h: bodies from files, standard input and words of the command line, as the API wants
 * them.
 *
 * Accepted, in any mixture, one after the other:
 *   {"cells": [[x,y,z], …]}, {"voxels": "…"}, {"id": "…"}     a design; a "name" is kept for tables
 * and not sent [design, …], {"designs": [design, …]}                       many designs; also
 * [[x,y,z], …]: the cells of one 144 digits 0 and 1                                          the
 * voxels of one 36 hexadecimal digits                                       an id # to the end of
 * the line                                    nothing */
#ifndef MORPHOCTL_DESIGNS_H
#define MORPHOCTL_DESIGNS_H

#include <jansson.h>

#include "ctl.h"

#define DESIGNS_MAX     10000
#define WORKSPACE_X     6
#define WORKSPACE_Y     6
#define WORKSPACE_Z     4
#define VOXELS          144
#define ID_DIGITS       36
#define INPUT_BYTES_MAX (64 << 20)

struct designs {
  json_t *list; /* array of objects as the API takes them */
  char **names; /* (n), entries may be NULL */
  size_t n;
  bool named; /* at least one has a name */
};

/* Adds what `text` holds; `source` in messages. STATUS_OK, STATUS_USAGE or STATUS_ERROR with a
 * complaint. */
int designs_add_text(struct designs *designs, const char *source, const char *text, size_t length);
/* Adds what an operand names: "-" standard input, a file, else the text itself if it is a body or
 * an id. */
int designs_add_operand(struct designs *designs, const char *operand);
/* Adds n bodies grown at random from `seed`: 1 to 144 voxels, each contiguous. The same seed gives
 * the same bodies. */
int designs_add_random(struct designs *designs, uint64_t seed, size_t n);
void designs_free(struct designs *designs);

/* The voxels of one design as 144 digits; false: it is an id or makes no sense. */
bool design_voxels(const json_t *design, char voxels[VOXELS + 1]);
/* The canonical voxels that an id spells. */
bool id_voxels(const char *id, char voxels[VOXELS + 1]);
bool is_id(const char *text, size_t length);
bool is_voxels(const char *text, size_t length);

/* A whole file or standard input ("-"): malloc, NUL-terminated. */
int read_input(const char *path, size_t limit, char **text, size_t *length);

/* ---- draw.c ---- */

/* Draws a body, layer beside layer, lowest first; layers above the body are left out. */
void draw_body(FILE *file, const char voxels[VOXELS + 1], bool utf8);

#endif
