/* follow.h: follows the event stream. After a break the stream continues after the last event
 * received. */
#ifndef MORPHOCTL_FOLLOW_H
#define MORPHOCTL_FOLLOW_H

#include "ctl.h"

#define SSE_BYTES_MAX (1 << 20)

struct sse {
  char *text; /* the part received of the next event */
  size_t n_bytes;
  char last_id[32]; /* id of the last complete event, where to continue; "" none yet */
};

/* Reads n bytes. Calls `event` for each complete event that has data; a non-zero result ends the
 * reading and is returned. −1: an event is larger than SSE_BYTES_MAX, or no memory. */
int sse_feed(struct sse *sse, const char *bytes, size_t n,
             int (*event)(void *context, const char *type, const char *data), void *context);
void sse_free(struct sse *sse);

struct follow {
  struct ctl *ctl;
  const char *job; /* NULL: all jobs */
  int64_t after;   /* start after this event; −1: with the next event */
  /* Receives each event. The event `reset` has a different body: some events are no longer
   * kept. Non-zero ends the following. */
  int (*event)(void *context, const char *type, const char *data);
  /* Called after the events of each sign of life, an event or a heartbeat (at least every 15 s).
   * Nullable; true ends the following. */
  bool (*alive)(void *context);
  /* Called after each break, before the stream is opened again. True ends the following. */
  bool (*broken)(void *context);
  void *context;
  struct sse sse; /* private */
};

/* Follows events until one of these functions ends it. An error ends the program, as does no sign
 * of life for as long as --retry says. */
void follow_events(struct follow *follow);

#endif
