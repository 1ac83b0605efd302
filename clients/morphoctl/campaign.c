/* campaign.c: see campaign.h. */
#include "campaign.h"

#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "table.h"
#include "training.h"
#include "transport.h"

/* ---- rows ---- */

static double value_of(const json_t *object, const char *key)
{
  const json_t *value = json_object_get(object, key);
  return json_is_number(value) ? json_number_value(value) : (double)NAN;
}

static double survived(const json_t *row, const char *op)
{
  const json_t *counts = json_object_get(json_object_get(row, "operators"), op);
  double born = value_of(counts, "born");
  return born > 0 ? value_of(counts, "survived") / born : (double)NAN;
}

static struct campaign_row read_row(const json_t *json)
{
  const json_t *score = json_object_get(json, "score"),
               *quantiles = json_object_get(score, "quantiles");
  return (struct campaign_row){.generation = number_of(json, "generation"),
                               .mean = value_of(score, "mean"),
                               .median = value_of(quantiles, "p50"),
                               .best = value_of(quantiles, "p0"),
                               .diversity = value_of(json, "diversity"),
                               .mutants = survived(json, "mutation"),
                               .recombinants = survived(json, "crossover"),
                               .voxels = value_of(json_object_get(json, "voxels"), "mean"),
                               .seconds = value_of(json, "seconds")};
}

static bool add_row(void *context, const json_t *row)
{
  struct campaign *campaign = context;
  if (campaign->n == campaign->capacity) {
    size_t capacity = campaign->capacity * 2 + 128;
    struct campaign_row *grown = realloc(campaign->rows, capacity * sizeof(*grown));
    if (grown == NULL)
      return false;
    campaign->rows = grown;
    campaign->capacity = capacity;
  }
  campaign->rows[campaign->n++] = read_row(row);
  return true;
}

static int load_rows(struct ctl *ctl, struct campaign *campaign)
{
  char path[128];
  snprintf(path, sizeof(path), "/v1/campaigns/%s/generations?limit=1000", campaign->id);
  return walk_rows(ctl, path, campaign->n > 0 ? campaign->rows[campaign->n - 1].generation : -1,
                   add_row, campaign);
}

/* Updates the progress if the rows are newer: a generation may have been committed between the two
 * requests. */
static void keep_up(struct campaign *campaign)
{
  json_t *progress = json_object_get(campaign->json, "progress");
  const json_t *generation = json_object_get(progress, "generation");
  const int64_t newest = campaign->n > 0 ? campaign->rows[campaign->n - 1].generation : -1;
  if (newest >= 0 && (!json_is_integer(generation) || json_integer_value(generation) < newest))
    (void)json_object_set_new(progress, "generation", json_integer(newest));
}

int campaign_load(struct ctl *ctl, struct campaign *campaign)
{
  char path[64];
  json_t *json;
  snprintf(path, sizeof(path), "/v1/campaigns/%s", campaign->id);
  int status = transport_get_json(ctl, path, 0, &json);
  if (status != STATUS_OK)
    return status;
  json_decref(campaign->json);
  campaign->json = json;
  status = load_rows(ctl, campaign);
  keep_up(campaign);
  return status;
}

void campaign_free(struct campaign *campaign)
{
  json_decref(campaign->json);
  free(campaign->rows);
  *campaign = (struct campaign){.json = NULL};
}

/* ---- sparklines ---- */

/* Returns the mean of the finite values; NaN: none. */
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

static const char *number_text(double value, const char *format, char text[32])
{
  if (!isfinite(value))
    return "–";
  snprintf(text, 32, format,
           value); /* NOLINT(clang-diagnostic-format-nonliteral): literals of this file */
  return text;
}

void campaign_generation_text(int64_t generation, int64_t generations, char *text, size_t size)
{
  char a[32], b[32];
  if (generation < 0)
    snprintf(text, size, "before generation 0 of %s", count_text(generations, b));
  else
    snprintf(text, size, "generation %s of %s", count_text(generation, a),
             count_text(generations, b));
}

void campaign_progress_text(const json_t *campaign, char *text, size_t size)
{
  const json_t *progress = json_object_get(campaign, "progress");
  const char *phase = text_of(campaign, "phase");
  const json_t *pace = json_object_get(progress, "rollouts_per_s"),
               *left = json_object_get(progress, "seconds_left");
  char done[32], total[32], speed[32], time[32];
  *text = 0;
  if (*phase == 0 || strcmp(phase, "idle") == 0)
    return;
  const char *what = strcmp(phase, "scoring") == 0     ? " designs"
                     : strcmp(phase, "learning") == 0  ? " steps"
                     : strcmp(phase, "preparing") == 0 ? " bodies of the pretraining"
                                                       : "";
  int n = 0;
  if (json_is_integer(json_object_get(progress, "under_way")))
    n = snprintf(text, size, "generation %s: ", count_text(number_of(progress, "under_way"), done));
  n += snprintf(text + n, size - (size_t)n, "%s", phase);
  if (number_of(progress, "total") > 0 && *what != 0)
    n += snprintf(text + n, size - (size_t)n, " %s of %s%s",
                  count_text(number_of(progress, "done"), done),
                  count_text(number_of(progress, "total"), total), what);
  if (json_is_number(pace) && json_number_value(pace) > 0 && (size_t)n < size)
    n += snprintf(text + n, size - (size_t)n, "  %s rollouts/s",
                  number_text(json_number_value(pace), "%.0f", speed));
  if (json_is_number(left) && (size_t)n < size)
    snprintf(text + n, size - (size_t)n, "  %s %s", duration_text(json_number_value(left), time),
             strcmp(phase, "preparing") == 0 && number_of(progress, "generation") <= 0
                 ? "until they are drawn"
                 : "left");
}

void campaign_row_text(const struct campaign_row *row, char *text, size_t size)
{
  char mean[32], best[32], diversity[32], mutants[32], recombinants[32], voxels[32], seconds[32];
  snprintf(text, size,
           "mean %s  best %s  diversity %s  survived: mutants %s recombinants %s  voxels %s  %s s",
           number_text(row->mean, "%.4f", mean), number_text(row->best, "%.4f", best),
           number_text(row->diversity, "%.4f", diversity),
           number_text(100 * row->mutants, "%.0f %%", mutants),
           number_text(100 * row->recombinants, "%.0f %%", recombinants),
           number_text(row->voxels, "%.1f", voxels), number_text(row->seconds, "%.1f", seconds));
}

void campaign_event_text(const char *type, const json_t *data, char *text, size_t size)
{
  char generation[96], mean[32], best[32], diversity[32], a[32], b[32];
  *text = 0;
  if (strcmp(type, "campaign.generation") == 0) {
    campaign_generation_text(number_of(data, "generation"), number_of(data, "generations"),
                             generation, sizeof(generation));
    snprintf(text, size, "  %s  mean %s  best %s  diversity %s", generation,
             score_text(json_object_get(data, "mean"), mean),
             score_text(json_object_get(data, "best"), best),
             score_text(json_object_get(data, "diversity"), diversity));
  } else if (strcmp(type, "campaign.progress") == 0) {
    snprintf(text, size, "  generation %" PRId64 "  %s %s of %s", number_of(data, "generation"),
             text_of(data, "phase"), count_text(number_of(data, "done"), a),
             count_text(number_of(data, "total"), b));
  } else if (strcmp(type, "campaign.extended") == 0) {
    snprintf(text, size, "  to %s generations", count_text(number_of(data, "generations"), a));
  } else if (strcmp(type, "campaign.diversity_collapse") == 0) {
    snprintf(text, size, "  generation %" PRId64 ": diversity %s, it was %s",
             number_of(data, "generation"),
             score_text(json_object_get(data, "diversity"), diversity),
             score_text(json_object_get(data, "maximum"), a));
  } else if (strcmp(type, "campaign.lineage_unreadable") == 0) {
    snprintf(text, size, "  %.40s of controller %.12s: %.160s", text_of(data, "field"),
             text_of(data, "controller"), text_of(data, "detail"));
  }
}

/* ---- the view ---- */

struct curve {
  const char *name, *format;
  size_t offset; /* of the value in struct campaign_row */
  double scale;
};

static double row_value(const struct campaign_row *row, const struct curve *curve)
{
  double value;
  memcpy(&value, (const char *)row + curve->offset, sizeof(value));
  return curve->scale * value;
}

static void draw_curves(const struct ctl *ctl, const struct campaign *campaign, int columns,
                        void (*line)(void *context, const char *text), void *context)
{
  static const struct curve curves[] = {
      {"mean score", "%.4f", offsetof(struct campaign_row, mean), 1},
      {"best score", "%.4f", offsetof(struct campaign_row, best), 1},
      {"diversity", "%.4f", offsetof(struct campaign_row, diversity), 1},
      {"mutants live", "%.0f %%", offsetof(struct campaign_row, mutants), 100},
      {"crossed live", "%.0f %%", offsetof(struct campaign_row, recombinants), 100},
      {"voxels", "%.1f", offsetof(struct campaign_row, voxels), 1},
  };
  int width = columns - 26 > 200 ? 200 : columns - 26;
  double *values = malloc((campaign->n > 0 ? campaign->n : 1) * sizeof(*values));
  if (values == NULL || width < 4) {
    free(values);
    return;
  }
  for (size_t c = 0; c < sizeof(curves) / sizeof(curves[0]); c++) {
    char spark[3 * 200 + 1], text[700], number[32];
    for (size_t i = 0; i < campaign->n; i++)
      values[i] = row_value(&campaign->rows[i], &curves[c]);
    sparkline(values, campaign->n, width, ctl->utf8, spark);
    const char *newest = number_text(values[campaign->n - 1], curves[c].format, number);
    snprintf(text, sizeof(text), "%-13s %*s%s  %s", curves[c].name, (int)(9 - text_width(newest)),
             "", newest, spark);
    line(context, text);
  }
  free(values);
}

void campaign_draw(const struct ctl *ctl, const struct campaign *campaign, int columns,
                   int table_rows, void (*line)(void *context, const char *text), void *context)
{
  if (campaign->n == 0) {
    line(context, "no generation yet");
    return;
  }
  draw_curves(ctl, campaign, columns, line, context);
  if (table_rows <= 0)
    return;
  line(context, "");
  line(context,
       "generation      mean    median      best  diversity  mutants  crossed  voxels    seconds");
  size_t first = campaign->n > (size_t)table_rows ? campaign->n - (size_t)table_rows : 0;
  for (size_t i = first; i < campaign->n; i++) {
    const struct campaign_row *row = &campaign->rows[i];
    static const char *const formats[] = {"%.4f",    "%.4f",    "%.4f", "%.4f",
                                          "%.0f %%", "%.0f %%", "%.1f", "%.1f"};
    static const int widths[] = {10, 10, 10, 11, 9, 9, 8, 11};
    const double values[] = {row->mean,      row->median,        row->best,
                             row->diversity, 100 * row->mutants, 100 * row->recombinants,
                             row->voxels,    row->seconds};
    char text[256], number[32];
    int n = snprintf(text, sizeof(text), "%10" PRId64, row->generation);
    for (size_t k = 0; k < sizeof(values) / sizeof(values[0]); k++) {
      const char *cell = number_text(values[k], formats[k], number);
      n += snprintf(text + n, sizeof(text) - (size_t)n, "%*s%s", widths[k] - (int)text_width(cell),
                    "", cell);
    }
    line(context, text);
  }
}
