/* training_submit.c: stores submitted training runs. */
#include <stdlib.h>

#include "jobs/submission.h"
#include "jobs/training_run.h"
#include "store/worlds.h"

/* Memory of a robot in a pretraining run: random body, environment, outcome. */
#define DRAWN_BYTES ((uint64_t)5 << 10)

struct mo_need mo_training_need(const struct mo_jobs *jobs, const struct mo_training_record *record,
                                enum mo_back_end back_end)
{
  const struct mo_training_settings *settings = &record->settings;
  const uint64_t hands = back_end == MO_ON_DEVICE ? 2 : 1,
                 drawn = (uint64_t)settings->n_steps * settings->batch;
  struct mo_need need = {0};
  mo_memory_add_learning(jobs, settings->batch, &settings->physics, back_end, &need);
  if (settings->kind == MO_TRAINING_PRETRAIN)
    need.own +=
        hands * settings->batch * DRAWN_BYTES +
        mo_form_set_estimate(jobs->lattice->workspace, drawn + drawn / (MO_HELD_OUT_ONE_IN - 1));
  else
    need.own += record->n_designs * MO_DESIGN_BYTES + hands * settings->batch * MO_ROBOT_BYTES;
  return need;
}

static int load_population(struct mo_jobs *jobs, const struct mo_training_request *request,
                           struct mo_bits **genotypes, uint32_t *n, struct mo_message *message)
{
  const long long population = (long long)request->record.population;
  int error = mo_store_population(jobs->store, request->record.population, request->population_best,
                                  genotypes, n);
  switch (error) {
  case MO_OK: break;
  case MO_ERR_NOT_FOUND:
    return mo_fail(message, error,
                   "population %lld does not exist; it must be an evaluation or a campaign",
                   population);
  case MO_ERR_CONFLICT:
    return mo_fail(message, error, "population %lld has not succeeded, or has no generation yet",
                   population);
  default:
    return mo_fail(message, error, "the population cannot be read: %s", mo_error_text(error));
  }
  if (*n == 0)
    return mo_fail(message, MO_ERR_CONFLICT, "every design of population %lld diverged",
                   population);
  if (*n > MO_TRAINING_DESIGNS_MAX) /* the population of a campaign */
    return mo_fail(message, MO_ERR_RANGE,
                   "a finetuning run must have 1 to %d designs, got %u; select the best ones",
                   MO_TRAINING_DESIGNS_MAX, (unsigned)*n);
  return MO_OK;
}

/* Draws the designs of a request from its atlas. */
static int load_sample(struct mo_jobs *jobs, struct mo_training_record *record,
                       struct mo_bits **genotypes, struct mo_message *message)
{
  const int error = mo_store_atlas_sample(jobs->store, &record->sample, genotypes, message);
  record->n_designs = record->sample.count;
  return error;
}

/* The steps of all designs are numbered consecutively. */
static int check_each(const struct mo_training_record *record, struct mo_message *message)
{
  const uint64_t steps = (uint64_t)record->n_designs * record->settings.n_steps;
  return steps <= MO_TRAINING_STEPS_MAX
             ? MO_OK
             : mo_fail(message, MO_ERR_RANGE,
                       "%u designs that learn %u steps each need %llu steps in total; a training "
                       "run has at most %d",
                       (unsigned)record->n_designs, (unsigned)record->settings.n_steps,
                       (unsigned long long)steps, MO_TRAINING_STEPS_MAX);
}

/* Chooses the back end and the designs; checks the memory. */
static int complete(struct mo_jobs *jobs, struct mo_training_request *request,
                    struct mo_placed *placed, struct mo_message *message)
{
  struct mo_training_record *record = &request->record;
  /* For drawn worlds, the orientation is chosen by the scores on the test set. */
  const bool is_listed = request->environments != NULL && !record->draws_worlds;
  const char *const set = record->environment_set[0] != '\0' ? record->environment_set
                          : is_listed                        ? NULL
                                                             : "paper-test";
  const struct mo_orienting under = {.controller = request->parent,
                                     .environment_set = set,
                                     .environments = request->environments,
                                     .n_environments = record->n_environments,
                                     .physics = &record->settings.physics,
                                     .precision = MO_FLOAT32,
                                     .workspace = jobs->lattice->workspace};
  struct mo_bits *population = NULL;
  struct mo_need need;
  int error = mo_back_end_choose(
      jobs, &request->job, mo_back_end_unsuited(request->environments, record->n_environments),
      true, message);
  if (error == MO_OK && record->population != 0)
    error = load_population(jobs, request, &population, &record->n_designs, message);
  if (error == MO_OK && record->sample.atlas[0] != '\0')
    error = load_sample(jobs, record, &population, message);
  if (error == MO_OK && record->each)
    error = check_each(record, message);
  if (error == MO_OK) {
    need = mo_training_need(jobs, record, (enum mo_back_end)request->job.back_end);
    error = mo_memory_check(jobs, &need, message);
  }
  if (error == MO_OK)
    error = mo_placed_create(jobs->lattice->workspace,
                             population != NULL ? population : request->genotypes,
                             record->n_designs, placed);
  free(population);
  if (error == MO_OK)
    error = mo_placed_orient(jobs, &under, (enum mo_back_end)request->job.back_end, placed,
                             record->n_designs, request->notes, request->n_notes, message);
  request->forms = placed->forms;
  request->genotypes = placed->genotypes;
  return error;
}

int mo_jobs_submit_training(struct mo_jobs *jobs, const struct mo_training_request *asked,
                            int64_t *id, bool *replayed, struct mo_message *message)
{
  struct mo_training_request request = *asked;
  struct mo_placed placed = {NULL, NULL};
  if (asked->parent == NULL && asked->record.settings.kind == MO_TRAINING_FINETUNE)
    request.parent = "default";
  const struct mo_submitting submitting = {MO_JOB_TRAINING, &asked->job, request.parent, 1, 0};
  int error = mo_submitting_begin(jobs, &submitting, id, replayed, message);
  if (error != MO_OK || *replayed)
    return error;
  error = complete(jobs, &request, &placed, message);
  if (error == MO_OK)
    error = mo_jobs_admit(jobs, 1, 0, message);
  if (error == MO_OK)
    error = mo_submitting_end(jobs, &submitting,
                              mo_store_submit_training(jobs->store, &request, id, replayed),
                              *replayed, message);
  mo_placed_free(&placed);
  return error;
}
