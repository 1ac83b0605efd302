/* shards.c: see shards.h. */
#include "compute/shards.h"

#include "compute/devices.h"

#include <stdlib.h>

#include "base/clock.h"

#define RETURNS_MAX 3
/* For a shard that only takers compute, which connect and disconnect. */
#define RETURNS_ABSENT_MAX 32
#define WORTH_S            0.2 /* seconds on the workers below which a batch is not offered */
#define WAIT_US            50000

struct mo_shard_result *mo_shard_result_create(size_t n_parameters)
{
  return calloc(1, sizeof(struct mo_shard_result) + n_parameters * sizeof(double));
}

static struct mo_compute_core *core_of(const struct mo_offer *offer)
{
  return mo_core(offer->compute);
}

static double units_of(const struct mo_gradient_batch *batch)
{
  return (double)batch->n * batch->physics.scheme.n_steps;
}

/* ---- opening and closing ---- */

/* Under the mutex. Returns whether takers should see the shards: takers need the genotypes, and a
 * small batch would be finished here before they have its weights. */
static bool is_worth_listing(const struct mo_offer *offer)
{
  const struct mo_compute_core *core = core_of(offer);
  const struct mo_gradient_batch *batch = offer->batch;
  if (core->remote.arrived == NULL || offer->share == NULL || batch->urgency != MO_BATCH)
    return false;
  for (uint32_t i = 0; i < batch->n; i++)
    if (batch->robots[i].genotype == NULL)
      return false;
  return offer->back_end == MO_ON_DEVICE || atomic_load(&core->remote.leave) ||
         units_of(batch) * batch->share->unit_s[MO_FAIR_GRADIENT] > WORTH_S * core->n_workers;
}

/* Under the mutex. Shows the shards to takers. */
static void list(struct mo_offer *offer)
{
  struct mo_compute_core *core = core_of(offer);
  offer->is_listed = true;
  offer->next = core->remote.offers[offer->back_end];
  core->remote.offers[offer->back_end] = offer;
  mo_remote_call(core);
}

int mo_offer_open(struct mo_offer *offer, struct mo_compute *compute, enum mo_back_end back_end,
                  const struct mo_gradient_batch *batch, const uint32_t *order, double weight)
{
  struct mo_compute_core *core = mo_core(compute);
  const bool on_device = back_end == MO_ON_DEVICE;
  const uint32_t n = (batch->n + MO_GRADIENT_SHARD - 1) / MO_GRADIENT_SHARD;
  *offer = (struct mo_offer){.compute = compute,
                             .back_end = back_end,
                             .fair = on_device ? &core->devices->fair : core->fair,
                             .share = on_device && batch->share != NULL ? batch->share->on_devices
                                                                        : batch->share,
                             .batch = batch,
                             .robots = malloc(batch->n * sizeof(*offer->robots)),
                             .n = n,
                             .items = calloc(n, sizeof(*offer->items))};
  if (offer->robots == NULL || offer->items == NULL) {
    free(offer->robots);
    free(offer->items);
    return MO_ERR_NO_MEMORY;
  }
  pthread_cond_init(&offer->changed, NULL);
  for (uint32_t i = 0; i < batch->n; i++)
    offer->robots[i] = batch->robots[order[i]];
  for (uint32_t i = 0; i < n; i++) {
    const uint32_t first = i * MO_GRADIENT_SHARD, left = batch->n - first;
    struct mo_gradient_batch *part = &offer->items[i].part;
    *part = *batch;
    part->robots = offer->robots + first;
    part->n = left < MO_GRADIENT_SHARD ? left : MO_GRADIENT_SHARD;
    part->options.weight = weight;
    part->is_arranged = true;
  }
  pthread_mutex_lock(&offer->fair->mutex);
  if (is_worth_listing(offer))
    list(offer);
  pthread_mutex_unlock(&offer->fair->mutex);
  if (offer->is_listed || !on_device)
    return MO_OK;
  mo_offer_close(offer);
  return MO_ERR_DEVICE;
}

void mo_offer_stop(struct mo_offer *offer)
{
  MO_GUARD(&offer->fair->mutex);
  for (uint32_t i = 0; i < offer->n; i++)
    atomic_store(&offer->items[i].stop, true);
  if (!offer->is_listed)
    return;
  struct mo_offer **link = &core_of(offer)->remote.offers[offer->back_end];
  while (*link != offer)
    link = &(*link)->next;
  *link = offer->next;
  offer->is_listed = false;
}

void mo_offer_close(struct mo_offer *offer)
{
  struct mo_fair *fair = offer->fair;
  pthread_mutex_lock(&fair->mutex);
  while (offer->n_taken > 0)
    pthread_cond_wait(&offer->changed, &fair->mutex);
  pthread_mutex_unlock(&fair->mutex);
  for (uint32_t i = 0; i < offer->n; i++)
    free(offer->items[i].result);
  pthread_cond_destroy(&offer->changed);
  free(offer->items);
  free(offer->robots);
}

/* ---- the calling thread ---- */

static bool is_done(const struct mo_shard *shard)
{
  return atomic_load_explicit(&shard->stop, memory_order_relaxed);
}

int mo_offer_claim(struct mo_offer *offer)
{
  const struct mo_compute_core *core = core_of(offer);
  MO_GUARD(&offer->fair->mutex);
  const bool leaves = offer->is_listed && atomic_load(&core->remote.leave) &&
                      atomic_load(&core->remote.blocks[MO_ON_CPU]) > 0;
  for (uint32_t i = 0; i < offer->n; i++) {
    struct mo_shard *shard = &offer->items[i];
    if (is_done(shard) || shard->is_here || shard->is_taken ||
        (leaves && !shard->is_refused && shard->n_returned < RETURNS_MAX))
      continue;
    shard->is_here = true;
    return (int)i;
  }
  return MO_ERR_EXHAUSTED;
}

/* Under the mutex. */
static void give(struct mo_shard *shard, struct mo_shard_result **result)
{
  if (*result == NULL || is_done(shard))
    return;
  shard->result = *result;
  atomic_store(&shard->stop, true);
  *result = NULL;
}

void mo_offer_finish(struct mo_offer *offer, uint32_t number, struct mo_shard_result **result)
{
  MO_GUARD(&offer->fair->mutex);
  give(&offer->items[number], result);
}

struct mo_shard_result *mo_offer_collect(struct mo_offer *offer, uint32_t number)
{
  MO_GUARD(&offer->fair->mutex);
  struct mo_shard_result *result = offer->items[number].result;
  offer->items[number].result = NULL;
  return result;
}

void mo_offer_wait(struct mo_offer *offer, uint32_t number)
{
  MO_GUARD(&offer->fair->mutex);
  if (offer->items[number].result == NULL)
    (void)mo_wait_until(&offer->changed, &offer->fair->mutex, mo_clock_us() + WAIT_US);
}

static bool was_returned_too_often(const struct mo_offer *offer, const struct mo_shard *shard)
{
  return shard->n_returned >= (offer->back_end == MO_ON_DEVICE ? RETURNS_ABSENT_MAX : RETURNS_MAX);
}

int mo_offer_error(struct mo_offer *offer)
{
  MO_GUARD(&offer->fair->mutex);
  for (uint32_t i = 0; i < offer->n; i++) {
    const struct mo_shard *shard = &offer->items[i];
    if (is_done(shard) || shard->is_taken)
      continue;
    if (shard->is_refused)
      return MO_ERR_UNSUPPORTED;
    if (was_returned_too_often(offer, shard))
      return MO_ERR_DEVICE;
  }
  return MO_OK;
}

/* ---- takers ---- */

/* Returns the shard that a taker gets next, or NULL if there is none. */
static struct mo_shard *find(const struct mo_offer *offer, bool here)
{
  for (uint32_t i = 0; i < offer->n; i++) {
    struct mo_shard *shard = &offer->items[i];
    if (shard->is_here == here && !shard->is_taken && !shard->is_refused &&
        !was_returned_too_often(offer, shard) && !mo_shard_is_cancelled(shard))
      return shard;
  }
  return NULL;
}

struct mo_offer *mo_offer_next(const struct mo_compute_core *core, enum mo_back_end back_end,
                               bool here)
{
  struct mo_offer *next = NULL;
  for (struct mo_offer *offer = core->remote.offers[back_end]; offer != NULL; offer = offer->next)
    if ((next == NULL || offer->share->virtual_s < next->share->virtual_s) &&
        find(offer, here) != NULL)
      next = offer;
  return next;
}

struct mo_shard *mo_offer_take(struct mo_offer *offer, bool here)
{
  struct mo_shard *shard = find(offer, here);
  shard->is_taken = true;
  offer->n_taken++;
  return shard;
}

void mo_offer_return(struct mo_offer *offer, struct mo_shard *shard, bool has_failed,
                     struct mo_shard_result *result)
{
  shard->is_taken = false;
  shard->n_returned += result == NULL;
  shard->is_refused |= has_failed;
  give(shard, &result);
  free(result);
  offer->n_taken--;
  pthread_cond_broadcast(&offer->changed); /* the offer may be freed once the mutex is released */
}

double mo_offers_units(const struct mo_compute_core *core, enum mo_back_end back_end)
{
  double units = 0;
  for (const struct mo_offer *offer = core->remote.offers[back_end]; offer != NULL;
       offer = offer->next)
    for (uint32_t i = 0; i < offer->n; i++) {
      const struct mo_shard *shard = &offer->items[i];
      if (!shard->is_here && !shard->is_taken && !is_done(shard))
        units += units_of(&shard->part);
    }
  return units;
}
