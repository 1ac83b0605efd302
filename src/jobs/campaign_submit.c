/* campaign_submit.c: checks, places and admits a campaign, then hands it to the store; adds
 * generations to one. */
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "jobs/internal.h"

static int check_environments(const struct mo_campaign_request *request, struct mo_message *message)
{
  const struct mo_campaign_record *record = &request->record;
  if (record->environment_set[0] != '\0')
    return MO_OK;
  return mo_environments_check(request->environments, record->n_environments, "a campaign",
                               message);
}

static int check_initial(const struct mo_campaign_request *request, struct mo_message *message)
{
  const struct mo_campaign_record *record = &request->record;
  if (record->n_listed > record->settings.population)
    return mo_fail(message, MO_ERR_RANGE, "%u designs are listed for a population of %u",
                   (unsigned)record->n_listed, (unsigned)record->settings.population);
  return MO_OK;
}

static int check_request(const struct mo_campaign_request *request, struct mo_message *message)
{
  const struct mo_campaign_record *record = &request->record;
  int error = mo_campaign_settings_check(&record->settings, message);
  if (error == MO_OK)
    error = check_initial(request, message);
  if (error == MO_OK)
    error = check_environments(request, message);
  if (error != MO_OK)
    return error;
  if (record->name[0] != '\0' && record->settings.mode == MO_ZERO_SHOT)
    return mo_fail(message, MO_ERR_INVALID,
                   "a zero-shot campaign makes no controller that could have a name");
  if (record->name[0] != '\0' && mo_controller_name_check(record->name) != MO_OK)
    return mo_fail(message, MO_ERR_INVALID, "\"%.64s\" is not a name of a controller",
                   record->name);
  if (record->replicates > MO_REPLICATES_MAX)
    return mo_fail(message, MO_ERR_RANGE, "1 to %d replicates are possible, not %u",
                   MO_REPLICATES_MAX, (unsigned)record->replicates);
  if (request->priority != MO_BATCH && request->priority != MO_INTERACTIVE)
    return mo_fail(message, MO_ERR_INVALID, "no such priority");
  error = mo_weight_check(request->weight, message);
  return error != MO_OK
             ? error
             : mo_submission_check_texts(request->label, request->idempotency_key, message);
}

/* Checks that listed designs fit the campaign's workspace and that no two have one form. */
static int check_designs(const struct mo_campaign_request *request, const struct mo_bits *forms,
                         const struct mo_bits *genotypes, uint32_t *fault,
                         struct mo_message *message)
{
  const struct mo_workspace workspace = request->record.settings.workspace;
  uint64_t *moved = calloc(mo_workspace_words(workspace), sizeof(*moved));
  struct mo_form_set *seen = NULL;
  int error = moved == NULL ? MO_ERR_NO_MEMORY : mo_form_set_create(MO_DEFAULT_WORKSPACE, &seen);
  for (uint32_t i = 0; i < request->record.n_listed && error == MO_OK; i++) {
    int added = mo_form_set_add(seen, forms[i].words);
    *fault = i;
    error = added < 0
                ? added
                : mo_genotype_move(MO_DEFAULT_WORKSPACE, genotypes[i].words, workspace, moved);
    if (error == MO_OK && added == 0)
      error = mo_fail(message, MO_ERR_DUPLICATE, "design %u has the form of an earlier one",
                      (unsigned)i);
    else if (error == MO_ERR_RANGE)
      error = mo_fail(message, error, "design %u does not fit a workspace of %ux%ux%u voxels",
                      (unsigned)i, workspace.nx, workspace.ny, workspace.nz);
  }
  mo_form_set_free(seen);
  free(moved);
  return error;
}

/* Checks that the environment set and the initial campaign of the record exist. */
static int check_references(struct mo_jobs *jobs, const struct mo_campaign_record *record,
                            struct mo_message *message)
{
  struct mo_campaign_status status;
  uint32_t n = 0;
  int error = MO_OK;
  if (record->environment_set[0] != '\0')
    error = mo_store_environment_set_size(jobs->store, record->environment_set, &n);
  if (error != MO_OK)
    return mo_fail(message, error, "there is no set of environments \"%.64s\"",
                   record->environment_set);
  if (record->initial_campaign != 0)
    error = mo_store_campaign(jobs->store, record->initial_campaign, &status);
  if (error == MO_ERR_NOT_FOUND)
    return mo_fail(message, error, "there is no campaign %" PRId64, record->initial_campaign);
  if (error == MO_OK && record->initial_campaign != 0 && status.generation < 0)
    return mo_fail(message, MO_ERR_CONFLICT, "campaign %" PRId64 " has no population yet",
                   record->initial_campaign);
  return error;
}

/* Checks whether the campaign can ever run, before it is stored. A later check reports a controller
 * that is missing or unreadable. */
static int check_memory(struct mo_jobs *jobs, const struct mo_campaign_settings *settings,
                        const char *controller, enum mo_back_end back_end,
                        struct mo_message *message)
{
  struct mo_controller_record record;
  struct mo_need need;
  bool has_controller =
      controller != NULL && mo_store_controller(jobs->store, controller, &record) == MO_OK;
  int error = mo_need_of_campaign(jobs, settings, has_controller ? &record.sha256 : NULL, back_end,
                                  &need, message);
  if (error != MO_OK)
    return error == MO_ERR_LIMIT || error == MO_ERR_NO_MEMORY ? error : MO_OK;
  return mo_memory_check(jobs, &need, message);
}

static int admit(struct mo_jobs *jobs, uint32_t n, struct mo_message *message)
{
  for (uint32_t i = 0; i < n; i++) {
    int error = mo_jobs_admit(jobs, 0, message);
    if (error == MO_OK)
      continue;
    while (i-- > 0)
      mo_jobs_closed(jobs, 0);
    return error;
  }
  return MO_OK;
}

static int admit_and_store(struct mo_jobs *jobs, const struct mo_campaign_submission *submission,
                           int64_t *id, bool *replayed, struct mo_message *message)
{
  const uint32_t n = submission->record.replicates;
  int error = admit(jobs, n, message);
  if (error != MO_OK)
    return error;
  error = mo_store_submit_campaign(jobs->store, submission, id, replayed);
  for (uint32_t i = 0; i < n && (error != MO_OK || *replayed); i++)
    mo_jobs_closed(jobs, 0);
  if (error != MO_OK)
    return mo_submission_explain(error, submission->controller, message);
  if (!*replayed) {
    atomic_fetch_add(&jobs->submitted, n);
    mo_runners_wake(&jobs->campaigns);
  }
  return MO_OK;
}

int mo_jobs_submit_campaign(struct mo_jobs *jobs, const struct mo_campaign_request *request,
                            int64_t *id, bool *replayed, uint32_t *fault,
                            struct mo_message *message)
{
  struct mo_campaign_submission submission = {.record = request->record,
                                              .controller = request->controller,
                                              .environments = request->environments,
                                              .priority = (enum mo_urgency)request->priority,
                                              .weight = request->weight != 0 ? request->weight : 1,
                                              .label = request->label,
                                              .idempotency_key = request->idempotency_key,
                                              .body_sha256 = request->body_sha256};
  struct mo_bits *forms, *genotypes;
  const uint32_t n = request->record.n_listed;
  uint32_t which = 0;
  int error;
  if (atomic_load(&jobs->is_stopping))
    return mo_fail(message, MO_ERR_CANCELLED, "the service is stopping");
  error = check_request(request, message);
  if (error != MO_OK)
    return error;
  if (submission.controller == NULL && request->record.settings.mode != MO_SIMULTANEOUS)
    submission.controller = "default";
  if (submission.record.replicates == 0)
    submission.record.replicates = 1;
  if (request->idempotency_key !=
      NULL) { /* known keys are answered even when the queue is full, or no device works any more */
    error = mo_store_replay(jobs->store, request->idempotency_key, &request->body_sha256, id);
    if (error == MO_OK)
      *replayed = true;
    if (error != MO_ERR_NOT_FOUND)
      return error == MO_OK ? MO_OK : mo_submission_explain(error, submission.controller, message);
  }
  error = mo_back_end_choose(jobs, request->back_end, true, true, &submission.back_end, message);
  if (error == MO_OK)
    error = check_references(jobs, &request->record, message);
  if (error == MO_OK)
    error = check_memory(jobs, &request->record.settings, submission.controller,
                         submission.back_end, message);
  if (error != MO_OK)
    return error;
  forms = calloc((size_t)n + 1, sizeof(*forms));
  genotypes = calloc((size_t)n + 1, sizeof(*genotypes));
  if (forms == NULL || genotypes == NULL)
    error = mo_fail(message, MO_ERR_NO_MEMORY, "out of memory");
  else
    error = mo_designs_place(request->genotypes, n, forms, genotypes, message);
  if (error == MO_OK)
    error = check_designs(request, forms, genotypes, fault != NULL ? fault : &which, message);
  submission.forms = forms;
  submission.genotypes = genotypes;
  if (error == MO_OK)
    error = admit_and_store(jobs, &submission, id, replayed, message);
  free(forms);
  free(genotypes);
  return error;
}

/* ---- more generations ---- */

static int explain_extension(int error, struct mo_message *message)
{
  switch (error) {
  case MO_ERR_NOT_FOUND: return mo_fail(message, error, "there is no such campaign");
  case MO_ERR_CONFLICT:
    return mo_fail(
        message, error,
        "the campaign has failed, was cancelled, or has found every design that there is");
  case MO_ERR_DUPLICATE:
    return mo_fail(message, error, "the idempotency key was used with another request");
  case MO_ERR_RANGE:
    return mo_fail(message, error,
                   "a campaign has at most %d generations and %" PRIu64
                   " designs (population × (generations + 1)), a simultaneous one at most %d steps "
                   "of learning",
                   MO_GENERATIONS_MAX, MO_CAMPAIGN_DESIGNS_MAX, MO_TRAINING_STEPS_MAX);
  case MO_ERR_UNSUPPORTED:
    return mo_fail(message, error,
                   "its learning rate is one cosine over all generations: with more of them, those "
                   "that are done would "
                   "have been others");
  case MO_ERR_EMPTY:
    return mo_fail(message, error,
                   "the checkpoint of what it has learned, which it would go on from, was deleted");
  case MO_ERR_NO_SPACE: return mo_fail(message, error, "the disk of the state folder is full");
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
  if (mo_store_campaign(jobs->store, id, &status) != MO_OK ||
      generations > MO_GENERATIONS_MAX - settings->generations)
    return MO_OK; /* rejected elsewhere, with another message */
  settings->generations += generations;
  mo_sha256_to_hex(&status.record.controller_sha256, digits + strlen(digits));
  return check_memory(jobs, settings, status.record.has_controller ? digits : NULL,
                      status.job.back_end, message);
}

int mo_jobs_extend_campaign(struct mo_jobs *jobs, int64_t id, uint32_t generations,
                            const struct mo_request_key *key, struct mo_message *message)
{
  enum mo_job_state before = MO_JOB_RUNNING;
  int64_t known;
  int error;
  if (atomic_load(&jobs->is_stopping))
    return mo_fail(message, MO_ERR_CANCELLED, "the service is stopping");
  if (generations == 0)
    return mo_fail(message, MO_ERR_INVALID, "an extension has at least one generation");
  if (key != NULL && mo_store_replay(jobs->store, key->text, &key->sha256, &known) == MO_OK)
    return MO_OK;
  error = check_extension(jobs, id, generations, message);
  if (error == MO_OK)
    error = mo_jobs_admit(jobs, 0, message); /* a campaign that has succeeded is open again */
  if (error != MO_OK)
    return error;
  error = mo_store_extend_campaign(jobs->store, id, generations, key, &before);
  if (error != MO_OK || before != MO_JOB_SUCCEEDED)
    mo_jobs_closed(jobs, 0);
  if (error != MO_OK)
    return explain_extension(error, message);
  mo_memory_renew(jobs, &mo_campaign_runners, id);
  return MO_OK;
}
