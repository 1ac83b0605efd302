/* sse.h: reads server-sent events from pieces of a stream, however they are cut. */
#ifndef MORPHOCTL_SSE_H
#define MORPHOCTL_SSE_H

#include <stdbool.h>
#include <stddef.h>

#define SSE_BYTES_MAX (1 << 20)

struct sse {
  char *line, *data; /* the line and the event that are being read */
  size_t line_bytes, data_bytes;
  char type[64], id[32];
  char last_id[32]; /* of the last event that was complete: where to go on; "" none yet */
  bool skip_newline;
};

/* `event` is called for each complete event that has data; a non-zero return ends the reading and
 * is passed on. −1: an event is larger than SSE_BYTES_MAX, or no memory. */
int sse_feed(struct sse *sse, const char *bytes, size_t n,
             int (*event)(void *context, const char *type, const char *id, const char *data),
             void *context);
/* Forgets what is half read, keeps last_id: for a new connection. */
void sse_reset(struct sse *sse);
void sse_free(struct sse *sse);

#endif
