/* upkeep.h: what the store does by itself: the reserve, deletions that go on, and rules of
 * retention. Only for this room. */
#ifndef MORPHO_STORE_UPKEEP_H
#define MORPHO_STORE_UPKEEP_H

#include "store/internal.h"

/* ---- the reserve (reserve.c) ---- */

/* Only the writer's thread calls these, and opening before that thread starts. */
/* Makes the reserve whole again. If there is no space for it, the store is short of space. */
void mo_reserve_make(struct mo_store *store);
/* Frees the reserve. true: the store is short of space, and there may be some space now. */
bool mo_reserve_free(struct mo_store *store);

/* ---- deletion.c ---- */

/* Continues what the last process left. Once the writer has started. */
void mo_upkeep_begin(struct mo_store *store);
/* The writer calls it between batches: queues what is due, once a minute. */
void mo_upkeep(struct mo_store *store);

#endif
