/* follow.c: see follow.h. */
#include "follow.h"

#include <inttypes.h>
#include <string.h>

#include "table.h"
#include "transport.h"

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
    if (status == STATUS_OK && follow->broken != NULL)
      status = follow->broken(follow->context);
    if (follow->ended != NULL && follow->ended(follow->context))
      break;
  }
  sse_free(&follow->sse);
  return status;
}
