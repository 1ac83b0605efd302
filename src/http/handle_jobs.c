/* handle_jobs.c: evaluations and jobs: submission, state, results, waiting, control. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "base/clock.h"
#include "base/number.h"
#include "http/campaign_json.h"
#include "http/evaluation_request.h"
#include "http/field.h"
#include "http/job_json.h"
#include "http/request_parts.h"
#include "http/server.h"
#include "http/training_json.h"

#define WAIT_MAX_S 60

bool mo_read_wait(struct mo_request *request)
{
  request->wait_s = mo_prefer_wait(request->framing.prefer, WAIT_MAX_S);
  if (request->wait_s != -2)
    return true;
  struct mo_faults *faults = calloc(1, sizeof(*faults));
  if (faults != NULL)
    mo_faults_add(faults, MO_FAULT_HEADER, "Prefer",
                  "wait must be a number of seconds, as in wait=30");
  mo_reply_problem(request, 400, faults, NULL);
  free(faults);
  return false;
}

/* Sets the tag of a job's representation. The row's version identifies the content within one
 * store, because results are stored together with the state. */
static void tag(struct mo_request *request, const char *what, const struct mo_job *job)
{
  mo_reply_etag(request, "%" PRIx64 "-%s-%lld-%lld", mo_store_id(request->http->services.store),
                what, (long long)job->id, (long long)job->version);
}

/* Writes an item of the list of jobs, or a job by its id, after the text `before`. Writes nothing
 * if the job is not, or no longer, in `state` (−1: any). */
static int write_job(struct mo_http *http, struct mo_text *text, const struct mo_job *job,
                     int state, const char *before)
{
  int code = MO_OK;
  if (job->kind == MO_JOB_TRAINING) {
    struct mo_live live;
    struct mo_training_status *training = malloc(sizeof(*training));
    code = training != NULL ? mo_read_training(http, job->id, training, &live) : MO_ERR_NO_MEMORY;
    if (code == MO_OK &&
        (state < 0 || mo_training_state(training, &live) == (enum mo_job_state)state)) {
      mo_text_add(text, before);
      mo_training_json_job(text, training, &live);
    }
    free(training);
  } else if (job->kind == MO_JOB_CAMPAIGN) {
    struct mo_live live;
    struct mo_campaign_status *campaign = malloc(sizeof(*campaign));
    code = campaign != NULL ? mo_read_campaign(http, job->id, campaign, &live) : MO_ERR_NO_MEMORY;
    if (code == MO_OK &&
        (state < 0 || mo_campaign_state_shown(campaign, &live) == (enum mo_job_state)state)) {
      mo_text_add(text, before);
      mo_campaign_json_job(text, campaign, &live);
    }
    free(campaign);
  } else {
    mo_text_add(text, before);
    mo_job_write(text, job, NULL);
  }
  return code;
}

/* Replies `status` with the evaluation (and results if there are any) or the job. On an error no
 * reply is made yet. */
static int write_reply(struct mo_request *request, unsigned status, struct mo_job *job,
                       bool with_results)
{
  struct mo_evaluation_results *results = NULL;
  struct mo_text text = {0};
  int code = MO_OK;
  if (with_results && job->state == MO_JOB_SUCCEEDED)
    code = mo_store_results(request->http->services.store, job->id, &results);
  if (code == MO_OK && with_results)
    mo_job_write(&text, job, results);
  else if (code == MO_OK)
    code = write_job(request->http, &text, job, -1, "");
  mo_evaluation_results_free(results);
  if (code != MO_OK) {
    mo_text_free(&text);
    return code;
  }
  mo_reply_json(request, status, &text);
  if (request->reply.status != status)
    return MO_OK;
  if (job->kind != MO_JOB_EVALUATION)
    mo_reply_etag_of_body(request); /* the row's version does not cover its progress */
  else
    tag(request, with_results ? "evaluation" : "job", job);
  if (request->wait_s >= 0)
    snprintf(request->reply.applied, sizeof(request->reply.applied), "wait=%d", request->wait_s);
  if (!mo_job_state_is_final(job->state))
    request->reply.retry_after_s = 1;
  return MO_OK;
}

static void reply_job(struct mo_request *request, unsigned status, struct mo_job *job,
                      bool with_results)
{
  int code = write_reply(request, status, job, with_results);
  if (code != MO_OK)
    mo_reply_error(request, code, with_results ? "evaluation" : "job");
}

enum mo_handled mo_await_job(struct mo_request *request, int64_t id, struct mo_job *job, int *code)
{
  struct mo_store *store = request->http->services.store;
  bool may_wait = request->wait_s > 0 && !request->wait_over;
  if (!may_wait) {
    *code = mo_store_job(store, id, job);
    return MO_HANDLED;
  }
  mo_wait_begin(request, id, mo_clock_us() + (int64_t)request->wait_s * 1000000);
  *code = mo_store_job(store, id, job);
  if (*code != MO_OK || mo_job_state_is_final(job->state)) {
    mo_wait_end(request);
    return MO_HANDLED;
  }
  if (mo_wait_park(request))
    return MO_PARKED;
  *code = mo_store_job(store, id, job);
  return MO_HANDLED;
}

/* ---- POST /v1/evaluations ---- */

static void submission_error(struct mo_request *request, int code, const struct mo_message *message)
{
  struct mo_faults *faults = calloc(1, sizeof(*faults));
  const char *pointer = NULL;
  switch (code) {
  case MO_ERR_NOT_FOUND: pointer = "/controller"; break;
  case MO_ERR_UNSUPPORTED: pointer = "/controller"; break;
  case MO_ERR_LIMIT: pointer = "/record"; break;
  case MO_ERR_DEVICE: pointer = "/device"; break;
  case MO_ERR_INVALID:
  case MO_ERR_RANGE: pointer = ""; break;
  case MO_ERR_CONFLICT: mo_reply_key_conflict(request, faults); break;
  case MO_ERR_BUSY: mo_reply_queue_full(request); break;
  default: mo_reply_error(request, code, "evaluation"); break;
  }
  if (pointer != NULL) {
    if (faults != NULL)
      mo_faults_add(faults, MO_FAULT_BODY, pointer, "%s",
                    message->text[0] != '\0' ? message->text : mo_error_text(code));
    mo_reply_problem(request, 422, faults, NULL);
  }
  free(faults);
}

/* Parses and stores the evaluation. False: a reply was made. */
static bool submit(struct mo_request *request, const struct mo_submission_key *key,
                   struct mo_faults *faults)
{
  struct mo_http *http = request->http;
  struct mo_parsed_evaluation parsed;
  int code = mo_evaluation_parse(request->body, request->body_size, &parsed, faults);
  if (code == MO_OK) {
    struct mo_message message = {""};
    bool replayed;
    parsed.request.idempotency_key = key->key[0] != '\0' ? key->key : NULL;
    parsed.request.body_sha256 = key->body_sha256;
    code = mo_jobs_submit_evaluation(http->services.jobs, &parsed.request, &request->submitted,
                                     &replayed, &message);
    if (code != MO_OK)
      submission_error(request, code, &message);
  } else {
    mo_reply_parse_error(request, code, faults, "evaluation");
  }
  mo_evaluation_parsed_free(&parsed);
  return code == MO_OK;
}

static void reply_submitted(struct mo_request *request, struct mo_job *job, bool done)
{
  reply_job(request, done ? 200 : 202, job, true);
  snprintf(request->reply.location, sizeof(request->reply.location), "/v1/evaluations/%lld",
           (long long)job->id);
  if (!done) {
    request->reply.applied[0] = '\0';
    request->reply.retry_after_s = 1;
  }
}

enum mo_handled mo_handle_evaluations_post(struct mo_request *request)
{
  if (request->submitted == 0 &&
      (!mo_read_wait(request) || !mo_handle_submission(request, "evaluation", submit)))
    return MO_HANDLED;
  struct mo_job *job = malloc(sizeof(*job));
  int code = MO_ERR_NO_MEMORY;
  if (job != NULL && mo_await_job(request, request->submitted, job, &code) == MO_PARKED) {
    free(job);
    return MO_PARKED;
  }
  if (code != MO_OK) {
    mo_reply_error(request, code, "evaluation");
  } else {
    reply_submitted(request, job, request->wait_s >= 0 && mo_job_state_is_final(job->state));
  }
  free(job);
  return MO_HANDLED;
}

void mo_reply_accepted_evaluation(struct mo_request *request, int64_t id)
{
  struct mo_job *job = malloc(sizeof(*job));
  int code = job != NULL ? mo_store_job(request->http->services.store, id, job) : MO_ERR_NO_MEMORY;
  if (code != MO_OK)
    mo_reply_error(request, code, "evaluation");
  else
    reply_submitted(request, job, false);
  free(job);
}

/* ---- reading ---- */

enum mo_handled mo_handle_job_of(struct mo_request *request, int kind, const char *what,
                                 void (*reply)(struct mo_request *request, struct mo_job *job))
{
  struct mo_query_value none;
  int64_t id;
  if (!request->wait_over && (!mo_query_read(request, NULL, &none, 0) ||
                              !mo_accepts_json(request) || !mo_read_wait(request)))
    return MO_HANDLED;
  if (!mo_path_id(request, 0, &id))
    return MO_HANDLED;
  struct mo_job *job = malloc(sizeof(*job));
  int code = MO_ERR_NO_MEMORY;
  enum mo_handled handled = job != NULL ? mo_await_job(request, id, job, &code) : MO_HANDLED;
  if (handled == MO_HANDLED) {
    if (mo_job_is_another(job, code, kind))
      code = MO_ERR_NOT_FOUND;
    if (code != MO_OK)
      mo_reply_error(request, code, what);
    else
      reply(request, job);
  }
  free(job);
  return handled;
}

static void reply_evaluation(struct mo_request *request, struct mo_job *job)
{
  reply_job(request, 200, job, true);
}

static void reply_any(struct mo_request *request, struct mo_job *job)
{
  reply_job(request, 200, job, false);
}

enum mo_handled mo_handle_evaluation_get(struct mo_request *request)
{
  return mo_handle_job_of(request, MO_JOB_EVALUATION, "evaluation", reply_evaluation);
}

enum mo_handled mo_handle_job_get(struct mo_request *request)
{
  return mo_handle_job_of(request, -1, "job", reply_any);
}

/* ---- lists ---- */

bool mo_query_state(struct mo_request *request, const struct mo_query_value *value, int *state)
{
  enum mo_job_state named;
  *state = -1;
  if (value->present && mo_job_state_from_name(value->text, &named) != MO_OK) {
    mo_reply_bad_parameter(request, "state",
                           "queued, running, paused, succeeded, failed or cancelled is expected");
    return false;
  }
  if (value->present)
    *state = (int)named;
  return true;
}

bool mo_query_label(struct mo_request *request, const struct mo_query_value *value,
                    const char **label)
{
  size_t characters = 0;
  for (const char *c = value->text; *c != '\0'; c++)
    characters += ((unsigned char)*c & 0xC0) != 0x80;
  if (value->present && (characters < 1 || characters > 200)) {
    mo_reply_bad_parameter(request, "label",
                           "the label of a job, of 1 to 200 characters, is expected");
    return false;
  }
  *label = value->present ? value->text : NULL;
  return true;
}

bool mo_query_before(struct mo_request *request, const struct mo_query_value *value,
                     int64_t *before)
{
  *before = 0;
  if (!value->present || mo_id(value->text, before))
    return true;
  mo_reply_bad_parameter(request, "cursor", "the next_cursor of an earlier page is expected");
  return false;
}

void mo_reply_page(struct mo_request *request, struct mo_text *text, int64_t n, size_t limit,
                   int64_t last)
{
  if (n < 0) {
    mo_text_free(text);
    mo_reply_error(request, (int)n, "page");
    return;
  }
  if (n > 0 && (size_t)n == limit)
    mo_text_format(text, "],\"next_cursor\":\"%lld\"", (long long)last);
  else
    mo_text_add(text, "],\"next_cursor\":null");
  mo_text_add(text, "}");
  mo_reply_json(request, 200, text);
  mo_reply_etag_of_body(request);
}

void mo_handle_jobs(struct mo_request *request)
{
  static const char *const names[] = {"state", "kind", "limit", "cursor", "label"};
  struct mo_query_value values[5];
  int64_t waiting[MO_WAITING_MAX];
  struct mo_job_query query = {.state = -1,
                               .kind = -1,
                               .waiting = waiting,
                               .n_waiting = mo_jobs_waiting(request->http->services.jobs, waiting)};
  size_t limit;
  if (!mo_query_read(request, names, values, 5) || !mo_accepts_json(request) ||
      !mo_query_limit(request, &values[2], &limit) ||
      !mo_query_label(request, &values[4], &query.label))
    return;
  enum mo_job_kind kind;
  if (!mo_query_state(request, &values[0], &query.state))
    return;
  if (values[1].present && mo_job_kind_from_name(values[1].text, &kind) != MO_OK) {
    mo_reply_bad_parameter(request, "kind", "evaluation, training or campaign is expected");
    return;
  }
  if (!mo_query_before(request, &values[3], &query.before))
    return;
  if (values[1].present)
    query.kind = (int)kind;
  struct mo_job *jobs = malloc((limit + 1) * sizeof(*jobs));
  int64_t n = jobs != NULL ? mo_store_jobs(request->http->services.store, &query, jobs, limit)
                           : MO_ERR_NO_MEMORY;
  struct mo_text text = {0};
  const char *comma = "";
  int code = n < 0 ? (int)n : MO_OK;
  mo_text_add(&text, "{\"items\":[");
  for (int64_t i = 0; i < n && code == MO_OK; i++) {
    size_t size = text.size;
    code = write_job(request->http, &text, &jobs[i], query.state, comma);
    if (text.size > size)
      comma = ",";
  }
  mo_reply_page(request, &text, code != MO_OK ? code : n, limit, n > 0 ? jobs[n - 1].id : 0);
  free(jobs);
}

/* ---- control ---- */

void mo_handle_job_change(struct mo_request *request)
{
  struct mo_jobs *jobs = request->http->services.jobs;
  struct mo_query_value none;
  int64_t id;
  if (!mo_query_read(request, NULL, &none, 0) || !mo_accepts_json(request) ||
      !mo_path_id(request, 0, &id))
    return;
  struct mo_job *job = malloc(sizeof(*job));
  if (job == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "job");
    return;
  }
  const char *verb = request->route == MO_ROUTE_JOB_PAUSE    ? "paused"
                     : request->route == MO_ROUTE_JOB_RESUME ? "resumed"
                                                             : "cancelled";
  int code = request->route == MO_ROUTE_JOB_PAUSE    ? mo_jobs_pause(jobs, id)
             : request->route == MO_ROUTE_JOB_RESUME ? mo_jobs_resume(jobs, id)
                                                     : mo_jobs_cancel(jobs, id);
  const bool conflict = code == MO_ERR_CONFLICT;
  if (code == MO_OK || conflict)
    code = mo_store_job(request->http->services.store, id, job);
  if (conflict && code == MO_OK) {
    mo_reply_problem(request, 409, NULL, "The job cannot be %s: it is %s.", verb,
                     mo_job_state_name(job->state));
  } else {
    if (code == MO_OK)
      code = write_reply(request, 200, job, false);
    if (code != MO_OK)
      mo_reply_error(request, code, "job");
  }
  request->reply.retry_after_s = request->reply.status == 200 ? 0 : request->reply.retry_after_s;
  free(job);
}

/* Reads {"weight": x}. MO_ERR_FORMAT, MO_ERR_INVALID: see the faults. */
static int read_weight(const struct mo_request *request, double *weight, struct mo_faults *faults)
{
  struct mo_json *json = malloc(sizeof(*json));
  struct mo_json_slice key;
  bool given = false;
  if (json == NULL)
    return MO_ERR_NO_MEMORY;
  mo_json_start(json, request->body != NULL ? request->body : "", request->body_size, faults);
  bool object = mo_json_object(json);
  while (object && mo_json_member(json, &key))
    if (mo_json_is(key, "weight")) {
      given = true;
      mo_read_weight(json, weight);
    } else {
      mo_read_unknown(json, "weight");
    }
  if (object && !json->stop && !given)
    mo_json_fault_at(json, 0, "", "weight is missing: a number from %s to %s",
                     MO_NUMBER(MO_WEIGHT_MIN), MO_NUMBER(MO_WEIGHT_MAX));
  mo_json_finish(json);
  free(json);
  return faults->malformed ? MO_ERR_FORMAT : faults->n > 0 ? MO_ERR_INVALID : MO_OK;
}

static void set_weight(struct mo_request *request, int64_t id, struct mo_faults *faults,
                       struct mo_job *job)
{
  double weight = 1;
  int code = read_weight(request, &weight, faults);
  bool conflict = false;
  if (code != MO_OK) {
    mo_reply_parse_error(request, code, faults, "job");
    return;
  }
  code = mo_jobs_set_weight(request->http->services.jobs, id, weight);
  conflict = code == MO_ERR_CONFLICT;
  if (code == MO_OK || conflict)
    code = mo_store_job(request->http->services.store, id, job);
  if (code != MO_OK) {
    mo_reply_error(request, code, "job");
  } else if (conflict) {
    mo_reply_problem(request, 409, NULL, "The job has no use for a weight: it is %s.",
                     mo_job_state_name(job->state));
  } else {
    reply_job(request, 200, job, false);
    request->reply.retry_after_s = request->reply.status == 200 ? 0 : request->reply.retry_after_s;
  }
}

void mo_handle_job_weight(struct mo_request *request)
{
  struct mo_query_value none;
  int64_t id;
  if (!mo_query_read(request, NULL, &none, 0) || !mo_accepts_json(request) ||
      !mo_path_id(request, 0, &id) || !mo_check_content(request, "application/json", NULL))
    return;
  struct mo_faults *faults = calloc(1, sizeof(*faults));
  struct mo_job *job = malloc(sizeof(*job));
  if (faults != NULL && job != NULL)
    set_weight(request, id, faults, job);
  else
    mo_reply_error(request, MO_ERR_NO_MEMORY, "job");
  free(job);
  free(faults);
}

/* ---- trajectories ---- */

static void write_frames(struct mo_text *text, const struct mo_trajectory *t)
{
  if (t->com_m != NULL) {
    mo_text_add(text, ",\"com_m\":[");
    for (uint32_t f = 0; f < t->n_frames; f++)
      for (int axis = 0; axis < 3; axis++) {
        mo_text_add(text, axis > 0 ? "," : f > 0 ? "],[" : "[");
        mo_text_json_number(text, t->com_m[(size_t)f * 3 + (size_t)axis]);
      }
    mo_text_add(text, "]]");
  }
  if (t->mass_m != NULL) {
    mo_text_add(text, ",\"masses_m\":[");
    for (uint32_t f = 0; f < t->n_frames; f++) {
      mo_text_add(text, f > 0 ? "],[" : "[");
      const float *frame = &t->mass_m[(size_t)f * t->n_masses * 3];
      for (size_t i = 0; i < (size_t)t->n_masses * 3; i++) {
        mo_text_add(text, i % 3 > 0 ? "," : i > 0 ? "],[" : "[");
        mo_text_json_float(text, frame[i]);
      }
      mo_text_add(text, "]");
    }
    mo_text_add(text, "]]");
  }
}

/* Replies with one array as float32, little-endian (the byte order of this machine: the build
 * refuses others). */
static void reply_binary(struct mo_request *request, const struct mo_trajectory *t, bool masses)
{
  size_t n = masses ? (size_t)t->n_frames * t->n_masses * 3 : (size_t)t->n_frames * 3;
  float *numbers = malloc(n * sizeof(float));
  if (numbers == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "trajectory");
    return;
  }
  for (size_t i = 0; i < n; i++)
    numbers[i] = masses ? t->mass_m[i] : (float)t->com_m[i];
  mo_reply_bytes(request, 200, "application/octet-stream", (char *)numbers, n * sizeof(float));
  mo_reply_extra(request, "Morphod-Array", "%s", masses ? "masses" : "com");
  if (masses)
    mo_reply_extra(request, "Morphod-Shape", "%u,%u,3", t->n_frames, t->n_masses);
  else
    mo_reply_extra(request, "Morphod-Shape", "%u,3", t->n_frames);
  mo_reply_extra(request, "Morphod-Type", "float32-le");
  mo_reply_extra(request, "Morphod-Stride", "%u", t->stride);
  mo_reply_extra(request, "Morphod-Dt-S", "%.17g", t->dt_s);
}
_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "the binary form is little-endian");

void mo_handle_trajectory(struct mo_request *request)
{
  static const char *const names[] = {"environment", "array"};
  static const char *const types[] = {"application/json", "application/octet-stream"};
  struct mo_store *store = request->http->services.store;
  struct mo_query_value values[2];
  int64_t id, n, k = 0;
  if (!mo_query_read(request, names, values, 2) || !mo_path_id(request, 0, &id))
    return;
  int form = mo_accept_choose(request->framing.accept, types, 2);
  if (form < 0) {
    mo_reply_problem(request, 406, NULL,
                     "This path gives application/json or application/octet-stream, which the "
                     "Accept field does not allow.");
    return;
  }
  const char *design = request->parameters[1];
  if (!mo_decimal(design, strlen(design), 0, MO_DESIGNS_MAX - 1, &n)) {
    mo_reply_problem(request, 404, NULL,
                     "There is no such design: its place in the request, from 0, is expected.");
    return;
  }
  if (values[0].present &&
      !mo_decimal(values[0].text, strlen(values[0].text), 0, MO_ENVIRONMENTS_MAX - 1, &k)) {
    mo_reply_bad_parameter(request, "environment", "an integer from 0 to 63 is expected");
    return;
  }
  bool com = strcmp(values[1].text, "com") == 0, masses = strcmp(values[1].text, "masses") == 0;
  if (values[1].present && !com && !masses) {
    mo_reply_bad_parameter(request, "array", "com or masses is expected");
    return;
  }
  struct mo_job *job = malloc(sizeof(*job));
  struct mo_trajectory *trajectory = NULL;
  int code = job != NULL ? mo_store_job(store, id, job) : MO_ERR_NO_MEMORY;
  if (code != MO_OK) {
    mo_reply_error(request, code, "evaluation");
  } else if ((uint32_t)n >= job->n_designs || (uint32_t)k >= job->n_environments) {
    mo_reply_problem(request, 404, NULL, "The evaluation has %u designs and %u environments.",
                     job->n_designs, job->n_environments);
  } else if (!job->record_com && !job->record_masses) {
    mo_reply_problem(request, 404, NULL, "The evaluation did not ask for a recording.");
  } else if ((masses && !job->record_masses) || (com && !job->record_com)) {
    mo_reply_problem(request, 404, NULL,
                     "The evaluation did not ask for a recording of this array.");
  } else if ((code = mo_store_trajectory(store, id, (uint32_t)n, (uint32_t)k, &trajectory)) ==
             MO_ERR_NOT_FOUND) {
    if (mo_job_state_is_final(job->state))
      mo_reply_problem(request, 404, NULL, "This rollout was not recorded: the evaluation has %s.",
                       mo_job_state_name(job->state));
    else
      mo_reply_problem(request, 409, NULL, "This rollout is not done yet: the evaluation is %s.",
                       mo_job_state_name(job->state));
  } else if (code != MO_OK) {
    mo_reply_error(request, code, "trajectory");
  } else if (form == 1) {
    reply_binary(request, trajectory, masses || (!com && trajectory->mass_m != NULL));
  } else {
    struct mo_text text = {0};
    mo_text_format(&text,
                   "{\"evaluation\":\"%lld\",\"design\":%lld,\"environment\":%lld,\"stride\":%u,"
                   "\"frames\":%u,\"dt_s\":",
                   (long long)id, (long long)n, (long long)k, trajectory->stride,
                   trajectory->n_frames);
    mo_text_json_number(&text, trajectory->dt_s);
    write_frames(&text, trajectory);
    mo_text_add(&text, "}");
    mo_reply_json(request, 200, &text);
  }
  if (request->reply.status == 200)
    mo_reply_etag(request, "%" PRIx64 "-trajectory-%lld-%lld-%lld-%d%s", mo_store_id(store),
                  (long long)id, (long long)n, (long long)k, form, values[1].text);
  mo_trajectory_free(trajectory);
  free(job);
}
