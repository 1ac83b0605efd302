/* decide.h: this process computes the block on which two sessions differ. A block may take a
 * minute, so a thread of its own does it, one block at a time. */
#ifndef MORPHO_FLEET_DECIDE_H
#define MORPHO_FLEET_DECIDE_H

#include "fleet/checks.h"

/* Locked. Decides by the rows of a block that is done, and begins the next one. */
void mo_decide_tick(struct mo_fleet *fleet, uint64_t now_ns, struct mo_after *after);
/* Cancels the block that is computed, and waits for its thread. */
void mo_decide_end(struct mo_fleet *fleet);

#endif
