/* cmd_eval.c: eval and verify. */
#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "commands.h"
#include "table.h"
#include "template.h"
#include "transport.h"

static int fill_record(const struct ctl *ctl, json_t *request)
{
  int64_t stride = 10;
  if (!option_is_set(ctl, "record") && !option_is_set(ctl, "film")) {
    if (option_is_set(ctl, "record-stride") || option_is_set(ctl, "output"))
      return complain(STATUS_USAGE, "--record-stride and --output need --record, such as "
                                    "--record com,masses");
    return STATUS_OK;
  }
  const int status = request_fill_record(ctl, request, NULL);
  if (status != STATUS_OK)
    return status;
  if (!option_number(ctl, "record-stride", 1, 1000000, &stride))
    return STATUS_USAGE;
  if (option_is_set(ctl, "record-stride"))
    json_object_set_new(request, "record_stride", json_integer(stride));
  return STATUS_OK;
}

/* Writes the header of a NumPy .npy file, version 1: magic, version, length of the header, header
 * padded to 64 bytes. The numbers follow. */
static size_t npy_head(const char *array, const char *shape, char head[256])
{
  const char *type = strcmp(array, "actuation") == 0  ? "|i1"
                     : strcmp(array, "contacts") == 0 ? "|u1"
                                                      : "<f4";
  char text[200];
  int n = snprintf(text, sizeof(text), "{'descr': '%s', 'fortran_order': False, 'shape': (%s), }",
                   type, shape);
  size_t padded = ((size_t)n + 1 + 10 + 63) / 64 * 64 - 10;
  static const char magic[8] = {'\x93', 'N', 'U', 'M', 'P', 'Y', 1, 0};
  memcpy(head, magic, sizeof(magic));
  head[8] = (char)(padded & 0xff);
  head[9] = (char)(padded >> 8);
  memset(head + 10, ' ', padded);
  memcpy(head + 10, text, (size_t)n);
  head[10 + padded - 1] = '\n';
  return padded + 10;
}

static int save_array(struct ctl *ctl, const char *folder, const char *id, size_t design,
                      size_t environment, const char *array)
{
  const char *path = path_to("/v1/evaluations/%s/trajectories/%zu/file?environment=%zu&array=%s",
                             id, design, environment, array);
  struct reply reply;
  int status = transport_get(ctl, path, "application/octet-stream", &reply);
  if (status == STATUS_OK && strspn(reply.shape, "0123456789,") != strlen(reply.shape))
    status = complain(STATUS_ERROR, "the server's reply has no shape");
  if (status == STATUS_OK) {
    char head[256];
    size_t n = npy_head(array, reply.shape, head);
    char *file =
        format_text("%s/design-%04zu-environment-%02zu-%s.npy", folder, design, environment, array);
    status = save_output(file, head, n, reply.body, reply.body_bytes);
    free(file);
  }
  reply_free(&reply);
  return status;
}

int save_trajectories(struct ctl *ctl, const json_t *evaluation, const char *folder)
{
  if (mkdir(folder, 0777) != 0 && errno != EEXIST)
    return complain(STATUS_ERROR, "%s: %s", folder, strerror(errno));
  char *path = format_text("%s/evaluation.json", folder),
       *text = dump_json(evaluation, JSON_INDENT(1));
  int status = save_output(path, "", 0, text, strlen(text));
  free(text);
  free(path);
  const json_t *results = json_object_get(evaluation, "results"),
               *record = json_object_get(evaluation, "record");
  size_t n_files = 0;
  for (size_t i = 0; i < json_array_size(results) && status == STATUS_OK; i++) {
    const json_t *result = json_array_get(results, i);
    size_t n_environments = json_array_size(json_object_get(result, "losses"));
    if (json_is_object(json_object_get(result, "fault")))
      continue;
    for (size_t k = 0; k < n_environments && status == STATUS_OK; k++)
      for (size_t a = 0; a < json_array_size(record) && status == STATUS_OK; a++) {
        status = save_array(ctl, folder, text_of(evaluation, "id"), i, k,
                            json_string_value(json_array_get(record, a)));
        n_files++;
      }
  }
  if (status == STATUS_OK && !ctl->quiet)
    fprintf(stderr, "%zu trajectories in %s\n", n_files, folder);
  return status;
}

/* ---- results ---- */

static int compare_ranked(const void *a, const void *b)
{
  const struct ranked *x = a, *y = b;
  if (x->score != y->score)
    return x->score < y->score ? -1 : 1;
  return x->place < y->place ? -1 : x->place > y->place;
}

struct ranked *rank_results(const json_t *results, bool by_score)
{
  const size_t n = json_array_size(results);
  struct ranked *order = need(calloc(n + 1, sizeof(*order)));
  for (size_t i = 0; i < n; i++) {
    const double score = real_at(json_array_get(results, i), "score");
    order[i] = (struct ranked){i, isnan(score) ? (double)INFINITY : score};
  }
  if (by_score)
    qsort(order, n, sizeof(*order), compare_ranked);
  return order;
}

/* Returns a copy of a result with what the table shows besides: number, name, best, worst,
 * note. */
static json_t *result_row(const json_t *result, size_t number, const char *name)
{
  const json_t *losses = json_object_get(result, "losses"), *best = NULL, *worst = NULL, *loss,
               *agrees = json_object_get(result, "agrees");
  const char *note = json_is_true(agrees)    ? "the same"
                     : json_is_false(agrees) ? "DIFFERENT"
                                             : "nothing stored";
  size_t k;
  json_array_foreach(losses, k, loss)
  {
    if (!json_is_number(loss))
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
  json_object_update_missing(row, (json_t *)result);
  return row;
}

static const char *name_of(const struct designs *designs, size_t i)
{
  return designs != NULL && i < designs->n ? designs->names[i] : NULL;
}

void print_results(const struct ctl *ctl, const json_t *evaluation, const struct designs *designs,
                   bool by_score, size_t top)
{
  const json_t *results = json_object_get(evaluation, "results");
  const size_t n = json_array_size(results), shown = top != 0 && top < n ? top : n;
  struct ranked *order = rank_results(results, by_score);
  json_t *rows = json_array();
  bool named = false, verified = false;
  char columns[512];
  for (size_t i = 0; i < n; i++) {
    named |= name_of(designs, i) != NULL;
    verified |= json_object_get(json_array_get(results, i), "agrees") != NULL;
  }
  for (size_t r = 0; r < shown; r++) {
    const size_t i = order[r].place;
    json_array_append_new(rows, result_row(json_array_get(results, i), i, name_of(designs, i)));
  }
  snprintf(columns, sizeof(columns),
           ">#={number}%s|design={id}|>voxels={voxels}|>score={score:.4f}|>best={best:.4f}"
           "|>worst={worst:.4f}|%s=[skipped: {fault.detail}|{note}|diverged in {diverged:#} of "
           "{losses:#} (environment {diverged.0.environment}, step {diverged.0.step})]",
           named ? "|name={name}" : "", verified ? "bits" : "note");
  print_table(stdout, ctl, rows, columns);
  if (shown < n)
    printf("… and %zu more\n", n - shown);
  json_decref(rows);
  free(order);
}

/* Prints an evaluation that was waited for. */
static void print_evaluation(const struct ctl *ctl, const json_t *evaluation,
                             const struct designs *designs, bool by_score, size_t top)
{
  if (ctl->json)
    print_json(evaluation);
  else if (json_object_get(evaluation, "results") != NULL)
    print_results(ctl, evaluation, designs, by_score, top);
}

int run_eval(struct ctl *ctl)
{
  struct designs designs = {0};
  json_t *request = json_object(), *evaluation = NULL;
  const bool wait = !option_is_set(ctl, "no-wait"), speaks = !ctl->json && !ctl->quiet;
  int64_t n_random = 0, seed = 1, top = 0;
  const char *sort = option_text(ctl, "sort", "input"), *output = option_text(ctl, "output", NULL);
  int status = option_number(ctl, "random", 1, DESIGNS_MAX, &n_random) &&
                       option_number(ctl, "seed", 0, INT64_MAX, &seed)
                   ? add_designs(ctl, 0, n_random, seed, &designs)
                   : STATUS_USAGE;
  if (status == STATUS_OK && !option_number(ctl, "top", 1, DESIGNS_MAX, &top))
    status = STATUS_USAGE;
  if (status == STATUS_OK && strcmp(sort, "input") != 0 && strcmp(sort, "score") != 0)
    status = complain(STATUS_USAGE, "--sort: \"%s\" is not input or score", sort);
  if (status == STATUS_OK && output != NULL && !wait)
    status = complain(STATUS_USAGE, "--output needs the result: it goes with --wait");
  if (status == STATUS_OK && option_is_set(ctl, "film") && !wait)
    status = complain(STATUS_USAGE, "--film needs the result: it goes with --wait");
  if (status == STATUS_OK)
    status = film_check(ctl);
  if (status == STATUS_OK)
    status = request_fill(ctl, request);
  if (status == STATUS_OK)
    status = fill_record(ctl, request);
  if (status == STATUS_OK) {
    json_object_set(request, "designs", designs.list);
    status = fill_fields(ctl, request);
  }
  if (status == STATUS_OK)
    status = evaluate(ctl, "/v1/evaluations", request, wait, &evaluation);
  if (status == STATUS_OK && !wait) {
    if (ctl->json)
      print_json(evaluation);
    else
      print_from(stdout, evaluation, "{id}");
    if (speaks)
      print_from(stderr, evaluation,
                 "evaluation {id} is accepted: {n_designs} designs, {rollouts_total} rollouts; "
                 "morphoctl watch {id}");
  } else if (status == STATUS_OK) {
    print_evaluation(ctl, evaluation, &designs, strcmp(sort, "score") == 0 || top > 0, (size_t)top);
    if (speaks)
      print_from(stderr, evaluation,
                 "evaluation {id}: {rollouts_total:,} rollouts, {rollouts_cached:,} of them from "
                 "the store");
    status = job_outcome("job", evaluation);
    if (status == STATUS_OK && output != NULL)
      status = save_trajectories(ctl, evaluation, output);
    if (status == STATUS_OK)
      status = film_evaluation(ctl, evaluation);
  }
  json_decref(evaluation);
  json_decref(request);
  designs_free(&designs);
  return status;
}

/* ---- verify ---- */

/* Adds the orientations in which a design was scored: a score belongs to one oriented body, an id
 * to all of its orientations. */
static int add_orientations(struct ctl *ctl, struct designs *designs, const char *id)
{
  json_t *design;
  int status = get_json(ctl, &design, "/v1/designs/%s", id);
  if (status == STATUS_OK)
    status = designs_add_genotypes(designs, json_object_get(design, "orientations"));
  json_decref(design);
  return status;
}

/* Adds what an earlier evaluation requested. */
static int add_evaluation(struct ctl *ctl, struct designs *designs, json_t *request, const char *id)
{
  json_t *evaluation;
  if (!check_job_id(id))
    return STATUS_USAGE;
  int status = get_json(ctl, &evaluation, "/v1/evaluations/%s", id);
  const bool named = json_is_string(json_object_get(evaluation, "environments"));
  if (status == STATUS_OK)
    status = job_outcome("job", evaluation);
  if (status == STATUS_OK && !named && !option_is_set(ctl, "environments"))
    status = complain(
        STATUS_USAGE,
        "evaluation %s has environments of its own: give them again with --environments", id);
  if (status == STATUS_OK)
    status = designs_add_genotypes(designs, json_object_get(evaluation, "results"));
  if (status == STATUS_OK) {
    json_object_set_new(
        request, "controller",
        json_sprintf("sha256:%s", text_of(json_object_get(evaluation, "controller"), "sha256")));
    json_object_set(request, "physics", json_object_get(evaluation, "physics"));
    json_object_set(request, "precision", json_object_get(evaluation, "precision"));
    if (named)
      json_object_set(request, "environments", json_object_get(evaluation, "environments"));
  }
  json_decref(evaluation);
  return status;
}

int run_verify(struct ctl *ctl)
{
  struct designs designs = {0};
  json_t *request = json_object(), *evaluation = NULL;
  const char *earlier = option_text(ctl, "evaluation", NULL);
  int status = STATUS_OK;
  if (earlier == NULL && ctl->n_operands == 0)
    status = complain(STATUS_USAGE, "nothing to verify: give designs, or --evaluation ID");
  if (status == STATUS_OK && earlier != NULL)
    status = add_evaluation(ctl, &designs, request, earlier);
  for (size_t i = 0; i < ctl->n_operands && status == STATUS_OK; i++) {
    if (is_id(ctl->operands[i], strlen(ctl->operands[i])))
      status = add_orientations(ctl, &designs, ctl->operands[i]);
    else
      status = designs_add_operand(&designs, ctl->operands[i]);
  }
  if (status == STATUS_OK)
    status = request_fill(ctl, request);
  if (status == STATUS_OK) {
    json_object_set(request, "designs", designs.list);
    json_object_set_new(request, "verify", json_true());
    status = evaluate(ctl, "/v1/evaluations", request, true, &evaluation);
  }
  if (status == STATUS_OK)
    status = job_outcome("job", evaluation);
  if (status == STATUS_OK) {
    size_t agree = 0, differ = 0, absent = 0, i;
    json_t *result;
    json_array_foreach(json_object_get(evaluation, "results"), i, result)
    {
      const json_t *agrees = json_object_get(result, "agrees");
      agree += json_is_true(agrees);
      differ += json_is_false(agrees);
      absent += !json_is_boolean(agrees);
    }
    print_evaluation(ctl, evaluation, &designs, false, 0);
    if (!ctl->json && !ctl->quiet)
      printf("%zu the same, %zu different, %zu not stored\n", agree, differ, absent);
    if (differ > 0)
      status = complain(STATUS_NEGATIVE,
                        "%zu stored scores have other bits than their recomputation", differ);
    else if (agree == 0)
      status = complain(STATUS_NEGATIVE, "nothing is stored to compare with");
  }
  json_decref(evaluation);
  json_decref(request);
  designs_free(&designs);
  return status;
}
