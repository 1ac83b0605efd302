/* environment.h: an environment as tables of fields. */
#ifndef MORPHO_WORLD_ENVIRONMENT_H
#define MORPHO_WORLD_ENVIRONMENT_H

#include <stdbool.h>

#include <morpho/world.h>

#include "base/fields.h"
#include "base/sha256.h"

/* The position of the light, and the terrain: numbers and arrays of numbers. Requests, replies and
 * scenes use these rows. */
extern const struct mo_fields mo_place_fields;
enum { MO_PLACE_LIGHT, MO_PLACE_HEIGHTS }; /* its first rows */
/* Returns whether the environment has a row: no light if its task moves one, and no heights of a
 * grid if its terrain is a profile. Those have their own members in JSON (task_json.h). */
bool mo_place_has(const struct mo_environment *environment, size_t row);

/* The drop, for JSON and the packed form. */
extern const struct mo_fields mo_drop_fields;

/* The whole environment, except for a custom grid. task_json.h: in JSON. */
extern const struct mo_fields mo_environment_fields;
/* The values of newly added fields where they are not given. */
extern const struct mo_environment mo_environment_defaults;

/* The packed form, for hashed encodings, checkpoints and the messages of workers. It is that of the
 * fields (base/fields.h): 66 float64. Version 2 added the task, 3 the shape of the terrain, 4 the
 * damage, 5 the terms of a sum, 7 the factors, and 8 the drop. From version 6 on, 16 bytes follow,
 * columns and rows of the grid (uint32_t) and its spacing (double), which are 0 without a custom
 * grid, and then its heights (double). */
#define MO_ENVIRONMENT_GRID_VERSION 6
#define MO_ENVIRONMENT_VERSION      8 /* the newest: rows that are added later raise it */
/* Upper bound on the bytes before a grid's heights. */
#define MO_ENVIRONMENT_HEAD_BYTES (sizeof(struct mo_environment) + 16)

/* Returns the first version that includes every field that an environment uses. */
unsigned mo_environment_version(const struct mo_environment *environment);
size_t mo_environment_packed_bytes(const struct mo_environment *environment, unsigned version);
void mo_environment_pack(const struct mo_environment *environment, unsigned version,
                         uint8_t *bytes);
/* Reads one environment from the start of `bytes`; *used: its bytes, or 0 if it is cut off. The
 * caller drops its grid (mo_environments_drop), unless an error was returned. Checks words and the
 * grid only. MO_ERR_FORMAT, MO_ERR_NO_MEMORY. */
int mo_environment_unpack(unsigned version, const uint8_t *bytes, size_t size,
                          struct mo_environment *environment, size_t *used);
/* Computes the hash of the packed form in its own version, with −0 as 0. */
void mo_environment_digest(const struct mo_environment *environment, struct mo_sha256 *hash);

/* Returns the numbers of a row. */
static inline const double *mo_environment_numbers(const struct mo_environment *environment,
                                                   const struct mo_field *field)
{
  return (const double *)(const void *)((const char *)environment + field->offset);
}

#endif
