/* events.c: replies with events as a page or a stream, and passes new events of the store to the
 * streams, to requests that wait for a job, and to the counts of jobs. */
#include <stdlib.h>
#include <string.h>

#include "api/jobs.h"
#include "api/tables.h"
#include "http/pool.h"
#include "http/stream.h"

/* Writes an event as JSON, after the opening brace of the object. */
static void write_event(struct mo_text *text, const struct mo_event *event)
{
  mo_text_member_id(text, "id", event->sequence);
  mo_text_member(text, "type", event->type);
  mo_text_member_id(text, "job", event->job > 0 ? event->job : -1);
  mo_text_member_time(text, "at", event->time_us);
  mo_text_name(text, "data");
  mo_text_json_stored(text, event->data);
  mo_text_add(text, "}");
}

static void write_frame(struct mo_text *text, const void *any)
{
  const struct mo_event *event = any;
  mo_text_format(text, "id: %lld\nevent: %s\ndata: {", (long long)event->sequence, event->type);
  write_event(text, event);
  mo_text_add(text, "\n\n");
}

/* ---- new events ---- */

/* Receives new events on the store's writer thread, after a commit. */
static void listener(void *context, const struct mo_event *events, size_t n)
{
  struct mo_api *api = context;
  for (size_t i = 0; i < n; i++) {
    if (strncmp(events[i].type, "job.", 4) == 0 && strcmp(events[i].type, "job.progress") != 0)
      atomic_store(&api->jobs_changed, true);
    if (strcmp(events[i].type, "job.finished") == 0)
      mo_waits_end(api->http, events[i].job, INT64_MIN);
    if (strcmp(events[i].type, "campaign.generation") == 0 ||
        strcmp(events[i].type, "job.finished") == 0)
      mo_waits_end(api->http, MO_WAIT_BATCH(events[i].job), INT64_MIN);
    mo_streams_send(api->http, events[i].sequence, events[i].job, write_frame, &events[i]);
  }
}

int mo_events_follow(struct mo_api *api)
{
  return mo_store_subscribe(api->store, listener, api, &api->listener);
}

void mo_events_leave(struct mo_api *api)
{
  if (api->listener >= 0)
    mo_store_unsubscribe(api->store, api->listener);
  api->listener = -1;
}

/* ---- streams ---- */

/* A callback of type mo_stream_fill. */
static int64_t fill(struct mo_request *request, struct mo_stream_place *place,
                    struct mo_text *frames)
{
  struct mo_event *page = malloc(MO_STREAM_PAGE * sizeof(*page));
  struct mo_store *store = mo_api_of(request)->store;
  int64_t oldest = 0, newest = 0, known = place->after;
  int64_t n = page != NULL ? mo_store_events(store, place->after, place->topic, page,
                                             MO_STREAM_PAGE, &oldest, &newest)
                           : MO_ERR_NO_MEMORY;
  if (n >= 0 && !place->greeted && place->after >= oldest) {
    const int error = mo_store_event_before(store, place->after, &known);
    n = error != MO_OK ? error : n;
  }
  if (n == MO_ERR_CORRUPT)
    mo_request_note(request, "the events cannot be read: %s", mo_error_text((int)n));
  if (n >= 0 && (place->after < oldest - 1 || known != place->after)) {
    /* The sequence number is unknown (pruned, or from a different history), so the client must
     * start over. */
    place->after = place->after < oldest - 1 ? oldest - 1 : known;
    mo_text_format(frames,
                   "id: %lld\nevent: reset\ndata: {\"oldest\":\"%lld\",\"newest\":\"%lld\"}\n\n",
                   (long long)place->after, (long long)oldest, (long long)newest);
  }
  for (int64_t i = 0; i < n; i++)
    write_frame(frames, &page[i]);
  if (n > 0)
    place->after = page[n - 1].sequence;
  place->greeted = true;
  free(page);
  return n;
}

static void open_stream(struct mo_request *request, int64_t after, int64_t job)
{
  static const char *const stream_type[] = {"text/event-stream", NULL};
  struct mo_stream_place place = {.after = after, .topic = job};
  if (mo_accept_choose(request->framing.accept, stream_type, 1) != 0) {
    mo_reply_problem(request, 406, NULL,
                     "This path returns text/event-stream, which the Accept field does not allow; "
                     "format=json returns a page.");
    return;
  }
  if (request->method == MO_HEAD) {
    mo_reply_static(request, 200, "text/event-stream", "", 0);
    return;
  }
  int error = MO_OK;
  if (after < 0) {
    /* Start with the next event. Events that arrive before the stream is open are read from the
     * store. */
    int64_t n =
        mo_store_events(mo_api_of(request)->store, INT64_MAX - 1, 0, NULL, 0, NULL, &place.after);
    error = n < 0 ? (int)n : MO_OK;
    place.greeted = true;
  }
  if (error == MO_OK)
    error = mo_stream_open(request, place, fill);
  if (error == MO_ERR_LIMIT) {
    mo_reply_problem(request, 503, NULL,
                     "All event streams of the service are in use; try again later.");
    request->reply.retry_after_s = 5;
  } else if (error != MO_OK) {
    mo_reply_error(request, error == MO_ERR_BUSY ? MO_ERR_CANCELLED : error, "stream");
  }
}

/* ---- pages ---- */

/* Replies with the page of events after `after`. */
static void reply_page(struct mo_request *request, int64_t after, int64_t job, size_t limit)
{
  struct mo_event *events = malloc(limit * sizeof(*events));
  int64_t oldest = 0, newest = 0;
  if (after < 0)
    after = 0;
  int64_t known = after;
  int64_t n = events != NULL ? mo_store_events(mo_api_of(request)->store, after, job, events, limit,
                                               &oldest, &newest)
                             : MO_ERR_NO_MEMORY;
  if (n >= 0 && after >= oldest) {
    const int error = mo_store_event_before(mo_api_of(request)->store, after, &known);
    n = error != MO_OK ? error : n;
  }
  struct mo_text text = {0};
  mo_text_add(&text, "{\"items\":[");
  for (int64_t i = 0; i < n; i++) {
    mo_text_object(&text);
    write_event(&text, &events[i]);
  }
  mo_text_add(&text, "]");
  mo_text_member_id(
      &text, "next_cursor",
      n > 0 && (size_t)n == limit && events[n - 1].sequence < newest ? events[n - 1].sequence : -1);
  mo_text_member_id(&text, "newest", newest);
  mo_text_member_bool(&text, "reset", (after > 0 && after < oldest - 1) || known != after);
  mo_text_add(&text, "}");
  free(events);
  if (n >= 0)
    mo_reply_json(request, 200, &text);
  else
    mo_reply_text(request, (int)n, &text, "page");
}

/* Checks that the job exists or once existed: events outlive a deleted job. Returns false if it has
 * replied. */
static bool has_job(struct mo_request *request, int64_t id)
{
  struct mo_store *store = mo_api_of(request)->store;
  struct mo_job job;
  struct mo_event event;
  int64_t n = mo_store_job(store, id, &job);
  if (n == MO_ERR_NOT_FOUND)
    n = mo_store_events(store, 0, id, &event, 1, NULL, NULL) == 0 ? MO_ERR_NOT_FOUND : MO_OK;
  if (n < 0)
    mo_reply_job_error(request, (int)n, "job", id);
  return n >= 0;
}

void mo_api_get_events(struct mo_request *request)
{
  static const char *const json[] = {"application/json", NULL};
  static const char *const formats[] = {"stream", "json", "csv", "ndjson", "columns", NULL};
  static const char place[] = "must be the id of an event, in decimal digits";
  const char *from = mo_query(request, "after");
  const char *last = request->framing.last_event_id;
  const char *cursor = mo_query(request, "cursor");
  int64_t after = -1, job = 0;
  size_t limit;
  int is_page = 0, form;
  if (!mo_query_word(request, "format", formats, &is_page))
    return;
  if (is_page > 1) {
    mo_table_reply(request, (enum mo_form)(is_page - 1), mo_api_get_events, "id type job at data",
                   NULL);
    return;
  }
  if (!mo_query_limit(request, &limit) ||
      !mo_query_id(request, "job", "must be the id of a job, in decimal digits", &job))
    return;
  if (job > 0 && !has_job(request, job))
    return;
  if (from != NULL && !mo_decimal(from, strlen(from), 0, INT64_MAX, &after))
    mo_reply_bad_parameter(request, "after", place);
  else if (last != NULL && last[0] != '\0' && !mo_decimal(last, strlen(last), 0, INT64_MAX, &after))
    mo_reply_bad_header(request, "Last-Event-ID", place);
  else if (cursor != NULL &&
           (!is_page || !mo_decimal(cursor, strlen(cursor), 0, INT64_MAX, &after)))
    mo_reply_bad_parameter(request, "cursor",
                           "must be the next_cursor of an earlier page with format=json");
  else if (!is_page)
    open_stream(request, after, job);
  else if (mo_accept(request, json, &form))
    reply_page(request, after, job, limit);
}
