/* cmd_suite.c: suite run: scores designs in all tasks of the suite morpho-12.
 *
 * One evaluation for each task. The server keeps their scores, so a run that was interrupted is
 * simply repeated: whatever is stored is not computed again. */
#include <math.h>
#include <string.h>

#include "commands.h"
#include "results.h"

static const char *const tasks[] = {"photo",  "photo-auc", "walk",   "rough",   "up",   "down",
                                    "hurdle", "gap",       "circle", "shuttle", "path", "damage"};
enum { TASKS = sizeof(tasks) / sizeof(*tasks) };

/* Returns the value of a result in the unit of its task; NaN: a rollout diverged. */
static double value_of(const json_t *result)
{
  const json_t *value = json_object_get(result, "value");
  if (value == NULL) /* `photo` has no value of its own */
    return 1 - real_at(result, "score");
  return json_is_number(value) ? json_number_value(value) : NAN;
}

/* Adds the values of one task to the rows, one for each result. */
static void add_values(json_t *rows, const char *task, const json_t *results)
{
  const json_t *result;
  size_t i;
  json_array_foreach(results, i, result)
  {
    if (json_array_size(rows) <= i)
      json_array_append_new(
          rows, json_pack("{s:O?, s:O?, s:o}", "robot", json_object_get(result, "robot"), "fault",
                          json_object_get(result, "fault"), "values", json_object()));
    const double value = value_of(result);
    json_object_set_new(json_object_get(json_array_get(rows, i), "values"), task,
                        isfinite(value) ? json_real(value) : json_null());
  }
}

/* Replaces ids by the robots that were scored, so that every task scores the same orientation. */
static void pin_robots(json_t *designs, const json_t *rows)
{
  const json_t *row;
  size_t i;
  json_array_foreach(rows, i, row)
  {
    json_t *robot = json_object_get(row, "robot");
    if (json_is_string(robot))
      json_array_set_new(designs, i, json_pack("{s:O}", "id", robot));
  }
}

/* Adds the means over the designs that have all values as a last row. Returns the number of the
 * others. */
static size_t add_means(json_t *rows)
{
  const json_t *row;
  json_t *means = json_object();
  double sums[TASKS] = {0};
  size_t i, n = 0;
  json_array_foreach(rows, i, row)
  {
    const json_t *values = json_object_get(row, "values");
    int known = 0;
    while (known < TASKS && json_is_number(json_object_get(values, tasks[known])))
      known++;
    for (int t = 0; t < TASKS && known == TASKS; t++)
      sums[t] += json_number_value(json_object_get(values, tasks[t]));
    n += known == TASKS;
  }
  const size_t left_out = json_array_size(rows) - n;
  for (int t = 0; t < TASKS; t++)
    json_object_set_new(means, tasks[t], n > 0 ? json_real(sums[t] / (double)n) : json_null());
  json_array_append_new(rows, json_pack("{s:s, s:o}", "robot", "mean", "values", means));
  return left_out;
}

static void print_values(const struct ctl *ctl, const json_t *rows)
{
  char columns[TASKS * 48 + 32] = "design={robot}";
  for (int t = 0; t < TASKS; t++)
    snprintf(columns + strlen(columns), sizeof(columns) - strlen(columns), "|>%s=[{values.%s:.3f}]",
             tasks[t], tasks[t]);
  print_table(stdout, ctl, rows, columns);
}

void run_suite(struct ctl *ctl)
{
  struct designs designs = given_designs(ctl, 0, random_of(ctl, "seed", DESIGNS_MAX));
  const char *ending = option_is_set(ctl, "held-out") ? "-held-out" : "";
  json_t *rows = keep(json_array()), *evaluations = keep(json_object());
  for (int t = 0; t < TASKS; t++) {
    json_t *request = keep(json_pack("{s:O, s:s++}", "designs", designs.list, "environments",
                                     "morpho-12-", tasks[t], ending));
    request_fill(ctl, request);
    const json_t *evaluation = evaluate(ctl, "/v1/evaluations", request, true);
    expect_success("job", evaluation);
    add_values(rows, tasks[t], json_object_get(evaluation, "results"));
    if (t == 0)
      pin_robots(designs.list, rows);
    json_object_set(evaluations, tasks[t], json_object_get(evaluation, "id"));
  }
  if (ctl->json) {
    print_json(keep(json_pack("{s:O, s:O}", "evaluations", evaluations, "designs", rows)));
    return;
  }
  const size_t left_out = json_array_size(rows) > 1 ? add_means(rows) : 0;
  print_values(ctl, rows);
  if (left_out > 0)
    fprintf(stderr, "The means leave out %zu of %zu designs: skipped, or diverged in a task.\n",
            left_out, json_array_size(rows) - 1);
  if (!ctl->quiet)
    fprintf(stderr,
            "photo, damage: 1 - d/d0; photo-auc: 1 - mean d/d0; up: m of height; the others: m of "
            "way. Larger is better; 0 is standing still.\n");
}
