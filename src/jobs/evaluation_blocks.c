/* evaluation_blocks.c: cuts the cells of a job into blocks for the back end, and stores the
 * results.
 *
 * The look-up for a cell to do checks first the rollouts that are being computed or wait for their
 * commit (the cell is deferred), then the store (the cell is done). Otherwise the cell joins a new
 * block. Only the scheduler adds and removes rollouts, and removes a rollout only after its commit,
 * or when its block fails. So a score is always in one of the two places and is never computed
 * twice. The exception is an interactive job, which does not wait for a device. Verify and
 * recording jobs compute every cell in their own blocks. */
#include <stdlib.h>
#include <string.h>

#include "jobs/evaluation.h"

/* A block of an evaluation. */
struct flight {
  struct mo_flight flight; /* first */
  struct mo_active *owner;
  struct mo_rollout *rollouts[MO_BLOCK_LANES]; /* of jobs that share them */
  struct mo_body *body;                        /* recorded */
  struct mo_recording recordings[MO_BLOCK_LANES];
  uint32_t frames;
  uint64_t recorded_bytes;
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

static struct mo_rollout **bucket_of(struct mo_evaluations *all, const struct mo_rollout *key)
{
  uint64_t h = (uint64_t)key->genotype * UINT64_C(0x9E3779B97F4A7C15);
  h = (h ^ (uint64_t)key->environment) * UINT64_C(0xBF58476D1CE4E5B9);
  h = (h ^ (uint64_t)key->controller ^ ((uint64_t)key->physics << 20)) *
      UINT64_C(0x94D049BB133111EB);
  return &all->buckets[(size_t)(h >> 40) % MO_ROLLOUT_BUCKETS];
}

static struct mo_rollout key_of(const struct mo_work *work, uint32_t design, uint32_t k)
{
  return (struct mo_rollout){.genotype = work->genotype_rows[design],
                             .controller = work->controller,
                             .physics = work->physics,
                             .environment = work->environment_rows[k],
                             .fingerprint = work->fingerprint};
}

/* Defers a cell whose rollout another block of the class computes. */
static bool defer(struct mo_evaluations *all, struct mo_active *active, uint32_t design, uint32_t k)
{
  const struct mo_rollout key = key_of(active->work, design, k);
  const struct mo_rollout *rollout = *bucket_of(all, &key);
  while (rollout != NULL &&
         (rollout->genotype != key.genotype || rollout->environment != key.environment ||
          rollout->controller != key.controller || rollout->physics != key.physics ||
          rollout->fingerprint != key.fingerprint))
    rollout = rollout->next;
  if (rollout == NULL)
    return false;
  *mo_grid_cell(&active->grid, design, k) = MO_CELL_DEFERRED;
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

static void finish_cell(struct mo_evaluations *all, struct mo_active *active, uint32_t design,
                        uint32_t k, int32_t diverged_step)
{
  const struct mo_work *work = active->work;
  const struct mo_saved_design saved = {
      work->genotype_rows[design], work->controller,  work->physics,
      work->environment_set,       work->fingerprint, work->workers};
  const bool is_whole = mo_grid_finish(&active->grid, design, k);
  active->done++;
  active->diverged += diverged_step != 0;
  active->changed = true;
  mo_pending_touch(all);
  if (is_whole && work->environment_set != 0 &&
      mo_pending_add(all, &all->pending.designs, &saved, sizeof(saved)) == NULL)
    mo_active_fail(all, active, MO_ERR_NO_MEMORY, "out of memory");
}

/* Finishes a cell whose score the store has. */
static void finish_known(struct mo_evaluations *all, struct mo_active *active, uint32_t design,
                         uint32_t k, int32_t diverged_step)
{
  const bool was_deferred = *mo_grid_cell(&active->grid, design, k) == MO_CELL_DEFERRED;
  if (!was_deferred && active->own_before > 0)
    active->own_before--;
  else
    active->cached++;
  atomic_fetch_add(was_deferred ? &all->jobs->rollouts_shared : &all->jobs->rollouts_cached, 1);
  finish_cell(all, active, design, k, diverged_step);
}

/* ---- making blocks ---- */

static void free_flight(struct mo_evaluations *all, struct flight *flight)
{
  for (uint32_t i = 0; i < flight->flight.block.n_environments; i++)
    mo_recording_free(&flight->recordings[i]);
  all->recording_bytes -= flight->recorded_bytes;
  mo_body_free(flight->body);
  free(flight);
}

static struct flight *new_flight(struct mo_evaluations *all, struct mo_active *active,
                                 uint32_t design)
{
  struct flight *flight = calloc(1, sizeof(*flight));
  if (flight == NULL)
    return NULL;
  flight->owner = active;
  mo_flight_begin(&flight->flight, &active->grid, design, &all->inbox);
  return flight;
}

/* Submits the block. The job must outlive the block, which uses its grid and controller. */
static void launch(struct mo_evaluations *all, struct flight *flight)
{
  flight->owner->references++;
  flight->owner->n_flights++;
  atomic_fetch_add(&all->jobs->blocks_in_flight, 1);
  mo_flight_launch(all->jobs->compute, &flight->flight);
}

static int prepare_recording(struct mo_evaluations *all, const struct mo_job *job,
                             struct flight *flight)
{
  struct mo_block *block = &flight->flight.block;
  uint32_t frames = mo_recording_frames(&job->physics, job->record_stride);
  int error = mo_body_create(all->jobs->lattice, block->genotype, &flight->body);
  if (error != MO_OK)
    return error;
  flight->frames = frames;
  block->body = flight->body;
  block->recordings = flight->recordings;
  flight->recorded_bytes =
      (uint64_t)block->n_environments * frames *
      mo_recording_frame_bytes(job->record, flight->body->n_masses, flight->body->n_springs);
  all->recording_bytes += flight->recorded_bytes;
  for (uint32_t i = 0; i < block->n_environments && error == MO_OK; i++)
    error = mo_recording_create(&flight->recordings[i], job->record, job->record_stride, frames,
                                flight->body->n_masses, flight->body->n_springs);
  return error;
}

/* Adds a cell to the block of its design, unless that is full. */
static int join_flight(struct mo_evaluations *all, struct mo_active *active, uint32_t design,
                       uint32_t k, struct flight **flight)
{
  struct mo_rollout *rollout = NULL;
  if (*flight == NULL)
    *flight = new_flight(all, active, design);
  if (*flight == NULL)
    return MO_ERR_NO_MEMORY;
  if ((*flight)->flight.block.n_environments == MO_BLOCK_LANES)
    return MO_OK;
  if (!active->private_runs && (rollout = add_rollout(all, active, design, k)) == NULL)
    return MO_ERR_NO_MEMORY;
  (*flight)->rollouts[(*flight)->flight.block.n_environments] = rollout;
  (void)mo_flight_add(&(*flight)->flight, k);
  return MO_OK;
}

static bool is_open(const struct mo_active *active, uint32_t design, uint32_t k)
{
  const uint8_t cell = *mo_grid_cell(&active->grid, design, k);
  return cell == MO_CELL_TO_DO || cell == MO_CELL_DEFERRED;
}

/* Looks up the scores of a design, unless all open cells can be deferred. Returns whether any is
 * left, or an error. */
static int look_up(struct mo_evaluations *all, struct mo_active *active, uint32_t design,
                   struct mo_score *scores)
{
  const struct mo_work *work = active->work;
  uint32_t n = 0;
  int error;
  for (uint32_t k = 0; k < active->grid.n_environments; k++)
    n += is_open(active, design, k) && !defer(all, active, design, k);
  if (n == 0)
    return 0;
  error = mo_store_scores(all->jobs->store, work->genotype_rows[design], work->controller,
                          work->physics, work->fingerprint, work->environment_rows,
                          work->n_environments, scores);
  return error == MO_OK ? 1 : error;
}

/* Finishes the known cells of one design and launches at most one block. 1: launched; 0: nothing is
 * to do; −1: the job failed. */
static int advance_design(struct mo_evaluations *all, struct mo_active *active, uint32_t design)
{
  const bool shares = !active->private_runs;
  struct mo_score scores[MO_ENVIRONMENTS_MAX];
  struct flight *flight = NULL;
  int error = shares ? look_up(all, active, design, scores) : 1;
  if (error == 0)
    return 0;
  error = error > 0 ? MO_OK : error;
  for (uint32_t k = 0; k < active->grid.n_environments && error == MO_OK; k++) {
    if (!is_open(active, design, k))
      continue;
    if (shares && scores[k].known)
      finish_known(all, active, design, k, scores[k].diverged_step);
    else if (!shares || !defer(all, active, design, k)) /* the block may have it already */
      error = join_flight(all, active, design, k, &flight);
  }
  if (flight != NULL && error == MO_OK && active->work->job.record != 0)
    error = prepare_recording(all, &active->work->job, flight);
  if (flight != NULL && flight->flight.block.n_environments > 0 && (shares || error == MO_OK))
    launch(all, flight);
  else if (flight != NULL)
    free_flight(all, flight);
  if (error != MO_OK) {
    mo_active_fail(all, active, error, mo_error_text(error));
    return -1;
  }
  return flight != NULL ? 1 : 0;
}

bool mo_active_advance(struct mo_evaluations *all, struct mo_active *active, unsigned *budget)
{
  struct mo_grid *grid = &active->grid;
  while (grid->cursor < grid->n_designs) {
    const uint8_t *cells = mo_grid_cell(grid, grid->cursor, 0);
    int result = 0;
    if (memchr(cells, MO_CELL_TO_DO, grid->n_environments) != NULL ||
        memchr(cells, MO_CELL_DEFERRED, grid->n_environments) != NULL) {
      if (*budget == 0)
        return false;
      (*budget)--;
      result = advance_design(all, active, grid->cursor);
    }
    if (result != 0)
      return result > 0;
    grid->cursor++; /* what is left of the design is deferred */
  }
  return false;
}

/* ---- taking blocks back ---- */

static int save_recording(struct mo_evaluations *all, struct flight *flight, uint32_t i)
{
  struct mo_saved_trajectory saved = {
      .job = flight->owner->id,
      .design_position = flight->owner->work->positions[flight->flight.design],
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

static int take(struct mo_evaluations *all, struct flight *flight, uint32_t i)
{
  const struct mo_block *block = &flight->flight.block;
  const struct mo_outcome *outcome = &block->outcomes[i];
  struct mo_active *active = flight->owner;
  const struct mo_work *work = active->work;
  const uint32_t design = flight->flight.design, k = flight->flight.places[i];
  const struct mo_saved_score score = {
      .genotype = work->genotype_rows[design],
      .controller = work->controller,
      .physics = work->physics,
      .environment = work->environment_rows[k],
      .fingerprint = block->computed_on == MO_ON_DEVICE ? all->jobs->classes.device
                                                        : all->jobs->classes.cpu[block->precision],
      .loss = outcome->loss,
      .diverged_step = outcome->diverged_step,
      .verify_job = work->job.verify ? active->id : 0,
      .design_position = work->positions[design],
      .environment_position = k};
  int error = mo_flight_check(&flight->flight, i);
  if (error == MO_OK && block->recordings != NULL)
    error = save_recording(all, flight, i);
  if (error == MO_OK && mo_pending_add(all, &all->pending.scores, &score, sizeof(score)) == NULL)
    error = MO_ERR_NO_MEMORY;
  if (error != MO_OK)
    return error;
  if (flight->rollouts[i] != NULL) { /* forgotten after the commit */
    flight->rollouts[i]->next_save = all->pending.rollouts;
    all->pending.rollouts = flight->rollouts[i];
    flight->rollouts[i] = NULL;
  }
  active->computed++;
  atomic_fetch_add(&all->jobs->rollouts_computed, 1);
  atomic_fetch_add(&all->jobs->rollouts_diverged, outcome->diverged_step != 0);
  finish_cell(all, active, design, k, outcome->diverged_step);
  return MO_OK;
}

/* Returns whether an interactive job waits for scores that a block computes. */
static bool somebody_waits(const struct mo_evaluations *all)
{
  for (const struct mo_active *active = all->actives; active != NULL; active = active->next)
    if (active->priority == MO_INTERACTIVE && active->has_deferred && !active->detached)
      return true;
  return false;
}

void mo_active_take_back(struct mo_evaluations *all, struct mo_flight *finished)
{
  struct flight *flight = (struct flight *)finished;
  struct mo_active *active = flight->owner;
  char text[128];
  active->n_flights--;
  atomic_fetch_sub(&all->jobs->blocks_in_flight, 1);
  for (uint32_t i = 0; i < finished->block.n_environments; i++) {
    const int error = take(all, flight, i);
    if (error == MO_OK)
      continue;
    if (flight->rollouts[i] != NULL)
      mo_rollout_forget(all, flight->rollouts[i]);
    mo_grid_return(&active->grid, finished->design, finished->places[i]);
    if (error != MO_ERR_CANCELLED) {
      mo_flight_describe(error, text);
      mo_active_fail(all, active, error, text);
    }
  }
  if (finished->block.urgency == MO_INTERACTIVE || somebody_waits(all))
    all->pending.urgent = true;
  free_flight(all, flight);
  active->references--;
}
