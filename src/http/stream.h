/* stream.h: event streams (server-sent events) of a durable sequence that the service keeps. */
#ifndef MORPHO_HTTP_STREAM_H
#define MORPHO_HTTP_STREAM_H

#include "base/text.h"
#include "http/request.h"

struct mo_stream;
struct mo_streams {
  pthread_mutex_t lock;
  LIST_HEAD(, mo_stream) open;
  atomic_uint n;
  bool closed;
};

/* The position of a stream. */
struct mo_stream_place {
  int64_t after; /* sequence of the last event that was sent */
  int64_t topic; /* only events of this topic; 0: all */
  bool greeted;  /* `after` is known to be a position in the sequence */
};
#define MO_STREAM_PAGE 200
/* Appends the frames of up to MO_STREAM_PAGE more events and advances the position. Runs on an API
 * thread. Returns the number of events; MO_STREAM_PAGE: there may be more. On an error the stream
 * is closed, and the client reconnects from its last event. */
typedef int64_t (*mo_stream_fill)(struct mo_request *request, struct mo_stream_place *place,
                                  struct mo_text *frames);

/* Opens an event stream as the reply. MO_ERR_LIMIT, MO_ERR_BUSY (closing), MO_ERR_NO_MEMORY. */
int mo_stream_open(struct mo_request *request, struct mo_stream_place place, mo_stream_fill fill);
/* Sends a new event to all streams that include its topic. Call it in order of the sequence
 * numbers, once mo_stream_fill can read the event. write: appends the frame. */
void mo_streams_send(struct mo_http *http, int64_t sequence, int64_t topic,
                     void (*write)(struct mo_text *text, const void *event), const void *event);
void mo_stream_free(struct mo_request *request);
/* Sends heartbeats, and drops readers that are slow, have left, or have a revoked token. */
void mo_streams_tick(struct mo_http *http, int64_t now_us);
void mo_streams_close(struct mo_http *http);

#endif
