/* cmd_study.c: study ask, tell, sampler, finish: a custom search that the server stores. A study is
 * a campaign, so the campaign commands do everything else. */
#include <stdlib.h>
#include <string.h>

#include "base/base64.h"
#include "commands.h"

#define CHILDREN_BYTES_MAX ((size_t)64 << 20)
#define SAMPLER_BYTES_MAX  ((size_t)16 << 20)
#define WAIT_S             50

static json_t *post(struct ctl *ctl, const char *verb, const json_t *request)
{
  struct request how =
      json_request("POST", path_to("/v1/campaigns/%s/%s", ctl->operands[0], verb), request);
  how.wait_s = WAIT_S;
  return keep(send_json(ctl, &how, NULL));
}

/* Adds the comma-separated numbers of an option, if it is given. */
static void fill_numbers(const struct ctl *ctl, const char *name, json_t *request)
{
  const char *text = option_text(ctl, name, NULL);
  if (text == NULL)
    return;
  json_t *numbers = json_array();
  json_object_set_new(request, name, numbers);
  for (const char *at = text; *at != 0;) {
    char *end;
    const long long number = strtoll(at, &end, 10);
    if (end == at || number < 0 || (*end != ',' && *end != 0))
      fail(STATUS_USAGE, "--%s: \"%s\" is not a list of numbers, e.g. 3,17", name, text);
    json_array_append_new(numbers, json_integer(number));
    at = *end == ',' ? end + 1 : end;
  }
}

/* ---- ask ---- */

void run_study_ask(struct ctl *ctl)
{
  char *end;
  const long long n = strtoll(ctl->operands[1], &end, 10);
  const json_t *child;
  size_t i;
  job_id(ctl->operands[0]);
  if (*end != 0 || n < 1)
    fail(STATUS_USAGE, "\"%s\" is not a number of bodies", ctl->operands[1]);
  json_t *request = keep(json_pack("{sI}", "n", (json_int_t)n));
  if (option_is_set(ctl, "random"))
    json_object_set_new(request, "by", json_string("random"));
  fill_numbers(ctl, "parents", request);
  const json_t *asked = post(ctl, "ask", request);
  if (ctl->json)
    print_json(asked);
  else
    json_array_foreach(json_object_get(asked, "children"), i, child)
    {
      put_json(child, JSON_COMPACT);
    }
}

/* ---- study tell ---- */

/* Adds a child: an object with a body, or only a body. */
static void add_child(json_t *children, json_t *value)
{
  if (json_object_get(value, "body") != NULL) {
    json_array_append(children, value);
    return;
  }
  json_object_del(value, "name"); /* for a design in a file */
  json_array_append_new(children, json_pack("{s:O}", "body", value));
}

/* Reads children: JSON objects, one after another or in lists. */
static json_t *read_children(const char *path)
{
  json_t *children = keep(json_array());
  size_t n, at = 0, i;
  const char *bytes = read_input(path, CHILDREN_BYTES_MAX, &n);
  while ((at += strspn(bytes + at, " \t\r\n")) < n) {
    json_error_t error;
    json_t *value = json_loadb(bytes + at, n - at, JSON_DISABLE_EOF_CHECK, &error), *item;
    if (!json_is_object(value) && !json_is_array(value))
      fail(STATUS_USAGE, "%s, byte %zu: %s", path, at + (size_t)error.position,
           value == NULL ? error.text : "expected a child or a list of children");
    if (json_is_object(value))
      add_child(children, value);
    json_array_foreach(value, i, item)
    {
      add_child(children, item);
    }
    at += (size_t)error.position;
    json_decref(value);
  }
  return children;
}

static void fill_sampler(const struct ctl *ctl, json_t *request)
{
  const char *path = option_text(ctl, "sampler", NULL);
  size_t n = 0;
  const char *bytes = path != NULL ? read_input(path, SAMPLER_BYTES_MAX, &n) : NULL;
  if (n == 0)
    return;
  char *text = keep(malloc(MO_BASE64_BYTES(n)));
  mo_base64_encode(bytes, n, text);
  json_object_set_new(request, "sampler_state", json_string(text));
}

/* Adds the number of the next batch, or of --batch. */
static void fill_batch(struct ctl *ctl, json_t *request)
{
  int64_t batch = option_number(ctl, "batch", 0, 100000, -1);
  if (batch < 0) {
    const json_t *campaign = get_json(ctl, "/v1/campaigns/%s", ctl->operands[0]);
    if (!json_is_object(json_object_get(campaign, "study")))
      fail(STATUS_NEGATIVE, "campaign %s is not a study", ctl->operands[0]);
    batch = number_of(json_object_get(campaign, "study"), "next_batch");
  }
  json_object_set_new(request, "batch", json_integer(batch));
}

/* Waits until the batch is committed, which may take days. Keeps only the last reply. */
static const json_t *await_batch(struct ctl *ctl, const json_t *batch)
{
  const char *id = ctl->operands[0];
  const struct request of_job = {.method = "GET", .path = path_to("/v1/jobs/%s", id)},
                       of_batch = {.method = "GET",
                                   .path = path_to("/v1/campaigns/%s/batch", id),
                                   .wait_s = WAIT_S};
  json_t *last = NULL;
  while (strcmp(text_of(batch, "state"), "committed") != 0) {
    json_t *job = send_json(ctl, &of_job, NULL);
    if (is_final(text_of(job, "state")))
      expect_success("study", job);
    json_decref(job);
    json_decref(last);
    batch = last = send_json(ctl, &of_batch, NULL);
  }
  return last != NULL ? keep(last) : batch;
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
    if (json_is_object(json_object_get(note, "fault")) && !ctl->quiet)
      print_from(stderr, note, "child {place} is left out: {fault.pointer}: {fault.detail}");
  }
  say_orientations(ctl, json_object_get(batch, "notes"));
  print_table(stdout, ctl, json_object_get(batch, "children"),
              ">number={number}|design={robot}|operator={operator}|>voxels={voxels}"
              "|>score={score:.4f}");
}

void run_study_tell(struct ctl *ctl)
{
  job_id(ctl->operands[0]);
  json_t *request = keep(json_object());
  json_object_set(request, "children", read_children(ctl->n_operands > 1 ? ctl->operands[1] : "-"));
  fill_batch(ctl, request);
  fill_numbers(ctl, "survivors", request);
  fill_sampler(ctl, request);
  request_fill(ctl, request);
  print_batch(ctl, await_batch(ctl, post(ctl, "tell", request)));
}

/* ---- sampler and finish ---- */

void run_study_sampler(struct ctl *ctl)
{
  save_reply(ctl, path_to("/v1/campaigns/%s/sampler", job_id(ctl->operands[0])),
             "application/octet-stream", option_text(ctl, "output", "-"));
}

void run_study_finish(struct ctl *ctl)
{
  job_id(ctl->operands[0]);
  tell(ctl, post(ctl, "finish", NULL),
       "study {id} is {state}, with {progress.designs:,} design{progress.designs:s}");
}
