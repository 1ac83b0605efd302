/* campaign_submit.c: places and admits a campaign, then passes it to the store; adds generations to
 * a campaign. */
#include <inttypes.h>
#include <string.h>

#include "jobs/campaign_excluded.h"
#include "jobs/submission.h"
#include "store/studies.h"

#define MIB             ((uint64_t)1 << 20)
#define DRAWING_THREADS 16
/* Measured, and rounded up. */
#define CAMPAIGN_BYTES  (20 * MIB)          /* the controller, packed for the kernels */
#define CANDIDATE_BYTES ((uint64_t)3 << 9)  /* of a population: parents and children */
#define SCORED_BYTES    ((uint64_t)4 << 10) /* a candidate's losses: computed, saved, found */
#define WORLD_BYTES     ((uint64_t)4 << 10) /* a fresh world, with the losses of the elite */
#define DRAWING_BYTES   (3 * MIB)           /* for a thread that redraws bodies */

#define STUDY_MEASURES_MAX 2000000

/* ---- memory ---- */

/* Adds the set of all excluded bodies, and a second set that detects duplicates within one part.
 * The first part in the service's workspace needs no second set. */
static void add_excluded(const struct mo_jobs *jobs, const struct mo_lineage *lineage,
                         struct mo_workspace workspace, struct mo_need *need)
{
  const struct mo_workspace all = jobs->lattice->workspace;
  const bool is_all = mo_workspace_equal(workspace, all);
  const uint32_t n = jobs->memory.n_workers;
  uint64_t total = 0, apart = 0,
           key = UINT64_C(0xcbf29ce484222325) ^ mo_workspace_voxels(workspace);
  if (lineage->n_parts == 0)
    return;
  for (uint32_t i = 0; i < lineage->n_parts; i++) {
    const struct mo_lineage_part *part = &lineage->parts[i];
    total += part->n_bodies;
    if ((i > 0 || !is_all) && part->n_bodies > apart)
      apart = part->n_bodies;
    key = ((key ^ part->seed) * UINT64_C(0x100000001b3) ^ part->n_bodies) * UINT64_C(0x100000001b3);
  }
  need->shared = mo_form_set_estimate(workspace, total) +
                 (apart > 0 ? mo_form_set_estimate(all, apart) : 0) +
                 (n < DRAWING_THREADS ? n : DRAWING_THREADS) * DRAWING_BYTES;
  need->shared_key = key;
}

int mo_campaign_need(struct mo_jobs *jobs, const struct mo_campaign_record *record,
                     const struct mo_sha256 *controller, enum mo_back_end back_end,
                     struct mo_need *need, struct mo_message *message)
{
  const struct mo_campaign_settings *settings = &record->settings;
  const uint64_t n = settings->population;
  /* Per candidate, three copies: computed, found, and saved. */
  const uint64_t measures_bytes =
      record->measures != 0 ? 3 * sizeof(double[MO_MEASURES]) * record->n_environments : 0;
  struct mo_lineage lineage = {.n_parts = 0};
  int error = MO_OK;
  if (controller != NULL && settings->exclude_pretraining)
    error = mo_lineage_read(jobs, controller, NULL, &lineage, message);
  if (error != MO_OK)
    return error;
  *need = (struct mo_need){.own = CAMPAIGN_BYTES + 2 * n * CANDIDATE_BYTES};
  if (record->re_evaluate.every > 0)
    need->own += record->re_evaluate.environments * WORLD_BYTES;
  if (mo_modes[settings->mode].makes_children)
    need->own +=
        mo_form_set_estimate(settings->workspace, n * (settings->generations + UINT64_C(1)));
  if (!mo_modes[settings->mode].learns) {
    need->own += n * (SCORED_BYTES + measures_bytes);
  } else {
    const uint32_t batch = mo_campaign_training(settings, 0).batch;
    mo_memory_add_learning(jobs, batch, &settings->physics, back_end, need);
    need->own +=
        2 * n * (SCORED_BYTES + measures_bytes) + n * MO_DESIGN_BYTES + batch * MO_ROBOT_BYTES;
  }
  add_excluded(jobs, &lineage, settings->workspace, need);
  return MO_OK;
}

/* ---- checks ---- */

/* A reply with a batch of a study contains every measure of every rollout. */
static int check_study_reply(const struct mo_campaign_record *record, struct mo_message *message)
{
  const uint64_t each =
      (uint64_t)record->n_environments * (uint64_t)__builtin_popcount(record->measures);
  if (mo_modes[record->settings.mode].makes_children ||
      record->settings.population * each <= STUDY_MEASURES_MAX)
    return MO_OK;
  return mo_fail(
      message, MO_ERR_LIMIT,
      "a batch of %u designs with %llu measures each is too large for a reply; population "
      "× environments × measures can be at most %d",
      record->settings.population, (unsigned long long)each, STUDY_MEASURES_MAX);
}

/* Checks that the environment set and the initial campaign of the record exist, and counts the
 * environments of the set. */
static int check_references(struct mo_jobs *jobs, struct mo_campaign_record *record,
                            struct mo_message *message)
{
  struct mo_campaign_status status;
  int error =
      record->environment_set[0] != '\0'
          ? mo_environments_count(jobs, record->environment_set, &record->n_environments, message)
          : MO_OK;
  if (error != MO_OK)
    return error;
  if (record->initial_campaign != 0)
    error = mo_store_campaign(jobs->store, record->initial_campaign, &status);
  if (error == MO_ERR_NOT_FOUND)
    return mo_fail(message, error, "campaign %" PRId64 " does not exist", record->initial_campaign);
  if (error == MO_OK && record->initial_campaign != 0 && status.generation < 0)
    return mo_fail(message, MO_ERR_CONFLICT, "campaign %" PRId64 " has no population yet",
                   record->initial_campaign);
  return error;
}

/* Checks whether the campaign can ever run, before it is stored. A missing or unreadable controller
 * is reported by a later check. */
static int check_memory(struct mo_jobs *jobs, const struct mo_campaign_record *campaign,
                        const char *controller, enum mo_back_end back_end,
                        struct mo_message *message)
{
  struct mo_controller_record record;
  struct mo_need need;
  bool has_controller =
      controller != NULL && mo_store_controller(jobs->store, controller, &record) == MO_OK;
  int error = mo_campaign_need(jobs, campaign, has_controller ? &record.sha256 : NULL, back_end,
                               &need, message);
  if (error != MO_OK)
    return error == MO_ERR_LIMIT || error == MO_ERR_NO_MEMORY ? error : MO_OK;
  return mo_memory_check(jobs, &need, message);
}

/* The scores belong to the controller that the campaign starts from. */
static int orient(struct mo_jobs *jobs, const struct mo_campaign_request *request,
                  struct mo_placed *placed, struct mo_message *message)
{
  const struct mo_campaign_record *record = &request->record;
  const bool has_set = record->environment_set[0] != '\0';
  const struct mo_orienting under = {.controller = request->controller,
                                     .environment_set = has_set ? record->environment_set : NULL,
                                     .environments = request->environments,
                                     .n_environments = record->n_environments,
                                     .physics = &record->settings.physics,
                                     .precision = MO_FLOAT32,
                                     .workspace = record->settings.workspace};
  return mo_placed_orient(jobs, &under, (enum mo_back_end)request->job.back_end, placed,
                          record->n_listed, request->notes, request->n_notes, message);
}

int mo_jobs_submit_campaign(struct mo_jobs *jobs, const struct mo_campaign_request *asked,
                            int64_t *id, bool *replayed, struct mo_message *message)
{
  struct mo_campaign_request request = *asked;
  struct mo_campaign_record *record = &request.record;
  struct mo_placed placed = {NULL, NULL};
  if (asked->controller == NULL && !mo_modes[record->settings.mode].starts_untrained)
    request.controller = "default";
  record->replicates = record->replicates > 0 ? record->replicates : 1;
  const struct mo_submitting submitting = {MO_JOB_CAMPAIGN, &asked->job, request.controller,
                                           record->replicates, 0};
  int error = mo_submitting_begin(jobs, &submitting, id, replayed, message);
  /* Look for the study before a full queue or a missing device can cause the request to be
   * rejected; the store checks again. */
  if (error == MO_OK && !*replayed && asked->reuses &&
      mo_store_study_find(jobs->store, asked->job.label, id) == MO_OK)
    return MO_ERR_DUPLICATE;
  if (error != MO_OK || *replayed)
    return error;
  error = mo_back_end_choose(jobs, &request.job,
                             mo_back_end_unsuited(request.environments, record->n_environments),
                             true, message);
  if (error == MO_OK)
    error = check_references(jobs, record, message);
  if (error == MO_OK)
    error = check_study_reply(record, message);
  if (error == MO_OK)
    error = check_memory(jobs, record, request.controller, (enum mo_back_end)request.job.back_end,
                         message);
  if (error == MO_OK)
    error = mo_placed_create(jobs->lattice->workspace, asked->genotypes, record->n_listed, &placed);
  if (error == MO_OK)
    error = orient(jobs, &request, &placed, message);
  request.forms = placed.forms;
  request.genotypes = placed.genotypes;
  if (error == MO_OK)
    error = mo_jobs_admit(jobs, record->replicates, 0, message);
  if (error == MO_OK)
    error = mo_submitting_end(jobs, &submitting,
                              mo_store_submit_campaign(jobs->store, &request, id, replayed),
                              *replayed, message);
  mo_placed_free(&placed);
  return error;
}

/* ---- more generations ---- */

static int explain_extension(int error, struct mo_message *message)
{
  switch (error) {
  case MO_ERR_NOT_FOUND: return mo_fail(message, error, "the campaign does not exist");
  case MO_ERR_CONFLICT:
    return mo_fail(message, error,
                   "the campaign has failed, was cancelled, or has found every possible design");
  case MO_ERR_DUPLICATE:
    return mo_fail(message, error,
                   "the idempotency key was used with a different request; use a new key");
  case MO_ERR_RANGE:
    return mo_fail(message, error,
                   "a campaign may have at most %d generations and %" PRIu64
                   " designs (population × (generations + 1)), and a simultaneous one at most %d "
                   "learning steps",
                   MO_GENERATIONS_MAX, MO_CAMPAIGN_DESIGNS_MAX, MO_TRAINING_STEPS_MAX);
  case MO_ERR_UNSUPPORTED:
    return mo_fail(message, error,
                   "its learning rate is one cosine over all generations, so more generations "
                   "would have changed the completed ones");
  case MO_ERR_EMPTY:
    return mo_fail(
        message, error,
        "the checkpoint of its learning state, which it would continue from, was deleted");
  case MO_ERR_NO_SPACE:
    return mo_fail(message, error, "the disk of the state folder is full; free some space");
  default:
    return mo_fail(message, error, "the campaign could not be extended: %s", mo_error_text(error));
  }
}

static int check_extension(struct mo_jobs *jobs, int64_t id, uint32_t generations,
                           struct mo_message *message)
{
  struct mo_campaign_status status;
  struct mo_campaign_settings *settings = &status.record.settings;
  char digits[MO_SHA256_DIGITS + 8] = "sha256:";
  const int error = mo_store_campaign(jobs->store, id, &status);
  if (error == MO_OK && !mo_modes[settings->mode].makes_children)
    return mo_fail(message, MO_ERR_UNSUPPORTED, "a study gets its generations from tell requests");
  if (error != MO_OK || generations > MO_GENERATIONS_MAX - settings->generations)
    return MO_OK; /* rejected elsewhere, with a different message */
  settings->generations += generations;
  mo_sha256_to_hex(&status.job.controller_sha256, digits + strlen(digits));
  return check_memory(jobs, &status.record, status.job.has_controller ? digits : NULL,
                      status.job.back_end, message);
}

int mo_jobs_extend_campaign(struct mo_jobs *jobs, int64_t id, uint32_t generations,
                            const struct mo_request_key *key, struct mo_message *message)
{
  enum mo_job_state before = MO_JOB_RUNNING;
  int64_t known;
  if (atomic_load(&jobs->is_stopping))
    return mo_fail(message, MO_ERR_CANCELLED, "the service is stopping");
  if (key != NULL && mo_store_replay(jobs->store, key, &known) == MO_OK)
    return MO_OK;
  int error = check_extension(jobs, id, generations, message);
  if (error == MO_OK)
    error = mo_jobs_admit(jobs, 1, 0, message); /* a succeeded campaign is open again */
  if (error != MO_OK)
    return error;
  error = mo_store_extend_campaign(jobs->store, id, generations, key, &before);
  if (error != MO_OK || before != MO_JOB_SUCCEEDED)
    mo_jobs_closed(jobs, 1, 0);
  if (error != MO_OK)
    return explain_extension(error, message);
  mo_memory_renew(jobs, MO_JOB_CAMPAIGN, id);
  return MO_OK;
}
