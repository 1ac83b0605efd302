/* job_reply.c: replies about one job, which handlers of all kinds share. */
#include <inttypes.h>
#include <stdio.h>

#include "api/job_json.h"
#include "api/jobs.h"
#include "base/clock.h"
#include "http/pool.h"

void mo_read_live(struct mo_api *api, const struct mo_job *job, struct mo_live *live)
{
  *live = (struct mo_live){.seconds_left = -1};
  if (!mo_job_state_is_final(job->state))
    mo_jobs_live(api->jobs, job->id, live);
}

void mo_reply_job_error(struct mo_request *request, int error, const char *what, int64_t id)
{
  char digits[24];
  snprintf(digits, sizeof(digits), "%lld", (long long)id);
  if (error == MO_ERR_NOT_FOUND)
    mo_reply_missing(request, what, digits);
  else
    mo_reply_error(request, error, what);
}

int mo_reply_job(struct mo_request *request, unsigned http_status, const struct mo_resource *kind,
                 int64_t id, bool whole)
{
  struct mo_api *api = mo_api_of(request);
  struct mo_text text = {0};
  struct mo_live live;
  union mo_job_status status;
  const struct mo_job *job = &status.job;
  int error = kind->read(api->store, id, &status);
  if (error == MO_OK) {
    mo_read_live(api, job, &live);
    if (whole)
      error = kind->write(api, &text, &status, &live, false);
    else
      kind->write_job(&text, &status, &live);
  }
  if (error != MO_OK) {
    mo_text_free(&text);
    mo_reply_job_error(request, error, whole ? mo_job_kind_name(kind->kind) : "job", id);
    return error;
  }
  mo_reply_json(request, http_status, &text);
  if (request->reply.status != http_status)
    return MO_ERR_NO_MEMORY;
  if (kind->versioned && (job->state != MO_JOB_RUNNING || http_status != 200))
    mo_reply_etag(request, "%" PRIx64 "-%s-%lld-%lld", mo_store_history(api->store),
                  whole ? mo_job_kind_name(kind->kind) : "job", (long long)job->id,
                  (long long)job->version);
  else
    mo_reply_etag_of_body(request);
  if (request->wait_s >= 0 && http_status == 200)
    snprintf(request->reply.applied, sizeof(request->reply.applied), "wait=%d", request->wait_s);
  if (!mo_job_state_is_final(job->state) && request->method != MO_POST)
    request->reply.retry_after_s = 1;
  return MO_OK;
}

void mo_reply_submitted(struct mo_request *request, const struct mo_resource *kind, int64_t id,
                        bool done)
{
  if (mo_reply_job(request, done ? 200 : 202, kind, id, true) != MO_OK)
    return;
  snprintf(request->reply.location, sizeof(request->reply.location), "%s/%lld", kind->path,
           (long long)id);
  if (!done)
    request->reply.retry_after_s = 1;
}

static int read_of_kind(struct mo_store *store, const struct mo_resource *kind, int64_t id,
                        struct mo_job *job)
{
  int error = mo_store_job(store, id, job);
  return error == MO_OK && kind != NULL && job->kind != kind->kind ? MO_ERR_NOT_FOUND : error;
}

bool mo_job_of_kind(struct mo_request *request, const struct mo_resource *kind, int64_t id,
                    struct mo_job *job)
{
  const int error = read_of_kind(mo_api_of(request)->store, kind, id, job);
  if (error != MO_OK)
    mo_reply_job_error(request, error, mo_job_kind_name(kind->kind), id);
  return error == MO_OK;
}

bool mo_await_job(struct mo_request *request, const struct mo_resource *kind, int64_t id,
                  struct mo_job *job)
{
  struct mo_store *store = mo_api_of(request)->store;
  bool may_wait = request->wait_s > 0 && !request->wait_over;
  if (may_wait)
    mo_wait_begin(request, id, mo_clock_us() + (int64_t)request->wait_s * 1000000);
  int error = read_of_kind(store, kind, id, job);
  if (may_wait && error == MO_OK && !mo_job_state_is_final(job->state))
    return false;
  if (may_wait)
    mo_wait_end(request);
  if (error != MO_OK)
    mo_reply_job_error(request, error, kind != NULL ? mo_job_kind_name(kind->kind) : "job", id);
  return error == MO_OK;
}
