/* cmd_campaign_watch.c: campaign watch: shows a campaign while it runs.
 *
 * On a terminal it draws sparklines of the curves and a table of the newest generations, redrawn in
 * place; elsewhere it prints a line per generation. Each event about a generation makes it fetch
 * the generation, so the view always agrees with the API. */
#include <string.h>

#include "campaign.h"
#include "commands.h"
#include "follow.h"
#include "screen.h"
#include "table.h"
#include "transport.h"

#define ASK_S         5 /* without an event for this long, the state is fetched */
#define LINES_BESIDES 13

struct view {
  struct ctl *ctl;
  struct campaign campaign;
  struct screen screen;
  size_t told;   /* rows already printed, if not on a terminal */
  double told_s; /* when the state was last fetched */
  bool finished;
};

/* ---- the screen ---- */

struct lines {
  FILE *file;
  int columns;
};

static void put_line(void *context, const char *text)
{
  const struct lines *lines = context;
  screen_line(lines->file, lines->columns, "", text, "");
}

static void write_view(void *context, FILE *file, int columns, int rows)
{
  const struct view *view = context;
  const json_t *campaign = view->campaign.json, *progress = json_object_get(campaign, "progress");
  const char *bold = view->ctl->color ? "\033[1m" : "", *plain = view->ctl->color ? "\033[0m" : "";
  struct lines lines = {file, columns};
  char text[512], generation[96], now[256];
  const char *reason = text_of(campaign, "reason"), *label = text_of(campaign, "label");
  campaign_generation_text(json_is_integer(json_object_get(progress, "generation"))
                               ? number_of(progress, "generation")
                               : -1,
                           number_of(progress, "generations"), generation, sizeof(generation));
  snprintf(text, sizeof(text), "%s%s%.64s  %s  %s   campaign %s", text_of(campaign, "mode"),
           *label != 0 ? "  " : "", label, text_of(campaign, "state"), generation,
           view->campaign.id);
  screen_line(file, columns, bold, text, plain);
  campaign_draw(view->ctl, &view->campaign, columns,
                rows - LINES_BESIDES > 20 ? 20 : rows - LINES_BESIDES, put_line, &lines);
  campaign_progress_text(campaign, now, sizeof(now));
  screen_line(file, columns, "", now, "");
  snprintf(text, sizeof(text), "%s",
           *reason != 0                           ? reason
           : is_final(text_of(campaign, "state")) ? ""
                                                  : "Ctrl-C leaves; the campaign goes on.");
  screen_line(file, columns, "", text, "");
}

static void draw(struct view *view, bool now)
{
  screen_draw(&view->screen, now, write_view, view);
}

/* ---- state ---- */

static int load(struct view *view)
{
  int status = campaign_load(view->ctl, &view->campaign);
  if (status != STATUS_OK)
    return status;
  view->finished = is_final(text_of(view->campaign.json, "state"));
  view->told_s = monotonic_s();
  return STATUS_OK;
}

/* Prints a line for each generation up to `until` that was not printed yet. Only the time of the
 * last one is known: that of its event (nullable). */
static void tell(struct view *view, int64_t until, const json_t *at)
{
  char line[400], words[256], generation[96];
  const int64_t generations =
      number_of(json_object_get(view->campaign.json, "progress"), "generations");
  for (; view->told < view->campaign.n && view->campaign.rows[view->told].generation <= until;
       view->told++) {
    const struct campaign_row *row = &view->campaign.rows[view->told];
    campaign_generation_text(row->generation, generations, generation, sizeof(generation));
    campaign_row_text(row, words, sizeof(words));
    snprintf(line, sizeof(line), "%s  %s", generation, words);
    if (at != NULL && row->generation == until)
      screen_event(&view->screen, view->ctl, at, line);
    else
      screen_earlier(&view->screen, view->ctl, line);
  }
}

static int load_and_tell(struct view *view)
{
  int status = load(view);
  if (status == STATUS_OK)
    tell(view, INT64_MAX, NULL);
  return status;
}

/* Updates "progress" from an event. */
static void take_progress(struct view *view, const json_t *data)
{
  static const char *const keys[][2] = {
      {"generation", "under_way"}, {"done", "done"}, {"total", "total"}};
  json_t *progress = json_object_get(view->campaign.json, "progress");
  for (size_t i = 0; i < sizeof(keys) / sizeof(keys[0]); i++)
    if (json_object_get(data, keys[i][0]) != NULL)
      json_object_set(progress, keys[i][1], json_object_get(data, keys[i][0]));
  if (json_object_get(data, "phase") != NULL)
    json_object_set(view->campaign.json, "phase", json_object_get(data, "phase"));
}

static int show_event(void *context, const char *type, const char *data)
{
  struct view *view = context;
  char line[400], words[256];
  if (strcmp(type, "reset") == 0)
    return load_and_tell(view) != STATUS_OK || view->finished;
  json_t *event = json_loads(data, 0, NULL);
  const json_t *details = json_object_get(event, "data"), *at = json_object_get(event, "at");
  bool generation = strcmp(type, "campaign.generation") == 0;
  int status = STATUS_OK;
  if (strcmp(type, "campaign.progress") == 0) {
    take_progress(view, details);
  } else {
    status = load(view);
    if (status == STATUS_OK && generation) {
      tell(view, number_of(details, "generation"), at);
    } else if (status == STATUS_OK) {
      campaign_event_text(type, details, words, sizeof(words));
      if (strncmp(type, "job.", 4) == 0)
        snprintf(words, sizeof(words), "  %s", text_of(view->campaign.json, "state"));
      snprintf(line, sizeof(line), "%.64s%s", type, words);
      screen_event(&view->screen, view->ctl, at, line);
    }
  }
  json_decref(event);
  draw(view, view->finished);
  return status != STATUS_OK ||
         (view->finished && !generation); /* more generations may be reported before the end is */
}

static int look_again(void *context)
{
  struct view *view = context;
  char before[64], reason_before[320], line[400];
  snprintf(before, sizeof(before), "%s", text_of(view->campaign.json, "phase"));
  snprintf(reason_before, sizeof(reason_before), "%s", text_of(view->campaign.json, "reason"));
  int status = load(view);
  if (status != STATUS_OK)
    return status;
  const char *phase = text_of(view->campaign.json, "phase"),
             *reason = text_of(view->campaign.json, "reason");
  if (*reason != 0 && (strcmp(before, phase) != 0 || strcmp(reason_before, reason) != 0)) {
    snprintf(line, sizeof(line), "%s: %.300s", phase, reason);
    screen_event(&view->screen, view->ctl, NULL, line);
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

static int finish(const struct view *view)
{
  const json_t *campaign = view->campaign.json, *result = json_object_get(campaign, "result");
  const json_t *controller = json_object_get(result, "controller");
  if (!view->ctl->quiet && strcmp(text_of(campaign, "end"), "exhausted") == 0)
    print_plain_line(
        stdout,
        "The morphospace holds no further design that the campaign could find: it ended early.");
  if (json_is_object(controller) && !view->ctl->quiet)
    print_plain_line(stdout, "controller %s: sha256:%s", text_of(controller, "name"),
                     text_of(controller, "sha256"));
  return campaign_outcome(campaign);
}

int watch_campaign(struct ctl *ctl, const char *id)
{
  struct view view = {.ctl = ctl, .screen = screen_open(ctl)};
  int64_t newest = -1;
  snprintf(view.campaign.id, sizeof(view.campaign.id), "%s", id);
  catch_interrupts(); /* before the first output */
  int status = newest_event(ctl, &newest);
  if (status == STATUS_OK)
    status = load_and_tell(&view);
  if (status == STATUS_OK)
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
  if (status == STATUS_INTERRUPTED && !ctl->quiet)
    print_plain_line(stderr,
                     "The campaign goes on. To watch it again: morphoctl campaign watch %s; to set "
                     "it aside: morphoctl "
                     "campaign pause %s; to stop it: morphoctl campaign cancel %s",
                     id, id, id);
  else if (status == STATUS_OK && view.finished) {
    tell(&view, INT64_MAX, NULL);
    status = finish(&view);
  } else if (status == STATUS_OK)
    status = STATUS_ERROR; /* the error was already reported */
  campaign_free(&view.campaign);
  return status;
}

int run_campaign_watch(struct ctl *ctl)
{
  if (ctl->json)
    return run_watch(ctl); /* the API's events, one per line */
  return check_job_id(ctl->operands[0]) ? watch_campaign(ctl, ctl->operands[0]) : STATUS_USAGE;
}
