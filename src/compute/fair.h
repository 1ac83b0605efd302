/* fair.h: the queue of batch blocks: whose turn it is. Time is an argument, so that tests can run
 * it without threads.
 *
 * Start-time fair queueing over worker time. Each share has a queue, first in first out, and a
 * virtual time: the worker seconds that it was charged, over its weight. A free worker takes the
 * next block of the share with the least virtual time, among equals of the one that was created
 * first. What a block will cost is known only when it is done, and other workers choose meanwhile:
 * so its share is charged an estimate when it starts (the share's mean cost per rollout step of
 * such blocks), and the difference when it ends.
 *
 * The queue's own virtual time is the largest at which a block was started. A share whose queue was
 * empty goes on from its own virtual time, but from no more than MO_FAIR_CREDIT_S of worker time
 * per worker behind the queue's: short gaps, between two steps of a training or two refills of a
 * window, cost it nothing, and a long rest earns nothing. What it is ahead it stays ahead. The same
 * rule bounds a share that cannot use its part because it never has enough blocks. */
#ifndef MORPHO_COMPUTE_FAIR_H
#define MORPHO_COMPUTE_FAIR_H

#include "compute/internal.h"

#define MO_FAIR_CREDIT_S 0.2

enum mo_fair_kind { MO_FAIR_SCORING, MO_FAIR_GRADIENT, MO_FAIR_KINDS };

/* The first four fields are under the mutex of the back end, the counters are read anywhere. */
struct mo_compute_share {
  struct mo_compute *compute;
  double weight, virtual_s;
  double unit_s[MO_FAIR_KINDS]; /* estimates: worker seconds of one rollout step */
  struct mo_block *first, *last;
  struct mo_compute_share *next; /* in order of creation */
  struct mo_compute_share
      *on_devices; /* its place in the queue of the devices; NULL: there are none */
  atomic_uint_fast64_t busy_ns, urgent_ns, waiting, blocks_done;
};

struct mo_fair {
  struct mo_compute_share *shares;
  double credit_s; /* of all workers together */
  double virtual_s;
  double unit_s[MO_FAIR_KINDS]; /* where a new share's estimates start */
  atomic_uint_fast64_t waiting; /* in all shares; read anywhere */
};

/* What a block that runs, or several that run together, were charged at their start. */
struct mo_fair_charge {
  struct mo_compute_share *share;
  enum mo_fair_kind kind;
  uint32_t n_blocks;
  double units, estimate_s;
};

/* All under one mutex. */
void mo_fair_init(struct mo_fair *fair, uint32_t n_workers);
void mo_fair_add(struct mo_fair *fair, struct mo_compute_share *share, double weight);
void mo_fair_remove(struct mo_fair *fair, struct mo_compute_share *share);
/* What a share is ahead or behind stays the same in worker seconds: an old debt does not grow with
 * a new weight. */
void mo_fair_set_weight(struct mo_fair *fair, struct mo_compute_share *share, double weight);
void mo_fair_push(struct mo_fair *fair, struct mo_compute_share *share, struct mo_block *block);
struct mo_block *mo_fair_take(struct mo_fair *fair,
                              struct mo_fair_charge *charge); /* NULL: none waits */
/* The next block of this share, whosever turn it is; NULL: it has none waiting. */
struct mo_block *mo_fair_take_from(struct mo_fair *fair, struct mo_compute_share *share,
                                   struct mo_fair_charge *charge);
/* The next block of the charge's share, which is to run together with those taken before; NULL:
 * none waits, or it does not fit. */
struct mo_block *mo_fair_take_more(struct mo_fair *fair, struct mo_fair_charge *charge,
                                   bool (*fits)(const struct mo_block *block, void *context),
                                   void *context);
/* The block took so many worker seconds; `whole`: it was computed to its end, so that its cost
 * tells something of the next. */
void mo_fair_settle(struct mo_fair *fair, const struct mo_fair_charge *charge, double seconds,
                    bool whole);

#endif
