/* service.c: the state of the service: health, metrics, threads, devices, the contract. All of it
 * is answered on I/O threads. */
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

/* ---- who asks ---- */

void mo_api_get_whoami(struct mo_request *request)
{
  const struct mo_caller *caller = &request->caller;
  struct mo_text text = {0};
  mo_text_object(&text);
  mo_text_member(&text, "name", caller->name[0] != '\0' ? caller->name : NULL);
  mo_text_member(&text, "right", mo_right_words[caller->right]);
  mo_text_member(&text, "dashboard", mo_dashboard_words[mo_api_of(request)->dashboard]);
  mo_text_add(&text, "}");
  mo_reply_json(request, 200, &text);
}

/* ---- what computes ---- */

void mo_api_get_threads(struct mo_request *request)
{
  struct mo_compute *compute = mo_api_of(request)->compute;
  struct mo_compute_stats c;
  struct mo_text text = {0};
  mo_compute_get_stats(compute, &c);
  mo_text_object(&text);
  mo_text_member_count(&text, "n_threads", c.n_workers);
  mo_text_member_count(&text, "n_busy", c.n_busy);
  mo_text_member_count(&text, "blocks_done", c.blocks_done);
  mo_text_member_count(&text, "rollouts_done", c.rollouts_done);
  mo_text_member_count(&text, "rollout_steps", c.rollout_steps);
  mo_text_member_count(&text, "rollouts_diverged", c.rollouts_diverged);
  mo_text_member_count(&text, "blocks_preempted", c.blocks_preempted);
  mo_text_member_count(&text, "queued_batch", c.queued_batch);
  mo_text_member_count(&text, "queued_interactive", c.queued_interactive);
  mo_text_member_count(&text, "thread_bytes_max", c.worker_bytes_max);
  mo_text_member_number(&text, "busy_s", c.busy_s);
  mo_text_add(&text, ",\"fingerprints\":{");
  mo_text_member(&text, "float32", mo_compute_fingerprint(compute, MO_FLOAT32));
  mo_text_member(&text, "float64", mo_compute_fingerprint(compute, MO_FLOAT64));
  mo_text_add(&text, "}}");
  mo_reply_json(request, 200, &text);
}

static void write_device(struct mo_text *text, const struct mo_device_status *status)
{
  const bool works = status->state == MO_DEVICE_WORKS;
  mo_text_object(text);
  mo_text_member_count(text, "index", status->index);
  mo_text_member(text, "name", status->name);
  mo_text_member(text, "id", status->id);
  mo_text_member(text, "state", works ? "working" : "lost");
  mo_text_member(text, "error", works ? NULL : status->error);
  mo_text_member_count(text, "memory_bytes", status->memory_bytes);
  mo_text_member_count(text, "free_bytes", status->free_bytes);
  mo_text_member_count(text, "multiprocessors", status->multiprocessors);
  mo_text_format(text, ",\"capability\":\"%u.%u\"", status->capability / 10,
                 status->capability % 10);
  mo_text_member_bool(text, "busy", status->is_busy);
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
  for (uint32_t i = 0; mo_compute_device(compute, i, &status) == MO_OK; i++)
    write_device(&text, &status);
  mo_text_add(&text, "],\"fingerprints\":{");
  mo_text_member(&text, "scores", mo_compute_device_fingerprint(compute));
  mo_text_member(&text, "gradients", mo_compute_device_gradient_fingerprint(compute));
  mo_text_add(&text, "}}");
  mo_reply_json(request, 200, &text);
}

/* ---- documents ---- */

void mo_api_get_contract(struct mo_request *request)
{
  const struct mo_embedded contract = {mo_openapi_json, mo_openapi_json_size, mo_openapi_gzip,
                                       mo_openapi_gzip_size};
  mo_reply_embedded(request, "application/json", &contract, "openapi-%s",
                    mo_api_of(request)->contract_tag);
}
