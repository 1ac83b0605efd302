/* bundle_import.c: imports the campaigns of a bundle. The bundle is read twice: first all of it is
 * checked and compared with the store, then it is imported. */
#include "exchange/bundle_import.h"

#include <stdlib.h>
#include <string.h>

#include "store/import_compare.h"
#include "store/store.h"

struct entry {
  struct mo_bundle_import *import;
  struct mo_message *message;
  struct mo_import_comparison rows;            /* in the first read */
  struct mo_import *open;                      /* in the second read */
  uint32_t at;                                 /* campaigns so far */
  bool is_own[MO_BUNDLE_CAMPAIGNS];            /* the campaign ran here */
  struct mo_text lasting[MO_BUNDLE_CAMPAIGNS]; /* the part of a campaign that never changes */
};

static bool is_over(void *context)
{
  const struct mo_bundle_import *import = ((struct entry *)context)->import;
  return import->is_over(import->context);
}

static int read_bundle(struct entry *entry, struct mo_bundle_sink sink,
                       const struct mo_bundle_summary *known, struct mo_bundle_summary *summary)
{
  sink.context = entry;
  sink.is_over = is_over;
  return mo_bundle_read(entry->import->bytes, entry->import->size, entry->import->lattice, &sink,
                        known, summary, entry->message);
}

/* ---- the first read: stored results of the same rollouts must be equal ---- */

/* Writes the part of a campaign that neither edits nor an extension can change. */
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
  /* In this store, the name may stand for different environments. */
  lasting->record.environment_set[0] = '\0';
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
  const int error = mo_compare_campaign(entry->import->store, &entry->rows, campaign);
  return error == MO_OK ? 1 : error;
}

static int compare_design(void *context, const struct mo_campaign_design *design)
{
  struct entry *entry = context;
  return mo_compare_design(entry->import->store, &entry->rows, design);
}

static int refuse_score(const struct entry *entry, uint32_t number)
{
  return mo_fail(entry->message, MO_ERR_CONFLICT,
                 "a loss of design %u of campaign %lld differs from the loss stored here for the "
                 "same rollout and class",
                 number, (long long)entry->import->summary.campaigns[entry->at - 1].source.job);
}

static int compare_score(void *context, const struct mo_campaign_score *score)
{
  struct entry *entry = context;
  const int error = mo_compare_score(entry->import->store, &entry->rows, score);
  if (error == MO_ERR_LIMIT)
    return mo_fail(entry->message, MO_ERR_FORMAT, "the scores of a campaign have too many classes");
  return error == MO_ERR_CONFLICT ? refuse_score(entry, score->number) : error;
}

static int refuse_evaluation(const struct entry *entry,
                             const struct mo_imported_evaluation *evaluation)
{
  return mo_fail(entry->message, MO_ERR_FORMAT,
                 "the bundle lacks losses for rollouts that evaluation %lld recorded",
                 (long long)evaluation->source.job);
}

static int compare_evaluation(void *context, const struct mo_imported_evaluation *evaluation)
{
  struct entry *entry = context;
  const int found = mo_compare_evaluation(entry->import->store, &entry->rows, evaluation);
  if (found != 0)
    return found;
  const int error = mo_compare_losses(entry->import->store, &entry->rows, evaluation);
  return error == MO_ERR_NOT_FOUND ? refuse_evaluation(entry, evaluation) : error;
}

static int compare_rollout(void *context, const struct mo_saved_trajectory *rollout)
{
  struct entry *entry = context;
  const int error = mo_compare_rollout(entry->import->store, &entry->rows, rollout);
  return error == MO_ERR_CONFLICT ? mo_fail(entry->message, error,
                                            "evaluation %lld exists here with a different "
                                            "recording for environment %u of design %u",
                                            (long long)entry->rows.evaluation,
                                            rollout->environment_position, rollout->design_position)
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
  const int error = read_bundle(entry, sink, NULL, &entry->import->summary);
  mo_compare_end(&entry->rows);
  return error;
}

/* ---- the import ---- */

static int write_file(void *context, const struct mo_controller *controller,
                      const struct mo_sha256 *sha256, const char *bytes, size_t size)
{
  const struct entry *entry = context;
  (void)controller;
  return mo_store_import_file(entry->import->store, sha256, (const uint8_t *)bytes, size);
}

/* Stops the read: the controllers precede the campaigns. */
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
  return mo_import_controller(entry->open, controller, sha256, size);
}

/* Writes the rows of a campaign that are still waiting. */
static int flush(struct entry *entry)
{
  const int error = mo_import_flush(entry->open);
  return error == MO_ERR_CONFLICT ? refuse_score(entry, mo_import_conflict(entry->open)) : error;
}

static int enter_campaign(void *context, const struct mo_imported_campaign *campaign)
{
  struct entry *entry = context;
  int64_t *id = &entry->import->ids[entry->at];
  int error = flush(entry);
  if (error != MO_OK)
    return error;
  error = mo_import_find(entry->open, &campaign->source, entry->is_own[entry->at] ? *id : 0, id);
  entry->import->entered[entry->at] = error == MO_ERR_NOT_FOUND;
  if (error == MO_ERR_NOT_FOUND)
    error = mo_import_campaign(entry->open, campaign, id);
  const bool entered = entry->import->entered[entry->at++];
  return error != MO_OK ? error : entered;
}

static int enter_design(void *context, const struct mo_campaign_design *design)
{
  return mo_import_design(((struct entry *)context)->open, design);
}

static int enter_generation(void *context, const struct mo_campaign_generation *row,
                            const struct mo_descent *births,
                            const struct mo_campaign_member *members, uint32_t n)
{
  return mo_import_generation(((struct entry *)context)->open, row, births, members, n);
}

static int enter_held_out(void *context, const struct mo_re_evaluated *result)
{
  return mo_import_held_out(((struct entry *)context)->open, result);
}

static int enter_step(void *context, const struct mo_campaign_step *step)
{
  return mo_import_step(((struct entry *)context)->open, step);
}

static int enter_evaluation(void *context, const struct mo_imported_evaluation *evaluation)
{
  struct entry *entry = context;
  int error = flush(entry);
  if (error != MO_OK)
    return error;
  error = mo_import_evaluation(entry->open, evaluation);
  return error == MO_ERR_NOT_FOUND ? refuse_evaluation(entry, evaluation) : error;
}

static int enter_rollout(void *context, const struct mo_saved_trajectory *rollout)
{
  return mo_import_rollout(((struct entry *)context)->open, rollout);
}

static int enter_score(void *context, const struct mo_campaign_score *score)
{
  struct entry *entry = context;
  const int error = mo_import_score(entry->open, score);
  return error == MO_ERR_CONFLICT ? refuse_score(entry, mo_import_conflict(entry->open)) : error;
}

/* Imports the whole bundle. */
static int enter_all(struct entry *entry)
{
  static const struct mo_bundle_sink sink = {.controller = enter_controller,
                                             .campaign = enter_campaign,
                                             .design = enter_design,
                                             .generation = enter_generation,
                                             .held_out = enter_held_out,
                                             .step = enter_step,
                                             .score = enter_score,
                                             .evaluation = enter_evaluation,
                                             .rollout = enter_rollout};
  struct mo_bundle_summary *again = calloc(1, sizeof(*again));
  if (again == NULL)
    return MO_ERR_NO_MEMORY;
  int error = mo_import_open(entry->import->store, is_over, entry, &entry->open);
  entry->at = 0;
  entry->import->has_begun = error == MO_OK;
  if (error == MO_OK)
    error = read_bundle(entry, sink, &entry->import->summary, again);
  if (error == MO_OK)
    error = flush(entry);
  if (error == MO_OK)
    error = mo_import_finish(entry->open);
  if (error == MO_OK)
    entry->import->n_scores = mo_import_losses(entry->open);
  mo_import_close(entry->open);
  free(again);
  return error;
}

static int enter(struct entry *entry)
{
  static const struct mo_bundle_sink files = {.controller = write_file, .campaign = end_of_files};
  struct mo_store *store = entry->import->store;
  struct mo_bundle_summary *again = calloc(1, sizeof(*again));
  if (again == NULL)
    return MO_ERR_NO_MEMORY;
  mo_store_import_begin(store);
  int error = read_bundle(entry, files, NULL, again);
  free(again);
  if (error == MO_ERR_EXHAUSTED)
    error = enter_all(entry);
  mo_store_import_end(store);
  return error;
}

/* ---- campaigns that already exist here ---- */

/* Finds the campaign if it ran here with the same history as in the bundle. MO_ERR_NOT_FOUND. */
static int find_own(struct entry *entry, const struct mo_import_source *source, int64_t *id)
{
  struct mo_store *store = entry->import->store;
  struct mo_sha256 digest;
  int error = mo_store_import_own(store, source, id);
  if (error == MO_OK)
    error = mo_bundle_digest(store, *id, is_over, entry, &digest);
  if (error != MO_OK)
    return error;
  return mo_sha256_equal(&digest, &source->digest) ? MO_OK : MO_ERR_NOT_FOUND;
}

/* Checks that the campaign with the history of the i-th campaign also has its settings. */
static int compare_lasting(struct entry *entry, uint32_t i)
{
  struct mo_campaign_status *status = malloc(sizeof(*status));
  struct mo_imported_campaign *stored = malloc(sizeof(*stored));
  const struct mo_text *lasting = &entry->lasting[i];
  const struct mo_bundle_campaign *campaign = &entry->import->summary.campaigns[i];
  struct mo_text text = {0};
  int error = status == NULL || stored == NULL
                  ? MO_ERR_NO_MEMORY
                  : mo_bundle_describe(entry->import->store, entry->import->ids[i], status, stored);
  if (error == MO_ERR_CONFLICT) { /* a client is extending it at this moment */
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
                      "campaign %lld exists here as campaign %lld, with the same history but "
                      "different settings, controllers or times",
                      (long long)campaign->source.job, (long long)entry->import->ids[i]);
  }
  mo_text_free(&text);
  free(status);
  free(stored);
  return error;
}

/* Finds the campaigns that already exist here; the others get id 0. Returns the number of the
 * others, or an error. */
static int find_known(struct entry *entry)
{
  int n = 0;
  for (uint32_t i = 0; i < entry->import->summary.n; i++) {
    const struct mo_import_source *source = &entry->import->summary.campaigns[i].source;
    int error = find_own(entry, source, &entry->import->ids[i]);
    entry->is_own[i] = error == MO_OK;
    if (error == MO_ERR_NOT_FOUND)
      error = mo_store_import_find(entry->import->store, source, &entry->import->ids[i]);
    if (error == MO_OK)
      error = compare_lasting(entry, i);
    else if (error == MO_ERR_NOT_FOUND)
      entry->import->ids[i] = 0;
    if (error != MO_OK && error != MO_ERR_NOT_FOUND)
      return error;
    n += error == MO_ERR_NOT_FOUND;
  }
  return n;
}

int mo_bundle_import(struct mo_bundle_import *import, bool enters, struct mo_message *message)
{
  struct entry *entry = calloc(1, sizeof(*entry));
  if (entry == NULL)
    return MO_ERR_NO_MEMORY;
  entry->import = import;
  entry->message = message;
  int error = check(entry);
  const int n_new = error == MO_OK ? find_known(entry) : 0;
  if (n_new < 0)
    error = n_new;
  if (error == MO_OK && enters && n_new > 0)
    error = enter(entry);
  import->is_new = enters && n_new > 0;
  for (uint32_t i = 0; i < MO_BUNDLE_CAMPAIGNS; i++)
    mo_text_free(&entry->lasting[i]);
  free(entry);
  return error;
}
