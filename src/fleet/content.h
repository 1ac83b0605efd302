/* content.h: the content of a lease as it is sent to a worker, made from taken blocks. It is a copy
 * and outlives the blocks, so that a lease can be given to a second session after its first
 * result. */
#ifndef MORPHO_FLEET_CONTENT_H
#define MORPHO_FLEET_CONTENT_H

#include "fleet/wire.h"

/* Copies blocks, physics and environments, each environment once. MO_ERR_LIMIT: more rows or
 * environments than fit into a lease; MO_ERR_NO_MEMORY. */
int mo_content_of(const struct mo_taken *taken, struct mo_wire_lease *content);
/* Keeps n blocks, starting with `first`. Returns the row that they begin with. */
uint32_t mo_content_cut(struct mo_wire_lease *content, uint32_t first, uint32_t n);

#endif
