/* designs.h: reads bodies from files, standard input and operands, and converts them to the API's
 * format.
 *
 * Accepted, in any mixture, one after another:
 * - {"cells": [[x,y,z], …]}, {"voxels": "…"}, {"id": "…"}: one design; "name" is only for tables
 * - [design, …], {"designs": [design, …]}: many designs
 * - [[x,y,z], …]: the cells of one design. Rejected if they are not in one piece, and could be rows
 *   of EvoGym materials
 * - 144 digits 0 and 1, optionally after a g: the voxels of one design
 * - 36 hexadecimal digits, optionally after a d: an id; followed by @0 to @7: a robot, which
 *   is the design in one orientation
 * - # to the end of the line: ignored */
#ifndef MORPHOCTL_DESIGNS_H
#define MORPHOCTL_DESIGNS_H

#include <jansson.h>

#include "ctl.h"

#define DESIGNS_MAX       10000   /* of a request, except evaluations */
#define LARGE_MAX         1000000 /* of an evaluation */
#define RANDOM_BODIES_MAX 1000000 /* of one seed */
#define WORKSPACE_X       6
#define WORKSPACE_Y       6
#define WORKSPACE_Z       4
#define VOXELS            144
#define ID_DIGITS         36
#define INPUT_BYTES_MAX   (64 << 20)

struct designs {
  json_t *list;  /* array of objects in the API's format; kept (ctl.h) */
  json_t *names; /* of the same length: texts, or null; kept */
};

struct designs no_designs(void);
/* Adds the designs in `text`. source: its name in messages. Exits if it is invalid. */
void designs_add_text(struct designs *designs, const char *source, const char *text, size_t length);
/* Adds the designs of an operand: "-" is standard input; otherwise a file; otherwise the text
 * itself if it is a body or an id. */
void designs_add_operand(struct designs *designs, const char *operand);
/* Adds the bodies of an array of objects with "genotype"; skips null. */
void designs_add_genotypes(struct designs *designs, const json_t *objects);

/* Writes all voxels as hexadecimal digits, which take a third of the space. */
void designs_pack(struct designs *designs);

/* Writes the voxels of a design as 144 digits. Returns false if the design is an id or invalid. */
bool design_voxels(const json_t *design, char voxels[VOXELS + 1]);
/* Decodes the voxels of a robot, not placed; for an id, the canonical voxels. Returns false if it
 * is neither. */
bool robot_voxels(const char *robot, char voxels[VOXELS + 1]);
bool is_robot(const char *text, size_t length); /* or an id without one */
bool is_id(const char *text, size_t length);    /* without an orientation */
bool is_voxels(const char *text, size_t length);

/* Reads a whole file or standard input ("-"): kept, NUL-terminated. */
char *read_input(const char *path, size_t limit, size_t *length);

/* Draws a body as layers side by side, the lowest first; omits layers above the body. */
void draw_body(FILE *file, const char voxels[VOXELS + 1], bool utf8);

#endif
