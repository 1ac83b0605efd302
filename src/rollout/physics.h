/* physics.h: the constants of a rollout as a table of fields. */
#ifndef MORPHO_ROLLOUT_PHYSICS_H
#define MORPHO_ROLLOUT_PHYSICS_H

#include <morpho/rollout.h>

#include "base/fields.h"

/* For struct mo_physics. Packed (base/fields.h): nine float64, then the steps, the impact and the
 * bisections in 32 bits, until a constant is added. */
extern const struct mo_fields mo_physics_fields;

unsigned mo_physics_version(const struct mo_physics *physics); /* of its packed form */
bool mo_physics_equal(const struct mo_physics *a, const struct mo_physics *b);

#endif
