/* suspects.h: bodies whose leases ended sessions.
 *
 * A body that crashes a worker's process would crash one worker after another. So when a session is
 * lost, every body of its leases is remembered by the hash of its genotype. After three lost
 * sessions it is leased among at most half as many bodies as the last time, and to a session that
 * holds no other lease. It is no longer computed only after three different workers were lost with
 * it as their only body, so that one bad worker cannot condemn a body. If fewer workers lost six
 * sessions in this way, this process computes it. A result clears the bodies of its lease. */
#ifndef MORPHO_FLEET_SUSPECTS_H
#define MORPHO_FLEET_SUSPECTS_H

#include "fleet/wire.h"

#define MO_SUSPECT_SETS 4096
#define MO_SUSPECT_WAYS 4
/* Number of lost sessions that may be chance, and of workers that prove that a body is bad. */
#define MO_PATIENT 3

/* Initialize it to zeros. */
struct mo_suspects {
  uint32_t n;
  struct mo_suspect {
    uint64_t hash, session;     /* session: the most recently lost session */
    uint64_t alone[MO_PATIENT]; /* workers that were lost while this was their only body */
    uint32_t lost, lost_alone, n_alone, limit;
  } sets[MO_SUSPECT_SETS][MO_SUSPECT_WAYS];
};

/* Records that a session ended while it held this lease. A session counts once per body, and its
 * worker counts once toward the proof. is_only: the session held no other lease. *is_kept: this
 * process should compute the lease. Returns whether the lease has a single body that is now proven
 * bad. */
bool mo_suspects_add(struct mo_suspects *suspects, const struct mo_wire_lease *lease,
                     uint64_t session, uint64_t worker, bool is_only, bool *is_kept);
/* Returns how many blocks a lease with these bodies may have, ≥ 1. UINT32_MAX: any number, and its
 * session may hold other leases. *is_suspect: one of the bodies is a suspect. */
uint32_t mo_suspects_limit(const struct mo_suspects *suspects, const struct mo_wire_lease *lease,
                           bool *is_suspect);
void mo_suspects_clear(struct mo_suspects *suspects, const struct mo_wire_lease *lease);

#endif
