/* follow.h: follows the event stream. After a break the stream continues after the last event
 * received. */
#ifndef MORPHOCTL_FOLLOW_H
#define MORPHOCTL_FOLLOW_H

#include "ctl.h"
#include "sse.h"

struct follow {
  struct ctl *ctl;
  const char *job; /* NULL: all jobs */
  int64_t after;   /* start after this event; −1: with the next event */
  /* Receives each event. The event `reset` has no event's body: it says that some events are no
   * longer kept. Non-zero ends the following. */
  int (*event)(void *context, const char *type, const char *data);
  /* Called after the events of each sign of life, an event or a heartbeat (at least every 15 s).
   * Nullable; non-zero ends the following. */
  int (*alive)(void *context);
  /* Called after each break, before the stream is opened again. Nullable; STATUS_OK continues. */
  int (*broken)(void *context);
  bool (*ended)(void *context); /* says whether `broken` found the job ended (nullable) */
  void *context;
  struct sse sse; /* private */
};

/* Follows events. STATUS_OK: `event` or `ended` ended the following; STATUS_INTERRUPTED;
 * STATUS_CONNECTION: no sign of life for as long as --retry says; else the status of an error that
 * was already reported. */
int follow_events(struct follow *follow);

#endif
