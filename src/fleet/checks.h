/* checks.h: leases whose rows are compared bit for bit.
 *
 * One lease in ten of a new session is computed by a second session, too, and one in 200 after 500
 * leases; so are leases that were late. Two that differ are decided on the first block in which
 * they do: by this process, if it can, whose rows are right, however many sessions say otherwise;
 * if not, and for shards of gradients, as a whole, by a third session. Sessions that gave other
 * rows are quarantined, by the names of their token and their own. */
#ifndef MORPHO_FLEET_CHECKS_H
#define MORPHO_FLEET_CHECKS_H

#include "fleet/sessions.h"

/* All functions: locked. */

/* Decides what becomes of a lease whose blocks just got the rows of a session's result: an audit, a
 * check by the sessions that still hold it, or nothing more. May free it. */
void mo_check_begin(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_session *session,
                    const struct mo_wire_result *result, uint64_t now_ns, struct mo_after *after);
/* Compares a further result. session NULL: of this process. May free the lease. */
void mo_check_result(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_session *session,
                     const struct mo_wire_result *result, uint64_t now_ns, struct mo_after *after);
/* Returns whether a session may compute an audit that waits: it has no vote in it, and is of
 * another name and host than the voters, unless there was none for some seconds. */
bool mo_check_suits(const struct mo_lease *lease, const struct mo_session *session,
                    uint64_t now_ns);
/* Cuts an audit that is not disputed to about max_steps, at a random place. */
void mo_check_fit(struct mo_fleet *fleet, struct mo_lease *lease, uint64_t max_steps);

#endif
