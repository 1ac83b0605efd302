/* checkpoints.c: lists and deletes the checkpoints of trainings and campaigns. */
#include <string.h>

#include "api/campaign_json.h"
#include "api/job_reply.h"
#include "api/training_json.h"

void mo_api_get_training_checkpoints(struct mo_request *request)
{
  struct mo_checkpoint_row rows[MO_CHECKPOINTS_KEPT_MAX];
  int64_t id;
  if (!mo_path_job(request, MO_JOB_TRAINING, &id))
    return;
  int64_t n = mo_store_checkpoints(mo_api_of(request)->store, id, rows, MO_CHECKPOINTS_KEPT_MAX);
  if (n < 0) {
    mo_reply_error(request, (int)n, "page");
    return;
  }
  struct mo_text text = {0};
  mo_text_add(&text, "{\"items\":[");
  for (int64_t i = 0; i < n; i++) {
    if (i > 0)
      mo_text_bytes(&text, ",", 1);
    mo_training_json_checkpoint(&text, &rows[i]);
  }
  mo_text_add(&text, "]}");
  mo_reply_json(request, 200, &text);
  mo_reply_etag_of_body(request);
}

static void delete_checkpoints(struct mo_request *request, bool one)
{
  struct mo_checkpoints_removed removed;
  const char *text = request->parameters[1];
  int64_t id, step = 0;
  if (!mo_path_job(request, MO_JOB_TRAINING, &id))
    return;
  int code = one && !mo_decimal(text, strlen(text), 1, MO_TRAINING_STEPS_MAX, &step)
                 ? MO_ERR_NOT_FOUND
                 : MO_OK;
  if (code == MO_OK)
    code = mo_store_checkpoints_remove(mo_api_of(request)->store, id, MO_JOB_TRAINING,
                                       (uint32_t)step, &removed);
  if (code == MO_ERR_NOT_FOUND) {
    mo_reply_problem(request, 404, NULL,
                     "The training keeps no checkpoint of this step; GET "
                     "/v1/trainings/%lld/checkpoints lists them.",
                     (long long)id);
  } else if (code == MO_ERR_CONFLICT) {
    mo_reply_problem(request, 409, NULL,
                     "The training has not ended and goes on from its newest checkpoint, that of "
                     "step %lld, after a restart or a pause; it can be deleted when the training "
                     "has ended or was cancelled.",
                     (long long)step);
  } else if (code != MO_OK) {
    mo_reply_error(request, code, "checkpoint");
  } else {
    struct mo_text reply = {0};
    mo_text_add(&reply, "{\"items\":[");
    for (size_t i = 0; i < removed.n; i++)
      mo_text_format(&reply, "%s{\"step\":%u}", i > 0 ? "," : "", removed.places[i].step);
    mo_text_add(&reply, "]");
    mo_text_member_count(&reply, "bytes", removed.bytes);
    mo_text_add(&reply, "}");
    mo_reply_json(request, 200, &reply);
  }
}

void mo_api_delete_training_checkpoints(struct mo_request *request)
{
  delete_checkpoints(request, false);
}

void mo_api_delete_training_checkpoint(struct mo_request *request)
{
  delete_checkpoints(request, true);
}

void mo_api_get_campaign_checkpoints(struct mo_request *request)
{
  struct mo_checkpoint_row rows[MO_CHECKPOINTS_MAX];
  struct mo_text text = {0};
  int64_t id;
  if (!mo_path_job(request, MO_JOB_CAMPAIGN, &id))
    return;
  int64_t n = mo_store_checkpoints(mo_api_of(request)->store, id, rows, MO_CHECKPOINTS_MAX);
  if (n < 0) {
    mo_reply_error(request, (int)n, "page");
    return;
  }
  mo_text_add(&text, "{\"items\":[");
  for (int64_t i = 0; i < n; i++) {
    mo_text_add(&text, i > 0 ? "," : "");
    mo_campaign_json_checkpoint(&text, &rows[i]);
  }
  mo_text_add(&text, "]}");
  mo_reply_json(request, 200, &text);
  mo_reply_etag_of_body(request);
}

void mo_api_delete_campaign_checkpoints(struct mo_request *request)
{
  struct mo_checkpoints_removed removed;
  struct mo_text text = {0};
  int64_t id;
  if (!mo_path_job(request, MO_JOB_CAMPAIGN, &id))
    return;
  int code =
      mo_store_checkpoints_remove(mo_api_of(request)->store, id, MO_JOB_CAMPAIGN, 0, &removed);
  if (code != MO_OK) {
    mo_reply_error(request, code, "campaign");
    return;
  }
  mo_text_add(&text, "{\"items\":[");
  for (size_t i = 0; i < removed.n; i++)
    mo_text_format(&text, "%s{\"generation\":%u,\"step\":%u}", i > 0 ? "," : "",
                   removed.places[i].generation, removed.places[i].step);
  mo_text_add(&text, "]");
  mo_text_member_count(&text, "bytes", removed.bytes);
  mo_text_add(&text, "}");
  mo_reply_json(request, 200, &text);
}
