/* submit.c: checks, places and admits an evaluation, then hands it to the store. */
#include <stdlib.h>
#include <string.h>

#include "base/number.h"
#include "jobs/internal.h"

#define INTERACTIVE_ROLLOUTS 64 /* limit if the request has no priority */
/* Interactive jobs go first, so they must be short: about a second of one core. In that time, the
 * float32 kernel moves 40 million springs by one step; the hidden layers of the network cost as
 * much as 100 more springs per rollout. float64 takes twice as long. */
#define INTERACTIVE_COST 40e6
#define NETWORK_SPRINGS  100

int mo_submission_check_texts(const char *label, const char *idempotency_key,
                              struct mo_message *message)
{
  if (label != NULL && strlen(label) > MO_LABEL_BYTES_MAX)
    return mo_fail(message, MO_ERR_RANGE, "the label is longer than %d bytes", MO_LABEL_BYTES_MAX);
  if (idempotency_key != NULL &&
      (idempotency_key[0] == '\0' || strlen(idempotency_key) > MO_IDEMPOTENCY_BYTES_MAX))
    return mo_fail(message, MO_ERR_RANGE, "an idempotency key has 1 to %d bytes",
                   MO_IDEMPOTENCY_BYTES_MAX);
  return MO_OK;
}

int mo_weight_check(double weight, struct mo_message *message)
{
  if (weight == 0 || (weight >= MO_WEIGHT_MIN && weight <= MO_WEIGHT_MAX))
    return MO_OK;
  return mo_fail(message, MO_ERR_RANGE, "a weight is %s to %s, not %s", MO_NUMBER(MO_WEIGHT_MIN),
                 MO_NUMBER(MO_WEIGHT_MAX), MO_NUMBER(weight));
}

int mo_environments_check(const struct mo_environment *environments, uint32_t n, const char *whose,
                          struct mo_message *message)
{
  if (n < 1 || n > MO_ENVIRONMENTS_MAX)
    return mo_fail(message, MO_ERR_RANGE, "%s has 1 to %d environments, not %u", whose,
                   MO_ENVIRONMENTS_MAX, (unsigned)n);
  for (uint32_t k = 0; k < n; k++) {
    uint32_t where = 0;
    int error = mo_environment_check(&environments[k], &where);
    if (error != MO_OK)
      return mo_fail(message, error, "environment %u: value %u is not finite or out of range",
                     (unsigned)k, (unsigned)where);
  }
  return MO_OK;
}

static int check_request(const struct mo_evaluation_request *request, struct mo_message *message)
{
  int error;
  if (request->n_designs < 1 || request->n_designs > MO_DESIGNS_MAX)
    return mo_fail(message, MO_ERR_RANGE, "an evaluation has 1 to %d designs, not %u",
                   MO_DESIGNS_MAX, (unsigned)request->n_designs);
  if (request->environment_set == NULL) {
    error = mo_environments_check(request->environments, request->n_environments, "an evaluation",
                                  message);
    if (error != MO_OK)
      return error;
  }
  error = mo_physics_check(&request->physics, message);
  if (error != MO_OK)
    return error;
  if (request->precision != MO_FLOAT32 && request->precision != MO_FLOAT64)
    return mo_fail(message, MO_ERR_INVALID, "no such precision");
  if (request->priority < -1 || request->priority > MO_INTERACTIVE)
    return mo_fail(message, MO_ERR_INVALID, "no such priority");
  error = mo_weight_check(request->weight, message);
  if (error == MO_OK)
    error = mo_submission_check_texts(request->label, request->idempotency_key, message);
  if (error != MO_OK)
    return error;
  if ((request->record_com || request->record_masses) &&
      (request->record_stride < 1 || request->record_stride > request->physics.n_steps))
    return mo_fail(message, MO_ERR_RANGE,
                   "the stride of a recording is 1 to the number of steps (%u), not %u",
                   (unsigned)request->physics.n_steps, (unsigned)request->record_stride);
  return MO_OK;
}

int mo_designs_place(const struct mo_bits *asked, uint32_t n, struct mo_bits *forms,
                     struct mo_bits *genotypes, struct mo_message *message)
{
  for (uint32_t i = 0; i < n; i++) {
    int contiguous;
    genotypes[i] = asked[i];
    if (mo_genotype_count(MO_DEFAULT_WORKSPACE, genotypes[i].words) == 0)
      return mo_fail(message, MO_ERR_INVALID, "design %u is empty", (unsigned)i);
    contiguous = mo_genotype_is_contiguous(MO_DEFAULT_WORKSPACE, genotypes[i].words);
    if (contiguous < 0)
      return contiguous;
    if (contiguous == 0)
      return mo_fail(message, MO_ERR_INVALID, "design %u is not in one piece", (unsigned)i);
    mo_genotype_place(MO_DEFAULT_WORKSPACE, genotypes[i].words);
    mo_genotype_canonical(MO_DEFAULT_WORKSPACE, genotypes[i].words, forms[i].words);
  }
  return MO_OK;
}

/* Checks the bytes that the recordings of an evaluation will take. */
static int check_recording(struct mo_jobs *jobs, const struct mo_submission *submission,
                           struct mo_message *message)
{
  uint64_t frames = mo_recording_frames(&submission->physics, submission->record_stride);
  uint64_t bytes = 0;
  for (uint32_t i = 0; i < submission->n_designs; i++) {
    uint64_t frame = submission->record_com ? 24 : 0;
    if (submission->record_masses) {
      struct mo_body *body = NULL;
      int error = mo_body_create(jobs->lattice, submission->genotypes[i].words, &body);
      if (error != MO_OK)
        return error;
      frame += (uint64_t)body->n_masses * 12;
      mo_body_free(body);
    }
    bytes += frame * frames * submission->n_environments;
    if (bytes > UINT64_C(1) << 60)
      break;
  }
  if (bytes > jobs->config.max_recorded_bytes)
    return mo_fail(message, MO_ERR_LIMIT,
                   "the recordings would take %llu bytes, the limit is %llu: record less, or with "
                   "a larger stride",
                   (unsigned long long)bytes, (unsigned long long)jobs->config.max_recorded_bytes);
  return MO_OK;
}

int mo_jobs_admit(struct mo_jobs *jobs, uint64_t rollouts, struct mo_message *message)
{
  int error = MO_OK;
  pthread_mutex_lock(&jobs->admission_mutex);
  if (jobs->open_jobs >= jobs->config.max_open_jobs)
    error = mo_fail(message, MO_ERR_BUSY, "%llu jobs are open, which is the limit",
                    (unsigned long long)jobs->open_jobs);
  else if (jobs->open_rollouts > 0 &&
           jobs->open_rollouts + rollouts > jobs->config.max_open_rollouts)
    error = mo_fail(message, MO_ERR_BUSY,
                    "%llu rollouts are waiting; %llu more would pass the limit of %llu",
                    (unsigned long long)jobs->open_rollouts, (unsigned long long)rollouts,
                    (unsigned long long)jobs->config.max_open_rollouts);
  if (error == MO_OK) {
    jobs->open_jobs++;
    jobs->open_rollouts += rollouts;
  }
  pthread_mutex_unlock(&jobs->admission_mutex);
  return error;
}

int mo_submission_explain(int error, const char *controller, struct mo_message *message)
{
  switch (error) {
  case MO_ERR_NOT_FOUND:
    return mo_fail(message, error, "there is no controller \"%.80s\"", controller);
  case MO_ERR_CONFLICT:
    return mo_fail(message, error, "the idempotency key was used with another request");
  case MO_ERR_UNSUPPORTED:
    return mo_fail(message, error, "controller \"%.80s\" is for another workspace", controller);
  case MO_ERR_NO_SPACE: return mo_fail(message, error, "the disk of the state folder is full");
  default: return mo_fail(message, error, "the job could not be stored: %s", mo_error_text(error));
  }
}

static int admit_and_store(struct mo_jobs *jobs, const struct mo_submission *submission,
                           int64_t *id, bool *replayed, struct mo_message *message)
{
  uint64_t rollouts = (uint64_t)submission->n_designs * submission->n_environments;
  int error = mo_jobs_admit(jobs, rollouts, message);
  if (error != MO_OK)
    return error;
  error = mo_store_submit(jobs->store, submission, id, replayed);
  if (error != MO_OK || *replayed)
    mo_jobs_closed(jobs, rollouts);
  if (error != MO_OK)
    return mo_submission_explain(error, submission->controller, message);
  if (!*replayed) {
    atomic_fetch_add(&jobs->submitted, 1);
    mo_jobs_wake(jobs);
  }
  return MO_OK;
}

/* Returns whether the evaluation is short enough to be interactive. */
static int is_short(const struct mo_jobs *jobs, const struct mo_submission *submission, bool *ret)
{
  double cost = (double)submission->n_designs * NETWORK_SPRINGS;
  const double springs_max = INTERACTIVE_COST / submission->n_environments /
                             submission->physics.n_steps /
                             (submission->precision == MO_FLOAT64 ? 2 : 1);
  for (uint32_t i = 0; i < submission->n_designs && cost <= springs_max; i++) {
    struct mo_design_size size;
    int error = mo_design_size(jobs->lattice, submission->genotypes[i].words, &size);
    if (error != MO_OK)
      return error;
    cost += size.springs;
  }
  *ret = cost <= springs_max;
  return MO_OK;
}

static int choose(const struct mo_jobs *jobs, const struct mo_evaluation_request *request,
                  struct mo_submission *submission, struct mo_message *message)
{
  const uint64_t n = (uint64_t)request->n_designs * submission->n_environments;
  const bool is_small = n <= INTERACTIVE_ROLLOUTS && request->back_end != MO_ON_DEVICE;
  bool is_interactive = request->priority >= 0 ? request->priority == MO_INTERACTIVE : is_small;
  int error = is_interactive ? is_short(jobs, submission, &is_interactive) : MO_OK;
  if (error != MO_OK)
    return mo_fail(message, error, "%s", mo_error_text(error));
  submission->priority = is_interactive ? MO_INTERACTIVE : MO_BATCH;
  return mo_back_end_choose(jobs, request->back_end,
                            submission->priority == MO_BATCH && request->precision == MO_FLOAT32 &&
                                !request->record_com && !request->record_masses,
                            n >= MO_DEVICE_ROLLOUTS_MIN && !request->verify, &submission->back_end,
                            message);
}

int mo_jobs_submit_evaluation(struct mo_jobs *jobs, const struct mo_evaluation_request *request,
                              int64_t *id, bool *replayed, struct mo_message *message)
{
  struct mo_submission submission = {.n_designs = request->n_designs,
                                     .environment_set = request->environment_set,
                                     .environments = request->environments,
                                     .n_environments = request->n_environments,
                                     .controller = request->controller != NULL ? request->controller
                                                                               : "default",
                                     .physics = request->physics,
                                     .precision = request->precision,
                                     .weight = request->weight,
                                     .label = request->label,
                                     .verify = request->verify,
                                     .record_com = request->record_com,
                                     .record_masses = request->record_masses,
                                     .record_stride = 1,
                                     .idempotency_key = request->idempotency_key,
                                     .body_sha256 = request->body_sha256};
  struct mo_bits *forms, *genotypes;
  int error;
  if (atomic_load(&jobs->is_stopping))
    return mo_fail(message, MO_ERR_CANCELLED, "the service is stopping");
  error = check_request(request, message);
  if (error != MO_OK)
    return error;
  if (request->idempotency_key != NULL) { /* known keys are answered even when the queue is full */
    error = mo_store_replay(jobs->store, request->idempotency_key, &request->body_sha256, id);
    if (error == MO_OK)
      *replayed = true;
    if (error != MO_ERR_NOT_FOUND)
      return error == MO_OK ? MO_OK : mo_submission_explain(error, submission.controller, message);
  }
  if (request->environment_set != NULL) {
    error = mo_store_environment_set_size(jobs->store, request->environment_set,
                                          &submission.n_environments);
    if (error != MO_OK)
      return mo_fail(message, error, "there is no set of environments \"%.64s\"",
                     request->environment_set);
  }
  if (request->record_com || request->record_masses)
    submission.record_stride = request->record_stride;
  forms = calloc(request->n_designs, sizeof(*forms));
  genotypes = calloc(request->n_designs, sizeof(*genotypes));
  if (forms == NULL || genotypes == NULL) {
    free(forms);
    free(genotypes);
    return mo_fail(message, MO_ERR_NO_MEMORY, "out of memory");
  }
  submission.forms = forms;
  submission.genotypes = genotypes;
  error = mo_designs_place(request->genotypes, request->n_designs, forms, genotypes, message);
  if (error == MO_OK)
    error = choose(jobs, request, &submission, message);
  if (error == MO_OK && (request->record_com || request->record_masses))
    error = check_recording(jobs, &submission, message);
  if (error == MO_OK)
    error = admit_and_store(jobs, &submission, id, replayed, message);
  free(forms);
  free(genotypes);
  return error;
}
