/* evaluations.c: evaluations: submission, state, results, lists. */
#include <stdlib.h>
#include <string.h>

#include "api/job_json.h"
#include "api/job_reply.h"
#include "api/requests.h"
#include "api/submission.h"

/* ---- the kind ---- */

static int read_status(struct mo_store *store, int64_t id, void *status)
{
  return mo_store_job(store, id, status);
}

static int write_whole(struct mo_api *api, struct mo_text *text, const void *status,
                       const struct mo_live *live)
{
  (void)live;
  const struct mo_job *job = status;
  struct mo_evaluation_results *results = NULL;
  int error = MO_OK;
  if (job->state == MO_JOB_SUCCEEDED)
    error = mo_store_results(api->store, job->id, &results);
  if (error == MO_OK)
    mo_job_write(text, job, results);
  mo_evaluation_results_free(results);
  return error;
}

static void write_item(struct mo_text *text, const void *status, const struct mo_live *live)
{
  (void)live;
  mo_job_write(text, status, NULL);
}

static int64_t read_page(struct mo_store *store, const struct mo_campaign_query *query,
                         void *statuses, size_t limit)
{
  const struct mo_job_query jobs = {.before = query->before,
                                    .state = query->state,
                                    .kind = MO_JOB_EVALUATION,
                                    .label = query->label};
  return mo_store_jobs(store, &jobs, statuses, limit);
}

const struct mo_resource mo_evaluation_resource = {.kind = MO_JOB_EVALUATION,
                                                   .path = "/v1/evaluations",
                                                   .status_size = sizeof(struct mo_job),
                                                   .read = read_status,
                                                   .page = read_page,
                                                   .write = write_whole,
                                                   .write_job = write_item,
                                                   .versioned = true,
                                                   .brief = true};

/* ---- routes ---- */

/* Parses and stores the evaluation. False: a reply was made. */
static bool submit(struct mo_request *request, const struct mo_submission_key *key,
                   struct mo_faults *faults)
{
  static const struct mo_refusal_pointers pointers = {.controller = "/controller",
                                                      .limit = "/record"};
  struct mo_parsed_evaluation parsed;
  int error = mo_evaluation_parse(request->body, request->body_size, &parsed, faults);
  if (error == MO_OK) {
    struct mo_message message = {""};
    bool replayed;
    parsed.request.idempotency_key = key->key[0] != '\0' ? key->key : NULL;
    parsed.request.body_sha256 = key->body_sha256;
    error = mo_jobs_submit_evaluation(mo_api_of(request)->jobs, &parsed.request, &request->kept,
                                      &replayed, &message);
    if (error != MO_OK)
      mo_reply_not_stored(request, key, error, &message, &pointers, faults, "evaluation");
  } else {
    mo_reply_parse_error(request, error, faults, "evaluation");
  }
  mo_evaluation_parsed_free(&parsed);
  return error == MO_OK;
}

void mo_api_post_evaluation(struct mo_request *request)
{
  if (request->kept == 0 &&
      (!mo_read_wait(request) || !mo_handle_submission(request, "evaluation", submit)))
    return;
  struct mo_job *job = malloc(sizeof(*job));
  if (job == NULL)
    mo_reply_error(request, MO_ERR_NO_MEMORY, "evaluation");
  else if (mo_await_job(request, &mo_evaluation_resource, request->kept, job))
    mo_reply_submitted(request, &mo_evaluation_resource, request->kept,
                       request->wait_s >= 0 && mo_job_state_is_final(job->state));
  free(job);
}

void mo_api_get_evaluation(struct mo_request *request)
{
  mo_get_of_kind(request, &mo_evaluation_resource);
}

void mo_api_list_evaluations(struct mo_request *request)
{
  mo_list_of_kind(request, &mo_evaluation_resource, 0);
}
