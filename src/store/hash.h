/* hash.h: hashes of the conditions of scores, except for body and weights. */
#ifndef MORPHO_STORE_HASH_H
#define MORPHO_STORE_HASH_H

#include <morpho/rollout.h>
#include <morpho/world.h>

#include "base/sha256.h"

/* Hashes everything that a score depends on except body, environment and weights: every physics
 * value, the precision, and the sensor. Bisections count only if the impact mode uses them. */
void mo_physics_hash(const struct mo_physics *physics, enum mo_precision precision,
                     enum mo_sensor sensor, struct mo_sha256 *hash);

void mo_environment_hash(const struct mo_environment *environment, struct mo_sha256 *hash);

#endif
