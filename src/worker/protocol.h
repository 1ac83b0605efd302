/* protocol.h: the JSON that a worker and its daemon exchange about a session. */
#ifndef MORPHO_WORKER_PROTOCOL_H
#define MORPHO_WORKER_PROTOCOL_H

#include "base/text.h"
#include "fleet/fleet.h"

/* Writes the request that opens a session. */
void mo_protocol_put_offer(const struct mo_fleet_offer *offer, struct mo_text *text);

struct mo_worker_session {
  char id[24]; /* digits */
  struct mo_workspace workspace;
  uint32_t silence_ms; /* the daemon drops a session that is silent for longer */
  uint32_t wait_s;     /* longest wait for leases that the daemon grants */
};
/* These two parse the daemon's reply, which is NUL-terminated. MO_ERR_FORMAT; MO_ERR_NO_MEMORY.
 */
int mo_protocol_get_session(const char *text, size_t size, struct mo_worker_session *session,
                            struct mo_message *message);
int mo_protocol_get_orders(const char *text, size_t size, struct mo_fleet_orders *orders,
                           struct mo_message *message);
/* Reads the detail of a problem document. Returns "" if the text is not a problem document. */
void mo_protocol_get_detail(const char *text, size_t size, struct mo_message *message);

#endif
