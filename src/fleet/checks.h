/* checks.h: leases whose rows are compared bit for bit.
 *
 * A second session also computes one lease in ten of a new session (one in 200 after 500 leases),
 * and every lease that was late. If the two results differ, this process computes the first block
 * that differs, and refuses the sessions that returned different rows. This process cannot compute
 * gradient shards, or a device class that only workers have. If two results of these differ, one of
 * them must be wrong, so both sessions are refused. */
#ifndef MORPHO_FLEET_CHECKS_H
#define MORPHO_FLEET_CHECKS_H

#include "fleet/sessions.h"

/* Call all functions with the lock held. */

/* Decides what happens to a lease after its blocks received the rows of a session's result: an
 * audit, a check by the sessions that still hold it, or nothing more. May free the lease. */
void mo_check_begin(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_session *session,
                    const struct mo_wire_result *result, uint64_t now_ns, struct mo_after *after);
/* Compares another result. May free the lease. */
void mo_check_result(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_session *session,
                     const struct mo_wire_result *result, uint64_t now_ns, struct mo_after *after);
/* Takes rows that this process computed, refuses the sessions that returned different rows for a
 * disputed lease, and frees the lease. */
void mo_check_decide(struct mo_fleet *fleet, struct mo_lease *lease, double *losses,
                     uint32_t *diverged_steps, double (*measures)[MO_MEASURES], uint64_t now_ns,
                     struct mo_after *after);
/* Returns whether a session may compute a waiting audit. It must not have delivered the lease, and
 * its name and host must differ from the delivering session's, unless no other session has been
 * available for several seconds. */
bool mo_check_suits(const struct mo_lease *lease, const struct mo_session *session,
                    uint64_t now_ns);
/* Cuts an audit that is not disputed to about max_steps, starting at a random place. */
void mo_check_fit(struct mo_fleet *fleet, struct mo_lease *lease, uint64_t max_steps);

#endif
