/* leases.h: the table of leases and their holders. Call all functions with the lock held. */
#ifndef MORPHO_FLEET_LEASES_H
#define MORPHO_FLEET_LEASES_H

#include "fleet/after.h"
#include "fleet/weights.h"

/* Makes a lease of taken blocks. Call it without the lock; the lease is not in the table yet. Takes
 * ownership of the content. On MO_ERR_NO_MEMORY (NULL), nothing was taken. */
struct mo_lease *mo_lease_create(struct mo_taken *taken, struct mo_wire_lease *content);
/* Assigns a number to the lease and puts it into the table. Takes over one use of the weights
 * (NULL: passive bodies). */
void mo_lease_insert(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_weights *weights);
struct mo_lease *mo_lease_find(struct mo_fleet *fleet, uint64_t number); /* NULL: not found */
/* Assigns a new number to a lease, so that no session knows its number. */
void mo_lease_renumber(struct mo_fleet *fleet, struct mo_lease *lease);

/* Returns the index of a session's hold, or MO_ERR_NOT_FOUND. */
int mo_lease_held_by(const struct mo_lease *lease, const struct mo_session *session);
/* Returns the steps per second that a session computes; 0: not measured. */
double mo_session_rate(const struct mo_session *session, enum mo_back_end back_end);
bool mo_session_is_free(const struct mo_session *session); /* it holds nothing */
void mo_lease_hold(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_session *session,
                   uint64_t now_ns);
/* Ends a hold, and does nothing else. */
void mo_lease_unhold(struct mo_lease *lease, uint32_t place);
/* Ends a hold without a result. If it was the last hold, the work is put back, and an audit returns
 * to the list. A lease with a body for which too many sessions were lost ends even if other
 * sessions hold it. is_lost: the session ended while it held the lease, or failed. Returns false if
 * the lease was freed. */
bool mo_lease_release(struct mo_fleet *fleet, struct mo_lease *lease, uint32_t place, bool is_lost,
                      uint64_t now_ns, struct mo_after *after);
/* Orders a session to drop a lease. */
void mo_lease_drop(const struct mo_lease *lease, struct mo_session *session,
                   struct mo_after *after);
/* Lists the lease for the next session, or removes it from the list. */
void mo_lease_list(struct mo_fleet *fleet, struct mo_lease *lease, uint64_t now_ns,
                   struct mo_after *after);
void mo_lease_unlist(struct mo_fleet *fleet, struct mo_lease *lease);

/* Gives the blocks their results. After this the lease has no parcel. */
void mo_lease_deliver(struct mo_lease *lease, const struct mo_remote_result *result,
                      struct mo_after *after);
/* Frees a lease. Puts its remaining blocks back, and orders sessions that hold it to drop it. */
void mo_lease_end(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_after *after);

/* Lets a session wait for work of a class. NULL: it stops waiting. */
void mo_session_wait(struct mo_session *session, enum mo_back_end back_end, struct mo_class *class);
/* Wakes one waiting session, if any. Prefers an idle one. */
void mo_class_wake(struct mo_fleet *fleet, enum mo_back_end back_end, struct mo_after *after);

#endif
