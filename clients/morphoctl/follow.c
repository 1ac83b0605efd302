/* follow.c: see follow.h. */
#include "follow.h"

#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "table.h"
#include "transport.h"

/* ---- server-sent events, as morphod writes them: an event is a few lines, "name: value", and a
 * blank one; lines that begin with a colon are heartbeats ---- */

/* Parses the lines of one event, which it modifies. */
static int take_event(struct sse *sse, char *text,
                      int (*event)(void *context, const char *type, const char *data),
                      void *context)
{
  const char *type = "message", *data = NULL;
  for (char *line; (line = strsep(&text, "\n")) != NULL;)
    if (strncmp(line, "event: ", 7) == 0)
      type = line + 7;
    else if (strncmp(line, "data: ", 6) == 0)
      data = line + 6;
    else if (strncmp(line, "id: ", 4) == 0)
      snprintf(sse->last_id, sizeof(sse->last_id), "%s", line + 4);
  return data != NULL ? event(context, type, data) : 0;
}

int sse_feed(struct sse *sse, const char *bytes, size_t n,
             int (*event)(void *context, const char *type, const char *data), void *context)
{
  char *grown = sse->n_bytes + n <= SSE_BYTES_MAX ? realloc(sse->text, sse->n_bytes + n + 1) : NULL;
  if (grown == NULL)
    return -1;
  memcpy(grown + sse->n_bytes, bytes, n);
  sse->text = grown;
  sse->n_bytes += n;
  int status = 0;
  char *begin = grown, *end;
  while (status == 0 &&
         (end = memmem(begin, sse->n_bytes - (size_t)(begin - grown), "\n\n", 2)) != NULL) {
    *end = 0;
    status = take_event(sse, begin, event, context);
    begin = end + 2;
  }
  sse->n_bytes -= (size_t)(begin - grown);
  memmove(grown, begin, sse->n_bytes);
  return status;
}

void sse_free(struct sse *sse)
{
  free(sse->text);
  *sse = (struct sse){0};
}

/* ---- the stream ---- */

static int feed(void *context, const char *bytes, size_t n)
{
  struct follow *follow = context;
  const int end = sse_feed(&follow->sse, bytes, n, follow->event, follow->context);
  if (end < 0)
    fail(STATUS_ERROR, "the server sends an event of more than %d bytes", SSE_BYTES_MAX);
  return end == 0 && follow->alive != NULL ? follow->alive(follow->context) : end;
}

static bool open_stream(struct follow *follow)
{
  const char *last = *follow->sse.last_id != 0 ? follow->sse.last_id : NULL;
  const char *path = follow->job != NULL ? path_to("/v1/events?job=%s", follow->job) : "/v1/events";
  if (last == NULL && follow->after >= 0)
    path = path_to("%s%cafter=%" PRId64, path, follow->job != NULL ? '&' : '?', follow->after);
  follow->sse.n_bytes = 0; /* of an incomplete event */
  return transport_stream(follow->ctl, path, last, feed, follow);
}

void follow_events(struct follow *follow)
{
  struct ctl *ctl = follow->ctl;
  double pause = 0.2, broken_since = monotonic_s();
  for (;;) {
    char before[sizeof(follow->sse.last_id)];
    memcpy(before, follow->sse.last_id, sizeof(before));
    double begin = monotonic_s();
    if (open_stream(follow))
      break;
    /* The stream broke: continue after the last event, for as long as --retry allows without an
     * event or heartbeat. */
    double limit = ctl->retry_s >= 0 ? ctl->retry_s : *follow->sse.last_id != 0 ? 60 : 5;
    if (strcmp(before, follow->sse.last_id) != 0 || monotonic_s() - begin > 10) {
      broken_since = monotonic_s();
      pause = 0.2;
    }
    if (monotonic_s() - broken_since > limit)
      leave(complain_about_server(ctl, "the event stream ended"));
    pause_s(pause);
    pause = pause * 2 > 5 ? 5 : pause * 2;
    if (interrupted())
      leave(STATUS_INTERRUPTED);
    if (follow->broken(follow->context))
      break;
  }
  sse_free(&follow->sse);
}
