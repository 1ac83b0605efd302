/* sse.h: reads server-sent events from a stream in pieces of any size. */
#ifndef MORPHOCTL_SSE_H
#define MORPHOCTL_SSE_H

#include <stdbool.h>
#include <stddef.h>

#define SSE_BYTES_MAX (1 << 20)

struct sse {
  char *line, *data; /* the current line and the current event */
  size_t line_bytes, data_bytes;
  char type[64], id[32];
  char last_id[32]; /* id of the last complete event, where to continue; "" none yet */
  bool skip_newline;
};

/* Reads n bytes. Calls `event` for each complete event that has data; a non-zero result ends the
 * reading and is returned. −1: an event is larger than SSE_BYTES_MAX, or no memory. */
int sse_feed(struct sse *sse, const char *bytes, size_t n,
             int (*event)(void *context, const char *type, const char *id, const char *data),
             void *context);
/* Drops an incomplete event but keeps last_id, for a new connection. */
void sse_reset(struct sse *sse);
void sse_free(struct sse *sse);

#endif
