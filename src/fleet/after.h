/* after.h: what is left to do when the mutex is free again. */
#ifndef MORPHO_FLEET_AFTER_H
#define MORPHO_FLEET_AFTER_H

#include "fleet/state.h"

struct mo_event;

/* Starts as {0}; mo_after_run empties it. */
struct mo_after {
  SLIST_HEAD(, mo_parcel) parcels;
  struct mo_event *events;
  uint64_t *wakes;
  uint32_t n_wakes, wakes_capacity;
  bool is_put_back[2], is_emptied[2]; /* by back end; emptied: its last session ended */
};

/* Blocks go back to the source, or get results; rows must live until mo_after_run. */
void mo_after_put_back(struct mo_after *after, struct mo_parcel *parcel);
void mo_after_deliver(struct mo_after *after, struct mo_parcel *parcel,
                      const struct mo_remote_result *result);
/* These two are lost without memory: sessions look for orders and work by themselves as well, and
 * the counters still say what happened. */
void mo_after_wake(struct mo_after *after, uint64_t session);
/* data: a JSON object without its end; more members may have been added. Takes the text. An event
 * has room for 511 bytes: add what workers and operators chose by mo_event_member. */
void mo_after_event(struct mo_after *after, const char *type, struct mo_text *data);

/* Appends a member, of whose words at most so many bytes, as JSON, are kept. */
#define MO_EVENT_NAME_BYTES 64
#define MO_EVENT_WHY_BYTES  320
void mo_event_member(struct mo_text *text, const char *name, const char *words, size_t most);
/* Begins the event of a worker. why "": none. */
void mo_event_session(struct mo_text *text, const char *name, const char *host, const char *why);

/* Without the lock. */
void mo_after_run(struct mo_fleet *fleet, struct mo_after *after);

#endif
