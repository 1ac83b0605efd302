/* studies.c: the actions of the client of a study: submit a batch, read its scores, ask for bodies,
 * fetch the state of its sampler, finish the study. Everything else works as for any campaign. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "api/job_json.h"
#include "api/jobs.h"
#include "api/submission.h"
#include "base/clock.h"
#include "http/pool.h"
#include "store/designs.h"

/* Reads a study. MO_ERR_NOT_FOUND: the campaign is not a study. */
static int read_study(struct mo_request *request, int64_t id, struct mo_campaign_status *status)
{
  const int error = mo_store_campaign(mo_api_of(request)->store, id, status);
  return error == MO_OK && mo_modes[status->record.settings.mode].makes_children ? MO_ERR_NOT_FOUND
                                                                                 : error;
}

/* ---- a batch with its scores ---- */

/* A study's newest batch, with its designs once they are born. */
struct told {
  struct mo_campaign_status status;
  uint32_t n;
  struct mo_study_batch *batch;
  struct mo_campaign_design *designs; /* (n) */
  struct mo_bits *genotypes;          /* (n) */
  struct mo_campaign_loss *losses;    /* (n) */
  double (*measures)[MO_MEASURES];    /* (n, n_environments) space; NULL: the study requests none */
  uint8_t *known;                     /* (n) */
  struct mo_environment *tasks;       /* nullable */
  struct mo_design_note *notes;       /* (n_notes) */
  uint32_t n_notes;
};

static void free_told(struct told *told)
{
  mo_study_batch_free(told->batch);
  free(told->designs);
  free(told->genotypes);
  free(told->losses);
  free(told->measures);
  free(told->known);
  free(told->tasks);
  free(told->notes);
}

static int read_designs(struct mo_api *api, struct told *told)
{
  const int64_t id = told->status.job.id;
  const struct mo_campaign_record *record = &told->status.record;
  const uint32_t n = told->batch->n_children;
  int error = MO_OK;
  told->designs = calloc((size_t)n + 1, sizeof(*told->designs));
  told->genotypes = calloc((size_t)n + 1, sizeof(*told->genotypes));
  told->losses = calloc((size_t)n + 1, sizeof(*told->losses));
  told->known = calloc((size_t)n + 1, 1);
  if (record->measures != 0)
    told->measures = calloc((size_t)n * record->n_environments + 1, sizeof(*told->measures));
  if (told->designs == NULL || told->genotypes == NULL || told->losses == NULL ||
      told->known == NULL || (record->measures != 0 && told->measures == NULL))
    return MO_ERR_NO_MEMORY;
  while (told->n < n && error == MO_OK) {
    const uint32_t left = n - told->n;
    const int64_t found = mo_store_campaign_designs(
        api->store, id, (int64_t)told->status.last.born_before + told->n - 1,
        told->designs + told->n, left < MO_PAGE_MAX ? left : MO_PAGE_MAX);
    error = found < 0 ? (int)found : found == 0 ? MO_ERR_CORRUPT : MO_OK;
    told->n += error == MO_OK ? (uint32_t)found : 0;
  }
  for (uint32_t i = 0; i < told->n; i++)
    memcpy(told->genotypes[i].words, told->designs[i].genotype.words, sizeof(*told->genotypes));
  if (error == MO_OK)
    error = mo_tasks_read(api->store, id, MO_JOB_CAMPAIGN, told->status.record.environment_set,
                          &told->tasks);
  return error == MO_OK ? mo_jobs_study_losses(api->jobs, id, told->genotypes, told->n,
                                               told->losses, told->measures, told->known)
                        : error;
}

/* Writes the losses of a child with the measures that the study names. Their means are among the
 * measures of the design. */
static void write_measured(struct mo_text *text, const struct told *told,
                           const struct mo_campaign_loss *loss)
{
  const uint32_t n = told->status.record.n_environments, set = told->status.record.measures;
  double values[MO_ENVIRONMENTS_MAX * MO_MEASURES];
  uint8_t flags[MO_ENVIRONMENTS_MAX];
  uint32_t place = 0;
  for (uint32_t k = 0; k < n; k++) {
    flags[k] = (uint8_t)mo_measures_flags(loss->measures[k]);
    for (unsigned m = 0; m < MO_MEASURES; m++)
      if (set >> m & 1)
        values[place++] = loss->measures[k][m];
  }
  const struct mo_measured measured = {
      .set = set, .values = values, .flags = flags, .has_means = true};
  mo_members_losses(text, loss->losses, n, told->tasks, &measured);
}

static void write_child(struct mo_text *text, const struct told *told, uint32_t i)
{
  const struct mo_campaign_loss *loss = &told->losses[i];
  mo_text_object(text);
  mo_text_member_count(text, "child", told->batch->children[i].place);
  mo_campaign_json_design(text, &told->designs[i], &told->status.words);
  if (told->known[i] && told->measures != NULL)
    write_measured(text, told, loss);
  else if (told->known[i])
    mo_members_losses(text, loss->losses, told->status.record.n_environments, told->tasks, NULL);
  else
    mo_text_member(text, "losses", NULL);
  mo_text_add(text, "}");
}

/* Replies with the newest batch. status_pending: the HTTP status while it is pending. */
static void reply_batch(struct mo_request *request, int64_t id, unsigned status_pending)
{
  struct mo_api *api = mo_api_of(request);
  struct told told = {.n = 0};
  struct mo_text text = {0};
  int error = mo_store_campaign(api->store, id, &told.status);
  if (error == MO_OK)
    error = mo_store_study_batch(api->store, id, &told.batch);
  if (error == MO_OK)
    error = mo_store_design_notes(api->store, id, &told.notes, &told.n_notes);
  bool is_born = error == MO_OK && told.batch->number == told.status.generation;
  if (is_born)
    error = read_designs(api, &told);
  if (error == MO_OK) {
    mo_text_object(&text);
    mo_text_member_id(&text, "campaign", id);
    mo_text_member_count(&text, "batch", told.batch->number);
    mo_text_member(&text, "state", is_born ? "committed" : "pending");
    mo_text_open(&text, "children", "[");
    for (uint32_t i = 0; i < told.n; i++)
      write_child(&text, &told, i);
    mo_text_add(&text, "]");
    mo_member_notes(&text, "notes", told.notes, told.n_notes);
    mo_text_add(&text, "}");
  }
  free_told(&told);
  if (error == MO_ERR_NOT_FOUND)
    mo_reply_problem(request, 404, NULL, "No batch has been sent yet.");
  else if (error != MO_OK)
    mo_reply_error(request, error, "study");
  else {
    mo_reply_json(request, is_born ? 200 : status_pending, &text);
    request->reply.retry_after_s = is_born ? 0 : 1;
    mo_reply_etag_of_body(request);
    if (request->wait_s >= 0 && is_born)
      snprintf(request->reply.applied, sizeof(request->reply.applied), "wait=%d", request->wait_s);
    if (status_pending == 202)
      snprintf(request->reply.location, sizeof(request->reply.location),
               "/v1/campaigns/%" PRId64 "/batch", id);
  }
  if (error != MO_OK)
    mo_text_free(&text);
}

/* Lets the request wait until no batch is pending. Returns false if it is waiting or has its
 * reply. */
static bool await_batch(struct mo_request *request, int64_t id)
{
  struct mo_campaign_status status;
  const bool may_wait = request->wait_s > 0 && !request->wait_over;
  if (may_wait)
    mo_wait_begin(request, MO_WAIT_BATCH(id), mo_clock_us() + (int64_t)request->wait_s * 1000000);
  const int error = read_study(request, id, &status);
  if (may_wait && error == MO_OK && status.told > status.generation &&
      !mo_job_state_is_final(status.job.state))
    return false;
  if (may_wait)
    mo_wait_end(request);
  if (error != MO_OK)
    mo_reply_error(request, error, "study");
  return error == MO_OK;
}

void mo_api_get_study_batch(struct mo_request *request)
{
  int64_t id;
  mo_read_wait(request);
  if (mo_path_id(request, 0, &id) && await_batch(request, id))
    reply_batch(request, id, 200);
}

/* ---- submitting a batch ---- */

static void reply_refused(struct mo_request *request, struct mo_post *post, int error,
                          const struct mo_telling_reply *reply)
{
  char place[64] = "/children";
  if (error == MO_ERR_CONFLICT) {
    mo_reply_problem(request, 409, NULL, "The batch was refused: %s.", mo_post_words(post, error));
    mo_reply_extra(request, "Morphod-Next-Batch", "%u", reply->next);
    return;
  }
  if (reply->fault == MO_TELLING_PARENT)
    snprintf(place, sizeof(place), "/children/%u/parents", reply->place);
  else if (reply->fault == MO_TELLING_SURVIVOR)
    snprintf(place, sizeof(place), "/survivors/%u", reply->place);
  else if (reply->fault == MO_TELLING_SCORE)
    snprintf(place, sizeof(place), "/children/%u/score", reply->place);
  mo_faults_add(&post->faults, MO_FAULT_BODY, place, "%s", mo_post_words(post, error));
  mo_reply_problem(request, 422, &post->faults, NULL);
}

static int tell(struct mo_request *request, struct mo_post *post)
{
  struct mo_parsed_telling parsed;
  struct mo_telling_reply reply = {.next = 0};
  struct mo_campaign_status status;
  int64_t id;
  if (!mo_path_id(request, 0, &id))
    return MO_ERR_NOT_FOUND;
  int error = read_study(request, id, &status);
  if (error != MO_OK) {
    mo_reply_error(request, error, "study");
    return error;
  }
  error = mo_tell_parse(request->body, request->body_size, &status.record, &parsed, &post->faults);
  post->parsed = error == MO_OK;
  if (error == MO_OK)
    error = mo_jobs_tell(mo_api_of(request)->jobs, id, &parsed.telling, &reply, &post->message);
  if (post->parsed && (error == MO_ERR_CONFLICT || error == MO_ERR_RANGE ||
                       error == MO_ERR_INVALID || error == MO_ERR_LIMIT))
    reply_refused(request, post, error, &reply);
  mo_tell_free(&parsed);
  request->kept = id;
  return error;
}

void mo_api_post_study_tell(struct mo_request *request)
{
  mo_read_wait(request);
  if (!request->wait_over && !mo_handle_submission(request, "study", tell))
    return;
  if (await_batch(request, request->kept))
    reply_batch(request, request->kept, 202);
}

/* ---- asking ---- */

static void write_asked(struct mo_text *text, const struct mo_asked *asked)
{
  mo_text_object(text);
  mo_text_member_count(text, "batch", asked->batch);
  mo_text_open(text, "children", "[");
  for (uint32_t i = 0; i < asked->n; i++) {
    const struct mo_study_child *child = &asked->children[i];
    mo_text_next(text);
    mo_text_add(text, "{\"body\":{\"voxels\":\"");
    mo_genotype_write(text, &child->genotype);
    mo_text_add(text, "\"}");
    mo_member_parents(text, &child->descent);
    mo_text_member(text, "operator", mo_operator_words[child->descent.op]);
    mo_text_add(text, "}");
  }
  mo_text_add(text, "]}");
}

static int ask(struct mo_request *request, struct mo_post *post)
{
  struct mo_parsed_ask parsed;
  struct mo_asked asked = {.n = 0};
  struct mo_text text = {0};
  int64_t id;
  if (!mo_path_job(request, &id))
    return MO_ERR_NOT_FOUND;
  int error = mo_ask_parse(request->body, request->body_size, &parsed, &post->faults);
  post->parsed = error == MO_OK;
  if (error == MO_OK)
    error = mo_jobs_ask(mo_api_of(request)->jobs, id, &parsed.ask, &asked, &post->message);
  free(parsed.parents);
  if (error == MO_OK)
    write_asked(&text, &asked);
  free(asked.children);
  if (error == MO_OK)
    mo_reply_json(request, 200, &text);
  else if (post->parsed && error == MO_ERR_CONFLICT)
    mo_reply_problem(request, 409, NULL, "The study cannot return bodies: %s.",
                     mo_post_words(post, error));
  else if (error == MO_ERR_NOT_FOUND)
    mo_reply_error(request, error, "study");
  post->pointers.invalid = "";
  return error;
}

void mo_api_post_study_ask(struct mo_request *request)
{
  (void)mo_handle_submission(request, "study", ask);
}

/* ---- the state of the sampler, and the end ---- */

void mo_api_get_study_sampler(struct mo_request *request)
{
  struct mo_store *store = mo_api_of(request)->store;
  struct mo_campaign_status status;
  uint8_t *bytes = NULL;
  uint32_t step;
  size_t size = 0;
  int64_t id;
  if (!mo_path_id(request, 0, &id))
    return;
  int error = mo_store_campaign(store, id, &status);
  if (error == MO_OK && !mo_modes[status.record.settings.mode].makes_children &&
      status.sampler_bytes > 0)
    error = mo_store_campaign_checkpoint_of(store, id, (uint32_t)status.generation, &step, &bytes,
                                            &size);
  if (error != MO_OK) {
    mo_reply_error(request, error, "study");
    return;
  }
  if (bytes == NULL) {
    mo_reply_problem(request, 404, NULL, "The newest batch was sent without a sampler state.");
    return;
  }
  mo_sha256_of(bytes, size, &status.sampler_sha256);
  mo_reply_bytes(request, 200, "application/octet-stream", (char *)bytes, size);
  mo_reply_extra(request, "Morphod-Batch", "%" PRId64, status.generation);
  mo_reply_etag(request, "%s", MO_SHA256_HEX(&status.sampler_sha256));
}

void mo_api_post_study_finish(struct mo_request *request)
{
  struct mo_campaign_status status;
  int64_t id;
  if (!mo_path_id(request, 0, &id))
    return;
  const int error = mo_jobs_finish_study(mo_api_of(request)->jobs, id);
  if (error == MO_ERR_CONFLICT &&
      mo_store_campaign(mo_api_of(request)->store, id, &status) == MO_OK)
    mo_reply_problem(request, 409, NULL, "The study cannot be finished: %s%s.",
                     status.told > status.generation ? "a batch is still being scored; it is "
                                                     : "it is ",
                     mo_job_state_name(status.job.state));
  else if (error != MO_OK)
    mo_reply_error(request, error, "study");
  else
    mo_reply_job(request, 200, &mo_campaign_resource, id, true);
}
