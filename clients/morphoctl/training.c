/* training.c: see training.h. */
#include "training.h"

#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "table.h"
#include "transport.h"

/* ---- curves ---- */

/* Drops every other point, but keeps the newest. */
static void thin(struct training_curve *curve)
{
  size_t kept = 0;
  for (size_t i = (curve->n + 1) % 2; i < curve->n; i += 2)
    curve->points[kept++] = curve->points[i];
  curve->n = kept;
}

bool training_add(struct training_curve *curve, double x, double y)
{
  while (curve->n > 0 && curve->points[curve->n - 1].x >= x)
    curve->n--;
  if (curve->n >= TRAINING_POINTS_MAX)
    thin(curve);
  if (curve->n == curve->capacity) {
    size_t capacity = curve->capacity * 2 + 256;
    struct plot_point *grown = realloc(curve->points, capacity * sizeof(*grown));
    if (grown == NULL)
      return false;
    curve->points = grown;
    curve->capacity = capacity;
  }
  curve->points[curve->n++] = (struct plot_point){x, y};
  return true;
}

struct loading {
  struct training_curve *curve;
  const char *key; /* the value to draw */
};

static bool add_row(void *context, const json_t *row)
{
  const struct loading *loading = context;
  const json_t *value = json_object_get(row, loading->key);
  return training_add(loading->curve, (double)number_of(row, "step"),
                      json_is_number(value) ? json_number_value(value) : (double)NAN);
}

/* Fetches the rows after the last point. stride 0: the path has no stride. */
static int load_curve(struct ctl *ctl, const char *id, const char *what, const char *key,
                      int64_t stride, struct training_curve *curve)
{
  struct loading loading = {curve, key};
  char path[160];
  int n = snprintf(path, sizeof(path), "/v1/trainings/%s/%s?limit=1000", id, what);
  if (stride > 0)
    snprintf(path + n, sizeof(path) - (size_t)n, "&stride=%" PRId64, stride);
  return walk_rows(ctl, path, curve->n > 0 ? (int64_t)curve->points[curve->n - 1].x : -1, add_row,
                   &loading);
}

int training_load(struct ctl *ctl, struct training *training)
{
  char path[64];
  json_t *json;
  snprintf(path, sizeof(path), "/v1/trainings/%s", training->id);
  int status = transport_get_json(ctl, path, 0, &json);
  if (status != STATUS_OK)
    return status;
  json_decref(training->json);
  training->json = json;
  int64_t step = number_of(json_object_get(json, "progress"), "step");
  int64_t stride = step / (TRAINING_POINTS_MAX / 2) + 1;
  status = load_curve(ctl, training->id, "steps", "mean_loss", stride, &training->losses);
  if (status == STATUS_OK)
    status = load_curve(ctl, training->id, "validations", "mean_score", 0, &training->validations);
  return status;
}

void training_free(struct training *training)
{
  json_decref(training->json);
  free(training->losses.points);
  free(training->validations.points);
  *training = (struct training){.json = NULL};
}

char *training_plot(const struct ctl *ctl, const struct training *training, int width, int height)
{
  const struct training_curve *losses = &training->losses, *validations = &training->validations;
  if (losses->n + validations->n == 0)
    return NULL;
  double end = losses->n > 0 ? losses->points[losses->n - 1].x : 0;
  if (validations->n > 0 && validations->points[validations->n - 1].x > end)
    end = validations->points[validations->n - 1].x;
  struct plot plot = {.curve = losses->points,
                      .n_curve = losses->n,
                      .marks = validations->points,
                      .n_marks = validations->n,
                      .x_end = end,
                      .width = width,
                      .height = height,
                      .utf8 = ctl->utf8,
                      .color = ctl->color};
  return plot_draw(&plot);
}

/* ---- texts ---- */

const char *duration_text(double seconds, char text[32])
{
  if (!(seconds >= 0) || seconds > 1e9)
    return "–";
  long whole = lround(seconds);
  if (whole >= 2 * 86400)
    snprintf(text, 32, "%ld d %02ld:%02ld", whole / 86400, whole / 3600 % 24, whole / 60 % 60);
  else
    snprintf(text, 32, "%ld:%02ld:%02ld", whole / 3600, whole / 60 % 60, whole % 60);
  return text;
}

const char *real_text(const json_t *number, char text[32])
{
  if (!json_is_number(number))
    return "–";
  snprintf(text, 32, "%.4g", json_number_value(number));
  return text;
}

const char *share_text(const json_t *share, char text[32])
{
  if (!json_is_number(share))
    return "–";
  snprintf(text, 32, "%.1f %%", 100 * json_number_value(share));
  return text;
}

void training_step_text(int64_t step, int64_t steps, char *text, size_t size)
{
  char a[32], b[32];
  snprintf(text, size, "step %s of %s", count_text(step, a), count_text(steps, b));
}

void training_numbers_text(const json_t *progress, char *text, size_t size)
{
  char loss[32], gradient[32], rate[32], clipped[32];
  snprintf(text, size, "loss %s  gradient %s  rate %s  clipped %s",
           score_text(json_object_get(progress, "mean_loss"), loss),
           real_text(json_object_get(progress, "gradient_norm"), gradient),
           real_text(json_object_get(progress, "rate"), rate),
           share_text(json_object_get(progress, "clipped_share"), clipped));
}

void training_pace_text(const json_t *progress, char *text, size_t size)
{
  char speed[32], left[32];
  const json_t *bodies = json_object_get(progress, "bodies_per_s"),
               *seconds = json_object_get(progress, "seconds_left");
  int n = 0;
  *text = 0;
  if (json_is_number(bodies))
    n = snprintf(text, size, "  %s bodies/s", real_text(bodies, speed));
  if (json_is_number(seconds) && n >= 0 && (size_t)n < size)
    snprintf(text + n, size - (size_t)n, "  %s left",
             duration_text(json_number_value(seconds), left));
}

void training_progress_text(const json_t *progress, char *text, size_t size)
{
  char pace[80];
  training_numbers_text(progress, text, size);
  training_pace_text(progress, pace, sizeof(pace));
  size_t n = strlen(text);
  snprintf(text + n, size - n, "%s", pace);
}

void training_validation_text(const json_t *validation, char *text, size_t size)
{
  char score[32], error[32], step[32], diverged[64] = "";
  if (!json_is_object(validation)) {
    snprintf(text, size, "–");
    return;
  }
  if (number_of(validation, "diverged") > 0)
    snprintf(diverged, sizeof(diverged), ", %" PRId64 " of %" PRId64 " rollouts diverged",
             number_of(validation, "diverged"), number_of(validation, "rollouts"));
  snprintf(text, size, "%s ± %s at step %s%s",
           score_text(json_object_get(validation, "mean_score"), score),
           score_text(json_object_get(validation, "standard_error"), error),
           count_text(number_of(validation, "step"), step), diverged);
}

void training_event_text(const char *type, const json_t *data, char *text, size_t size)
{
  char step[96], words[256];
  *text = 0;
  if (strcmp(type, "training.progress") == 0) {
    training_step_text(number_of(data, "step"), number_of(data, "steps"), step, sizeof(step));
    training_progress_text(data, words, sizeof(words));
    snprintf(text, size, "  %s  %s", step, words);
  } else if (strcmp(type, "training.validation") == 0) {
    training_validation_text(data, words, sizeof(words));
    snprintf(text, size, "  %s", words);
  } else if (strcmp(type, "training.checkpoint") == 0) {
    snprintf(text, size, "  of step %s", count_text(number_of(data, "step"), step));
  } else if (strcmp(type, "training.code_changed") == 0) {
    const char *before = text_of(data, "before");
    snprintf(text, size, "  after step %s: %s, before %s",
             count_text(number_of(data, "from_step"), step), text_of(data, "fingerprint"),
             *before != 0 ? before : "unknown");
  }
}
