/* facts.h: the state of the fleet as operators see it. Call the functions from any thread. */
#ifndef MORPHO_FLEET_FACTS_H
#define MORPHO_FLEET_FACTS_H

#include "fleet/fleet.h"

struct mo_session_status {
  uint64_t id;
  struct mo_fleet_offer offer;
  enum mo_session_state state;
  bool is_older;                          /* its version is older than this program's */
  char why[128];                          /* why it ended or was refused; "": it is working */
  uint64_t joined_ns, heard_ns, ended_ns; /* ended_ns: 0 if open */
  uint32_t leases, rows_out;              /* held at present */
  double rows_per_s;                      /* over about the last ten leases */
  double busy_s;
  uint64_t leases_done, leases_lost, rows_done, audits, audits_failed;
};
struct mo_fleet_status {
  uint32_t n_sessions, n_threads, n_devices; /* of open sessions */
  uint32_t n_older;                          /* open sessions with an older version */
  uint32_t n_serving[2];                     /* active sessions, by enum mo_back_end */
  uint32_t leases, rows_out;
  double rows_per_s;
  uint64_t joined, lost, leases_done, leases_again, rows_done, rows_twice, audits, audits_failed;
  uint64_t results_ignored; /* for leases that their session did not hold */
};
void mo_fleet_status(struct mo_fleet *fleet, struct mo_fleet_status *status);
/* Lists open sessions and the newest 256 ended ones, open ones first (malloc). MO_ERR_NO_MEMORY. */
int mo_fleet_sessions(struct mo_fleet *fleet, struct mo_session_status **items, size_t *n);

#endif
