/* compute.h: "score these rollouts" and "gradient of these rollouts", whatever computes them.
 *
 * A back end runs blocks: one body in up to MO_BLOCK_LANES environments with one controller. Blocks
 * are submitted from any thread and finish in any order; each block's result depends on its inputs
 * alone. Urgent blocks start at once: a worker that is inside another block sets it aside at its
 * next pause point (a few steps), runs the urgent one, and goes on. Other blocks share the workers'
 * time by the weights of those who submit them. */
#ifndef MORPHO_COMPUTE_H
#define MORPHO_COMPUTE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/gradient.h>
#include <morpho/rollout.h>

#ifdef __cplusplus
extern "C" {
#endif

/* A controller ready for a back end: packs for each precision are made at first use and shared by
 * all workers. */
struct mo_compute;
struct mo_compute_controller;
struct mo_compute_share;

enum mo_urgency { MO_BATCH = 0, MO_INTERACTIVE = 1 };

/* Where a block or batch is to be computed. Bits differ between the two, and are the same on any
 * number of devices. */
enum mo_back_end { MO_ON_CPU = 0, MO_ON_DEVICE = 1 };

struct mo_compute_config {
  uint32_t n_workers; /* 0: one per online processor */
  enum mo_isa isa;    /* from mo_isa_best(), or lower for tests */
  int nice; /* workers' niceness above the process's, 0 … 19: the service's threads stay responsive
             */
  size_t gradient_bytes; /* budget of one worker's scratch for gradients; 0:
                            MO_GRADIENT_DEFAULT_BYTES */
};

/* Filled in by the submitter, who owns it and all it points to until `done` is called. */
struct mo_block {
  const struct mo_body *body; /* or NULL: built by the worker from lattice and genotype */
  const struct mo_lattice *lattice;
  const uint64_t *genotype; /* placed; used when body is NULL */
  struct mo_compute_controller *controller;
  const struct mo_environment *environments[MO_BLOCK_LANES];
  uint32_t n_environments;
  struct mo_physics physics;
  enum mo_precision precision;
  enum mo_urgency urgency;
  enum mo_back_end back_end;             /* MO_ON_DEVICE: as far as devices can, see below */
  const struct mo_recording *recordings; /* NULL or (n_environments) */
  const volatile int *cancel; /* NULL or a flag; non-zero ends the block with MO_ERR_CANCELLED */
  int64_t tag; /* the submitter's, e.g. the job; readable by mo_compute_current_tag */
  struct mo_compute_share
      *share; /* whose worker time it is; NULL: the back end's own share, of weight 1 */
  /* Results. */
  struct mo_outcome outcomes[MO_BLOCK_LANES];
  int status;                   /* MO_OK, MO_ERR_CANCELLED, MO_ERR_NO_MEMORY, MO_ERR_DEVICE, … */
  enum mo_back_end computed_on; /* with MO_OK */
  /* Called once, on a worker's or a device's thread, after the results are written; must be short.
   * The block may be freed in it. */
  void (*done)(struct mo_block *block, void *context);
  void *context;
  /* The back end's own. */
  struct mo_block *next;
  struct mo_gradient_task *gradient;
  struct mo_device_task *shards;
};

struct mo_compute_stats {
  uint32_t n_workers, n_busy;
  uint64_t blocks_done;                                     /* scoring and gradient blocks */
  uint64_t rollouts_done, rollout_steps, rollouts_diverged; /* of scoring blocks */
  uint64_t blocks_preempted; /* urgent blocks that overtook inside another */
  uint64_t gradient_robots_done, gradient_robots_diverged, gradient_robots_zeroed;
  uint64_t queued_batch, queued_interactive;
  double busy_s;           /* worker seconds spent inside blocks */
  size_t worker_bytes_max; /* largest scratch of one worker */
};

/* The CPU back end. MO_ERR_RANGE, MO_ERR_NO_MEMORY, MO_ERR_UNSUPPORTED (isa). */
int mo_compute_create_cpu(const struct mo_compute_config *config, struct mo_compute **compute);
/* Cancels what is queued and running (their `done` is called with MO_ERR_CANCELLED), joins the
 * workers. NULL-safe. */
void mo_compute_free(struct mo_compute *compute);

/* For a thread that computes but is none of the workers: batch scheduling and their niceness, as of
 * now, for itself and for the threads that it starts from then on. Once a thread; it cannot be
 * undone. */
void mo_compute_settle(const struct mo_compute *compute);

/* Takes a copy of nothing: `controller` (nullable: passive bodies) must outlive the result. */
int mo_compute_controller_create(struct mo_compute *compute, const struct mo_controller *controller,
                                 struct mo_compute_controller **ret);
/* Only when no block uses it; where there are devices, before mo_compute_free. NULL-safe. */
void mo_compute_controller_free(struct mo_compute_controller *controller);

/* ---- shares: how the workers' time is divided among submitters ---- */

/* While several shares have blocks that wait, each gets worker time in proportion to its weight,
 * whatever its blocks cost and however many of them wait; a share that has none leaves its part to
 * the others. Blocks of one share start in the order in which they came. The order decides when a
 * result is there, never its bits. Keep two blocks per worker submitted: a share that never has a
 * block waiting cannot use a large part. Urgent blocks (MO_INTERACTIVE) go first as ever and are
 * charged to nobody; their time is taken off the block inside which they overtook. */
#define MO_SHARE_WEIGHT_MIN 1e-3
#define MO_SHARE_WEIGHT_MAX 1e6 /* 1000 for one job; a share may stand for many */

/* Weights outside the range are moved to its ends. MO_ERR_NO_MEMORY. */
int mo_compute_share_create(struct mo_compute *compute, double weight,
                            struct mo_compute_share **share);
/* Only when no block of it is queued or running (the calls of `done` of all have begun), before or
 * after the compute is. NULL-safe. */
void mo_compute_share_free(struct mo_compute_share *share);
void mo_compute_share_set_weight(struct mo_compute_share *share, double weight); /* from now on */

struct mo_compute_share_stats {
  double busy_s; /* worker seconds in its blocks, without urgent blocks that overtook inside them */
  double urgent_s;      /* of these, in urgent blocks: charged to nobody */
  double device_s;      /* seconds of devices in its blocks and gradients */
  uint64_t waiting;     /* batch blocks that wait */
  uint64_t blocks_done; /* urgent ones, too */
};
void mo_compute_share_get_stats(const struct mo_compute_share *share,
                                struct mo_compute_share_stats *stats); /* lock-free reads */

/* Queues a block; never blocks, never fails for a valid block (MO_ERR_INVALID, MO_ERR_CANCELLED
 * after free began), but for devices with MO_ERR_DEVICE when none works. */
int mo_compute_submit(struct mo_compute *compute, struct mo_block *block);

/* Whoever submits many blocks one after the other says so before and after: devices wait for the
 * last of them (50 ms at most), rather than take the few that are there first. */
void mo_compute_begin_blocks(struct mo_compute *compute);
void mo_compute_end_blocks(struct mo_compute *compute);

/* Submits blocks and waits for all of them; returns the first error by position. For tools and
 * tests. */
int mo_compute_run(struct mo_compute *compute, struct mo_block *blocks, size_t n);

/* ---- gradients ---- */

/* A batch of different robots, each with its environment. Filled in by the caller, who owns all it
 * points to. */
struct mo_gradient_batch {
  const struct mo_controller *controller;
  const struct mo_robot *robots; /* (n) */
  uint32_t n;                    /* 1 … MO_GRADIENT_BATCH_MAX */
  struct mo_physics physics;
  double adjoint_bound; /* ≥ 0; 0: off */
  enum mo_adjoint_rule adjoint_rule;
  double restart_weight;
  enum mo_urgency urgency;    /* MO_INTERACTIVE: goes before all batch blocks that wait, without
                                 interrupting one that runs */
  const volatile int *cancel; /* NULL or a flag; non-zero: MO_ERR_CANCELLED soon */
  int64_t tag;
  struct mo_compute_share *share; /* as in a block */
  enum mo_back_end back_end;
  /* Results. */
  enum mo_back_end computed_on;
  double *d_parameters; /* (n_parameters) the gradient of the mean loss over all n robots; those
                         * that diverged or were zeroed count as 0 */
  struct mo_outcome *outcomes; /* (n) */
  struct mo_gradient_counts counts;
  struct mo_gradient_profile profile;
};
#define MO_GRADIENT_BATCH_MAX 65536

/* Cuts the batch into blocks of MO_GRADIENT_ROBOTS (in the order of mo_gradient_arrange), keeps all
 * workers busy with them, and adds their results up in float64 in the order of the blocks: the same
 * bits for any number of workers. Urgent scoring blocks overtake inside a block. Waits for the
 * result; for a thread that may block. `state` keeps what lasts from one call to the next: a pack,
 * and at most two float32 gradients per worker. Create it once per training; one call at a time,
 * which must have returned before mo_compute_free. MO_ERR_RANGE (n, a bound below 0, a weight
 * outside its range), MO_ERR_INVALID (something missing or not finite, no such rule, a body of
 * another workspace, physics or an environment that their checks refuse), MO_ERR_NO_MEMORY,
 * MO_ERR_CANCELLED, MO_ERR_DEVICE. On error the results are undefined.
 *
 * On devices the blocks are shards of 1024 consecutive robots, spread over the devices and added up
 * in the same way: the same bits for any number of devices. `urgency` does not count there. What
 * the devices do not support is computed by the workers, all of it. */
struct mo_gradient_state;
int mo_gradient_state_create(struct mo_compute *compute, struct mo_gradient_state **state);
void mo_gradient_state_free(struct mo_gradient_state *state); /* NULL-safe; before the compute */
int mo_compute_gradient(struct mo_gradient_state *state, struct mo_gradient_batch *batch);
/* Lays out the robots of a gradient that devices are to compute next, before the weights are known:
 * so that they need not wait for it. For another thread, while mo_compute_gradient computes the one
 * before. Robots and what they point to stay as they are until their gradient was computed, or
 * forgotten; only the newest that were laid out are kept. Changes no bit; without devices it does
 * nothing. MO_ERR_RANGE, MO_ERR_INVALID, MO_ERR_NO_MEMORY, MO_ERR_UNSUPPORTED, MO_ERR_DEVICE: the
 * gradient will find them as if it had not been called. */
int mo_compute_gradient_lay_out(struct mo_gradient_state *state, const struct mo_robot *robots,
                                uint32_t n, const struct mo_physics *physics);
void mo_compute_gradient_forget(
    struct mo_gradient_state *state); /* robots that were laid out will change */
/* As mo_compute_fingerprint, for gradients. */
const char *mo_compute_gradient_fingerprint(const struct mo_compute *compute);

/* ---- devices: GPUs, by a module that is loaded at run time ---- */

/* Blocks with MO_ON_DEVICE wait in a queue of all devices together, in which shares have their
 * weights as with the workers. A device takes many at once, of one share, one controller and one
 * physics. What devices do not do is computed by the workers: blocks in float64 or with recordings,
 * and whatever a module does not support; which it is depends on the block alone, and `computed_on`
 * says so. Blocks of MO_INTERACTIVE go before the others. Where a device has no memory for so many
 * it gets fewer. One that fails is lost: its work goes to the others, and when none is left all of
 * it ends with MO_ERR_DEVICE, as does what comes later. */
enum mo_device_state { MO_DEVICE_WORKS = 0, MO_DEVICE_LOST = 1 };

struct mo_device_status {
  uint32_t index;                       /* among the module's devices */
  char name[96], id[48];                /* "NVIDIA H200"; UUID or PCI bus id */
  uint64_t memory_bytes, free_bytes;    /* free: as it was a moment ago */
  uint32_t multiprocessors, capability; /* 90: compute capability 9.0 */
  enum mo_device_state state;
  char error[256]; /* lost: why */
  bool is_busy;
  double load;   /* share of the last ten seconds, about, in which it was busy */
  double busy_s; /* since the start */
  uint64_t rollouts_done, gradient_robots_done, calls;
  uint32_t rows_at_once; /* rollouts that it gets at most at a time; less after want of memory */
};

struct mo_devices_config {
  const char *module;      /* path of the shared object */
  const uint32_t *devices; /* (n) which of its devices; NULL: all that can be opened */
  uint32_t n;
  /* Told when a device is lost, and, while devices are added, of each that cannot be opened; on a
   * thread of its own. Nullable. */
  void (*lost)(void *context, const struct mo_device_status *status);
  void *context;
};

/* Loads a module and opens its devices; once, before shares, controllers and blocks are made.
 * MO_ERR_NOT_FOUND: there is no such file; MO_ERR_UNSUPPORTED: it is no module, or one for another
 * version of this program; MO_ERR_EXHAUSTED: it finds no device that works; MO_ERR_RANGE: no such
 * device; MO_ERR_DEVICE: one that was named cannot be opened; MO_ERR_CONFLICT: there are devices
 * already; MO_ERR_NO_MEMORY. After an error there are none. */
int mo_compute_add_devices(struct mo_compute *compute, const struct mo_devices_config *config,
                           struct mo_message *message);
uint32_t mo_compute_devices(const struct mo_compute *compute);         /* opened, lost ones too */
uint32_t mo_compute_devices_working(const struct mo_compute *compute); /* of these, not lost */
/* MO_ERR_RANGE: position is not below mo_compute_devices. */
int mo_compute_device(struct mo_compute *compute, uint32_t position,
                      struct mo_device_status *status);
/* "cuda …": as the fingerprints below, of scores and gradients that devices compute. NULL: there
 * are no devices. */
const char *mo_compute_device_fingerprint(const struct mo_compute *compute);
const char *mo_compute_device_gradient_fingerprint(const struct mo_compute *compute);

/* ---- facts ---- */

/* Of the workers. Lock-free reads. */
void mo_compute_get_stats(const struct mo_compute *compute, struct mo_compute_stats *stats);
/* The tag of the block that the calling worker thread is in, −1 elsewhere. Async-signal-safe. */
int64_t mo_compute_current_tag(void);
/* "cpu avx512 float32 …": what the bits of a result depend on besides its inputs (back end,
 * instruction set, code version). */
const char *mo_compute_fingerprint(const struct mo_compute *compute, enum mo_precision precision);

#ifdef __cplusplus
}
#endif
#endif
