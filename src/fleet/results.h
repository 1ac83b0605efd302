/* results.h: takes the results of a session. */
#ifndef MORPHO_FLEET_RESULTS_H
#define MORPHO_FLEET_RESULTS_H

#include "fleet/sessions.h"

/* Call it with the lock held. Returns whether a message contains a result that mo_results_take
 * would count or deliver. */
bool mo_results_count(struct mo_fleet *fleet, const struct mo_session *session,
                      const struct mo_wire_results *results);
/* Call it with the lock held. Takes all results of a message, or none. MO_ERR_FORMAT: rows do not
 * belong to the lease. Results of leases that the session does not hold are only counted. The rows
 * must live until mo_after_run. */
int mo_results_take(struct mo_fleet *fleet, struct mo_session *session,
                    const struct mo_wire_results *results, uint64_t now_ns, struct mo_after *after,
                    struct mo_message *message);

#endif
