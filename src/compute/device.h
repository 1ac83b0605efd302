/* device.h: the table of functions of a module, which computes on devices.
 *
 * A module is a shared object that is loaded at run time (devices.c). It exports one symbol,
 * mo_device_module. Queues, shares, jobs and the use of several devices belong to this side of the
 * table; a module deals only with rows, weights and one device at a time. Calls on one device come
 * from one thread at a time; calls on different devices run concurrently. A device may be opened
 * twice; it then counts as two, and if calls run on both, the one that began first has priority.
 * `lay_out`, `layout_free`, `allocate`, `release` and `controller_free` may be called from any
 * thread, even during a call on a device.
 *
 * The caller has checked the arguments; a module rejects only what its kernels do not support.
 *
 * Same bits: the outcome of a row depends only on its body, environment, controller, physics and
 * the device's compute capability, not on its neighbors in the call or the device's number. Two
 * runs produce the same bits.
 *
 * Errors. After an error the results of the call are undefined; after all but MO_ERR_DEVICE the
 * device still works.
 *   MO_ERR_NO_MEMORY    on the device or the host: the caller retries with fewer rows
 *   MO_ERR_DEVICE       the device is lost or has failed. After that, only `error`,
 *                       `controller_free` and `close` are called, and `lay_out` and `allocate`
 *                       by a thread that has not learned of it yet; its layouts and memory
 *                       are still released
 *   MO_ERR_CANCELLED    the flag `cancel` was set
 *   MO_ERR_INVALID      the control period is not a whole number of steps
 *   MO_ERR_UNSUPPORTED  a workspace, sensor, integrator or option that the kernels lack: the
 *                       caller uses the CPU */
#ifndef MORPHO_COMPUTE_DEVICE_H
#define MORPHO_COMPUTE_DEVICE_H

#include <stddef.h>
#include <stdint.h>

#include <morpho/controller.h>
#include <morpho/error.h>
#include <morpho/gradient.h>
#include <morpho/rollout.h>

#ifdef __cplusplus
extern "C" {
#endif

#define MO_DEVICE_ABI      10
#define MO_DEVICE_SHARD    1024 /* consecutive robots whose gradients are one float32 sum */
#define MO_DEVICE_ROWS_MAX 131072

struct mo_device;            /* one opened device */
struct mo_device_controller; /* weights on a device */
struct mo_device_layout;     /* rows of a gradient, laid out before their weights are known */

struct mo_device_info {
  char name[96]; /* "NVIDIA H200" */
  char id[48];   /* unchanged after a restart: UUID or PCI bus id */
  uint64_t memory_bytes, free_bytes;
  uint32_t multiprocessors;
  uint32_t capability; /* 90: compute capability 9.0 */
};

/* Computes the outcomes of rows, according to the tasks of their environments. All pointers are
 * borrowed for the call. */
struct mo_device_score {
  struct mo_device_controller *controller; /* NULL: passive bodies */
  const struct mo_robot
      *robots; /* (n) rows: body, environment; faster if rows of one body are adjacent */
  uint32_t n;  /* 1 … MO_DEVICE_ROWS_MAX */
  struct mo_physics physics;
  const volatile int *cancel; /* NULL or a flag, read between launches of at most 100 ms */
  /* Results. */
  struct mo_outcome *outcomes;     /* (n) */
  double (*measures)[MO_MEASURES]; /* NULL, or (n): all measures of each row, as mo_rollout_block
                                      writes them; they change no other result */
  double host_s, device_s;         /* time on the host and on the device */
};

/* Computes gradients of rows, in shards of MO_DEVICE_SHARD consecutive rows (the last one may be
 * shorter).
 */
struct mo_device_gradient {
  const struct mo_controller *controller; /* uploaded by the call, because it changes with each
                                             step */
  const struct mo_robot *robots;          /* (n) rows */
  uint32_t n;                             /* 1 … MO_DEVICE_ROWS_MAX */
  struct mo_physics physics;
  struct mo_device_layout *layout; /* NULL, or the finished layout of the same robots and physics */
  struct mo_gradient_options options;
  const volatile int *cancel; /* as above */
  /* Results. */
  float *d_parameters; /* (shards, n_parameters) the sum of each shard; robots that diverged or were
                          zeroed count as 0; faster in memory from `allocate` */
  struct mo_outcome *outcomes;      /* (n) */
  struct mo_gradient_counts counts; /* of this call only */
  double host_s, device_s;
};

struct mo_device_module {
  uint32_t abi;     /* MO_DEVICE_ABI; stays the first member in every version */
  const char *name; /* "cuda" */
  const char *score_code, *gradient_code; /* code versions; with the capability they identify the
                                             bits */
  int (*count)(uint32_t *n);              /* usable devices on this machine; 0 without a driver */
  int (*open)(uint32_t index, struct mo_device **device);
  void (*close)(struct mo_device *device); /* after its controllers are freed; NULL-safe */
  int (*info)(struct mo_device *device, struct mo_device_info *info);
  /* Keeps no reference to `controller`. */
  int (*controller_create)(struct mo_device *device, const struct mo_controller *controller,
                           struct mo_device_controller **ret);
  void (*controller_free)(struct mo_device *device,
                          struct mo_device_controller *controller); /* NULL-safe */
  int (*score)(struct mo_device *device, struct mo_device_score *score);
  int (*gradient)(struct mo_device *device, struct mo_device_gradient *gradient);
  /* Lays out the rows of a later gradient, for this device and others like it, so that its call
   * starts sooner. The robots must not change until that call. *layout: NULL, or a layout that no
   * call uses any longer; its memory is reused. Errors as in `gradient`, except MO_ERR_DEVICE.
   * After an error, an existing layout remains allocated, but contains no robots. */
  int (*lay_out)(const struct mo_device *device, const struct mo_robot *robots, uint32_t n,
                 const struct mo_physics *physics, struct mo_device_layout **layout);
  void (*layout_free)(struct mo_device_layout *layout); /* before its device is closed; NULL-safe */
  /* Allocates host memory that devices access faster, if the module has such memory. Returns NULL
   * if memory runs out. */
  void *(*allocate)(const struct mo_device *device, size_t bytes);
  void (*release)(void *memory); /* before its device is closed; NULL-safe */
  const char *(*error)(
      const struct mo_device *device); /* text of the last failure; never NULL; owned by the device,
                                          valid until its next call */
};

/* The module's one exported symbol. Static storage. */
__attribute__((visibility("default"))) const struct mo_device_module *mo_device_module(void);

#ifdef __cplusplus
}
#endif
#endif
