/* give.h: chooses the leases of a session. */
#ifndef MORPHO_FLEET_GIVE_H
#define MORPHO_FLEET_GIVE_H

#include "fleet/sessions.h"

/* Gives a session as many leases of a back end as it can hold: audits and late leases, then new
 * ones from the source, then, if it is idle and nothing is left, a lease that another session
 * should have finished. Locked, but the lock is free while blocks are taken. Returns the session;
 * NULL: it ended meanwhile. numbers (room for MO_FLEET_LEASES more), *n: the leases, which may have
 * ended meanwhile, too. */
struct mo_session *mo_give(struct mo_fleet *fleet, struct mo_session *session,
                           enum mo_back_end back_end, uint64_t now_ns, struct mo_after *after,
                           uint64_t *numbers, uint32_t *n);
/* Locked. Returns the oldest lease that only one session holds although it should be done, and that
 * is not held by this one; NULL: none. session NULL: any. */
struct mo_lease *mo_give_overdue(struct mo_fleet *fleet, const struct mo_session *session,
                                 enum mo_back_end back_end, uint64_t now_ns);
/* Locked. Returns the blocks that the source should have ready for a class: four seconds of its
 * sessions, at most 2^17. */
uint32_t mo_give_wanted(const struct mo_fleet *fleet, enum mo_back_end back_end);

#endif
