/* handle_devices.c: GET /v1/devices: the GPUs of the service. */
#include <string.h>

#include "http/server.h"

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

void mo_handle_devices(struct mo_request *request)
{
  struct mo_compute *compute = request->http->services.compute;
  struct mo_device_status status;
  struct mo_text text = {0};
  if (!mo_accepts_json(request))
    return;
  mo_text_add(&text, "{\"devices\":[");
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
