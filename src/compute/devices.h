/* devices.h: the devices of a back end, for the files of this room.
 *
 * Each device has three threads: two callers, each inside the module with its own chunk, and the
 * gatherer, which collects the next chunk and builds its bodies. The mutex of the fair queue guards
 * everything here, unless a comment says otherwise. */
#ifndef MORPHO_COMPUTE_DEVICES_H
#define MORPHO_COMPUTE_DEVICES_H

#include "compute/device.h"
#include "compute/fair.h"

/* Largest number of rollouts in one call of a module: a second or two. Multiprocessors that become
 * idle at the end of a call take work from the next call only if that is in flight, so an idle
 * device gets its work in two calls, if each has enough for all multiprocessors. While several
 * shares use the devices, a call takes only a few tenths of a second. */
#define MO_CHUNK_ROWS        98304
#define MO_CHUNK_ROWS_SHARED 32768
#define MO_CHUNK_ROWS_ENOUGH 4096

enum { MO_CHUNK_NOT_DONE = 1, MO_CHUNK_TO_WORKERS = 2 };

struct mo_chunk_item {
  struct mo_block *block; /* NULL: requeued */
  int status;             /* a result code, or MO_CHUNK_NOT_DONE or MO_CHUNK_TO_WORKERS */
  uint32_t first_row;     /* if active */
  struct mo_body *body;   /* built here; NULL: the block's own, or the previous block's */
  bool needs_body;        /* used during the build */
};

/* The work of one call on a device: blocks of one share, controller and physics, or one part of a
 * gradient. */
struct mo_chunk {
  struct mo_fair_charge charge;
  struct mo_device_task *task;     /* a gradient; else NULL */
  uint32_t n_blocks, n_rows;       /* for a gradient: one block */
  uint32_t n_active;               /* the first blocks, which have rows; the others already have a
                                      result */
  struct mo_chunk_item *items;     /* (n_blocks) */
  struct mo_robot *robots;         /* (n_rows) consecutive within a block */
  struct mo_outcome *outcomes;     /* (n_rows) */
  double (*measures)[MO_MEASURES]; /* (n_rows) made for the first chunk with measured rows */
  bool is_measured;
};

/* Weights on a device. */
struct mo_device_copy {
  const struct mo_compute_controller *owner; /* NULL: no longer needed */
  struct mo_device_controller *controller;   /* NULL: unsupported */
  struct mo_device_copy *next;
};

/* A thread that calls the module. For the second one the device is opened once more. */
struct mo_caller {
  struct mo_unit *unit;
  struct mo_device *device; /* NULL: none */
  pthread_t thread;
  bool has_thread;
  enum mo_caller_state {
    MO_CALLER_IDLE = 0,
    MO_CALLER_ASKS, /* asks for the device's free memory */
    MO_CALLER_GETS, /* the gatherer fills its chunk */
    MO_CALLER_READY,
    MO_CALLER_RUNS,
    MO_CALLER_DELIVERS
  } state;
  struct mo_chunk chunk;
  volatile int cancel; /* the chunk that runs was cancelled; the module reads the flag */
  struct mo_device_copy *copies;
};

enum { MO_CALLERS = 2 };

struct mo_unit {
  struct mo_devices *devices;
  struct mo_caller callers[MO_CALLERS];
  uint32_t n_callers;              /* number that may be used at present */
  struct mo_device_status status;  /* busy_s and load: as of changed_ns */
  uint64_t changed_ns, charged_ns; /* charged: shares are charged for the device up to this time */
  bool wants_info;                 /* free memory was requested: read it */
  pthread_t gatherer;
  bool has_gatherer, gathered_all;         /* all: the gatherer has exited */
  _Atomic uint32_t row_limit, shard_limit; /* of a call; read anywhere */
  uint32_t good_chunks;                    /* since a limit was lowered */
};

/* The class of the devices, which determines their bits; constant. */
struct mo_device_class {
  char scores[128], gradients[128];
};

struct mo_devices {
  struct mo_compute *compute;
  const struct mo_device_module *module;
  void *library;
  void (*lost)(void *context, const struct mo_device_status *status);
  void *context;
  struct mo_device_class class;
  atomic_bool is_named; /* the class is set, and constant from then on; read anywhere */
  bool is_absent;       /* constant: only other machines have these devices (absent.c) */
  bool has_keeper;
  pthread_t keeper;
  struct mo_fair fair;
  pthread_cond_t wake;
  struct mo_compute_share own, urgent; /* for blocks without a share; for interactive blocks */
  const struct mo_compute_share *last; /* share of the last chunk taken; only compared, never
                                          dereferenced */
  bool stopping;
  uint32_t tasks_waiting; /* gradients */
  atomic_uint submitting; /* callers with more blocks to come */
  atomic_uint n_working;
  uint32_t n;
  struct mo_unit *units; /* (n) */
};

/* ---- devices.c ---- */
struct mo_devices *mo_devices_create(struct mo_compute *compute); /* NULL: out of memory */
/* Queues a block. MO_ERR_DEVICE: no device works, or the block needs a device of this machine;
 * MO_ERR_CANCELLED. */
int mo_devices_submit(struct mo_devices *devices, struct mo_block *block);
/* Cancels what is queued and running, joins the threads, and closes the devices. NULL-safe. */
void mo_devices_free(struct mo_devices *devices);

/* ---- device_chunk.c ---- */
int mo_chunk_create(struct mo_chunk *chunk); /* MO_ERR_NO_MEMORY */
void mo_chunk_destroy(struct mo_chunk *chunk);
/* Under the mutex: takes the next chunk for a caller of a device. Returns false if no work is
 * waiting. */
bool mo_chunk_take(struct mo_unit *unit, struct mo_chunk *chunk);
uint32_t mo_unit_held(const struct mo_unit *unit); /* under the mutex: callers that are not idle */
/* Without the mutex: builds the bodies, on at most n_threads threads, and lays out the rows. */
void mo_chunk_build(struct mo_chunk *chunk, uint32_t n_threads);
/* Returns whether all of the chunk was cancelled. */
bool mo_chunk_is_cancelled(const struct mo_chunk *chunk);
/* Under the mutex: requeues unfinished work, or ends it with an error if no device is left. */
void mo_chunk_return(struct mo_devices *devices, struct mo_chunk *chunk);
/* Without the mutex: calls `done`, or passes the block to the workers. outcomes: of a scoring block
 * with rows; else NULL. */
void mo_chunk_end_block(struct mo_devices *devices, struct mo_block *block, int status,
                        const struct mo_outcome *outcomes);
/* Without the mutex: calls `done` of the blocks with a result, and frees the bodies. */
void mo_chunk_deliver(struct mo_devices *devices, struct mo_chunk *chunk);

/* ---- device_run.c ---- */
void *mo_unit_gather(void *unit);
void *mo_caller_run(void *caller);
bool mo_unit_is_running(const struct mo_unit *unit); /* under the mutex */
/* Under the mutex: updates busy_s and load to the present. */
void mo_unit_account(struct mo_unit *unit);

#endif
