/* checkpoints.c: lists and deletes the checkpoints of training runs and campaigns. */
#include <string.h>

#include "api/job_json.h"
#include "api/jobs.h"

/* Opens an object with the step of a checkpoint and, in campaigns, its generation. */
static void write_place(struct mo_text *text, const struct mo_resource *kind, uint32_t generation,
                        uint32_t step)
{
  mo_text_object(text);
  if (kind->kind == MO_JOB_CAMPAIGN)
    mo_text_member_count(text, "generation", generation);
  mo_text_member_count(text, "step", step);
}

void mo_api_get_checkpoints(struct mo_request *request)
{
  const struct mo_resource *kind = mo_resource_of(request);
  struct mo_checkpoint_row rows[MO_CHECKPOINTS_MAX];
  struct mo_text text = {0};
  int64_t id;
  if (!mo_path_job(request, &id))
    return;
  int64_t n = mo_store_checkpoints(mo_api_of(request)->store, id, rows, MO_CHECKPOINTS_MAX);
  mo_text_add(&text, "{\"items\":[");
  for (int64_t i = 0; i < n; i++) {
    write_place(&text, kind, rows[i].generation, rows[i].step);
    mo_member_hash(&text, "sha256", &rows[i].sha256);
    mo_text_member_count(&text, "size", rows[i].size);
    mo_text_member_time(&text, "stored_at", rows[i].stored_us);
    mo_text_add(&text, "}");
  }
  mo_text_add(&text, "]}");
  mo_reply_text(request, n < 0 ? (int)n : MO_OK, &text, "page");
}

/* Deletes the checkpoints that are not needed, or the checkpoint of the step in the path. */
void mo_api_delete_checkpoints(struct mo_request *request)
{
  const struct mo_resource *kind = mo_resource_of(request);
  struct mo_checkpoints_removed removed;
  const char *given = request->parameters[1];
  const bool one = given[0] != '\0';
  struct mo_text text = {0};
  int64_t id, step = 0;
  if (!mo_path_job(request, &id))
    return;
  int error = one && !mo_decimal(given, strlen(given), 1, MO_TRAINING_STEPS_MAX, &step)
                  ? MO_ERR_NOT_FOUND
                  : mo_store_checkpoints_remove(mo_api_of(request)->store, id, kind->kind,
                                                (uint32_t)step, &removed);
  if (one && error == MO_ERR_NOT_FOUND) {
    mo_reply_problem(request, 404, NULL,
                     "The training run has no checkpoint of this step; GET "
                     "/v1/trainings/%lld/checkpoints lists its checkpoints.",
                     (long long)id);
  } else if (one && error == MO_ERR_CONFLICT) {
    mo_reply_problem(request, 409, NULL,
                     "The training run has not ended. After a restart or a pause, it would "
                     "continue from its newest checkpoint, at step %lld. Delete the checkpoint "
                     "after the run has ended or was cancelled.",
                     (long long)step);
  } else if (error != MO_OK) {
    mo_reply_error(request, error, mo_job_kind_name(kind->kind));
  } else {
    mo_text_add(&text, "{\"items\":[");
    for (size_t i = 0; i < removed.n; i++) {
      write_place(&text, kind, removed.places[i].generation, removed.places[i].step);
      mo_text_add(&text, "}");
    }
    mo_text_add(&text, "]");
    mo_text_member_count(&text, "bytes", removed.bytes);
    mo_text_add(&text, "}");
    mo_reply_json(request, 200, &text);
  }
}
