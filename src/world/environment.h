/* environment.h: an environment as a table of fields. */
#ifndef MORPHO_WORLD_ENVIRONMENT_H
#define MORPHO_WORLD_ENVIRONMENT_H

#include <morpho/world.h>

#include "base/fields.h"

/* Of struct mo_environment: numbers only, single ones or several. Requests, replies, scenes, the
 * encodings that are hashed and the messages of workers go by its rows. Packed (base/fields.h): 66
 * float64, until a field is added. */
extern const struct mo_fields mo_environment_fields;
/* What a field that is added stands for where it is not given. */
extern const struct mo_environment mo_environment_defaults;

unsigned mo_environment_version(const struct mo_environment *environment); /* of its packed form */

/* The numbers of a row. */
static inline const double *mo_environment_numbers(const struct mo_environment *environment,
                                                   const struct mo_field *field)
{
  return (const double *)(const void *)((const char *)environment + field->offset);
}

#endif
