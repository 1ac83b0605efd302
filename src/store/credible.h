/* credible.h: whether the wall clock may be believed when jobs are deleted by age. Only for this
 * room, on the writer's thread. */
#ifndef MORPHO_STORE_CREDIBLE_H
#define MORPHO_STORE_CREDIBLE_H

#include "store/internal.h"

/* Looks at the clock: before the others, once in a round of deletions. Keeps the newest credible
 * time in the database. */
int mo_clock_look(struct mo_store *store);
/* Returns whether what is kept for so long may be deleted. If not, the store's figures show how far
 * the clock is ahead. */
bool mo_clock_is_credible(struct mo_store *store, int64_t keep_us);

#endif
