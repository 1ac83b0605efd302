/* stream.c: see stream.h.
 *
 * A stream is live or behind. Live: mo_streams_send writes each new event into the stream's buffer
 * and wakes its connection. Behind (the client requested older events, or reads more slowly than
 * events arrive): mo_streams_send skips the stream. Whenever its buffer is empty, an API thread
 * fills it; when no more events exist, the stream is live again. The memory of a stream is
 * therefore bounded, no event is lost or sent twice, and an idle stream costs only its heartbeat.
 *
 * The connection of a stream that waits for events is suspended. One lock guards everything
 * here. */
#include "http/stream.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "base/thread.h"
#include "http/server.h"

#define BUFFER_BYTES (256 * 1024) /* a live stream with more unread bytes falls behind */
#define STALL_US     60000000     /* a client that reads nothing for this long is dropped */
#define RETRY_MS     2000         /* how long clients should wait before they reconnect */

struct mo_stream {
  struct mo_request *request;
  LIST_ENTRY(mo_stream) others;
  mo_stream_fill fill;
  struct mo_stream_place place; /* after: the newest event in the buffer or already sent */
  bool live;
  bool news; /* for a stream that is behind: events arrived since the last call of fill */
  bool ended;
  bool suspended;          /* the connection is suspended until a wake */
  unsigned tokens_version; /* version when the client's token was last checked; 0: none */
  bool busy; /* an API thread fills the buffer; the connection stays suspended until then */
  struct mo_text buffer;
  size_t read;        /* bytes of the buffer that were sent */
  int64_t written_us; /* when bytes were last put into the buffer */
  int64_t taken_us;   /* when the reader last took bytes, or had none to take */
};

static void wake(struct mo_stream *stream)
{
  if (!stream->suspended || stream->busy)
    return;
  stream->suspended = false;
  MHD_resume_connection(stream->request->mhd);
}

static void put(struct mo_stream *stream, const char *bytes, size_t n, int64_t now_us)
{
  if (stream->read > 0) {
    memmove(stream->buffer.data, stream->buffer.data + stream->read,
            stream->buffer.size - stream->read);
    stream->buffer.size -= stream->read;
    stream->read = 0;
  }
  if (stream->buffer.size == 0)
    stream->taken_us = now_us;
  mo_text_bytes(&stream->buffer, bytes, n);
  if (stream->buffer.failed)
    stream->ended = true;
  stream->written_us = now_us;
}

void mo_streams_send(struct mo_http *http, int64_t sequence, int64_t topic,
                     void (*write)(struct mo_text *text, const void *event), const void *event)
{
  struct mo_text text = {0};
  struct mo_stream *stream;
  /* A stream that is being opened is behind, and its first fill will find the event. */
  if (atomic_load(&http->streams.n) == 0)
    return;
  write(&text, event);
  pthread_mutex_lock(&http->streams.lock);
  int64_t now_us = mo_clock_us();
  LIST_FOREACH(stream, &http->streams.open, others)
  {
    if (stream->place.topic != 0 && stream->place.topic != topic)
      continue;
    if (!stream->live) {
      stream->news = true;
      continue;
    }
    if (sequence <= stream->place.after)
      continue;
    if (text.failed || stream->buffer.size - stream->read + text.size > BUFFER_BYTES) {
      stream->live = false; /* the rest comes from fill, once the buffer is empty */
      stream->news = true;
    } else {
      put(stream, text.data, text.size, now_us);
      stream->place.after = sequence;
      atomic_fetch_add(&http->metrics.events_sent, 1);
    }
    wake(stream);
  }
  pthread_mutex_unlock(&http->streams.lock);
  mo_text_free(&text);
}

/* Fills the buffer with one page. Returns whether there may be more. The connection is suspended
 * and the buffer empty. */
static bool fill(struct mo_http *http, struct mo_stream *stream)
{
  pthread_mutex_lock(&http->streams.lock);
  struct mo_stream_place place = stream->place;
  stream->news = false;
  pthread_mutex_unlock(&http->streams.lock);
  struct mo_text text = {0};
  int64_t n = stream->fill(stream->request, &place, &text);
  pthread_mutex_lock(&http->streams.lock);
  if (n < 0 || text.failed) {
    stream->ended = true; /* the client reconnects and continues from its last event */
  } else {
    stream->place = place;
    if (text.size > 0)
      put(stream, text.data, text.size, mo_clock_us());
    atomic_fetch_add(&http->metrics.events_sent, (uint64_t)n);
    stream->live = n < MO_STREAM_PAGE && !stream->news;
  }
  bool more =
      !stream->ended && !stream->live && stream->buffer.size - stream->read < BUFFER_BYTES / 2;
  pthread_mutex_unlock(&http->streams.lock);
  mo_text_free(&text);
  return more;
}

static void refill(struct mo_request *request)
{
  struct mo_http *http = request->http;
  struct mo_stream *stream = request->stream;
  while (fill(http, stream))
    ;
  MO_GUARD(&http->streams.lock);
  stream->busy = false;
  wake(stream);
}

/* Passes libmicrohttpd the next bytes. */
static ssize_t reader(void *context, uint64_t position, char *out, size_t capacity)
{
  (void)position;
  struct mo_request *request = context;
  struct mo_http *http = request->http;
  struct mo_stream *stream = request->stream;
  ssize_t result = 0;
  MO_GUARD(&http->streams.lock);
  size_t ready = stream->buffer.size - stream->read;
  stream->taken_us = mo_clock_us();
  if (ready > 0) {
    size_t n = ready < capacity ? ready : capacity;
    memcpy(out, stream->buffer.data + stream->read, n);
    stream->read += n;
    request->sent += n;
    result = (ssize_t)n;
    if (stream->read == stream->buffer.size)
      stream->buffer.size = stream->read = 0;
  } else if (stream->ended) {
    result = MHD_CONTENT_READER_END_OF_STREAM;
  } else {
    stream->busy = !stream->live;
    stream->suspended = true;
    MHD_suspend_connection(request->mhd);
    if (stream->busy && mo_pool_give(http, request) != MO_OK) {
      stream->busy = false;
      stream->ended = true;
      wake(stream);
    }
  }
  return result;
}

int mo_stream_open(struct mo_request *request, struct mo_stream_place place, mo_stream_fill fill_it)
{
  struct mo_http *http = request->http;
  struct mo_stream *stream = calloc(1, sizeof(*stream));
  if (stream == NULL)
    return MO_ERR_NO_MEMORY;
  char greeting[32];
  int n = snprintf(greeting, sizeof(greeting), "retry: %d\n\n", RETRY_MS);
  stream->request = request;
  stream->place = place;
  stream->fill = fill_it;
  put(stream, greeting, (size_t)n, mo_clock_us());
  pthread_mutex_lock(&http->streams.lock);
  int error = stream->buffer.failed                         ? MO_ERR_NO_MEMORY
              : http->streams.closed                        ? MO_ERR_BUSY
              : http->streams.n >= http->config.max_streams ? MO_ERR_LIMIT
                                                            : MO_OK;
  if (error == MO_OK) {
    request->stream = stream;
    request->refill = refill;
    request->reader = reader;
    LIST_INSERT_HEAD(&http->streams.open, stream, others);
    http->streams.n++;
  }
  pthread_mutex_unlock(&http->streams.lock);
  if (error != MO_OK) {
    mo_text_free(&stream->buffer);
    free(stream);
    return error;
  }
  mo_reply_static(request, 200, "text/event-stream", "", 0);
  mo_reply_extra(request, "X-Accel-Buffering", "no");
  /* Streams have their own limit, so they do not take a place of their client. */
  mo_client_leave(&http->clients, request->client, mo_clock_us());
  request->client = NULL;
  return MO_OK;
}

void mo_stream_free(struct mo_request *request)
{
  struct mo_streams *streams = &request->http->streams;
  struct mo_stream *stream = request->stream;
  MO_GUARD(&streams->lock);
  LIST_REMOVE(stream, others);
  streams->n--;
  mo_text_free(&stream->buffer);
  free(stream);
  request->stream = NULL;
}

/* Returns whether the token of a stream has been revoked since the stream was opened. */
static bool is_revoked(struct mo_http *http, struct mo_stream *stream)
{
  const unsigned version = atomic_load(&http->tokens.version);
  struct mo_request *request = stream->request;
  struct mo_caller caller;
  if (stream->tokens_version == version || request->caller.name[0] == '\0')
    return false;
  stream->tokens_version = version;
  return mo_tokens_check(&http->tokens, request->framing.authorization, &caller) != 1 ||
         caller.right < request->route->right;
}

void mo_streams_tick(struct mo_http *http, int64_t now_us)
{
  static const char beat[] = ": \n\n";
  struct mo_stream *stream;
  MO_GUARD(&http->streams.lock);
  LIST_FOREACH(stream, &http->streams.open, others)
  {
    bool unread = stream->buffer.size > stream->read;
    stream->ended |= is_revoked(http, stream);
    if (stream->suspended) {
      if (mo_connection_has_left(stream->request->connection))
        stream->ended = true;
      if (!stream->ended && !unread &&
          now_us - stream->written_us >= (int64_t)http->config.heartbeat_ms * 1000)
        put(stream, beat, sizeof(beat) - 1, now_us);
      if (stream->ended || stream->buffer.size > stream->read)
        wake(stream);
    } else if (unread && now_us - stream->taken_us > STALL_US) {
      atomic_fetch_add(&http->metrics.streams_dropped, 1);
      stream->ended = true;
      stream->taken_us = now_us;
      mo_connection_cut(http, stream->request->connection, NULL, NULL);
    }
  }
}

void mo_streams_close(struct mo_http *http)
{
  struct mo_stream *stream;
  MO_GUARD(&http->streams.lock);
  http->streams.closed = true;
  LIST_FOREACH(stream, &http->streams.open, others)
  {
    stream->ended = true;
    wake(stream);
  }
}
