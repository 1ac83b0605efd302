/* handle.c: maps routes to handlers; helpers that handlers share; routes that are answered on the
 * I/O thread. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "http/field.h"
#include "http/openapi.h"
#include "http/server.h"

const char *const mo_json_type[1] = {"application/json"};

static enum mo_handled handle_campaign(struct mo_request *request)
{
  bool post = request->method == MO_POST;
  switch (request->route) {
  case MO_ROUTE_CAMPAIGN: return mo_handle_campaign(request);
  case MO_ROUTE_CAMPAIGN_GENERATIONS: return mo_handle_campaign_generations(request);
  case MO_ROUTE_CAMPAIGN_LEARNING: return mo_handle_campaign_learning(request);
  case MO_ROUTE_CAMPAIGN_REPLICATES: return mo_handle_campaign_replicates(request);
  case MO_ROUTE_CAMPAIGN_PHYLOGENY: return mo_handle_campaign_phylogeny(request);
  case MO_ROUTE_CAMPAIGNS: (post ? mo_handle_campaigns_post : mo_handle_campaigns)(request); break;
  case MO_ROUTE_CAMPAIGN_EXTEND: mo_handle_campaign_extend(request); break;
  case MO_ROUTE_CAMPAIGN_POPULATION: mo_handle_campaign_population(request); break;
  case MO_ROUTE_CAMPAIGN_DESIGN: mo_handle_campaign_design(request); break;
  case MO_ROUTE_CAMPAIGN_ANCESTORS: mo_handle_campaign_ancestors(request); break;
  case MO_ROUTE_CAMPAIGN_DESCENDANTS: mo_handle_campaign_descendants(request); break;
  case MO_ROUTE_CAMPAIGN_CHECKPOINTS:
    (request->method == MO_DELETE ? mo_handle_campaign_checkpoints_delete
                                  : mo_handle_campaign_checkpoints)(request);
    break;
  case MO_ROUTE_CAMPAIGN_CHAMPIONS:
    (post ? mo_handle_campaign_champions_post : mo_handle_campaign_champions)(request);
    break;
  default: mo_handle_campaign_change(request); break; /* pause, resume, cancel */
  }
  return MO_HANDLED;
}

enum mo_handled mo_handle(struct mo_request *request)
{
  switch (request->route) {
  case MO_ROUTE_EVALUATIONS: return mo_handle_evaluations_post(request);
  case MO_ROUTE_EVALUATION: return mo_handle_evaluation_get(request);
  case MO_ROUTE_TRAJECTORY: mo_handle_trajectory(request); break;
  case MO_ROUTE_TRAININGS:
    if (request->method == MO_POST)
      mo_handle_trainings_post(request);
    else
      mo_handle_trainings(request);
    break;
  case MO_ROUTE_TRAINING: return mo_handle_training(request);
  case MO_ROUTE_TRAINING_STEPS: mo_handle_training_steps(request); break;
  case MO_ROUTE_TRAINING_VALIDATIONS: mo_handle_training_validations(request); break;
  case MO_ROUTE_TRAINING_CHECKPOINTS:
    if (request->method != MO_DELETE)
      mo_handle_training_checkpoints(request);
    else
      mo_handle_training_checkpoints_delete(request);
    break;
  case MO_ROUTE_TRAINING_CHECKPOINT: mo_handle_training_checkpoints_delete(request); break;
  case MO_ROUTE_TRAINING_CONTROLLER: mo_handle_training_controller(request); break;
  case MO_ROUTE_TRAINING_HELD_OUT: mo_handle_training_held_out(request); break;
  case MO_ROUTE_HELD_OUT: mo_handle_held_out(request); break;
  case MO_ROUTE_CAMPAIGNS:
  case MO_ROUTE_CAMPAIGN:
  case MO_ROUTE_CAMPAIGN_PAUSE:
  case MO_ROUTE_CAMPAIGN_RESUME:
  case MO_ROUTE_CAMPAIGN_CANCEL:
  case MO_ROUTE_CAMPAIGN_EXTEND:
  case MO_ROUTE_CAMPAIGN_GENERATIONS:
  case MO_ROUTE_CAMPAIGN_LEARNING:
  case MO_ROUTE_CAMPAIGN_REPLICATES:
  case MO_ROUTE_CAMPAIGN_POPULATION:
  case MO_ROUTE_CAMPAIGN_DESIGN:
  case MO_ROUTE_CAMPAIGN_ANCESTORS:
  case MO_ROUTE_CAMPAIGN_DESCENDANTS:
  case MO_ROUTE_CAMPAIGN_PHYLOGENY:
  case MO_ROUTE_CAMPAIGN_CHECKPOINTS:
  case MO_ROUTE_CAMPAIGN_CHAMPIONS: return handle_campaign(request);
  case MO_ROUTE_JOBS: mo_handle_jobs(request); break;
  case MO_ROUTE_JOB:
    if (request->method != MO_DELETE)
      return mo_handle_job_get(request);
    mo_handle_job_change(request);
    break;
  case MO_ROUTE_JOB_PAUSE:
  case MO_ROUTE_JOB_RESUME: mo_handle_job_change(request); break;
  case MO_ROUTE_JOB_WEIGHT: mo_handle_job_weight(request); break;
  case MO_ROUTE_DESIGNS: mo_handle_designs(request); break;
  case MO_ROUTE_DESIGN: mo_handle_design(request); break;
  case MO_ROUTE_CONTROLLERS: mo_handle_controllers(request); break;
  case MO_ROUTE_CONTROLLER:
    if (request->method == MO_PUT)
      mo_handle_controller_put(request);
    else if (request->method == MO_DELETE)
      mo_handle_controller_delete(request);
    else
      mo_handle_controller_get(request);
    break;
  case MO_ROUTE_EVENTS: return mo_handle_events(request);
  default: mo_reply_problem(request, 500, NULL, "The route has no handler."); break;
  }
  return MO_HANDLED;
}

/* ---- shared ---- */

bool mo_accepts_json(struct mo_request *request)
{
  if (mo_accept_choose(request->framing.accept, mo_json_type, 1) == 0)
    return true;
  mo_reply_problem(request, 406, NULL,
                   "This path gives application/json, which the Accept field does not allow.");
  return false;
}

bool mo_query_read(struct mo_request *request, const char *const *names,
                   struct mo_query_value *values, size_t n)
{
  const char *query = request->target.query;
  struct mo_query_item item;
  struct mo_faults *faults = calloc(1, sizeof(*faults));
  if (faults == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "request");
    return false;
  }
  for (size_t i = 0; i < n; i++)
    values[i] = (struct mo_query_value){0};
  while (mo_query_next(&query, &item)) {
    char name[64];
    size_t i = n;
    bool good = mo_percent_decode(item.name, item.name_size, true, name, sizeof(name));
    if (good)
      for (i = 0; i < n && strcmp(names[i], name) != 0;)
        i++;
    if (i == n)
      mo_faults_add(faults, MO_FAULT_PARAMETER, good ? name : "?",
                    "this path has no such parameter");
    else if (values[i].present)
      mo_faults_add(faults, MO_FAULT_PARAMETER, name, "the parameter is given more than once");
    else if (!mo_percent_decode(item.value, item.value_size, true, values[i].text,
                                sizeof(values[i].text)))
      mo_faults_add(faults, MO_FAULT_PARAMETER, name,
                    "the value is too long, or not UTF-8 in percent escapes");
    if (i < n)
      values[i].present = true;
  }
  bool good = faults->n == 0;
  if (!good)
    mo_reply_problem(request, 400, faults, NULL);
  free(faults);
  return good;
}

/* Replies 400 about one parameter. */
static void bad_parameter(struct mo_request *request, const char *name, const char *detail)
{
  struct mo_faults *faults = calloc(1, sizeof(*faults));
  if (faults != NULL)
    mo_faults_add(faults, MO_FAULT_PARAMETER, name, "%s", detail);
  mo_reply_problem(request, 400, faults, "%s: %s", name, detail);
  free(faults);
}

void mo_reply_bad_parameter(struct mo_request *request, const char *name, const char *detail)
{
  bad_parameter(request, name, detail);
}

bool mo_query_limit(struct mo_request *request, const struct mo_query_value *value, size_t *limit)
{
  int64_t number = 100;
  if (value->present && !mo_decimal(value->text, strlen(value->text), 1, MO_PAGE_MAX, &number)) {
    bad_parameter(request, "limit", "an integer from 1 to 1000 is expected");
    return false;
  }
  *limit = (size_t)number;
  return true;
}

bool mo_query_number(struct mo_request *request, const char *name,
                     const struct mo_query_value *value, int64_t min, int64_t max, int64_t *number)
{
  char detail[96];
  if (!value->present || mo_decimal(value->text, strlen(value->text), min, max, number))
    return true;
  snprintf(detail, sizeof(detail), "an integer from %lld to %lld is expected", (long long)min,
           (long long)max);
  bad_parameter(request, name, detail);
  return false;
}

bool mo_path_id(struct mo_request *request, unsigned parameter, int64_t *id)
{
  const char *text = request->parameters[parameter];
  if (mo_id(text, id))
    return true;
  mo_reply_problem(request, 404, NULL,
                   "There is no such job: an id is a positive integer in decimal digits.");
  return false;
}

bool mo_query_form(struct mo_request *request, const struct mo_query_value *format,
                   const char *const *names, const char *const *types, int n, int *form)
{
  char list[128] = "";
  for (int i = 0; i < n; i++) {
    if (format->present && strcmp(format->text, names[i]) == 0) {
      *form = i;
      return true;
    }
    size_t at = strlen(list);
    snprintf(list + at, sizeof(list) - at, "%s%s",
             i == 0      ? ""
             : i + 1 < n ? ", "
                         : " or ",
             format->present ? names[i] : types[i]);
  }
  if (!format->present &&
      (*form = mo_accept_choose(request->framing.accept, types, (size_t)n)) >= 0)
    return true;
  if (!format->present) {
    mo_reply_problem(request, 406, NULL,
                     "This path gives %s, which the Accept field does not allow.", list);
    return false;
  }
  snprintf(list + strlen(list), sizeof(list) - strlen(list), " is expected");
  bad_parameter(request, "format", list);
  return false;
}

/* ---- answered on the I/O thread ---- */

static void health(struct mo_request *request)
{
  struct mo_http *http = request->http;
  const char *status = "ok";
  if (request->route == MO_ROUTE_READY) {
    struct mo_store_stats store;
    mo_store_get_stats(http->services.store, &store);
    status = "ready";
    if (!atomic_load(&http->ready))
      mo_reply_problem(request, 503, NULL, "The service is starting or stopping.");
    else if (store.fatal)
      mo_reply_problem(request, 503, NULL, "The service cannot write its store.");
    else if (store.no_space)
      mo_reply_problem(request, 503, NULL, "The disk of the service is full.");
    if (request->reply.status != 0)
      return;
  }
  struct mo_text text = {0};
  mo_text_format(&text, "{\"status\":\"%s\",\"version\":\"%s\"}", status, http->version);
  mo_reply_json(request, 200, &text);
}

static void metrics(struct mo_request *request)
{
  struct mo_text text = {0};
  mo_metrics_write(request->http, &text);
  if (text.failed) {
    mo_text_free(&text);
    mo_reply_error(request, MO_ERR_NO_MEMORY, "request");
    return;
  }
  mo_reply_bytes(request, 200, "text/plain; version=0.0.4; charset=utf-8", text.data, text.size);
}

static void workers(struct mo_request *request)
{
  struct mo_compute *compute = request->http->services.compute;
  struct mo_compute_stats c;
  struct mo_text text = {0};
  if (!mo_accepts_json(request))
    return;
  mo_compute_get_stats(compute, &c);
  mo_text_format(&text,
                 "{\"n_workers\":%u,\"n_busy\":%u,\"blocks_done\":%llu,\"rollouts_done\":%llu,"
                 "\"rollout_steps\":%llu,"
                 "\"rollouts_diverged\":%llu,\"blocks_preempted\":%llu,\"queued_batch\":%llu,"
                 "\"queued_interactive\":%llu,"
                 "\"worker_bytes_max\":%zu,\"busy_s\":",
                 c.n_workers, c.n_busy, (unsigned long long)c.blocks_done,
                 (unsigned long long)c.rollouts_done, (unsigned long long)c.rollout_steps,
                 (unsigned long long)c.rollouts_diverged, (unsigned long long)c.blocks_preempted,
                 (unsigned long long)c.queued_batch, (unsigned long long)c.queued_interactive,
                 c.worker_bytes_max);
  mo_text_json_number(&text, c.busy_s);
  for (int precision = 0; precision < 2; precision++) {
    const char *fingerprint =
        mo_compute_fingerprint(compute, precision == 0 ? MO_FLOAT32 : MO_FLOAT64);
    mo_text_add(&text, precision == 0 ? ",\"fingerprints\":{\"float32\":" : ",\"float64\":");
    mo_text_json_string(&text, fingerprint, strlen(fingerprint));
  }
  mo_text_add(&text, "}}");
  mo_reply_json(request, 200, &text);
}

static const char index_page[] =
    "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>morphod</title>\n"
    "<style>body{font-family:sans-serif;max-width:40em;margin:3em "
    "auto;line-height:1.5}</style></head>\n"
    "<body><h1>morphod</h1>\n<p>Scores of voxel robots, durable and the same for ever.</p>\n<ul>\n"
    "<li><a href=\"/openapi.json\">The HTTP contract</a> (OpenAPI 3.1)</li>\n"
    "<li><a href=\"/v1/jobs\">Jobs</a>, <a href=\"/v1/trainings\">trainings</a>, <a "
    "href=\"/v1/campaigns\">campaigns</a>, <a href=\"/v1/designs\">designs</a>, "
    "<a "
    "href=\"/v1/controllers\">controllers</a>, "
    "<a href=\"/v1/workers\">workers</a>, <a href=\"/v1/devices\">devices</a></li>\n"
    "<li><a href=\"/healthz\">Health</a>, <a href=\"/readyz\">readiness</a>, <a "
    "href=\"/metrics\">metrics</a></li>\n"
    "</ul></body></html>\n";

void mo_handle_direct(struct mo_request *request)
{
  struct mo_query_value none;
  if (!mo_query_read(request, NULL, &none, 0))
    return;
  switch (request->route) {
  case MO_ROUTE_HEALTH:
  case MO_ROUTE_READY: health(request); break;
  case MO_ROUTE_METRICS: metrics(request); break;
  case MO_ROUTE_WORKERS: workers(request); break;
  case MO_ROUTE_DEVICES: mo_handle_devices(request); break;
  case MO_ROUTE_OPENAPI:
    mo_reply_static(request, 200, "application/json", mo_openapi_json, mo_openapi_json_size);
    mo_reply_etag(request, "openapi-%s", request->http->contract_tag);
    break;
  default:
    mo_reply_static(request, 200, "text/html; charset=utf-8", index_page, sizeof(index_page) - 1);
    break;
  }
}
