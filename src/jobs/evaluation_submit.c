/* evaluation_submit.c: places and admits an evaluation, then passes it to the store. */
#include <morpho/evolution.h>

#include "base/words.h"
#include "jobs/evaluations.h"
#include "jobs/submission.h"
#include "store/controllers.h"

#define INTERACTIVE_ROLLOUTS 64 /* largest interactive job if the request specifies no priority */
/* Interactive jobs go first, so they must be short: about a second of one core. In that time, the
 * float32 kernel moves 40 million springs by one step. The hidden layers of the network cost as
 * much as 100 more springs per rollout. float64 takes twice as long. */
#define INTERACTIVE_COST 40e6
#define NETWORK_SPRINGS  100
/* Fraction of the cost of such a step that is physics, if the network runs in every step. */
#define PHYSICS_SHARE 0.15

bool mo_is_short(uint32_t n_designs, uint64_t springs, uint32_t n_environments,
                 const struct mo_physics *physics, enum mo_precision precision)
{
  const double cost = (double)n_designs * NETWORK_SPRINGS + (double)springs;
  const double steps = physics->scheme.n_steps;
  const uint32_t period = mo_control_steps(&physics->scheme); /* 0: it will be rejected */
  return cost * n_environments * steps *
             (PHYSICS_SHARE + (1 - PHYSICS_SHARE) / (period > 0 ? period : 1)) *
             (precision == MO_FLOAT64 ? 2 : 1) <=
         INTERACTIVE_COST;
}

/* Adds up the springs of the designs and the bytes that their recordings will take. */
static int measure(const struct mo_jobs *jobs, const struct mo_evaluation_request *request,
                   uint64_t *springs, uint64_t *bytes)
{
  const uint64_t frames = mo_recording_frames(&request->physics, request->record_stride);
  for (uint32_t i = 0; i < request->n_designs && *bytes <= UINT64_C(1) << 60; i++) {
    struct mo_design_size size;
    int error = mo_design_size(jobs->lattice, request->genotypes[i].words, &size);
    if (error != MO_OK)
      return error;
    *springs += size.springs;
    *bytes += mo_recording_frame_bytes(request->record, size.masses, size.springs) * frames *
              request->n_environments;
  }
  return MO_OK;
}

/* Chooses priority and back end, and checks the recordings. */
static int choose(struct mo_jobs *jobs, struct mo_evaluation_request *request,
                  struct mo_message *message)
{
  struct mo_submission *job = &request->job;
  const uint32_t cost = mo_ladder_cost(request->n_displaced, request->tolerance);
  const uint64_t n = (uint64_t)request->n_designs * request->n_environments * cost;
  const bool is_small = n <= INTERACTIVE_ROLLOUTS && job->back_end != MO_ON_DEVICE;
  bool is_interactive =
      request->forms != NULL && (job->priority >= 0 ? job->priority == MO_INTERACTIVE : is_small);
  uint64_t springs = 0, bytes = 0;
  int error =
      is_interactive || request->record != 0 ? measure(jobs, request, &springs, &bytes) : MO_OK;
  if (error != MO_OK)
    return mo_fail(message, error, "%s", mo_error_text(error));
  struct mo_physics physics = request->physics;
  struct mo_controller_record controller;
  if (is_interactive && mo_store_controller(jobs->store, request->controller, &controller) == MO_OK)
    (void)mo_physics_complete(&physics, controller.control_period_s); /* submission checks it */
  is_interactive = is_interactive &&
                   mo_is_short(request->n_designs * cost, springs * cost, request->n_environments,
                               &physics, request->tolerance > 0 ? MO_FLOAT64 : request->precision);
  job->priority = is_interactive ? MO_INTERACTIVE : MO_BATCH;
  const bool suits = !is_interactive && request->precision == MO_FLOAT32 && request->record == 0 &&
                     request->n_displaced == 0;
  error = mo_back_end_choose(
      jobs, job,
      suits ? mo_back_end_unsuited(request->environments, request->n_environments)
            : "devices compute only float32 batches without record, error or tolerance; request "
              "\"cpu\" or \"auto\", or leave those out",
      n >= MO_DEVICE_ROLLOUTS_MIN && !request->verify, message);
  if (error == MO_OK && bytes > jobs->config.max_recorded_bytes)
    error = mo_fail(message, MO_ERR_LIMIT,
                    "the recordings would take %llu bytes, but the limit is %llu; record less, or "
                    "use a larger stride",
                    (unsigned long long)bytes, (unsigned long long)jobs->config.max_recorded_bytes);
  return error;
}

int mo_evaluation_orient(struct mo_jobs *jobs, const struct mo_evaluation_request *request,
                         struct mo_placed *placed, struct mo_message *message)
{
  const struct mo_orienting under = {.controller = request->controller,
                                     .environment_set = request->environment_set,
                                     .environments = request->environments,
                                     .n_environments = request->n_environments,
                                     .physics = &request->physics,
                                     .precision = request->precision,
                                     .workspace = jobs->lattice->workspace};
  return mo_placed_orient(jobs, &under, (enum mo_back_end)request->job.back_end, placed,
                          request->n_designs, request->notes, request->n_notes, message);
}

static bool is_suite(const struct mo_evaluation_request *request)
{
  return request->environment_set != NULL &&
         mo_word_index(mo_suite_words, request->environment_set) >= 0;
}

/* Checks that the data for all rows of the grid and all rollouts fit into memory (evaluation.h,
 * best.c, evaluation_climb.c). */
static int check_large(const struct mo_jobs *jobs, const struct mo_evaluation_request *request,
                       struct mo_message *message)
{
  const uint32_t n_sets = is_suite(request) ? MO_SUITE_TASKS : 1;
  const uint64_t runs =
      (uint64_t)request->n_designs * mo_ladder_runs(request->n_displaced, request->tolerance);
  const bool keeps_losses = request->best > 0 || request->tolerance > 0;
  const struct mo_need need = {
      .own = (80 * n_sets + (keeps_losses ? 9 : 1) * (uint64_t)request->n_environments) * runs};
  return mo_memory_check(jobs, &need, message);
}

int mo_jobs_submit_evaluation(struct mo_jobs *jobs, const struct mo_evaluation_request *asked,
                              int64_t *id, bool *replayed, struct mo_message *message)
{
  struct mo_evaluation_request request = *asked;
  struct mo_placed placed = {NULL, NULL};
  request.controller = asked->controller != NULL ? asked->controller : "default";
  request.record_stride = asked->record != 0 ? asked->record_stride : 1;
  struct mo_submitting submitting = {MO_JOB_EVALUATION, &asked->job, request.controller, 1, 0};
  int error = mo_submitting_begin(jobs, &submitting, id, replayed, message);
  if (error != MO_OK || *replayed)
    return error;
  if (request.environment_set != NULL)
    error = mo_environments_count(jobs, request.environment_set, &request.n_environments, message);
  const bool waits = asked->genotypes == NULL || asked->n_designs > MO_DESIGNS_MAX;
  if (error == MO_OK && !waits) {
    error = mo_placed_create(jobs->lattice->workspace, asked->genotypes, asked->n_designs, &placed);
    request.genotypes = placed.genotypes;
  }
  request.forms = placed.forms;
  if (error == MO_OK && (waits || request.tolerance > 0))
    error = check_large(jobs, &request, message);
  if (error == MO_OK)
    error = choose(jobs, &request, message);
  if (error == MO_OK && !waits)
    error = mo_evaluation_orient(jobs, &request, &placed, message);
  submitting.rollouts = (uint64_t)request.n_designs * request.n_environments *
                        mo_ladder_cost(request.n_displaced, request.tolerance);
  if (error == MO_OK)
    error = mo_jobs_admit(jobs, 1, submitting.rollouts, message);
  if (error == MO_OK)
    error =
        mo_submitting_end(jobs, &submitting, mo_store_submit(jobs->store, &request, id, replayed),
                          *replayed, message);
  mo_placed_free(&placed);
  return error;
}
