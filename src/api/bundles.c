/* bundles.c: campaigns as one file: out of this service, and into it. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/bundle.h"
#include "api/job_json.h"
#include "api/jobs.h"
#include "http/download.h"
#include "store/import_compare.h"

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
  struct mo_request *request;
  struct mo_api *api;
  const char *bytes;
  size_t size;
  struct mo_bundle_summary *summary;
  struct mo_message *message;
  struct mo_import_comparison rows; /* of the first reading */
  struct mo_import *import;
  uint32_t at; /* campaigns so far */
  int64_t ids[MO_BUNDLE_CAMPAIGNS];
  bool entered[MO_BUNDLE_CAMPAIGNS], is_own[MO_BUNDLE_CAMPAIGNS]; /* is_own: it ran here */
  struct mo_text lasting[MO_BUNDLE_CAMPAIGNS]; /* what nobody changes of a campaign */
  uint64_t n_scores;                           /* losses that were not stored */
};

static bool is_over(void *context)
{
  return mo_request_is_over(((struct entry *)context)->request);
}

static int read_bundle(struct entry *entry, struct mo_bundle_sink sink,
                       const struct mo_bundle_summary *known, struct mo_bundle_summary *summary)
{
  sink.context = entry;
  sink.is_over = is_over;
  return mo_bundle_read(entry->bytes, entry->size, entry->api->lattice, &sink, known, summary,
                        entry->message);
}

/* ---- the first reading: what is stored of the same rollouts must be the same ---- */

/* Writes what neither a person nor an extension changes of a campaign. */
static void write_lasting(const struct mo_imported_campaign *campaign, struct mo_text *text)
{
  static const struct mo_sha256 none;
  struct mo_imported_campaign *lasting = malloc(sizeof(*lasting));
  if (lasting == NULL) {
    text->failed = true;
    return;
  }
  *lasting = *campaign;
  lasting->source = (struct mo_import_source){.store = 0};
  lasting->record.group = lasting->record.replicate = 0;
  lasting->record.settings.generations = 0;
  lasting->record.environment_set[0] = '\0'; /* a name that may mean other environments here */
  lasting->state = MO_JOB_SUCCEEDED;
  lasting->end = MO_CAMPAIGN_OPEN;
  lasting->has_label = lasting->has_result = false;
  lasting->result_sha256 = none;
  lasting->experiment[0] = lasting->note[0] = '\0';
  lasting->weight = 1;
  lasting->started_us = lasting->finished_us = 0;
  lasting->generation = -1;
  lasting->n_designs = 0;
  lasting->diversity_max = 0;
  mo_fields_write_object(text, &mo_bundle_campaign_fields, lasting);
  free(lasting);
}

static int compare_campaign(void *context, const struct mo_imported_campaign *campaign)
{
  struct entry *entry = context;
  write_lasting(campaign, &entry->lasting[entry->at++]);
  const int error = mo_compare_campaign(entry->api->store, &entry->rows, campaign);
  return error == MO_OK ? 1 : error;
}

static int compare_design(void *context, const struct mo_campaign_design *design)
{
  struct entry *entry = context;
  return mo_compare_design(entry->api->store, &entry->rows, design);
}

static int refuse_score(const struct entry *entry, uint32_t number)
{
  return mo_fail(entry->message, MO_ERR_CONFLICT,
                 "a loss of design %u of campaign %lld is not the one that is stored here for the "
                 "same rollout and class",
                 number, (long long)entry->summary->campaigns[entry->at - 1].source.job);
}

static int compare_score(void *context, const struct mo_campaign_score *score)
{
  struct entry *entry = context;
  const int error = mo_compare_score(entry->api->store, &entry->rows, score);
  return error == MO_ERR_CONFLICT ? refuse_score(entry, score->number) : error;
}

static int compare_evaluation(void *context, const struct mo_imported_evaluation *evaluation)
{
  struct entry *entry = context;
  return mo_compare_evaluation(entry->api->store, &entry->rows, evaluation);
}

static int compare_rollout(void *context, const struct mo_saved_trajectory *rollout)
{
  struct entry *entry = context;
  const int error = mo_compare_rollout(entry->api->store, &entry->rows, rollout);
  return error == MO_ERR_CONFLICT
             ? mo_fail(entry->message, error,
                       "evaluation %lld is here, and recorded something else in environment %u of "
                       "design %u",
                       (long long)entry->rows.evaluation, rollout->environment_position,
                       rollout->design_position)
             : error;
}

/* Checks all of the bundle, and fills in the summary. */
static int check(struct entry *entry)
{
  static const struct mo_bundle_sink sink = {.campaign = compare_campaign,
                                             .design = compare_design,
                                             .score = compare_score,
                                             .evaluation = compare_evaluation,
                                             .rollout = compare_rollout};
  const int error = read_bundle(entry, sink, NULL, entry->summary);
  mo_compare_end(&entry->rows);
  return error;
}

/* ---- entering ---- */

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
  return MO_ERR_EXHAUSTED;
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
  int error =
      mo_import_find(entry->import, &campaign->source, entry->is_own[entry->at] ? *id : 0, id);
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
  return error == MO_ERR_CONFLICT ? refuse_score(entry, score->number) : error;
}

/* Enters all of it, in the writer's transaction. */
static int enter_all(void *context, struct mo_import *import)
{
  static const struct mo_bundle_sink sink = {.controller = enter_controller,
                                             .campaign = enter_campaign,
                                             .design = enter_design,
                                             .generation = enter_generation,
                                             .step = enter_step,
                                             .score = enter_score,
                                             .evaluation = enter_evaluation,
                                             .rollout = enter_rollout};
  struct entry *entry = context;
  struct mo_bundle_summary *again = calloc(1, sizeof(*again));
  if (again == NULL)
    return MO_ERR_NO_MEMORY;
  entry->import = import;
  entry->at = 0;
  entry->n_scores = 0;
  const int error = read_bundle(entry, sink, entry->summary, again);
  free(again);
  return error;
}

static int enter(struct entry *entry)
{
  static const struct mo_bundle_sink files = {.controller = write_file, .campaign = end_of_files};
  struct mo_store *store = entry->api->store;
  struct mo_bundle_summary *again = calloc(1, sizeof(*again));
  if (again == NULL)
    return MO_ERR_NO_MEMORY;
  mo_store_import_begin(store);
  int error = read_bundle(entry, files, NULL, again);
  free(again);
  if (error == MO_ERR_EXHAUSTED)
    error = mo_store_import(store, enter_all, entry);
  mo_store_import_end(store);
  return error;
}

/* ---- which campaigns are here already ---- */

/* Finds the campaign that ran here, if its history is that of the bundle. MO_ERR_NOT_FOUND. */
static int find_own(struct entry *entry, const struct mo_import_source *source, int64_t *id)
{
  struct mo_store *store = entry->api->store;
  struct mo_sha256 digest;
  int error = mo_store_import_own(store, source, id);
  if (error == MO_OK)
    error = mo_bundle_digest(store, *id, is_over, entry, &digest);
  if (error != MO_OK)
    return error;
  return mo_sha256_equal(&digest, &source->digest) ? MO_OK : MO_ERR_NOT_FOUND;
}

/* Checks that a campaign with the history of the i-th one has its settings, too. */
static int compare_lasting(struct entry *entry, uint32_t i)
{
  struct mo_campaign_status *status = malloc(sizeof(*status));
  struct mo_imported_campaign *stored = malloc(sizeof(*stored));
  const struct mo_text *lasting = &entry->lasting[i];
  const struct mo_bundle_campaign *campaign = &entry->summary->campaigns[i];
  struct mo_text text = {0};
  int error = status == NULL || stored == NULL
                  ? MO_ERR_NO_MEMORY
                  : mo_bundle_describe(entry->api->store, entry->ids[i], status, stored);
  if (error == MO_ERR_CONFLICT) { /* somebody extends it just now */
    error = MO_OK;
  } else if (error == MO_OK) {
    write_lasting(stored, &text);
    const bool same_result = stored->generation != campaign->generation ||
                             (stored->has_result == campaign->has_result &&
                              mo_sha256_equal(&stored->result_sha256, &campaign->result_sha256));
    if (text.failed || lasting->failed)
      error = MO_ERR_NO_MEMORY;
    else if (!same_result || text.size != lasting->size ||
             memcmp(text.data, lasting->data, text.size) != 0)
      error = mo_fail(entry->message, MO_ERR_CONFLICT,
                      "campaign %lld is here as campaign %lld, with the same history, but with "
                      "other settings, controllers or times",
                      (long long)campaign->source.job, (long long)entry->ids[i]);
  }
  mo_text_free(&text);
  free(status);
  free(stored);
  return error;
}

/* Finds which campaigns are here already; ids 0: they are not. Returns how many are not. */
static int find_known(struct entry *entry)
{
  int n = 0;
  for (uint32_t i = 0; i < entry->summary->n; i++) {
    const struct mo_import_source *source = &entry->summary->campaigns[i].source;
    int error = find_own(entry, source, &entry->ids[i]);
    entry->is_own[i] = error == MO_OK;
    if (error == MO_ERR_NOT_FOUND)
      error = mo_store_import_find(entry->api->store, source, &entry->ids[i]);
    if (error == MO_OK)
      error = compare_lasting(entry, i);
    else if (error == MO_ERR_NOT_FOUND)
      entry->ids[i] = 0;
    if (error != MO_OK && error != MO_ERR_NOT_FOUND)
      return error;
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
    *entry = (struct entry){.request = request,
                            .api = api,
                            .bytes = request->body,
                            .size = request->body_size,
                            .summary = summary,
                            .message = &message};
    error = check(entry);
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
  for (uint32_t i = 0; entry != NULL && i < MO_BUNDLE_CAMPAIGNS; i++)
    mo_text_free(&entry->lasting[i]);
  free(summary);
  free(entry);
}
