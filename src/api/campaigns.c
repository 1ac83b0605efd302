/* campaigns.c: campaigns: submission, state, extension. See curves.c for their curves, phylogeny.c
 * for their designs, and champions.c. */
#include <stdio.h>
#include <stdlib.h>

#include "api/job_json.h"
#include "api/jobs.h"
#include "api/study_compare.h"
#include "api/submission.h"
#include "base/words.h"
#include "certificate/held_out.h"
#include "exchange/columns.h"
#include "store/fields.h"
#include "store/runner.h"
#include "store/worlds.h"

/* ---- as JSON ---- */

static void write_initial(struct mo_text *text, const struct mo_campaign_record *record)
{
  if (record->initial_campaign > 0)
    mo_text_format(text, ",\"initial\":{\"campaign\":\"%lld\"}",
                   (long long)record->initial_campaign);
  else if (record->n_listed > 0)
    mo_text_format(text, ",\"initial\":{\"n_designs\":%u}", record->n_listed);
  else
    mo_text_member(text, "initial", "random");
}

/* Writes notes on the listed designs that were skipped or repaired. */
static int write_notes(struct mo_api *api, struct mo_text *text,
                       const struct mo_campaign_status *status)
{
  struct mo_design_note *notes = NULL;
  uint32_t n = 0;
  const int error = !mo_modes[status->record.settings.mode].makes_children
                        ? MO_OK /* its notes are those of its newest batch */
                        : mo_store_design_notes(api->store, status->record.group, &notes, &n);
  mo_member_notes(text, "founders", notes, n);
  free(notes);
  return error;
}

static void write_settings(struct mo_text *text, const struct mo_campaign_status *status)
{
  const struct mo_campaign_record *record = &status->record;
  struct mo_campaign_record shown = *record; /* a copy with values instead of null */
  struct mo_campaign_settings *settings = &shown.settings;
  if (settings->mutation_rate == 0)
    settings->mutation_rate = 1.0 / mo_workspace_voxels(settings->workspace);
  if (settings->batch == 0)
    settings->batch = settings->population;
  if (status->job.has_controller)
    settings->sensor = (enum mo_sensor) - 1; /* null: the sensor of the controller */
  mo_text_add(text, ",\"settings\":{");
  mo_fields_write(text, &mo_campaign_record_fields, &shown);
  mo_member_environments(text, record->environment_set, record->n_environments);
  write_initial(text, record);
  mo_text_name(text, "learning");
  if (!mo_modes[settings->mode].learns)
    mo_text_add(text, "null");
  else
    mo_fields_write_object(text, &mo_campaign_record_learning_fields, &shown);
  mo_text_add(text, "}");
}

static void write_group(struct mo_text *text, const struct mo_campaign_record *record)
{
  mo_text_format(text, ",\"group\":{\"id\":\"%lld\",\"replicate\":%u,\"replicates\":%u}",
                 (long long)record->group, record->replicate, record->replicates);
}

static void write_progress(struct mo_text *text, const struct mo_campaign_status *status,
                           const struct mo_live *live)
{
  bool runs = live->phase != MO_PHASE_IDLE;
  mo_text_format(text, ",\"progress\":{\"generations\":%u", status->record.settings.generations);
  mo_member_count_if(text, "generation", status->generation >= 0, (uint64_t)status->generation);
  mo_member_count_if(text, "under_way", runs, live->position);
  mo_text_member_count(text, "done", runs ? live->done : 0);
  mo_text_member_count(text, "total", runs ? live->total : 0);
  mo_text_member_count(text, "designs", status->n_designs);
  mo_member_number_if(text, "rollouts_per_s", runs && live->rate > 0, live->rate);
  mo_member_number_if(text, "seconds_left", runs && live->seconds_left >= 0, live->seconds_left);
  mo_member_number_if(text, "busy_s", runs && live->busy_s >= 0, live->busy_s);
  mo_text_add(text, "}");
}

static void write_words(struct mo_text *text, const char *name,
                        const char words[][MO_STUDY_WORD_MAX + 1], uint32_t n)
{
  mo_text_open(text, name, "[");
  for (uint32_t i = 0; i < n; i++)
    mo_text_format(text, i > 0 ? ",\"%s\"" : "\"%s\"", words[i]);
  mo_text_add(text, "]");
}

void mo_member_own_score(struct mo_text *text, const struct mo_own_score *own)
{
  if (!mo_own_score_is_set(own))
    return;
  mo_text_name(text, "own_score");
  mo_own_score_field.write(text, own);
}

void mo_member_fresh_worlds(struct mo_text *text, const struct mo_campaign_record *record)
{
  const int set = mo_word_index(mo_set_words, record->environment_set);
  const struct mo_certificate_base base = {.set = set >= 0 ? mo_set_words[set] : NULL};
  if (record->re_evaluate.every > 0)
    mo_text_member(text, "fresh_worlds", mo_fresh_kind(&base));
}

static void write_study(struct mo_text *text, const struct mo_campaign_status *status)
{
  mo_text_add(text, ",\"study\":{");
  mo_text_member_count(text, "next_batch", (uint64_t)(status->generation + 1));
  mo_text_member_bool(text, "pending", status->told > status->generation);
  write_words(text, "operators", status->words.operators, status->words.n_operators);
  write_words(text, "measures", status->words.measures, status->words.n_measures);
  mo_text_name(text, "own_score");
  mo_own_score_field.write(text, mo_campaign_takes_scores(&status->record)
                                     ? &status->record.own_score
                                     : &(const struct mo_own_score){.name = ""});
  if (status->sampler_bytes > 0) {
    mo_text_add(text, ",\"sampler\":{");
    mo_member_hash(text, "sha256", &status->sampler_sha256);
    mo_text_member_count(text, "size", status->sampler_bytes);
    mo_text_add(text, "}");
  } else {
    mo_text_member(text, "sampler", NULL);
  }
  mo_text_add(text, "}");
}

/* Returns the live state to show: a study without a pending batch waits for its client. */
static struct mo_live with_wait(const struct mo_campaign_status *status, const struct mo_live *live)
{
  struct mo_live shown = *live;
  if (!mo_modes[status->record.settings.mode].makes_children &&
      status->told <= status->generation && status->job.state == MO_JOB_QUEUED) {
    shown.phase = MO_PHASE_WAIT;
    snprintf(shown.reason, sizeof(shown.reason), "waiting for batch %lld from the study's client",
             (long long)status->generation + 1);
  }
  return shown;
}

void mo_campaign_json_write(struct mo_text *text, const struct mo_campaign_status *status,
                            const struct mo_live *running)
{
  static const char *const ends[] = {[MO_CAMPAIGN_OPEN] = NULL,
                                     [MO_CAMPAIGN_COMPLETED] = "completed",
                                     [MO_CAMPAIGN_EXHAUSTED] = "exhausted"};
  static const char *const below[] = {"generations", "generations", "learning",    "learning",
                                      "population",  "population",  "phylogeny",   "phylogeny",
                                      "champions",   "champions",   "checkpoints", "checkpoints",
                                      "replicates",  "replicates",  NULL};
  const struct mo_campaign_record *record = &status->record;
  const struct mo_live waiting = with_wait(status, running), *live = &waiting;
  char made[MO_MADE_BYTES];
  const char *name = mo_result_name(&status->job, record->name, made);
  mo_text_object(text);
  mo_text_member_id(text, "id", status->job.id);
  mo_text_member(text, "mode", mo_campaign_mode_words[record->settings.mode]);
  mo_text_member(text, "preset", record->preset[0] != '\0' ? record->preset : NULL);
  mo_text_member(text, "name", mo_modes[record->settings.mode].learns ? name : NULL);
  mo_job_write_head(text, &status->job, live);
  mo_text_member(text, "phase", mo_phase_name(live->phase));
  mo_member_controller(text, "controller", status->job.has_controller, status->job.controller_name,
                       &status->job.controller_sha256);
  write_settings(text, status);
  write_group(text, record);
  write_progress(text, status, live);
  mo_text_member(text, "end", ends[status->end]);
  mo_member_own_score(text, &record->own_score);
  if (!mo_modes[record->settings.mode].makes_children)
    write_study(text, status);
  else
    mo_text_member(text, "study", NULL);
  mo_text_name(text, "newest");
  mo_columns_json(text, &mo_generation_columns, status->generation >= 0 ? &status->last : NULL);
  if (status->job.has_result) {
    mo_text_add(text, ",\"result\":{");
    mo_member_controller(text, "controller", true, name, &status->job.result_sha256);
    mo_text_add(text, "}");
  } else {
    mo_text_member(text, "result", NULL);
  }
  if (status->source_campaign > 0) {
    mo_text_format(text, ",\"imported\":{\"store\":\"%016llx\"",
                   (unsigned long long)status->source_store);
    mo_text_member_id(text, "campaign", status->source_campaign);
    mo_text_member_time(text, "at", status->imported_us);
    mo_text_add(text, "}");
  } else {
    mo_text_member(text, "imported", NULL);
  }
  mo_links_write(text, &status->job, below);
}

void mo_campaign_json_job(struct mo_text *text, const void *any, const struct mo_live *live)
{
  const struct mo_campaign_status *status = any;
  const struct mo_live waiting = with_wait(status, live);
  mo_text_object(text);
  mo_text_member_id(text, "id", status->job.id);
  mo_text_member(text, "kind", mo_job_kind_name(status->job.kind));
  mo_job_write_head(text, &status->job, &waiting);
  mo_text_format(text, ",\"campaign\":{\"mode\":\"%s\"",
                 mo_campaign_mode_words[status->record.settings.mode]);
  mo_text_member_count(text, "population", status->record.settings.population);
  mo_member_count_if(text, "generation", status->generation >= 0, (uint64_t)status->generation);
  mo_text_member_count(text, "generations", status->record.settings.generations);
  write_group(text, &status->record);
  mo_text_member_count(text, "seed", status->record.settings.seed);
  mo_member_environments(text, status->record.environment_set, status->record.n_environments);
  mo_text_member_number(text, "best_score", status->best_score);
  mo_member_own_score(text, &status->record.own_score);
  mo_text_add(text, "}}");
}

/* ---- the kind ---- */

static int read_status(struct mo_store *store, int64_t id, union mo_job_status *status)
{
  return mo_store_campaign(store, id, &status->campaign);
}

static int write_whole(struct mo_api *api, struct mo_text *text, const void *status,
                       const struct mo_live *live, bool is_listed)
{
  mo_campaign_json_write(text, status, live);
  const int error = is_listed ? MO_OK : write_notes(api, text, status);
  mo_text_add(text, "}");
  return error;
}

const struct mo_resource mo_campaign_resource = {.kind = MO_JOB_CAMPAIGN,
                                                 .path = "/v1/campaigns",
                                                 .status_size = sizeof(struct mo_campaign_status),
                                                 .read = read_status,
                                                 .page = mo_store_campaigns,
                                                 .write = write_whole,
                                                 .write_job = mo_campaign_json_job};

/* ---- submission ---- */

/* Checks that the study with this label has the requested settings. Only then stores the key,
 * because the key of a rejected request would answer the next one. reference: the requested
 * controller, or NULL. */
static int check_found(struct mo_request *request, struct mo_post *post, const char *reference)
{
  struct mo_store *store = mo_api_of(request)->store;
  struct mo_controller_record controller = {0};
  struct mo_campaign_status status;
  struct mo_environment *environments = NULL;
  uint32_t n = 0;
  int error = mo_store_campaign(store, request->kept, &status);
  if (error == MO_OK)
    error = mo_store_job_environments(store, request->kept, MO_JOB_CAMPAIGN, &environments, &n);
  if (error == MO_OK && reference != NULL)
    error = mo_store_controller(store, reference, &controller);
  if (error == MO_OK)
    error = mo_study_compare(request->body, request->body_size, &status, environments,
                             &controller.sha256, &post->faults);
  mo_environments_free(environments, n);
  if (error == MO_OK && post->faults.n == 0)
    error = mo_store_keep_key(store, &post->key, request->kept);
  if (error != MO_OK || post->faults.n == 0)
    return error;
  mo_reply_problem(request, 409, &post->faults,
                   "Study %lld has this label, but its settings differ from the request. Use its "
                   "settings or another label, or finish it first.",
                   (long long)request->kept);
  return MO_ERR_CONFLICT;
}

/* Parses and stores the campaign. */
static int submit(struct mo_request *request, struct mo_post *post)
{
  struct mo_api *api = mo_api_of(request);
  struct mo_faults *faults = &post->faults;
  struct mo_parsed_campaign parsed;
  bool replayed;
  int error = mo_campaign_parse(request->body, request->body_size, &parsed, faults);
  const int64_t initial = parsed.request.record.initial_campaign;
  if (error == MO_OK) {
    post->parsed = true;
    post->pointers.conflict = post->pointers.empty = initial > 0 ? "/initial/campaign" : NULL;
    mo_post_sign(request, post, &parsed.request.job);
    error = mo_jobs_submit_campaign(api->jobs, &parsed.request, &request->kept, &replayed,
                                    &post->message);
  }
  if (error == MO_ERR_DUPLICATE)
    error =
        check_found(request, post, parsed.parts.has_controller ? parsed.request.controller : NULL);
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

static int check_extension(struct mo_json *json, void *generations)
{
  if (*(uint32_t *)generations == 0 && json->faults->n == 0)
    mo_json_fault_at(json, 0, "", "generations is missing; it must be a positive integer");
  return MO_OK;
}

static void reply_not_extended(struct mo_request *request, int64_t id, int error)
{
  struct mo_campaign_status status;
  if (mo_store_campaign(mo_api_of(request)->store, id, &status) != MO_OK)
    mo_reply_error(request, error, "campaign");
  else if (status.end == MO_CAMPAIGN_EXHAUSTED)
    mo_reply_problem(request, 409, NULL,
                     "The campaign cannot be extended: it has exhausted its morphospace, and no "
                     "new design is left.");
  else
    mo_reply_problem(request, 409, NULL, "The campaign cannot be extended: it is %s.",
                     mo_job_state_name(status.job.state));
}

static int extend(struct mo_request *request, struct mo_post *post)
{
  static const struct mo_field rows[] = {
      {"generations", MO_FIELD_COUNT, 0, 0, .min = 1, .max = MO_GENERATIONS_MAX}};
  static const struct mo_fields fields = MO_FIELDS(rows);
  struct mo_request_key known;
  uint32_t generations = 0;
  struct mo_job job;
  int64_t id;
  if (!mo_path_id(request, 0, &id) || !mo_job_of_kind(request, &mo_campaign_resource, id, &job))
    return MO_ERR_NOT_FOUND;
  int error = mo_read_body(request->body, request->body_size, &fields, &generations, NULL,
                           check_extension, &post->faults);
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
