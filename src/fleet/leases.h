/* leases.h: the table of leases, and who holds them. All functions: locked. */
#ifndef MORPHO_FLEET_LEASES_H
#define MORPHO_FLEET_LEASES_H

#include "fleet/after.h"
#include "fleet/weights.h"

/* Makes a lease of taken blocks, without the lock and outside of the table. Takes the content; on
 * MO_ERR_NO_MEMORY (NULL) nothing was taken. */
struct mo_lease *mo_lease_create(struct mo_taken *taken, struct mo_wire_lease *content);
/* Gives the lease its number and puts it into the table. Takes over the use of the
 * weights; NULL: passive bodies. */
void mo_lease_insert(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_weights *weights);
struct mo_lease *mo_lease_find(struct mo_fleet *fleet, uint64_t number); /* NULL: none */
/* Gives a lease a new number, under which no session knows it. */
void mo_lease_renumber(struct mo_fleet *fleet, struct mo_lease *lease);

/* Returns the place of a session's hold, or MO_ERR_NOT_FOUND. */
int mo_lease_held_by(const struct mo_lease *lease, const struct mo_session *session);
/* Returns the steps that a session computes in a second; 0: not measured. */
double mo_session_rate(const struct mo_session *session, enum mo_back_end back_end);
bool mo_session_is_free(const struct mo_session *session); /* it holds nothing */
void mo_lease_hold(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_session *session,
                   uint64_t now_ns);
/* Ends a hold. Only that. */
void mo_lease_unhold(struct mo_lease *lease, uint32_t place);
/* Ends a hold without a result. The last one: work goes back, and an audit to the list. With a body
 * that was lost too often the lease ends although others hold it. is_lost: the session ended with
 * it, or failed. false: the lease was freed. */
bool mo_lease_release(struct mo_fleet *fleet, struct mo_lease *lease, uint32_t place, bool is_lost,
                      uint64_t now_ns, struct mo_after *after);
/* Orders a session to drop a lease. */
void mo_lease_drop(const struct mo_lease *lease, struct mo_session *session,
                   struct mo_after *after);
/* Lets the next session take the lease, or have it no more. */
void mo_lease_list(struct mo_fleet *fleet, struct mo_lease *lease, uint64_t now_ns,
                   struct mo_after *after);
void mo_lease_unlist(struct mo_fleet *fleet, struct mo_lease *lease);

/* Gives the blocks their results: the lease has no parcel any more. */
void mo_lease_deliver(struct mo_lease *lease, const struct mo_remote_result *result,
                      struct mo_after *after);
/* Frees a lease. Blocks that it still has are put back; sessions that hold it are told to drop
 * it. */
void mo_lease_end(struct mo_fleet *fleet, struct mo_lease *lease, struct mo_after *after);

/* Lets a session wait for work of a class; NULL: it waits no more. */
void mo_session_wait(struct mo_session *session, enum mo_back_end back_end, struct mo_class *class);
/* Wakes a session that waits, if any: an idle one if there is one. */
void mo_class_wake(struct mo_fleet *fleet, enum mo_back_end back_end, struct mo_after *after);

#endif
