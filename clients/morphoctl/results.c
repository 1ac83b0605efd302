/* results.c: see results.h. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "results.h"

#define MEASURES_MAX 32 /* columns */

static int compare_ranked(const void *a, const void *b)
{
  const struct ranked *x = a, *y = b;
  if (x->is_bound != y->is_bound)
    return x->is_bound ? 1 : -1;
  if (x->score != y->score)
    return x->score < y->score ? -1 : 1;
  return x->place < y->place ? -1 : x->place > y->place;
}

struct ranked *rank_results(const json_t *results, bool by_score)
{
  const size_t n = json_array_size(results);
  struct ranked *order = keep(calloc(n + 1, sizeof(*order)));
  for (size_t i = 0; i < n; i++) {
    const json_t *result = json_array_get(results, i);
    const double score = real_at(result, "score");
    order[i] = (struct ranked){i, isnan(score) ? (double)INFINITY : score,
                               json_is_true(json_object_get(result, "lower_bound"))};
  }
  if (by_score)
    qsort(order, n, sizeof(*order), compare_ranked);
  return order;
}

const char *words_of(const json_t *list)
{
  const char *words = "";
  const json_t *word;
  size_t i;
  json_array_foreach(list, i, word) if (json_is_string(word)) words =
      keep(format_text("%s%s%s", words, words[0] != '\0' ? ", " : "", json_string_value(word)));
  return words;
}

const char *measure_columns(const json_t *measures)
{
  static const char letters[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789_-";
  const char *columns = "", *name;
  const json_t *mean;
  size_t n = 0, left_out = 0;
  json_object_foreach((json_t *)measures, name, mean)
  {
    if (name[strspn(name, letters)] == '\0' && n < MEASURES_MAX) {
      n++;
      columns = keep(format_text("%s|>%s=[{measures.%s:.4g}]", columns, name, name));
    } else {
      left_out++;
    }
  }
  if (left_out > 0)
    fprintf(stderr, "%zu measures are not in the table; --json has them.\n", left_out);
  return columns;
}

/* Returns a copy of a result with the other columns of the table: number, name, note and, unless
 * the score is a lower bound, the best and the worst loss. */
static json_t *result_row(const json_t *result, size_t number, const char *name)
{
  const json_t *losses = json_object_get(result, "losses"), *best = NULL, *worst = NULL, *loss,
               *agrees = json_object_get(result, "agrees");
  const char *note = json_is_true(agrees)    ? "the same"
                     : json_is_false(agrees) ? "DIFFERENT"
                                             : "nothing stored";
  const bool is_whole = !json_is_true(json_object_get(result, "lower_bound"));
  size_t k;
  json_array_foreach(losses, k, loss)
  {
    if (json_is_object(loss))
      loss = json_object_get(loss, "loss");
    if (!is_whole || !json_is_number(loss))
      continue;
    if (best == NULL || json_number_value(loss) < json_number_value(best))
      best = loss;
    if (worst == NULL || json_number_value(loss) > json_number_value(worst))
      worst = loss;
  }
  json_t *row = json_pack("{s:I, s:s*, s:O*, s:O*}", "number", (json_int_t)number, "name", name,
                          "best", best, "worst", worst);
  if (agrees != NULL)
    json_object_set_new(row, "note", json_string(note));
  const char *flags = words_of(json_object_get(result, "flags"));
  if (flags[0] != '\0')
    json_object_set_new(row, "flag", json_string(flags));
  json_object_update_missing(row, (json_t *)result);
  return row;
}

static const char *name_of(const struct designs *designs, size_t i)
{
  return designs != NULL ? json_string_value(json_array_get(designs->names, i)) : NULL;
}

/* Returns the position in the request of the design of result i: results in pages have its
 * number. */
static size_t place_of(const json_t *results, size_t i)
{
  const json_t *number = json_object_get(json_array_get(results, i), "number");
  return number != NULL ? (size_t)json_integer_value(number) : i;
}

void print_results(const struct ctl *ctl, const json_t *evaluation, const struct designs *designs,
                   bool by_score, size_t top)
{
  const json_t *results = json_object_get(evaluation, "results");
  const size_t n = json_array_size(results), shown = top != 0 && top < n ? top : n;
  struct ranked *order = rank_results(results, by_score);
  json_t *rows = keep(json_array());
  bool named = false, verified = false, estimated = false, valued = false, climbed = false;
  const json_t *measures = json_object_get(value_at(results, "0"), "measures");
  const char *measured =
      measures != NULL ? keep(format_text("%s|flags=[{flag}]", measure_columns(measures))) : "";
  for (size_t i = 0; i < n; i++) {
    named |= name_of(designs, place_of(results, i)) != NULL;
    verified |= json_object_get(json_array_get(results, i), "agrees") != NULL;
    estimated |= json_object_get(json_array_get(results, i), "error") != NULL;
    climbed |= json_object_get(json_array_get(results, i), "tolerance") != NULL;
    valued |= json_object_get(json_array_get(results, i), "value") != NULL;
  }
  for (size_t r = 0; r < shown; r++) {
    const size_t i = order[r].place;
    const size_t place = place_of(results, i);
    json_array_append_new(rows,
                          result_row(json_array_get(results, i), place, name_of(designs, place)));
  }
  const char *columns = keep(format_text(
      ">#={number}%s|design={robot}|>voxels={voxels}|>score=[{lower_bound=true}≥ "
      "]{score:.4f}%s%s%s%s|>best={best:.4f}"
      "|>worst={worst:.4f}|%s=[skipped: {fault.detail}|{note}|diverged in {diverged:#} of "
      "{losses:#} (environment {diverged.0.environment}, step {diverged.0.step})]",
      named ? "|name={name}" : "", valued ? "|>value=[{value:.4f} {unit}]" : "",
      estimated ? "|>limit=[{error.low:.4f} to {error.high:.4f}]|>bifurcates="
                  "[{error.low:-}{error.bifurcates:#} of {losses:#}]"
                : "",
      climbed ? "|>error={tolerance.estimated_error:.2g}|step=[{tolerance.dt_s:g} s "
                "{tolerance.precision}]|tolerance=[{tolerance.bifurcates=true}bifurcates"
                "|{tolerance.reached=true}reached|not reached]"
              : "",
      measured, verified ? "bits" : "note"));
  print_table(stdout, ctl, rows, columns);
  say_orientations(ctl, results);
  if (shown < n)
    printf("… and %zu more\n", n - shown);
}
