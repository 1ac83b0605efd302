/* cmd_train_watch.c: train watch: shows a training while it runs.
 *
 * On a terminal it draws a plot of the loss and the numbers of the newest step, redrawn in place
 * with each event; elsewhere it prints a line per event. To miss nothing at the start, it fetches
 * the sequence of the newest event, then the training, then the events after that sequence. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "follow.h"
#include "screen.h"
#include "table.h"
#include "training.h"
#include "transport.h"

#define ASK_S         10 /* without an event, the state is fetched: waiting makes no events */
#define LINES_BESIDES 6  /* lines of the view besides the plot */

struct view {
  struct ctl *ctl;
  struct training training;
  json_t *progress, *validation; /* the newest values */
  struct screen screen;
  double told_s; /* time of the last event, or when the state was last fetched */
  bool finished;
};

/* ---- the screen ---- */

static void write_view(void *context, FILE *file, int columns, int rows)
{
  const struct view *view = context;
  const json_t *training = view->training.json;
  const char *bold = view->ctl->color ? "\033[1m" : "", *plain = view->ctl->color ? "\033[0m" : "";
  char text[512], more[256];
  const char *phase = text_of(training, "phase"), *reason = text_of(training, "reason");
  snprintf(text, sizeof(text), "%s  %s  %s%s%s%s   training %s", text_of(training, "name"),
           text_of(training, "kind"), text_of(training, "state"),
           strcmp(phase, "idle") != 0 ? " (" : "", strcmp(phase, "idle") != 0 ? phase : "",
           strcmp(phase, "idle") != 0 ? ")" : "", view->training.id);
  screen_line(file, columns, bold, text, plain);
  int height = rows - LINES_BESIDES > 20 ? 20 : rows - LINES_BESIDES;
  char *plot = training_plot(view->ctl, &view->training, columns > 110 ? 110 : columns - 1, height);
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
           view->ctl->utf8 ? PLOT_MARK_UTF8 : PLOT_MARK_ASCII, more);
  screen_line(file, columns, "", text, "");
  if (*reason != 0)
    snprintf(text, sizeof(text), "%s", reason);
  else
    snprintf(text, sizeof(text), "%s",
             is_final(text_of(training, "state")) ? "" : "Ctrl-C leaves; the training goes on.");
  screen_line(file, columns, "", text, "");
}

static void draw(struct view *view, bool now)
{
  screen_draw(&view->screen, now, write_view, view);
}

static void print_event_line(const struct view *view, const json_t *at, const char *words)
{
  screen_event(&view->screen, view->ctl, at, words);
}

/* ---- state ---- */

static int load(struct view *view)
{
  int status = training_load(view->ctl, &view->training);
  if (status != STATUS_OK)
    return status;
  json_decref(view->progress);
  json_decref(view->validation);
  view->progress = json_incref(json_object_get(view->training.json, "progress"));
  view->validation = json_incref(json_object_get(view->training.json, "validation"));
  view->finished = is_final(text_of(view->training.json, "state"));
  view->told_s = monotonic_s();
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
  print_event_line(view, at, line);
}

static void take_validation(struct view *view, const json_t *at, const json_t *data)
{
  char text[160], line[200];
  merge(&view->validation, data);
  training_add(&view->training.validations, (double)number_of(data, "step"),
               value_of(data, "mean_score"));
  training_validation_text(view->validation, text, sizeof(text));
  snprintf(line, sizeof(line), "validation %s", text);
  print_event_line(view, at, line);
}

/* Handles a change of state: fetches what else changed. */
static int take_change(struct view *view, const json_t *at, const char *type)
{
  char line[160];
  int status = load(view);
  snprintf(line, sizeof(line), "%.64s  %s", type, text_of(view->training.json, "state"));
  print_event_line(view, at, line);
  return status;
}

static int show_event(void *context, const char *type, const char *data)
{
  struct view *view = context;
  if (strcmp(type, "reset") == 0)
    return load(view) != STATUS_OK || view->finished;
  json_t *event = json_loads(data, 0, NULL);
  const json_t *details = json_object_get(event, "data"), *at = json_object_get(event, "at");
  view->told_s = monotonic_s();
  bool progress = strcmp(type, "training.progress") == 0;
  int status = STATUS_OK;
  if (progress)
    take_progress(view, at, details);
  else if (strcmp(type, "training.validation") == 0)
    take_validation(view, at, details);
  else if (strcmp(type, "training.checkpoint") == 0) {
    char line[64];
    json_object_set(view->training.json, "checkpoint_step", json_object_get(details, "step"));
    snprintf(line, sizeof(line), "checkpoint of step %lld", (long long)number_of(details, "step"));
    print_event_line(view, at, line);
  } else if (strncmp(type, "job.", 4) == 0)
    status = take_change(view, at, type);
  json_decref(event);
  draw(view, !progress || view->finished);
  return status != STATUS_OK || view->finished;
}

/* Fetches the state, and reports a new phase or reason. */
static int look_again(void *context)
{
  struct view *view = context;
  char before[64], line[400];
  snprintf(before, sizeof(before), "%s", text_of(view->training.json, "phase"));
  int status = load(view);
  if (status != STATUS_OK)
    return status;
  const char *phase = text_of(view->training.json, "phase"),
             *reason = text_of(view->training.json, "reason");
  if (strcmp(before, phase) != 0 && strcmp(phase, "idle") != 0) {
    snprintf(line, sizeof(line), "%s%s%.300s", phase, *reason != 0 ? ": " : "", reason);
    print_event_line(view, NULL, line);
  }
  draw(view, true);
  return STATUS_OK;
}

static int notice(void *context)
{
  struct view *view = context;
  int status = STATUS_OK;
  if (monotonic_s() - view->told_s > ASK_S)
    status = look_again(view);
  return status != STATUS_OK || view->finished;
}

static bool is_finished(void *context)
{
  const struct view *view = context;
  return view->finished;
}

static void say_how_to_return(const struct ctl *ctl, const char *id)
{
  if (!ctl->quiet)
    print_plain_line(stderr,
                     "The training goes on. To watch it again: morphoctl train watch %s; to set it "
                     "aside: morphoctl "
                     "train pause %s; to stop it: morphoctl train cancel %s",
                     id, id, id);
}

static int finish(const struct view *view)
{
  const json_t *training = view->training.json,
               *controller = json_object_get(training, "controller");
  if (json_is_object(controller) && !view->ctl->quiet)
    print_plain_line(stdout, "controller %s: sha256:%s", text_of(controller, "name"),
                     text_of(controller, "sha256"));
  return training_outcome(training);
}

int watch_training(struct ctl *ctl, const char *id)
{
  struct view view = {.ctl = ctl, .screen = screen_open(ctl)};
  int64_t newest = -1;
  snprintf(view.training.id, sizeof(view.training.id), "%s", id);
  catch_interrupts(); /* before the first output */
  int status = newest_event(ctl, &newest);
  if (status == STATUS_OK)
    status = load(&view);
  if (status == STATUS_OK && !view.screen.live && !ctl->quiet) {
    char step[96];
    training_step_text(number_of(view.progress, "step"), number_of(view.progress, "steps"), step,
                       sizeof(step));
    print_plain_line(stdout, "training %s (%s %s) is %s, %s", id,
                     text_of(view.training.json, "kind"), text_of(view.training.json, "name"),
                     text_of(view.training.json, "state"), step);
    fflush(stdout);
  }
  draw(&view, true);
  struct follow follow = {.ctl = ctl,
                          .job = id,
                          .after = newest,
                          .event = show_event,
                          .alive = notice,
                          .broken = look_again,
                          .ended = is_finished,
                          .context = &view};
  if (status == STATUS_OK && !view.finished)
    status = follow_events(&follow);
  if (status == STATUS_INTERRUPTED)
    say_how_to_return(ctl, id);
  else if (status == STATUS_OK && view.finished)
    status = finish(&view);
  else if (status == STATUS_OK)
    status = STATUS_ERROR; /* the error was already reported */
  json_decref(view.progress);
  json_decref(view.validation);
  training_free(&view.training);
  return status;
}

int run_train_watch(struct ctl *ctl)
{
  if (ctl->json)
    return run_watch(ctl); /* the API's events, one per line */
  return check_job_id(ctl->operands[0]) ? watch_training(ctl, ctl->operands[0]) : STATUS_USAGE;
}
