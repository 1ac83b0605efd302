/* training_submit.c: checks, places and admits a training, then hands it to the store. */
#include <stdlib.h>
#include <string.h>

#include "jobs/internal.h"

static int check_kind(const struct mo_training_request *request, struct mo_message *message)
{
  const struct mo_training_record *record = &request->record;
  if (record->settings.kind == MO_TRAINING_PRETRAIN) {
    if (record->n_designs > 0 || request->population != 0)
      return mo_fail(message, MO_ERR_INVALID,
                     "a pretraining draws its own bodies: it takes no designs and no population");
    return MO_OK;
  }
  if (request->population != 0 && record->n_designs > 0)
    return mo_fail(message, MO_ERR_INVALID, "a finetuning takes designs or a population, not both");
  if (request->population == 0 &&
      (record->n_designs < 1 || record->n_designs > MO_TRAINING_DESIGNS_MAX))
    return mo_fail(message, MO_ERR_RANGE, "a finetuning learns on 1 to %d designs, not %u",
                   MO_TRAINING_DESIGNS_MAX, (unsigned)record->n_designs);
  return MO_OK;
}

static int check_request(const struct mo_training_request *request, struct mo_message *message)
{
  const struct mo_training_record *record = &request->record;
  int error = mo_training_settings_check(&record->settings, message);
  if (error == MO_OK)
    error = check_kind(request, message);
  if (error != MO_OK)
    return error;
  if (record->name[0] != '\0' && mo_controller_name_check(record->name) != MO_OK)
    return mo_fail(message, MO_ERR_INVALID, "\"%.64s\" is not a name of a controller",
                   record->name);
  if (record->checkpoints_kept < 1 || record->checkpoints_kept > MO_CHECKPOINTS_KEPT_MAX)
    return mo_fail(message, MO_ERR_RANGE, "1 to %d checkpoints can be kept, not %u",
                   MO_CHECKPOINTS_KEPT_MAX, (unsigned)record->checkpoints_kept);
  if (record->validate_every_steps > 0 &&
      (record->settings.held_out_designs == 0 || record->settings.held_out_environments == 0))
    return mo_fail(message, MO_ERR_INVALID,
                   "a validation needs at least one design and one environment");
  if (request->priority != MO_BATCH && request->priority != MO_INTERACTIVE)
    return mo_fail(message, MO_ERR_INVALID, "no such priority");
  error = mo_weight_check(request->weight, message);
  return error != MO_OK
             ? error
             : mo_submission_check_texts(request->label, request->idempotency_key, message);
}

static int load_population(struct mo_jobs *jobs, const struct mo_training_request *request,
                           struct mo_bits **genotypes, uint32_t *n, struct mo_message *message)
{
  int error =
      mo_store_population(jobs->store, request->population, request->population_best, genotypes, n);
  switch (error) {
  case MO_OK:
    if (*n > 0)
      return MO_OK;
    free(*genotypes);
    *genotypes = NULL;
    return mo_fail(message, MO_ERR_CONFLICT, "every design of population %lld has diverged",
                   (long long)request->population);
  case MO_ERR_NOT_FOUND:
    return mo_fail(message, error,
                   "there is no population %lld: an evaluation or a campaign is expected",
                   (long long)request->population);
  case MO_ERR_CONFLICT:
    return mo_fail(message, error, "population %lld has not succeeded, or has no generation yet",
                   (long long)request->population);
  default:
    return mo_fail(message, error, "the population cannot be read: %s", mo_error_text(error));
  }
}

static int admit_and_store(struct mo_jobs *jobs, const struct mo_training_submission *submission,
                           int64_t *id, bool *replayed, struct mo_message *message)
{
  int error = mo_jobs_admit(jobs, 0, message);
  if (error != MO_OK)
    return error;
  error = mo_store_submit_training(jobs->store, submission, id, replayed);
  if (error != MO_OK || *replayed)
    mo_jobs_closed(jobs, 0);
  if (error != MO_OK)
    return mo_submission_explain(error, submission->parent, message);
  if (!*replayed) {
    atomic_fetch_add(&jobs->submitted, 1);
    mo_runners_wake(&jobs->trainings);
  }
  return MO_OK;
}

int mo_jobs_submit_training(struct mo_jobs *jobs, const struct mo_training_request *request,
                            int64_t *id, bool *replayed, struct mo_message *message)
{
  struct mo_training_submission submission = {.record = request->record,
                                              .parent = request->parent,
                                              .priority = (enum mo_urgency)request->priority,
                                              .weight = request->weight,
                                              .label = request->label,
                                              .idempotency_key = request->idempotency_key,
                                              .body_sha256 = request->body_sha256};
  struct mo_bits *population = NULL, *forms = NULL, *genotypes = NULL;
  struct mo_need need;
  uint32_t n = request->record.n_designs;
  int error;
  if (atomic_load(&jobs->is_stopping))
    return mo_fail(message, MO_ERR_CANCELLED, "the service is stopping");
  error = check_request(request, message);
  if (error != MO_OK)
    return error;
  if (submission.parent == NULL && request->record.settings.kind == MO_TRAINING_FINETUNE)
    submission.parent = "default";
  if (request->idempotency_key !=
      NULL) { /* known keys are answered even when the queue is full, or no device works any more */
    error = mo_store_replay(jobs->store, request->idempotency_key, &request->body_sha256, id);
    if (error == MO_OK)
      *replayed = true;
    if (error != MO_ERR_NOT_FOUND)
      return error == MO_OK ? MO_OK : mo_submission_explain(error, submission.parent, message);
  }
  error = mo_back_end_choose(jobs, request->back_end, true, true, &submission.back_end, message);
  if (error != MO_OK)
    return error;
  if (request->population != 0) {
    error = load_population(jobs, request, &population, &n, message);
    if (error != MO_OK)
      return error;
  }
  if (n > MO_TRAINING_DESIGNS_MAX) { /* the population of a campaign */
    free(population);
    return mo_fail(message, MO_ERR_RANGE,
                   "a finetuning learns on 1 to %d designs, not %u: ask for the best of them",
                   MO_TRAINING_DESIGNS_MAX, (unsigned)n);
  }
  submission.record.n_designs = n;
  submission.record.population = request->population;
  need = mo_need_of_training(jobs, &submission.record, submission.back_end);
  error = mo_memory_check(jobs, &need, message);
  if (error != MO_OK) {
    free(population);
    return error;
  }
  forms = calloc((size_t)n + 1, sizeof(*forms));
  genotypes = calloc((size_t)n + 1, sizeof(*genotypes));
  if (forms == NULL || genotypes == NULL)
    error = mo_fail(message, MO_ERR_NO_MEMORY, "out of memory");
  else
    error = mo_designs_place(population != NULL ? population : request->genotypes, n, forms,
                             genotypes, message);
  submission.forms = forms;
  submission.genotypes = genotypes;
  if (error == MO_OK)
    error = admit_and_store(jobs, &submission, id, replayed, message);
  free(population);
  free(forms);
  free(genotypes);
  return error;
}
