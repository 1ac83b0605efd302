/* give.h: chooses the leases of a session. */
#ifndef MORPHO_FLEET_GIVE_H
#define MORPHO_FLEET_GIVE_H

#include "fleet/sessions.h"

/* Gives a session as many leases of a back end as it can hold: first audits and late leases, then
 * new ones from the source, and then, if the session is idle and no work is left, a lease that
 * another session should have finished by now. Call it with the lock held; the lock is released
 * while blocks are taken. Returns the session, or NULL if it ended during that time. numbers (room
 * for MO_FLEET_LEASES more), *n: the leases, which may also have ended during that time. */
struct mo_session *mo_give(struct mo_fleet *fleet, struct mo_session *session,
                           enum mo_back_end back_end, uint64_t now_ns, struct mo_after *after,
                           uint64_t *numbers, uint32_t *n);
/* Call it with the lock held. Returns the oldest overdue lease that exactly one other session
 * holds, or NULL. session NULL: any session may hold it. */
struct mo_lease *mo_give_overdue(struct mo_fleet *fleet, const struct mo_session *session,
                                 enum mo_back_end back_end, uint64_t now_ns);
/* Call it with the lock held. Returns the number of blocks that the source should have ready for a
 * class: four seconds of work for its sessions, at most 2^17. */
uint32_t mo_give_wanted(const struct mo_fleet *fleet, enum mo_back_end back_end);

#endif
