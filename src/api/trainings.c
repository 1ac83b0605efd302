/* trainings.c: trainings: submission and state. */
#include <string.h>

#include "api/jobs.h"
#include "api/requests.h"
#include "api/submission.h"
#include "api/training_json.h"

static int read_status(struct mo_store *store, int64_t id, union mo_job_status *status)
{
  return mo_store_training(store, id, &status->training);
}

static int64_t read_page(struct mo_store *store, const struct mo_job_query *query, void *statuses,
                         size_t limit)
{
  return mo_store_trainings(store, query, statuses, limit);
}

/* Returns the kind of the job whose designs a training learns from. */
static enum mo_job_kind population_kind(struct mo_store *store,
                                        const struct mo_training_status *status)
{
  const int64_t id = status->record.population;
  struct mo_job job;
  return id > 0 && mo_store_job(store, id, &job) == MO_OK ? job.kind : MO_JOB_EVALUATION;
}

static int write_whole(struct mo_api *api, struct mo_text *text, const void *status,
                       const struct mo_live *live)
{
  mo_training_json_write(text, status, population_kind(api->store, status), live);
  return MO_OK;
}

const struct mo_resource mo_training_resource = {.kind = MO_JOB_TRAINING,
                                                 .path = "/v1/trainings",
                                                 .status_size = sizeof(struct mo_training_status),
                                                 .read = read_status,
                                                 .page = read_page,
                                                 .has_live = true,
                                                 .write = write_whole,
                                                 .write_job = mo_training_json_job};

/* Parses and stores the training. */
static int submit(struct mo_request *request, struct mo_post *post)
{
  struct mo_api *api = mo_api_of(request);
  struct mo_faults *faults = &post->faults;
  struct mo_parsed_training parsed;
  bool replayed;
  int error = mo_training_parse(request->body, request->body_size, &parsed, faults);
  const int64_t population = parsed.request.population;
  const char *pointer =
      parsed.population_kind == MO_JOB_CAMPAIGN ? "/population/campaign" : "/population/evaluation";
  const bool invalid = error == MO_ERR_INVALID;
  if (invalid)
    mo_look_up_controller(api->store, parsed.request.parent, faults);
  if (error == MO_OK || invalid) /* the job with this id may be of another kind */
    mo_look_up_job(api->store, population, parsed.population_kind, pointer, faults);
  if (error == MO_OK && faults->n > 0)
    error = MO_ERR_INVALID;
  if (error == MO_OK) {
    post->parsed = true;
    post->pointers =
        (struct mo_refusal_pointers){.empty = population > 0 ? "/population" : "/designs",
                                     .conflict = population > 0 ? pointer : NULL};
    parsed.request.idempotency_key = mo_post_key(post);
    parsed.request.body_sha256 = post->body_sha256;
    error = mo_jobs_submit_training(api->jobs, &parsed.request, &request->kept, &replayed,
                                    &post->message);
  }
  if (!invalid && mo_names_unknown(post, error))
    mo_look_up_controller(api->store, parsed.request.parent, faults);
  mo_parts_free(&parsed.parts);
  return error;
}

void mo_api_post_training(struct mo_request *request)
{
  if (mo_handle_submission(request, "training", submit))
    mo_reply_submitted(request, &mo_training_resource, request->kept, false);
}
