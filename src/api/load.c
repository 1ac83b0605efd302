/* load.c: GET /v1/load: how busy threads and devices were, from a ring of samples that lasts an
 * hour and is not kept over a restart. */
#include <math.h>

#include "api/handlers.h"
#include "base/clock.h"
#include "base/thread.h"

#define SAMPLE_US 10000000

/* Adds a sample when one is due. On the clock thread. */
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
