/* sessions.h: the table of sessions, and how they end. Call all functions with the lock held. */
#ifndef MORPHO_FLEET_SESSIONS_H
#define MORPHO_FLEET_SESSIONS_H

#include "fleet/leases.h"

struct mo_session *mo_session_find(struct mo_fleet *fleet, uint64_t id); /* NULL: not open */
void mo_session_insert(struct mo_fleet *fleet, struct mo_session *session, struct mo_after *after);

/* Ends all holds of a session, as mo_lease_release does. */
void mo_session_release(struct mo_fleet *fleet, struct mo_session *session, bool is_lost,
                        uint64_t now_ns, struct mo_after *after);
/* Stops giving leases to a session. */
void mo_session_drain(struct mo_fleet *fleet, struct mo_session *session, const char *why,
                      struct mo_after *after);
/* Ends a session: puts its leases back, and moves it to the list of ended ones (MO_SESSION_LEFT,
 * MO_SESSION_LOST). A refused session keeps its state and creates no event. */
void mo_session_end(struct mo_fleet *fleet, struct mo_session *session, enum mo_session_state state,
                    const char *why, uint64_t now_ns, struct mo_after *after);

/* Refuses a session that returned wrong bits: its leases are put back, its later results are
 * ignored, and its worker is notified. The session may have already ended, so name and host are
 * passed for the event. */
void mo_session_refuse(struct mo_fleet *fleet, uint64_t id, const char *name, const char *host,
                       const char *why, uint64_t now_ns, struct mo_after *after);

#endif
