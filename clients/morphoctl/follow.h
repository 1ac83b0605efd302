/* follow.h: the event stream, followed across breaks: after each the stream goes on behind the last
 * event that came. */
#ifndef MORPHOCTL_FOLLOW_H
#define MORPHOCTL_FOLLOW_H

#include "ctl.h"
#include "sse.h"

struct follow {
  struct ctl *ctl;
  const char *job; /* NULL: everything */
  int64_t after;   /* begin behind this event; −1: with what happens next */
  /* Each event; `reset` has no body of an event: some are no longer kept. Non-zero ends the
   * following. */
  int (*event)(void *context, const char *type, const char *data);
  /* With each sign of life, events or heartbeats (at least every 15 s), after its events
   * (nullable). Non-zero as above. */
  int (*alive)(void *context);
  /* After each break, before the stream is opened again (nullable): STATUS_OK to go on. */
  int (*broken)(void *context);
  bool (*ended)(void *context); /* whether `broken` found that there is nothing to follow any more
                                   (nullable) */
  void *context;
  struct sse sse; /* its own */
};

/* STATUS_OK when `event` or `ended` said so; STATUS_INTERRUPTED; STATUS_CONNECTION after --retry
 * without a sign of life; else what was complained about. */
int follow_events(struct follow *follow);

#endif
