/* cmd_watch.c: watch: follows the event stream, reconnects when it breaks, and ends when the
 * watched job ends. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "campaign.h"
#include "commands.h"
#include "follow.h"
#include "table.h"
#include "training.h"
#include "transport.h"

struct watch {
  struct ctl *ctl;
  const char *job; /* NULL: all jobs */
  struct progress progress;
  bool finished, failed, reset;
};

static int show_event(void *context, const char *type, const char *data)
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
    put_json(event, JSON_COMPACT);
  } else if (progress && watch->job != NULL && ctl->progress) {
    progress_show(&watch->progress, ctl, "running", done, total);
  } else {
    char time[32], words[320] = "", a[32], b[32];
    progress_end(&watch->progress);
    if (total > 0)
      snprintf(words, sizeof(words), "  %s of %s rollouts", count_text(done, a),
               count_text(total, b));
    else if (strncmp(type, "campaign.", 9) == 0)
      campaign_event_text(type, details, words, sizeof(words));
    else
      training_event_text(type, details, words, sizeof(words));
    if (*job != 0)
      print_plain_line(stdout, "%s  %-15s job %s%s%s%s",
                       time_text(json_object_get(event, "at"), time), type, job,
                       *state != 0 ? "  " : "", state, words);
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
  return watch->finished;
}

/* Fetches the watched job to see whether it has ended. */
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

/* Checks after a break for the end of the job: its event may no longer be kept. */
static int look_again(void *context)
{
  struct watch *watch = context;
  return watch->job != NULL && watch->reset ? ask(watch) : STATUS_OK;
}

static bool is_finished(void *context)
{
  const struct watch *watch = context;
  return watch->finished;
}

int run_watch(struct ctl *ctl)
{
  struct watch watch = {.ctl = ctl, .job = ctl->n_operands > 0 ? ctl->operands[0] : NULL};
  int64_t after = watch.job != NULL ? 0 : -1;
  if (!option_number(ctl, "after", 0, INT64_MAX, &after))
    return STATUS_USAGE;
  if (watch.job != NULL && !check_job_id(watch.job))
    return STATUS_USAGE;
  int status = watch.job != NULL ? ask(&watch) : STATUS_OK; /* checks that the job exists */
  watch.finished = false; /* show the events of an ended job, too */
  struct follow follow = {.ctl = ctl,
                          .job = watch.job,
                          .after = after,
                          .event = show_event,
                          .broken = look_again,
                          .ended = is_finished,
                          .context = &watch};
  catch_interrupts();
  if (status == STATUS_OK)
    status = follow_events(&follow);
  progress_end(&watch.progress);
  if (status == STATUS_OK && watch.failed)
    status = STATUS_NEGATIVE;
  return status;
}

int watch_started(struct ctl *ctl, const char *id, int (*watch)(struct ctl *ctl, const char *id))
{
  ctl->operands[0] = id;
  ctl->n_operands = 1;
  return watch_operand(ctl, watch);
}

int watch_operand(struct ctl *ctl, int (*watch)(struct ctl *ctl, const char *id))
{
  if (ctl->json)
    return run_watch(ctl);
  return check_job_id(ctl->operands[0]) ? watch(ctl, ctl->operands[0]) : STATUS_USAGE;
}
