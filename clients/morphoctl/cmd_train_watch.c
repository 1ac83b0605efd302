/* cmd_train_watch.c: train watch: shows a training while it runs.
 *
 * On a terminal it draws a plot of the loss and the numbers of the newest step; elsewhere it prints
 * a line per event. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "live.h"
#include "table.h"
#include "training.h"

#define ASK_S         10 /* waiting makes no events */
#define LINES_BESIDES 6  /* lines of the view besides the plot */

struct view {
  struct live live;
  struct training training;
  json_t *progress, *validation; /* the newest values */
};

/* ---- the screen ---- */

static void write_view(void *context, FILE *file, int columns, int rows)
{
  const struct view *view = context;
  const json_t *training = view->training.json;
  const char *bold = view->live.ctl->color ? "\033[1m" : "",
             *plain = view->live.ctl->color ? "\033[0m" : "";
  char text[512], more[256];
  const char *phase = text_of(training, "phase"), *reason = text_of(training, "reason");
  snprintf(text, sizeof(text), "%s  %s  %s%s%s%s   training %s", text_of(training, "name"),
           text_of(training, "kind"), text_of(training, "state"),
           strcmp(phase, "idle") != 0 ? " (" : "", strcmp(phase, "idle") != 0 ? phase : "",
           strcmp(phase, "idle") != 0 ? ")" : "", view->training.id);
  screen_line(file, columns, bold, text, plain);
  int height = rows - LINES_BESIDES > 20 ? 20 : rows - LINES_BESIDES;
  char *plot =
      training_plot(view->live.ctl, &view->training, columns > 110 ? 110 : columns - 1, height);
  if (plot != NULL && height >= 4)
    screen_lines(file, plot);
  free(plot);
  training_numbers_text(
      view->progress, text,
      sizeof(text)); /* the pace is beside the step: both do not fit into 80 columns */
  screen_line(file, columns, "", text, "");
  int64_t replayed = number_of(view->progress, "replayed"),
          total = number_of(view->progress, "replay_total");
  training_step_text(number_of(view->progress, "step"), number_of(view->progress, "steps"), more,
                     sizeof(more));
  int n = snprintf(text, sizeof(text), "%s", more);
  training_pace_text(view->progress, more, sizeof(more));
  if (strcmp(phase, "replaying") == 0 && total > 0)
    snprintf(text + n, sizeof(text) - (size_t)n,
             ", drawing the bodies of earlier steps again: %d %%", (int)(100 * replayed / total));
  else if (json_is_integer(json_object_get(training, "checkpoint_step")))
    snprintf(text + n, sizeof(text) - (size_t)n, "%s  checkpoint of step %lld", more,
             (long long)number_of(training, "checkpoint_step"));
  else
    snprintf(text + n, sizeof(text) - (size_t)n, "%s", more);
  screen_line(file, columns, "", text, "");
  training_validation_text(view->validation, more, sizeof(more));
  snprintf(text, sizeof(text), "%s validation %s",
           view->live.ctl->utf8 ? PLOT_MARK_UTF8 : PLOT_MARK_ASCII, more);
  screen_line(file, columns, "", text, "");
  if (*reason != 0)
    snprintf(text, sizeof(text), "%s", reason);
  else
    snprintf(text, sizeof(text), "%s",
             is_final(text_of(training, "state")) ? "" : "Ctrl-C leaves; the training goes on.");
  screen_line(file, columns, "", text, "");
}

/* ---- state ---- */

static int load(struct live *live)
{
  struct view *view = (struct view *)live;
  int status = training_load(live->ctl, &view->training);
  if (status != STATUS_OK)
    return status;
  json_decref(view->progress);
  json_decref(view->validation);
  live->job = view->training.json;
  view->progress = json_incref(json_object_get(live->job, "progress"));
  view->validation = json_incref(json_object_get(live->job, "validation"));
  return STATUS_OK;
}

static double value_of(const json_t *object, const char *key)
{
  const json_t *value = json_object_get(object, key);
  return json_is_number(value) ? json_number_value(value) : (double)NAN;
}

/* Updates known values from an event: events have only the numbers that changed. */
static void merge(json_t **known, const json_t *data)
{
  json_t *merged = json_is_object(*known) ? json_copy(*known) : json_object();
  if (merged == NULL)
    return;
  json_object_update(merged, (json_t *)data);
  json_decref(*known);
  *known = merged;
}

/* ---- events ---- */

static void take_progress(struct view *view, const json_t *at, const json_t *data)
{
  char step[96], numbers[256], line[400];
  merge(&view->progress, data);
  training_add(&view->training.losses, (double)number_of(data, "step"),
               value_of(data, "mean_loss"));
  if (json_is_string(json_object_get(view->training.json, "phase")))
    json_object_set_new(view->training.json, "phase", json_string("learning"));
  training_step_text(number_of(data, "step"), number_of(view->progress, "steps"), step,
                     sizeof(step));
  training_progress_text(view->progress, numbers, sizeof(numbers));
  snprintf(line, sizeof(line), "%s  %s", step, numbers);
  live_line(&view->live, at, line);
}

static void take_validation(struct view *view, const json_t *at, const json_t *data)
{
  char text[160], line[200];
  merge(&view->validation, data);
  training_add(&view->training.validations, (double)number_of(data, "step"),
               value_of(data, "mean_score"));
  training_validation_text(view->validation, text, sizeof(text));
  snprintf(line, sizeof(line), "validation %s", text);
  live_line(&view->live, at, line);
}

/* Handles a change of state: fetches what else changed. */
static int take_change(struct view *view, const json_t *at, const char *type)
{
  char line[160];
  int status = live_load(&view->live);
  snprintf(line, sizeof(line), "%.64s  %s", type, text_of(view->training.json, "state"));
  live_line(&view->live, at, line);
  return status;
}

static int take_event(struct live *live, const char *type, const json_t *at, const json_t *data,
                      bool *draw)
{
  struct view *view = (struct view *)live;
  live->told_s = monotonic_s();
  *draw = strcmp(type, "training.progress") != 0;
  if (!*draw)
    take_progress(view, at, data);
  else if (strcmp(type, "training.validation") == 0)
    take_validation(view, at, data);
  else if (strcmp(type, "training.checkpoint") == 0) {
    char line[64];
    json_object_set(live->job, "checkpoint_step", json_object_get(data, "step"));
    snprintf(line, sizeof(line), "checkpoint of step %lld", (long long)number_of(data, "step"));
    live_line(live, at, line);
  } else if (strncmp(type, "job.", 4) == 0)
    return take_change(view, at, type);
  return STATUS_OK;
}

static void report_phase(const struct live *live, const char *before, const char *reason_before)
{
  char line[400];
  const char *phase = text_of(live->job, "phase"), *reason = text_of(live->job, "reason");
  (void)reason_before;
  if (strcmp(before, phase) != 0 && strcmp(phase, "idle") != 0) {
    snprintf(line, sizeof(line), "%s%s%.300s", phase, *reason != 0 ? ": " : "", reason);
    live_line(live, NULL, line);
  }
}

static void begin(struct live *live)
{
  const struct view *view = (const struct view *)live;
  char step[96];
  if (live->screen.live || live->ctl->quiet)
    return;
  training_step_text(number_of(view->progress, "step"), number_of(view->progress, "steps"), step,
                     sizeof(step));
  print_plain_line(stdout, "training %s (%s %s) is %s, %s", live->id, text_of(live->job, "kind"),
                   text_of(live->job, "name"), text_of(live->job, "state"), step);
  fflush(stdout);
}

static int finish(struct live *live)
{
  live_print_controller(live, json_object_get(live->job, "controller"));
  return job_outcome("training", live->job);
}

int watch_training(struct ctl *ctl, const char *id)
{
  static const struct live_kind kind = {"training", "train",    ASK_S,        load,  write_view,
                                        begin,      take_event, report_phase, finish};
  struct view view = {.live = {.kind = &kind, .ctl = ctl, .id = id}};
  snprintf(view.training.id, sizeof(view.training.id), "%s", id);
  int status = live_watch(&view.live);
  json_decref(view.progress);
  json_decref(view.validation);
  training_free(&view.training);
  return status;
}

int run_train_watch(struct ctl *ctl)
{
  return watch_operand(ctl, watch_training);
}
