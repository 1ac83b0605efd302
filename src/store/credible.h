/* credible.h: whether the wall clock can be trusted when jobs are deleted by age. Only for this
 * room, on the writer's thread. */
#ifndef MORPHO_STORE_CREDIBLE_H
#define MORPHO_STORE_CREDIBLE_H

#include "store/internal.h"

/* Checks the clock, once per round of deletions. The shortest retention time applies to all rules.
 * Stores the newest credible time in the database. If the clock is not credible, the store's
 * statistics report how far it is ahead. */
int mo_clock_check(struct mo_store *store);
/* Returns the result of the last check: whether anything may be deleted by age. */
bool mo_clock_is_credible(struct mo_store *store);

#endif
