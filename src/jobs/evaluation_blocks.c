/* evaluation_blocks.c: cuts the cells of a job into blocks for the back end, and stores the
 * results.
 *
 * The look-up for a cell to do checks first the rollouts that are being computed or wait for their
 * commit (the cell waits, too), then the store (the cell is done). Otherwise the cell joins a new
 * block. Only the scheduler adds and removes rollouts, and removes a rollout only after its commit.
 * So a score is always in one of the two places and is never computed twice. The exception is an
 * interactive job, which does not wait for a device. Verify and recording jobs compute every cell
 * in their own blocks. */
#include <stdlib.h>
#include <string.h>

#include "jobs/evaluation.h"

struct mo_waiter {
  struct mo_active *active;
  size_t cell;
  bool owner; /* the block was made for this cell */
  struct mo_waiter *next;
};

/* ---- lanes and failures ---- */

enum mo_lane mo_lane_of(enum mo_urgency priority, enum mo_back_end back_end)
{
  return back_end == MO_ON_DEVICE     ? MO_LANE_DEVICE
         : priority == MO_INTERACTIVE ? MO_LANE_INTERACTIVE
                                      : MO_LANE_BATCH;
}

void mo_flights_cancel(struct mo_evaluations *all, bool every)
{
  for (struct mo_flight *flight = all->flights; flight != NULL; flight = flight->next) {
    bool wanted = flight->rollouts[0] == NULL && !flight->owner->detached;
    for (uint32_t i = 0; i < MO_BLOCK_LANES && flight->rollouts[i] != NULL; i++)
      for (const struct mo_waiter *waiter = flight->rollouts[i]->waiters; waiter != NULL;
           waiter = waiter->next)
        wanted = wanted || !waiter->active->detached;
    if (every || !wanted)
      __atomic_store_n(&flight->cancel, 1, __ATOMIC_RELAXED);
  }
}

void mo_active_fail(struct mo_evaluations *all, struct mo_active *active, int error,
                    const char *text)
{
  char loss[256];
  if (active->detached)
    return;
  active->detached = true;
  if (error == MO_ERR_DEVICE) {
    mo_back_end_describe_loss(all->jobs, loss, sizeof(loss));
    text = loss;
  }
  if (all->jobs->config.warn != NULL)
    all->jobs->config.warn(all->jobs->config.warn_context, active->id, error, text);
  active->failing =
      mo_pending_update(all, active, error == MO_ERR_DEVICE ? MO_STEP_HALT : MO_STEP_RETRY, error,
                        text) == MO_OK;
  mo_flights_cancel(all, false);
}

/* ---- the table of rollouts ---- */

static size_t bucket_of(int64_t genotype, int64_t controller, int64_t physics, int64_t environment)
{
  uint64_t h = (uint64_t)genotype * UINT64_C(0x9E3779B97F4A7C15);
  h = (h ^ (uint64_t)environment) * UINT64_C(0xBF58476D1CE4E5B9);
  h = (h ^ (uint64_t)controller ^ ((uint64_t)physics << 20)) * UINT64_C(0x94D049BB133111EB);
  return (size_t)(h >> 40) % MO_ROLLOUT_BUCKETS;
}

static struct mo_rollout *find_rollout(struct mo_evaluations *all, const struct mo_work *work,
                                       int64_t genotype, int64_t environment)
{
  struct mo_rollout *rollout =
      all->buckets[bucket_of(genotype, work->controller, work->physics, environment)];
  while (rollout != NULL &&
         (rollout->genotype != genotype || rollout->environment != environment ||
          rollout->controller != work->controller || rollout->physics != work->physics))
    rollout = rollout->next;
  return rollout;
}

/* Returns whether the job may wait for the rollout. An interactive job does not wait for a device,
 * whose queue may be seconds long: it computes the rollout again, and the store keeps the result
 * that is saved first. */
static bool may_wait_at(const struct mo_rollout *rollout, const struct mo_active *active)
{
  return active->priority != MO_INTERACTIVE || rollout->flight == NULL ||
         rollout->flight->block.back_end != MO_ON_DEVICE;
}

static struct mo_rollout *add_rollout(struct mo_evaluations *all, const struct mo_work *work,
                                      int64_t genotype, int64_t environment)
{
  struct mo_rollout *rollout = calloc(1, sizeof(*rollout));
  struct mo_rollout **bucket =
      &all->buckets[bucket_of(genotype, work->controller, work->physics, environment)];
  if (rollout == NULL)
    return NULL;
  rollout->genotype = genotype;
  rollout->controller = work->controller;
  rollout->physics = work->physics;
  rollout->environment = environment;
  rollout->next = *bucket;
  *bucket = rollout;
  return rollout;
}

void mo_rollout_forget(struct mo_evaluations *all, struct mo_rollout *rollout)
{
  struct mo_rollout **link = &all->buckets[bucket_of(rollout->genotype, rollout->controller,
                                                     rollout->physics, rollout->environment)];
  while (*link != NULL && *link != rollout)
    link = &(*link)->next;
  if (*link == rollout)
    *link = rollout->next;
  free(rollout);
}

static bool wait_at(struct mo_rollout *rollout, struct mo_active *active, size_t cell, bool owner)
{
  struct mo_waiter *waiter = malloc(sizeof(*waiter));
  if (waiter == NULL)
    return false;
  *waiter = (struct mo_waiter){active, cell, owner, rollout->waiters};
  rollout->waiters = waiter;
  active->references++;
  active->cells[cell] = MO_CELL_IN_FLIGHT;
  return true;
}

/* ---- cells ---- */

enum origin { COMPUTED, SHARED, STORED };

static void finish_cell(struct mo_evaluations *all, struct mo_active *active, size_t cell,
                        int32_t diverged_step, enum origin origin)
{
  uint32_t design = (uint32_t)(cell / active->work->n_environments);
  active->cells[cell] = MO_CELL_DONE;
  active->left[design]--;
  active->done++;
  active->changed = true;
  mo_pending_touch(all);
  if (diverged_step != 0)
    active->diverged++;
  if (origin == STORED && active->own_before > 0)
    active->own_before--;
  else if (origin != COMPUTED)
    active->cached++;
  if (origin == STORED)
    atomic_fetch_add(&all->jobs->cached, 1);
  if (origin == SHARED)
    atomic_fetch_add(&all->jobs->shared, 1);
  if (active->left[design] == 0 && active->work->environment_set != 0) {
    struct mo_saved_design saved = {active->work->genotype_rows[design], active->work->controller,
                                    active->work->physics, active->work->environment_set};
    if (mo_pending_design(all, &saved) != MO_OK)
      mo_active_fail(all, active, MO_ERR_NO_MEMORY, "out of memory");
  }
}

static void return_cell(struct mo_active *active, size_t cell)
{
  uint32_t design = (uint32_t)(cell / active->work->n_environments);
  active->cells[cell] = MO_CELL_TO_DO;
  if (design < active->cursor)
    active->cursor = design;
}

/* ---- making blocks ---- */

static void free_flight(struct mo_flight *flight)
{
  for (uint32_t i = 0; i < flight->block.n_environments; i++) {
    free(flight->recordings[i].com_m);
    free(flight->recordings[i].mass_m);
  }
  flight->all->recording_bytes -= flight->recorded_bytes;
  mo_body_free(flight->body);
  free(flight);
}

static void flight_done(struct mo_block *block, void *context)
{
  struct mo_flight *flight = context;
  struct mo_evaluations *all = flight->all;
  (void)block;
  pthread_mutex_lock(&all->runners->mutex);
  flight->next_inbox = all->finished;
  all->finished = flight;
  pthread_cond_broadcast(&all->runners->news);
  pthread_mutex_unlock(&all->runners->mutex);
}

static struct mo_flight *new_flight(struct mo_evaluations *all, struct mo_active *active,
                                    uint32_t design)
{
  const struct mo_work *work = active->work;
  struct mo_flight *flight = calloc(1, sizeof(*flight));
  if (flight == NULL)
    return NULL;
  flight->all = all;
  flight->genotype = work->genotypes[design];
  flight->block = (struct mo_block){.lattice = all->jobs->lattice,
                                    .genotype = flight->genotype.words,
                                    .controller = active->controller->ready,
                                    .physics = work->job.physics,
                                    .precision = work->job.precision,
                                    .urgency = work->job.priority,
                                    .back_end = active->back_end,
                                    .cancel = &flight->cancel,
                                    .tag = active->id,
                                    .share = all->jobs->evaluation_share,
                                    .done = flight_done,
                                    .context = flight};
  return flight;
}

static enum mo_lane lane_of(const struct mo_flight *flight)
{
  return mo_lane_of(flight->block.urgency, flight->block.back_end);
}

/* Submits the block. The job must outlive the block, which uses its environments and controller. */
static void launch(struct mo_evaluations *all, struct mo_active *active, struct mo_flight *flight)
{
  double cost = (double)flight->block.n_environments * flight->block.physics.n_steps;
  int error;
  active->pass += cost / active->weight;
  active->references++;
  flight->owner = active;
  flight->next = all->flights;
  if (all->flights != NULL)
    all->flights->previous = flight;
  all->flights = flight;
  all->n_flights[lane_of(flight)]++;
  atomic_fetch_add(&all->jobs->blocks_in_flight, 1);
  error = mo_compute_submit(all->jobs->compute, &flight->block);
  if (error != MO_OK) {
    flight->block.status = error;
    flight_done(&flight->block, flight);
  }
}

static int prepare_recording(struct mo_evaluations *all, const struct mo_job *job,
                             struct mo_flight *flight)
{
  uint32_t frames = mo_recording_frames(&job->physics, job->record_stride);
  int error = mo_body_create(all->jobs->lattice, flight->genotype.words, &flight->body);
  if (error != MO_OK)
    return error;
  flight->frames = frames;
  flight->block.body = flight->body;
  flight->block.recordings = flight->recordings;
  flight->recorded_bytes =
      (uint64_t)flight->block.n_environments * frames *
      ((job->record_com ? 24 : 0) + (job->record_masses ? flight->body->n_masses * 12 : 0));
  all->recording_bytes += flight->recorded_bytes;
  for (uint32_t i = 0; i < flight->block.n_environments; i++) {
    struct mo_recording *recording = &flight->recordings[i];
    recording->stride = job->record_stride;
    if (job->record_com)
      recording->com_m = calloc((size_t)frames * 3, sizeof(double));
    if (job->record_masses)
      recording->mass_m = calloc((size_t)frames * flight->body->n_masses * 3, sizeof(float));
    if ((job->record_com && recording->com_m == NULL) ||
        (job->record_masses && recording->mass_m == NULL))
      return MO_ERR_NO_MEMORY;
  }
  return MO_OK;
}

/* Launches the next cells of a design of a verify or recording job, without look-ups. */
static int launch_private(struct mo_evaluations *all, struct mo_active *active, uint32_t design)
{
  const struct mo_work *work = active->work;
  struct mo_flight *flight = new_flight(all, active, design);
  int error = flight == NULL ? MO_ERR_NO_MEMORY : MO_OK;
  if (error == MO_OK)
    for (uint32_t k = 0; k < work->n_environments && flight->block.n_environments < MO_BLOCK_LANES;
         k++) {
      size_t cell = (size_t)design * work->n_environments + k;
      if (active->cells[cell] != MO_CELL_TO_DO)
        continue;
      flight->block.environments[flight->block.n_environments] = &work->environments[k];
      flight->cells[flight->block.n_environments++] = cell;
    }
  if (error == MO_OK && (work->job.record_com || work->job.record_masses))
    error = prepare_recording(all, &work->job, flight);
  if (error != MO_OK) {
    if (flight != NULL)
      free_flight(flight);
    mo_active_fail(all, active, error, mo_error_text(error));
    return -1;
  }
  for (uint32_t i = 0; i < flight->block.n_environments; i++)
    active->cells[flight->cells[i]] = MO_CELL_IN_FLIGHT;
  launch(all, active, flight);
  return 1;
}

/* Adds a cell that neither the table nor the store knows to the block. false: out of memory. */
static bool join_flight(struct mo_evaluations *all, struct mo_active *active, uint32_t design,
                        uint32_t k, struct mo_flight **flight)
{
  const struct mo_work *work = active->work;
  size_t cell = (size_t)design * work->n_environments + k;
  struct mo_rollout *rollout;
  if (*flight == NULL)
    *flight = new_flight(all, active, design);
  if (*flight == NULL)
    return false;
  rollout = add_rollout(all, work, work->genotype_rows[design], work->environment_rows[k]);
  if (rollout == NULL)
    return false;
  rollout->flight = *flight;
  if (!wait_at(rollout, active, cell, true)) {
    mo_rollout_forget(all, rollout);
    return false;
  }
  (*flight)->block.environments[(*flight)->block.n_environments] = &work->environments[k];
  (*flight)->rollouts[(*flight)->block.n_environments++] = rollout;
  return true;
}

/* Finishes the known cells of one design and launches at most one block. 1: launched; 0: not; −1:
 * the job failed. */
static int advance_design(struct mo_evaluations *all, struct mo_active *active, uint32_t design)
{
  const struct mo_work *work = active->work;
  struct mo_score scores[MO_ENVIRONMENTS_MAX];
  struct mo_flight *flight = NULL;
  bool whole = true;
  int error = mo_store_scores(all->jobs->store, work->genotype_rows[design], work->controller,
                              work->physics, work->environment_rows, work->n_environments, scores);
  if (error != MO_OK) {
    mo_active_fail(all, active, error, mo_error_text(error));
    return -1;
  }
  for (uint32_t k = 0; k < work->n_environments && whole; k++) {
    size_t cell = (size_t)design * work->n_environments + k;
    struct mo_rollout *rollout;
    if (active->cells[cell] != MO_CELL_TO_DO)
      continue;
    if (scores[k].known) {
      finish_cell(all, active, cell, scores[k].diverged_step, STORED);
      continue;
    }
    rollout = find_rollout(all, work, work->genotype_rows[design], work->environment_rows[k]);
    if (rollout != NULL && !may_wait_at(rollout, active))
      rollout = NULL;
    if (rollout != NULL && rollout->flight == NULL)
      finish_cell(all, active, cell, rollout->diverged_step, SHARED);
    else if (rollout != NULL)
      whole = wait_at(rollout, active, cell, false);
    else if (flight == NULL || flight->block.n_environments < MO_BLOCK_LANES)
      whole = join_flight(all, active, design, k, &flight);
  }
  if (flight != NULL && flight->block.n_environments > 0)
    launch(all, active, flight);
  else if (flight != NULL)
    free_flight(flight);
  if (!whole) {
    mo_active_fail(all, active, MO_ERR_NO_MEMORY, mo_error_text(MO_ERR_NO_MEMORY));
    return -1;
  }
  return flight != NULL ? 1 : 0;
}

static bool has_cell_to_do(const struct mo_active *active, uint32_t design)
{
  const uint8_t *cells = active->cells + (size_t)design * active->work->n_environments;
  return active->left[design] > 0 &&
         memchr(cells, MO_CELL_TO_DO, active->work->n_environments) != NULL;
}

int mo_active_advance(struct mo_evaluations *all, struct mo_active *active, unsigned *budget)
{
  while (active->cursor < active->work->n_designs) {
    int result;
    if (!has_cell_to_do(active, active->cursor)) {
      active->cursor++;
      continue;
    }
    if (*budget == 0)
      return 0;
    (*budget)--;
    result = active->private_runs ? launch_private(all, active, active->cursor)
                                  : advance_design(all, active, active->cursor);
    if (result != 0)
      return result;
  }
  return -1;
}

/* ---- taking blocks back ---- */

static void drop_flight(struct mo_evaluations *all, struct mo_flight *flight)
{
  if (flight->previous != NULL)
    flight->previous->next = flight->next;
  else
    all->flights = flight->next;
  if (flight->next != NULL)
    flight->next->previous = flight->previous;
  all->n_flights[lane_of(flight)]--;
  atomic_fetch_sub(&all->jobs->blocks_in_flight, 1);
}

/* Reports the outcome to all cells that wait for the rollout, and frees the list. */
static void tell_waiters(struct mo_evaluations *all, struct mo_rollout *rollout, int status)
{
  char text[128];
  while (rollout->waiters != NULL) {
    struct mo_waiter *waiter = rollout->waiters;
    struct mo_active *active = waiter->active;
    rollout->waiters = waiter->next;
    if (status == MO_OK) {
      finish_cell(all, active, waiter->cell, rollout->diverged_step,
                  waiter->owner ? COMPUTED : SHARED);
    } else if (!active->detached) {
      return_cell(active, waiter->cell);
      /* A job that only waited for another job's rollout computes the rollout itself. */
      if (status != MO_ERR_CANCELLED &&
          (status != MO_ERR_DEVICE || active->back_end == MO_ON_DEVICE)) {
        mo_block_describe(status, text);
        mo_active_fail(all, active, status, text);
      }
    }
    free(waiter);
    active->references--;
  }
}

static int64_t fingerprint_of(const struct mo_evaluations *all, const struct mo_block *block)
{
  return block->computed_on == MO_ON_DEVICE ? all->jobs->device_fingerprint
                                            : all->jobs->fingerprints[block->precision];
}

static void land_shared(struct mo_evaluations *all, struct mo_flight *flight)
{
  for (uint32_t i = 0; i < flight->block.n_environments; i++) {
    struct mo_rollout *rollout = flight->rollouts[i];
    const struct mo_outcome *outcome = &flight->block.outcomes[i];
    struct mo_saved_score score = {.genotype = rollout->genotype,
                                   .controller = rollout->controller,
                                   .physics = rollout->physics,
                                   .environment = rollout->environment,
                                   .fingerprint = fingerprint_of(all, &flight->block),
                                   .loss = outcome->loss,
                                   .diverged_step = outcome->diverged_step};
    int status = mo_block_check(&flight->block, i);
    if (status == MO_OK)
      status = mo_pending_score(all, &score);
    if (status == MO_OK) {
      rollout->flight = NULL;
      rollout->diverged_step = outcome->diverged_step;
      rollout->next_save = all->pending.rollouts;
      all->pending.rollouts = rollout;
      atomic_fetch_add(&all->jobs->computed, 1);
      atomic_fetch_add(&all->jobs->diverged, outcome->diverged_step != 0);
      tell_waiters(all, rollout, MO_OK);
    } else {
      tell_waiters(all, rollout, status);
      mo_rollout_forget(all, rollout);
    }
  }
}

static int land_private_cell(struct mo_evaluations *all, struct mo_flight *flight, uint32_t i)
{
  struct mo_active *active = flight->owner;
  const struct mo_work *work = active->work;
  uint32_t design = (uint32_t)(flight->cells[i] / work->n_environments);
  uint32_t k = (uint32_t)(flight->cells[i] % work->n_environments);
  const struct mo_outcome *outcome = &flight->block.outcomes[i];
  struct mo_saved_score score = {.genotype = work->genotype_rows[design],
                                 .controller = work->controller,
                                 .physics = work->physics,
                                 .environment = work->environment_rows[k],
                                 .fingerprint = fingerprint_of(all, &flight->block),
                                 .loss = outcome->loss,
                                 .diverged_step = outcome->diverged_step,
                                 .verify_job = work->job.verify ? active->id : 0,
                                 .design_position = design,
                                 .environment_position = k};
  int error = MO_OK;
  if (flight->block.recordings != NULL) {
    struct mo_saved_trajectory saved = {.job = active->id,
                                        .design_position = design,
                                        .environment_position = k,
                                        .stride = flight->recordings[i].stride,
                                        .frames = flight->frames,
                                        .n_masses = flight->body->n_masses,
                                        .com_m = flight->recordings[i].com_m,
                                        .mass_m = flight->recordings[i].mass_m};
    error = mo_pending_trajectory(all, &saved);
    if (error == MO_OK) { /* the save owns the arrays now */
      flight->recordings[i].com_m = NULL;
      flight->recordings[i].mass_m = NULL;
    }
  }
  if (error == MO_OK)
    error = mo_pending_score(all, &score);
  if (error != MO_OK)
    return error;
  atomic_fetch_add(&all->jobs->computed, 1);
  atomic_fetch_add(&all->jobs->diverged, outcome->diverged_step != 0);
  finish_cell(all, active, flight->cells[i], outcome->diverged_step, COMPUTED);
  return MO_OK;
}

static void land_private(struct mo_evaluations *all, struct mo_flight *flight)
{
  struct mo_active *active = flight->owner;
  char text[128];
  for (uint32_t i = 0; i < flight->block.n_environments; i++) {
    int status = mo_block_check(&flight->block, i);
    if (status == MO_OK)
      status = land_private_cell(all, flight, i);
    if (status == MO_OK || active->detached)
      continue;
    return_cell(active, flight->cells[i]);
    if (status != MO_ERR_CANCELLED) {
      mo_block_describe(status, text);
      mo_active_fail(all, active, status, text);
    }
  }
}

void mo_flight_land(struct mo_evaluations *all, struct mo_flight *flight)
{
  struct mo_active *owner = flight->owner;
  drop_flight(all, flight);
  if (flight->rollouts[0] != NULL)
    land_shared(all, flight);
  else
    land_private(all, flight);
  if (flight->block.urgency == MO_INTERACTIVE)
    all->pending.urgent = true;
  free_flight(flight);
  owner->references--;
}
