/* cmd_campaign_watch.c: campaign watch: shows a campaign while it runs.
 *
 * On a terminal it draws sparklines of the curves and a table of the newest generations; elsewhere
 * it prints a line per generation. Each event about a generation makes it fetch the generation, so
 * the view always agrees with the API. */
#include <string.h>

#include "campaign.h"
#include "commands.h"
#include "live.h"

#define ASK_S         5
#define LINES_BESIDES 13

struct view {
  struct live live;
  struct campaign campaign;
  size_t told; /* rows already printed, if not on a terminal */
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
  const char *bold = view->live.ctl->color ? "\033[1m" : "",
             *plain = view->live.ctl->color ? "\033[0m" : "";
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
  campaign_draw(view->live.ctl, &view->campaign, columns,
                rows - LINES_BESIDES > 20 ? 20 : rows - LINES_BESIDES, put_line, &lines);
  campaign_progress_text(campaign, now, sizeof(now));
  screen_line(file, columns, "", now, "");
  snprintf(text, sizeof(text), "%s",
           *reason != 0                           ? reason
           : is_final(text_of(campaign, "state")) ? ""
                                                  : "Ctrl-C leaves; the campaign goes on.");
  screen_line(file, columns, "", text, "");
}

/* ---- state ---- */

static int load(struct live *live)
{
  struct view *view = (struct view *)live;
  int status = campaign_load(live->ctl, &view->campaign);
  live->job = view->campaign.json;
  return status;
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
      screen_event(&view->live.screen, view->live.ctl, at, line);
    else
      screen_earlier(&view->live.screen, view->live.ctl, line);
  }
}

static void begin(struct live *live)
{
  tell((struct view *)live, INT64_MAX, NULL);
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

static int take_event(struct live *live, const char *type, const json_t *at, const json_t *data,
                      bool *draw)
{
  struct view *view = (struct view *)live;
  char line[400], words[256];
  (void)draw;
  if (strcmp(type, "reset") == 0) {
    begin(live);
    return STATUS_OK;
  }
  if (strcmp(type, "campaign.progress") == 0) {
    take_progress(view, data);
    return STATUS_OK;
  }
  int status = live_load(live);
  if (status != STATUS_OK)
    return status;
  if (strcmp(type, "campaign.generation") == 0) {
    tell(view, number_of(data, "generation"), at);
    return -1; /* more generations may be reported before the end is */
  }
  campaign_event_text(type, data, words, sizeof(words));
  if (strncmp(type, "job.", 4) == 0)
    snprintf(words, sizeof(words), "  %s", text_of(live->job, "state"));
  snprintf(line, sizeof(line), "%.64s%s", type, words);
  live_line(live, at, line);
  return STATUS_OK;
}

static void report_reason(const struct live *live, const char *phase_before,
                          const char *reason_before)
{
  char line[400];
  const char *phase = text_of(live->job, "phase"), *reason = text_of(live->job, "reason");
  if (*reason != 0 && (strcmp(phase_before, phase) != 0 || strcmp(reason_before, reason) != 0)) {
    snprintf(line, sizeof(line), "%s: %.300s", phase, reason);
    live_line(live, NULL, line);
  }
}

static int finish(struct live *live)
{
  begin(live);
  if (!live->ctl->quiet && strcmp(text_of(live->job, "end"), "exhausted") == 0)
    print_plain_line(
        stdout,
        "The morphospace holds no further design that the campaign could find: it ended early.");
  live_print_controller(live, json_object_get(json_object_get(live->job, "result"), "controller"));
  return job_outcome("campaign", live->job);
}

int watch_campaign(struct ctl *ctl, const char *id)
{
  static const struct live_kind kind = {"campaign", "campaign", ASK_S,         load,  write_view,
                                        begin,      take_event, report_reason, finish};
  struct view view = {.live = {.kind = &kind, .ctl = ctl, .id = id}};
  snprintf(view.campaign.id, sizeof(view.campaign.id), "%s", id);
  int status = live_watch(&view.live);
  campaign_free(&view.campaign);
  return status;
}

int run_campaign_watch(struct ctl *ctl)
{
  return watch_operand(ctl, watch_campaign);
}
