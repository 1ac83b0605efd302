/* evaluation_submit.c: checks, places and admits an evaluation, then hands it to the store. */
#include <morpho/evolution.h>

#include "jobs/evaluations.h"
#include "jobs/submission.h"

#define INTERACTIVE_ROLLOUTS 64 /* limit if the request has no priority */
/* Interactive jobs go first, so they must be short: about a second of one core. In that time, the
 * float32 kernel moves 40 million springs by one step; the hidden layers of the network cost as
 * much as 100 more springs per rollout. float64 takes twice as long. */
#define INTERACTIVE_COST 40e6
#define NETWORK_SPRINGS  100

static int check_request(const struct mo_evaluation_request *request, struct mo_message *message)
{
  int error;
  const uint32_t n_given = request->n_designs + request->n_skipped;
  if (n_given < 1 || n_given > MO_DESIGNS_MAX)
    return mo_fail(message, MO_ERR_RANGE, "an evaluation has 1 to %d designs, not %u",
                   MO_DESIGNS_MAX, (unsigned)n_given);
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
  if (request->record >> MO_CHANNELS != 0)
    return mo_fail(message, MO_ERR_INVALID, "no such channel of a recording");
  if (request->record != 0 &&
      (request->record_stride < 1 || request->record_stride > request->physics.n_steps))
    return mo_fail(message, MO_ERR_RANGE,
                   "the stride of a recording is 1 to the number of steps (%u), not %u",
                   (unsigned)request->physics.n_steps, (unsigned)request->record_stride);
  return MO_OK;
}

/* Checks the bytes that the recordings of an evaluation will take. */
static int check_recording(struct mo_jobs *jobs, const struct mo_submission *submission,
                           struct mo_message *message)
{
  uint64_t frames = mo_recording_frames(&submission->physics, submission->record_stride);
  uint64_t bytes = 0;
  for (uint32_t i = 0; i < submission->n_designs && bytes <= UINT64_C(1) << 60; i++) {
    struct mo_design_size size;
    int error = mo_design_size(jobs->lattice, submission->genotypes[i].words, &size);
    if (error != MO_OK)
      return error;
    bytes += mo_recording_frame_bytes(submission->record, size.masses, size.springs) * frames *
             submission->n_environments;
  }
  if (bytes > jobs->config.max_recorded_bytes)
    return mo_fail(message, MO_ERR_LIMIT,
                   "the recordings would take %llu bytes, the limit is %llu: record less, or with "
                   "a larger stride",
                   (unsigned long long)bytes, (unsigned long long)jobs->config.max_recorded_bytes);
  return MO_OK;
}

bool mo_is_short(uint32_t n_designs, uint64_t springs, uint32_t n_environments,
                 const struct mo_physics *physics, enum mo_precision precision)
{
  const double cost = (double)n_designs * NETWORK_SPRINGS + (double)springs;
  return cost * n_environments * physics->n_steps * (precision == MO_FLOAT64 ? 2 : 1) <=
         INTERACTIVE_COST;
}

/* Returns whether the evaluation is short enough to be interactive. */
static int is_short(const struct mo_jobs *jobs, const struct mo_submission *submission, bool *ret)
{
  uint64_t springs = 0;
  *ret = true;
  for (uint32_t i = 0; i < submission->n_designs && *ret; i++) {
    struct mo_design_size size;
    int error = mo_design_size(jobs->lattice, submission->genotypes[i].words, &size);
    if (error != MO_OK)
      return error;
    springs += size.springs;
    *ret = mo_is_short(submission->n_designs, springs, submission->n_environments,
                       &submission->physics, submission->precision);
  }
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
  return mo_back_end_choose(
      jobs, request->back_end,
      submission->priority == MO_BATCH && request->precision == MO_FLOAT32 && request->record == 0,
      n >= MO_DEVICE_ROLLOUTS_MIN && !request->verify, &submission->back_end, message);
}

int mo_jobs_submit_evaluation(struct mo_jobs *jobs, const struct mo_evaluation_request *request,
                              int64_t *id, bool *replayed, struct mo_message *message)
{
  struct mo_submission submission = {
      .n_designs = request->n_designs,
      .notes = request->notes,
      .n_notes = request->n_notes,
      .n_skipped = request->n_skipped,
      .environment_set = request->environment_set,
      .environments = request->environments,
      .n_environments = request->n_environments,
      .controller = request->controller != NULL ? request->controller : "default",
      .physics = request->physics,
      .precision = request->precision,
      .weight = request->weight,
      .label = request->label,
      .submitted_by = request->submitted_by,
      .verify = request->verify,
      .record = request->record,
      .record_stride = request->record != 0 ? request->record_stride : 1,
      .idempotency_key = request->idempotency_key,
      .body_sha256 = request->body_sha256};
  struct mo_submitting submitting = {.kind = MO_JOB_EVALUATION,
                                     .n_jobs = 1,
                                     .weight = request->weight,
                                     .controller = submission.controller,
                                     .label = request->label,
                                     .idempotency_key = request->idempotency_key,
                                     .body_sha256 = &request->body_sha256};
  struct mo_placed placed = {NULL, NULL};
  int error = check_request(request, message);
  if (error == MO_OK)
    error = mo_submitting_begin(jobs, &submitting, id, replayed, message);
  if (error != MO_OK || *replayed)
    return error;
  if (request->environment_set != NULL)
    error =
        mo_environments_count(jobs, request->environment_set, &submission.n_environments, message);
  if (error == MO_OK)
    error = mo_placed_create(request->genotypes, request->n_designs, &placed, message);
  submission.forms = placed.forms;
  submission.genotypes = placed.genotypes;
  if (error == MO_OK)
    error = choose(jobs, request, &submission, message);
  if (error == MO_OK && submission.record != 0)
    error = check_recording(jobs, &submission, message);
  submitting.rollouts = (uint64_t)submission.n_designs * submission.n_environments;
  if (error == MO_OK)
    error = mo_jobs_admit(jobs, 1, submitting.rollouts, message);
  if (error == MO_OK)
    error = mo_submitting_end(jobs, &submitting,
                              mo_store_submit(jobs->store, &submission, id, replayed), *replayed,
                              message);
  mo_placed_free(&placed);
  return error;
}
