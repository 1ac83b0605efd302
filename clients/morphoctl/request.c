/* request.c: makes the body of an evaluation from options, and waits for its end. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "fields.h"
#include "settings.inc"
#include "table.h"
#include "transport.h"

int request_physics(json_t *physics, const char *text)
{
  static const struct {
    const char *key;
    enum field_kind kind;
  } fields[] = {PHYSICS_FIELDS};
  enum { N_FIELDS = sizeof(fields) / sizeof(fields[0]) };
  const char *keys[N_FIELDS];
  const char *equals = strchr(text, '=');
  char key[64];
  if (equals == NULL || equals == text || (size_t)(equals - text) >= sizeof(key))
    return complain(STATUS_USAGE, "--physics: \"%s\" is not KEY=VALUE", text);
  memcpy(key, text, (size_t)(equals - text));
  key[equals - text] = 0;
  size_t k = 0;
  while (k < N_FIELDS && strcmp(fields[k].key, key) != 0)
    k++;
  if (k == N_FIELDS) {
    for (k = 0; k < N_FIELDS; k++)
      keys[k] = fields[k].key;
    const char *near = nearest_name(key, keys, N_FIELDS);
    return complain(STATUS_USAGE, "--physics: there is no \"%s\"%s%s%s", key,
                    near != NULL ? "; did you mean " : "", near != NULL ? near : "",
                    near != NULL ? "?" : "");
  }
  json_t *json = field_value(fields[k].kind, equals + 1);
  if (json == NULL)
    return complain(STATUS_USAGE, "--physics: \"%s\" is not a %s", equals + 1,
                    field_kind_name(fields[k].kind));
  json_object_set_new(physics, key, json);
  return STATUS_OK;
}

int request_fill_physics(const struct ctl *ctl, json_t *request)
{
  json_t *physics = json_object();
  int status = physics != NULL ? STATUS_OK : complain(STATUS_ERROR, "out of memory");
  for (size_t i = 0; i < ctl->n_given && status == STATUS_OK; i++)
    if (strcmp(ctl->given[i].name, "physics") == 0)
      status = request_physics(physics, ctl->given[i].value);
  if (json_object_size(physics) > 0)
    json_object_set(request, "physics", physics);
  json_decref(physics);
  return status;
}

static int fill_environments(const struct ctl *ctl, json_t *request)
{
  const char *name = option_text(ctl, "environments", NULL);
  if (name == NULL)
    return STATUS_OK;
  if (strcmp(name, "paper-test") == 0) {
    json_object_set_new(request, "environments", json_string(name));
    return STATUS_OK;
  }
  char *text;
  size_t length;
  int status = read_input(name, INPUT_BYTES_MAX, &text, &length);
  if (status != STATUS_OK)
    return status;
  json_error_t error;
  json_t *json = json_loadb(text, length, JSON_REJECT_DUPLICATES, &error);
  free(text);
  if (json == NULL)
    return complain(STATUS_USAGE, "%s:%d: %s", name, error.line, error.text);
  json_t *list = json_is_object(json) ? json_object_get(json, "environments") : json;
  if (list == NULL && json_object_get(json, "light_xy_m") != NULL)
    list = json_pack("[O]", json);
  else
    json_incref(list);
  json_decref(json);
  if (!json_is_array(list) && !json_is_string(list)) {
    json_decref(list);
    return complain(
        STATUS_USAGE,
        "%s: not a list of environments: [{\"light_xy_m\": [x, y], \"terrain_heights_m\": […]}, …]",
        name);
  }
  json_object_set_new(request, "environments", list);
  return STATUS_OK;
}

int request_fill(const struct ctl *ctl, json_t *request)
{
  const char *controller = option_text(ctl, "controller", NULL),
             *precision = option_text(ctl, "precision", NULL);
  if (controller != NULL)
    json_object_set_new(request, "controller", json_string(controller));
  if (precision != NULL) {
    if (strcmp(precision, "float32") != 0 && strcmp(precision, "float64") != 0)
      return complain(STATUS_USAGE, "--precision: \"%s\" is not float32 or float64", precision);
    json_object_set_new(request, "precision", json_string(precision));
  }
  int status = request_fill_physics(ctl, request);
  return status == STATUS_OK ? fill_environments(ctl, request) : status;
}

/* Waits until the job is final; each request waits up to a second at the server. */
static int wait_for(struct ctl *ctl, const char *id)
{
  struct progress progress = {0};
  char path[64];
  int status = STATUS_OK;
  snprintf(path, sizeof(path), "/v1/jobs/%s", id);
  catch_interrupts();
  for (;;) {
    json_t *job;
    status = transport_get_json(ctl, path, 1, &job);
    const char *state = text_of(job, "state");
    bool final = is_final(state);
    if (status == STATUS_OK && !final)
      progress_show(&progress, ctl, state, number_of(job, "rollouts_done"),
                    number_of(job, "rollouts_total"));
    bool resting = strcmp(state, "paused") == 0;
    json_decref(job);
    if (status != STATUS_OK || final || interrupted())
      break;
    if (resting)
      pause_s(1);
  }
  progress_end(&progress);
  if (interrupted()) {
    if (!ctl->quiet)
      print_plain_line(
          stderr,
          "The evaluation goes on: morphoctl job show %s; to stop it: morphoctl job cancel %s", id,
          id);
    return STATUS_INTERRUPTED;
  }
  return status;
}

int post_job(struct ctl *ctl, const char *path, const json_t *request, unsigned wait_s,
             json_t **job)
{
  char generated[33], *key_header = NULL;
  const char *key = option_text(ctl, "idempotency-key", NULL);
  *job = NULL;
  if (key == NULL) {
    int status = random_key(generated);
    if (status != STATUS_OK)
      return status;
    key = generated;
  }
  char *body = dump_json(request, JSON_COMPACT);
  if (body == NULL || asprintf(&key_header, "Idempotency-Key: %s", key) < 0) {
    free(body);
    return complain(STATUS_ERROR, "out of memory");
  }
  struct request post = {.method = "POST",
                         .path = path,
                         .content_type = "application/json",
                         .body = body,
                         .body_bytes = strlen(body),
                         .headers = {key_header},
                         .wait_s = wait_s};
  struct reply reply;
  int status = transport_send(ctl, &post, &reply);
  free(body);
  free(key_header);
  if (status == STATUS_OK && (*job = reply_json(&reply)) == NULL)
    status = STATUS_ERROR;
  reply_free(&reply);
  return status;
}

int evaluation_wait(struct ctl *ctl, const char *id, json_t **evaluation)
{
  char path[64];
  snprintf(path, sizeof(path), "/v1/evaluations/%s", id);
  *evaluation = NULL;
  int status = wait_for(ctl, id);
  return status == STATUS_OK ? transport_get_json(ctl, path, 0, evaluation) : status;
}

int evaluate(struct ctl *ctl, const json_t *request, bool wait, json_t **evaluation)
{
  int status = post_job(ctl, "/v1/evaluations", request, wait ? 1 : 0, evaluation);
  if (status != STATUS_OK || !wait || is_final(text_of(*evaluation, "state")))
    return status;
  char id[24];
  snprintf(id, sizeof(id), "%s", text_of(*evaluation, "id"));
  json_decref(*evaluation);
  return evaluation_wait(ctl, id, evaluation);
}
