/* cmd_eval.c: eval and verify. */
#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "commands.h"
#include "results.h"

static void fill_record(const struct ctl *ctl, json_t *request)
{
  const int64_t stride = option_number(ctl, "record-stride", 1, 1000000, 0);
  if (!option_is_set(ctl, "record") && !option_is_set(ctl, "film") &&
      (stride > 0 || option_is_set(ctl, "output")))
    fail(STATUS_USAGE, "--record-stride and --output need --record, such as --record com,masses");
  request_fill_record(ctl, request, NULL);
  if (stride > 0)
    json_object_set_new(request, "record_stride", json_integer(stride));
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

static void save_array(struct ctl *ctl, const char *folder, const char *id, size_t design,
                       size_t environment, const char *array)
{
  const char *path = path_to("/v1/evaluations/%s/trajectories/%zu/file?environment=%zu&array=%s",
                             id, design, environment, array);
  struct reply reply;
  char head[256];
  transport_get(ctl, path, "application/octet-stream", &reply);
  if (strspn(reply.shape, "0123456789,") != strlen(reply.shape))
    fail(STATUS_ERROR, "the server's reply has no shape");
  const size_t n = npy_head(array, reply.shape, head);
  save_output(
      path_to("%s/design-%04zu-environment-%02zu-%s.npy", folder, design, environment, array), head,
      n, reply.body, reply.body_bytes);
  reply_free(&reply);
}

void save_trajectories(struct ctl *ctl, const json_t *evaluation, const char *folder)
{
  const json_t *result, *array, *record = json_object_get(evaluation, "record");
  const char *text = keep(dump_json(evaluation, JSON_INDENT(1)));
  size_t n_files = 0, i, a;
  if (mkdir(folder, 0777) != 0 && errno != EEXIST)
    fail(STATUS_ERROR, "%s: %s", folder, strerror(errno));
  save_output(path_to("%s/evaluation.json", folder), "", 0, text, strlen(text));
  json_array_foreach(json_object_get(evaluation, "results"), i, result)
  {
    const size_t n_environments = json_array_size(json_object_get(result, "losses"));
    if (json_is_object(json_object_get(result, "fault")))
      continue;
    for (size_t k = 0; k < n_environments; k++)
      json_array_foreach(record, a, array)
      {
        save_array(ctl, folder, text_of(evaluation, "id"), i, k, json_string_value(array));
        n_files++;
      }
  }
  if (!ctl->quiet)
    fprintf(stderr, "%zu trajectories in %s\n", n_files, folder);
}

/* ---- eval ---- */

static void print_evaluation(const struct ctl *ctl, const json_t *evaluation,
                             const struct designs *designs, bool by_score, size_t top)
{
  if (ctl->json)
    print_json(evaluation);
  else if (json_object_get(evaluation, "results") != NULL)
    print_results(ctl, evaluation, designs, by_score, top);
}

/* Adds the complete scores to an evaluation that is too large for its results to be in the
 * reply. */
static void add_whole_results(struct ctl *ctl, json_t *evaluation)
{
  if (strcmp(text_of(evaluation, "state"), "succeeded") == 0)
    json_object_set(
        evaluation, "results",
        collect(ctl, path_to("/v1/evaluations/%s/results?whole=true", text_of(evaluation, "id")),
                0));
}

void run_eval(struct ctl *ctl)
{
  const bool wait = !option_is_set(ctl, "no-wait"), speaks = !ctl->json && !ctl->quiet;
  const bool races = option_is_set(ctl, "best");
  static const char *const orders[] = {"input", "score", NULL};
  const char *sort = option_word(ctl, "sort", orders, races ? "score" : "input"),
             *output = option_text(ctl, "output", NULL);
  const json_t *random = random_of(ctl, "seed", RANDOM_BODIES_MAX);
  const bool is_drawn = random != NULL && number_of(random, "count") > DESIGNS_MAX;
  if (is_drawn && ctl->n_operands > 0)
    fail(STATUS_USAGE, "with given designs, --random must be at most %d", DESIGNS_MAX);
  struct designs designs = is_drawn ? no_designs() : given_designs(ctl, 0, random);
  const bool is_large = is_drawn || json_array_size(designs.list) > DESIGNS_MAX;
  if (is_large)
    designs_pack(&designs);
  const bool is_top = races && !option_is_set(ctl, "sort") && !option_is_set(ctl, "top");
  const int64_t top = option_number(ctl, is_top ? "best" : "top", 1, RANDOM_BODIES_MAX, 0);
  json_t *request = keep(json_object());
  if (output != NULL && !wait)
    fail(STATUS_USAGE, "--output needs the result: give --wait");
  if (option_is_set(ctl, "film") && !wait)
    fail(STATUS_USAGE, "--film needs the result: give --wait");
  film_check(ctl);
  request_fill(ctl, request);
  fill_record(ctl, request);
  if (option_is_set(ctl, "error"))
    json_object_set_new(request, "error", json_true());
  request_fill_measures(ctl, request);
  if (is_drawn)
    json_object_set(request, "random", (json_t *)random);
  else
    json_object_set(request, "designs", designs.list);
  json_t *evaluation = evaluate(ctl, "/v1/evaluations", request, wait);
  if (is_large && wait && races)
    add_whole_results(ctl, evaluation);
  if (!wait) {
    if (ctl->json)
      print_json(evaluation);
    else
      print_from(stdout, evaluation, "{id}");
    if (speaks)
      print_from(stderr, evaluation,
                 "evaluation {id} accepted: {n_designs} design{n_designs:s}, {rollouts_total} "
                 "rollout{rollouts_total:s}; morphoctl watch {id}");
    complain_of_warnings("job", evaluation);
    return;
  }
  print_evaluation(ctl, evaluation, &designs, strcmp(sort, "score") == 0 || top > 0, (size_t)top);
  const bool is_long = json_object_get(evaluation, "results") == NULL &&
                       strcmp(text_of(evaluation, "state"), "succeeded") == 0;
  if (speaks && (is_large || is_long))
    print_from(stderr, evaluation,
               "all results: morphoctl export evaluations/{id}/results -o FILE.csv");
  if (speaks)
    print_from(
        stderr, evaluation,
        "evaluation {id}: {rollouts_total:,} rollout{rollouts_total:s}, {rollouts_cached:,} from "
        "the store[, {rollouts_cut>0:,} not needed]");
  expect_success("job", evaluation);
  if (output != NULL)
    save_trajectories(ctl, evaluation, output);
  film_evaluation(ctl, evaluation);
}

/* ---- verify ---- */

/* Adds the settings of an earlier evaluation. */
static void add_evaluation(struct ctl *ctl, struct designs *designs, json_t *request,
                           const char *id)
{
  const json_t *evaluation = get_json(ctl, "/v1/evaluations/%s", job_id(id));
  const bool named = json_is_string(json_object_get(evaluation, "environments"));
  expect_success("job", evaluation);
  if (json_object_get(evaluation, "tolerance") != NULL)
    fail(STATUS_USAGE,
         "evaluation %s has a tolerance, so its scores have different settings; verify each "
         "design with the step and precision in its result: verify ROBOT -p dt_s=… --precision …",
         id);
  if (json_object_get(evaluation, "results") == NULL)
    fail(STATUS_USAGE,
         "evaluation %s is too long for one reply; verify some of its designs: verify ROBOT…", id);
  if (!named && !option_is_set(ctl, "environments"))
    fail(STATUS_USAGE, "evaluation %s has custom environments; give them again with --environments",
         id);
  designs_add_genotypes(designs, json_object_get(evaluation, "results"));
  json_object_set_new(
      request, "controller",
      json_sprintf("sha256:%s", text_of(json_object_get(evaluation, "controller"), "sha256")));
  json_object_set(request, "physics", json_object_get(evaluation, "physics"));
  json_object_set(request, "precision", json_object_get(evaluation, "precision"));
  if (named)
    json_object_set(request, "environments", json_object_get(evaluation, "environments"));
}

void run_verify(struct ctl *ctl)
{
  struct designs designs = no_designs();
  json_t *request = keep(json_pack("{s:O, s:b}", "designs", designs.list, "verify", 1));
  const json_t *result;
  const char *earlier = option_text(ctl, "evaluation", NULL);
  size_t agree = 0, differ = 0, absent = 0, i;
  if (earlier == NULL && ctl->n_operands == 0)
    fail(STATUS_USAGE, "nothing to verify: give designs, or --evaluation ID");
  if (earlier != NULL)
    add_evaluation(ctl, &designs, request, earlier);
  for (i = 0; i < ctl->n_operands; i++) {
    const char *operand = ctl->operands[i];
    if (!is_id(operand, strlen(operand)))
      designs_add_operand(&designs, operand);
    else /* in all orientations in which it was scored */
      designs_add_genotypes(
          &designs, json_object_get(get_json(ctl, "/v1/designs/%s", operand), "orientations"));
  }
  request_fill(ctl, request);
  const json_t *evaluation = evaluate(ctl, "/v1/evaluations", request, true);
  expect_success("job", evaluation);
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
    fail(STATUS_NEGATIVE, "%zu stored scores differ from the recomputed ones", differ);
  if (agree == 0)
    fail(STATUS_NEGATIVE, "there are no stored scores to compare with");
}
