/* cmd_eval.c: eval and verify. */
#include <errno.h>
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "commands.h"
#include "fields.h"
#include "table.h"
#include "transport.h"

static int fill_record(const struct ctl *ctl, json_t *request)
{
  const char *record = option_text(ctl, "record", NULL);
  int64_t stride = 10;
  if (record == NULL) {
    if (option_is_set(ctl, "record-stride") || option_is_set(ctl, "output"))
      return complain(STATUS_USAGE,
                      "--record-stride and --output need --record com, masses or com,masses");
    return STATUS_OK;
  }
  json_t *list = json_array();
  for (const char *c = record; *c != 0;) {
    size_t length = strcspn(c, ",");
    if (length == 3 && strncmp(c, "com", 3) == 0)
      json_array_append_new(list, json_string("com"));
    else if (length == 6 && strncmp(c, "masses", 6) == 0)
      json_array_append_new(list, json_string("masses"));
    else {
      json_decref(list);
      return complain(STATUS_USAGE, "--record: \"%s\" is not com, masses or com,masses", record);
    }
    c += length + (c[length] == ',');
  }
  json_object_set_new(request, "record", list);
  if (!option_number(ctl, "record-stride", 1, 1000000, &stride))
    return STATUS_USAGE;
  if (option_is_set(ctl, "record-stride"))
    json_object_set_new(request, "record_stride", json_integer(stride));
  return STATUS_OK;
}

static int write_file(const char *path, const void *head, size_t head_bytes, const void *bytes,
                      size_t n)
{
  FILE *file = fopen(path, "we");
  bool ok = file != NULL && fwrite(head, 1, head_bytes, file) == head_bytes &&
            fwrite(bytes, 1, n, file) == n;
  int error = errno;
  if (file != NULL && fclose(file) != 0) {
    ok = false;
    error = errno;
  }
  return ok ? STATUS_OK : complain(STATUS_ERROR, "%s: %s", path, strerror(error));
}

/* Writes the header of a NumPy .npy file, version 1: magic, version, length of the header, header
 * padded to 64 bytes. The numbers follow. */
static size_t npy_head(const char *shape, char head[256])
{
  char text[200];
  int n = snprintf(text, sizeof(text), "{'descr': '<f4', 'fortran_order': False, 'shape': (%s), }",
                   shape);
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
  char path[160], *file = NULL;
  snprintf(path, sizeof(path), "/v1/evaluations/%s/trajectories/%zu/file?environment=%zu&array=%s",
           id, design, environment, array);
  struct reply reply;
  int status = transport_send(
      ctl, &(struct request){.method = "GET", .path = path, .accept = "application/octet-stream"},
      &reply);
  if (status == STATUS_OK && strspn(reply.shape, "0123456789,") != strlen(reply.shape))
    status = complain(STATUS_ERROR, "the server's reply has no shape");
  if (status == STATUS_OK) {
    char head[256];
    size_t n = npy_head(reply.shape, head);
    if (asprintf(&file, "%s/design-%04zu-environment-%02zu-%s.npy", folder, design, environment,
                 array) < 0)
      status = complain(STATUS_ERROR, "out of memory");
    else
      status = write_file(file, head, n, reply.body != NULL ? reply.body : "", reply.body_bytes);
  }
  free(file);
  reply_free(&reply);
  return status;
}

int save_trajectories(struct ctl *ctl, const json_t *evaluation, const char *folder)
{
  if (mkdir(folder, 0777) != 0 && errno != EEXIST)
    return complain(STATUS_ERROR, "%s: %s", folder, strerror(errno));
  int status = STATUS_OK;
  char *path = NULL, *text = dump_json(evaluation, JSON_INDENT(1));
  if (text == NULL || asprintf(&path, "%s/evaluation.json", folder) < 0)
    status = complain(STATUS_ERROR, "out of memory");
  else
    status = write_file(path, "", 0, text, strlen(text));
  free(text);
  free(path);
  const json_t *results = json_object_get(evaluation, "results"),
               *record = json_object_get(evaluation, "record");
  size_t n_files = 0;
  for (size_t i = 0; i < json_array_size(results) && status == STATUS_OK; i++) {
    size_t n_environments = json_array_size(json_object_get(json_array_get(results, i), "losses"));
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

static int read_designs(struct ctl *ctl, struct designs *designs)
{
  int64_t n_random = 0, seed = 1;
  int status = STATUS_OK;
  if (!option_number(ctl, "random", 1, DESIGNS_MAX, &n_random) ||
      !option_number(ctl, "seed", 0, INT64_MAX, &seed))
    return STATUS_USAGE;
  for (size_t i = 0; i < ctl->n_operands && status == STATUS_OK; i++)
    status = designs_add_operand(designs, ctl->operands[i]);
  if (status == STATUS_OK && ctl->n_operands == 0 && n_random == 0)
    status = designs_add_operand(designs, "-");
  if (status == STATUS_OK && n_random > 0)
    status = designs_add_random(designs, (uint64_t)seed, (size_t)n_random);
  return status;
}

int run_eval(struct ctl *ctl)
{
  struct designs designs = {0};
  json_t *request = json_object(), *evaluation = NULL;
  bool wait = !option_is_set(ctl, "no-wait");
  int64_t top = 0;
  const char *sort = option_text(ctl, "sort", "input"), *output = option_text(ctl, "output", NULL);
  int status = read_designs(ctl, &designs);
  if (status == STATUS_OK && !option_number(ctl, "top", 1, DESIGNS_MAX, &top))
    status = STATUS_USAGE;
  if (status == STATUS_OK && strcmp(sort, "input") != 0 && strcmp(sort, "score") != 0)
    status = complain(STATUS_USAGE, "--sort: \"%s\" is not input or score", sort);
  if (status == STATUS_OK && output != NULL && !wait)
    status = complain(STATUS_USAGE, "--output needs the result: it goes with --wait");
  if (status == STATUS_OK)
    status = request_fill(ctl, request);
  if (status == STATUS_OK)
    status = fill_record(ctl, request);
  if (status == STATUS_OK) {
    json_object_set(request, "designs", designs.list);
    status = fill_fields(ctl, request);
  }
  if (status == STATUS_OK)
    status = evaluate(ctl, request, wait, &evaluation);
  if (status == STATUS_OK && !wait) {
    if (ctl->json)
      print_json(evaluation);
    else
      print_plain_line(stdout, "%s", text_of(evaluation, "id"));
    if (!ctl->json && !ctl->quiet)
      print_plain_line(stderr,
                       "evaluation %s is accepted: %zu designs, %" PRId64
                       " rollouts; morphoctl watch %s",
                       text_of(evaluation, "id"), designs.n,
                       number_of(evaluation, "rollouts_total"), text_of(evaluation, "id"));
  } else if (status == STATUS_OK) {
    if (ctl->json)
      print_json(evaluation);
    else if (json_object_get(evaluation, "results") != NULL)
      print_results(ctl, evaluation, designs.named ? designs.names : NULL,
                    strcmp(sort, "score") == 0 || top > 0, (size_t)top);
    if (!ctl->json && !ctl->quiet) {
      char a[32], b[32];
      print_plain_line(stderr, "evaluation %s: %s rollouts, %s of them from the store",
                       text_of(evaluation, "id"),
                       count_text(number_of(evaluation, "rollouts_total"), a),
                       count_text(number_of(evaluation, "rollouts_cached"), b));
    }
    status = job_outcome("job", evaluation);
    if (status == STATUS_OK && output != NULL)
      status = save_trajectories(ctl, evaluation, output);
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
  char path[80];
  json_t *design;
  snprintf(path, sizeof(path), "/v1/designs/%s", id);
  int status = transport_get_json(ctl, path, 0, &design);
  size_t i;
  json_t *orientation;
  json_array_foreach(json_object_get(design, "orientations"), i, orientation)
  {
    const char *genotype = text_of(orientation, "genotype");
    if (status == STATUS_OK)
      status = designs_add_text(designs, "the server's reply", genotype, strlen(genotype));
  }
  json_decref(design);
  return status;
}

/* Adds what an earlier evaluation requested. */
static int add_evaluation(struct ctl *ctl, struct designs *designs, json_t *request, const char *id)
{
  char path[64];
  json_t *evaluation;
  if (!check_job_id(id))
    return STATUS_USAGE;
  snprintf(path, sizeof(path), "/v1/evaluations/%s", id);
  int status = transport_get_json(ctl, path, 0, &evaluation);
  if (status == STATUS_OK)
    status = job_outcome("job", evaluation);
  if (status == STATUS_OK && !json_is_string(json_object_get(evaluation, "environments")) &&
      !option_is_set(ctl, "environments"))
    status = complain(
        STATUS_USAGE,
        "evaluation %s has environments of its own: give them again with --environments", id);
  size_t i;
  json_t *result;
  json_array_foreach(json_object_get(evaluation, "results"), i, result)
  {
    const char *genotype = text_of(result, "genotype");
    if (status == STATUS_OK)
      status = designs_add_text(designs, "the server's reply", genotype, strlen(genotype));
  }
  if (status == STATUS_OK) {
    char controller[80];
    snprintf(controller, sizeof(controller), "sha256:%s",
             text_of(json_object_get(evaluation, "controller"), "sha256"));
    json_object_set_new(request, "controller", json_string(controller));
    json_object_set(request, "physics", json_object_get(evaluation, "physics"));
    json_object_set(request, "precision", json_object_get(evaluation, "precision"));
    if (json_is_string(json_object_get(evaluation, "environments")))
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
    status = evaluate(ctl, request, true, &evaluation);
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
    if (ctl->json)
      print_json(evaluation);
    else
      print_results(ctl, evaluation, designs.named ? designs.names : NULL, false, 0);
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
