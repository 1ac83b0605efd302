/* handle_events.c: events as a page, and the start of a stream (see stream.c for the rest). */
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "http/field.h"
#include "http/server.h"

static void reply_page(struct mo_request *request, int64_t after, int64_t job, size_t limit)
{
  struct mo_event *events = malloc(limit * sizeof(*events));
  int64_t oldest = 0, newest = 0;
  if (after < 0)
    after = 0;
  int64_t n = events != NULL ? mo_store_events(request->http->services.store, after, job, events,
                                               limit, &oldest, &newest)
                             : MO_ERR_NO_MEMORY;
  if (n < 0) {
    mo_reply_error(request, (int)n, "page");
    free(events);
    return;
  }
  struct mo_text text = {0};
  const char *comma = "";
  mo_text_add(&text, "{\"items\":[");
  for (int64_t i = 0; i < n; i++) {
    mo_text_add(&text, comma);
    comma = ",";
    mo_event_write(&text, &events[i]);
  }
  /* A short page has reached the newest event, so skip what the filter left out. */
  int64_t next = (size_t)n == limit ? events[n - 1].sequence : newest > after ? newest : after;
  if (after > newest || next > newest) /* never beyond the newest event */
    next = newest;
  bool reset = (after > 0 && after < oldest - 1) || after > newest;
  mo_text_format(&text, "],\"next_after\":\"%lld\",\"reset\":%s}", (long long)next,
                 reset ? "true" : "false");
  free(events);
  mo_reply_json(request, 200, &text);
}

enum mo_handled mo_handle_events(struct mo_request *request)
{
  static const char *const names[] = {"format", "after", "job", "limit"};
  static const char *const stream_type[] = {"text/event-stream"};
  struct mo_query_value values[4];
  int64_t after = -1, job = 0;
  size_t limit;
  if (!mo_query_read(request, names, values, 4) || !mo_query_limit(request, &values[3], &limit))
    return MO_HANDLED;
  bool page = strcmp(values[0].text, "json") == 0;
  if (values[0].present && !page && strcmp(values[0].text, "stream") != 0) {
    mo_reply_bad_parameter(request, "format", "stream or json is expected");
    return MO_HANDLED;
  }
  if (values[1].present &&
      !mo_decimal(values[1].text, strlen(values[1].text), 0, INT64_MAX, &after)) {
    mo_reply_bad_parameter(request, "after", "the id of an event, in decimal digits, is expected");
    return MO_HANDLED;
  }
  if (values[2].present && !mo_id(values[2].text, &job)) {
    mo_reply_bad_parameter(request, "job", "the id of a job, in decimal digits, is expected");
    return MO_HANDLED;
  }
  const char *last = request->framing.last_event_id;
  if (last != NULL && last[0] != '\0' && !mo_decimal(last, strlen(last), 0, INT64_MAX, &after)) {
    struct mo_faults *faults = calloc(1, sizeof(*faults));
    if (faults != NULL)
      mo_faults_add(faults, MO_FAULT_HEADER, "Last-Event-ID",
                    "the id of an event, in decimal digits, is expected");
    mo_reply_problem(request, 400, faults, NULL);
    free(faults);
    return MO_HANDLED;
  }
  if (page) {
    if (mo_accepts_json(request))
      reply_page(request, after, job, limit);
    return MO_HANDLED;
  }
  if (mo_accept_choose(request->framing.accept, stream_type, 1) != 0) {
    mo_reply_problem(request, 406, NULL,
                     "This path gives text/event-stream, which the Accept field does not allow; "
                     "format=json gives a page.");
    return MO_HANDLED;
  }
  if (request->method == MO_HEAD) {
    mo_reply_static(request, 200, "text/event-stream", "", 0);
    return MO_HANDLED;
  }
  int code = mo_stream_open(request, after, job);
  if (code == MO_OK) {
    /* Streams have their own limit, so they take none of their client's places. */
    mo_client_leave(&request->http->clients, request->client, mo_clock_us());
    request->client = NULL;
    return MO_STREAMED;
  }
  if (code == MO_ERR_LIMIT) {
    mo_reply_problem(request, 503, NULL,
                     "All event streams of the service are in use; try again later.");
    request->reply.retry_after_s = 5;
  } else {
    mo_reply_error(request, code == MO_ERR_BUSY ? MO_ERR_CANCELLED : code, "stream");
  }
  return MO_HANDLED;
}
