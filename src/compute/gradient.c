/* gradient.c: the gradient of a batch, from blocks that the workers compute in any order.
 *
 * The calling thread submits blocks in order, and adds their results in order. Between submission
 * and addition, there is a window of at most two blocks per worker, each with its own float32
 * gradient, so that a worker never waits for the sum, and memory does not grow with the batch.
 *
 * Sums are float64: 32 consecutive blocks are added to the sum of a shard, and the sums of the
 * shards are added to that of the batch. A shard from a remote taker is therefore one sum instead
 * of 32 gradients; it is kept until the shards before it are added. The bits depend only on the
 * batch. */
#include "compute/device_gradient.h"
#include "compute/shards.h"

#include <stdlib.h>
#include <string.h>

#include "base/memory.h"

enum { BLOCKS_PER_WORKER = 2 };

struct slot {
  struct mo_gradient_task task;
  struct mo_waiter waiter;
  uint32_t shard, first; /* index of its first robot in the shard */
};

/* Memory that grows as calls need it. */
struct room {
  void *at;
  size_t bytes;
};

struct mo_gradient_state {
  struct mo_compute *compute;
  struct mo_pack *pack;
  uint32_t n_slots;
  struct slot *slots;                     /* (n_slots); used in turn */
  struct room d_parameters;               /* float: of each slot in use */
  struct room order;                      /* uint32_t (n) */
  struct mo_device_gradients *on_devices; /* NULL: none */
};

/* The state of a call, on the calling thread. */
struct call {
  struct mo_gradient_state *state;
  struct mo_gradient_batch *batch;
  struct mo_offer offer;
  int status;
  uint32_t n_submitted, n_gathered; /* blocks */
  int shard;                        /* the shard that is being submitted; below 0: none */
  uint32_t first;                   /* first robot of the next block in that shard */
  struct mo_shard_result *sum;      /* of the shard that is being gathered */
  uint32_t n_added;                 /* shards added */
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
  if (status == MO_OK && devices != NULL && !devices->is_absent)
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
  free(state->order.at);
  free(state->slots);
  free(state);
}

/* Prepares a pack of the batch's controller; reuses the old pack if it fits. */
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

static int prepare(struct mo_gradient_state *state, const struct mo_gradient_batch *batch)
{
  const uint32_t n_blocks = (batch->n + MO_GRADIENT_ROBOTS - 1) / MO_GRADIENT_ROBOTS;
  const size_t n_slots = n_blocks < state->n_slots ? n_blocks : state->n_slots;
  if (!reserve(&state->d_parameters, n_slots * stride_of(batch) * sizeof(float)) ||
      !reserve(&state->order, batch->n * sizeof(uint32_t)))
    return MO_ERR_NO_MEMORY;
  uint32_t *order = state->order.at;
  for (uint32_t i = 0; i < batch->n; i++)
    order[i] = i;
  const int status = prepare_pack(state, batch->controller);
  return status == MO_OK && !batch->is_arranged
             ? mo_gradient_arrange(batch->robots, batch->n, order)
             : status;
}

/* ---- blocks ---- */

/* Claims the next shard if the last one is submitted completely, or was computed elsewhere. */
static bool has_block(struct call *call)
{
  const struct mo_shard *items = call->offer.items;
  while (call->shard < 0 || call->first >= items[call->shard].part.n ||
         atomic_load(&items[call->shard].stop)) {
    call->shard = mo_offer_claim(&call->offer);
    call->first = 0;
    if (call->shard < 0)
      return false;
  }
  return true;
}

static int submit(struct call *call)
{
  struct mo_gradient_state *state = call->state;
  struct mo_shard *shard = &call->offer.items[call->shard];
  const struct mo_gradient_batch *part = &shard->part;
  const uint32_t place = call->n_submitted % state->n_slots, left = part->n - call->first;
  struct slot *slot = &state->slots[place];
  struct mo_gradient_task *task = &slot->task;
  task->block = (struct mo_block){.physics = part->physics,
                                  .urgency = part->urgency,
                                  .cancel = part->cancel,
                                  .tag = part->tag,
                                  .share = part->share,
                                  .done = mo_waiter_done,
                                  .context = &slot->waiter};
  task->pack = state->pack;
  task->n = left < MO_GRADIENT_ROBOTS ? left : MO_GRADIENT_ROBOTS;
  memcpy(task->robots, part->robots + call->first, task->n * sizeof(*task->robots));
  task->options = mo_batch_options(part);
  task->stop = &shard->stop;
  task->counts = (struct mo_gradient_counts){0};
  task->d_parameters = (float *)state->d_parameters.at + place * stride_of(part);
  slot->shard = (uint32_t)call->shard;
  slot->first = call->first;
  slot->waiter = (struct mo_waiter)MO_WAITER(1);
  call->first += task->n;
  const int status = mo_compute_submit_gradient(state->compute, task);
  call->n_submitted += status == MO_OK;
  return status;
}

/* Adds all parameters but the first and the last, which the caller adds in code that sanitizers
 * check, so that they still catch arrays that are too short or still in use. With sanitizers, these
 * loops would take half of the time of the gradient tests under the thread sanitizer. */
__attribute__((no_sanitize("address", "thread", "undefined"))) static void
add_inner(double *sum, const float *part, size_t n)
{
  for (size_t i = 1; i + 1 < n; i++)
    sum[i] += (double)part[i];
}

static void add_parameters(double *sum, const float *part, size_t n)
{
  sum[0] += (double)part[0];
  add_inner(sum, part, n);
  if (n > 1)
    sum[n - 1] += (double)part[n - 1];
}

/* Adds a block to the sum of its shard. */
static int add_block(struct call *call, const struct slot *slot)
{
  const struct mo_gradient_task *task = &slot->task;
  const size_t n = call->batch->controller->n_parameters;
  if (slot->first == 0) {
    free(call->sum); /* the sum of a shard that a taker finished first */
    call->sum = mo_shard_result_create(n);
  }
  struct mo_shard_result *sum = call->sum;
  if (sum == NULL)
    return MO_ERR_NO_MEMORY;
  add_parameters(sum->d_parameters, task->d_parameters, n);
  memcpy(sum->outcomes + slot->first, task->outcomes, task->n * sizeof(*task->outcomes));
  mo_gradient_counts_add(&sum->counts, &task->counts);
  if (slot->first + task->n == call->offer.items[slot->shard].part.n)
    mo_offer_finish(&call->offer, slot->shard, &call->sum);
  return MO_OK;
}

/* Waits for the oldest block. Ignores it if its shard is done or no longer needed. */
static void gather(struct call *call)
{
  struct slot *slot = &call->state->slots[call->n_gathered++ % call->state->n_slots];
  mo_waiter_wait(&slot->waiter);
  if (call->status != MO_OK || atomic_load(&call->offer.items[slot->shard].stop))
    return;
  call->status = slot->task.block.status == MO_OK ? add_block(call, slot) : slot->task.block.status;
}

/* Adds finished shards to the batch, in order. */
static void add_shards(struct call *call)
{
  struct mo_gradient_batch *batch = call->batch;
  const size_t n = batch->controller->n_parameters;
  struct mo_shard_result *result;
  while (call->n_added < call->offer.n &&
         (result = mo_offer_collect(&call->offer, call->n_added)) != NULL) {
    const struct mo_gradient_batch *part = &call->offer.items[call->n_added].part;
    const uint32_t *order = (uint32_t *)call->state->order.at + (part->robots - call->offer.robots);
    if (call->n_added++ == 0)
      memcpy(batch->d_parameters, result->d_parameters, n * sizeof(double));
    else
      for (size_t i = 0; i < n; i++)
        batch->d_parameters[i] += result->d_parameters[i];
    for (uint32_t i = 0; i < part->n; i++)
      batch->outcomes[order[i]] = result->outcomes[i];
    mo_gradient_counts_add(&batch->counts, &result->counts);
    free(result);
  }
}

/* ---- batches ---- */

static void clear(struct mo_gradient_batch *batch, enum mo_back_end back_end)
{
  batch->counts = (struct mo_gradient_counts){0};
  batch->computed_on = back_end;
}

int mo_compute_gradient_lay_out(struct mo_gradient_state *state, const struct mo_robot *robots,
                                uint32_t n, const struct mo_physics *physics)
{
  return state->on_devices != NULL ? mo_devices_lay_out(state->on_devices, robots, n, physics)
                                   : MO_OK;
}

void mo_compute_gradient_forget(struct mo_gradient_state *state)
{
  if (state->on_devices != NULL)
    mo_device_gradients_forget(state->on_devices);
}

static int compute_on_cpu(struct mo_gradient_state *state, struct mo_gradient_batch *batch)
{
  struct call call = {.state = state, .batch = batch, .shard = -1};
  int status = prepare(state, batch);
  if (status == MO_OK)
    status = mo_offer_open(&call.offer, state->compute, MO_ON_CPU, batch, state->order.at,
                           mo_batch_options(batch).weight);
  if (status != MO_OK)
    return status;
  clear(batch, MO_ON_CPU);
  while (call.status == MO_OK && call.n_added < call.offer.n) {
    while (call.status == MO_OK && call.n_submitted - call.n_gathered < state->n_slots &&
           has_block(&call))
      call.status = submit(&call);
    if (call.n_submitted != call.n_gathered)
      gather(&call);
    else if (mo_is_cancelled(batch->cancel))
      call.status = MO_ERR_CANCELLED;
    else
      mo_offer_wait(&call.offer, call.n_added);
    add_shards(&call);
  }
  mo_offer_stop(&call.offer);
  while (call.n_submitted != call.n_gathered) /* submit nothing more, only wait */
    gather(&call);
  mo_offer_close(&call.offer);
  free(call.sum);
  return call.status;
}

/* Waits until remote takers have computed all shards. As on local devices, the robots are in the
 * order of the batch. */
static int compute_elsewhere(struct mo_gradient_state *state, struct mo_gradient_batch *batch)
{
  struct call call = {.state = state, .batch = batch};
  if (!mo_compute_expects_devices(state->compute) || !mo_compute_serves_devices(state->compute))
    return MO_ERR_DEVICE;
  if (!reserve(&state->order, batch->n * sizeof(uint32_t)))
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < batch->n; i++)
    ((uint32_t *)state->order.at)[i] = i;
  int status = mo_offer_open(&call.offer, state->compute, MO_ON_DEVICE, batch, state->order.at,
                             mo_batch_options(batch).weight);
  if (status != MO_OK)
    return status;
  while (status == MO_OK && call.n_added < call.offer.n) {
    mo_offer_wait(&call.offer, call.n_added);
    add_shards(&call);
    status = mo_is_cancelled(batch->cancel) ? MO_ERR_CANCELLED : mo_offer_error(&call.offer);
  }
  mo_offer_stop(&call.offer);
  mo_offer_close(&call.offer);
  return status;
}

int mo_compute_gradient(struct mo_gradient_state *state, struct mo_gradient_batch *batch)
{
  if (batch->back_end == MO_ON_DEVICE) {
    clear(batch, MO_ON_DEVICE);
    const int status = state->on_devices == NULL ? compute_elsewhere(state, batch)
                                                 : mo_devices_gradient(state->on_devices, batch);
    if (status != MO_ERR_UNSUPPORTED || batch->is_strict)
      return status;
  }
  return compute_on_cpu(state, batch);
}
