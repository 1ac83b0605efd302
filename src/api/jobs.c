/* jobs.c: jobs of any kind: state, lists, control. */
#include "api/jobs.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/job_json.h"
#include "api/submission.h"
#include "base/clock.h"
#include "base/text.h"
#include "http/pool.h"
#include "store/deletion.h"

static const struct mo_resource *const kinds[MO_JOB_KINDS] = {
    [MO_JOB_EVALUATION] = &mo_evaluation_resource,
    [MO_JOB_TRAINING] = &mo_training_resource,
    [MO_JOB_CAMPAIGN] = &mo_campaign_resource,
    [MO_JOB_ATLAS] = &mo_atlas_resource,
    [MO_JOB_CERTIFICATE] = &mo_certificate_resource};

const struct mo_resource *mo_resource_of(const struct mo_request *request)
{
  for (size_t i = 0; i < MO_JOB_KINDS; i++)
    if (strncmp(request->route->path, kinds[i]->path, strlen(kinds[i]->path)) == 0)
      return kinds[i];
  return NULL;
}

/* ---- one job ---- */

void mo_api_get_job(struct mo_request *request)
{
  const struct mo_resource *kind = mo_resource_of(request);
  struct mo_job job;
  int64_t id;
  mo_read_wait(request);
  if (mo_path_id(request, 0, &id) && mo_await_job(request, kind, id, &job))
    mo_reply_job(request, 200, kinds[job.kind], id, kind != NULL);
}

bool mo_path_job(struct mo_request *request, int64_t *id)
{
  struct mo_job job;
  return mo_path_id(request, 0, id) && mo_job_of_kind(request, mo_resource_of(request), *id, &job);
}

/* ---- lists ---- */

static void reply_page(struct mo_request *request, struct mo_text *text, int64_t n, size_t limit,
                       int64_t last)
{
  mo_text_add(text, "]");
  mo_text_member_id(text, "next_cursor", n > 0 && (size_t)n == limit ? last : -1);
  mo_text_add(text, "}");
  mo_reply_text(request, n < 0 ? (int)n : MO_OK, text, "page");
}

/* Writes an item of a list. listed: the kind of the list; NULL: any kind. Writes nothing if the job
 * is no longer in `state` (−1: any state). */
static int write_item(struct mo_api *api, struct mo_text *text, const struct mo_resource *listed,
                      const void *item, int state)
{
  const struct mo_resource *kind = listed != NULL ? listed : kinds[((struct mo_job *)item)->kind];
  const void *status = item;
  union mo_job_status whole;
  struct mo_live live;
  if (listed == NULL && kind->status_size > sizeof(struct mo_job)) {
    int error = kind->read(api->store, ((struct mo_job *)item)->id, &whole);
    if (error != MO_OK)
      return error;
    status = &whole;
  }
  mo_read_live(api, status, &live);
  if (state >= 0 && (int)mo_job_state_shown(status, &live) != state)
    return MO_OK;
  if (listed != NULL)
    return kind->write(api, text, status, &live, true);
  kind->write_job(text, status, &live);
  return MO_OK;
}

/* Reads a parameter of 1 to `most` characters. *text is NULL if the parameter is not given. */
static bool read_text(struct mo_request *request, const char *name, size_t most, const char *words,
                      const char **text)
{
  *text = mo_query(request, name);
  const size_t characters = *text != NULL ? mo_utf8_length(*text, strlen(*text)) : 1;
  if (characters >= 1 && characters <= most)
    return true;
  mo_reply_bad_parameter(request, name, words);
  return false;
}

/* Reads a token's name, in the form that token files allow. *name is NULL if the parameter is not
 * given. */
static bool read_user(struct mo_request *request, const char **name)
{
  static const char words[] =
      "must be a token's name: 1 to 64 printable ASCII characters without spaces";
  if (!read_text(request, "submitted_by", MO_USER_BYTES_MAX, words, name))
    return false;
  for (const char *c = *name; c != NULL && *c != '\0'; c++)
    if (*c < '!' || *c > '~') {
      mo_reply_bad_parameter(request, "submitted_by", words);
      return false;
    }
  return true;
}

bool mo_read_job_filters(struct mo_request *request, struct mo_job_query *query,
                         char label[MO_LABEL_BYTES_MAX + 1])
{
  static const char *const archived[] = {"false", "true", "all", NULL};
  int which = 0;
  if (!mo_query_word(request, "state", mo_job_state_words, &query->state) ||
      !read_text(
          request, "label", 200,
          "must be a job's label, of 1 to 200 characters, or its beginning followed by an asterisk",
          &query->label) ||
      !read_text(request, "search", 200,
                 "must be text to search for in labels, 1 to 200 characters", &query->search) ||
      !read_text(request, "experiment", 100, "must be an experiment's name, of 1 to 100 characters",
                 &query->experiment) ||
      !read_user(request, &query->submitted_by) ||
      !mo_query_word(request, "archived", archived, &which))
    return false;
  query->archived = which == 2 ? -1 : which;
  const size_t size = query->label != NULL ? strlen(query->label) : 0;
  query->label_is_prefix = size > 0 && query->label[size - 1] == '*';
  if (query->label_is_prefix) {
    memcpy(label, query->label, size - 1);
    label[size - 1] = '\0';
    query->label = label;
  }
  return true;
}

void mo_api_list_jobs(struct mo_request *request)
{
  struct mo_api *api = mo_api_of(request);
  const struct mo_resource *listed = mo_resource_of(request);
  int64_t waiting[MO_WAITING_MAX];
  char label[MO_LABEL_BYTES_MAX + 1];
  struct mo_job_query query = {.state = -1,
                               .kind = listed != NULL ? (int)listed->kind : -1,
                               .waiting = waiting,
                               .n_waiting = mo_jobs_waiting(api->jobs, waiting)};
  size_t limit;
  if (!mo_query_limit(request, &limit) || !mo_read_job_filters(request, &query, label) ||
      !mo_query_id(request, "cursor", MO_CURSOR_WORDS, &query.before) ||
      !mo_query_word(request, "kind", mo_job_kind_words, &query.kind) ||
      !mo_query_id(request, "group", "must be the id of a group, in decimal digits", &query.group))
    return;
  const size_t size = listed != NULL ? listed->status_size : sizeof(struct mo_job);
  char *page = malloc(limit * size);
  int64_t n = page == NULL     ? MO_ERR_NO_MEMORY
              : listed == NULL ? mo_store_jobs(api->store, &query, page, limit)
                               : listed->page(api->store, &query, page, limit);
  struct mo_text text = {0};
  int64_t last = 0;
  mo_text_add(&text, "{\"items\":[");
  int error = MO_OK;
  for (int64_t i = 0; i < n && error == MO_OK; i++) {
    const void *item = page + (size_t)i * size;
    last = ((const struct mo_job *)item)->id;
    error = write_item(api, &text, listed, item, query.state);
  }
  reply_page(request, &text, error != MO_OK ? error : n, limit, last);
  free(page);
}

/* ---- control ---- */

/* Replies with the job after a change. conflict: describes the action that the job's state does not
 * allow. */
static void reply_changed(struct mo_request *request, int64_t id, int error, const char *conflict)
{
  const bool refused = error == MO_ERR_CONFLICT;
  struct mo_job job;
  if (error == MO_OK || refused)
    error = mo_store_job(mo_api_of(request)->store, id, &job);
  if (error != MO_OK)
    mo_reply_error(request, error, "job");
  else if (refused)
    mo_reply_problem(request, 409, NULL, "The job %s: it is %s.", conflict,
                     mo_job_state_name(job.state));
  else
    mo_reply_job(request, 200, kinds[job.kind], id, false);
}

/* Pauses, resumes or cancels a job, depending on the last part of the route. */
void mo_api_change_job(struct mo_request *request)
{
  static const struct {
    const char *name;
    int (*call)(struct mo_jobs *jobs, int64_t id);
    const char *conflict;
  } changes[] = {{"pause", mo_jobs_pause, "cannot be paused"},
                 {"resume", mo_jobs_resume, "cannot be resumed"},
                 {"cancel", mo_jobs_cancel, "cannot be cancelled"}};
  const char *name = strrchr(request->route->path, '/') + 1;
  size_t i = 0;
  int64_t id;
  while (strcmp(changes[i].name, name) != 0)
    i++;
  if (mo_path_id(request, 0, &id))
    reply_changed(request, id, changes[i].call(mo_api_of(request)->jobs, id), changes[i].conflict);
}

static int check_weight(struct mo_json *json, void *weight)
{
  if (isnan(*(double *)weight) && json->faults->n == 0)
    mo_json_fault_at(json, 0, "", "weight is missing; it must be a number from %s to %s",
                     MO_NUMBER(MO_WEIGHT_MIN), MO_NUMBER(MO_WEIGHT_MAX));
  return MO_OK;
}

void mo_api_set_job_weight(struct mo_request *request)
{
  double weight = NAN;
  int64_t id;
  if (mo_path_id(request, 0, &id) &&
      mo_read_request(request, &mo_weight_fields, &weight, NULL, check_weight, "job"))
    reply_changed(request, id, mo_jobs_set_weight(mo_api_of(request)->jobs, id, weight),
                  "does not support a weight");
}

static int check_edit(struct mo_json *json, void *any)
{
  const struct mo_job_edit *edit = &((struct mo_parsed_edit *)any)->edit;
  if (!edit->has_label && !edit->has_experiment && !edit->has_note && !edit->has_archived &&
      json->faults->n == 0)
    mo_json_fault_at(json, 0, "",
                     "the request changes nothing; give label, experiment, note or archived");
  return MO_OK;
}

void mo_api_edit_job(struct mo_request *request)
{
  struct mo_parsed_edit parsed = {.edit.has_label = false};
  int64_t id;
  if (mo_path_id(request, 0, &id) &&
      mo_read_request(request, &mo_edit_fields, &parsed, NULL, check_edit, "job"))
    reply_changed(request, id, mo_jobs_edit(mo_api_of(request)->jobs, id, &parsed.edit), "");
}

/* ---- deletion ---- */

static void write_staying(struct mo_text *text, const char *what, const char *why)
{
  mo_text_object(text);
  mo_text_member(text, "what", what);
  mo_text_member(text, "why", why);
  mo_text_add(text, "}");
}

/* Reports a deleted job: what was removed with it, and what was kept. */
static void write_deleted(struct mo_text *text, const union mo_job_status *status,
                          const struct mo_deleted *deleted)
{
  const struct mo_job *job = &status->job;
  char made[MO_MADE_BYTES], what[MO_NAME_BYTES_MAX + 16];
  mo_text_object(text);
  mo_text_member_id(text, "id", job->id);
  mo_text_member(text, "kind", mo_job_kind_name(job->kind));
  mo_text_member_count(text, "recorded_bytes", deleted->recorded_bytes);
  mo_text_member_count(text, "checkpoints", deleted->n_checkpoints);
  mo_text_member_count(text, "checkpoint_bytes", deleted->checkpoint_bytes);
  mo_text_add(text, ",\"stays\":[");
  write_staying(text, "designs", "all jobs with these designs share them");
  write_staying(text, "scores", "later jobs reuse them instead of recomputing them");
  if (job->has_result) {
    snprintf(what, sizeof(what), "controller %s",
             mo_result_name(job,
                            job->kind == MO_JOB_TRAINING ? status->training.record.name
                                                         : status->campaign.record.name,
                            made));
    write_staying(text, what, "it has its own name; use that name to delete it");
  }
  if (job->kind == MO_JOB_ATLAS && job->state == MO_JOB_SUCCEEDED) {
    snprintf(what, sizeof(what), "atlas %s", status->atlas.record.name);
    write_staying(text, what, "it has its own name; use that name to delete it");
  }
  mo_text_add(text, "]}");
}

void mo_api_delete_job(struct mo_request *request)
{
  struct mo_store *store = mo_api_of(request)->store;
  struct mo_message message = {.text = ""};
  struct mo_deleted deleted;
  union mo_job_status status;
  struct mo_text text = {0};
  int64_t id;
  if (!mo_path_id(request, 0, &id))
    return;
  int error = mo_store_job(store, id, &status.job);
  const enum mo_job_state state = status.job.state;
  if (error == MO_OK)
    error = kinds[status.job.kind]->read(store, id, &status);
  if (error == MO_OK)
    error = mo_store_delete_job(store, id, &deleted, &message);
  if (error == MO_ERR_CONFLICT && message.text[0] == '\0') {
    mo_reply_problem(request, 409, NULL, "The job cannot be deleted: it is %s.",
                     mo_job_state_name(state));
  } else if (error == MO_ERR_CONFLICT) {
    mo_reply_problem(request, 409, NULL, "The job cannot be deleted: %s.", message.text);
  } else if (error != MO_OK) {
    mo_reply_error(request, error, "job");
  } else {
    write_deleted(&text, &status, &deleted);
    mo_reply_json(request, 200, &text);
  }
}

/* ---- usage ---- */

void mo_api_get_usage(struct mo_request *request)
{
  static const char *const words[] = {"kind", "label", "experiment", "submitted_by", NULL};
  struct mo_usage_row *rows;
  struct mo_text text = {0};
  size_t limit;
  int by = MO_USAGE_LABEL;
  if (!mo_query_word(request, "by", words, &by) || !mo_query_limit(request, &limit))
    return;
  rows = malloc(limit * sizeof(*rows));
  const int64_t n =
      rows == NULL ? MO_ERR_NO_MEMORY
                   : mo_store_usage(mo_api_of(request)->store, (enum mo_usage_by)by, rows, limit);
  mo_text_add(&text, "{\"items\":[");
  for (int64_t i = 0; i < n; i++) {
    const char *name = by == MO_USAGE_KIND
                           ? mo_job_kind_name((enum mo_job_kind)(rows[i].name[0] - '0'))
                           : rows[i].name;
    mo_text_object(&text);
    mo_text_member(&text, "name", name[0] != '\0' ? name : NULL);
    mo_text_member_count(&text, "jobs", rows[i].jobs);
    mo_text_member_number(&text, "core_seconds", rows[i].worker_s);
    mo_text_member_number(&text, "device_seconds", rows[i].device_s);
    mo_text_add(&text, "}");
  }
  mo_text_add(&text, "]}");
  mo_reply_text(request, n < 0 ? (int)n : MO_OK, &text, "page");
  free(rows);
}
