/* rollouts.c: see rollouts.h. */
#include "jobs/rollouts.h"

#include <stdlib.h>
#include <string.h>

#include "jobs/submission.h"
#include "store/worlds.h"

#define RECORDED_MAX ((uint64_t)64 << 20)

void mo_rollouts_free(struct mo_rollouts *rollouts)
{
  if (rollouts == NULL)
    return;
  for (uint32_t i = 0; rollouts->designs != NULL && i < rollouts->n_designs; i++)
    mo_body_free(rollouts->designs[i].body);
  for (uint32_t i = 0;
       rollouts->rollouts != NULL && i < rollouts->n_designs * rollouts->n_environments; i++)
    mo_recording_free(&rollouts->rollouts[i].recording);
  for (uint32_t i = 0; rollouts->ends != NULL && i < rollouts->n_designs * rollouts->n_environments;
       i++)
    mo_state_free(&rollouts->ends[i]);
  free(rollouts->ends);
  free(rollouts->designs);
  mo_environments_free(rollouts->environments, rollouts->n_environments);
  free(rollouts->rollouts);
  free(rollouts);
}

/* ---- the request ---- */

static int take_environments(struct mo_jobs *jobs, const struct mo_evaluation_request *request,
                             struct mo_rollouts *rollouts, struct mo_message *message)
{
  int error;
  if (request->environment_set != NULL) {
    error = mo_store_environment_set(jobs->store, request->environment_set, &rollouts->environments,
                                     &rollouts->n_environments);
    return error == MO_ERR_NOT_FOUND ? mo_fail(message, error, "unknown set of environments")
                                     : error;
  }
  rollouts->environments = malloc(request->n_environments * sizeof(*rollouts->environments));
  if (rollouts->environments == NULL)
    return MO_ERR_NO_MEMORY;
  memcpy(rollouts->environments, request->environments,
         request->n_environments * sizeof(*rollouts->environments));
  mo_environments_hold(rollouts->environments, request->n_environments);
  rollouts->n_environments = request->n_environments;
  return MO_OK;
}

static int take_designs(struct mo_jobs *jobs, const struct mo_evaluation_request *request,
                        struct mo_rollouts *rollouts, struct mo_message *message)
{
  const struct mo_workspace workspace = jobs->lattice->workspace;
  struct mo_evaluation_request here = *request;
  struct mo_placed placed;
  int error = mo_placed_create(workspace, request->genotypes, request->n_designs, &placed);
  if (error != MO_OK)
    return error;
  here.job.back_end = MO_ON_CPU;
  error = mo_evaluation_orient(jobs, &here, &placed, message);
  rollouts->designs = calloc(request->n_designs, sizeof(*rollouts->designs));
  if (error == MO_OK && rollouts->designs == NULL)
    error = MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < request->n_designs && error == MO_OK; i++) {
    struct mo_rolled_design *design = &rollouts->designs[i];
    rollouts->n_designs = i + 1;
    design->form = mo_genotype_of(workspace, &placed.forms[i]);
    design->genotype = mo_genotype_of(workspace, &placed.genotypes[i]);
    error = mo_body_create(jobs->lattice, design->genotype.words, &design->body);
  }
  for (uint32_t i = 0; i < request->n_notes && error == MO_OK; i++) {
    struct mo_rolled_design *design = &rollouts->designs[request->notes[i].place];
    design->dropped = request->notes[i].dropped;
    design->orientation = request->notes[i].orientation;
  }
  mo_placed_free(&placed);
  return error;
}

/* Rejects requests that are not short, or that would make large recordings. */
static int check_size(const struct mo_evaluation_request *request,
                      const struct mo_rollouts *rollouts, struct mo_message *message)
{
  uint64_t springs = 0, bytes = 0;
  if ((uint64_t)rollouts->n_designs * rollouts->n_environments > MO_ROLLOUTS_MAX)
    return mo_fail(message, MO_ERR_LIMIT,
                   "a request may have at most %d rollouts; submit an evaluation for more",
                   MO_ROLLOUTS_MAX);
  for (uint32_t i = 0; i < rollouts->n_designs; i++) {
    const struct mo_body *body = rollouts->designs[i].body;
    springs += body->n_springs;
    bytes += mo_recording_frame_bytes(request->record, body->n_masses, body->n_springs) *
             rollouts->n_frames * rollouts->n_environments;
  }
  if (!mo_is_short(rollouts->n_designs, springs, rollouts->n_environments, &rollouts->physics,
                   request->precision))
    return mo_fail(message, MO_ERR_LIMIT,
                   "these rollouts would take more than about one core-second; submit an "
                   "evaluation instead");
  if (bytes > RECORDED_MAX)
    return mo_fail(
        message, MO_ERR_LIMIT,
        "the recording would take %llu bytes, but the limit is %llu; use a larger stride",
        (unsigned long long)bytes, (unsigned long long)RECORDED_MAX);
  return MO_OK;
}

static int prepare_recordings(const struct mo_evaluation_request *request,
                              struct mo_rollouts *rollouts)
{
  const uint32_t n = rollouts->n_environments;
  rollouts->rollouts = calloc((size_t)rollouts->n_designs * n, sizeof(*rollouts->rollouts));
  int error = rollouts->rollouts != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < rollouts->n_designs * n && error == MO_OK; i++) {
    const struct mo_body *body = rollouts->designs[i / n].body;
    error = mo_recording_create(&rollouts->rollouts[i].recording, request->record,
                                request->record_stride, rollouts->n_frames, body->n_masses,
                                body->n_springs);
  }
  return error;
}

/* ---- states ---- */

/* Checks the states of the request: one for each rollout, of its robot, all at the same time. */
static int check_states(const struct mo_evaluation_request *request,
                        const struct mo_rollout_states *states, const struct mo_rollouts *rollouts,
                        struct mo_message *message)
{
  const uint32_t n_environments = rollouts->n_environments,
                 n = rollouts->n_designs * n_environments;
  struct mo_message why;
  if (states->from == NULL)
    return MO_OK;
  if (states->n_from != n)
    return mo_fail(message, MO_ERR_CONFLICT,
                   "expected %u states, one for each rollout (each design in every environment), "
                   "got %u",
                   n, states->n_from);
  for (uint32_t i = 0; i < n; i++) {
    const struct mo_start *start = &states->from[i];
    const struct mo_rolled_design *design = &rollouts->designs[i / n_environments];
    if (!mo_genotype_equal(&start->robot, &design->genotype))
      return mo_fail(
          message, MO_ERR_CONFLICT,
          "state %u belongs to a different robot than design %u; to start a new robot, omit states",
          i, i / n_environments);
    if (start->state.step != states->from[0].state.step)
      return mo_fail(
          message, MO_ERR_CONFLICT,
          "state %u has a different time_s than state 0; send states with different times in "
          "separate requests",
          i);
    if (mo_state_check(&start->state, design->body, &rollouts->environments[i % n_environments],
                       &rollouts->physics, request->precision, &why) != MO_OK)
      return mo_fail(message, MO_ERR_CONFLICT, "cannot start from state %u: %.200s", i, why.text);
  }
  return MO_OK;
}

static int prepare_ends(struct mo_rollouts *rollouts)
{
  const uint32_t n = rollouts->n_designs * rollouts->n_environments;
  rollouts->ends = calloc(n, sizeof(*rollouts->ends));
  int error = rollouts->ends != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    const struct mo_body *body = rollouts->designs[i / rollouts->n_environments].body;
    error = mo_state_create(&rollouts->ends[i], body->n_masses, body->n_springs, body->n_voxels);
  }
  return error;
}

/* ---- computing ---- */

/* Fills in a block of one design and some of the environments. recordings, from (nullable): for all
 * rollouts. */
static void fill_block(const struct mo_evaluation_request *request, struct mo_rollouts *rollouts,
                       struct mo_loaded *controller, uint32_t design, uint32_t first,
                       struct mo_recording *recordings, const struct mo_state *from,
                       struct mo_block *block)
{
  const uint32_t left = rollouts->n_environments - first;
  const uint32_t row = design * rollouts->n_environments + first;
  *block = (struct mo_block){.body = rollouts->designs[design].body,
                             .controller = controller->ready,
                             .n_environments = left < MO_BLOCK_LANES ? left : MO_BLOCK_LANES,
                             .physics = rollouts->physics,
                             .precision = request->precision,
                             .urgency = rollouts->is_crowded ? MO_INTERACTIVE : MO_IMMEDIATE,
                             .recordings = request->record != 0 ? recordings + row : NULL,
                             .states = {from != NULL ? from + row : NULL,
                                        rollouts->ends != NULL ? rollouts->ends + row : NULL},
                             .tag = -1};
  for (uint32_t k = 0; k < block->n_environments; k++) {
    block->environments[k] = &rollouts->environments[first + k];
    recordings[row + k] = rollouts->rollouts[row + k].recording;
  }
}

static int compute(struct mo_jobs *jobs, const struct mo_evaluation_request *request,
                   struct mo_rollouts *rollouts, struct mo_loaded *controller)
{
  const size_t n_max = (size_t)rollouts->n_designs * rollouts->n_environments;
  struct mo_recording *recordings = calloc(n_max, sizeof(*recordings));
  struct mo_block *blocks = calloc(n_max, sizeof(*blocks));
  struct mo_state *from = rollouts->from != NULL ? calloc(n_max, sizeof(*from)) : NULL;
  const bool has_memory =
      recordings != NULL && blocks != NULL && (from != NULL) == (rollouts->from != NULL);
  int error = has_memory ? MO_OK : MO_ERR_NO_MEMORY;
  size_t n = 0, row = 0;
  for (size_t i = 0; from != NULL && error == MO_OK && i < n_max; i++)
    from[i] = rollouts->from[i].state; /* its arrays still belong to the request */
  for (uint32_t i = 0; i < rollouts->n_designs && error == MO_OK; i++)
    for (uint32_t k = 0; k < rollouts->n_environments; k += MO_BLOCK_LANES, n++)
      fill_block(request, rollouts, controller, i, k, recordings, from, &blocks[n]);
  if (error == MO_OK)
    error = mo_compute_run(jobs->compute, blocks, n);
  for (size_t b = 0; b < n && error == MO_OK; b++)
    for (uint32_t k = 0; k < blocks[b].n_environments; k++)
      rollouts->rollouts[row++].outcome = blocks[b].outcomes[k];
  free(recordings);
  free(blocks);
  free(from);
  return error;
}

static void score(struct mo_rollouts *rollouts)
{
  for (uint32_t i = 0; i < rollouts->n_designs; i++) {
    double sum = 0;
    for (uint32_t k = 0; k < rollouts->n_environments; k++)
      sum += rollouts->rollouts[i * rollouts->n_environments + k].outcome.loss;
    rollouts->designs[i].score = sum / rollouts->n_environments;
  }
}

static int with_controller(struct mo_jobs *jobs, const struct mo_evaluation_request *request,
                           struct mo_rollouts *rollouts)
{
  struct mo_loaded *controller = NULL;
  int error = mo_loaded_acquire(&jobs->controllers, &rollouts->controller, &controller);
  if (error != MO_OK)
    return error;
  rollouts->sensor = controller->controller->sensor;
  error = compute(jobs, request, rollouts, controller);
  mo_loaded_release(&jobs->controllers, controller);
  return error;
}

static int find_controller(struct mo_jobs *jobs, const char *name, struct mo_sha256 *sha256,
                           struct mo_physics *physics, struct mo_message *message)
{
  struct mo_controller_record stored;
  const int error = mo_store_controller(jobs->store, name, &stored);
  if (error == MO_ERR_NOT_FOUND)
    return mo_fail(message, error, "controller \"%s\" does not exist", name);
  if (error == MO_OK && !mo_workspace_equal(stored.workspace, jobs->lattice->workspace))
    return mo_fail(message, MO_ERR_UNSUPPORTED, "the controller is for a different workspace");
  *sha256 = stored.sha256;
  if (error == MO_OK && mo_physics_complete(physics, stored.control_period_s) != MO_OK)
    return mo_fail(message, MO_ERR_RANGE,
                   "controller \"%s\" computes its outputs every %g s, which must be a whole "
                   "multiple of physics.dt_s; choose another dt_s, or set physics.control_period_s",
                   name, stored.control_period_s);
  return error;
}

int mo_jobs_roll(struct mo_jobs *jobs, const struct mo_evaluation_request *request,
                 const struct mo_rollout_states *states, bool is_crowded, struct mo_rollouts **ret,
                 struct mo_message *message)
{
  struct mo_rollouts *rollouts = calloc(1, sizeof(*rollouts));
  int error = rollouts != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  if (error == MO_OK && atomic_load(&jobs->is_stopping))
    error = MO_ERR_CANCELLED;
  if (error == MO_OK)
    rollouts->physics = request->physics;
  if (error == MO_OK && request->n_designs > MO_ROLLOUTS_MAX)
    error = mo_fail(message, MO_ERR_LIMIT,
                    "a request must have 1 to %d designs; submit an evaluation for more",
                    MO_ROLLOUTS_MAX);
  if (error == MO_OK)
    error = take_environments(jobs, request, rollouts, message);
  if (error == MO_OK)
    error = find_controller(jobs, request->controller, &rollouts->controller, &rollouts->physics,
                            message);
  if (error == MO_OK)
    error = take_designs(jobs, request, rollouts, message);
  if (error == MO_OK) {
    rollouts->precision = request->precision;
    rollouts->is_crowded = is_crowded;
    rollouts->n_frames = mo_recording_frames(&request->physics, request->record_stride);
    error = check_size(request, rollouts, message);
  }
  if (error == MO_OK)
    error = check_states(request, states, rollouts, message);
  if (error == MO_OK) {
    rollouts->from = states->from;
    error = prepare_recordings(request, rollouts);
  }
  if (error == MO_OK && states->wants_final)
    error = prepare_ends(rollouts);
  if (error == MO_OK)
    error = with_controller(jobs, request, rollouts);
  if (error != MO_OK) {
    mo_rollouts_free(rollouts);
    return error;
  }
  score(rollouts);
  *ret = rollouts;
  return MO_OK;
}
