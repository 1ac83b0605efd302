/* checks.h: leases whose rows are compared bit for bit.
 *
 * One lease in ten of a new session is computed by a second session, too, and one in 200 after 500
 * leases; so are leases that were late. Where two differ this process computes the first block in
 * which they do, and the sessions that gave other rows are refused. What it does not compute,
 * shards of gradients and the class of devices that only workers have, shows that one of the two is
 * wrong: both are refused. */
#ifndef MORPHO_FLEET_CHECKS_H
#define MORPHO_FLEET_CHECKS_H

#include "fleet/sessions.h"

/* All functions: locked. */

/* Decides what becomes of a lease whose blocks just got the rows of a session's result: an audit, a
 * check by the sessions that still hold it, or nothing more. May free it. */
void mo_check_begin(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_session *session,
                    const struct mo_wire_result *result, uint64_t now_ns, struct mo_after *after);
/* Compares a further result. May free the lease. */
void mo_check_result(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_session *session,
                     const struct mo_wire_result *result, uint64_t now_ns, struct mo_after *after);
/* Refuses the sessions whose rows of a disputed lease are not these, of this process. Frees it. */
void mo_check_decide(struct mo_fleet *fleet, struct mo_lease *lease, double *losses,
                     uint32_t *diverged_steps, uint64_t now_ns, struct mo_after *after);
/* Returns whether a session may compute an audit that waits: it did not deliver it, and is of
 * another name and host than the one that did, unless there was no other for some seconds. */
bool mo_check_suits(const struct mo_lease *lease, const struct mo_session *session,
                    uint64_t now_ns);
/* Cuts an audit that is not disputed to about max_steps, at a random place. */
void mo_check_fit(struct mo_fleet *fleet, struct mo_lease *lease, uint64_t max_steps);

#endif
