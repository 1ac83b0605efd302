/* cmd_study.c: study ask, tell, sampler, finish: a search of one's own that the server keeps. All
 * else is done by the commands of campaigns, of which a study is one. */
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "table.h"
#include "transport.h"

#define CHILDREN_BYTES_MAX ((size_t)64 << 20)
#define SAMPLER_BYTES_MAX  ((size_t)16 << 20)
#define WAIT_S             50

/* Posts to a path below the study; the request may be repeated. */
static int post(struct ctl *ctl, const char *verb, const json_t *request, json_t **reply)
{
  char *path = format_text("/v1/campaigns/%s/%s", ctl->operands[0], verb);
  char *body = request != NULL ? dump_json(request, JSON_COMPACT) : NULL;
  const int status = send_json(ctl,
                               &(struct request){.method = "POST",
                                                 .path = path,
                                                 .content_type = "application/json",
                                                 .body = body,
                                                 .body_bytes = body != NULL ? strlen(body) : 0,
                                                 .wait_s = WAIT_S,
                                                 .repeatable = true},
                               NULL, reply);
  free(body);
  free(path);
  return status;
}

/* Reads numbers that commas separate. NULL: not such numbers, and a message was printed. */
static json_t *numbers_of(const char *name, const char *text)
{
  json_t *numbers = json_array();
  const char *at = text;
  while (*at != 0) {
    char *end;
    const long long number = strtoll(at, &end, 10);
    if (end == at || number < 0 || (*end != ',' && *end != 0)) {
      complain(STATUS_USAGE, "--%s: \"%s\" is not a list of numbers, e.g. 3,17", name, text);
      json_decref(numbers);
      return NULL;
    }
    json_array_append_new(numbers, json_integer(number));
    at = *end == ',' ? end + 1 : end;
  }
  return numbers;
}

/* Adds the numbers of an option, if it is given. */
static int fill_numbers(const struct ctl *ctl, const char *name, json_t *request)
{
  const char *text = option_text(ctl, name, NULL);
  json_t *numbers = text != NULL ? numbers_of(name, text) : NULL;
  if (numbers != NULL)
    json_object_set_new(request, name, numbers);
  return text == NULL || numbers != NULL ? STATUS_OK : STATUS_USAGE;
}

/* ---- ask ---- */

int run_study_ask(struct ctl *ctl)
{
  char *end;
  const long long n = strtoll(ctl->operands[1], &end, 10);
  json_t *request, *asked = NULL, *child;
  size_t i;
  if (!check_job_id(ctl->operands[0]))
    return STATUS_USAGE;
  if (*end != 0 || n < 1)
    return complain(STATUS_USAGE, "\"%s\" is not a number of bodies", ctl->operands[1]);
  request = json_pack("{sI}", "n", (json_int_t)n);
  if (option_is_set(ctl, "random"))
    json_object_set_new(request, "by", json_string("random"));
  int status = fill_numbers(ctl, "parents", request);
  if (status == STATUS_OK)
    status = post(ctl, "ask", request, &asked);
  if (status == STATUS_OK && ctl->json)
    print_json(asked);
  else
    json_array_foreach(json_object_get(asked, "children"), i, child)
    {
      put_json(child, JSON_COMPACT);
    }
  json_decref(request);
  json_decref(asked);
  return status;
}

/* ---- tell ---- */

/* Adds a child: an object with a body, or a body alone. */
static void add_child(json_t *children, json_t *value)
{
  if (json_object_get(value, "body") != NULL) {
    json_array_append(children, value);
    return;
  }
  json_object_del(value, "name"); /* of a design in a file */
  json_array_append_new(children, json_pack("{s:O}", "body", value));
}

/* Reads children: JSON objects, one after the other or in lists. */
static int read_children(const char *path, json_t *children)
{
  char *bytes = NULL;
  size_t n = 0, at = 0, i;
  int status = read_input(path, CHILDREN_BYTES_MAX, &bytes, &n);
  while (status == STATUS_OK && (at += strspn(bytes + at, " \t\r\n")) < n) {
    json_error_t error;
    json_t *value = json_loadb(bytes + at, n - at, JSON_DISABLE_EOF_CHECK, &error), *item;
    if (!json_is_object(value) && !json_is_array(value))
      status = complain(STATUS_USAGE, "%s, byte %zu: %s", path, at + (size_t)error.position,
                        value == NULL ? error.text : "a child, or a list of children, is expected");
    if (json_is_object(value))
      add_child(children, value);
    json_array_foreach(value, i, item)
    {
      add_child(children, item);
    }
    at += (size_t)error.position;
    json_decref(value);
  }
  free(bytes);
  return status;
}

/* Returns bytes in Base64 (malloc). */
static char *base64_of(const unsigned char *bytes, size_t n)
{
  static const char digits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  char *text = need(malloc((n + 2) / 3 * 4 + 1)), *to = text;
  for (size_t i = 0; i < n; i += 3) {
    const size_t left = n - i;
    const unsigned bits = (unsigned)bytes[i] << 16 | (left > 1 ? (unsigned)bytes[i + 1] << 8 : 0) |
                          (left > 2 ? bytes[i + 2] : 0);
    *to++ = digits[bits >> 18];
    *to++ = digits[bits >> 12 & 63];
    *to++ = '=';
    *to++ = '=';
    if (left > 1)
      to[-2] = digits[bits >> 6 & 63];
    if (left > 2)
      to[-1] = digits[bits & 63];
  }
  *to = 0;
  return text;
}

/* Adds the bytes of the file --sampler. */
static int fill_sampler(const struct ctl *ctl, json_t *request)
{
  const char *path = option_text(ctl, "sampler", NULL);
  char *bytes = NULL;
  size_t n = 0;
  int status = path != NULL ? read_input(path, SAMPLER_BYTES_MAX, &bytes, &n) : STATUS_OK;
  if (status == STATUS_OK && n > 0) {
    char *text = base64_of((const unsigned char *)bytes, n);
    json_object_set_new(request, "sampler_state", json_string(text));
    free(text);
  }
  free(bytes);
  return status;
}

/* Adds the number of the next batch, or of --batch. */
static int fill_batch(struct ctl *ctl, json_t *request)
{
  int64_t batch = -1;
  json_t *campaign = NULL;
  if (!option_number(ctl, "batch", 0, 100000, &batch))
    return STATUS_USAGE;
  int status =
      batch < 0 ? get_json(ctl, &campaign, "/v1/campaigns/%s", ctl->operands[0]) : STATUS_OK;
  if (campaign != NULL && !json_is_object(json_object_get(campaign, "study")))
    status = complain(STATUS_NEGATIVE, "campaign %s is no study", ctl->operands[0]);
  else if (campaign != NULL)
    batch = number_of(json_object_get(campaign, "study"), "next_batch");
  json_object_set_new(request, "batch", json_integer(batch));
  json_decref(campaign);
  return status;
}

/* Waits until the batch is committed. */
static int await_batch(struct ctl *ctl, json_t **batch)
{
  char *path = format_text("/v1/campaigns/%s/batch", ctl->operands[0]);
  int status = STATUS_OK;
  while (status == STATUS_OK && strcmp(text_of(*batch, "state"), "committed") != 0) {
    json_t *job = NULL;
    status = get_json(ctl, &job, "/v1/jobs/%s", ctl->operands[0]);
    if (status == STATUS_OK && is_final(text_of(job, "state")))
      status = job_outcome("study", job);
    json_decref(job);
    json_decref(*batch);
    *batch = NULL;
    if (status == STATUS_OK)
      status = send_json(ctl, &(struct request){.method = "GET", .path = path, .wait_s = WAIT_S},
                         NULL, batch);
  }
  free(path);
  return status;
}

static void print_batch(const struct ctl *ctl, const json_t *batch)
{
  const json_t *note;
  size_t i;
  if (ctl->json) {
    print_json(batch);
    return;
  }
  json_array_foreach(json_object_get(batch, "notes"), i, note)
  {
    const json_t *fault = json_object_get(note, "fault");
    if (json_is_object(fault) && !ctl->quiet)
      print_plain_line(stderr, "child %" JSON_INTEGER_FORMAT " is left out: %s: %s",
                       (json_int_t)number_of(note, "place"), text_of(fault, "pointer"),
                       text_of(fault, "detail"));
  }
  print_table(stdout, ctl, json_object_get(batch, "children"),
              ">number={number}|design={id}|operator={operator}|>voxels={voxels}"
              "|>score={score:.4f}");
}

int run_study_tell(struct ctl *ctl)
{
  json_t *request = json_object(), *children = json_array(), *batch = NULL;
  int status = check_job_id(ctl->operands[0]) ? STATUS_OK : STATUS_USAGE;
  json_object_set(request, "children", children);
  if (status == STATUS_OK)
    status = read_children(ctl->n_operands > 1 ? ctl->operands[1] : "-", children);
  if (status == STATUS_OK)
    status = fill_batch(ctl, request);
  if (status == STATUS_OK)
    status = fill_numbers(ctl, "survivors", request);
  if (status == STATUS_OK)
    status = fill_sampler(ctl, request);
  if (status == STATUS_OK)
    status = fill_fields(ctl, request);
  if (status == STATUS_OK)
    status = post(ctl, "tell", request, &batch);
  if (status == STATUS_OK)
    status = await_batch(ctl, &batch);
  if (status == STATUS_OK)
    print_batch(ctl, batch);
  json_decref(request);
  json_decref(children);
  json_decref(batch);
  return status;
}

/* ---- the rest ---- */

int run_study_sampler(struct ctl *ctl)
{
  if (!check_job_id(ctl->operands[0]))
    return STATUS_USAGE;
  char *path = format_text("/v1/campaigns/%s/sampler", ctl->operands[0]);
  const int status =
      save_reply(ctl, path, "application/octet-stream", option_text(ctl, "output", "-"));
  free(path);
  return status;
}

int run_study_finish(struct ctl *ctl)
{
  json_t *campaign = NULL;
  if (!check_job_id(ctl->operands[0]))
    return STATUS_USAGE;
  const int status = post(ctl, "finish", NULL, &campaign);
  if (campaign != NULL)
    tell(ctl, campaign, "study {id} is {state}, with {progress.designs:,} designs");
  json_decref(campaign);
  return status;
}
