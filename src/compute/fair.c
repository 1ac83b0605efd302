/* fair.c: see fair.h. */
#include "compute/fair.h"

#define SMOOTHING 0.125

/* Initial estimates, before any block was measured: roughly for one 2.5 GHz core. If they were far
 * too low, all workers could take long blocks of the same share. */
static const double unit_s_at_first[MO_FAIR_KINDS] = {
    [MO_FAIR_SCORING] = 3e-6, [MO_FAIR_GRADIENT] = 8e-5};

void mo_fair_init(struct mo_fair *fair, uint32_t n_workers)
{
  pthread_mutex_init(&fair->mutex, NULL);
  fair->shares = NULL;
  fair->credit_s = MO_FAIR_CREDIT_S * n_workers;
  fair->virtual_s = 0;
  for (int kind = 0; kind < MO_FAIR_KINDS; kind++)
    fair->unit_s[kind] = unit_s_at_first[kind];
  atomic_store(&fair->waiting, 0);
  atomic_store(&fair->remote_steps, 0);
}

static double within(double weight)
{
  if (!(weight >= MO_SHARE_WEIGHT_MIN))
    return MO_SHARE_WEIGHT_MIN;
  return weight < MO_SHARE_WEIGHT_MAX ? weight : MO_SHARE_WEIGHT_MAX;
}

void mo_fair_add(struct mo_fair *fair, struct mo_compute_share *share, double weight)
{
  MO_GUARD(&fair->mutex);
  struct mo_compute_share **link = &fair->shares;
  while (*link != NULL)
    link = &(*link)->next;
  *link = share;
  share->next = NULL;
  share->queue.first = NULL;
  share->weight = within(weight);
  share->virtual_s = fair->virtual_s;
  for (int kind = 0; kind < MO_FAIR_KINDS; kind++)
    share->unit_s[kind] = fair->unit_s[kind];
}

void mo_fair_remove(struct mo_fair *fair, struct mo_compute_share *share)
{
  MO_GUARD(&fair->mutex);
  struct mo_compute_share **link = &fair->shares;
  while (*link != share)
    link = &(*link)->next;
  *link = share->next;
}

void mo_fair_set_weight(struct mo_fair *fair, struct mo_compute_share *share, double weight)
{
  MO_GUARD(&fair->mutex);
  const double lead_s = (share->virtual_s - fair->virtual_s) * share->weight;
  share->weight = within(weight);
  share->virtual_s = fair->virtual_s + lead_s / share->weight;
}

double mo_fair_units(const struct mo_block *block)
{
  const uint32_t n = block->gradient != NULL ? block->gradient->n
                     : block->shards != NULL ? block->shards->n
                                             : block->n_environments;
  return (double)n * block->physics.scheme.n_steps;
}

static uint64_t remote_steps_of(const struct mo_block *block)
{
  return mo_block_suits_remote(block) ? (uint64_t)mo_fair_units(block) : 0;
}

/* Limits the credit that a share gained while it had no waiting blocks. */
static void join(const struct mo_fair *fair, struct mo_compute_share *share)
{
  const double least_s = fair->virtual_s - fair->credit_s / share->weight;
  if (share->queue.first == NULL && share->virtual_s < least_s)
    share->virtual_s = least_s;
}

void mo_fair_push(struct mo_fair *fair, struct mo_compute_share *share, struct mo_block *block)
{
  join(fair, share);
  mo_queue_push(&share->queue, block);
  atomic_fetch_add(&fair->waiting, 1);
  atomic_fetch_add(&fair->remote_steps, remote_steps_of(block));
}

static void add_charge(struct mo_fair_charge *charge, double units)
{
  struct mo_compute_share *share = charge->share;
  const double estimate_s = units * share->unit_s[charge->kind];
  charge->units += units;
  charge->estimate_s += estimate_s;
  share->virtual_s += estimate_s / share->weight;
}

/* Makes a share the current one: advances the queue's virtual time to the share's time. */
static struct mo_fair_charge start_charge(struct mo_fair *fair, struct mo_compute_share *share,
                                          enum mo_fair_kind kind)
{
  if (fair->virtual_s < share->virtual_s)
    fair->virtual_s = share->virtual_s;
  return (struct mo_fair_charge){.share = share, .kind = kind};
}

void mo_fair_charge_gradient(struct mo_fair *fair, struct mo_compute_share *share, double units,
                             struct mo_fair_charge *charge)
{
  join(fair, share);
  *charge = start_charge(fair, share, MO_FAIR_GRADIENT);
  add_charge(charge, units);
}

/* Takes and charges the first block of the charge's share, which must have one waiting. */
static struct mo_block *take_first(struct mo_fair *fair, struct mo_fair_charge *charge)
{
  struct mo_block *block = mo_queue_pop(&charge->share->queue);
  atomic_fetch_sub(&fair->waiting, 1);
  atomic_fetch_sub(&fair->remote_steps, remote_steps_of(block));
  charge->n_blocks++;
  add_charge(charge, mo_fair_units(block));
  return block;
}

struct mo_compute_share *mo_fair_next(const struct mo_fair *fair, mo_fair_fits *fits, void *context)
{
  struct mo_compute_share *next = NULL;
  for (struct mo_compute_share *share = fair->shares; share != NULL; share = share->next)
    if (share->queue.first != NULL && (next == NULL || share->virtual_s < next->virtual_s) &&
        (fits == NULL || fits(share->queue.first, context)))
      next = share;
  return next;
}

struct mo_block *mo_fair_take(struct mo_fair *fair, struct mo_fair_charge *charge,
                              mo_fair_fits *fits, void *context)
{
  struct mo_compute_share *next = mo_fair_next(fair, fits, context);
  return next != NULL ? mo_fair_take_from(fair, next, charge) : NULL;
}

struct mo_block *mo_fair_take_from(struct mo_fair *fair, struct mo_compute_share *share,
                                   struct mo_fair_charge *charge)
{
  if (share->queue.first == NULL)
    return NULL;
  const bool is_gradient =
      share->queue.first->gradient != NULL || share->queue.first->shards != NULL;
  *charge = start_charge(fair, share, is_gradient ? MO_FAIR_GRADIENT : MO_FAIR_SCORING);
  return take_first(fair, charge);
}

struct mo_block *mo_fair_take_more(struct mo_fair *fair, struct mo_fair_charge *charge,
                                   mo_fair_fits *fits, void *context)
{
  const struct mo_block *next = charge->share->queue.first;
  return next != NULL && fits(next, context) ? take_first(fair, charge) : NULL;
}

void mo_fair_put_back(struct mo_fair *fair, const struct mo_fair_charge *charge,
                      struct mo_block *const *blocks)
{
  struct mo_compute_share *share = charge->share;
  share->virtual_s -= charge->estimate_s / share->weight;
  for (uint32_t i = charge->n_blocks; i-- > 0;) {
    mo_queue_push_front(&share->queue, blocks[i]);
    atomic_fetch_add(&fair->remote_steps, remote_steps_of(blocks[i]));
  }
  atomic_fetch_add(&fair->waiting, charge->n_blocks);
}

void mo_fair_correct(struct mo_fair *fair, const struct mo_fair_charge *charge, double seconds,
                     bool whole)
{
  struct mo_compute_share *share = charge->share;
  share->virtual_s += (seconds - charge->estimate_s) / share->weight;
  atomic_fetch_add(&share->blocks_done, charge->n_blocks);
  if (!whole || charge->units <= 0)
    return;
  const double unit_s = seconds / charge->units;
  share->unit_s[charge->kind] += SMOOTHING * (unit_s - share->unit_s[charge->kind]);
  fair->unit_s[charge->kind] += SMOOTHING * (unit_s - fair->unit_s[charge->kind]);
}
