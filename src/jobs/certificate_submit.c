/* certificate_submit.c: completes a certificate's request, and admits it. */
#include <stdlib.h>
#include <string.h>

#include "base/words.h"
#include "jobs/certificates.h"
#include "jobs/submission.h"
#include "rollout/physics.h"
#include "store/controllers.h"
#include "store/trainings.h"
#include "store/worlds.h"

#define LARGE_ROLLOUTS 20000 /* at this size or above, devices are worthwhile */

/* The data with which a request is completed; the request points into it. */
struct completion {
  struct mo_certificate_request request;
  char controller[MO_SHA256_DIGITS + 8], set[MO_NAME_BYTES_MAX + 1];
  struct mo_environment *environments; /* of the set or the campaign; NULL: listed */
  uint32_t n_environments;
  struct mo_bits *population;
  struct mo_placed placed;
};

static void free_completion(struct completion *made)
{
  mo_environments_free(made->environments, made->n_environments);
  free(made->population);
  mo_placed_free(&made->placed);
}

/* ---- a job with designs ---- */

static int load_population(struct mo_jobs *jobs, struct completion *made,
                           struct mo_message *message)
{
  struct mo_certificate_request *request = &made->request;
  const long long id = (long long)request->record.population;
  const int error =
      mo_store_population(jobs->store, id, request->best, &made->population, &request->n_designs);
  switch (error) {
  case MO_OK: break;
  case MO_ERR_NOT_FOUND:
    return mo_fail(message, error,
                   "population %lld does not exist; it must be an evaluation or a campaign", id);
  case MO_ERR_CONFLICT:
    return mo_fail(message, error, "population %lld has not succeeded, or has no generation yet",
                   id);
  default:
    return mo_fail(message, error, "the population cannot be read: %s", mo_error_text(error));
  }
  if (request->n_designs == 0)
    return mo_fail(message, MO_ERR_CONFLICT, "every design of population %lld diverged", id);
  request->genotypes = made->population;
  return MO_OK;
}

/* Takes the environments of the job with the designs. */
static int take_environments(struct mo_jobs *jobs, struct completion *made,
                             const struct mo_job *job, struct mo_message *message)
{
  struct mo_certificate_request *request = &made->request;
  const char *const set = job->environment_set;
  if (set[0] != '\0' && mo_word_index(mo_set_words, set) < 0)
    return mo_fail(message, MO_ERR_CONFLICT,
                   "%s %lld has the environments of all tasks of %s; give environments, such as "
                   "those of one task",
                   mo_job_kind_name(job->kind), (long long)job->id, set);
  request->record.taken |= MO_TAKEN_ENVIRONMENTS;
  request->environment_set = NULL;
  if (set[0] != '\0') {
    snprintf(made->set, sizeof(made->set), "%s", set);
    request->environment_set = made->set;
    return MO_OK;
  }
  const int error = mo_store_job_environments(jobs->store, job->id, job->kind, &made->environments,
                                              &made->n_environments);
  return error == MO_OK
             ? MO_OK
             : mo_fail(message, error, "the environments of %s %lld cannot be read: %s",
                       mo_job_kind_name(job->kind), (long long)job->id, mo_error_text(error));
}

/* Takes the settings that the request leaves out from the job with the designs. */
static int take_from_job(struct mo_jobs *jobs, struct completion *made, const struct mo_job *job,
                         struct mo_message *message)
{
  struct mo_certificate_request *request = &made->request;
  if (request->controller == NULL) {
    if (!job->has_result && !job->has_controller)
      return mo_fail(message, MO_ERR_EMPTY,
                     "%s %lld started without a controller and has not finished one; give the name "
                     "of a controller",
                     mo_job_kind_name(job->kind), (long long)job->id);
    memcpy(made->controller, "sha256:", sizeof("sha256:"));
    mo_sha256_to_hex(job->has_result ? &job->result_sha256 : &job->controller_sha256,
                     made->controller + strlen("sha256:"));
    request->controller = made->controller;
    request->record.taken |= MO_TAKEN_CONTROLLER;
  }
  if (!request->has_physics) {
    request->physics = job->physics;
    request->record.taken |= MO_TAKEN_PHYSICS;
  }
  return request->has_environments ? MO_OK : take_environments(jobs, made, job, message);
}

static int read_population(struct mo_jobs *jobs, struct completion *made,
                           struct mo_message *message)
{
  struct mo_job job;
  if (made->request.record.population == 0)
    return MO_OK;
  int error = load_population(jobs, made, message);
  if (error == MO_OK)
    error = mo_store_job(jobs->store, made->request.record.population, &job);
  return error == MO_OK ? take_from_job(jobs, made, &job, message) : error;
}

/* ---- trials ---- */

static int check_worlds(const struct mo_certificate_base *base, struct mo_message *message)
{
  struct mo_message why;
  for (uint32_t i = 0; i < base->n_environments; i++)
    if (mo_physics_check_in(&base->physics, &base->environments[i], NULL, &why) != MO_OK)
      return mo_fail(message, MO_ERR_RANGE, "in environment %u, constants are out of range: %s",
                     (unsigned)i, why.text);
  return MO_OK;
}

/* The bounds of a request imply this bound. The trials are: base, precision, two steps and two
 * heights; copies of all worlds; six constants; two axes with their own worlds. */
_Static_assert(
    (uint64_t)MO_CERTIFICATE_DESIGNS_MAX *(
        MO_ENVIRONMENTS_MAX *(6 + MO_CERTIFICATE_CHANCE_MAX + 6 * MO_CERTIFICATE_LEVELS_MAX) +
        MO_CERTIFICATE_HELD_OUT_MAX + MO_CERTIFICATE_WORLDS_MAX) <= MO_CERTIFICATE_ROLLOUTS_MAX,
    "every certificate has a bounded number of rollouts");

static int count_trials(struct completion *made, const struct mo_certificate_base *base,
                        struct mo_message *message)
{
  struct mo_certificate_record *record = &made->request.record;
  struct mo_trial *trials = NULL;
  int error = mo_certificate_trials(&record->settings, base, &trials, &record->n_trials);
  if (error != MO_OK)
    return mo_fail(message, error, "%s", mo_error_text(error));
  record->n_rollouts = 0;
  for (uint32_t t = 0; t < record->n_trials; t++)
    record->n_rollouts += (uint64_t)made->request.n_designs * trials[t].n_environments;
  free(trials);
  return MO_OK;
}

/* Reads the environments of a named set. Determines the data from which the trials are built. */
static int find_base(struct mo_jobs *jobs, struct completion *made,
                     struct mo_certificate_base *base, struct mo_message *message)
{
  struct mo_certificate_request *request = &made->request;
  struct mo_controller_record controller;
  if (request->environment_set != NULL &&
      mo_store_environment_set(jobs->store, request->environment_set, &made->environments,
                               &made->n_environments) != MO_OK)
    return mo_fail(message, MO_ERR_NOT_FOUND, "unknown set of environments \"%.64s\"",
                   request->environment_set);
  if (request->environments == NULL) {
    request->environments = made->environments;
    request->n_environments = made->n_environments;
  }
  *base = (struct mo_certificate_base){.physics = request->physics,
                                       .precision = MO_FLOAT32,
                                       .environments = request->environments,
                                       .n_environments = request->n_environments};
  if (request->environment_set != NULL)
    base->set = mo_set_words[mo_word_index(mo_set_words, request->environment_set)];
  if (mo_store_controller(jobs->store, request->controller, &controller) == MO_OK)
    (void)mo_physics_complete(&base->physics,
                              controller.control_period_s); /* the store checks it */
  return check_worlds(base, message);
}

/* ---- submission ---- */

static int complete(struct mo_jobs *jobs, struct completion *made, struct mo_message *message)
{
  struct mo_certificate_request *request = &made->request;
  struct mo_certificate_base base;
  int error = read_population(jobs, made, message);
  if (request->controller == NULL)
    request->controller = "default";
  if (error == MO_OK)
    error = find_base(jobs, made, &base, message);
  if (error == MO_OK)
    error = count_trials(made, &base, message);
  if (error == MO_OK)
    error = mo_back_end_choose(jobs, &request->job,
                               mo_back_end_unsuited(request->environments, request->n_environments),
                               request->record.n_rollouts >= LARGE_ROLLOUTS, message);
  if (error != MO_OK)
    return error;
  const enum mo_back_end back_end = (enum mo_back_end)request->job.back_end;
  const struct mo_need need =
      mo_certificate_need(jobs, request->n_designs, request->record.n_rollouts, back_end);
  const struct mo_orienting under = {.controller = request->controller,
                                     .environment_set = request->environment_set,
                                     .environments = request->environments,
                                     .n_environments = request->n_environments,
                                     .physics = &request->physics,
                                     .precision = MO_FLOAT32,
                                     .workspace = jobs->lattice->workspace};
  error = mo_memory_check(jobs, &need, message);
  if (error == MO_OK)
    error = mo_placed_create(jobs->lattice->workspace, request->genotypes, request->n_designs,
                             &made->placed);
  if (error == MO_OK)
    error = mo_placed_orient(jobs, &under, back_end, &made->placed, request->n_designs,
                             request->notes, request->n_notes, message);
  request->forms = made->placed.forms;
  request->genotypes = made->placed.genotypes;
  return error;
}

int mo_jobs_submit_certificate(struct mo_jobs *jobs, const struct mo_certificate_request *asked,
                               int64_t *id, bool *replayed, struct mo_message *message)
{
  struct completion made = {.request = *asked};
  const struct mo_submission *const job = &asked->job;
  int error = mo_submitting_begin(
      jobs, &(struct mo_submitting){MO_JOB_CERTIFICATE, job, asked->controller, 1, 0}, id, replayed,
      message);
  if (error != MO_OK || *replayed)
    return error;
  error = complete(jobs, &made, message);
  if (error == MO_OK)
    error = mo_jobs_admit(jobs, 1, 0, message);
  if (error == MO_OK)
    error = mo_submitting_end(
        jobs, &(struct mo_submitting){MO_JOB_CERTIFICATE, job, made.request.controller, 1, 0},
        mo_store_submit_certificate(jobs->store, &made.request, id, replayed), *replayed, message);
  free_completion(&made);
  return error;
}
