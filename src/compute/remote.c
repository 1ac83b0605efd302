/* remote.c: remote takers: blocks and shards that are sent to other machines, and their results.
 *
 * A taker chooses like a worker: the share that is next, among the shares with a suitable first
 * block. It takes more blocks of that share while they have the same controller and physics. Shards
 * of gradients compete with the blocks by the shares of their batches. The share is charged an
 * estimate until the blocks or the shard are returned. */
#include "compute/devices.h"
#include "compute/shards.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "rollout/physics.h"

struct taken {
  struct mo_taken shown;
  struct mo_fair *fair;
  struct mo_fair_charge charge;
  struct mo_block **blocks; /* (n_blocks) unless it is a shard */
  struct mo_offer *offer;
  struct mo_shard *shard;
};

static struct taken *private_of(struct mo_taken *taken)
{
  return (struct taken *)taken;
}

/* ---- taking ---- */

struct room {
  const struct mo_block *like;
  double steps; /* number of steps left */
};

static bool suits(const struct mo_block *block, void *context)
{
  (void)context;
  return mo_block_suits_remote(block);
}

static bool fits(const struct mo_block *block, void *context)
{
  const struct room *room = context;
  return mo_block_suits_remote(block) && block->controller == room->like->controller &&
         (block->measuring != NULL) == (room->like->measuring != NULL) &&
         mo_fair_units(block) <= room->steps &&
         mo_physics_equal(&block->physics, &room->like->physics);
}

static struct mo_fair *queue_of(struct mo_compute *compute, enum mo_back_end back_end)
{
  struct mo_compute_core *core = mo_core(compute);
  if (back_end == MO_ON_CPU)
    return core->fair;
  return core->devices != NULL ? &core->devices->fair : NULL;
}

/* Makes room for another block; the array grows by doubling. */
static bool reserve(struct taken *taken)
{
  const uint32_t n = taken->shown.n_blocks;
  if ((n & (n - 1)) != 0)
    return true;
  const size_t bytes = (n > 0 ? 2 * (size_t)n : 1) * sizeof(struct mo_block *);
  struct mo_block **more = realloc((void *)taken->blocks, bytes);
  if (more == NULL)
    return false;
  taken->blocks = more;
  return true;
}

static void keep(struct taken *taken, struct mo_block *block)
{
  taken->blocks[taken->shown.n_blocks++] = block;
  taken->shown.n_rows += block->n_environments;
}

/* Under the mutex. Takes blocks until `taken` is full. */
static void fill(struct taken *taken, uint64_t max_steps)
{
  struct room room = {.steps = (double)max_steps};
  while (reserve(taken)) {
    struct mo_block *block = room.like == NULL
                                 ? mo_fair_take(taken->fair, &taken->charge, suits, NULL)
                                 : mo_fair_take_more(taken->fair, &taken->charge, fits, &room);
    if (block == NULL)
      return;
    keep(taken, block);
    room.like = block;
    room.steps -= mo_fair_units(block);
  }
}

/* Under the mutex. Takes a shard, if one exists and its share is next. here: if there is no other
 * shard, takes one that the workers are computing. */
static bool take_shard(struct mo_compute *compute, struct taken *taken, bool here)
{
  struct mo_offer *offer = mo_offer_next(mo_core(compute), taken->shown.back_end, here);
  const struct mo_compute_share *other = mo_fair_next(taken->fair, suits, NULL);
  if (offer == NULL || (other != NULL && other->virtual_s < offer->share->virtual_s))
    return false;
  taken->offer = offer;
  taken->shard = mo_offer_take(offer, here);
  const struct mo_gradient_batch *part = &taken->shard->part;
  mo_fair_charge_gradient(taken->fair, offer->share, (double)part->n * part->physics.scheme.n_steps,
                          &taken->charge);
  taken->shown.n_blocks = 1;
  taken->shown.n_rows = part->n;
  taken->shown.shard = part;
  taken->shown.controller = part->controller;
  taken->shown.identity = offer;
  return true;
}

static void show(struct taken *taken)
{
  if (taken->shard != NULL || taken->blocks == NULL)
    return; /* a shard needs no list of blocks */
  taken->shown.blocks = taken->blocks;
  taken->shown.identity = taken->blocks[0]->controller;
  taken->shown.controller = mo_compute_controller_weights(taken->blocks[0]->controller);
}

static void discard(struct taken *taken)
{
  free((void *)taken->blocks);
  free(taken);
}

struct mo_taken *mo_compute_take(struct mo_compute *compute, enum mo_back_end back_end,
                                 uint64_t max_steps)
{
  struct mo_fair *fair = queue_of(compute, back_end);
  struct taken *taken = fair != NULL ? calloc(1, sizeof(*taken)) : NULL;
  if (taken == NULL)
    return NULL;
  taken->shown.back_end = back_end;
  taken->fair = fair;
  pthread_mutex_lock(&fair->mutex);
  if (!take_shard(compute, taken, false))
    fill(taken, max_steps);
  if (taken->shown.n_blocks == 0 && !take_shard(compute, taken, true))
    atomic_store(&mo_core(compute)->remote.hungry, true);
  pthread_mutex_unlock(&fair->mutex);
  if (taken->shown.n_blocks == 0) {
    discard(taken);
    return NULL;
  }
  show(taken);
  return &taken->shown;
}

struct mo_taken *mo_compute_split(struct mo_compute *compute, struct mo_taken *whole)
{
  struct taken *first = private_of(whole);
  const uint32_t n = whole->n_blocks, n_first = n / 2;
  struct taken *second = n > 1 ? calloc(1, sizeof(*second)) : NULL;
  double units = 0;
  (void)compute;
  if (second == NULL)
    return NULL;
  *second = (struct taken){.shown = *whole, .fair = first->fair, .charge = first->charge};
  second->shown.n_blocks = second->shown.n_rows = 0;
  for (uint32_t i = n_first; i < n; i++) {
    if (!reserve(second)) {
      discard(second);
      return NULL;
    }
    keep(second, first->blocks[i]);
    units += mo_fair_units(first->blocks[i]);
  }
  second->charge.n_blocks = n - n_first;
  second->charge.units = units;
  second->charge.estimate_s =
      first->charge.units > 0 ? first->charge.estimate_s * (units / first->charge.units) : 0;
  first->charge.n_blocks = n_first;
  first->charge.units -= units;
  first->charge.estimate_s -= second->charge.estimate_s;
  first->shown.n_blocks = n_first;
  first->shown.n_rows -= second->shown.n_rows;
  show(second);
  return &second->shown;
}

/* ---- returning ---- */

bool mo_taken_is_cancelled(const struct mo_taken *taken)
{
  if (taken->shard != NULL)
    return mo_shard_is_cancelled(((const struct taken *)taken)->shard);
  for (uint32_t i = 0; i < taken->n_blocks; i++)
    if (!mo_block_is_cancelled(taken->blocks[i]))
      return false;
  return true;
}

/* Under the mutex. Returns whether all devices of the queue are lost: their threads have ended the
 * waiting work, and will not read the queue again. */
static bool is_lost(const struct mo_compute *compute, const struct taken *taken)
{
  const struct mo_devices *devices = mo_core(compute)->devices;
  return taken->shown.back_end == MO_ON_DEVICE && !devices->is_absent &&
         atomic_load(&devices->n_working) == 0;
}

/* is_refused: takers cannot compute it. */
static void put_back(struct mo_compute *compute, struct taken *taken, bool is_refused)
{
  pthread_mutex_lock(&taken->fair->mutex);
  if (is_lost(compute, taken)) {
    pthread_mutex_unlock(&taken->fair->mutex);
    mo_compute_deliver(compute, &taken->shown, &(struct mo_remote_result){.status = MO_ERR_DEVICE});
    return;
  }
  mo_fair_put_back(taken->fair, &taken->charge, taken->blocks);
  if (taken->shard != NULL)
    mo_offer_return(taken->offer, taken->shard, is_refused, NULL);
  pthread_mutex_unlock(&taken->fair->mutex);
  mo_compute_wake(compute);
  discard(taken);
}

void mo_compute_put_back(struct mo_compute *compute, struct mo_taken *taken)
{
  put_back(compute, private_of(taken), false);
}

void mo_compute_keep(struct mo_compute *compute, struct mo_taken *taken)
{
  for (uint32_t i = 0; taken->shard == NULL && i < taken->n_blocks; i++)
    private_of(taken)->blocks[i]->stays = true;
  put_back(compute, private_of(taken), true);
}

static struct mo_outcome outcome_of(const struct mo_remote_result *result, uint32_t row)
{
  return (struct mo_outcome){.loss = result->losses[row],
                             .diverged_step = (int32_t)result->diverged[row],
                             .com_start_m = {NAN, NAN, NAN},
                             .com_end_m = {NAN, NAN, NAN}};
}

/* back_end: the queue that the block was taken from. Blocks that devices cannot compute are queued
 * for the workers. */
static void end_block(struct mo_block *block, enum mo_back_end back_end,
                      const struct mo_remote_result *result, uint32_t row)
{
  block->status = mo_block_is_cancelled(block) ? MO_ERR_CANCELLED : result->status;
  block->computed_on = back_end;
  block->origin = result->origin;
  for (uint32_t i = 0; i < block->n_environments && block->status == MO_OK; i++) {
    block->outcomes[i] = outcome_of(result, row + i);
    if (block->measuring != NULL)
      memcpy(block->measuring->values[i], result->measures[row + i], sizeof(*result->measures));
  }
  block->done(block, block->context); /* the block may have been freed by now */
}

/* Returns NULL if there is no result, or if out of memory. */
static struct mo_shard_result *copy_of(const struct mo_gradient_batch *part,
                                       const struct mo_remote_result *result)
{
  const size_t n = part->controller->n_parameters;
  struct mo_shard_result *copy = result->status == MO_OK ? mo_shard_result_create(n) : NULL;
  if (copy == NULL)
    return NULL;
  memcpy(copy->d_parameters, result->d_parameters, n * sizeof(double));
  copy->counts = result->counts;
  for (uint32_t i = 0; i < part->n; i++)
    copy->outcomes[i] = outcome_of(result, i);
  return copy;
}

void mo_compute_deliver(struct mo_compute *compute, struct mo_taken *shown,
                        const struct mo_remote_result *result)
{
  struct taken *taken = private_of(shown);
  struct mo_shard_result *sum = shown->shard != NULL ? copy_of(shown->shard, result) : NULL;
  uint32_t row = 0;
  (void)compute;
  pthread_mutex_lock(&taken->fair->mutex);
  mo_fair_correct(taken->fair, &taken->charge, result->busy_s, result->status == MO_OK);
  atomic_fetch_add(&taken->charge.share->busy_ns, (uint64_t)(1e9 * result->busy_s));
  if (taken->shard != NULL) {
    mo_offer_return(taken->offer, taken->shard, result->status != MO_OK, sum);
    shown->n_blocks = 0;
  }
  pthread_mutex_unlock(&taken->fair->mutex);
  for (uint32_t i = 0; i < shown->n_blocks; i++) { /* the share may be freed after the last one */
    const uint32_t n = taken->blocks[i]->n_environments;
    end_block(taken->blocks[i], shown->back_end, result, row);
    row += n;
  }
  discard(taken);
}

/* ---- how many, and when ---- */

void mo_compute_want_remote(struct mo_compute *compute, enum mo_back_end back_end, uint32_t blocks)
{
  atomic_store(&mo_core(compute)->remote.blocks[back_end], blocks);
}

uint32_t mo_compute_remote_wanted(const struct mo_compute *compute, enum mo_back_end back_end)
{
  return atomic_load(&mo_core(compute)->remote.blocks[back_end]);
}

uint64_t mo_compute_remote_waiting(struct mo_compute *compute, enum mo_back_end back_end)
{
  struct mo_fair *fair = queue_of(compute, back_end);
  if (fair == NULL)
    return 0;
  MO_GUARD(&fair->mutex);
  return atomic_load(&fair->remote_steps) + (uint64_t)mo_offers_units(mo_core(compute), back_end);
}

void mo_compute_leave_remote(struct mo_compute *compute, bool leave)
{
  atomic_store(&mo_core(compute)->remote.leave, leave);
  mo_compute_wake(compute);
}

void mo_compute_watch_remote(struct mo_compute *compute, void (*arrived)(void *context),
                             void *context)
{
  struct mo_compute_core *core = mo_core(compute);
  pthread_mutex_lock(&core->fair->mutex);
  if (core->devices != NULL)
    pthread_mutex_lock(&core->devices->fair.mutex);
  core->remote.arrived = arrived;
  core->remote.context = context;
  if (core->devices != NULL)
    pthread_mutex_unlock(&core->devices->fair.mutex);
  pthread_mutex_unlock(&core->fair->mutex);
}
