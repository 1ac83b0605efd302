/* content.h: what a lease says to a worker, made from what was taken. It is a copy: it
 * outlives the blocks, so that a lease can be given out twice after its first result. */
#ifndef MORPHO_FLEET_CONTENT_H
#define MORPHO_FLEET_CONTENT_H

#include "fleet/wire.h"

/* Copies blocks, physics and environments, each environment once. MO_ERR_LIMIT: more rows or
 * environments than a lease can have; MO_ERR_NO_MEMORY. */
int mo_content_of(const struct mo_taken *taken, struct mo_wire_lease *content);
/* Keeps n blocks from the first on; returns the row with which they begin. */
uint32_t mo_content_cut(struct mo_wire_lease *content, uint32_t first, uint32_t n);

#endif
