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

/* Where a stream is. */
struct mo_stream_place {
  int64_t after; /* sequence of the last event that was sent */
  int64_t topic; /* only events of this topic; 0: all */
  bool greeted;  /* `after` is known to be a place of the sequence */
};
#define MO_STREAM_PAGE 200
/* Appends the frames of up to MO_STREAM_PAGE further events and moves the place. Runs on an API
 * thread. Returns the number of events; MO_STREAM_PAGE: there may be more. On an error the stream
 * ends, and the client asks again from its last event. */
typedef int64_t (*mo_stream_fill)(struct mo_request *request, struct mo_stream_place *place,
                                  struct mo_text *frames);

/* Opens an event stream as the reply. MO_ERR_LIMIT, MO_ERR_BUSY (closing), MO_ERR_NO_MEMORY. */
int mo_stream_open(struct mo_request *request, struct mo_stream_place place, mo_stream_fill fill);
/* Sends a new event to all streams that want it. Call in order of the sequences, after the event
 * can be read by mo_stream_fill. write: appends the frame. */
void mo_streams_send(struct mo_http *http, int64_t sequence, int64_t topic,
                     void (*write)(struct mo_text *text, const void *event), const void *event);
void mo_stream_free(struct mo_request *request);
/* Sends heartbeats, drops slow and vanished readers, and those with a token that was taken away. */
void mo_streams_tick(struct mo_http *http, int64_t now_us);
void mo_streams_close(struct mo_http *http);

#endif
