/* service.c: the state of the service: health, metrics, threads, devices, the contract. All of it
 * is answered on I/O threads. */
#include <string.h>

#include "api/handlers.h"
#include "api/openapi.h"

/* ---- health ---- */

static void reply_health(struct mo_request *request, const char *status)
{
  struct mo_text text = {0};
  mo_text_format(&text, "{\"status\":\"%s\",\"version\":\"%s\"}", status,
                 mo_api_of(request)->version);
  mo_reply_json(request, 200, &text);
}

void mo_api_get_health(struct mo_request *request)
{
  reply_health(request, "ok");
}

void mo_api_get_readiness(struct mo_request *request)
{
  struct mo_api *api = mo_api_of(request);
  struct mo_store_stats store;
  mo_store_get_stats(api->store, &store);
  if (!mo_http_is_ready(api->http))
    mo_reply_problem(request, 503, NULL, "The service is starting or stopping.");
  else if (store.fatal)
    mo_reply_problem(request, 503, NULL, "The service cannot write its store.");
  else if (store.no_space)
    mo_reply_problem(request, 503, NULL, "The disk of the service is full.");
  else
    reply_health(request, "ready");
}

void mo_api_get_metrics(struct mo_request *request)
{
  struct mo_text text = {0};
  mo_api_metrics_write(mo_api_of(request), &text);
  if (text.failed) {
    mo_text_free(&text);
    mo_reply_error(request, MO_ERR_NO_MEMORY, "request");
    return;
  }
  mo_reply_bytes(request, 200, "text/plain; version=0.0.4; charset=utf-8", text.data, text.size);
}

/* ---- what computes ---- */

void mo_api_get_threads(struct mo_request *request)
{
  struct mo_compute *compute = mo_api_of(request)->compute;
  struct mo_compute_stats c;
  struct mo_text text = {0};
  mo_compute_get_stats(compute, &c);
  mo_text_format(&text,
                 "{\"n_threads\":%u,\"n_busy\":%u,\"blocks_done\":%llu,\"rollouts_done\":%llu,"
                 "\"rollout_steps\":%llu,"
                 "\"rollouts_diverged\":%llu,\"blocks_preempted\":%llu,\"queued_batch\":%llu,"
                 "\"queued_interactive\":%llu,"
                 "\"thread_bytes_max\":%zu,\"busy_s\":",
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

static void write_fingerprint(struct mo_text *text, const char *name, const char *fingerprint)
{
  mo_text_format(text, "\"%s\":", name);
  if (fingerprint != NULL)
    mo_text_json_string(text, fingerprint, strlen(fingerprint));
  else
    mo_text_add(text, "null");
}

static void write_device(struct mo_text *text, const struct mo_device_status *status)
{
  mo_text_format(text, "{\"index\":%u", status->index);
  mo_text_member(text, "name", status->name);
  mo_text_member(text, "id", status->id);
  mo_text_member(text, "state", status->state == MO_DEVICE_WORKS ? "working" : "lost");
  if (status->state == MO_DEVICE_WORKS)
    mo_text_add(text, ",\"error\":null");
  else
    mo_text_member(text, "error", status->error);
  mo_text_member_count(text, "memory_bytes", status->memory_bytes);
  mo_text_member_count(text, "free_bytes", status->free_bytes);
  mo_text_member_count(text, "multiprocessors", status->multiprocessors);
  mo_text_format(text, ",\"capability\":\"%u.%u\",\"busy\":%s", status->capability / 10,
                 status->capability % 10, status->is_busy ? "true" : "false");
  mo_text_member_number(text, "load", status->load);
  mo_text_member_number(text, "busy_s", status->busy_s);
  mo_text_member_count(text, "calls", status->calls);
  mo_text_member_count(text, "rollouts_done", status->rollouts_done);
  mo_text_member_count(text, "gradient_robots_done", status->gradient_robots_done);
  mo_text_member_count(text, "rollouts_at_once", status->rows_at_once);
  mo_text_add(text, "}");
}

void mo_api_get_devices(struct mo_request *request)
{
  struct mo_compute *compute = mo_api_of(request)->compute;
  struct mo_device_status status;
  struct mo_text text = {0};
  mo_text_add(&text, "{\"items\":[");
  for (uint32_t i = 0; mo_compute_device(compute, i, &status) == MO_OK; i++) {
    mo_text_add(&text, i > 0 ? "," : "");
    write_device(&text, &status);
  }
  mo_text_add(&text, "],\"fingerprints\":{");
  write_fingerprint(&text, "scores", mo_compute_device_fingerprint(compute));
  mo_text_add(&text, ",");
  write_fingerprint(&text, "gradients", mo_compute_device_gradient_fingerprint(compute));
  mo_text_add(&text, "}}");
  mo_reply_json(request, 200, &text);
}

/* ---- documents ---- */

void mo_api_get_contract(struct mo_request *request)
{
  mo_reply_static(request, 200, "application/json", mo_openapi_json, mo_openapi_json_size);
  mo_reply_etag(request, "openapi-%s", mo_api_of(request)->contract_tag);
}

static const char index_page[] =
    "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>morphod</title>\n"
    "<style>body{font-family:sans-serif;max-width:40em;margin:3em "
    "auto;line-height:1.5}</style></head>\n"
    "<body><h1>morphod</h1>\n<p>Scores of voxel robots, durable, and never different.</p>\n<ul>\n"
    "<li><a href=\"/openapi.json\">The HTTP contract</a> (OpenAPI 3.1)</li>\n"
    "<li><a href=\"/v1/jobs\">Jobs</a>, <a href=\"/v1/evaluations\">evaluations</a>, <a "
    "href=\"/v1/trainings\">trainings</a>, <a href=\"/v1/campaigns\">campaigns</a>, <a "
    "href=\"/v1/designs\">designs</a>, <a href=\"/v1/controllers\">controllers</a>, <a "
    "href=\"/v1/threads\">threads</a>, <a href=\"/v1/devices\">devices</a></li>\n"
    "<li><a href=\"/healthz\">Health</a>, <a href=\"/readyz\">readiness</a>, <a "
    "href=\"/metrics\">metrics</a></li>\n"
    "</ul></body></html>\n";

void mo_api_get_index(struct mo_request *request)
{
  mo_reply_static(request, 200, "text/html; charset=utf-8", index_page, sizeof(index_page) - 1);
  mo_reply_extra(request, "Content-Security-Policy",
                 "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'");
}
