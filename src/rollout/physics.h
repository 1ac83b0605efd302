/* physics.h: the constants of a rollout as a table of fields. */
#ifndef MORPHO_ROLLOUT_PHYSICS_H
#define MORPHO_ROLLOUT_PHYSICS_H

#include <morpho/rollout.h>

#include "base/fields.h"

/* Of struct mo_physics. */
extern const struct mo_fields mo_physics_fields;

#endif
