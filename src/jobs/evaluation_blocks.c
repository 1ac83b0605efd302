/* evaluation_blocks.c: what evaluations add to the blocks of scoring.c: look-ups, rollouts shared
 * between jobs, recordings.
 *
 * The look-up for an open cell first checks the rollouts that are being computed or are waiting for
 * their commit (then the cell is deferred), and then the store (then the cell is done). Otherwise
 * the cell joins a new block. Only the scheduler adds and removes rollouts, and removes a rollout
 * only after its commit, or when its block fails. A score is therefore always in one of the two
 * places and is never computed twice, except for interactive jobs, which do not wait for a device.
 * Verify and recording jobs compute every cell in their own blocks. */
#include <stdlib.h>
#include <string.h>

#include <morpho/score_ladder.h>

#include "base/clock.h"
#include "jobs/evaluation_climb.h"

/* A block of an evaluation. */
struct flight {
  struct mo_flight flight;                     /* must be the first member */
  struct mo_rollout *rollouts[MO_BLOCK_LANES]; /* rollouts of jobs that share them */
  struct mo_body *body;                        /* the body, if it is recorded */
  struct mo_recording recordings[MO_BLOCK_LANES];
  uint32_t frames;
  uint64_t recorded_bytes;
  struct mo_measuring measuring;
  double (*measures)[MO_MEASURES]; /* NULL: none, or the save owns them */
};

void mo_active_detach(struct mo_active *active)
{
  active->detached = true;
  __atomic_store_n(&active->cancel, 1, __ATOMIC_RELAXED);
}

void mo_active_fail(struct mo_evaluations *all, struct mo_active *active, int error,
                    const char *text)
{
  const struct mo_jobs_config *config = &all->jobs->config;
  char loss[256];
  if (active->detached)
    return;
  mo_active_detach(active);
  if (error == MO_ERR_DEVICE) {
    mo_back_end_describe_loss(all->jobs, loss, sizeof(loss));
    text = loss;
  }
  if (config->warn != NULL)
    config->warn(config->warn_context, active->id, error, text);
  active->failing =
      mo_pending_update(all, active, error == MO_ERR_DEVICE ? MO_STEP_HALT : MO_STEP_RETRY, error,
                        text) != NULL;
}

/* ---- the table of rollouts ---- */

static struct mo_rollout **bucket_of(struct mo_evaluations *all, const struct mo_rollout *rollout)
{
  uint64_t h = 0;
  for (size_t i = 0; i < sizeof(rollout->key) / sizeof(rollout->key[0]); i++)
    h = (h ^ (uint64_t)rollout->key[i]) * UINT64_C(0x9E3779B97F4A7C15);
  return &all->buckets[(size_t)(h >> 40) % MO_ROLLOUT_BUCKETS];
}

/* Returns the number of the run that a row of the grid is for its design (score_ladder.h); 0
 * without estimates. */
static uint32_t run_of(const struct mo_work *work, uint32_t design)
{
  return design / (work->n_designs / work->n_runs);
}

/* Returns whether a row of the grid has measures: the additional runs have none. */
static bool is_measured(const struct mo_work *work, uint32_t design)
{
  return work->job.measures != 0 && run_of(work, design) == 0;
}

static int64_t physics_of(const struct mo_work *work, uint32_t design)
{
  return work->physics_rows[run_of(work, design)];
}

static struct mo_setting setting_of(const struct mo_work *work, uint32_t design)
{
  const struct mo_setting first = {work->job.physics, work->job.precision};
  return mo_ladder_run(&first, work->job.n_displaced, run_of(work, design));
}

/* Returns the class that stores the rollouts of a row: the float64 rungs have a separate one. */
static int64_t class_of(const struct mo_work *work, uint32_t design)
{
  return work->job.tolerance > 0 && setting_of(work, design).precision == MO_FLOAT64
             ? work->workers
             : work->fingerprint;
}

/* Returns which set of a suite a row of the grid is in; 0 without a suite. */
static uint32_t set_of(const struct mo_work *work, uint32_t design)
{
  return design / (work->n_designs / work->n_sets);
}

/* Returns the database ids of the environments of one design in the grid. */
static const int64_t *environments_of(const struct mo_work *work, uint32_t design)
{
  return &work->environment_rows[(size_t)set_of(work, design) * work->n_environments];
}

static struct mo_rollout key_of(const struct mo_work *work, uint32_t design, uint32_t k)
{
  return (struct mo_rollout){.key = {work->genotype_rows[design], environments_of(work, design)[k],
                                     work->controller, physics_of(work, design),
                                     class_of(work, design)}};
}

/* Returns whether another block of the same class is computing the rollout of a cell. */
static bool must_wait(struct mo_evaluations *all, struct mo_active *active, uint32_t design,
                      uint32_t k)
{
  const struct mo_rollout key = key_of(active->work, design, k);
  const struct mo_rollout *rollout = *bucket_of(all, &key);
  while (rollout != NULL && memcmp(rollout->key, key.key, sizeof(key.key)) != 0)
    rollout = rollout->next;
  if (rollout == NULL)
    return false;
  active->has_deferred = true;
  return true;
}

static struct mo_rollout *add_rollout(struct mo_evaluations *all, const struct mo_active *active,
                                      uint32_t design, uint32_t k)
{
  struct mo_rollout *rollout = malloc(sizeof(*rollout)), **bucket;
  if (rollout == NULL)
    return NULL;
  *rollout = key_of(active->work, design, k);
  bucket = bucket_of(all, rollout);
  rollout->next = *bucket;
  *bucket = rollout;
  return rollout;
}

void mo_rollout_forget(struct mo_evaluations *all, struct mo_rollout *rollout)
{
  struct mo_rollout **link = bucket_of(all, rollout);
  while (*link != rollout)
    link = &(*link)->next;
  *link = rollout->next;
  free(rollout);
  all->visit_again = true;
}

/* ---- cells ---- */

static void count_cell(struct mo_evaluations *all, struct mo_active *active, uint32_t design,
                       uint32_t k, double loss, int32_t diverged_step)
{
  if (active->race != NULL) {
    mo_best_give(active->race, design, k, loss);
    active->n_asked--;
  }
  if (active->climbs != NULL)
    mo_active_climb_give(active, design, k, loss);
  active->done++;
  active->diverged += diverged_step != 0;
  active->changed = true;
  mo_pending_touch(all);
}

static struct mo_saved_design design_of(const struct mo_work *work, uint32_t design)
{
  return (struct mo_saved_design){work->genotype_rows[design], work->controller,
                                  physics_of(work, design),    work->sets[set_of(work, design)],
                                  class_of(work, design),      work->workers};
}

/* Saves the mean of a design if its cells are done. The additional runs are not ranked. */
static int finish_design(struct mo_evaluations *all, const struct mo_active *active,
                         uint32_t design)
{
  const struct mo_saved_design saved = design_of(active->work, design);
  return saved.environment_set == 0 || run_of(active->work, design) > 0 ||
                 mo_pending_add(all, &all->pending.designs, &saved, sizeof(saved)) != NULL
             ? MO_OK
             : MO_ERR_NO_MEMORY;
}

/* Finishes a cell with a score in the store. Returns whether its design is done. */
static bool finish_known(struct mo_evaluations *all, struct mo_active *active, uint32_t design,
                         uint32_t k, const struct mo_score *score)
{
  const bool was_deferred = *mo_grid_cell(&active->grid, design, k) == MO_CELL_DEFERRED;
  if (!was_deferred && active->own_before > 0)
    active->own_before--;
  else
    active->cached++;
  atomic_fetch_add(was_deferred ? &all->jobs->rollouts_shared : &all->jobs->rollouts_cached, 1);
  count_cell(all, active, design, k, score->loss, score->diverged_step);
  return mo_grid_finish(&active->grid, design, k);
}

/* Finishes the cells of a design with scores in the store, unless all open cells must wait. */
static int look_up(void *context, uint32_t design)
{
  struct mo_active *active = context;
  struct mo_evaluations *all = active->all;
  const struct mo_work *work = active->work;
  const int64_t *environments = environments_of(work, design);
  struct mo_saved_design key = design_of(work, design);
  struct mo_score scores[MO_ENVIRONMENTS_MAX];
  uint64_t measured = UINT64_MAX; /* a score without its measures counts as unknown */
  bool any = false, is_done = false;
  int error;
  for (uint32_t k = 0; k < work->n_environments && !any && !active->private_runs; k++)
    any = mo_grid_is_open(&active->grid, design, k) && !must_wait(all, active, design, k);
  if (!any)
    return MO_OK;
  key.workers = 0; /* use only the job's own class */
  error = mo_store_scores(all->jobs->store, &key, environments, work->n_environments, scores);
  if (error == MO_OK && is_measured(work, design))
    error = mo_store_measured(all->jobs->store, &key, environments, work->n_environments,
                              work->job.measures, &measured);
  for (uint32_t k = 0; k < work->n_environments && error == MO_OK; k++)
    if (scores[k].known && (measured >> k & 1) && mo_grid_is_open(&active->grid, design, k))
      is_done = finish_known(all, active, design, k, &scores[k]);
  return is_done ? finish_design(all, active, design) : error;
}

/* ---- blocks ---- */

/* Returns whether a cell may join a block. The block may already have the same rollout. */
static int joins(void *context, struct mo_flight *flight, uint32_t k)
{
  struct mo_active *active = context;
  struct mo_rollout **rollout = &((struct flight *)flight)->rollouts[flight->block.n_environments];
  if (active->private_runs)
    return 1;
  if (must_wait(active->all, active, flight->design, k))
    return 0;
  *rollout = add_rollout(active->all, active, flight->design, k);
  return *rollout != NULL ? 1 : MO_ERR_NO_MEMORY;
}

/* All measures are computed, no matter which were requested: most of the time is spent on observing
 * the body once, and later requests will find the others. */
static int prepare_measures(struct flight *flight)
{
  struct mo_block *block = &flight->flight.block;
  flight->measures = malloc(block->n_environments * sizeof(*flight->measures));
  if (flight->measures == NULL)
    return MO_ERR_NO_MEMORY;
  flight->measuring = (struct mo_measuring){.set = MO_MEASURES_ALL, .values = flight->measures};
  block->measuring = &flight->measuring;
  return MO_OK;
}

static int prepare(void *context, struct mo_flight *any)
{
  struct mo_active *active = context;
  struct flight *flight = (struct flight *)any;
  struct mo_block *block = &flight->flight.block;
  const struct mo_job *job = &active->work->job;
  if (active->work->n_runs > 1) {
    const struct mo_setting setting = setting_of(active->work, any->design);
    block->physics = setting.physics;
    block->precision = setting.precision;
  }
  int error = job->record != 0
                  ? mo_body_create(active->all->jobs->lattice, block->genotype, &flight->body)
                  : MO_OK;
  if (error == MO_OK && is_measured(active->work, any->design))
    error = prepare_measures(flight);
  if (error != MO_OK || job->record == 0)
    return error;
  flight->frames = mo_recording_frames(&job->physics, job->record_stride);
  block->body = flight->body;
  block->recordings = flight->recordings;
  flight->recorded_bytes =
      (uint64_t)block->n_environments * flight->frames *
      mo_recording_frame_bytes(job->record, flight->body->n_masses, flight->body->n_springs);
  active->all->recording_bytes += flight->recorded_bytes;
  for (uint32_t i = 0; i < block->n_environments && error == MO_OK; i++)
    error = mo_recording_create(&flight->recordings[i], job->record, job->record_stride,
                                flight->frames, flight->body->n_masses, flight->body->n_springs);
  return error;
}

void mo_active_open_window(struct mo_active *active)
{
  struct mo_evaluations *all = active->all;
  active->window = (struct mo_window){.compute = all->jobs->compute,
                                      .inbox = &all->inbox,
                                      .grid = &active->grid,
                                      .flight_bytes = sizeof(struct flight),
                                      .context = active,
                                      .look_up = look_up,
                                      .joins = joins,
                                      .prepare = prepare};
}

/* ---- taking blocks back ---- */

static int save_recording(struct mo_evaluations *all, const struct mo_active *active,
                          struct flight *flight, uint32_t i)
{
  struct mo_saved_trajectory saved = {
      .job = active->id,
      .design_position = active->work->positions[flight->flight.design],
      .environment_position = flight->flight.places[i],
      .frames = flight->frames,
      .n_masses = flight->body->n_masses,
      .n_springs = flight->body->n_springs,
      .diverged_step = flight->flight.block.outcomes[i].diverged_step,
      .recording = flight->recordings[i]};
  if (mo_pending_add(all, &all->pending.trajectories, &saved, sizeof(saved)) == NULL)
    return MO_ERR_NO_MEMORY;
  all->pending.recorded_bytes += flight->recorded_bytes / flight->flight.block.n_environments;
  flight->recordings[i] = (struct mo_recording){0}; /* the save owns the arrays now */
  return MO_OK;
}

static int take(struct mo_evaluations *all, struct mo_active *active, struct flight *flight)
{
  const struct mo_block *block = &flight->flight.block;
  const struct mo_work *work = active->work;
  const int64_t *environments = environments_of(work, flight->flight.design);
  struct mo_saved_block saved = {
      .genotype = work->genotype_rows[flight->flight.design],
      .condition = {.controller = work->controller,
                    .physics = physics_of(work, flight->flight.design),
                    .fingerprint = block->computed_on == MO_ON_DEVICE
                                       ? work->fingerprint
                                       : all->jobs->classes.cpu[block->precision],
                    .n = block->n_environments},
      .origin = block->origin,
      .measures = flight->measures,
      .verify_job = work->job.verify ? active->id : 0,
      .design_position = work->positions[flight->flight.design]};
  int error = MO_OK;
  memcpy(saved.places, flight->flight.places, sizeof(saved.places));
  for (uint32_t i = 0; i < block->n_environments && error == MO_OK; i++) {
    saved.condition.environments[i] = environments[saved.places[i]];
    saved.losses[i] = block->outcomes[i].loss;
    saved.diverged_steps[i] = (uint32_t)block->outcomes[i].diverged_step;
    if (block->recordings != NULL)
      error = save_recording(all, active, flight, i);
  }
  if (error == MO_OK && mo_pending_add(all, &all->pending.blocks, &saved, sizeof(saved)) == NULL)
    error = MO_ERR_NO_MEMORY;
  if (error == MO_OK)
    flight->measures = NULL; /* the save owns them now */
  for (uint32_t i = 0; i < block->n_environments && error == MO_OK; i++) {
    if (flight->rollouts[i] != NULL) { /* forgotten after the commit */
      flight->rollouts[i]->next_save = all->pending.rollouts;
      all->pending.rollouts = flight->rollouts[i];
      flight->rollouts[i] = NULL;
    }
    atomic_fetch_add(&all->jobs->rollouts_diverged, saved.diverged_steps[i] != 0);
    count_cell(all, active, flight->flight.design, saved.places[i], saved.losses[i],
               block->outcomes[i].diverged_step);
  }
  if (error != MO_OK)
    return error;
  all->pending.n_losses += block->n_environments;
  active->computed += block->n_environments;
  mo_pace_add(&active->pace, mo_clock_us(), active->computed);
  atomic_fetch_add(&all->jobs->rollouts_computed, block->n_environments);
  return MO_OK;
}

/* Returns whether an interactive job is waiting for scores that a block computes. */
static bool has_waiting_job(const struct mo_evaluations *all)
{
  for (const struct mo_active *active = all->actives; active != NULL; active = active->next)
    if (active->priority == MO_INTERACTIVE && active->has_deferred && !active->detached)
      return true;
  return false;
}

/* Frees a block, and forgets its rollouts that are not in any save. */
static void free_flight(struct mo_evaluations *all, struct flight *flight)
{
  for (uint32_t i = 0; i < flight->flight.block.n_environments; i++) {
    mo_recording_free(&flight->recordings[i]);
    if (flight->rollouts[i] != NULL)
      mo_rollout_forget(all, flight->rollouts[i]);
  }
  all->recording_bytes -= flight->recorded_bytes;
  mo_body_free(flight->body);
  free(flight->measures);
  free(flight);
}

void mo_active_take_back(struct mo_evaluations *all, struct mo_flight *finished)
{
  struct flight *flight = (struct flight *)finished;
  struct mo_active *active = finished->window->context;
  const bool is_interactive = active->priority == MO_INTERACTIVE;
  char text[128] = "out of memory";
  bool is_done;
  int error = mo_window_take(&active->window, finished, &is_done, text);
  if (error == MO_OK)
    error = take(all, active, flight);
  if (error == MO_OK && is_done)
    error = finish_design(all, active, finished->design);
  if (error != MO_OK && error != MO_ERR_CANCELLED)
    mo_active_fail(all, active, error, text);
  if (is_interactive || has_waiting_job(all))
    all->pending.urgent = true;
  free_flight(all, flight);
}
