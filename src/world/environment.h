/* environment.h: an environment as a table of fields. */
#ifndef MORPHO_WORLD_ENVIRONMENT_H
#define MORPHO_WORLD_ENVIRONMENT_H

#include <morpho/world.h>

#include "base/fields.h"

/* For the numbers and arrays of numbers of struct mo_environment; it has no row for the task.
 * Requests, replies, scenes, hashed encodings and the messages of workers use its rows. Packed
 * (base/fields.h): 66 float64, until a field is added. */
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
