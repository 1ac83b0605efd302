/* physics.h: the constants of a rollout as a table of fields. */
#ifndef MORPHO_ROLLOUT_PHYSICS_H
#define MORPHO_ROLLOUT_PHYSICS_H

#include <morpho/rollout.h>

#include "base/fields.h"

/* Of struct mo_physics. */
extern const struct mo_fields mo_physics_fields;

bool mo_physics_equal(const struct mo_physics *a, const struct mo_physics *b);

/* The packed form (base/fields.h): nine float64, then the steps, the impact and the bisections in
 * 32 bits, until a constant is added. pack returns the bytes that it wrote. unpack: false: not what
 * pack writes in this version; values are not checked otherwise. */
size_t mo_physics_pack(const struct mo_physics *physics, unsigned *version,
                       uint8_t bytes[sizeof(struct mo_physics)]);
bool mo_physics_unpack(unsigned version, const uint8_t *bytes, struct mo_physics *physics);

#endif
