/* outcasts.h: the list of workers in quarantine, which outlives the process. A name is its token's:
 * nobody can put the workers of another into quarantine. */
#ifndef MORPHO_FLEET_OUTCASTS_H
#define MORPHO_FLEET_OUTCASTS_H

#include "fleet/state.h"

/* Locked. NULL: it is not listed. */
const struct mo_outcast *mo_outcast_find(const struct mo_fleet *fleet, const char *user,
                                         const char *name);
/* Adds one; the oldest gives way in a full list. */
void mo_outcast_add(struct mo_fleet *fleet, const struct mo_outcast *outcast);

/* Without the lock. Stores the list. without (nullable): a name, of any user, that leaves it once
 * that is stored. MO_ERR_NOT_FOUND: it is not listed. */
int mo_outcasts_save(struct mo_fleet *fleet, const char *without);

#endif
