/* credible.h: whether the wall clock may be believed when jobs are deleted by age. Only for this
 * room, on the writer's thread. */
#ifndef MORPHO_STORE_CREDIBLE_H
#define MORPHO_STORE_CREDIBLE_H

#include "store/internal.h"

/* Looks at the clock, once in a round of deletions. The shortest time to keep decides for all
 * rules. Keeps the newest credible time in the database. If the clock is not credible, the store's
 * figures show how far it is ahead. */
int mo_clock_look(struct mo_store *store);
/* Returns what the last look has found: whether anything may be deleted by age. */
bool mo_clock_is_credible(struct mo_store *store);

#endif
