/* job_reply.c: see job_reply.h. */
#include "api/job_reply.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/job_json.h"
#include "base/clock.h"
#include "http/pool.h"

/* ---- one job ---- */

static void look(struct mo_api *api, const struct mo_resource *kind, const struct mo_job *job,
                 struct mo_live *live)
{
  *live = (struct mo_live){.seconds_left = -1};
  if (kind->has_live && !mo_job_state_is_final(job->state))
    mo_jobs_live(api->jobs, job->id, live);
}

int mo_status_read(struct mo_api *api, const struct mo_resource *kind, int64_t id, void **status,
                   struct mo_live *live)
{
  *status = malloc(kind->status_size);
  int error = *status != NULL ? kind->read(api->store, id, *status) : MO_ERR_NO_MEMORY;
  if (error == MO_OK)
    look(api, kind, *status, live);
  return error;
}

int mo_write_reply(struct mo_request *request, unsigned http_status, const struct mo_resource *kind,
                   int64_t id, bool whole)
{
  struct mo_api *api = mo_api_of(request);
  struct mo_text text = {0};
  struct mo_live live;
  void *status;
  int error = mo_status_read(api, kind, id, &status, &live);
  const struct mo_job *job = status;
  if (error == MO_OK && whole)
    error = kind->write(api, &text, status, &live);
  else if (error == MO_OK)
    kind->write_job(&text, status, &live);
  if (error != MO_OK) {
    mo_text_free(&text);
    free(status);
    return error;
  }
  mo_reply_json(request, http_status, &text);
  if (request->reply.status == http_status) {
    if (kind->versioned)
      mo_reply_etag(request, "%" PRIx64 "-%s-%lld-%lld", mo_store_id(api->store),
                    whole ? mo_job_kind_name(kind->kind) : "job", (long long)job->id,
                    (long long)job->version);
    else
      mo_reply_etag_of_body(request);
    if (request->wait_s >= 0 && http_status == 200)
      snprintf(request->reply.applied, sizeof(request->reply.applied), "wait=%d", request->wait_s);
    if (!mo_job_state_is_final(job->state) && request->method != MO_POST)
      request->reply.retry_after_s = 1;
  }
  free(status);
  return MO_OK;
}

void mo_reply_of_kind(struct mo_request *request, unsigned http_status,
                      const struct mo_resource *kind, int64_t id)
{
  int error = mo_write_reply(request, http_status, kind, id, true);
  if (error != MO_OK)
    mo_reply_error(request, error, mo_job_kind_name(kind->kind));
}

void mo_reply_submitted(struct mo_request *request, const struct mo_resource *kind, int64_t id,
                        bool done)
{
  mo_reply_of_kind(request, done ? 200 : 202, kind, id);
  if (request->reply.status != 200 && request->reply.status != 202)
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
    mo_reply_error(request, error, kind != NULL ? mo_job_kind_name(kind->kind) : "job");
  return error == MO_OK;
}

void mo_get_of_kind(struct mo_request *request, const struct mo_resource *kind)
{
  int64_t id;
  if ((!request->wait_over && !mo_read_wait(request)) || !mo_path_id(request, 0, &id))
    return;
  struct mo_job *job = malloc(sizeof(*job));
  if (job == NULL)
    mo_reply_error(request, MO_ERR_NO_MEMORY, mo_job_kind_name(kind->kind));
  else if (mo_await_job(request, kind, id, job))
    mo_reply_of_kind(request, 200, kind, id);
  free(job);
}

bool mo_path_job(struct mo_request *request, enum mo_job_kind kind, int64_t *id)
{
  if (!mo_path_id(request, 0, id))
    return false;
  struct mo_job *job = malloc(sizeof(*job));
  int error = job != NULL ? mo_store_job(mo_api_of(request)->store, *id, job) : MO_ERR_NO_MEMORY;
  if (error == MO_OK && job->kind != kind)
    error = MO_ERR_NOT_FOUND;
  free(job);
  if (error != MO_OK)
    mo_reply_error(request, error, mo_job_kind_name(kind));
  return error == MO_OK;
}

/* ---- lists ---- */

static bool read_state(struct mo_request *request, int *state)
{
  const char *text = mo_query(request, "state");
  enum mo_job_state named;
  *state = -1;
  if (text != NULL && mo_job_state_from_name(text, &named) != MO_OK) {
    mo_reply_bad_parameter(request, "state",
                           "queued, running, paused, succeeded, failed or cancelled is expected");
    return false;
  }
  if (text != NULL)
    *state = (int)named;
  return true;
}

static bool read_label(struct mo_request *request, const char **label)
{
  size_t characters = 0;
  *label = mo_query(request, "label");
  for (const char *c = *label; c != NULL && *c != '\0'; c++)
    characters += ((unsigned char)*c & 0xC0) != 0x80;
  if (*label == NULL || (characters >= 1 && characters <= 200))
    return true;
  mo_reply_bad_parameter(request, "label",
                         "the label of a job, of 1 to 200 characters, is expected");
  return false;
}

bool mo_read_job_query(struct mo_request *request, struct mo_campaign_query *query,
                       int64_t waiting[MO_WAITING_MAX], size_t *limit)
{
  const char *cursor = mo_query(request, "cursor");
  *query =
      (struct mo_campaign_query){.state = -1,
                                 .waiting = waiting,
                                 .n_waiting = mo_jobs_waiting(mo_api_of(request)->jobs, waiting)};
  if (!mo_query_limit(request, limit) || !read_state(request, &query->state) ||
      !read_label(request, &query->label))
    return false;
  if (cursor == NULL || mo_id(cursor, &query->before))
    return true;
  mo_reply_bad_parameter(request, "cursor", "the next_cursor of an earlier page is expected");
  return false;
}

void mo_reply_page(struct mo_request *request, struct mo_text *text, int64_t n, size_t limit,
                   int64_t last)
{
  if (n > 0 && (size_t)n == limit)
    mo_text_format(text, "],\"next_cursor\":\"%lld\"}", (long long)last);
  else
    mo_text_add(text, "],\"next_cursor\":null}");
  mo_reply_text(request, n < 0 ? (int)n : MO_OK, text, "page");
}

void mo_list_of_kind(struct mo_request *request, const struct mo_resource *kind, int64_t group)
{
  struct mo_api *api = mo_api_of(request);
  struct mo_campaign_query query;
  int64_t waiting[MO_WAITING_MAX];
  struct mo_text text = {0};
  size_t limit;
  int64_t last = 0;
  if (!mo_read_job_query(request, &query, waiting, &limit))
    return;
  query.group = group;
  char *page = malloc(limit * kind->status_size);
  int64_t n = page != NULL ? kind->page(api->store, &query, page, limit) : MO_ERR_NO_MEMORY;
  mo_text_add(&text, "{\"items\":[");
  int error = MO_OK;
  for (int64_t i = 0; i < n && error == MO_OK; i++) {
    const void *status = page + (size_t)i * kind->status_size;
    const struct mo_job *job = status;
    struct mo_live live;
    look(api, kind, job, &live);
    last = job->id;
    if (query.state >= 0 && (int)mo_job_state_shown(job, &live) != query.state)
      continue; /* it has just started or stopped waiting */
    if (text.data != NULL && text.data[text.size - 1] == '}')
      mo_text_add(&text, ",");
    if (kind->brief)
      kind->write_job(&text, status, &live);
    else
      error = kind->write(api, &text, status, &live);
  }
  mo_reply_page(request, &text, error != MO_OK ? error : n, limit, last);
  free(page);
}
