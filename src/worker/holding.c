/* holding.c: see holding.h. The mutex guards everything except members that only the caller's
 * thread uses. A block's `done` runs on a worker: it copies the losses and submits the next block
 * in its place. */
#include "worker/holding.h"

#include <stdlib.h>

#include "base/clock.h"
#include "base/thread.h"
#include "compute/internal.h"
#include "worker/weights.h"

#define SLOTS_PER_WORKER 2
/* Rows per message: 8 MB, which the daemon accepts. */
#define RESULT_ROWS_MAX  (5 * MO_WIRE_ROWS_MAX)
#define SLOTS_OF_DEVICES 16384 /* slots for about two chunks */

enum lease_state {
  WAITING, /* it waits for weights */
  RUNNING, /* blocks are submitted or will be */
  ENDING   /* nothing more is submitted */
};

struct lease {
  struct mo_holding *holding;
  struct mo_wire_lease wire;
  enum lease_state state;
  bool is_dropped, is_given_back;
  int error; /* of the first block that failed */
  struct mo_compute_controller *controller;
  struct mo_compute_share *share;
  volatile int cancel;
  uint32_t n_submitted, n_out; /* blocks: submitted so far; in the back end */
  uint32_t next_row;           /* of the next block */
  uint64_t started_ns, ended_ns;
  struct mo_wire_result result; /* prepared as for a success */
  pthread_t thread;             /* of a gradient, if has_thread */
  bool has_thread;
  struct lease *next;
};

struct slot {
  struct lease *lease; /* NULL: free */
  uint32_t first_row;
  struct mo_block block;
  struct mo_measuring measuring;
  struct slot *next; /* next free slot */
};

struct mo_holding {
  struct mo_holding_config config;
  struct mo_kept_weights weights;
  struct mo_lattice *lattice;
  pthread_mutex_t mutex;
  pthread_cond_t quiet; /* the last block has left the back end */
  struct lease *leases; /* in order of arrival */
  struct slot *slots;
  struct slot *free[2]; /* by enum mo_back_end */
  uint32_t n_out;
  uint64_t rows_done, leases_done;
};

/* ---- blocks ---- */

static bool has_ended(const struct lease *lease)
{
  return lease->n_out == 0 &&
         (lease->state == ENDING || lease->n_submitted == lease->wire.n_blocks);
}

/* Under the mutex: fills a slot with the next block. Returns NULL if there is no free slot or no
 * block. */
static struct slot *next_block(struct mo_holding *holding, enum mo_back_end back_end)
{
  struct lease *lease = holding->leases;
  while (lease != NULL && (lease->state != RUNNING || lease->wire.back_end != back_end ||
                           lease->n_submitted == lease->wire.n_blocks))
    lease = lease->next;
  struct slot *slot = lease != NULL ? holding->free[back_end] : NULL;
  if (slot == NULL)
    return NULL;
  holding->free[back_end] = slot->next;
  const struct mo_wire_block *from = &lease->wire.blocks[lease->n_submitted++];
  slot->lease = lease;
  slot->first_row = lease->next_row;
  lease->next_row += from->n_environments;
  lease->n_out++;
  holding->n_out++;
  slot->block.lattice = holding->lattice;
  slot->block.genotype = from->genotype;
  slot->block.controller = lease->controller;
  slot->block.share = lease->share;
  slot->block.n_environments = from->n_environments;
  for (uint32_t k = 0; k < from->n_environments; k++)
    slot->block.environments[k] = &lease->wire.environments[from->environments[k]];
  slot->block.physics = lease->wire.physics;
  slot->block.cancel = &lease->cancel;
  slot->block.measuring = NULL;
  if (lease->wire.has_measures) {
    slot->measuring = (struct mo_measuring){.set = MO_MEASURES_ALL,
                                            .values = lease->result.measures + slot->first_row};
    slot->block.measuring = &slot->measuring;
  }
  return slot;
}

/* Under the mutex: takes the result of a block. Returns whether the lease has ended with it. */
static bool take_block(struct slot *slot, int status)
{
  struct lease *lease = slot->lease;
  struct mo_holding *holding = lease->holding;
  if (status == MO_OK && slot->block.computed_on != lease->wire.back_end)
    status = MO_ERR_UNSUPPORTED; /* its bits belong to a different class */
  for (uint32_t k = 0; status == MO_OK && k < slot->block.n_environments; k++) {
    const struct mo_outcome *outcome = &slot->block.outcomes[k];
    lease->result.losses[slot->first_row + k] = outcome->loss;
    lease->result.diverged_steps[slot->first_row + k] = (uint32_t)outcome->diverged_step;
  }
  if (status != MO_OK && lease->error == MO_OK) {
    lease->error = status;
    lease->state = ENDING;
    __atomic_store_n(&lease->cancel, 1, __ATOMIC_RELAXED);
  }
  if (status == MO_OK)
    holding->rows_done += slot->block.n_environments;
  slot->lease = NULL;
  slot->next = holding->free[lease->wire.back_end];
  holding->free[lease->wire.back_end] = slot;
  lease->n_out--;
  holding->n_out--;
  if (holding->n_out == 0)
    pthread_cond_broadcast(&holding->quiet);
  if (!has_ended(lease))
    return false;
  lease->ended_ns = mo_clock_ns();
  return true;
}

/* Submits blocks while slots are free. Releases the mutex during a submission, because a block can
 * be done before its submission returns. */
static void submit(struct mo_holding *holding, enum mo_back_end back_end)
{
  bool ended = false;
  struct slot *slot;
  while ((slot = next_block(holding, back_end)) != NULL) {
    pthread_mutex_unlock(&holding->mutex);
    const int error = mo_compute_submit(holding->config.compute, &slot->block);
    pthread_mutex_lock(&holding->mutex);
    if (error != MO_OK)
      ended |= take_block(slot, error);
  }
  if (ended)
    holding->config.ended(holding->config.context);
}

static void block_done(struct mo_block *block, void *context)
{
  struct slot *slot = context;
  struct mo_holding *holding = slot->lease->holding;
  MO_GUARD(&holding->mutex);
  const enum mo_back_end back_end = block->back_end;
  const bool ended = take_block(slot, block->status);
  submit(holding, back_end);
  if (ended)
    holding->config.ended(holding->config.context);
}

/* ---- gradients ---- */

/* Under the mutex: gives the oldest gradient priority, so that the next one only fills the gaps. */
static void prefer_first(struct mo_holding *holding)
{
  double weight = 1;
  for (struct lease *lease = holding->leases; lease != NULL; lease = lease->next)
    if (lease->has_thread && lease->n_out > 0) {
      mo_compute_share_set_weight(lease->share, weight);
      weight = MO_SHARE_WEIGHT_MIN;
    }
}

static void free_robots(struct mo_robot *robots, uint32_t n)
{
  for (uint32_t i = 0; robots != NULL && i < n; i++)
    mo_body_free((struct mo_body *)robots[i].body);
  free(robots);
}

static int make_robots(const struct lease *lease, struct mo_robot *robots)
{
  int error = MO_OK;
  for (uint32_t i = 0; i < lease->wire.n_blocks && error == MO_OK; i++) {
    const struct mo_wire_block *block = &lease->wire.blocks[i];
    struct mo_body *body = NULL;
    error = mo_body_create(lease->holding->lattice, block->genotype, &body);
    robots[i].body = body;
    robots[i].environment = &lease->wire.environments[block->environments[0]];
  }
  return error;
}

static int differentiate(struct lease *lease, struct mo_gradient_state *state,
                         const struct mo_robot *robots, struct mo_outcome *outcomes)
{
  const struct mo_wire_lease *wire = &lease->wire;
  const struct mo_controller *controller = mo_compute_controller_weights(lease->controller);
  if (controller == NULL || controller->n_parameters != wire->n_parameters)
    return MO_ERR_FORMAT;
  struct mo_gradient_batch batch = {.controller = controller,
                                    .robots = robots,
                                    .n = wire->n_blocks,
                                    .physics = wire->physics,
                                    .options = wire->gradient,
                                    .cancel = &lease->cancel,
                                    .tag = -1,
                                    .share = lease->share,
                                    .back_end = wire->back_end,
                                    .is_arranged = true,
                                    .is_strict = true,
                                    .d_parameters = lease->result.d_parameters,
                                    .outcomes = outcomes};
  const int error = mo_compute_gradient(state, &batch);
  lease->result.counts = batch.counts;
  for (uint32_t i = 0; i < wire->n_blocks && error == MO_OK; i++) {
    lease->result.losses[i] = outcomes[i].loss;
    lease->result.diverged_steps[i] = (uint32_t)outcomes[i].diverged_step;
  }
  return error;
}

static void *compute_gradient(void *argument)
{
  struct lease *lease = argument;
  struct mo_holding *holding = lease->holding;
  const uint32_t n = lease->wire.n_blocks;
  struct mo_gradient_state *state = NULL;
  struct mo_robot *robots = calloc(n, sizeof(*robots));
  struct mo_outcome *outcomes = calloc(n, sizeof(*outcomes));
  int error = robots != NULL && outcomes != NULL ? make_robots(lease, robots) : MO_ERR_NO_MEMORY;
  if (error == MO_OK)
    error = mo_gradient_state_create(holding->config.compute, &state);
  if (error == MO_OK)
    error = differentiate(lease, state, robots, outcomes);
  mo_gradient_state_free(state);
  free_robots(robots, n);
  free(outcomes);
  MO_GUARD(&holding->mutex);
  lease->error = error;
  lease->n_out = 0;
  lease->ended_ns = mo_clock_ns();
  holding->rows_done += error == MO_OK ? n : 0;
  if (--holding->n_out == 0)
    pthread_cond_broadcast(&holding->quiet);
  prefer_first(holding);
  holding->config.ended(holding->config.context);
  return NULL;
}

/* Under the mutex: starts a gradient. Its blocks count as one. */
static void start_gradient(struct mo_holding *holding, struct lease *lease)
{
  lease->n_submitted = lease->wire.n_blocks;
  lease->result.d_parameters = malloc(lease->wire.n_parameters * sizeof(double));
  lease->has_thread = lease->result.d_parameters != NULL &&
                      mo_thread_create(&lease->thread, NULL, compute_gradient, lease) == 0;
  if (!lease->has_thread) {
    lease->error = MO_ERR_NO_MEMORY;
    return;
  }
  lease->n_out = 1;
  holding->n_out++;
  prefer_first(holding);
}

/* ---- leases ---- */

static void free_lease(struct mo_holding *holding, struct lease *lease)
{
  if (lease->has_thread)
    pthread_join(lease->thread, NULL);
  if (lease->controller != NULL)
    mo_kept_weights_release(&holding->weights, lease->controller);
  mo_compute_share_free(lease->share);
  mo_wire_free_lease(&lease->wire);
  free(lease->result.losses);
  free(lease->result.diverged_steps);
  free(lease->result.measures);
  free(lease->result.d_parameters);
  free(lease);
}

int mo_holding_add(struct mo_holding *holding, struct mo_wire_lease *wire)
{
  struct lease *lease = calloc(1, sizeof(*lease));
  if (lease == NULL)
    return MO_ERR_NO_MEMORY;
  lease->holding = holding;
  lease->result =
      (struct mo_wire_result){.id = wire->id,
                              .n_rows = wire->n_rows,
                              .n_parameters = wire->n_parameters,
                              .losses = malloc(wire->n_rows * sizeof(double)),
                              .diverged_steps = malloc(wire->n_rows * sizeof(uint32_t))};
  if (wire->has_measures)
    lease->result.measures = malloc(wire->n_rows * sizeof(*lease->result.measures));
  int error = lease->result.losses != NULL && lease->result.diverged_steps != NULL &&
                      (!wire->has_measures || lease->result.measures != NULL)
                  ? mo_compute_share_create(holding->config.compute, 1, &lease->share)
                  : MO_ERR_NO_MEMORY;
  pthread_mutex_lock(&holding->mutex);
  struct lease **last = &holding->leases;
  uint32_t n = 0;
  for (; *last != NULL; last = &(*last)->next)
    n++;
  if (error == MO_OK && n >= MO_HELD_LEASES_MAX)
    error = MO_ERR_LIMIT;
  if (error == MO_OK) {
    lease->wire = *wire;
    *wire = (struct mo_wire_lease){0};
    *last = lease;
  }
  pthread_mutex_unlock(&holding->mutex);
  if (error != MO_OK)
    free_lease(holding, lease);
  return error;
}

bool mo_holding_start(struct mo_holding *holding, struct mo_sha256 *hash)
{
  bool lacks = false;
  MO_GUARD(&holding->mutex);
  for (struct lease *lease = holding->leases; lease != NULL; lease = lease->next) {
    if (lease->state != WAITING)
      continue;
    lease->controller = mo_kept_weights_take(&holding->weights, &lease->wire.controller);
    if (lease->controller == NULL) {
      if (!lacks)
        *hash = lease->wire.controller;
      lacks = true;
      continue;
    }
    lease->started_ns = mo_clock_ns();
    lease->state = RUNNING;
    if (lease->wire.n_parameters > 0)
      start_gradient(holding, lease);
  }
  const bool on_device = holding->free[MO_ON_DEVICE] != NULL;
  if (on_device)
    mo_compute_begin_blocks(holding->config.compute);
  submit(holding, MO_ON_CPU);
  submit(holding, MO_ON_DEVICE);
  if (on_device)
    mo_compute_end_blocks(holding->config.compute);
  return lacks;
}

int mo_holding_add_weights(struct mo_holding *holding, const struct mo_sha256 *hash,
                           const uint8_t *bytes, size_t size, struct mo_message *message)
{
  return mo_kept_weights_add(&holding->weights, hash, holding->lattice->workspace, bytes, size,
                             message);
}

/* Under the mutex: submits no more blocks of a lease, and cancels running ones. */
static void end(struct lease *lease, bool is_dropped)
{
  if (has_ended(lease) && !is_dropped)
    return;
  lease->is_dropped |= is_dropped;
  lease->is_given_back = !is_dropped;
  lease->state = ENDING;
  __atomic_store_n(&lease->cancel, 1, __ATOMIC_RELAXED);
}

void mo_holding_miss_weights(struct mo_holding *holding, const struct mo_sha256 *hash)
{
  MO_GUARD(&holding->mutex);
  for (struct lease *lease = holding->leases; lease != NULL; lease = lease->next)
    if (lease->state == WAITING && mo_sha256_equal(&lease->wire.controller, hash))
      end(lease, false);
}

void mo_holding_drop(struct mo_holding *holding, const struct mo_lease_id *id)
{
  MO_GUARD(&holding->mutex);
  for (struct lease *lease = holding->leases; lease != NULL; lease = lease->next)
    if (id == NULL || (lease->wire.id.epoch == id->epoch && lease->wire.id.number == id->number))
      end(lease, true);
}

void mo_holding_give_back(struct mo_holding *holding, bool all)
{
  MO_GUARD(&holding->mutex);
  for (struct lease *lease = holding->leases; lease != NULL; lease = lease->next)
    if (lease->state != ENDING && (all || lease->n_submitted == 0))
      end(lease, false);
}

/* ---- results ---- */

/* Completes and moves the result of a lease that has ended. */
static struct mo_wire_result take_result(struct lease *lease)
{
  struct mo_wire_result result = lease->result;
  struct mo_compute_share_stats stats;
  mo_compute_share_get_stats(lease->share, &stats);
  result.busy_s = lease->wire.back_end == MO_ON_DEVICE ? stats.device_s : stats.busy_s;
  if (lease->started_ns > 0 && lease->ended_ns > lease->started_ns)
    result.wall_s = 1e-9 * (double)(lease->ended_ns - lease->started_ns);
  if (lease->is_given_back)
    result.state = MO_RESULT_GIVEN_BACK;
  else if (lease->error != MO_OK)
    result.state = lease->error == MO_ERR_UNSUPPORTED ? MO_RESULT_UNSUPPORTED : MO_RESULT_FAILED;
  if (result.state != MO_RESULT_DONE)
    result.n_rows = result.n_parameters = 0;
  lease->result = (struct mo_wire_result){.losses = NULL};
  return result;
}

void mo_holding_take_results(struct mo_holding *holding, struct mo_wire_results *results)
{
  uint32_t rows = 0;
  *results = (struct mo_wire_results){0};
  MO_GUARD(&holding->mutex);
  for (struct lease **at = &holding->leases; *at != NULL;) {
    struct lease *lease = *at;
    const uint32_t n = lease->wire.n_parameters > 0 ? RESULT_ROWS_MAX
                       : lease->wire.has_measures   ? MO_WIRE_MEASURED_ROWS * lease->wire.n_rows
                                                    : lease->wire.n_rows;
    if (!has_ended(lease) ||
        (!lease->is_dropped && (results->n == MO_WIRE_RESULTS_MAX || rows + n > RESULT_ROWS_MAX))) {
      at = &lease->next;
      continue;
    }
    *at = lease->next;
    if (!lease->is_dropped) {
      results->items[results->n++] = take_result(lease);
      rows += n;
    }
    holding->leases_done += !lease->is_dropped && !lease->is_given_back && lease->error == MO_OK;
    free_lease(holding, lease);
  }
}

void mo_holding_get_status(struct mo_holding *holding, struct mo_holding_status *status)
{
  *status = (struct mo_holding_status){0};
  MO_GUARD(&holding->mutex);
  for (const struct lease *lease = holding->leases; lease != NULL; lease = lease->next) {
    if (!has_ended(lease))
      status->n_leases[lease->wire.back_end] += !lease->is_dropped;
    else
      status->n_results++;
  }
  status->rows_done = holding->rows_done;
  status->leases_done = holding->leases_done;
}

/* ---- start and stop ---- */

int mo_holding_create(const struct mo_holding_config *config, struct mo_holding **ret)
{
  struct mo_holding *holding = calloc(1, sizeof(*holding));
  struct mo_compute_stats stats;
  if (holding == NULL)
    return MO_ERR_NO_MEMORY;
  mo_compute_get_stats(config->compute, &stats);
  const uint32_t n[2] = {SLOTS_PER_WORKER * stats.n_workers,
                         mo_compute_devices(config->compute) > 0 ? SLOTS_OF_DEVICES : 0};
  holding->config = *config;
  holding->slots = calloc(n[0] + n[1], sizeof(*holding->slots));
  int error = holding->slots != NULL ? mo_kept_weights_init(&holding->weights, config->compute)
                                     : MO_ERR_NO_MEMORY;
  if (error != MO_OK) {
    free(holding->slots);
    free(holding);
    return error;
  }
  pthread_mutex_init(&holding->mutex, NULL);
  pthread_cond_init(&holding->quiet, NULL);
  for (uint32_t i = 0; i < n[0] + n[1]; i++) {
    struct slot *slot = &holding->slots[i];
    const enum mo_back_end back_end = i < n[0] ? MO_ON_CPU : MO_ON_DEVICE;
    *slot = (struct slot){.block = {.precision = MO_FLOAT32,
                                    .urgency = MO_BATCH,
                                    .back_end = back_end,
                                    .tag = -1,
                                    .done = block_done,
                                    .context = slot},
                          .next = holding->free[back_end]};
    holding->free[back_end] = slot;
  }
  *ret = holding;
  return MO_OK;
}

/* Cancels all leases; blocks stop at their next pause point. */
static void cancel_all(struct mo_holding *holding)
{
  struct mo_wire_results none;
  mo_holding_drop(holding, NULL);
  pthread_mutex_lock(&holding->mutex);
  while (holding->n_out > 0)
    pthread_cond_wait(&holding->quiet, &holding->mutex);
  pthread_mutex_unlock(&holding->mutex);
  mo_holding_take_results(holding, &none);
}

int mo_holding_set_workspace(struct mo_holding *holding, struct mo_workspace workspace)
{
  struct mo_lattice *lattice = NULL;
  if (holding->lattice != NULL && mo_workspace_equal(holding->lattice->workspace, workspace))
    return MO_OK;
  const int error = mo_lattice_create(workspace, &lattice);
  if (error != MO_OK)
    return error;
  cancel_all(holding);
  mo_lattice_free(holding->lattice);
  holding->lattice = lattice;
  return MO_OK;
}

void mo_holding_free(struct mo_holding *holding)
{
  if (holding == NULL)
    return;
  cancel_all(holding);
  mo_kept_weights_clear(&holding->weights);
  mo_lattice_free(holding->lattice);
  pthread_mutex_destroy(&holding->mutex);
  pthread_cond_destroy(&holding->quiet);
  free(holding->slots);
  free(holding);
}
