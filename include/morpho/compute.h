/* compute.h: scores rollouts and computes their gradients, on CPU workers or on devices.
 *
 * A back end runs blocks: one body in up to MO_BLOCK_LANES environments with one controller. Any
 * thread may submit blocks. Blocks finish in any order; the result of a block depends only on its
 * inputs. An urgent block starts at once: a worker that is running another block suspends that
 * block at its next pause point (a few steps), runs the urgent one, and resumes. Other blocks share
 * the workers' time by the weights of their submitters. */
#ifndef MORPHO_COMPUTE_H
#define MORPHO_COMPUTE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <morpho/gradient.h>
#include <morpho/rollout.h>
#include <morpho/state.h>

#ifdef __cplusplus
extern "C" {
#endif

/* A controller prepared for a back end. Its pack for each precision is created at first use and
 * shared by all workers. */
struct mo_compute;
struct mo_compute_controller;
struct mo_compute_share;

/* In ascending order. MO_IMMEDIATE: a scoring block may also interrupt an interactive one. */
enum mo_urgency { MO_BATCH = 0, MO_INTERACTIVE = 1, MO_IMMEDIATE = 2 };

/* Where to compute a block or batch. The bits depend on this choice, but not on the number of
 * devices. */
enum mo_back_end { MO_ON_CPU = 0, MO_ON_DEVICE = 1 };

struct mo_compute_config {
  uint32_t n_workers; /* 0 = one per CPU in the affinity mask, or fewer under a CPU quota */
  enum mo_isa isa;    /* from mo_isa_best(), or lower for tests */
  int nice; /* added to the process's niceness, 0 … 19, so that the service's threads stay
               responsive */
};

/* The submitter fills in a block. It owns the block and everything that the block points to until
 * `done` is called. */
struct mo_block {
  const struct mo_body *body; /* NULL: the worker builds it from lattice and genotype */
  const struct mo_lattice *lattice;
  const uint64_t *genotype; /* placed; used when body is NULL */
  struct mo_compute_controller *controller;
  const struct mo_environment *environments[MO_BLOCK_LANES];
  uint32_t n_environments;
  struct mo_physics physics;
  enum mo_precision precision;
  enum mo_urgency urgency;
  enum mo_back_end back_end;             /* MO_ON_DEVICE: if devices support it, see below */
  const struct mo_recording *recordings; /* NULL or (n_environments) */
  const struct mo_measuring *measuring;  /* NULL, or of n_environments rollouts */
  struct mo_states states;               /* all NULL: the usual start, and no final states */
  const volatile int *cancel; /* NULL or a flag; non-zero stops the block with MO_ERR_CANCELLED */
  int64_t tag; /* chosen by the submitter, such as a job's id: the thread's tag while the block
                  runs */
  struct mo_compute_share
      *share; /* charged for the block's worker time; NULL: the back end's own share, of weight 1 */
  /* Results. */
  struct mo_outcome outcomes[MO_BLOCK_LANES];
  int status;                   /* MO_OK, MO_ERR_CANCELLED, MO_ERR_NO_MEMORY, MO_ERR_DEVICE, … */
  enum mo_back_end computed_on; /* with MO_OK */
  int64_t origin; /* with MO_OK: the `origin` of the remote taker's result; 0 = this machine */
  /* Called once, on a worker's or a device's thread, after the results have been written. Must be
   * short; may free the block. */
  void (*done)(struct mo_block *block, void *context);
  void *context;
  /* Private to the back end. */
  struct mo_block *next;
  struct mo_gradient_task *gradient;
  struct mo_device_task *shards;
  bool stays; /* cannot be computed by remote takers */
};

struct mo_compute_stats {
  uint32_t n_workers, n_busy;
  uint64_t blocks_done;                                     /* scoring and gradient blocks */
  uint64_t rollouts_done, rollout_steps, rollouts_diverged; /* only of scoring blocks */
  uint64_t blocks_preempted; /* urgent blocks that interrupted another block */
  uint64_t gradient_robots_done, gradient_robots_diverged, gradient_robots_zeroed;
  uint64_t queued_batch, queued_interactive;
  double busy_s;           /* worker seconds spent inside blocks */
  size_t worker_bytes_max; /* largest scratch of one worker */
};

/* Time spent computing with a controller since the start, for one kind of work. The first members
 * identify the kind. Work that failed, was cancelled or ran in other processes does not count; nor
 * do rollouts with recordings, measures or states, which take longer. */
struct mo_rate {
  bool is_gradient; /* rollouts with their gradients */
  enum mo_back_end back_end;
  enum mo_precision precision;
  enum mo_integrator integrator;
  double dt_s, control_period_s;
  uint64_t blocks;       /* a block has one body, or the robots of a gradient; on devices: calls */
  uint64_t rollouts;     /* or robots, of gradients */
  uint64_t steps;        /* sum over rollouts */
  uint64_t spring_steps; /* sum over rollouts: steps × springs */
  double busy_s;         /* CPU or device seconds */
};
enum { MO_RATES_MAX = 64 }; /* further kinds of work replace the least recently used kind */

/* Creates the CPU back end. MO_ERR_NO_MEMORY, MO_ERR_UNSUPPORTED (isa). */
int mo_compute_create_cpu(const struct mo_compute_config *config, struct mo_compute **compute);
/* Cancels queued and running blocks (their `done` gets MO_ERR_CANCELLED) and joins the workers.
 * NULL-safe. */
void mo_compute_free(struct mo_compute *compute);

/* Gives the calling thread batch scheduling and the workers' niceness; threads that it starts later
 * inherit both. For a thread that computes but is not a worker. Call it at most once per thread; it
 * cannot be undone. */
void mo_compute_lower_priority(const struct mo_compute *compute);

/* Does not copy `controller` (NULL: passive bodies), which must outlive the result. */
int mo_compute_controller_create(struct mo_compute *compute, const struct mo_controller *controller,
                                 struct mo_compute_controller **ret);
/* Call it only when no block uses the controller, and, with devices, before mo_compute_free.
 * NULL-safe. */
void mo_compute_controller_free(struct mo_compute_controller *controller);

/* ---- shares: how the workers' time is divided among submitters ---- */

/* While several shares have waiting blocks, each gets worker time in proportion to its weight, no
 * matter how long its blocks run or how many wait. A share without waiting blocks leaves its time
 * to the others. Blocks of one share start in order of submission. The order affects when a result
 * arrives, but never its bits. Keep two blocks per worker submitted: a share with no block waiting
 * cannot use a large fraction of the time. Urgent blocks (MO_INTERACTIVE) still go first and are
 * charged to no share; their time is subtracted from the block that they interrupted. */
#define MO_SHARE_WEIGHT_MIN 1e-3
#define MO_SHARE_WEIGHT_MAX 1e6 /* one job has at most 1000; a share may stand for many jobs */

/* Creates a share; a weight outside the range is clamped to it. MO_ERR_NO_MEMORY. */
int mo_compute_share_create(struct mo_compute *compute, double weight,
                            struct mo_compute_share **share);
/* Call it only when no block of the share is queued or running (`done` has begun for each), before
 * or after mo_compute_free. NULL-safe. */
void mo_compute_share_free(struct mo_compute_share *share);
void mo_compute_share_set_weight(struct mo_compute_share *share,
                                 double weight); /* takes effect at once */

struct mo_compute_share_stats {
  double busy_s;    /* CPU time in its blocks, without urgent blocks that interrupted them */
  double urgent_s;  /* part of busy_s spent in the share's own urgent blocks, which is charged to no
                       share */
  double device_s;  /* seconds of devices in its blocks and gradients */
  uint64_t waiting; /* waiting batch blocks */
  uint64_t blocks_done; /* including urgent ones */
};
void mo_compute_share_get_stats(const struct mo_compute_share *share,
                                struct mo_compute_share_stats *stats); /* lock-free */

/* Sets the budget of a worker's scratch for gradients, initially MO_GRADIENT_DEFAULT_BYTES. It
 * applies to scratch that workers create later, and changes no bit of a result. */
void mo_compute_set_gradient_bytes(struct mo_compute *compute, size_t bytes);
/* Makes workers free their gradient scratch. Call it when no gradients are expected soon; a later
 * gradient reallocates its scratch. */
void mo_compute_trim(struct mo_compute *compute);

/* Queues a block and returns at once. Environments and physics must have been checked
 * (mo_environment_check, mo_physics_check). Fails only after mo_compute_free has begun
 * (MO_ERR_CANCELLED) or, for a block that requires a device, if no device works (MO_ERR_DEVICE). */
int mo_compute_submit(struct mo_compute *compute, struct mo_block *block);

/* Mark the beginning and end of a series of submissions: devices then wait for the last block (50
 * ms at most) instead of starting with the first few. */
void mo_compute_begin_blocks(struct mo_compute *compute);
void mo_compute_end_blocks(struct mo_compute *compute);

/* Submits blocks and waits for all of them. Returns the error of the first block that failed, by
 * position. For tools and tests. */
int mo_compute_run(struct mo_compute *compute, struct mo_block *blocks, size_t n);

/* ---- gradients ---- */

/* A batch of different robots, each with its own environment. The caller fills it in, and owns
 * everything that it points to. */
struct mo_gradient_batch {
  const struct mo_controller *controller;
  const struct mo_robot *robots; /* (n) */
  uint32_t n;                    /* 1 … 65536 */
  struct mo_physics physics;
  struct mo_gradient_options options; /* weight: of each robot's gradient; 0: 1 / n */
  enum mo_urgency urgency; /* MO_INTERACTIVE: runs before all waiting batch blocks, without
                              interrupting a running one */
  const volatile int *cancel;
  int64_t tag;
  struct mo_compute_share *share; /* as in a block */
  enum mo_back_end back_end;
  bool is_arranged; /* on the CPU: the robots already have the order of mo_gradient_arrange */
  bool is_strict;   /* on devices: MO_ERR_UNSUPPORTED if they do not support the batch */
  /* Results. */
  enum mo_back_end computed_on;
  double *d_parameters; /* (n_parameters) the gradient of the mean loss over all n robots; those
                           that diverged or were zeroed count as 0 */
  struct mo_outcome *outcomes; /* (n) */
  struct mo_gradient_counts counts;
};
#define MO_GRADIENT_SHARD 1024

/* Computes the gradient of a batch and waits for it; call it from a thread that may block. The
 * batch is cut into blocks of MO_GRADIENT_ROBOTS, in the order of mo_gradient_arrange. Results are
 * added in float64: blocks in order within shards of MO_GRADIENT_SHARD robots, then the shards in
 * order. The bits are therefore the same for any number of workers. Urgent scoring blocks can
 * interrupt a gradient block. Remote takers compute whole shards, see below.
 *
 * `state` keeps data from one call to the next: a pack, and at most two float32 gradients per
 * worker. Create one state per training run. Only one call at a time may use it, and that call must
 * have returned before mo_compute_free.
 *
 * Environments, physics and options must have been checked (mo_gradient_options_check).
 * MO_ERR_INVALID (a body of a different workspace), MO_ERR_NO_MEMORY, MO_ERR_CANCELLED,
 * MO_ERR_DEVICE. On error the results are undefined.
 *
 * On devices a shard is 1024 consecutive robots in the order of the batch, with a float32 sum.
 * Shards are spread over the devices and added in float64 in order: the same bits for any number of
 * devices. Devices ignore `urgency`. If devices do not support the batch, the workers compute all
 * of it, unless the batch is strict. */
struct mo_gradient_state;
int mo_gradient_state_create(struct mo_compute *compute, struct mo_gradient_state **state);
void mo_gradient_state_free(struct mo_gradient_state *state); /* NULL-safe; before the compute */
int mo_compute_gradient(struct mo_gradient_state *state, struct mo_gradient_batch *batch);
/* Lays out the robots of the next gradient before its weights are known, so that devices do not
 * have to wait for the layout. Call it from another thread while mo_compute_gradient computes the
 * previous one. The robots and what they point to must not change until their gradient is computed
 * or mo_compute_gradient_forget is called. Only the newest layout is kept. Changes no bit; does
 * nothing without devices. On error the gradient works as if this had not been called. */
int mo_compute_gradient_lay_out(struct mo_gradient_state *state, const struct mo_robot *robots,
                                uint32_t n, const struct mo_physics *physics);
void mo_compute_gradient_forget(
    struct mo_gradient_state *state); /* call it before changing robots that were laid out */
/* Same as mo_compute_fingerprint, for gradients. */
const char *mo_compute_gradient_fingerprint(const struct mo_compute *compute);

/* ---- remote takers: machines that compute blocks from this back end's queues ---- */

/* Work taken by a remote taker. It is either blocks: batch blocks in float32, without recordings
 * and states, with `body` NULL, all of one share, one controller and one physics, and either all
 * with all measures or all without measures; the submitters still own them. Or it is one shard of a
 * gradient on the CPU or on expected devices, if the batch has a share, is not urgent, and includes
 * the genotypes of its robots. */
struct mo_taken {
  enum mo_back_end back_end;
  uint32_t n_blocks, n_rows;              /* a row is one rollout; a shard counts as one block */
  struct mo_block *const *blocks;         /* (n_blocks) */
  const struct mo_gradient_batch *shard;  /* NULL: blocks; its robots are arranged */
  const struct mo_controller *controller; /* of all blocks; NULL: passive bodies */
  const void *identity; /* identifies the controller while any of its work is taken */
  /* Private to the back end below this line. */
};
/* Results of blocks that were taken, or of a shard. */
struct mo_remote_result {
  int status;                 /* MO_OK, or an error for all blocks */
  const double *losses;       /* (n_rows) in the order of blocks and environments; with MO_OK */
  const uint32_t *diverged;   /* (n_rows) steps of divergence; 0: none */
  int64_t origin;             /* the machine that computed it, as numbered by the taker; > 0 */
  double busy_s;              /* CPU time, charged to the share */
  const double *d_parameters; /* of a shard: (n_parameters) its sum */
  struct mo_gradient_counts counts;
  const double (*measures)[MO_MEASURES]; /* (n_rows) all measures, for blocks that measure */
};
/* Takes at least one block, and more while their rollout steps stay within max_steps; or a shard,
 * regardless of its size. Does not wait. Returns NULL if there is no suitable block, or if out of
 * memory. Put back or deliver each `taken` exactly once, before mo_compute_free. */
struct mo_taken *mo_compute_take(struct mo_compute *compute, enum mo_back_end back_end,
                                 uint64_t max_steps);
/* Puts the blocks back at the front of their share, charges nothing, and frees `taken`. A shard
 * that was put back three times, or delivered with an error, is computed by the workers. A shard
 * for expected devices that was put back 32 times ends its batch with MO_ERR_DEVICE. */
void mo_compute_put_back(struct mo_compute *compute, struct mo_taken *taken);
/* Puts back blocks that remote takers cannot compute, and excludes them from remote takers
 * permanently. After a shard for devices, the workers compute its entire gradient. */
void mo_compute_keep(struct mo_compute *compute, struct mo_taken *taken);
/* Splits off the second half of the blocks as another `taken`. Returns NULL if `taken` has only one
 * block, or if out of memory. */
struct mo_taken *mo_compute_split(struct mo_compute *compute, struct mo_taken *taken);
/* Returns whether every block is cancelled. */
bool mo_taken_is_cancelled(const struct mo_taken *taken);
/* Delivers results, calls `done` of each block, and frees `taken`. Outcomes lack centers of mass.
 * Cancelled blocks end as cancelled. */
void mo_compute_deliver(struct mo_compute *compute, struct mo_taken *taken,
                        const struct mo_remote_result *result);
/* Sets how many blocks the remote takers of a back end can hold in total, initially 0. Submitters
 * keep that many more blocks submitted. */
void mo_compute_want_remote(struct mo_compute *compute, enum mo_back_end back_end, uint32_t blocks);
uint32_t mo_compute_remote_wanted(const struct mo_compute *compute, enum mo_back_end back_end);
/* Returns the number of rollout steps in waiting blocks that are suitable for remote takers. */
uint64_t mo_compute_remote_waiting(struct mo_compute *compute, enum mo_back_end back_end);
/* Leaves suitable blocks to remote takers: workers take only the others. */
void mo_compute_leave_remote(struct mo_compute *compute, bool leave);
/* Sets a callback for the first suitable block that is queued after mo_compute_take found none. It
 * runs with a lock held: it must be short and must not call any function of this room. Set it
 * before the first block. NULL removes it; when this function returns, no call is in progress. */
void mo_compute_watch_remote(struct mo_compute *compute, void (*arrived)(void *context),
                             void *context);

/* Opens a queue for devices that exist only on other machines: remote takers compute all of its
 * blocks, which wait until a taker connects. Call it once, instead of mo_compute_add_devices, and
 * equally early. MO_ERR_CONFLICT: devices already exist; MO_ERR_NO_MEMORY. */
int mo_compute_expect_devices(struct mo_compute *compute);
bool mo_compute_expects_devices(const struct mo_compute *compute);
/* Sets the class of expected devices permanently: the fingerprints of its scores and gradients.
 * Until then, no block is accepted. Only one thread may call it at a time. MO_ERR_CONFLICT: the
 * class is already set; MO_ERR_LIMIT: too long. */
int mo_compute_name_devices(struct mo_compute *compute, const char *scores, const char *gradients);
/* Returns whether blocks for devices are accepted: a device works, or the class of expected devices
 * is set. */
bool mo_compute_serves_devices(const struct mo_compute *compute);
/* Returns whether suitable blocks are left to remote takers, but no taker is connected. */
bool mo_compute_lacks_takers(const struct mo_compute *compute, enum mo_back_end back_end);

/* ---- devices: GPUs, through a module that is loaded at run time ---- */

/* Blocks with MO_ON_DEVICE wait in one queue for all devices, in which shares have the same weights
 * as for workers. A device takes many blocks at once, all of one share, one controller and one
 * physics; fewer if it lacks memory. MO_INTERACTIVE blocks go first. The workers compute what
 * devices cannot: blocks in float64 or with recordings, and blocks that the module does not
 * support. The choice depends only on the block, and `computed_on` reports it. A device that fails
 * is lost, and its work moves to the other devices. If no device is left, all queued and later work
 * fails with MO_ERR_DEVICE. */
enum mo_device_state { MO_DEVICE_WORKS = 0, MO_DEVICE_LOST = 1 };

struct mo_device_status {
  uint32_t index;                       /* among the module's devices */
  char name[96], id[48];                /* "NVIDIA H200"; UUID or PCI bus id */
  uint64_t memory_bytes, free_bytes;    /* free: recent, not current */
  uint32_t multiprocessors, capability; /* 90: compute capability 9.0 */
  enum mo_device_state state;
  char error[256]; /* why it was lost */
  bool is_busy;
  double load;   /* fraction of roughly the last ten seconds that it was busy */
  double busy_s; /* since the start */
  uint64_t rollouts_done, gradient_robots_done, calls;
  uint32_t rows_at_once; /* largest number of rollouts in one call; lowered if memory runs out */
};

struct mo_devices_config {
  const char *module;      /* path of the shared object */
  const uint32_t *devices; /* (n) indices of devices to open; NULL: all that can be opened */
  uint32_t n;
  /* Called when a device is lost and, while devices are added, for each device that is left out.
   * Runs on a separate thread. Nullable. */
  void (*lost)(void *context, const struct mo_device_status *status);
  void *context;
};

/* Loads a module and opens its devices. Call it once, before creating shares, controllers and
 * blocks. Devices whose compute capability differs from that of the first opened device are left
 * out, because their bits differ. MO_ERR_NOT_FOUND: no such file; MO_ERR_UNSUPPORTED: not a module,
 * or a module for a different version of this program; MO_ERR_EXHAUSTED: no working device;
 * MO_ERR_RANGE: no such device; MO_ERR_DEVICE: a device in `devices` cannot be opened, or its
 * capability differs from the first; MO_ERR_CONFLICT: devices have already been added;
 * MO_ERR_NO_MEMORY. After an error there are no devices. */
int mo_compute_add_devices(struct mo_compute *compute, const struct mo_devices_config *config,
                           struct mo_message *message);
uint32_t mo_compute_devices(const struct mo_compute *compute);         /* including lost ones */
uint32_t mo_compute_devices_working(const struct mo_compute *compute); /* without lost ones */
/* MO_ERR_RANGE: position is not below mo_compute_devices. */
int mo_compute_device(struct mo_compute *compute, uint32_t position,
                      struct mo_device_status *status);
/* Like the fingerprints below, for scores and gradients that devices compute, such as "cuda float32
 * score 4 sm90". NULL: no devices, or their class is not set yet. */
const char *mo_compute_device_fingerprint(const struct mo_compute *compute);
const char *mo_compute_device_gradient_fingerprint(const struct mo_compute *compute);

/* ---- facts ---- */

/* Statistics of the workers. Lock-free reads. */
void mo_compute_get_stats(const struct mo_compute *compute, struct mo_compute_stats *stats);
/* Copies the rates; returns their number. */
uint32_t mo_compute_get_rates(struct mo_compute *compute, struct mo_rate rates[MO_RATES_MAX]);
/* Describes what the bits of a result depend on in addition to its inputs (back end, instruction
 * set, code version), such as "cpu avx512 float32 …". */
const char *mo_compute_fingerprint(const struct mo_compute *compute, enum mo_precision precision);

#ifdef __cplusplus
}
#endif
#endif
