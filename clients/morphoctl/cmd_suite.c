/* cmd_suite.c: suite run, show, picture: designs in all tasks of the suite morpho-12, as one
 * evaluation of the service. */
#include <math.h>
#include <string.h>

#include "commands.h"
#include "results.h"

/* Returns the mean of the numbers that rows have at a place, or null; *n: how many have one. */
static json_t *mean_of(const json_t *rows, const char *place, size_t *n)
{
  const json_t *row;
  double sum = 0;
  size_t i;
  *n = 0;
  json_array_foreach(rows, i, row)
  {
    const double value = real_at(row, place);
    if (isfinite(value)) {
      sum += value;
      ++*n;
    }
  }
  return real_or_null(sum / (double)*n); /* of none: 0 / 0 */
}

/* Makes the row with the means over the designs. `fewest`: how many designs the mean of a task
 * has. */
static json_t *make_means(const json_t *rows, size_t *fewest)
{
  json_t *values = json_object();
  size_t n;
  *fewest = json_array_size(rows);
  for (int t = 0; t < SUITE_TASKS; t++) {
    json_object_set_new(
        values, suite_tasks[t],
        json_pack("{s:o}", "value", mean_of(rows, path_to("tasks.%s.value", suite_tasks[t]), &n)));
    *fewest = n < *fewest ? n : *fewest;
  }
  return json_pack("{s:s, s:o, s:{s:o}}", "robot", "mean", "tasks", values, "tasks_mean", "loss",
                   mean_of(rows, "tasks_mean.loss", &n));
}

static void print_suite(struct ctl *ctl, const json_t *evaluation)
{
  char columns[SUITE_TASKS * 56 + 160] = "design=[{robot}|skipped]";
  const json_t *results = json_object_get(evaluation, "results"), *result;
  size_t left_out = 0, fewest, i;
  if (ctl->json) {
    print_json(evaluation);
    return;
  }
  if (results == NULL) /* too many for one reply */
    results = collect(ctl, path_to("/v1/evaluations/%s/results", text_of(evaluation, "id")), 0);
  json_t *rows = keep(json_copy((json_t *)results));
  json_array_foreach(results, i, result) left_out +=
      json_array_size(json_object_get(json_object_get(result, "tasks_mean"), "left_out")) > 0;
  const size_t n = json_array_size(rows);
  json_t *means = make_means(rows, &fewest);
  if (n > 1)
    json_array_append(rows, means);
  json_decref(means);
  for (int t = 0; t < SUITE_TASKS; t++)
    snprintf(columns + strlen(columns), sizeof(columns) - strlen(columns),
             "|>%s=[{tasks.%s.value:.3f}]", suite_tasks[t], suite_tasks[t]);
  snprintf(columns + strlen(columns), sizeof(columns) - strlen(columns),
           "|>mean loss=[{tasks_mean.loss:.3f}]");
  print_table(stdout, ctl, rows, columns);
  json_array_foreach(results, i, result)
  {
    const json_t *without = json_object_get(json_object_get(result, "tasks_mean"), "left_out");
    if (json_array_size(without) > 0 && json_is_string(json_object_get(result, "robot")))
      fprintf(stderr, "The mean loss of %s leaves out %s, in which a rollout diverged.\n",
              text_of(result, "robot"), words_of(without));
  }
  if (left_out > 0 && n > 1)
    fprintf(stderr,
            "Some task means leave out up to %zu of %zu designs, which were skipped or diverged.\n",
            n - fewest, n);
  if (ctl->quiet)
    return;
  fprintf(stderr, "photo, damage: 1 - d/d0; photo-auc: 1 - mean d/d0; up: meters climbed; "
                  "others: meters traveled. Higher is better; a robot that stands still gets 0. "
                  "Mean loss over the tasks: lower is better; standing still gives 1.\n");
  print_from(stderr, evaluation,
             "evaluation {id}: {rollouts_total:,} rollouts, {rollouts_cached:,} from the store; "
             "morphoctl suite picture {id} draws it");
}

/* ---- suite run ---- */

/* Makes the request; *path: where to post it. */
static json_t *make_request(struct ctl *ctl, const char **path)
{
  const char *campaign = option_text(ctl, "campaign", NULL),
             *set = option_is_set(ctl, "held-out") ? "morpho-12-held-out" : "morpho-12";
  json_t *request = keep(json_pack("{s:s}", "environments", set));
  if (campaign == NULL) {
    const json_t *random = random_of(ctl, "seed", RANDOM_BODIES_MAX);
    if (option_is_set(ctl, "count"))
      fail(STATUS_USAGE, "--count needs --campaign ID, which selects the champions to score");
    if (random != NULL && ctl->n_operands == 0)
      json_object_set(request, "random", (json_t *)random);
    else
      json_object_set(request, "designs", given_designs(ctl, 0, random).list);
    request_fill(ctl, request);
    *path = "/v1/evaluations";
    return request;
  }
  static const char *const excluded[] = {"random",    "seed",       "first",    "physics",
                                         "precision", "repair",     "on-fault", "weight",
                                         "device",    "experiment", NULL};
  for (const char *const *name = excluded; *name != NULL; name++)
    if (option_is_set(ctl, *name))
      fail(STATUS_USAGE,
           "--%s cannot be combined with --campaign, which determines the designs and their "
           "settings",
           *name);
  if (ctl->n_operands > 0)
    fail(STATUS_USAGE, "give designs or --campaign, not both");
  json_object_set_new(request, "count", json_integer(option_number(ctl, "count", 1, 1000, 12)));
  request_fill(ctl, request); /* controller, label */
  *path = path_to("/v1/campaigns/%s/champions", job_id(campaign));
  return request;
}

void run_suite(struct ctl *ctl)
{
  const bool wait = !option_is_set(ctl, "no-wait");
  const char *path;
  const json_t *request = make_request(ctl, &path),
               *evaluation = evaluate(ctl, path, request, wait);
  if (wait) {
    expect_success("job", evaluation);
    print_suite(ctl, evaluation);
    return;
  }
  if (ctl->json)
    print_json(evaluation);
  else
    print_from(stdout, evaluation, "{id}");
  if (!ctl->json && !ctl->quiet)
    print_from(stderr, evaluation,
               "evaluation {id} accepted: {n_designs} design{n_designs:s}, {rollouts_total} "
               "rollouts; morphoctl watch {id}; then morphoctl suite show {id}");
}

/* ---- suite show, suite picture ---- */

void run_suite_show(struct ctl *ctl)
{
  const json_t *evaluation = get_json(ctl, "/v1/evaluations/%s", job_id(ctl->operands[0]));
  if (json_object_get(evaluation, "suite") == NULL)
    fail(STATUS_USAGE, "evaluation %s is not in a suite; use morphoctl job show %s",
         ctl->operands[0], ctl->operands[0]);
  expect_success("job", evaluation);
  print_suite(ctl, evaluation);
}

void run_suite_picture(struct ctl *ctl)
{
  static const char *const parameters[] = {"designs", "theme", "width", NULL};
  const char *id = job_id(ctl->operands[0]),
             *path = path_with(ctl, path_to("/v1/evaluations/%s/picture.svg", id), parameters);
  save_reply(ctl, path, "image/svg+xml", option_text(ctl, "output", path_to("suite-%s.svg", id)));
}
