/* bundles.c: exports campaigns as one file, and imports such files. */
#include <stdio.h>
#include <stdlib.h>

#include "api/job_json.h"
#include "api/jobs.h"
#include "exchange/bundle_import.h"
#include "http/download.h"

/* ---- export ---- */

/* Checks that a campaign has ended and is not a study. Returns false if it has replied. */
static bool check_ended(struct mo_request *request, int64_t id, struct mo_campaign_status *status)
{
  const int error = mo_store_campaign(mo_api_of(request)->store, id, status);
  const enum mo_job_state state = status->job.state;
  if (error != MO_OK)
    mo_reply_job_error(request, error, "campaign", id);
  else if (state != MO_JOB_SUCCEEDED && state != MO_JOB_CANCELLED)
    mo_reply_problem(request, 409, NULL,
                     "Campaign %lld is %s; a bundle can hold only campaigns that have succeeded or "
                     "were cancelled.",
                     (long long)id, mo_job_state_name(state));
  else if (!mo_modes[status->record.settings.mode].makes_children)
    mo_reply_problem(request, 409, NULL, "Campaign %lld is a study; bundles cannot hold studies.",
                     (long long)id);
  else
    return true;
  return false;
}

/* Checks that the number of recordings is not more than a service would import. */
static bool check_recordings(struct mo_request *request, const int64_t *ids, uint32_t n)
{
  uint64_t sum = 0;
  for (uint32_t i = 0; i < n; i++) {
    int64_t *evaluations = NULL;
    uint64_t rollouts = 0;
    uint32_t found;
    const int error = mo_store_campaign_recordings(mo_api_of(request)->store, ids[i], &evaluations,
                                                   &found, &rollouts);
    free(evaluations);
    if (error != MO_OK) {
      mo_reply_job_error(request, error, "campaign", ids[i]);
      return false;
    }
    sum += rollouts;
  }
  if (sum <= MO_BUNDLE_ROLLOUTS)
    return true;
  mo_reply_problem(request, 409, NULL,
                   "These campaigns have %llu recorded rollouts, but a bundle can hold at "
                   "most %d. Select fewer campaigns, or delete recordings.",
                   (unsigned long long)sum, MO_BUNDLE_ROLLOUTS);
  return false;
}

static bool check_all(struct mo_request *request, const int64_t *ids, uint32_t n)
{
  struct mo_campaign_status *status = malloc(sizeof(*status));
  bool good = status != NULL;
  if (!good)
    mo_reply_error(request, MO_ERR_NO_MEMORY, "bundle");
  else if (n == 0 || n > MO_BUNDLE_CAMPAIGNS)
    mo_reply_problem(request, n == 0 ? 404 : 400, NULL,
                     "The request selects %u campaigns, but a bundle must have 1 to %u.", n,
                     MO_BUNDLE_CAMPAIGNS);
  good = good && n > 0 && n <= MO_BUNDLE_CAMPAIGNS;
  for (uint32_t i = 0; i < n && good; i++)
    good = check_ended(request, ids[i], status);
  free(status);
  return good;
}

void mo_api_get_bundle(struct mo_request *request)
{
  static const char *const types[] = {MO_ARCHIVE_TYPE, "application/octet-stream", NULL};
  struct mo_api *api = mo_api_of(request);
  char program[64];
  int64_t *ids = NULL;
  uint32_t n = 0;
  static const char *const flags[] = {"false", "true", NULL};
  int form, with_recordings = 0;
  if (!mo_accept(request, types, &form) ||
      !mo_query_word(request, "recordings", flags, &with_recordings) ||
      !mo_find_campaigns(request, &ids, &n))
    return;
  if (!check_all(request, ids, n) || (with_recordings != 0 && !check_recordings(request, ids, n))) {
    free(ids);
    return;
  }
  snprintf(program, sizeof(program), "morphod %s", api->version);
  struct mo_bundle_export *export =
      mo_bundle_export_create(api->store, program, ids, n, with_recordings != 0);
  if (export == NULL)
    mo_reply_error(request, MO_ERR_NO_MEMORY, "bundle");
  else /* reserves memory for a member and for the compression */
    mo_download_open(request, MO_ARCHIVE_TYPE, NULL, (uint64_t)8 << 20, mo_bundle_export_more,
                     export, mo_bundle_export_free);
}

/* ---- import ---- */

static bool is_over(void *request)
{
  return mo_request_is_over(request);
}

static void reply_entered(struct mo_request *request, const struct mo_bundle_import *import)
{
  struct mo_text text = {0};
  mo_text_object(&text);
  mo_text_open(&text, "items", "[");
  for (uint32_t i = 0; i < import->summary.n; i++) {
    const struct mo_bundle_campaign *campaign = &import->summary.campaigns[i];
    mo_text_object(&text);
    mo_text_member_id(&text, "campaign", import->ids[i] > 0 ? import->ids[i] : -1);
    mo_text_member_bool(&text, "entered", import->entered[i]);
    mo_text_format(&text, ",\"source\":{\"store\":\"%016llx\"",
                   (unsigned long long)campaign->source.store);
    mo_text_member_id(&text, "campaign", campaign->source.job);
    mo_text_add(&text, "}");
    mo_member_hash(&text, "digest", &campaign->source.digest);
    mo_text_member_count(&text, "designs", campaign->n_designs);
    mo_member_count_if(&text, "generation", campaign->generation >= 0,
                       (uint64_t)campaign->generation);
    mo_text_member_count(&text, "losses", campaign->n_scores);
    mo_text_member_count(&text, "recordings", campaign->n_recordings);
    mo_text_add(&text, "}");
  }
  mo_text_add(&text, "]");
  mo_text_member_count(&text, "controllers", import->summary.n_controllers);
  mo_text_member_count(&text, "losses_stored", import->n_scores);
  mo_text_add(&text, "}");
  mo_reply_json(request, import->is_new ? 201 : 200, &text);
}

/* Replies with the reason why a bundle is rejected. */
static void reply_refusal(struct mo_request *request, int error,
                          const struct mo_bundle_import *import, const struct mo_message *message)
{
  struct mo_faults faults = {0};
  const char *stored = import->has_begun
                           ? "no campaign was stored, but some of its designs and scores may be"
                           : "nothing was stored";
  if (error == MO_ERR_FORMAT || error == MO_ERR_INVALID || error == MO_ERR_LIMIT) {
    mo_faults_add(&faults, MO_FAULT_BODY, "", "%s",
                  message->text[0] != '\0' ? message->text
                                           : "the replicates of a group have different worlds");
    mo_reply_problem(request, 422, &faults, "The bundle was refused, and %s.", stored);
  } else if (error == MO_ERR_CONFLICT) {
    mo_reply_problem(request, 409, NULL, "The bundle was refused, and %s: %s.", stored,
                     message->text);
  } else {
    mo_reply_error(request, error, "bundle");
  }
}

void mo_api_post_bundle(struct mo_request *request)
{
  static const char *const modes[] = {"enter", "verify", NULL};
  struct mo_api *api = mo_api_of(request);
  struct mo_message message = {""};
  int mode = 0;
  if (!mo_check_content(request, MO_ARCHIVE_TYPE, "application/octet-stream") ||
      !mo_query_word(request, "mode", modes, &mode))
    return;
  struct mo_bundle_import *import = calloc(1, sizeof(*import));
  if (import == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "bundle");
    return;
  }
  import->store = api->store;
  import->lattice = api->lattice;
  import->bytes = request->body;
  import->size = request->body_size;
  import->is_over = is_over;
  import->context = request;
  const int error = mo_bundle_import(import, mode == 0, &message);
  if (error != MO_OK)
    reply_refusal(request, error, import, &message);
  else
    reply_entered(request, import);
  free(import);
}
