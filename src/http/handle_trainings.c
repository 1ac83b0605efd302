/* handle_trainings.c: trainings: submission, state, lists, curves, checkpoints. See
 * handle_learned.c for the controller and the held-out set of a training. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "http/field.h"
#include "http/server.h"
#include "http/training_json.h"
#include "http/training_request.h"

#define CSV_ROWS_MAX                                                                               \
  10000 /* of one reply that was not asked for a limit: 5 µs each on a thread that serves others, \
           too */

/* ---- POST /v1/trainings ---- */

static const char *population_pointer(const struct mo_parsed_training *parsed)
{
  return parsed->population_kind == MO_JOB_CAMPAIGN ? "/population/campaign"
                                                    : "/population/evaluation";
}

/* Checks that what the request names exists, and adds all faults to those of the body. */
static void look_up(struct mo_store *store, const struct mo_parsed_training *parsed,
                    struct mo_faults *faults)
{
  mo_look_up_controller(store, parsed->request.parent, faults);
  mo_look_up_job(store, parsed->request.population, parsed->population_kind,
                 population_pointer(parsed), faults);
}

static void submission_error(struct mo_request *request, const struct mo_parsed_training *parsed,
                             const struct mo_submission_key *key, int code,
                             const struct mo_message *message, struct mo_faults *faults)
{
  struct mo_store *store = request->http->services.store;
  const char *words = message->text[0] != '\0' ? message->text : mo_error_text(code);
  switch (code) {
  case MO_ERR_NOT_FOUND:
  case MO_ERR_UNSUPPORTED:
    look_up(store, parsed, faults);
    if (faults->n == 0)
      mo_faults_add(faults, MO_FAULT_BODY, "", "%s", words);
    mo_reply_problem(request, 422, faults, NULL);
    break;
  case MO_ERR_INVALID:
  case MO_ERR_RANGE:
  case MO_ERR_LIMIT:
    mo_faults_add(faults, MO_FAULT_BODY, "", "%s", words);
    mo_reply_problem(request, 422, faults, NULL);
    break;
  case MO_ERR_EMPTY:
    mo_faults_add(faults, MO_FAULT_BODY,
                  parsed->request.population > 0 ? "/population" : "/designs", "%s", words);
    mo_reply_problem(request, 422, faults, NULL);
    break;
  case MO_ERR_CONFLICT:
    if (mo_key_conflicts(store, key) || parsed->request.population == 0) {
      mo_reply_key_conflict(request, faults);
    } else {
      mo_faults_add(faults, MO_FAULT_BODY, population_pointer(parsed), "%s", words);
      mo_reply_problem(request, 409, faults, NULL);
    }
    break;
  case MO_ERR_DEVICE:
    mo_faults_add(faults, MO_FAULT_BODY, "/device", "%s", words);
    mo_reply_problem(request, 422, faults, NULL);
    break;
  case MO_ERR_BUSY: mo_reply_queue_full(request); break;
  default: mo_reply_error(request, code, "training"); break;
  }
}

int mo_read_training(struct mo_http *http, int64_t id, struct mo_training_status *status,
                     struct mo_training_live *live)
{
  int code = mo_store_training(http->services.store, id, status);
  *live = (struct mo_training_live){.seconds_left = -1};
  if (code == MO_OK && !mo_job_state_is_final(status->job.state)) {
    code = mo_jobs_training_live(http->services.jobs, id, live);
    if (code == MO_ERR_NOT_FOUND)
      code = MO_OK;
  }
  return code;
}

/* Returns the kind of the job whose designs a training learns from. */
static enum mo_job_kind population_kind(struct mo_http *http,
                                        const struct mo_training_status *status)
{
  enum mo_job_kind kind = MO_JOB_EVALUATION;
  struct mo_job *job = status->record.population > 0 ? malloc(sizeof(*job)) : NULL;
  if (job != NULL && mo_store_job(http->services.store, status->record.population, job) == MO_OK)
    kind = job->kind;
  free(job);
  return kind;
}

static void reply_training(struct mo_request *request, unsigned http_status, int64_t id)
{
  struct mo_training_status *status = malloc(sizeof(*status));
  struct mo_training_live live;
  struct mo_text text = {0};
  int code = status != NULL ? mo_read_training(request->http, id, status, &live) : MO_ERR_NO_MEMORY;
  if (code != MO_OK) {
    mo_reply_error(request, code, "training");
    free(status);
    return;
  }
  bool final = mo_job_state_is_final(status->job.state);
  mo_training_json_write(&text, status, population_kind(request->http, status), &live);
  free(status);
  mo_reply_json(request, http_status, &text);
  if (request->reply.status != http_status)
    return;
  mo_reply_etag_of_body(request);
  if (request->wait_s >= 0 && http_status == 200)
    snprintf(request->reply.applied, sizeof(request->reply.applied), "wait=%d", request->wait_s);
  if (!final)
    request->reply.retry_after_s = 1;
}

/* Parses and stores the training. False: a reply was made. */
static bool submit(struct mo_request *request, const struct mo_submission_key *key,
                   struct mo_faults *faults)
{
  struct mo_http *http = request->http;
  struct mo_parsed_training *parsed = malloc(sizeof(*parsed));
  if (parsed == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "training");
    return false;
  }
  int code = mo_training_parse(request->body, request->body_size, parsed, faults);
  if (code == MO_OK) /* the job with this id may be of another kind */
    mo_look_up_job(http->services.store, parsed->request.population, parsed->population_kind,
                   population_pointer(parsed), faults);
  if (code == MO_OK && faults->n > 0)
    mo_look_up_controller(http->services.store, parsed->request.parent, faults);
  if (code == MO_OK && faults->n > 0) {
    code = MO_ERR_INVALID;
    mo_reply_problem(request, 422, faults, NULL);
  } else if (code == MO_OK) {
    struct mo_message message = {""};
    bool replayed;
    parsed->request.idempotency_key = key->key[0] != '\0' ? key->key : NULL;
    parsed->request.body_sha256 = key->body_sha256;
    code = mo_jobs_submit_training(http->services.jobs, &parsed->request, &request->submitted,
                                   &replayed, &message);
    if (code != MO_OK)
      submission_error(request, parsed, key, code, &message, faults);
  } else {
    if (code == MO_ERR_INVALID)
      look_up(http->services.store, parsed, faults);
    mo_reply_parse_error(request, code, faults, "training");
  }
  mo_training_parsed_free(parsed);
  free(parsed);
  return code == MO_OK;
}

void mo_handle_trainings_post(struct mo_request *request)
{
  if (!mo_handle_submission(request, "training", submit))
    return;
  reply_training(request, 202, request->submitted);
  if (request->reply.status == 202)
    snprintf(request->reply.location, sizeof(request->reply.location), "/v1/trainings/%lld",
             (long long)request->submitted);
}

/* ---- reading ---- */

static void reply_now(struct mo_request *request, struct mo_job *job)
{
  reply_training(request, 200, job->id);
}

enum mo_handled mo_handle_training(struct mo_request *request)
{
  return mo_handle_job_of(request, MO_JOB_TRAINING, "training", reply_now);
}

void mo_handle_trainings(struct mo_request *request)
{
  static const char *const names[] = {"state", "limit", "cursor", "label"};
  struct mo_http *http = request->http;
  struct mo_query_value values[4];
  struct mo_job_query query = {.state = -1, .kind = -1};
  int64_t waiting[MO_WAITING_MAX];
  size_t limit;
  if (!mo_query_read(request, names, values, 4) || !mo_accepts_json(request) ||
      !mo_query_limit(request, &values[1], &limit) ||
      !mo_query_state(request, &values[0], &query.state) ||
      !mo_query_label(request, &values[3], &query.label) ||
      !mo_query_before(request, &values[2], &query.before))
    return;
  query.waiting = waiting;
  query.n_waiting = mo_jobs_waiting(http->services.jobs, waiting);
  struct mo_training_status *page = malloc(limit * sizeof(*page));
  int64_t n = page != NULL ? mo_store_trainings(http->services.store, &query, page, limit)
                           : MO_ERR_NO_MEMORY;
  struct mo_text text = {0};
  const char *comma = "";
  mo_text_add(&text, "{\"items\":[");
  for (int64_t i = 0; i < n; i++) {
    struct mo_training_live live = {.seconds_left = -1};
    if (!mo_job_state_is_final(page[i].job.state))
      mo_jobs_training_live(http->services.jobs, page[i].job.id, &live);
    if (query.state >= 0 && mo_training_state(&page[i], &live) != (enum mo_job_state)query.state)
      continue; /* it has just started or stopped waiting */
    mo_text_add(&text, comma);
    comma = ",";
    mo_training_json_write(&text, &page[i], population_kind(http, &page[i]), &live);
  }
  mo_reply_page(request, &text, n, limit, n > 0 ? page[n - 1].job.id : 0);
  free(page);
}

/* ---- curves ---- */

/* One page of either curve; the curves differ only in their rows. */
struct curve {
  struct mo_store *store;
  bool validations;
  int64_t id, after; /* after −1: from step 0 */
  uint32_t stride;
  union {
    struct mo_training_step_row *steps;
    struct mo_training_validation_row *validations;
    void *any;
  } rows;
};

static int64_t read_rows(const struct curve *curve, size_t limit)
{
  return curve->validations ? mo_store_training_validations(curve->store, curve->id, curve->after,
                                                            curve->rows.validations, limit)
                            : mo_store_training_steps(curve->store, curve->id,
                                                      curve->after > 0 ? (uint32_t)curve->after : 0,
                                                      curve->stride, curve->rows.steps, limit);
}

static int64_t step_of_row(const struct curve *curve, int64_t i)
{
  return curve->validations ? curve->rows.validations[i].step : curve->rows.steps[i].report.step;
}

static void write_row(struct mo_text *text, const struct curve *curve, int64_t i, bool csv)
{
  if (curve->validations && csv)
    mo_training_csv_validation(text, &curve->rows.validations[i]);
  else if (curve->validations)
    mo_training_json_validation(text, &curve->rows.validations[i]);
  else if (csv)
    mo_training_csv_step(text, &curve->rows.steps[i]);
  else
    mo_training_json_step(text, &curve->rows.steps[i]);
}

/* Writes up to `limit` rows, page by page. *more: there may be more rows. */
static int write_rows(struct mo_text *text, struct curve *curve, size_t limit, bool csv, bool *more)
{
  size_t written = 0;
  *more = true;
  while (written < limit) {
    size_t wanted = limit - written < MO_PAGE_MAX ? limit - written : MO_PAGE_MAX;
    int64_t n = read_rows(curve, wanted);
    if (n < 0)
      return (int)n;
    for (int64_t i = 0; i < n; i++, written++) {
      if (!csv && text->size > 0 && text->data[text->size - 1] == '}')
        mo_text_bytes(text, ",", 1);
      write_row(text, curve, i, csv);
    }
    if (n > 0)
      curve->after = step_of_row(curve, n - 1);
    if ((size_t)n < wanted) {
      *more = false;
      break;
    }
  }
  return MO_OK;
}

static void reply_curve(struct mo_request *request, struct curve *curve, size_t limit, bool csv)
{
  struct mo_text text = {0};
  bool more;
  mo_text_add(&text, !csv                 ? "{\"items\":["
                     : curve->validations ? mo_training_csv_validations
                                          : mo_training_csv_steps);
  int code = write_rows(&text, curve, limit, csv, &more);
  if (code != MO_OK || (csv && text.failed)) {
    mo_text_free(&text);
    mo_reply_error(request, code != MO_OK ? code : MO_ERR_NO_MEMORY, "page");
    return;
  }
  if (csv) {
    mo_reply_bytes(request, 200, "text/csv; charset=utf-8; header=present", text.data, text.size);
    if (more)
      mo_reply_extra(request, "Morphod-Next-After", "%lld", (long long)curve->after);
  } else {
    if (curve->after >= 0)
      mo_text_format(&text, "],\"next_after\":%lld,\"more\":%s", (long long)curve->after,
                     more ? "true" : "false");
    else
      mo_text_add(&text, "],\"next_after\":null,\"more\":false");
    mo_text_add(&text, "}");
    mo_reply_json(request, 200, &text);
  }
  mo_reply_etag_of_body(request);
}

static void handle_curve(struct mo_request *request, bool validations)
{
  static const char *const names[] = {"after", "limit", "format", "stride"};
  static const char *const forms[] = {"json", "csv"};
  static const char *const types[] = {"application/json", "text/csv"};
  struct mo_query_value values[4] = {0};
  int64_t id, after = validations ? -1 : 0, stride = 1, limit = MO_PAGE_MAX;
  int form;
  if (!mo_query_read(request, names, values, validations ? 3 : 4) ||
      !mo_query_form(request, &values[2], forms, types, 2, &form))
    return;
  if (form == 1)
    limit = CSV_ROWS_MAX;
  if (!mo_query_number(request, "after", &values[0], 0, UINT32_MAX, &after) ||
      !mo_query_number(request, "limit", &values[1], 1, MO_PAGE_MAX, &limit) ||
      !mo_query_number(request, "stride", &values[3], 1, MO_TRAINING_STEPS_MAX, &stride) ||
      !mo_path_id(request, 0, &id) || !mo_job_is(request, id, MO_JOB_TRAINING, "training"))
    return;
  struct curve curve = {.store = request->http->services.store,
                        .validations = validations,
                        .id = id,
                        .after = after,
                        .stride = (uint32_t)stride};
  curve.rows.any = malloc(
      MO_PAGE_MAX * (validations ? sizeof(*curve.rows.validations) : sizeof(*curve.rows.steps)));
  if (curve.rows.any == NULL)
    mo_reply_error(request, MO_ERR_NO_MEMORY, "page");
  else
    reply_curve(request, &curve, (size_t)limit, form == 1);
  free(curve.rows.any);
}

void mo_handle_training_steps(struct mo_request *request)
{
  handle_curve(request, false);
}

void mo_handle_training_validations(struct mo_request *request)
{
  handle_curve(request, true);
}

void mo_handle_training_checkpoints(struct mo_request *request)
{
  struct mo_query_value none;
  struct mo_checkpoint_row rows[MO_CHECKPOINTS_KEPT_MAX];
  int64_t id;
  if (!mo_query_read(request, NULL, &none, 0) || !mo_accepts_json(request) ||
      !mo_path_id(request, 0, &id) || !mo_job_is(request, id, MO_JOB_TRAINING, "training"))
    return;
  int64_t n =
      mo_store_checkpoints(request->http->services.store, id, rows, MO_CHECKPOINTS_KEPT_MAX);
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

void mo_handle_training_checkpoints_delete(struct mo_request *request)
{
  struct mo_query_value none;
  struct mo_checkpoints_removed removed;
  const char *text = request->parameters[1];
  bool one = request->route == MO_ROUTE_TRAINING_CHECKPOINT;
  int64_t id, step = 0;
  if (!mo_query_read(request, NULL, &none, 0) || !mo_accepts_json(request) ||
      !mo_path_id(request, 0, &id) || !mo_job_is(request, id, MO_JOB_TRAINING, "training"))
    return;
  int code = one && !mo_decimal(text, strlen(text), 1, MO_TRAINING_STEPS_MAX, &step)
                 ? MO_ERR_NOT_FOUND
                 : MO_OK;
  if (code == MO_OK)
    code = mo_store_checkpoints_remove(request->http->services.store, id, MO_JOB_TRAINING,
                                       (uint32_t)step, &removed);
  if (code == MO_ERR_NOT_FOUND) {
    mo_reply_problem(request, 404, NULL,
                     "The training keeps no checkpoint of this step; GET "
                     "/v1/trainings/%lld/checkpoints lists them.",
                     (long long)id);
  } else if (code == MO_ERR_CONFLICT) {
    mo_reply_problem(request, 409, NULL,
                     "The training has not ended and goes on from its newest checkpoint, that of "
                     "step %lld, after a restart "
                     "or a pause; it can be deleted when the training has ended or was cancelled.",
                     (long long)step);
  } else if (code != MO_OK) {
    mo_reply_error(request, code, "checkpoint");
  } else {
    struct mo_text reply = {0};
    mo_text_add(&reply, "{\"removed\":[");
    for (size_t i = 0; i < removed.n; i++)
      mo_text_format(&reply, "%s%u", i > 0 ? "," : "", removed.places[i].step);
    mo_text_add(&reply, "]");
    mo_text_member_count(&reply, "bytes", removed.bytes);
    mo_text_add(&reply, "}");
    mo_reply_json(request, 200, &reply);
  }
}
