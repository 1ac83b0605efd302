/* suspects.h: bodies whose leases ended sessions.
 *
 * A body that ends the process of a worker would end one after the other. So every body of a lease
 * whose session was lost is remembered, by the hash of its genotype. After three lost sessions it
 * is leased among at most half as many bodies as the last time, and to a session that holds no
 * other lease. When three different workers were lost with it as their only body, it is computed no
 * more: one bad worker condemns no body. When fewer workers lost six such sessions, this process
 * computes it. A result clears its bodies. */
#ifndef MORPHO_FLEET_SUSPECTS_H
#define MORPHO_FLEET_SUSPECTS_H

#include "fleet/wire.h"

#define MO_SUSPECT_SETS 4096
#define MO_SUSPECT_WAYS 4
#define MO_PATIENT      3 /* lost sessions that are taken for chance; workers that prove a body */

/* Zeros at first. */
struct mo_suspects {
  uint32_t n;
  struct mo_suspect {
    uint64_t hash, session;     /* session: the last that was lost */
    uint64_t alone[MO_PATIENT]; /* workers that were lost with this body only */
    uint32_t lost, lost_alone, n_alone, limit;
  } sets[MO_SUSPECT_SETS][MO_SUSPECT_WAYS];
};

/* Notes that a session ended with this lease; a session counts once per body, and its worker once
 * for the proof. is_only: it held no other lease. *is_kept: this process should compute it. Returns
 * whether the lease is of one body, which is now proven. */
bool mo_suspects_add(struct mo_suspects *suspects, const struct mo_wire_lease *lease,
                     uint64_t session, uint64_t worker, bool is_only, bool *is_kept);
/* Returns how many blocks a lease with these bodies may have, ≥ 1; UINT32_MAX: any number, beside
 * other leases. *is_suspect: it has a suspect. */
uint32_t mo_suspects_limit(const struct mo_suspects *suspects, const struct mo_wire_lease *lease,
                           bool *is_suspect);
void mo_suspects_clear(struct mo_suspects *suspects, const struct mo_wire_lease *lease);

#endif
