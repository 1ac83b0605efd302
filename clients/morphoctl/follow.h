/* follow.h: follows the event stream. After a lost connection, the stream continues after the last
 * event received. */
#ifndef MORPHOCTL_FOLLOW_H
#define MORPHOCTL_FOLLOW_H

#include "ctl.h"

#define SSE_BYTES_MAX (1 << 20)

struct sse {
  char *text; /* the received part of the next event */
  size_t n_bytes;
  char last_id[32]; /* id of the last complete event, from which to continue; "" if none yet */
};

/* Parses n bytes. Calls `event` for each complete event with data; a non-zero result stops the
 * parsing and is returned. −1: an event is larger than SSE_BYTES_MAX, or out of memory. */
int sse_feed(struct sse *sse, const char *bytes, size_t n,
             int (*event)(void *context, const char *type, const char *data), void *context);
void sse_free(struct sse *sse);

struct follow {
  struct ctl *ctl;
  const char *job; /* NULL means all jobs */
  int64_t after;   /* start after this event; −1 = with the next event */
  /* Receives each event. The event `reset`, with a different body, means that some events are no
   * longer kept. A non-zero result stops following. */
  int (*event)(void *context, const char *type, const char *data);
  /* Called after each event or heartbeat (at least one every 15 s). Nullable; true stops
   * following. */
  bool (*alive)(void *context);
  /* Called after each lost connection, before the stream is reopened. True stops following. */
  bool (*broken)(void *context);
  void *context;
  struct sse sse; /* private */
};

/* Follows events until one of these functions stops it. An error ends the program, as does a
 * silence as long as --retry allows. */
void follow_events(struct follow *follow);

#endif
