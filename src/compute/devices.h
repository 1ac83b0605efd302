/* devices.h: the devices of a back end, for the files of this room.
 *
 * Each device has two threads: one gathers what it is to compute next and builds the bodies, while
 * the other is inside the module with what was gathered before. All that is here is under one
 * mutex, but for what says otherwise. */
#ifndef MORPHO_COMPUTE_DEVICES_H
#define MORPHO_COMPUTE_DEVICES_H

#include "compute/device.h"
#include "compute/fair.h"

/* Most rollouts of one call of a module: a second or two. Each call ends with some tenths of a
 * second in which ever fewer multiprocessors have work, so the fewer calls the better; but while
 * others use the devices, too, a call takes some tenths of a second. */
#define MO_CHUNK_ROWS        98304
#define MO_CHUNK_ROWS_SHARED 32768

enum { MO_CHUNK_NOT_DONE = 1, MO_CHUNK_TO_WORKERS = 2 };

/* What a device computes in one go: blocks of one share, controller and physics; or one part of a
 * gradient. */
struct mo_chunk {
  struct mo_fair_charge charge;
  struct mo_device_task *task; /* a gradient; else NULL */
  /* Of a gradient one block; of blocks also: */
  uint32_t n_blocks, n_rows;
  uint32_t n_active;        /* blocks before it have rows; the others have their end already */
  struct mo_block **blocks; /* (n_blocks) NULL: went back to the queue */
  int *status;              /* (n_blocks) a result code, or one of those below */
  uint32_t *first_row;      /* (n_active) */
  struct mo_body *
      *bodies;      /* (n_blocks) built here; NULL: the block's own, or that of the block before */
  bool *needs_body; /* (n_blocks) while it is built */
  struct mo_robot *robots;     /* (n_rows) those of a block are consecutive */
  struct mo_outcome *outcomes; /* (n_rows) */
};

/* Weights on a device. */
struct mo_device_copy {
  const struct mo_compute_controller *owner; /* NULL: nobody needs it any more */
  struct mo_device_controller *controller;   /* NULL: unsupported */
  struct mo_device_copy *next;
};

struct mo_unit {
  struct mo_devices *devices;
  struct mo_device *device;
  struct mo_device_status status; /* busy_s and load: as of changed_ns */
  uint64_t changed_ns;
  bool wants_info; /* somebody has asked: free memory is looked up */
  pthread_t gatherer, runner;
  bool has_gatherer, has_runner;
  struct mo_chunk chunks[2];
  struct mo_chunk *ready, *running; /* NULL: none */
  struct mo_chunk *held;            /* what runs, and what is handed back */
  bool is_building;                 /* the gatherer has taken one that is not ready yet */
  bool gathered_all;                /* the gatherer has ended */
  volatile int cancel;              /* what runs is not wanted any more; read by the module */
  struct mo_device_copy *copies;
  /* The runner's. */
  uint32_t row_limit, shard_limit; /* row_limit is read by the gatherer, under the mutex */
  uint32_t good_chunks;            /* since one of them was lowered */
};

struct mo_devices {
  struct mo_compute *compute;
  const struct mo_device_module *module;
  void *library;
  void (*lost)(void *context, const struct mo_device_status *status);
  void *context;
  char fingerprint[128], gradient_fingerprint[128];
  pthread_mutex_t mutex;
  pthread_cond_t wake;
  struct mo_fair fair;
  struct mo_compute_share own, urgent; /* of blocks that name none; of interactive ones */
  const struct mo_compute_share *last; /* of which a chunk was taken last; only compared */
  bool stopping;
  uint32_t tasks_waiting; /* gradients */
  atomic_uint submitting; /* callers that have more blocks to come */
  atomic_uint n_working;
  uint32_t n;
  struct mo_unit *units; /* (n) */
};

/* ---- devices.c ---- */
/* Queues a block. MO_ERR_DEVICE: no device works; MO_ERR_CANCELLED. */
int mo_devices_submit(struct mo_devices *devices, struct mo_block *block);
/* Nobody will use this controller any more. */
void mo_devices_forget(struct mo_devices *devices, const struct mo_compute_controller *controller);
/* Cancels what is queued and running, joins the threads, closes the devices. NULL-safe. */
void mo_devices_free(struct mo_devices *devices);
/* Places of a share in the queue of the devices. */
int mo_devices_share_create(struct mo_devices *devices, double weight,
                            struct mo_compute_share **share);
void mo_devices_share_remove(struct mo_devices *devices,
                             struct mo_compute_share *share); /* does not free it */
void mo_devices_share_set_weight(struct mo_devices *devices, struct mo_compute_share *share,
                                 double weight);

/* ---- device_gradient.c ---- */
/* What lasts from one gradient to the next: memory, and what was laid out ahead. */
struct mo_device_gradients;
int mo_device_gradients_create(struct mo_devices *devices,
                               struct mo_device_gradients **ret);     /* MO_ERR_NO_MEMORY */
void mo_device_gradients_free(struct mo_device_gradients *gradients); /* NULL-safe */
/* The gradient of a checked batch. Adds to counts, which are 0. One call at a time. */
int mo_devices_gradient(struct mo_device_gradients *gradients, struct mo_gradient_batch *batch);
/* Lays out checked robots, which stay as they are until their gradient was asked for, or forgotten.
 * One call at a time, beside one of mo_devices_gradient. What was laid out before and is not in use
 * is forgotten. MO_ERR_CONFLICT: two are in use. */
int mo_devices_lay_out(struct mo_device_gradients *gradients, const struct mo_robot *robots,
                       uint32_t n, const struct mo_physics *physics);
void mo_device_gradients_forget(struct mo_device_gradients *gradients);
bool mo_devices_have_laid_out(struct mo_device_gradients *gradients,
                              const struct mo_gradient_batch *batch);

/* ---- device_chunk.c ---- */
int mo_chunk_create(struct mo_chunk *chunk); /* MO_ERR_NO_MEMORY */
void mo_chunk_destroy(struct mo_chunk *chunk);
/* Under the mutex: takes what a device is to compute next. False: nothing waits. */
bool mo_chunk_take(struct mo_unit *unit, struct mo_chunk *chunk);
/* Without the mutex: builds the bodies, on so many threads at most, and lays out the rows. */
void mo_chunk_build(struct mo_chunk *chunk, uint32_t n_threads);
bool mo_same_physics(const struct mo_physics *a, const struct mo_physics *b);
/* Whether nobody wants what is in it any more. */
bool mo_chunk_is_cancelled(const struct mo_chunk *chunk);
/* Under the mutex: what is not done goes back to the queue, or has its end if nobody is left to do
 * it. */
void mo_chunk_return(struct mo_devices *devices, struct mo_chunk *chunk);
/* Without the mutex: hands back what has a result, and frees the bodies. */
void mo_chunk_deliver(struct mo_devices *devices, struct mo_chunk *chunk);

/* ---- device_run.c ---- */
/* The threads of a device. */
void *mo_unit_gather(void *unit);
void *mo_unit_run(void *unit);
/* Under the mutex: brings busy_s and load up to now. */
void mo_unit_account(struct mo_unit *unit);

#endif
