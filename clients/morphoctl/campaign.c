/* campaign.c: campaign show and watch: a campaign with its curves.
 *
 * On a terminal, campaign watch draws sparklines of the curves and a table of the newest
 * generations; elsewhere it prints a line per generation. After each event about a generation it
 * fetches the generation, so the view always agrees with the API. */
#include "campaign.h"

#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "results.h"

#define ASK_S         5
#define LINES_BESIDES 13

/* ---- generations ---- */

/* The numbers shown for a generation. */
static const struct measure {
  const char *place;      /* name in a row of the API; the counts for fractions that survived */
  const char *name;       /* index of its curve; NULL if it has no curve */
  const char *head, *tag; /* headings in the table and in a line */
  int width, digits;
  const char *unit; /* " %" for a fraction */
} measures[CAMPAIGN_VALUES] = {
    {"score.mean", "mean score", "mean", "mean", 10, 4, ""},
    {"score.quantiles.p50", NULL, "median", NULL, 10, 4, ""},
    {"score.quantiles.p0", "best score", "best", "  best", 10, 4, ""},
    {"diversity", "diversity", "diversity", "  diversity", 11, 4, ""},
    {"operators.mutation", "mutants live", "mutants", "  survived: mutants", 9, 0, " %"},
    {"operators.crossover", "crossed live", "crossed", " recombinants", 9, 0, " %"},
    {"voxels.mean", "voxels", "voxels", "  voxels", 8, 1, ""},
    {"seconds", NULL, "seconds", " ", 11, 1, ""},
};

static void add_row(void *context, json_t *json)
{
  struct campaign *campaign = context;
  if (campaign->n == campaign->capacity) {
    campaign->capacity = campaign->capacity * 2 + 128;
    campaign->rows = need(realloc(campaign->rows, campaign->capacity * sizeof(*campaign->rows)));
  }
  struct campaign_row *row = &campaign->rows[campaign->n++];
  row->generation = number_of(json, "generation");
  for (size_t k = 0; k < CAMPAIGN_VALUES; k++) {
    const json_t *counts = value_at(json, measures[k].place);
    const double born = real_at(counts, "born");
    row->values[k] = *measures[k].unit == 0 ? real_at(json, measures[k].place)
                     : born > 0             ? 100 * real_at(counts, "survived") / born
                                            : (double)NAN;
  }
}

static int64_t newest_generation(const struct campaign *campaign)
{
  return campaign->n > 0 ? campaign->rows[campaign->n - 1].generation : -1;
}

static void load(struct live *live)
{
  struct campaign *campaign = (struct campaign *)live;
  walk_items(live->ctl, path_to("/v1/campaigns/%s/generations", live->id),
             newest_generation(campaign), 0, add_row, campaign);
  /* A generation may have been committed between the two requests. */
  json_t *progress = json_object_get(live->job, "progress");
  const double known = real_at(progress, "generation");
  if (campaign->n > 0 && !((double)newest_generation(campaign) <= known))
    json_object_set_new(progress, "generation", json_integer(newest_generation(campaign)));
}

/* ---- sparklines ---- */

/* Returns the mean of the finite values, or NaN. */
static double group_mean(const double *values, size_t n)
{
  double sum = 0;
  size_t finite = 0;
  for (size_t i = 0; i < n; i++)
    if (isfinite(values[i])) {
      sum += values[i];
      finite++;
    }
  return finite > 0 ? sum / (double)finite : (double)NAN;
}

void sparkline(const double *values, size_t n, int width, bool utf8, char *text)
{
  static const char *const blocks[] = {"▁", "▂", "▃", "▄", "▅", "▆", "▇", "█"};
  size_t cells = n < (size_t)width ? n : (size_t)width;
  double least = HUGE_VAL, most = -HUGE_VAL;
  for (size_t c = 0; c < cells; c++) {
    size_t begin = c * n / cells, end = (c + 1) * n / cells;
    double value = group_mean(values + begin, end - begin);
    least = value < least ? value : least;
    most = value > most ? value : most;
  }
  for (size_t c = 0; c < cells; c++) {
    size_t begin = c * n / cells, end = (c + 1) * n / cells;
    double value = group_mean(values + begin, end - begin);
    double height = most > least ? (value - least) / (most - least) : 0.5;
    if (!isfinite(value))
      *text++ = ' ';
    else if (utf8) {
      const char *block = blocks[(int)(height * 7.999)];
      memcpy(text, block, 3);
      text += 3;
    } else
      *text++ = (char)('0' + (int)(height * 9.999));
  }
  *text = 0;
}

/* ---- texts ---- */

static const char *value_text(double value, const struct measure *kind, char text[32])
{
  if (!isfinite(value))
    return "–";
  snprintf(text, 32, "%.*f%s", kind->digits, value, kind->unit);
  return text;
}

void campaign_row_text(const struct campaign_row *row, char *text, size_t size)
{
  int n = 0;
  for (size_t k = 0; k < CAMPAIGN_VALUES; k++) {
    char number[32];
    if (measures[k].tag != NULL)
      n += snprintf(text + n, size - (size_t)n, "%s %s", measures[k].tag,
                    value_text(row->values[k], &measures[k], number));
  }
  snprintf(text + n, size - (size_t)n, " s");
}

static void draw_curves(const struct campaign *campaign, int columns, FILE *file)
{
  int width = columns - 26 > 200 ? 200 : columns - 26;
  if (width < 4)
    return;
  double *curve = need(malloc(campaign->n * sizeof(*curve)));
  for (size_t k = 0; k < CAMPAIGN_VALUES; k++) {
    char spark[3 * 200 + 1], number[32];
    if (measures[k].name == NULL)
      continue;
    for (size_t i = 0; i < campaign->n; i++)
      curve[i] = campaign->rows[i].values[k];
    sparkline(curve, campaign->n, width, campaign->live.ctl->utf8, spark);
    const char *newest = value_text(curve[campaign->n - 1], &measures[k], number);
    fprintf(file, "%-13s %*s%s  %s\n", measures[k].name, (int)(9 - text_width(newest)), "", newest,
            spark);
  }
  free(curve);
}

/* Draws a row of the table of generations; with row NULL, the headings. */
static void draw_row(const struct campaign_row *row, FILE *file)
{
  if (row != NULL)
    fprintf(file, "%10" PRId64, row->generation);
  else
    fputs("generation", file);
  for (size_t k = 0; k < CAMPAIGN_VALUES; k++) {
    char number[32];
    const char *cell =
        row != NULL ? value_text(row->values[k], &measures[k], number) : measures[k].head;
    fprintf(file, "%*s%s", measures[k].width - (int)text_width(cell), "", cell);
  }
  fputc('\n', file);
}

char *campaign_draw(const struct campaign *campaign, int columns, int table_rows)
{
  char *text = NULL;
  size_t size = 0, rows = table_rows > 0 ? (size_t)table_rows : 0;
  FILE *file = need(open_memstream(&text, &size));
  if (campaign->n == 0)
    fputs("no generations yet\n", file);
  else
    draw_curves(campaign, columns, file);
  if (campaign->n > 0 && rows > 0) {
    fputc('\n', file);
    draw_row(NULL, file);
    for (size_t i = campaign->n > rows ? campaign->n - rows : 0; i < campaign->n; i++)
      draw_row(&campaign->rows[i], file);
  }
  close_text(file);
  return text;
}

/* ---- show ---- */

static void print(struct live *live)
{
  static const struct fact facts[] = {
      {"campaign", "{id} ({mode}[, {preset}])"},
      JOB_STATE_FACTS(""),
      {"controller",
       CONTROLLER_WORDS("controller", "|random weights, sensor {settings.learning.sensor}")},
      {"population", "{settings.population:,} design{settings.population:s}, seed {settings.seed}"},
      {"replicate", "[{group.replicates>1:-}{group.number} of {group.replicates} of campaign "
                    "{group.id}]"},
      {"mutation", "{settings.mutation.share:.1%} of the population, rate "
                   "{settings.mutation.rate:.4g}, growth {settings.mutation.growth:.4g}"},
      {"selection", "{settings.selection.kind}[{settings.racing=off}, racing off]"},
      {"own score", "[{study.own_score.name}[ in {study.own_score.unit}], from the study's "
                    "client, not computed by the service]"},
      {"selects by", "[{settings.select_by.measure}, {settings.select_by.direction}]"},
      {"aggregate",
       "[{settings.aggregate.kind!=mean}[, level {settings.aggregate.level:g}|, weight "
       "{settings.aggregate.weight:g}]: how losses become a score]"},
      {"re-evaluates", "[the best {settings.re_evaluate.designs} and the champions every "
                       "{settings.re_evaluate.every} generations in "
                       "{settings.re_evaluate.environments} fresh worlds]"},
      {"held out", "[{newest.held_out.mean:.4f}, 95 % interval {newest.held_out.low:.4f} to "
                   "{newest.held_out.high:.4f}: the mean of the design with the best score, "
                   "{newest.score.quantiles.p0:.4f}, in fresh worlds]"},
      {"measures", "[{measured}]"},
      {"learning", "[{settings.learning.parent_steps} + {settings.learning.child_steps} steps a "
                   "generation, {settings.learning.schedule.kind} from "
                   "{settings.learning.schedule.peak:.4g} down to "
                   "{settings.learning.schedule.floor:.4g}"
                   "[{settings.learning.worlds=environments}, in the campaign's environments]"
                   "[{settings.learning.worlds=tasks}, with the tasks of its environments]]"},
      {"varies", VARY_WORDS("settings.learning.vary.")},
      {"progress",
       GENERATION_WORDS("progress.") ", {progress.designs:,} design{progress.designs:s} born"},
      {"now", CAMPAIGN_NOW_WORDS},
      {"end", "{end}"},
      {"result", CONTROLLER_WORDS("result.controller", "")},
      JOB_TIME_FACTS,
      {NULL, NULL}};
  const struct campaign *campaign = (const struct campaign *)live;
  json_t *group = json_object_get(live->job, "group");
  json_object_set_new(group, "number", json_integer(number_of(group, "replicate") + 1));
  json_object_set_new(live->job, "measured",
                      json_string(words_of(value_at(live->job, "settings.measures"))));
  print_facts(live->ctl, live->job, facts);
  if (campaign->n == 0)
    return;
  char *text = campaign_draw(campaign, 92, 10);
  printf("\n%s", text);
  free(text);
}

/* ---- watch ---- */

static void write_view(const struct live *live, FILE *file, int columns, int rows)
{
  const bool color = live->ctl->color, ended = is_final(text_of(live->job, "state"));
  fputs(color ? "\033[1m" : "", file);
  view_words(file, columns, live->job,
             "{mode}[  {label:.64}]  {state}  " GENERATION_WORDS("progress.") "   campaign {id}");
  fputs(color ? "\033[0m" : "", file);
  char *text = campaign_draw((const struct campaign *)live, columns,
                             rows - LINES_BESIDES > 20 ? 20 : rows - LINES_BESIDES);
  view_lines(file, columns, text);
  free(text);
  view_words(file, columns, live->job, CAMPAIGN_NOW_WORDS);
  view_words(file, columns, live->job,
             ended ? "{reason}" : "[{reason}|Ctrl-C leaves; the campaign continues.]");
}

/* Prints a line for each generation up to `until` that has not been printed yet. at: time of the
 * last one, from its event (nullable); the times of the others are unknown. */
static void print_generations(struct campaign *campaign, int64_t until, const json_t *at)
{
  char line[400], words[256], count[32];
  const json_t *progress = json_object_get(campaign->live.job, "progress");
  const char *generations = count_text(number_of(progress, "generations"), count);
  for (; campaign->printed < campaign->n && campaign->rows[campaign->printed].generation <= until;
       campaign->printed++) {
    const struct campaign_row *row = &campaign->rows[campaign->printed];
    char generation[32];
    campaign_row_text(row, words, sizeof(words));
    snprintf(line, sizeof(line), "generation %s of %s  %s", count_text(row->generation, generation),
             generations, words);
    live_line(&campaign->live, row->generation == until && at != NULL ? at : json_null(), line);
  }
}

static void begin(struct live *live)
{
  print_generations((struct campaign *)live, INT64_MAX, NULL);
}

static void take_progress(json_t *job, json_t *data)
{
  static const char *const keys[][2] = {
      {"generation", "under_way"}, {"done", "done"}, {"total", "total"}};
  json_t *progress = json_object_get(job, "progress");
  for (size_t i = 0; i < sizeof(keys) / sizeof(keys[0]); i++)
    if (json_object_get(data, keys[i][0]) != NULL)
      json_object_set(progress, keys[i][1], json_object_get(data, keys[i][0]));
  if (json_object_get(data, "phase") != NULL)
    json_object_set(job, "phase", json_object_get(data, "phase"));
}

static bool take_event(struct live *live, const char *type, json_t *event, bool *draw)
{
  const json_t *at = json_object_get(event, "at");
  json_t *data = json_object_get(event, "data");
  (void)draw;
  if (strcmp(type, "reset") == 0) {
    begin(live);
    return true;
  }
  if (strcmp(type, "campaign.progress") == 0) {
    take_progress(live->job, data);
    return true;
  }
  live_load(live);
  if (strcmp(type, "campaign.generation") == 0) {
    print_generations((struct campaign *)live, number_of(data, "generation"), at);
    return false; /* more generations may be reported before the end is reached */
  }
  json_object_set(event, "state", json_object_get(live->job, "state"));
  char line[512] = "{type:.64}";
  snprintf(line + strlen(line), sizeof(line) - strlen(line), "%s",
           strncmp(type, "job.", 4) == 0 ? "  {state}" : event_words(type));
  live_words(live, at, event, line);
  return true;
}

static void report_reason(const struct live *live, const char *phase_before,
                          const char *reason_before)
{
  const char *reason = text_of(live->job, "reason");
  const json_t *progress = json_object_get(live->job, "progress");
  if (strcmp(text_of(live->job, "phase"), "preparing") == 0 && number_of(progress, "total") > 0)
    live_words(live, NULL, live->job, CAMPAIGN_NOW_WORDS); /* it takes longer than a generation */
  if (*reason != 0 && (strcmp(phase_before, text_of(live->job, "phase")) != 0 ||
                       strcmp(reason_before, reason) != 0))
    live_words(live, NULL, live->job, "{phase}: {reason:.300}");
}

static void finish(struct live *live)
{
  begin(live);
  if (!live->ctl->quiet && value_at(live->job, "result.controller.sha256") != NULL)
    print_from(stdout, live->job,
               "controller {result.controller.name}: sha256:{result.controller.sha256}");
  expect_success("campaign", live->job);
}

const struct live_kind campaign_kind = {
    .size = sizeof(struct campaign),
    .noun = "campaign",
    .command = "campaign",
    .accepted =
        "campaign {id} accepted: {mode}, {settings.population:,} design{settings.population:s}, "
        "{settings.generations:,} generation{settings.generations:s}"
        "[{group.replicates>1:-}, with its replicates]",
    .ask_s = ASK_S,
    .load = load,
    .print = print,
    .write = write_view,
    .begin = begin,
    .event = take_event,
    .changed = report_reason,
    .finish = finish};
