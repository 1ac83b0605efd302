/* cmd_watch.c: watch. Follows the event stream, connects again where it broke, ends with the job that is watched. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "sse.h"
#include "table.h"
#include "transport.h"

struct watch {
  struct ctl *ctl;
  struct sse sse;
  const char *job; /* NULL: everything */
  struct progress progress;
  bool finished, failed, reset;
};

static int show_event(void *context, const char *type, const char *id, const char *data)
{
  struct watch *watch = context;
  struct ctl *ctl = watch->ctl;
  if (strcmp(type, "reset") == 0) {
    watch->reset = true;
    progress_end(&watch->progress);
    if (!ctl->quiet)
      complain(0, "some events are no longer kept");
    return 0;
  }
  json_t *event = json_loads(data, 0, NULL);
  if (event == NULL)
    return 0;
  const json_t *details = json_object_get(event, "data");
  const char *job = text_of(event, "job"), *state = text_of(details, "state");
  int64_t done = number_of(details, "rollouts_done"), total = number_of(details, "rollouts_total");
  bool progress = strcmp(type, "job.progress") == 0;
  if (ctl->json) {
    json_dumpf(event, stdout, JSON_COMPACT | JSON_REAL_PRECISION(17));
    putchar('\n');
  } else if (progress && watch->job != NULL && ctl->progress) {
    progress_show(&watch->progress, ctl, "running", done, total);
  } else {
    char time[32], counts[80] = "", a[32], b[32];
    progress_end(&watch->progress);
    if (total > 0)
      snprintf(counts, sizeof(counts), "  %s of %s rollouts", count_text(done, a), count_text(total, b));
    if (*job != 0)
      print_plain_line(stdout, "%s  %-15s job %s%s%s%s", time_text(json_object_get(event, "at"), time), type, job,
                       *state != 0 ? "  " : "", state, counts);
    else
      print_plain_line(stdout, "%s  %-15s %s", time_text(json_object_get(event, "at"), time), type,
                       text_of(details, "name"));
  }
  fflush(stdout);
  if (watch->job != NULL && strcmp(type, "job.finished") == 0) {
    watch->finished = true;
    watch->failed = strcmp(state, "succeeded") != 0;
  }
  json_decref(event);
  (void)id;
  return watch->finished;
}

static int feed(void *context, const char *bytes, size_t n)
{
  struct watch *watch = context;
  return sse_feed(&watch->sse, bytes, n, show_event, watch);
}

/* Whether the watched job has ended, by asking for it. */
static int ask(struct watch *watch)
{
  char path[64];
  json_t *job;
  snprintf(path, sizeof(path), "/v1/jobs/%s", watch->job);
  int status = transport_get_json(watch->ctl, path, 0, &job);
  if (status == STATUS_OK && is_final(text_of(job, "state"))) {
    watch->finished = true;
    watch->failed = strcmp(text_of(job, "state"), "succeeded") != 0;
  }
  json_decref(job);
  return status;
}

int run_watch(struct ctl *ctl)
{
  struct watch watch = {.ctl = ctl, .job = ctl->n_operands > 0 ? ctl->operands[0] : NULL};
  int64_t after = watch.job != NULL ? 0 : -1;
  if (!option_number(ctl, "after", 0, INT64_MAX, &after))
    return STATUS_USAGE;
  if (watch.job != NULL && !check_job_id(watch.job))
    return STATUS_USAGE;
  int status = watch.job != NULL ? ask(&watch) : STATUS_OK; /* there must be such a job */
  bool was_over = watch.finished;
  watch.finished = false;
  catch_interrupts();
  double pause = 0.2, broken_since = monotonic_s();
  while (status == STATUS_OK && !watch.finished) {
    char path[128], header[64] = "";
    int n = snprintf(path, sizeof(path), "/v1/events%s%s", watch.job != NULL ? "?job=" : "",
                     watch.job != NULL ? watch.job : "");
    if (*watch.sse.last_id != 0)
      snprintf(header, sizeof(header), "Last-Event-ID: %s", watch.sse.last_id);
    else if (after >= 0)
      snprintf(path + n, sizeof(path) - (size_t)n, "%cafter=%" PRId64, watch.job != NULL ? '&' : '?', after);
    char before[32];
    memcpy(before, watch.sse.last_id, sizeof(before));
    double begin = monotonic_s();
    sse_reset(&watch.sse);
    status = transport_stream(ctl, path, *header != 0 ? header : NULL, feed, &watch);
    if (status != STATUS_CONNECTION || watch.finished)
      break;
    /* Broken: go on where it was, for as long as --retry allows without a sign of life. */
    double limit = ctl->retry_s >= 0 ? ctl->retry_s : *watch.sse.last_id != 0 ? 60 : 5;
    if (strcmp(before, watch.sse.last_id) != 0 || monotonic_s() - begin > 10) {
      broken_since = monotonic_s();
      pause = 0.2;
    }
    if (monotonic_s() - broken_since > limit) {
      status = complain(STATUS_CONNECTION, "%s: the event stream ended", ctl->server);
      break;
    }
    pause_s(pause);
    pause = pause * 2 > 5 ? 5 : pause * 2;
    status = interrupted() ? STATUS_INTERRUPTED : STATUS_OK;
    if (status == STATUS_OK && watch.job != NULL && watch.reset)
      status = ask(&watch);
  }
  if (status == STATUS_OK && watch.job != NULL && !watch.finished && was_over)
    watch.finished = true;
  progress_end(&watch.progress);
  sse_free(&watch.sse);
  if (status == STATUS_OK && watch.failed)
    status = STATUS_NEGATIVE;
  return status;
}
