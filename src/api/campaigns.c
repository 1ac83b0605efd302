/* campaigns.c: campaigns: submission, state, extension. See curves.c for their curves, phylogeny.c
 * for their designs, and champions.c. */
#include <stdio.h>

#include "api/campaign_json.h"
#include "api/jobs.h"
#include "api/requests.h"
#include "api/submission.h"

static int read_status(struct mo_store *store, int64_t id, union mo_job_status *status)
{
  return mo_store_campaign(store, id, &status->campaign);
}

static int64_t read_page(struct mo_store *store, const struct mo_job_query *query, void *statuses,
                         size_t limit)
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

/* ---- submission ---- */

/* Parses and stores the campaign. */
static int submit(struct mo_request *request, struct mo_post *post)
{
  struct mo_api *api = mo_api_of(request);
  struct mo_faults *faults = &post->faults;
  struct mo_parsed_campaign parsed;
  uint32_t place = UINT32_MAX; /* of a listed design that the jobs room refused */
  bool replayed;
  int error = mo_campaign_parse(request->body, request->body_size, &parsed, faults);
  const int64_t initial = parsed.request.record.initial_campaign;
  if (error == MO_OK) {
    post->parsed = true;
    post->pointers.conflict = initial > 0 ? "/initial/campaign" : NULL;
    parsed.request.idempotency_key = mo_post_key(post);
    parsed.request.body_sha256 = post->body_sha256;
    error = mo_jobs_submit_campaign(api->jobs, &parsed.request, &request->kept, &replayed, &place,
                                    &post->message);
  }
  if (place != UINT32_MAX)
    snprintf(post->place, sizeof(post->place), "/initial/designs/%u", place);
  post->pointers.invalid = post->pointers.limit = post->place;
  if (mo_names_unknown(post, error)) {
    mo_look_up_controller(api->store, parsed.request.controller, faults);
    mo_look_up_job(api->store, initial, MO_JOB_CAMPAIGN, "/initial/campaign", faults);
  }
  mo_parts_free(&parsed.parts);
  return error;
}

void mo_api_post_campaign(struct mo_request *request)
{
  if (mo_handle_submission(request, "campaign", submit))
    mo_reply_submitted(request, &mo_campaign_resource, request->kept, false);
}

/* ---- extension ---- */

static void reply_not_extended(struct mo_request *request, int64_t id, int error)
{
  struct mo_campaign_status status;
  if (mo_store_campaign(mo_api_of(request)->store, id, &status) != MO_OK)
    mo_reply_error(request, error, "campaign");
  else if (status.end == MO_CAMPAIGN_EXHAUSTED)
    mo_reply_problem(request, 409, NULL,
                     "The campaign cannot be extended: it has exhausted its morphospace, of which "
                     "nothing new is left.");
  else
    mo_reply_problem(request, 409, NULL, "The campaign cannot be extended: it is %s.",
                     mo_job_state_name(status.job.state));
}

static int extend(struct mo_request *request, struct mo_post *post)
{
  struct mo_request_key known;
  uint32_t generations = 0;
  int64_t id;
  if (!mo_path_job(request, &id))
    return MO_ERR_NOT_FOUND;
  int error = mo_extension_parse(request->body, request->body_size, &generations, &post->faults);
  if (error != MO_OK)
    return error;
  post->parsed = true;
  post->pointers.invalid = post->pointers.limit = "/generations";
  error = mo_jobs_extend_campaign(mo_api_of(request)->jobs, id, generations,
                                  mo_post_key_of(post, "extend", id, &known), &post->message);
  if (error == MO_ERR_CONFLICT)
    reply_not_extended(request, id, error);
  else if (error == MO_ERR_UNSUPPORTED || error == MO_ERR_EMPTY)
    mo_reply_problem(request, 409, NULL, "The campaign cannot be extended: %s.",
                     mo_post_words(post, error));
  else if (error == MO_ERR_DUPLICATE)
    mo_reply_key_conflict(request, &post->faults);
  request->kept = id;
  return error;
}

void mo_api_extend_campaign(struct mo_request *request)
{
  if (mo_handle_submission(request, "campaign", extend))
    mo_reply_job(request, 200, &mo_campaign_resource, request->kept, true);
}
