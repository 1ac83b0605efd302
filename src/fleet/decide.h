/* decide.h: computes, in this process, a block for which two sessions returned different rows. A
 * block may take a minute, so a separate thread computes one block at a time. */
#ifndef MORPHO_FLEET_DECIDE_H
#define MORPHO_FLEET_DECIDE_H

#include "fleet/checks.h"

/* Call it with the lock held. Decides the dispute whose block has been computed, and begins the
 * next one. */
void mo_decide_tick(struct mo_fleet *fleet, uint64_t now_ns, struct mo_after *after);
/* Cancels the block that is being computed, and waits for its thread. */
void mo_decide_end(struct mo_fleet *fleet);

#endif
