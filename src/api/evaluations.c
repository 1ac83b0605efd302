/* evaluations.c: evaluations: submission, state, results. */
#include "api/job_json.h"
#include "api/jobs.h"
#include "api/requests.h"
#include "api/submission.h"

static int read_status(struct mo_store *store, int64_t id, union mo_job_status *status)
{
  return mo_store_job(store, id, &status->job);
}

static int64_t read_page(struct mo_store *store, const struct mo_job_query *query, void *statuses,
                         size_t limit)
{
  return mo_store_jobs(store, query, statuses, limit);
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

const struct mo_resource mo_evaluation_resource = {.kind = MO_JOB_EVALUATION,
                                                   .path = "/v1/evaluations",
                                                   .status_size = sizeof(struct mo_job),
                                                   .read = read_status,
                                                   .page = read_page,
                                                   .write = write_whole,
                                                   .write_job = write_item,
                                                   .versioned = true,
                                                   .brief = true};

/* Parses and stores the evaluation. */
static int submit(struct mo_request *request, struct mo_post *post)
{
  struct mo_parsed_evaluation parsed;
  bool replayed;
  int error = mo_evaluation_parse(request->body, request->body_size, &parsed, &post->faults);
  post->parsed = error == MO_OK;
  post->pointers = (struct mo_refusal_pointers){.controller = "/controller", .limit = "/record"};
  parsed.request.idempotency_key = mo_post_key(post);
  parsed.request.body_sha256 = post->body_sha256;
  if (error == MO_OK)
    error = mo_jobs_submit_evaluation(mo_api_of(request)->jobs, &parsed.request, &request->kept,
                                      &replayed, &post->message);
  mo_parts_free(&parsed.parts);
  return error;
}

void mo_api_post_evaluation(struct mo_request *request)
{
  struct mo_job job;
  if (request->kept == 0 &&
      (!mo_read_wait(request) || !mo_handle_submission(request, "evaluation", submit)))
    return;
  if (mo_await_job(request, &mo_evaluation_resource, request->kept, &job))
    mo_reply_submitted(request, &mo_evaluation_resource, request->kept,
                       request->wait_s >= 0 && mo_job_state_is_final(job.state));
}
