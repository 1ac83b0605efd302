/* stream.c: event streams (server-sent events).
 *
 * A stream is live or behind. Live: the store's listener writes each new event into the stream's
 * buffer and wakes its connection. Behind (the client asked for older events, or reads more slowly
 * than events come): the listener skips the stream. Whenever its buffer is empty, an API thread
 * fills it from the store; when the store has no more events, the stream is live again. So the
 * memory of a stream is bounded, no event is lost or sent twice, and an idle stream costs only its
 * heartbeat.
 *
 * The connection of a stream that waits for events is suspended. One lock guards everything
 * here. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "http/server.h"

#include "base/clock.h"

#define BUFFER_BYTES (256 * 1024) /* a live stream with more unread bytes falls behind */
#define PAGE_EVENTS  200
#define STALL_US     60000000 /* a reader that takes nothing for this long is dropped */
#define RETRY_MS     2000     /* how long clients should wait before they reconnect */

struct mo_stream {
  struct mo_request *request;
  struct mo_stream *next, *previous;
  int64_t last; /* sequence of the newest event in the buffer or already sent */
  int64_t job;  /* send only events of this job; 0: all */
  bool live;
  bool news; /* for a stream that is behind: events came since the last read of the store */
  bool ended;
  bool suspended; /* the connection waits for wake */
  bool busy;      /* an API thread fills the buffer; the connection stays suspended until then */
  bool greeted;   /* the sequence to start after has been checked */
  struct mo_text buffer;
  size_t read;        /* bytes of the buffer that were sent */
  int64_t written_us; /* when bytes were last put into the buffer */
  int64_t taken_us;   /* when the reader last took bytes, or had none to take */
};

void mo_event_write(struct mo_text *text, const struct mo_event *event)
{
  mo_text_format(text, "{\"id\":\"%lld\",\"type\":", (long long)event->sequence);
  mo_text_json_string(text, event->type, strlen(event->type));
  if (event->job > 0)
    mo_text_format(text, ",\"job\":\"%lld\",\"at\":", (long long)event->job);
  else
    mo_text_add(text, ",\"job\":null,\"at\":");
  mo_text_json_time(text, event->time_us);
  mo_text_add(text, ",\"data\":");
  mo_text_json_stored(text, event->data);
  mo_text_add(text, "}");
}

static void frame(struct mo_text *text, const struct mo_event *event)
{
  mo_text_format(text, "id: %lld\nevent: %s\ndata: ", (long long)event->sequence, event->type);
  mo_event_write(text, event);
  mo_text_add(text, "\n\n");
}

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

/* Receives new events on the store's writer thread, after a commit. */
static void listener(void *context, const struct mo_event *events, size_t n)
{
  struct mo_http *http = context;
  for (size_t i = 0; i < n; i++) {
    if (strncmp(events[i].type, "job.", 4) == 0 && strcmp(events[i].type, "job.progress") != 0)
      atomic_store(&http->jobs_changed, true);
    if (strcmp(events[i].type, "job.finished") == 0)
      mo_waits_job_ended(http, events[i].job);
  }
  pthread_mutex_lock(&http->streams.lock);
  int64_t now_us = http->streams.first != NULL ? mo_clock_us() : 0;
  for (size_t i = 0; i < n && http->streams.first != NULL; i++) {
    struct mo_text text = {0};
    frame(&text, &events[i]);
    for (struct mo_stream *stream = http->streams.first; stream != NULL; stream = stream->next) {
      if (stream->job != 0 && stream->job != events[i].job)
        continue;
      if (!stream->live) {
        stream->news = true;
        continue;
      }
      if (events[i].sequence <= stream->last)
        continue;
      if (text.failed || stream->buffer.size - stream->read + text.size > BUFFER_BYTES) {
        stream->live = false; /* the rest comes from the store, once the buffer is empty */
        stream->news = true;
      } else {
        put(stream, text.data, text.size, now_us);
        stream->last = events[i].sequence;
        atomic_fetch_add(&http->metrics.events_sent, 1);
      }
      wake(stream);
    }
    mo_text_free(&text);
  }
  pthread_mutex_unlock(&http->streams.lock);
}

int mo_streams_start(struct mo_http *http)
{
  pthread_mutex_init(&http->streams.lock, NULL);
  http->streams.listener = -1;
  return mo_store_subscribe(http->services.store, listener, http, &http->streams.listener);
}

int mo_stream_open(struct mo_request *request, int64_t after, int64_t job)
{
  struct mo_http *http = request->http;
  struct mo_stream *stream = calloc(1, sizeof(*stream));
  if (stream == NULL)
    return MO_ERR_NO_MEMORY;
  int64_t newest = 0, now_us = mo_clock_us();
  char greeting[32];
  int n = snprintf(greeting, sizeof(greeting), "retry: %d\n\n", RETRY_MS);
  stream->request = request;
  stream->job = job;
  put(stream, greeting, (size_t)n, now_us);
  if (stream->buffer.failed) {
    free(stream);
    return MO_ERR_NO_MEMORY;
  }
  if (after < 0) {
    int64_t got = mo_store_events(http->services.store, INT64_MAX - 1, 0, NULL, 0, NULL, &newest);
    if (got < 0) {
      mo_text_free(&stream->buffer);
      free(stream);
      return (int)got;
    }
    stream->greeted = true;
  }
  /* Events between this read and the entry into the list are fetched from the store, like older
   * ones. */
  stream->last = after < 0 ? newest : after;
  pthread_mutex_lock(&http->streams.lock);
  int result = http->streams.closed                          ? MO_ERR_BUSY
               : http->streams.n >= http->config.max_streams ? MO_ERR_LIMIT
                                                             : MO_OK;
  if (result == MO_OK) {
    request->stream = stream;
    stream->next = http->streams.first;
    if (stream->next != NULL)
      stream->next->previous = stream;
    http->streams.first = stream;
    http->streams.n++;
  }
  pthread_mutex_unlock(&http->streams.lock);
  if (result != MO_OK) {
    mo_text_free(&stream->buffer);
    free(stream);
  }
  return result;
}

/* Reads one page from the store into the buffer. True: there may be more. The connection is
 * suspended and the buffer empty. */
static bool fill(struct mo_http *http, struct mo_stream *stream, struct mo_event *page)
{
  pthread_mutex_lock(&http->streams.lock);
  int64_t after = stream->last;
  stream->news = false;
  pthread_mutex_unlock(&http->streams.lock);
  int64_t oldest = 0, newest = 0;
  int64_t n = mo_store_events(http->services.store, after, stream->job, page, PAGE_EVENTS, &oldest,
                              &newest);
  struct mo_text text = {0};
  if (n == MO_ERR_CORRUPT)
    mo_request_note(stream->request, "the events cannot be read: %s", mo_error_text((int)n));
  if (n >= 0 && (after < oldest - 1 || (!stream->greeted && after > newest))) {
    /* The sequence is unknown (pruned, or of another database): the client must start again. */
    after = after > newest ? newest : oldest - 1;
    mo_text_format(&text,
                   "id: %lld\nevent: reset\ndata: {\"oldest\":\"%lld\",\"newest\":\"%lld\"}\n\n",
                   (long long)after, (long long)oldest, (long long)newest);
  }
  for (int64_t i = 0; i < n; i++)
    frame(&text, &page[i]);
  pthread_mutex_lock(&http->streams.lock);
  if (n < 0 || text.failed) {
    stream->ended = true; /* the client reconnects and asks again from its last event */
  } else {
    stream->greeted = true;
    stream->last = n > 0 ? page[n - 1].sequence : after;
    if (text.size > 0)
      put(stream, text.data, text.size, mo_clock_us());
    atomic_fetch_add(&http->metrics.events_sent, (uint64_t)n);
    stream->live = n < PAGE_EVENTS && !stream->news;
  }
  bool more =
      !stream->ended && !stream->live && stream->buffer.size - stream->read < BUFFER_BYTES / 2;
  pthread_mutex_unlock(&http->streams.lock);
  mo_text_free(&text);
  return more;
}

void mo_stream_refill(struct mo_request *request)
{
  struct mo_http *http = request->http;
  struct mo_stream *stream = request->stream;
  struct mo_event *page = malloc(PAGE_EVENTS * sizeof(*page));
  while (page != NULL && fill(http, stream, page))
    ;
  pthread_mutex_lock(&http->streams.lock);
  stream->ended |= page == NULL;
  stream->busy = false;
  wake(stream);
  pthread_mutex_unlock(&http->streams.lock);
  free(page);
}

/* Gives libmicrohttpd the next bytes. */
static ssize_t reader(void *context, uint64_t position, char *out, size_t capacity)
{
  (void)position;
  struct mo_request *request = context;
  struct mo_http *http = request->http;
  struct mo_stream *stream = request->stream;
  ssize_t result = 0;
  pthread_mutex_lock(&http->streams.lock);
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
    bool closed;
    stream->busy = !stream->live;
    stream->suspended = true;
    MHD_suspend_connection(request->mhd);
    if (stream->busy && !mo_pool_give(http, request, &closed)) {
      stream->busy = false;
      stream->ended = true;
      wake(stream);
    }
  }
  pthread_mutex_unlock(&http->streams.lock);
  return result;
}

enum MHD_Result mo_stream_send(struct mo_request *request)
{
  struct MHD_Response *response =
      MHD_create_response_from_callback(MHD_SIZE_UNKNOWN, 16 * 1024, reader, request, NULL);
  if (response == NULL)
    return MHD_NO;
  request->reply.status = 200;
  atomic_store(&request->connection->deadline_us, MO_NEVER); /* see mo_streams_tick */
  enum MHD_Result result = MHD_NO;
  if (MHD_add_response_header(response, "Content-Type", "text/event-stream") == MHD_YES &&
      MHD_add_response_header(response, "Cache-Control", "no-store") == MHD_YES &&
      MHD_add_response_header(response, "X-Accel-Buffering", "no") == MHD_YES &&
      MHD_add_response_header(response, "X-Content-Type-Options", "nosniff") == MHD_YES &&
      MHD_add_response_header(response, "X-Request-Id", request->id) == MHD_YES)
    result = mo_queue_response(request->mhd, 200, response);
  MHD_destroy_response(response);
  return result;
}

void mo_stream_free(struct mo_request *request)
{
  struct mo_streams *streams = &request->http->streams;
  struct mo_stream *stream = request->stream;
  pthread_mutex_lock(&streams->lock);
  if (stream->previous != NULL)
    stream->previous->next = stream->next;
  else
    streams->first = stream->next;
  if (stream->next != NULL)
    stream->next->previous = stream->previous;
  streams->n--;
  pthread_mutex_unlock(&streams->lock);
  mo_text_free(&stream->buffer);
  free(stream);
  request->stream = NULL;
}

void mo_streams_tick(struct mo_http *http, int64_t now_us)
{
  static const char beat[] = ": \n\n";
  pthread_mutex_lock(&http->streams.lock);
  for (struct mo_stream *stream = http->streams.first; stream != NULL; stream = stream->next) {
    bool unread = stream->buffer.size > stream->read;
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
      mo_connection_cut(http, stream->request->connection);
    }
  }
  pthread_mutex_unlock(&http->streams.lock);
}

void mo_streams_close(struct mo_http *http)
{
  pthread_mutex_lock(&http->streams.lock);
  http->streams.closed = true;
  for (struct mo_stream *stream = http->streams.first; stream != NULL; stream = stream->next) {
    stream->ended = true;
    wake(stream);
  }
  pthread_mutex_unlock(&http->streams.lock);
}

void mo_streams_stop(struct mo_http *http)
{
  if (http->streams.listener >= 0)
    mo_store_unsubscribe(http->services.store, http->streams.listener);
  pthread_mutex_destroy(&http->streams.lock);
}
