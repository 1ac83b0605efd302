/* pictures.c: the picture of an evaluation in a suite: which designs it shows, and where its axes
 * end. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/jobs.h"
#include "api/suite.h"
#include "http/field.h"
#include "store/worlds.h"

#define AXIS_SCALES 3 /* in scales of the loss: 3 m traveled, 0.3 m climbed */

/* Chooses the ends of the axes: the same for tasks whose values have the same scale, so that they
 * can be compared, and usually the same for all pictures. */
static void choose_axes(const enum mo_objective objectives[MO_SUITE_TASKS],
                        const struct mo_suite_polygon *polygons, uint32_t n,
                        struct mo_suite_axis axes[MO_SUITE_TASKS])
{
  for (uint32_t t = 0; t < MO_SUITE_TASKS; t++) {
    const double scale = mo_objective_scale(objectives[t]), step = AXIS_SCALES * scale;
    double top = 0;
    for (uint32_t other = 0; other < MO_SUITE_TASKS; other++)
      for (uint32_t i = 0; i < n && mo_objective_scale(objectives[other]) == scale; i++)
        top = fmax(top, polygons[i].scores.values[other]); /* fmax ignores NaN */
    axes[t] = (struct mo_suite_axis){mo_objective_unit(objectives[t]),
                                     scale > 0 ? step * fmax(1, ceil(top / step)) : 1};
  }
}

/* Reads a list of up to MO_SUITE_POLYGONS_MAX numbers of designs. Returns how many; 0: none is
 * given; −1: it has replied. */
static int read_numbers(struct mo_request *request, const struct mo_job *job, uint32_t *numbers)
{
  const char *list = mo_query(request, "designs");
  int n = 0;
  while (list != NULL && n >= 0) {
    const size_t size = strcspn(list, ",");
    int64_t number;
    if (n == MO_SUITE_POLYGONS_MAX ||
        !mo_decimal(list, size, 0, (int64_t)job->n_designs - 1, &number))
      n = -1;
    else
      numbers[n++] = (uint32_t)number;
    list = list[size] == ',' ? list + size + 1 : NULL;
  }
  if (n < 0)
    mo_reply_bad_parameter(request, "designs",
                           "must be up to 6 design numbers, starting at 0, separated by commas");
  return n;
}

/* Means over different numbers of tasks are not comparable, so designs with a loss in more tasks
 * come first. */
static bool is_better(const struct mo_suite_scores *a, const struct mo_suite_scores *b)
{
  return a->n_left_out != b->n_left_out ? a->n_left_out < b->n_left_out
                                        : a->mean_loss < b->mean_loss;
}

/* Finds the designs with the least mean loss, the best first. Returns how many, or an error. */
static int find_best(struct mo_api *api, int64_t id, const struct mo_environment *environments,
                     uint32_t numbers[MO_SUITE_POLYGONS_MAX])
{
  struct mo_evaluation_results *results = NULL;
  struct mo_suite_scores best[MO_SUITE_POLYGONS_MAX];
  int n = 0;
  const int error = mo_store_results(api->store, id, &results);
  for (uint32_t d = 0; error == MO_OK && d < results->n_designs; d++) {
    const struct mo_suite_scores scores = mo_suite_scores(results, d, environments);
    if (!isfinite(scores.mean_loss) ||
        (n == MO_SUITE_POLYGONS_MAX && !is_better(&scores, &best[n - 1])))
      continue;
    int place = n < MO_SUITE_POLYGONS_MAX ? n++ : n - 1;
    for (; place > 0 && is_better(&scores, &best[place - 1]); place--) {
      best[place] = best[place - 1];
      numbers[place] = numbers[place - 1];
    }
    best[place] = scores;
    numbers[place] = d;
  }
  mo_evaluation_results_free(results);
  return error == MO_OK ? n : error;
}

/* Reads the scores of a design. */
static int read_polygon(struct mo_api *api, int64_t id, const struct mo_environment *environments,
                        uint32_t number, struct mo_suite_polygon *polygon)
{
  char robot[MO_DEFAULT_ROBOT_DIGITS + 1] = "";
  struct mo_evaluation_results *results = NULL;
  const int error = mo_store_result(api->store, id, number, &results);
  if (error != MO_OK)
    return error;
  if (mo_genotype_robot(api->lattice->workspace, results->genotypes[0].words, robot) == MO_OK)
    snprintf(polygon->name, sizeof(polygon->name), "%u: %.8s…%s", number, robot,
             &robot[MO_DEFAULT_ID_DIGITS]);
  else
    snprintf(polygon->name, sizeof(polygon->name), "%u: skipped", number);
  polygon->scores = mo_suite_scores(results, 0, environments);
  mo_evaluation_results_free(results);
  return MO_OK;
}

/* Draws the designs, or the best ones if n is 0. */
static int draw(struct mo_api *api, const struct mo_job *job, uint32_t *numbers, int n,
                uint32_t width_px, bool is_dark, struct mo_text *text)
{
  struct mo_suite_polygon polygons[MO_SUITE_POLYGONS_MAX];
  struct mo_suite_axis axes[MO_SUITE_TASKS];
  enum mo_objective objectives[MO_SUITE_TASKS];
  struct mo_environment *environments = NULL;
  uint32_t n_environments = 0;
  char title[128];
  int error =
      mo_store_job_environments(api->store, job->id, job->kind, &environments, &n_environments);
  if (error == MO_OK && n == 0)
    n = find_best(api, job->id, environments, numbers);
  if (n < 0)
    error = n;
  for (int i = 0; i < n && error == MO_OK; i++)
    error = read_polygon(api, job->id, environments, numbers[i], &polygons[i]);
  for (uint32_t t = 0; t < MO_SUITE_TASKS && error == MO_OK; t++)
    objectives[t] = environments[t * (n_environments / MO_SUITE_TASKS)].task.objective;
  if (error == MO_OK) {
    snprintf(title, sizeof(title), "%s, evaluation %lld", job->environment_set, (long long)job->id);
    choose_axes(objectives, polygons, (uint32_t)n, axes);
    mo_suite_draw(text, title, polygons, (uint32_t)n, axes, width_px, is_dark);
  }
  mo_environments_free(environments, n_environments);
  return error;
}

void mo_api_get_suite_picture(struct mo_request *request)
{
  static const char *const themes[] = {"light", "dark", NULL};
  struct mo_api *api = mo_api_of(request);
  uint32_t numbers[MO_SUITE_POLYGONS_MAX] = {0};
  struct mo_text text = {0};
  struct mo_job job;
  int64_t id, width_px = 760;
  int theme = 0;
  if (!mo_query_word(request, "theme", themes, &theme) ||
      !mo_query_number(request, "width", 320, 2000, &width_px) || !mo_path_id(request, 0, &id) ||
      !mo_job_of_kind(request, &mo_evaluation_resource, id, &job))
    return;
  const int n = mo_suite_of(&job) >= 0 && job.state == MO_JOB_SUCCEEDED
                    ? read_numbers(request, &job, numbers)
                    : 0;
  if (mo_suite_of(&job) < 0)
    mo_reply_problem(request, 404, NULL,
                     "The evaluation has no picture, because its environments are not a suite.");
  else if (job.state != MO_JOB_SUCCEEDED)
    mo_reply_problem(request, 409, NULL,
                     "The evaluation is %s; it has a picture once it has succeeded.",
                     mo_job_state_name(job.state));
  else if (n == 0 && !mo_results_fit(&job))
    mo_reply_bad_parameter(
        request, "designs",
        "is required, because this evaluation has too many designs to rank; give up to 6");
  else if (n >= 0) {
    const int error = draw(api, &job, numbers, n, (uint32_t)width_px, theme == 1, &text);
    if (error != MO_OK || text.failed) {
      mo_text_free(&text);
      mo_reply_error(request, error != MO_OK ? error : MO_ERR_NO_MEMORY, "picture");
      return;
    }
    mo_reply_bytes(request, 200, "image/svg+xml", text.data, text.size);
    request->reply.packs = true;
    mo_reply_etag_of_body(request);
  }
}
