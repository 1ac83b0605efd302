/* fair.h: the fair queue of batch blocks: decides which share is next. Time is an argument, so that
 * tests run it without threads.
 *
 * The method is start-time fair queueing over worker time. Each share has a first-in first-out
 * queue and a virtual time: the worker seconds charged to it, divided by its weight. A free worker
 * takes the next block of the share with the least virtual time; the share created first wins a
 * tie. The cost of a block is known only at its end, and other workers choose before that. So a
 * share is charged an estimate when its block starts (the share's mean cost per rollout step of
 * this kind of block), and the difference when the block ends.
 *
 * The queue's own virtual time is the largest one at which a block was started. A share that had an
 * empty queue continues from its own virtual time, but at most MO_FAIR_CREDIT_S of worker time per
 * worker behind the queue's. Therefore, short gaps (between two steps of a training run or two
 * refills of a window) cost a share nothing, and a long idle time earns it nothing. A share that is
 * ahead stays ahead. The same rule limits a share that cannot use its time because it never has
 * enough blocks. */
#ifndef MORPHO_COMPUTE_FAIR_H
#define MORPHO_COMPUTE_FAIR_H

#include "compute/internal.h"

#define MO_FAIR_CREDIT_S 0.2

enum mo_fair_kind { MO_FAIR_SCORING, MO_FAIR_GRADIENT, MO_FAIR_KINDS };

/* First in, first out. Changed under the mutex of the back end; `n` may be read without it. */
struct mo_block_queue {
  struct mo_block *first, *last;
  atomic_uint_fast64_t n;
};

static inline void mo_queue_push(struct mo_block_queue *queue, struct mo_block *block)
{
  block->next = NULL;
  if (queue->first == NULL)
    queue->first = block;
  else
    queue->last->next = block;
  queue->last = block;
  atomic_fetch_add(&queue->n, 1);
}

static inline void mo_queue_push_front(struct mo_block_queue *queue, struct mo_block *block)
{
  block->next = queue->first;
  queue->first = block;
  if (block->next == NULL)
    queue->last = block;
  atomic_fetch_add(&queue->n, 1);
}

/* NULL: the queue is empty. */
static inline struct mo_block *mo_queue_pop(struct mo_block_queue *queue)
{
  struct mo_block *block = queue->first;
  if (block == NULL)
    return NULL;
  queue->first = block->next;
  block->next = NULL;
  atomic_fetch_sub(&queue->n, 1);
  return block;
}

/* The mutex of the back end guards `weight` to `next`; counters can be read anywhere. */
struct mo_compute_share {
  struct mo_compute *compute;
  double weight, virtual_s;
  double unit_s[MO_FAIR_KINDS]; /* estimates: worker seconds of one rollout step */
  struct mo_block_queue queue;
  struct mo_compute_share *next; /* in order of creation */
  struct mo_compute_share
      *on_devices; /* the share's entry in the queue of the devices; NULL: no devices */
  atomic_uint_fast64_t busy_ns, urgent_ns, blocks_done;
};

struct mo_fair {
  pthread_mutex_t mutex; /* guards the queue, and anything else that its owner chooses */
  struct mo_compute_share *shares;
  double credit_s; /* of all workers together */
  double virtual_s;
  double unit_s[MO_FAIR_KINDS];      /* initial estimates of a new share */
  atomic_uint_fast64_t waiting;      /* in all shares; read anywhere */
  atomic_uint_fast64_t remote_steps; /* of blocks suitable for remote takers; read anywhere */
};

/* The charge at the start of a block, or of several blocks that run together. */
struct mo_fair_charge {
  struct mo_compute_share *share;
  enum mo_fair_kind kind;
  uint32_t n_blocks;
  double units, estimate_s;
};

/* Returns whether a block may be taken. */
typedef bool mo_fair_fits(const struct mo_block *block, void *context);

void mo_fair_init(struct mo_fair *fair, uint32_t n_workers);
/* The next three functions take the mutex. */
void mo_fair_add(struct mo_fair *fair, struct mo_compute_share *share, double weight);
void mo_fair_remove(struct mo_fair *fair, struct mo_compute_share *share);
/* Sets the weight. The share's lead or debt stays the same in worker seconds: an old debt does not
 * grow with the weight. */
void mo_fair_set_weight(struct mo_fair *fair, struct mo_compute_share *share, double weight);

/* Call the following functions under the mutex. */
void mo_fair_push(struct mo_fair *fair, struct mo_compute_share *share, struct mo_block *block);
/* Returns the share that is next, among the shares whose first block fits, or NULL if there is
 * none. */
struct mo_compute_share *mo_fair_next(const struct mo_fair *fair, mo_fair_fits *fits,
                                      void *context);
/* Charges a share for a gradient of `units` rollout steps that has no block in the queue. */
void mo_fair_charge_gradient(struct mo_fair *fair, struct mo_compute_share *share, double units,
                             struct mo_fair_charge *charge);
/* Takes the first block of the share that is next, among the shares whose first block fits. fits
 * NULL: any block fits. Returns NULL if no such block is waiting. */
struct mo_block *mo_fair_take(struct mo_fair *fair, struct mo_fair_charge *charge,
                              mo_fair_fits *fits, void *context);
/* Takes the next block of this share, even if another share is next. Returns NULL if none is
 * waiting. */
struct mo_block *mo_fair_take_from(struct mo_fair *fair, struct mo_compute_share *share,
                                   struct mo_fair_charge *charge);
/* Takes another block of the charge's share, to run together with the blocks taken before. Returns
 * NULL if none is waiting, or it does not fit. */
struct mo_block *mo_fair_take_more(struct mo_fair *fair, struct mo_fair_charge *charge,
                                   mo_fair_fits *fits, void *context);
/* Puts blocks of a charge back at the front of its share, in order, and reverses the charge. If
 * only some of the blocks are put back, `charge` is the part of the charge that belongs to them. */
void mo_fair_put_back(struct mo_fair *fair, const struct mo_fair_charge *charge,
                      struct mo_block *const *blocks);
/* Returns the number of rollout steps; the cost of a block is roughly proportional to it. */
double mo_fair_units(const struct mo_block *block);
/* Corrects a charge to the measured worker seconds. `whole`: the block was computed completely, so
 * its cost updates the estimates. */
void mo_fair_correct(struct mo_fair *fair, const struct mo_fair_charge *charge, double seconds,
                     bool whole);

#endif
