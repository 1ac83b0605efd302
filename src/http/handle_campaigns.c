/* handle_campaigns.c: campaigns: submission, state, lists, control, checkpoints. See
 * handle_curves.c for their curves, and handle_phylogeny.c for their designs. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "http/campaign_json.h"
#include "http/campaign_request.h"
#include "http/field.h"
#include "http/server.h"

/* ---- POST /v1/campaigns ---- */

/* Checks that what the request names exists, and adds all faults to those of the body. */
static void look_up(struct mo_store *store, const struct mo_parsed_campaign *parsed,
                    struct mo_faults *faults)
{
  mo_look_up_controller(store, parsed->request.controller, faults);
  mo_look_up_job(store, parsed->request.record.initial_campaign, MO_JOB_CAMPAIGN,
                 "/initial/campaign", faults);
}

/* Adds a fault for a listed design that the jobs room refused. */
static void design_fault(uint32_t place, const char *words, struct mo_faults *faults)
{
  char pointer[40] = "";
  if (place != UINT32_MAX)
    snprintf(pointer, sizeof(pointer), "/initial/designs/%u", place);
  mo_faults_add(faults, MO_FAULT_BODY, pointer, "%s", words);
}

static void submission_error(struct mo_request *request, const struct mo_parsed_campaign *parsed,
                             const struct mo_submission_key *key, int code, uint32_t place,
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
  case MO_ERR_DUPLICATE:
  case MO_ERR_INVALID:
  case MO_ERR_RANGE:
  case MO_ERR_LIMIT:
    design_fault(place, words, faults);
    mo_reply_problem(request, 422, faults, NULL);
    break;
  case MO_ERR_CONFLICT:
    if (mo_key_conflicts(store, key) || parsed->request.record.initial_campaign == 0) {
      mo_reply_key_conflict(request, faults);
    } else {
      mo_faults_add(faults, MO_FAULT_BODY, "/initial/campaign", "%s", words);
      mo_reply_problem(request, 409, faults, NULL);
    }
    break;
  case MO_ERR_DEVICE:
    mo_faults_add(faults, MO_FAULT_BODY, "/device", "%s", words);
    mo_reply_problem(request, 422, faults, NULL);
    break;
  case MO_ERR_BUSY: mo_reply_queue_full(request); break;
  default: mo_reply_error(request, code, "campaign"); break;
  }
}

int mo_read_campaign(struct mo_http *http, int64_t id, struct mo_campaign_status *status,
                     struct mo_campaign_live *live)
{
  int code = mo_store_campaign(http->services.store, id, status);
  *live = (struct mo_campaign_live){.seconds_left = -1};
  if (code == MO_OK && !mo_job_state_is_final(status->job.state)) {
    code = mo_jobs_campaign_live(http->services.jobs, id, live);
    if (code == MO_ERR_NOT_FOUND)
      code = MO_OK;
  }
  return code;
}

/* Writes the campaign as the reply. On an error no reply is made yet. */
static int write_reply(struct mo_request *request, unsigned http_status, int64_t id)
{
  struct mo_campaign_status *status = malloc(sizeof(*status));
  struct mo_campaign_live live;
  struct mo_text text = {0};
  int code = status != NULL ? mo_read_campaign(request->http, id, status, &live) : MO_ERR_NO_MEMORY;
  if (code != MO_OK) {
    free(status);
    return code;
  }
  bool final = mo_job_state_is_final(status->job.state);
  mo_campaign_json_write(&text, status, &live);
  free(status);
  mo_reply_json(request, http_status, &text);
  if (request->reply.status != http_status)
    return MO_OK;
  mo_reply_etag_of_body(request);
  if (request->wait_s >= 0 && http_status == 200)
    snprintf(request->reply.applied, sizeof(request->reply.applied), "wait=%d", request->wait_s);
  if (!final && request->method != MO_POST)
    request->reply.retry_after_s = 1;
  return MO_OK;
}

static void reply_campaign(struct mo_request *request, unsigned http_status, int64_t id)
{
  int code = write_reply(request, http_status, id);
  if (code != MO_OK)
    mo_reply_error(request, code, "campaign");
}

/* Parses and stores the campaign. False: a reply was made. */
static bool submit(struct mo_request *request, const struct mo_submission_key *key,
                   struct mo_faults *faults)
{
  struct mo_http *http = request->http;
  struct mo_parsed_campaign *parsed = malloc(sizeof(*parsed));
  if (parsed == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "campaign");
    return false;
  }
  int code = mo_campaign_parse(request->body, request->body_size, parsed, faults);
  if (code == MO_OK) {
    struct mo_message message = {""};
    uint32_t place = UINT32_MAX;
    bool replayed;
    parsed->request.idempotency_key = key->key[0] != '\0' ? key->key : NULL;
    parsed->request.body_sha256 = key->body_sha256;
    code = mo_jobs_submit_campaign(http->services.jobs, &parsed->request, &request->submitted,
                                   &replayed, &place, &message);
    if (code != MO_OK)
      submission_error(request, parsed, key, code, place, &message, faults);
  } else {
    if (code == MO_ERR_INVALID)
      look_up(http->services.store, parsed, faults);
    mo_reply_parse_error(request, code, faults, "campaign");
  }
  mo_campaign_parsed_free(parsed);
  free(parsed);
  return code == MO_OK;
}

void mo_handle_campaigns_post(struct mo_request *request)
{
  if (!mo_handle_submission(request, "campaign", submit))
    return;
  reply_campaign(request, 202, request->submitted);
  if (request->reply.status == 202) {
    request->reply.retry_after_s = 1;
    snprintf(request->reply.location, sizeof(request->reply.location), "/v1/campaigns/%lld",
             (long long)request->submitted);
  }
}

/* ---- reading ---- */

static void reply_now(struct mo_request *request, struct mo_job *job)
{
  reply_campaign(request, 200, job->id);
}

enum mo_handled mo_handle_campaign(struct mo_request *request)
{
  return mo_handle_job_of(request, MO_JOB_CAMPAIGN, "campaign", reply_now);
}

static void reply_list(struct mo_request *request, const struct mo_campaign_query *query,
                       size_t limit)
{
  struct mo_http *http = request->http;
  struct mo_campaign_status *page = malloc(limit * sizeof(*page));
  int64_t n = page != NULL ? mo_store_campaigns(http->services.store, query, page, limit)
                           : MO_ERR_NO_MEMORY;
  struct mo_text text = {0};
  const char *comma = "";
  mo_text_add(&text, "{\"items\":[");
  for (int64_t i = 0; i < n; i++) {
    struct mo_campaign_live live = {.seconds_left = -1};
    if (!mo_job_state_is_final(page[i].job.state))
      mo_jobs_campaign_live(http->services.jobs, page[i].job.id, &live);
    if (query->state >= 0 &&
        mo_campaign_state_shown(&page[i], &live) != (enum mo_job_state)query->state)
      continue; /* it has just started or stopped waiting */
    mo_text_add(&text, comma);
    comma = ",";
    mo_campaign_json_write(&text, &page[i], &live);
  }
  mo_reply_page(request, &text, n, limit, n > 0 ? page[n - 1].job.id : 0);
  free(page);
}

void mo_handle_campaigns(struct mo_request *request)
{
  static const char *const names[] = {"state", "group", "limit", "cursor", "label"};
  struct mo_query_value values[5];
  int64_t waiting[MO_WAITING_MAX];
  struct mo_campaign_query query = {.state = -1,
                                    .waiting = waiting,
                                    .n_waiting =
                                        mo_jobs_waiting(request->http->services.jobs, waiting)};
  size_t limit;
  if (!mo_query_read(request, names, values, 5) || !mo_accepts_json(request) ||
      !mo_query_limit(request, &values[2], &limit) ||
      !mo_query_state(request, &values[0], &query.state) ||
      !mo_query_label(request, &values[4], &query.label) ||
      !mo_query_before(request, &values[3], &query.before))
    return;
  if (values[1].present && !mo_id(values[1].text, &query.group))
    mo_reply_bad_parameter(request, "group", "the id of a group, in decimal digits, is expected");
  else
    reply_list(request, &query, limit);
}

/* ---- control ---- */

void mo_handle_campaign_change(struct mo_request *request)
{
  struct mo_http *http = request->http;
  struct mo_query_value none;
  int64_t id;
  if (!mo_query_read(request, NULL, &none, 0) || !mo_accepts_json(request) ||
      !mo_path_id(request, 0, &id) || !mo_job_is(request, id, MO_JOB_CAMPAIGN, "campaign"))
    return;
  bool pause = request->route == MO_ROUTE_CAMPAIGN_PAUSE,
       resume = request->route == MO_ROUTE_CAMPAIGN_RESUME;
  int code = pause    ? mo_jobs_pause(http->services.jobs, id)
             : resume ? mo_jobs_resume(http->services.jobs, id)
                      : mo_jobs_cancel(http->services.jobs, id);
  struct mo_job *job = malloc(sizeof(*job));
  if (code == MO_ERR_CONFLICT && job != NULL &&
      mo_store_job(http->services.store, id, job) == MO_OK)
    mo_reply_problem(request, 409, NULL, "The campaign cannot be %s: it is %s.",
                     pause    ? "paused"
                     : resume ? "resumed"
                              : "cancelled",
                     mo_job_state_name(job->state));
  else if (code != MO_OK)
    mo_reply_error(request, code, "campaign");
  else if ((code = write_reply(request, 200, id)) != MO_OK)
    mo_reply_error(request, code, "campaign");
  free(job);
}

static void extension_error(struct mo_request *request, int64_t id, int code,
                            const struct mo_message *message, struct mo_faults *faults)
{
  const char *words = message->text[0] != '\0' ? message->text : mo_error_text(code);
  struct mo_campaign_status *status = code == MO_ERR_CONFLICT ? malloc(sizeof(*status)) : NULL;
  switch (code) {
  case MO_ERR_CONFLICT:
    if (status == NULL || mo_store_campaign(request->http->services.store, id, status) != MO_OK)
      mo_reply_error(request, code, "campaign");
    else
      mo_reply_problem(request, 409, NULL, "The campaign cannot be extended: it %s%s.",
                       status->end == MO_CAMPAIGN_EXHAUSTED
                           ? "has exhausted its morphospace, of which nothing new is left"
                           : "is ",
                       status->end == MO_CAMPAIGN_EXHAUSTED ? ""
                                                            : mo_job_state_name(status->job.state));
    break;
  case MO_ERR_UNSUPPORTED:
  case MO_ERR_EMPTY:
    mo_reply_problem(request, 409, NULL, "The campaign cannot be extended: %s.", words);
    break;
  case MO_ERR_DUPLICATE: mo_reply_key_conflict(request, faults); break;
  case MO_ERR_INVALID:
  case MO_ERR_RANGE:
  case MO_ERR_LIMIT:
    mo_faults_add(faults, MO_FAULT_BODY, "/generations", "%s", words);
    mo_reply_problem(request, 422, faults, NULL);
    break;
  case MO_ERR_BUSY: mo_reply_queue_full(request); break;
  default: mo_reply_error(request, code, "campaign"); break;
  }
  free(status);
}

static bool extend(struct mo_request *request, const struct mo_submission_key *key,
                   struct mo_faults *faults)
{
  struct mo_message message = {""};
  struct mo_request_key known;
  uint32_t generations = 0;
  int64_t id;
  if (!mo_path_id(request, 0, &id) || !mo_job_is(request, id, MO_JOB_CAMPAIGN, "campaign"))
    return false;
  int code = mo_extension_parse(request->body, request->body_size, &generations, faults);
  if (code != MO_OK) {
    mo_reply_parse_error(request, code, faults, "campaign");
    return false;
  }
  code = mo_jobs_extend_campaign(request->http->services.jobs, id, generations,
                                 mo_submission_key_of(key, "extend", id, &known), &message);
  if (code != MO_OK)
    extension_error(request, id, code, &message, faults);
  request->submitted = id;
  return code == MO_OK;
}

void mo_handle_campaign_extend(struct mo_request *request)
{
  if (mo_handle_submission(request, "campaign", extend))
    reply_campaign(request, 200, request->submitted);
}

/* ---- checkpoints ---- */

static bool begin_checkpoints(struct mo_request *request, int64_t *id)
{
  struct mo_query_value none;
  return mo_query_read(request, NULL, &none, 0) && mo_accepts_json(request) &&
         mo_path_id(request, 0, id) && mo_job_is(request, *id, MO_JOB_CAMPAIGN, "campaign");
}

void mo_handle_campaign_checkpoints(struct mo_request *request)
{
  struct mo_checkpoint_row rows[MO_CHECKPOINTS_MAX];
  struct mo_text text = {0};
  int64_t id;
  if (!begin_checkpoints(request, &id))
    return;
  int64_t n = mo_store_checkpoints(request->http->services.store, id, rows, MO_CHECKPOINTS_MAX);
  if (n < 0) {
    mo_reply_error(request, (int)n, "page");
    return;
  }
  mo_text_add(&text, "{\"items\":[");
  for (int64_t i = 0; i < n; i++) {
    mo_text_add(&text, i > 0 ? "," : "");
    mo_campaign_json_checkpoint(&text, &rows[i]);
  }
  mo_text_add(&text, "]}");
  mo_reply_json(request, 200, &text);
  mo_reply_etag_of_body(request);
}

void mo_handle_campaign_checkpoints_delete(struct mo_request *request)
{
  struct mo_checkpoints_removed removed;
  struct mo_text text = {0};
  int64_t id;
  if (!begin_checkpoints(request, &id))
    return;
  int code =
      mo_store_checkpoints_remove(request->http->services.store, id, MO_JOB_CAMPAIGN, 0, &removed);
  if (code != MO_OK) {
    mo_reply_error(request, code, "campaign");
    return;
  }
  mo_text_add(&text, "{\"removed\":[");
  for (size_t i = 0; i < removed.n; i++)
    mo_text_format(&text, "%s{\"generation\":%u,\"step\":%u}", i > 0 ? "," : "",
                   removed.places[i].generation, removed.places[i].step);
  mo_text_add(&text, "]");
  mo_text_member_count(&text, "bytes", removed.bytes);
  mo_text_add(&text, "}");
  mo_reply_json(request, 200, &text);
}
