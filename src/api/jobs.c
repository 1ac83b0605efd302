/* jobs.c: jobs of any kind: lists, state, control. */
#include <stdlib.h>
#include <string.h>

#include "api/job_json.h"
#include "api/job_reply.h"
#include "api/requests.h"
#include "api/submission.h"

static const struct mo_resource *const kinds[MO_JOB_KINDS] = {
    [MO_JOB_EVALUATION] = &mo_evaluation_resource,
    [MO_JOB_TRAINING] = &mo_training_resource,
    [MO_JOB_CAMPAIGN] = &mo_campaign_resource};

void mo_api_get_job(struct mo_request *request)
{
  int64_t id;
  if ((!request->wait_over && !mo_read_wait(request)) || !mo_path_id(request, 0, &id))
    return;
  struct mo_job *job = malloc(sizeof(*job));
  if (job == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "job");
  } else if (mo_await_job(request, NULL, id, job)) {
    int error = mo_write_reply(request, 200, kinds[job->kind], id, false);
    if (error != MO_OK)
      mo_reply_error(request, error, "job");
  }
  free(job);
}

/* Writes an item of the list. Writes nothing if the job is not, or no longer, in `state` (−1:
 * any). */
static int write_item(struct mo_api *api, struct mo_text *text, const struct mo_job *job, int state)
{
  const struct mo_resource *kind = kinds[job->kind];
  struct mo_live live = {0};
  void *read = NULL;
  const void *status = job;
  int error = MO_OK;
  if (kind->has_live) {
    error = mo_status_read(api, kind, job->id, &read, &live);
    status = read;
  }
  if (error == MO_OK && (state < 0 || (int)mo_job_state_shown(status, &live) == state)) {
    if (text->data != NULL && text->data[text->size - 1] == '}')
      mo_text_add(text, ",");
    kind->write_job(text, status, &live);
  }
  free(read);
  return error;
}

void mo_api_list_jobs(struct mo_request *request)
{
  struct mo_api *api = mo_api_of(request);
  const char *named = mo_query(request, "kind");
  int64_t waiting[MO_WAITING_MAX];
  struct mo_campaign_query filter;
  enum mo_job_kind kind;
  size_t limit;
  if (!mo_read_job_query(request, &filter, waiting, &limit))
    return;
  if (named != NULL && mo_job_kind_from_name(named, &kind) != MO_OK) {
    mo_reply_bad_parameter(request, "kind", "evaluation, training or campaign is expected");
    return;
  }
  const struct mo_job_query query = {.before = filter.before,
                                     .state = filter.state,
                                     .kind = named != NULL ? (int)kind : -1,
                                     .label = filter.label,
                                     .waiting = waiting,
                                     .n_waiting = filter.n_waiting};
  struct mo_job *jobs = malloc(limit * sizeof(*jobs));
  int64_t n = jobs != NULL ? mo_store_jobs(api->store, &query, jobs, limit) : MO_ERR_NO_MEMORY;
  struct mo_text text = {0};
  int error = MO_OK;
  mo_text_add(&text, "{\"items\":[");
  for (int64_t i = 0; i < n && error == MO_OK; i++)
    error = write_item(api, &text, &jobs[i], query.state);
  mo_reply_page(request, &text, error != MO_OK ? error : n, limit, n > 0 ? jobs[n - 1].id : 0);
  free(jobs);
}

/* ---- control ---- */

/* Replies with the job after a change. conflict: what its state does not allow. */
static void reply_changed(struct mo_request *request, int64_t id, int error, const char *conflict)
{
  struct mo_job *job = malloc(sizeof(*job));
  bool refused = error == MO_ERR_CONFLICT;
  if (job == NULL)
    error = MO_ERR_NO_MEMORY;
  else if (error == MO_OK || refused)
    error = mo_store_job(mo_api_of(request)->store, id, job);
  if (error == MO_OK && refused)
    mo_reply_problem(request, 409, NULL, "The job %s: it is %s.", conflict,
                     mo_job_state_name(job->state));
  else if (error == MO_OK)
    error = mo_write_reply(request, 200, kinds[job->kind], id, false);
  if (error != MO_OK)
    mo_reply_error(request, error, "job");
  if (request->reply.status == 200)
    request->reply.retry_after_s = 0;
  free(job);
}

static void change(struct mo_request *request, int (*call)(struct mo_jobs *jobs, int64_t id),
                   const char *conflict)
{
  int64_t id;
  if (mo_path_id(request, 0, &id))
    reply_changed(request, id, call(mo_api_of(request)->jobs, id), conflict);
}

void mo_api_pause_job(struct mo_request *request)
{
  change(request, mo_jobs_pause, "cannot be paused");
}

void mo_api_resume_job(struct mo_request *request)
{
  change(request, mo_jobs_resume, "cannot be resumed");
}

void mo_api_cancel_job(struct mo_request *request)
{
  change(request, mo_jobs_cancel, "cannot be cancelled");
}

void mo_api_set_job_weight(struct mo_request *request)
{
  double weight = 1;
  int64_t id;
  if (!mo_path_id(request, 0, &id) || !mo_check_content(request, "application/json", NULL))
    return;
  struct mo_faults *faults = calloc(1, sizeof(*faults));
  int error = faults != NULL ? mo_weight_parse(request->body, request->body_size, &weight, faults)
                             : MO_ERR_NO_MEMORY;
  if (error != MO_OK)
    mo_reply_parse_error(request, error, faults, "job");
  else
    reply_changed(request, id, mo_jobs_set_weight(mo_api_of(request)->jobs, id, weight),
                  "has no use for a weight");
  free(faults);
}
