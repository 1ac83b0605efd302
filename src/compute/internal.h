/* internal.h: declarations shared by the files of this room. */
#ifndef MORPHO_COMPUTE_INTERNAL_H
#define MORPHO_COMPUTE_INTERNAL_H

#include <morpho/compute.h>

#include <stdatomic.h>

#include "base/thread.h"

/* Part of every fingerprint: increment it whenever a change to the fast path changes any bit of a
 * result. tests/unit/rollout/bits.c detects such a change. */
#define MO_KERNEL_VERSION 2
/* The same for gradients: tests/unit/rollout/gradient-bits.c detects changed bits of a block,
 * tests/unit/compute/gradient.c a changed order of adding blocks. */
#define MO_GRADIENT_VERSION 5

/* Returns the pack of one precision, which is created at first use; waits while another thread
 * creates it. MO_ERR_NO_MEMORY, MO_ERR_UNSUPPORTED. */
int mo_compute_controller_pack(struct mo_compute_controller *controller,
                               enum mo_precision precision, const struct mo_pack **pack);

struct mo_devices;
struct mo_fair;
struct mo_offer;
struct mo_rates;
/* The first member of a back end. Files that cpu.c calls can read it without calling cpu.c
 * themselves. */
struct mo_compute_core {
  enum mo_isa isa;
  uint32_t n_workers;
  struct mo_fair *fair;       /* the queue of the workers' batch blocks */
  struct mo_devices *devices; /* NULL: none */
  struct mo_rates *rates;
  struct {
    atomic_uint blocks[2]; /* blocks that takers can hold, by enum mo_back_end */
    atomic_bool leave;     /* leave suitable blocks to takers */
    atomic_bool hungry;    /* a taker found nothing since the last arrival */
    void (*arrived)(void *context);
    void *context;
    struct mo_offer *offers[2]; /* gradients, by back end; under the mutex of its queue */
  } remote;                     /* remote.c */
  /* Queues a block for the workers after it was submitted to devices that cannot compute it.
   * MO_ERR_CANCELLED. */
  int (*submit_to_workers)(struct mo_compute *compute, struct mo_block *block);
};

static inline struct mo_compute_core *mo_core(const struct mo_compute *compute)
{
  return (struct mo_compute_core *)compute;
}

/* Wakes all workers and gatherers, because blocks were put back or may now be taken. */
void mo_compute_wake(struct mo_compute *compute);

/* Returns whether a remote taker can compute a block. */
static inline bool mo_block_suits_remote(const struct mo_block *block)
{
  return block->urgency == MO_BATCH && block->precision == MO_FLOAT32 &&
         block->recordings == NULL && block->body == NULL && block->states.from == NULL &&
         block->states.to == NULL &&
         (block->measuring == NULL || block->measuring->set == MO_MEASURES_ALL) && /* sent whole */
         block->gradient == NULL && block->shards == NULL && !block->stays;
}

/* Under the mutex of the queue that received work: notifies takers that found nothing. */
static inline void mo_remote_call(struct mo_compute_core *core)
{
  if (core->remote.arrived != NULL &&
      atomic_load_explicit(&core->remote.hungry, memory_order_relaxed) &&
      atomic_exchange(&core->remote.hungry, false))
    core->remote.arrived(core->remote.context);
}

static inline void mo_remote_arrived(struct mo_compute_core *core, const struct mo_block *block)
{
  if (mo_block_suits_remote(block))
    mo_remote_call(core);
}

/* Waits for blocks: `done` and `context` of each are mo_waiter_done and the waiter. */
struct mo_waiter {
  pthread_mutex_t mutex;
  pthread_cond_t all_done;
  size_t left;
  atomic_bool failed; /* a block's status is not MO_OK */
};
#define MO_WAITER(n)                                                                               \
  {                                                                                                \
    PTHREAD_MUTEX_INITIALIZER, PTHREAD_COND_INITIALIZER, (n), false                                \
  }
void mo_waiter_done(struct mo_block *block, void *context);
void mo_waiter_wait(struct mo_waiter *waiter); /* and destroys it */

/* A gradient block. Its `block` is what the queues hold; physics, urgency, cancel, tag, status,
 * done and context mean the same as in a scoring block. */
struct mo_gradient_task {
  struct mo_block block;
  const struct mo_pack *pack;
  struct mo_robot robots[MO_GRADIENT_ROBOTS];
  uint32_t n;
  struct mo_gradient_options options;
  const atomic_bool *stop; /* true: like a set `cancel` */
  /* Results; counts are added to. */
  struct mo_outcome outcomes[MO_GRADIENT_ROBOTS];
  float *d_parameters; /* (n_parameters) */
  struct mo_gradient_counts counts;
};
/* Returns the options for each robot: its weight is its share of the batch's mean, unless the batch
 * sets a weight. */
static inline struct mo_gradient_options mo_batch_options(const struct mo_gradient_batch *batch)
{
  struct mo_gradient_options options = batch->options;
  if (options.weight == 0)
    options.weight = 1.0 / batch->n;
  return options;
}

/* A part of a batch for one device: shards of MO_DEVICE_SHARD robots. Its `block` is in the queue,
 * as for a gradient block. */
struct mo_device_layout;
struct mo_device_task {
  struct mo_block block;
  const struct mo_gradient_batch *batch;
  uint32_t first, n;               /* its robots */
  struct mo_device_layout *layout; /* of all n robots; NULL: not laid out */
  const atomic_bool *stop;
  /* Results, in addition to the batch's outcomes. */
  float *d_parameters;              /* (shards, n_parameters) */
  struct mo_gradient_counts counts; /* added to */
};

static inline bool mo_block_is_cancelled(const struct mo_block *block)
{
  const atomic_bool *stop = block->gradient != NULL ? block->gradient->stop
                            : block->shards != NULL ? block->shards->stop
                                                    : NULL;
  return mo_is_cancelled(block->cancel) ||
         (stop != NULL && atomic_load_explicit(stop, memory_order_relaxed));
}

/* Same as mo_compute_submit, for a task that was checked. MO_ERR_CANCELLED. */
int mo_compute_submit_gradient(struct mo_compute *compute, struct mo_gradient_task *task);

const struct mo_controller *
mo_compute_controller_weights(const struct mo_compute_controller *controller);

#endif
