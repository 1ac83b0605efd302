/* campaigns.c: campaigns: submission, state, lists, extension. See curves.c for their curves, and
 * phylogeny.c for their designs. */
#include <stdio.h>
#include <stdlib.h>

#include "api/campaign_json.h"
#include "api/job_reply.h"
#include "api/requests.h"
#include "api/submission.h"

/* ---- the kind ---- */

static int read_status(struct mo_store *store, int64_t id, void *status)
{
  return mo_store_campaign(store, id, status);
}

static int64_t read_page(struct mo_store *store, const struct mo_campaign_query *query,
                         void *statuses, size_t limit)
{
  return mo_store_campaigns(store, query, statuses, limit);
}

static int write_whole(struct mo_api *api, struct mo_text *text, const void *status,
                       const struct mo_live *live)
{
  (void)api;
  mo_campaign_json_write(text, status, live);
  return MO_OK;
}

const struct mo_resource mo_campaign_resource = {.kind = MO_JOB_CAMPAIGN,
                                                 .path = "/v1/campaigns",
                                                 .status_size = sizeof(struct mo_campaign_status),
                                                 .read = read_status,
                                                 .page = read_page,
                                                 .has_live = true,
                                                 .write = write_whole,
                                                 .write_job = mo_campaign_json_job};

/* ---- routes ---- */

/* Checks that what the request names exists, and adds all faults to those of the body. */
static void look_up(struct mo_store *store, const struct mo_parsed_campaign *parsed,
                    struct mo_faults *faults)
{
  mo_look_up_controller(store, parsed->request.controller, faults);
  mo_look_up_job(store, parsed->request.record.initial_campaign, MO_JOB_CAMPAIGN,
                 "/initial/campaign", faults);
}

/* Parses and stores the campaign. False: a reply was made. */
static bool submit(struct mo_request *request, const struct mo_submission_key *key,
                   struct mo_faults *faults)
{
  struct mo_api *api = mo_api_of(request);
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
    code = mo_jobs_submit_campaign(api->jobs, &parsed->request, &request->kept, &replayed, &place,
                                   &message);
    if (code == MO_ERR_NOT_FOUND || code == MO_ERR_UNSUPPORTED)
      look_up(api->store, parsed, faults);
    char design[40] = ""; /* a listed one that the jobs room refused */
    if (place != UINT32_MAX)
      snprintf(design, sizeof(design), "/initial/designs/%u", place);
    const struct mo_refusal_pointers pointers = {
        .invalid = design,
        .limit = design,
        .conflict = parsed->request.record.initial_campaign > 0 ? "/initial/campaign" : NULL};
    if (code != MO_OK)
      mo_reply_not_stored(request, key, code, &message, &pointers, faults, "campaign");
  } else {
    if (code == MO_ERR_INVALID)
      look_up(api->store, parsed, faults);
    mo_reply_parse_error(request, code, faults, "campaign");
  }
  mo_campaign_parsed_free(parsed);
  free(parsed);
  return code == MO_OK;
}

void mo_api_post_campaign(struct mo_request *request)
{
  if (mo_handle_submission(request, "campaign", submit))
    mo_reply_submitted(request, &mo_campaign_resource, request->kept, false);
}

void mo_api_get_campaign(struct mo_request *request)
{
  mo_get_of_kind(request, &mo_campaign_resource);
}

void mo_api_list_campaigns(struct mo_request *request)
{
  const char *text = mo_query(request, "group");
  int64_t group = 0;
  if (text != NULL && !mo_id(text, &group))
    mo_reply_bad_parameter(request, "group", "the id of a group, in decimal digits, is expected");
  else
    mo_list_of_kind(request, &mo_campaign_resource, group);
}

static void extension_error(struct mo_request *request, const struct mo_submission_key *key,
                            int64_t id, int code, const struct mo_message *message,
                            struct mo_faults *faults)
{
  static const struct mo_refusal_pointers pointers = {.invalid = "/generations",
                                                      .limit = "/generations"};
  const char *words = message->text[0] != '\0' ? message->text : mo_error_text(code);
  struct mo_campaign_status *status = code == MO_ERR_CONFLICT ? malloc(sizeof(*status)) : NULL;
  switch (code) {
  case MO_ERR_CONFLICT:
    if (status == NULL || mo_store_campaign(mo_api_of(request)->store, id, status) != MO_OK)
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
  default: mo_reply_not_stored(request, key, code, message, &pointers, faults, "campaign"); break;
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
  if (!mo_path_job(request, MO_JOB_CAMPAIGN, &id))
    return false;
  int code = mo_extension_parse(request->body, request->body_size, &generations, faults);
  if (code != MO_OK) {
    mo_reply_parse_error(request, code, faults, "campaign");
    return false;
  }
  code = mo_jobs_extend_campaign(mo_api_of(request)->jobs, id, generations,
                                 mo_submission_key_of(key, "extend", id, &known), &message);
  if (code != MO_OK)
    extension_error(request, key, id, code, &message, faults);
  request->kept = id;
  return code == MO_OK;
}

void mo_api_extend_campaign(struct mo_request *request)
{
  if (mo_handle_submission(request, "campaign", extend))
    mo_reply_of_kind(request, 200, &mo_campaign_resource, request->kept);
}
