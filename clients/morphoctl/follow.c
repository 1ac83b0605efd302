/* follow.c: see follow.h. */
#include "follow.h"

#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "table.h"
#include "transport.h"

/* ---- server-sent events: lines end with LF, CR or CRLF; several "data" lines of an event are
 * joined; a blank line ends the event; lines that begin with a colon are comments ---- */

static int append(char **text, size_t *length, const char *bytes, size_t n)
{
  if (*length + n + 1 > SSE_BYTES_MAX)
    return -1;
  char *grown = realloc(*text, *length + n + 1);
  if (grown == NULL)
    return -1;
  memcpy(grown + *length, bytes, n);
  *length += n;
  grown[*length] = 0;
  *text = grown;
  return 0;
}

static int take_line(struct sse *sse,
                     int (*event)(void *context, const char *type, const char *id,
                                  const char *data),
                     void *context)
{
  const char *line = sse->line != NULL ? sse->line : "";
  if (sse->line_bytes == 0) { /* the event is complete */
    int status = 0;
    if (*sse->id != 0)
      memcpy(sse->last_id, sse->id, sizeof(sse->id));
    if (sse->data_bytes > 0) {
      sse->data[sse->data_bytes - 1] = 0; /* without the last newline */
      status = event(context, *sse->type != 0 ? sse->type : "message", sse->id, sse->data);
    }
    sse->data_bytes = 0;
    *sse->type = *sse->id = 0;
    return status;
  }
  size_t name = strcspn(line, ":");
  const char *value = line + name;
  if (*value == ':')
    value++;
  if (*value == ' ')
    value++;
  if (name == 4 && strncmp(line, "data", 4) == 0) {
    if (append(&sse->data, &sse->data_bytes, value, strlen(value)) != 0 ||
        append(&sse->data, &sse->data_bytes, "\n", 1) != 0)
      return -1;
  } else if (name == 5 && strncmp(line, "event", 5) == 0) {
    snprintf(sse->type, sizeof(sse->type), "%s", value);
  } else if (name == 2 && strncmp(line, "id", 2) == 0) {
    snprintf(sse->id, sizeof(sse->id), "%s", value);
  }
  return 0;
}

int sse_feed(struct sse *sse, const char *bytes, size_t n,
             int (*event)(void *context, const char *type, const char *id, const char *data),
             void *context)
{
  int status = 0;
  for (size_t i = 0; i < n && status == 0;) {
    if (sse->skip_newline && bytes[i] == '\n') {
      sse->skip_newline = false;
      i++;
      continue;
    }
    sse->skip_newline = false;
    size_t length = 0;
    while (i + length < n && bytes[i + length] != '\n' && bytes[i + length] != '\r')
      length++;
    if (append(&sse->line, &sse->line_bytes, bytes + i, length) != 0)
      return -1;
    i += length;
    if (i < n) {
      sse->skip_newline = bytes[i] == '\r';
      i++;
      status = take_line(sse, event, context);
      sse->line_bytes = 0;
      if (sse->line != NULL)
        *sse->line = 0;
    }
  }
  return status;
}

void sse_reset(struct sse *sse)
{
  sse->line_bytes = sse->data_bytes = 0;
  sse->skip_newline = false;
  *sse->type = *sse->id = 0;
}

void sse_free(struct sse *sse)
{
  free(sse->line);
  free(sse->data);
  *sse = (struct sse){0};
}

/* ---- the stream ---- */

static int take_event(void *context, const char *type, const char *id, const char *data)
{
  struct follow *follow = context;
  (void)id;
  return follow->event(follow->context, type, data);
}

static int feed(void *context, const char *bytes, size_t n)
{
  struct follow *follow = context;
  int end = sse_feed(&follow->sse, bytes, n, take_event, follow);
  return end == 0 && follow->alive != NULL ? follow->alive(follow->context) : end;
}

static int open_stream(struct follow *follow)
{
  char path[128];
  const char *last = *follow->sse.last_id != 0 ? follow->sse.last_id : NULL;
  int n = snprintf(path, sizeof(path), "/v1/events%s%s", follow->job != NULL ? "?job=" : "",
                   follow->job != NULL ? follow->job : "");
  if (last == NULL && follow->after >= 0)
    snprintf(path + n, sizeof(path) - (size_t)n, "%cafter=%" PRId64,
             follow->job != NULL ? '&' : '?', follow->after);
  sse_reset(&follow->sse);
  return transport_stream(follow->ctl, path, last, feed, follow);
}

int follow_events(struct follow *follow)
{
  struct ctl *ctl = follow->ctl;
  double pause = 0.2, broken_since = monotonic_s();
  int status = STATUS_OK;
  while (status == STATUS_OK) {
    char before[sizeof(follow->sse.last_id)];
    memcpy(before, follow->sse.last_id, sizeof(before));
    double begin = monotonic_s();
    status = open_stream(follow);
    if (status != STATUS_CONNECTION)
      break;
    /* The stream broke: continue after the last event, for as long as --retry allows without a sign
     * of life. */
    double limit = ctl->retry_s >= 0 ? ctl->retry_s : *follow->sse.last_id != 0 ? 60 : 5;
    if (strcmp(before, follow->sse.last_id) != 0 || monotonic_s() - begin > 10) {
      broken_since = monotonic_s();
      pause = 0.2;
    }
    if (monotonic_s() - broken_since > limit) {
      status = complain_about_server(ctl, "the event stream ended");
      break;
    }
    pause_s(pause);
    pause = pause * 2 > 5 ? 5 : pause * 2;
    status = interrupted() ? STATUS_INTERRUPTED : STATUS_OK;
    if (status == STATUS_OK)
      status = follow->broken(follow->context);
  }
  sse_free(&follow->sse);
  return status > STATUS_OK ? status : STATUS_OK;
}
