/* environment.h: an environment as tables of fields. */
#ifndef MORPHO_WORLD_ENVIRONMENT_H
#define MORPHO_WORLD_ENVIRONMENT_H

#include <stdbool.h>

#include <morpho/world.h>

#include "base/fields.h"

/* Where the light stands and the terrain: numbers and arrays of numbers. Requests, replies and
 * scenes use these rows. */
extern const struct mo_fields mo_place_fields;
enum { MO_PLACE_LIGHT, MO_PLACE_HEIGHTS }; /* its first rows */
/* Returns whether the environment has a row: no light if its task moves one, and no heights of a
 * grid if its terrain is a profile. Those have members of their own in JSON (task_json.h). */
bool mo_place_has(const struct mo_environment *environment, size_t row);

/* The whole environment, for hashed encodings and the messages of workers: its packed form
 * (base/fields.h) has 66 float64, from version 2 on the task, from version 3 on the shape of the
 * terrain, from version 4 on the damage, and from version 5 on the terms of a sum. task_json.h: in
 * JSON. */
extern const struct mo_fields mo_environment_fields;
/* The value that a newly added field has where it is not given. */
extern const struct mo_environment mo_environment_defaults;

unsigned mo_environment_version(const struct mo_environment *environment); /* size of its packed
                                                                            * form */

/* Returns the numbers of a row. */
static inline const double *mo_environment_numbers(const struct mo_environment *environment,
                                                   const struct mo_field *field)
{
  return (const double *)(const void *)((const char *)environment + field->offset);
}

#endif
