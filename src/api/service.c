/* service.c: the state of the service: health, metrics, threads, devices, load; the contract; and
 * the pages about the types of problems. All replies are made on I/O threads. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "api/handlers.h"
#include "api/openapi.h"
#include "base/clock.h"
#include "base/thread.h"

#define SAMPLE_US 10000000 /* time between two samples of the load */
#define HEADING   "\n## "  /* begins a section of docs/problems.md */

/* ---- health ---- */

static void reply_health(struct mo_request *request, const char *status)
{
  struct mo_text text = {0};
  struct mo_store_stats store;
  mo_store_get_stats(mo_api_of(request)->store, &store);
  mo_text_object(&text);
  mo_text_member(&text, "status", status);
  mo_text_member(&text, "version", mo_api_of(request)->version);
  mo_text_member(&text, "notice",
                 store.clock_ahead_us > 0
                     ? "the clock is not credible, so no jobs are deleted by age; set the clock, "
                       "or confirm it with morphod store accept-clock"
                     : NULL);
  mo_text_add(&text, "}");
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

/* ---- the caller ---- */

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

/* ---- threads and devices ---- */

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

void mo_api_get_rates(struct mo_request *request)
{
  struct mo_rate rates[MO_RATES_MAX];
  const uint32_t n = mo_compute_get_rates(mo_api_of(request)->compute, rates);
  struct mo_text text = {0};
  mo_text_add(&text, "{\"items\":[");
  for (const struct mo_rate *rate = rates; rate < rates + n; rate++) {
    mo_text_object(&text);
    mo_text_member(&text, "work", rate->is_gradient ? "gradients" : "rollouts");
    mo_text_member(&text, "device", rate->back_end == MO_ON_CPU ? "cpu" : "cuda");
    mo_text_member(&text, "precision", rate->precision == MO_FLOAT32 ? "float32" : "float64");
    mo_text_member(&text, "integrator",
                   rate->integrator == MO_INTEGRATOR_SPLIT ? "split" : "paper");
    mo_text_member_number(&text, "dt_s", rate->dt_s);
    mo_text_member_number(&text, "control_period_s", rate->control_period_s);
    mo_text_member_count(&text, "blocks", rate->blocks);
    mo_text_member_count(&text, "rollouts", rate->rollouts);
    mo_text_member_count(&text, "steps", rate->steps);
    mo_text_member_number(&text, "springs", (double)rate->spring_steps / (double)rate->steps);
    mo_text_member_number(&text, "seconds", rate->busy_s);
    mo_text_add(&text, "}");
  }
  mo_text_add(&text, "]}");
  mo_reply_json(request, 200, &text);
}

/* ---- load: a ring of samples that covers an hour and is lost in a restart ---- */

/* Adds a sample when one is due. Runs on the clock thread. */
void mo_load_sample(struct mo_api *api)
{
  struct mo_load *load = &api->load;
  const int64_t now_us = mo_clock_us();
  struct mo_compute_stats stats;
  if (load->sampled_us != 0 && now_us - load->sampled_us < SAMPLE_US)
    return;
  mo_compute_get_stats(api->compute, &stats);
  if (load->sampled_us != 0) {
    const double seconds = (double)(now_us - load->sampled_us) * 1e-6;
    struct mo_load_sample *sample = &load->samples[load->n % MO_LOAD_SAMPLES];
    double devices = 0;
    const uint32_t n = mo_compute_devices(api->compute);
    for (uint32_t i = 0; i < n; i++) {
      struct mo_device_status status;
      if (mo_compute_device(api->compute, i, &status) == MO_OK)
        devices += status.load;
    }
    MO_GUARD(&load->mutex);
    *sample = (struct mo_load_sample){
        .at_us = now_us,
        .busy_share = fmin(1, (stats.busy_s - load->busy_s) / seconds / stats.n_workers),
        .device_share = n > 0 ? devices / n : NAN,
        .rollouts_per_s = (double)(stats.rollouts_done - load->rollouts) / seconds};
    load->n++;
  }
  load->sampled_us = now_us;
  load->busy_s = stats.busy_s;
  load->rollouts = stats.rollouts_done;
}

void mo_api_get_load(struct mo_request *request)
{
  struct mo_load *load = &mo_api_of(request)->load;
  const int64_t now_us = mo_clock_us();
  struct mo_text text = {0};
  int64_t seconds = 600;
  if (!mo_query_number(request, "seconds", 1, MO_LOAD_SAMPLES * (SAMPLE_US / 1000000), &seconds))
    return;
  mo_text_add(&text, "{\"items\":[");
  pthread_mutex_lock(&load->mutex);
  for (uint64_t i = load->n > MO_LOAD_SAMPLES ? load->n - MO_LOAD_SAMPLES : 0; i < load->n; i++) {
    const struct mo_load_sample *sample = &load->samples[i % MO_LOAD_SAMPLES];
    const double age_s = (double)(now_us - sample->at_us) * 1e-6;
    if (age_s > (double)seconds)
      continue;
    mo_text_object(&text);
    mo_text_member_number(&text, "age_s", round(age_s * 10) / 10);
    mo_text_member_number(&text, "busy_share", round(sample->busy_share * 1e4) / 1e4);
    mo_text_member_number(&text, "device_share", sample->device_share);
    mo_text_member_number(&text, "rollouts_per_s", round(sample->rollouts_per_s * 10) / 10);
    mo_text_add(&text, "}");
  }
  pthread_mutex_unlock(&load->mutex);
  mo_text_add(&text, "]}");
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

void mo_api_get_problem(struct mo_request *request)
{
  const char *document = (const char *)mo_problems;
  char heading[sizeof(HEADING) + MO_PATH_PARAMETER_BYTES + 1];
  snprintf(heading, sizeof(heading), HEADING "%s\n", request->parameters[0]);
  const char *part = strstr(document, heading);
  if (part == NULL) {
    mo_reply_missing(request, "type of problem", request->parameters[0]);
    return;
  }
  const char *end = strstr(part + 1, HEADING);
  part += strlen("\n");
  mo_reply_static(request, 200, "text/plain; charset=utf-8", part,
                  end != NULL ? (size_t)(end - part) + 1 : strlen(part));
}
