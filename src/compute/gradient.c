/* gradient.c: the gradient of a batch, from blocks that the workers compute in any order.
 *
 * The calling thread submits blocks in order, and adds their results in order. Between the two lies
 * a window of at most two blocks per worker, each with its own float32 gradient: a worker never
 * waits for the sum, and memory does not grow with the batch.
 *
 * Sums are float64: 32 consecutive blocks make the sum of a shard, and the shards' sums make that
 * of the batch, so that a shard computed elsewhere can be passed as one sum instead of 32
 * gradients. The bits depend only on the batch. */
#include "compute/devices.h"

#include <stdlib.h>
#include <string.h>

#include "base/memory.h"

enum { BLOCKS_PER_WORKER = 2, SHARD_BLOCKS = MO_DEVICE_SHARD / MO_GRADIENT_ROBOTS };

struct slot {
  struct mo_gradient_task task;
  struct mo_waiter waiter;
};

/* Memory that grows to what the calls need. */
struct room {
  void *at;
  size_t bytes;
};

struct mo_gradient_state {
  struct mo_compute *compute;
  struct mo_pack *pack;
  uint32_t n_slots;
  struct slot *slots;       /* (n_slots); block b of a batch is in slot b mod n_slots */
  struct room d_parameters; /* float: of each slot in use */
  struct room shard;        /* double (n_parameters): of batches of more than one shard */
  struct room order;        /* uint32_t (n) */
  struct mo_device_gradients *on_devices; /* NULL: there are none */
  atomic_bool stop;                       /* the call failed: running blocks may end */
};

int mo_gradient_state_create(struct mo_compute *compute, struct mo_gradient_state **ret)
{
  struct mo_devices *devices = mo_core(compute)->devices;
  struct mo_gradient_state *state = calloc(1, sizeof(*state));
  if (state == NULL)
    return MO_ERR_NO_MEMORY;
  state->compute = compute;
  state->n_slots = BLOCKS_PER_WORKER * mo_core(compute)->n_workers;
  state->slots = calloc(state->n_slots, sizeof(*state->slots));
  int status = state->slots != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  if (status == MO_OK && devices != NULL)
    status = mo_device_gradients_create(devices, &state->on_devices);
  if (status == MO_OK)
    *ret = state;
  else
    mo_gradient_state_free(state);
  return status;
}

void mo_gradient_state_free(struct mo_gradient_state *state)
{
  if (state == NULL)
    return;
  mo_pack_free(state->pack);
  mo_device_gradients_free(state->on_devices);
  free(state->d_parameters.at);
  free(state->shard.at);
  free(state->order.at);
  free(state->slots);
  free(state);
}

/* Options for one robot: its share of the batch mean. */
static struct mo_gradient_options options_of(const struct mo_gradient_batch *batch)
{
  return (struct mo_gradient_options){.adjoint_bound = batch->adjoint_bound,
                                      .weight = 1.0 / batch->n,
                                      .adjoint_rule = batch->adjoint_rule,
                                      .restart_weight = batch->restart_weight};
}

static int check(const struct mo_compute *compute, const struct mo_gradient_batch *batch)
{
  if (batch->n < 1 || batch->n > MO_GRADIENT_BATCH_MAX)
    return MO_ERR_RANGE;
  if (batch->controller == NULL || batch->robots == NULL || batch->d_parameters == NULL ||
      batch->outcomes == NULL || (batch->urgency != MO_BATCH && batch->urgency != MO_INTERACTIVE) ||
      mo_physics_check(&batch->physics, NULL) != MO_OK ||
      (batch->share != NULL && batch->share->compute != compute))
    return MO_ERR_INVALID;
  const struct mo_gradient_options options = options_of(batch);
  return mo_gradient_options_check(&options);
}

static int check_robots(const struct mo_robot *robots, uint32_t n, struct mo_workspace workspace)
{
  for (uint32_t i = 0; i < n; i++)
    if (robots[i].body == NULL || robots[i].environment == NULL ||
        !mo_workspace_equal(robots[i].body->workspace, workspace) ||
        mo_environment_check(robots[i].environment, NULL) != MO_OK)
      return MO_ERR_INVALID;
  return MO_OK;
}

/* Prepares a pack of the batch's controller; reuses the old one if it fits. */
static int prepare_pack(struct mo_gradient_state *state, const struct mo_controller *controller)
{
  int status = MO_ERR_UNSUPPORTED;
  if (state->pack != NULL)
    status = mo_pack_update(state->pack, controller);
  if (status == MO_ERR_UNSUPPORTED) {
    mo_pack_free(state->pack);
    state->pack = NULL;
    status = mo_pack_create_for_gradients(controller, mo_core(state->compute)->isa, &state->pack);
  }
  return status;
}

static bool reserve(struct room *room, size_t bytes)
{
  if (bytes > room->bytes) {
    free(room->at);
    room->at = mo_alloc_aligned(bytes, 1);
    room->bytes = room->at != NULL ? bytes : 0;
  }
  return room->bytes >= bytes;
}

/* Returns the floats from one slot's gradient to the next: whole cache lines. */
static size_t stride_of(const struct mo_gradient_batch *batch)
{
  const size_t line = MO_CACHE_LINE_BYTES / sizeof(float);
  return (batch->controller->n_parameters + line - 1) / line * line;
}

static int prepare(struct mo_gradient_state *state, const struct mo_gradient_batch *batch,
                   uint32_t n_blocks)
{
  const size_t n_slots = n_blocks < state->n_slots ? n_blocks : state->n_slots;
  const size_t n_sums = n_blocks > SHARD_BLOCKS ? batch->controller->n_parameters : 0;
  if (!reserve(&state->d_parameters, n_slots * stride_of(batch) * sizeof(float)) ||
      !reserve(&state->shard, n_sums * sizeof(double)) ||
      !reserve(&state->order, batch->n * sizeof(uint32_t)))
    return MO_ERR_NO_MEMORY;
  const int status = prepare_pack(state, batch->controller);
  return status == MO_OK ? mo_gradient_arrange(batch->robots, batch->n, state->order.at) : status;
}

static int submit(struct mo_gradient_state *state, const struct mo_gradient_batch *batch,
                  uint32_t number)
{
  struct slot *slot = state->slots + number % state->n_slots;
  struct mo_gradient_task *task = &slot->task;
  const uint32_t first = number * MO_GRADIENT_ROBOTS;
  task->block = (struct mo_block){.physics = batch->physics,
                                  .urgency = batch->urgency,
                                  .cancel = batch->cancel,
                                  .tag = batch->tag,
                                  .share = batch->share,
                                  .done = mo_waiter_done,
                                  .context = &slot->waiter};
  task->pack = state->pack;
  task->n = batch->n - first < MO_GRADIENT_ROBOTS ? batch->n - first : MO_GRADIENT_ROBOTS;
  for (uint32_t i = 0; i < task->n; i++)
    task->robots[i] = batch->robots[((const uint32_t *)state->order.at)[first + i]];
  task->options = options_of(batch);
  task->stop = &state->stop;
  task->counts = (struct mo_gradient_counts){0};
  task->d_parameters = (float *)state->d_parameters.at + number % state->n_slots * stride_of(batch);
  slot->waiter = (struct mo_waiter)MO_WAITER(1);
  return mo_compute_submit_gradient(state->compute, task);
}

/* Adds a block to the sum of its shard, and that sum to the batch's after the shard's last block.
 * The first shard is summed in the batch's own array. */
static void add_parameters(const struct mo_gradient_state *state, const float *block,
                           uint32_t number, const struct mo_gradient_batch *batch)
{
  const size_t n = batch->controller->n_parameters;
  const uint32_t in_shard = number % SHARD_BLOCKS, last = (batch->n - 1) / MO_GRADIENT_ROBOTS;
  double *sum = number < SHARD_BLOCKS ? batch->d_parameters : state->shard.at;
  if (in_shard == 0)
    memset(sum, 0, n * sizeof(*sum));
  for (size_t i = 0; i < n; i++)
    sum[i] += (double)block[i];
  if (sum != batch->d_parameters && (in_shard == SHARD_BLOCKS - 1 || number == last))
    for (size_t i = 0; i < n; i++)
      batch->d_parameters[i] += sum[i];
}

static void add(const struct mo_gradient_state *state, const struct mo_gradient_task *task,
                uint32_t number, struct mo_gradient_batch *batch)
{
  const uint32_t *order = (const uint32_t *)state->order.at + (size_t)number * MO_GRADIENT_ROBOTS;
  add_parameters(state, task->d_parameters, number, batch);
  for (uint32_t i = 0; i < task->n; i++)
    batch->outcomes[order[i]] = task->outcomes[i];
  mo_gradient_counts_add(&batch->counts, &task->counts);
}

static void clear(struct mo_gradient_batch *batch, enum mo_back_end back_end)
{
  batch->counts = (struct mo_gradient_counts){0};
  batch->computed_on = back_end;
}

int mo_compute_gradient_lay_out(struct mo_gradient_state *state, const struct mo_robot *robots,
                                uint32_t n, const struct mo_physics *physics)
{
  int status;
  if (state->on_devices == NULL)
    return MO_OK;
  if (n < 1 || n > MO_GRADIENT_BATCH_MAX)
    return MO_ERR_RANGE;
  if (robots == NULL || mo_physics_check(physics, NULL) != MO_OK)
    return MO_ERR_INVALID;
  status = check_robots(robots, n, MO_DEFAULT_WORKSPACE);
  return status == MO_OK ? mo_devices_lay_out(state->on_devices, robots, n, physics) : status;
}

void mo_compute_gradient_forget(struct mo_gradient_state *state)
{
  if (state->on_devices != NULL)
    mo_device_gradients_forget(state->on_devices);
}

int mo_compute_gradient(struct mo_gradient_state *state, struct mo_gradient_batch *batch)
{
  int status = check(state->compute, batch);
  const bool was_checked = status == MO_OK && batch->back_end == MO_ON_DEVICE &&
                           state->on_devices != NULL &&
                           mo_workspace_equal(batch->controller->workspace, MO_DEFAULT_WORKSPACE) &&
                           mo_devices_have_laid_out(state->on_devices, batch);
  if (status == MO_OK && !was_checked)
    status = check_robots(batch->robots, batch->n, batch->controller->workspace);
  if (status != MO_OK)
    return status;
  if (batch->back_end == MO_ON_DEVICE) {
    clear(batch, MO_ON_DEVICE);
    status =
        state->on_devices == NULL ? MO_ERR_DEVICE : mo_devices_gradient(state->on_devices, batch);
    if (status != MO_ERR_UNSUPPORTED)
      return status;
  }
  const uint32_t n_blocks = (batch->n + MO_GRADIENT_ROBOTS - 1) / MO_GRADIENT_ROBOTS;
  status = prepare(state, batch, n_blocks);
  if (status != MO_OK)
    return status;
  clear(batch, MO_ON_CPU);
  atomic_store(&state->stop, false);
  uint32_t submitted = 0;
  for (uint32_t b = 0; b < n_blocks && (status == MO_OK || b < submitted); b++) {
    while (status == MO_OK && submitted < n_blocks && submitted < b + state->n_slots) {
      status = submit(state, batch, submitted);
      submitted += status == MO_OK;
    }
    if (status != MO_OK) /* report the first error by position; only wait for the rest */
      atomic_store(&state->stop, true);
    if (b >= submitted)
      break;
    struct slot *slot = state->slots + b % state->n_slots;
    mo_waiter_wait(&slot->waiter);
    const int block_status = slot->task.block.status;
    if (status == MO_OK && block_status == MO_OK)
      add(state, &slot->task, b, batch);
    else if (status == MO_OK)
      status = block_status;
    if (status != MO_OK)
      atomic_store(&state->stop, true);
  }
  return status;
}
