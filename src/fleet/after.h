/* after.h: collects what must be done once the mutex is free. */
#ifndef MORPHO_FLEET_AFTER_H
#define MORPHO_FLEET_AFTER_H

#include "fleet/state.h"

struct mo_event;

/* Initialize it to {0}; mo_after_run empties it. */
struct mo_after {
  SLIST_HEAD(, mo_parcel) parcels;
  struct mo_event *events;
  uint64_t *wakes;
  uint32_t n_wakes, wakes_capacity;
  bool is_put_back[2], is_emptied[2]; /* by back end; is_emptied: its last session ended */
};

/* Puts blocks back into the source, or delivers their results; the rows must live until
 * mo_after_run. */
void mo_after_put_back(struct mo_after *after, struct mo_parcel *parcel);
void mo_after_deliver(struct mo_after *after, struct mo_parcel *parcel,
                      const struct mo_remote_result *result);
/* If memory runs out, these two functions do nothing. That is harmless: sessions also look for
 * orders and work without being woken, and the counters still show what happened. */
void mo_after_wake(struct mo_after *after, uint64_t session);
/* data: a JSON object without its closing brace, so that more members can be added. Takes ownership
 * of the text. An event has room for 511 bytes, so use mo_event_member for names and reasons that
 * workers and operators chose. */
void mo_after_event(struct mo_after *after, const char *type, struct mo_text *data);

/* Appends a member. Keeps at most `most` bytes of the value, encoded as JSON. */
#define MO_EVENT_NAME_BYTES 64
#define MO_EVENT_WHY_BYTES  320
void mo_event_member(struct mo_text *text, const char *name, const char *words, size_t most);
/* Begins an event about a worker. why: "" if there is no reason. */
void mo_event_session(struct mo_text *text, const char *name, const char *host, const char *why);

/* Call it without the lock. */
void mo_after_run(struct mo_fleet *fleet, struct mo_after *after);

#endif
