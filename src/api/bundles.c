/* bundles.c: campaigns as one file: out of this service, and into it. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/bundle.h"
#include "api/job_json.h"
#include "api/jobs.h"
#include "http/download.h"

/* ---- out ---- */

/* Checks that a campaign has ended, and is no study. False: the reply is made. */
static bool check_ended(struct mo_request *request, int64_t id, struct mo_campaign_status *status)
{
  const int error = mo_store_campaign(mo_api_of(request)->store, id, status);
  const enum mo_job_state state = status->job.state;
  if (error != MO_OK)
    mo_reply_error(request, error, "campaign");
  else if (state != MO_JOB_SUCCEEDED && state != MO_JOB_CANCELLED)
    mo_reply_problem(request, 409, NULL,
                     "Campaign %lld is %s; a bundle takes campaigns that have succeeded or were "
                     "cancelled.",
                     (long long)id, mo_job_state_name(state));
  else if (status->record.settings.mode == MO_STUDY)
    mo_reply_problem(request, 409, NULL, "Campaign %lld is a study; bundles do not take them.",
                     (long long)id);
  else
    return true;
  return false;
}

/* Checks that a reader would take as many recordings. */
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
      mo_reply_error(request, error, "campaign");
      return false;
    }
    sum += rollouts;
  }
  if (sum <= MO_BUNDLE_ROLLOUTS)
    return true;
  mo_reply_problem(request, 409, NULL,
                   "%llu rollouts of these campaigns' designs are recorded; a bundle takes up to "
                   "%d. Name fewer campaigns, or delete recordings.",
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
                     "These are %u campaigns; a bundle has 1 to %u.", n, MO_BUNDLE_CAMPAIGNS);
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
  else /* what a member and the compression take */
    mo_download_open(request, MO_ARCHIVE_TYPE, NULL, (uint64_t)8 << 20, mo_bundle_export_more,
                     export, mo_bundle_export_free);
}

/* ---- in ---- */

/* One import: of a bundle in memory, of which a first reading made the summary. */
struct entry {
  struct mo_api *api;
  const char *bytes;
  size_t size;
  const struct mo_bundle_summary *summary;
  struct mo_message *message;
  struct mo_import *import;
  uint32_t at; /* the campaign that is entered */
  int64_t ids[MO_BUNDLE_CAMPAIGNS];
  bool entered[MO_BUNDLE_CAMPAIGNS];
  uint64_t n_scores; /* losses that were not stored */
};

static int write_file(void *context, const struct mo_controller *controller,
                      const struct mo_sha256 *sha256, const char *bytes, size_t size)
{
  const struct entry *entry = context;
  (void)controller;
  return mo_store_import_file(entry->api->store, sha256, (const uint8_t *)bytes, size);
}

/* Ends the reading: the controllers come before. */
static int end_of_files(void *context, const struct mo_imported_campaign *campaign)
{
  (void)context;
  (void)campaign;
  return MO_ERR_CANCELLED;
}

static int enter_controller(void *context, const struct mo_controller *controller,
                            const struct mo_sha256 *sha256, const char *bytes, size_t size)
{
  const struct entry *entry = context;
  (void)bytes;
  return mo_import_controller(entry->import, controller, sha256, size);
}

static int enter_campaign(void *context, const struct mo_imported_campaign *campaign)
{
  struct entry *entry = context;
  int64_t *id = &entry->ids[entry->at];
  int error = mo_import_find(entry->import, &campaign->source, id);
  entry->entered[entry->at] = error == MO_ERR_NOT_FOUND;
  if (error == MO_ERR_NOT_FOUND)
    error = mo_import_campaign(entry->import, campaign, id);
  else if (error == MO_OK)
    error = 0;
  const bool entered = entry->entered[entry->at++];
  return error != MO_OK ? error : entered;
}

static int enter_design(void *context, const struct mo_campaign_design *design)
{
  return mo_import_design(((struct entry *)context)->import, design);
}

static int enter_generation(void *context, const struct mo_campaign_generation *row,
                            const struct mo_descent *births,
                            const struct mo_campaign_member *members, uint32_t n)
{
  return mo_import_generation(((struct entry *)context)->import, row, births, members, n);
}

static int enter_step(void *context, const struct mo_campaign_step *step)
{
  return mo_import_step(((struct entry *)context)->import, step);
}

static int enter_evaluation(void *context, const struct mo_imported_evaluation *evaluation)
{
  struct entry *entry = context;
  const int error = mo_import_evaluation(entry->import, evaluation);
  return error == MO_ERR_NOT_FOUND
             ? mo_fail(entry->message, MO_ERR_FORMAT,
                       "the bundle lacks losses of what evaluation %lld recorded",
                       (long long)evaluation->source.job)
             : error;
}

static int enter_rollout(void *context, const struct mo_saved_trajectory *rollout)
{
  return mo_import_rollout(((struct entry *)context)->import, rollout);
}

static int enter_score(void *context, const struct mo_campaign_score *score)
{
  struct entry *entry = context;
  bool is_new = false;
  const int error = mo_import_score(entry->import, score, &is_new);
  entry->n_scores += is_new ? score->n : 0;
  return error == MO_ERR_CONFLICT
             ? mo_fail(entry->message, error,
                       "a loss of design %u of campaign %lld is not the one that is stored here "
                       "for the same rollout and class",
                       score->number,
                       (long long)entry->summary->campaigns[entry->at - 1].source.job)
             : error;
}

/* Enters all of it, in the writer's transaction. */
static int enter_all(void *context, struct mo_import *import)
{
  static const struct mo_bundle_sink sink = {NULL,         enter_controller, enter_campaign,
                                             enter_design, enter_generation, enter_step,
                                             enter_score,  enter_evaluation, enter_rollout};
  struct entry *entry = context;
  struct mo_bundle_sink own = sink;
  struct mo_bundle_summary *again = calloc(1, sizeof(*again));
  if (again == NULL)
    return MO_ERR_NO_MEMORY;
  own.context = entry;
  entry->import = import;
  entry->at = 0;
  entry->n_scores = 0;
  const int error = mo_bundle_read(entry->bytes, entry->size, entry->api->lattice, &own,
                                   entry->summary, again, entry->message);
  free(again);
  return error;
}

static int enter(struct entry *entry)
{
  const struct mo_bundle_sink files = {
      .context = entry, .controller = write_file, .campaign = end_of_files};
  struct mo_store *store = entry->api->store;
  struct mo_bundle_summary *again = calloc(1, sizeof(*again));
  if (again == NULL)
    return MO_ERR_NO_MEMORY;
  mo_store_import_begin(store);
  int error = mo_bundle_read(entry->bytes, entry->size, entry->api->lattice, &files, NULL, again,
                             entry->message);
  free(again);
  if (error == MO_ERR_CANCELLED)
    error = mo_store_import(store, enter_all, entry);
  mo_store_import_end(store);
  return error;
}

/* Finds which campaigns are here already; ids 0: they are not. Returns how many are not. */
static int find_known(struct entry *entry)
{
  int n = 0;
  for (uint32_t i = 0; i < entry->summary->n; i++) {
    const int error = mo_store_import_find(entry->api->store, &entry->summary->campaigns[i].source,
                                           &entry->ids[i]);
    if (error != MO_OK && error != MO_ERR_NOT_FOUND)
      return error;
    if (error == MO_ERR_NOT_FOUND)
      entry->ids[i] = 0;
    n += error == MO_ERR_NOT_FOUND;
  }
  return n;
}

static void reply_entered(struct mo_request *request, const struct entry *entry, bool is_new)
{
  struct mo_text text = {0};
  mo_text_object(&text);
  mo_text_open(&text, "items", "[");
  for (uint32_t i = 0; i < entry->summary->n; i++) {
    const struct mo_bundle_campaign *campaign = &entry->summary->campaigns[i];
    mo_text_object(&text);
    mo_text_member_id(&text, "campaign", entry->ids[i] > 0 ? entry->ids[i] : -1);
    mo_text_member_bool(&text, "entered", entry->entered[i]);
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
  mo_text_member_count(&text, "controllers", entry->summary->n_controllers);
  mo_text_member_count(&text, "losses_stored", entry->n_scores);
  mo_text_add(&text, "}");
  mo_reply_json(request, is_new ? 201 : 200, &text);
}

/* Replies why a bundle is refused. */
static void reply_refusal(struct mo_request *request, int error, const struct mo_message *message)
{
  struct mo_faults faults = {0};
  if (error == MO_ERR_FORMAT || error == MO_ERR_INVALID || error == MO_ERR_LIMIT) {
    mo_faults_add(&faults, MO_FAULT_BODY, "", "%s",
                  message->text[0] != '\0' ? message->text
                                           : "replicates of one group differ in their worlds");
    mo_reply_problem(request, 422, &faults, "The bundle is refused, and nothing of it was stored.");
  } else if (error == MO_ERR_CONFLICT) {
    mo_reply_problem(request, 409, NULL, "The bundle is refused, and nothing of it was stored: %s.",
                     message->text);
  } else {
    mo_reply_error(request, error, "bundle");
  }
}

void mo_api_post_bundle(struct mo_request *request)
{
  static const char *const modes[] = {"enter", "verify", NULL};
  static const struct mo_bundle_sink nothing = {0};
  struct mo_api *api = mo_api_of(request);
  struct mo_message message = {""};
  int mode = 0;
  if (!mo_check_content(request, MO_ARCHIVE_TYPE, "application/octet-stream") ||
      !mo_query_word(request, "mode", modes, &mode))
    return;
  struct mo_bundle_summary *summary = calloc(1, sizeof(*summary));
  struct entry *entry = calloc(1, sizeof(*entry));
  int error = summary != NULL && entry != NULL ? MO_OK : MO_ERR_NO_MEMORY, n_new = 0;
  if (error == MO_OK) {
    *entry = (struct entry){.api = api,
                            .bytes = request->body,
                            .size = request->body_size,
                            .summary = summary,
                            .message = &message};
    error = mo_bundle_read(request->body, request->body_size, api->lattice, &nothing, NULL, summary,
                           &message);
  }
  if (error == MO_OK)
    n_new = find_known(entry);
  if (error == MO_OK && n_new < 0)
    error = n_new;
  if (error == MO_OK && mode == 0 && n_new > 0)
    error = enter(entry);
  if (error != MO_OK)
    reply_refusal(request, error, &message);
  else
    reply_entered(request, entry, mode == 0 && n_new > 0);
  free(summary);
  free(entry);
}
