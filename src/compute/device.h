/* device.h: what a module that computes on devices offers to the compute room: one table of
 * functions.
 *
 * A module is a shared object that is loaded at run time (devices.c); it exports one symbol,
 * mo_device_module. Everything that knows of queues, shares, several devices and jobs is on this
 * side of the table; a module knows rows, weights and one device at a time. Calls on one device
 * come from one thread at a time, calls on different devices at the same time. `lay_out`,
 * `layout_free`, `allocate` and `release` may be called from any thread, also while a device is in
 * a call.
 *
 * Same bits: the outcome of a row depends on its body, environment, controller, physics and
 * precision alone: not on its neighbours in the call, nor on the device's number; two runs give the
 * same bits.
 *
 * Errors: MO_ERR_NO_MEMORY   of the device or the host: the caller tries again with fewer rows
 *         MO_ERR_DEVICE      the device is lost or has failed: nothing more is asked of it but
 * `error`, `controller_free` and `close`, and by a thread that did not know yet, `lay_out` and
 * `allocate`; its layouts and memory are given back MO_ERR_CANCELLED   the flag `cancel` was seen
 *         MO_ERR_UNSUPPORTED a workspace, sensor or option that the kernels do not do: the caller
 * takes the CPU MO_ERR_INVALID     something missing or not finite After an error the results of
 * the call are undefined; after all but MO_ERR_DEVICE the device works on. */
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

#define MO_DEVICE_ABI 3
#define MO_DEVICE_SHARD                                                                            \
  1024 /* consecutive robots of a batch whose gradients are one float32 sum                        \
        */
#define MO_DEVICE_ROWS_MAX 131072

struct mo_device;            /* one opened device */
struct mo_device_controller; /* weights on a device */
struct mo_device_layout;     /* rows of a gradient, laid out before their weights are known */

struct mo_device_info {
  char name[96]; /* "NVIDIA H200" */
  char id[48];   /* the same after a restart: UUID or PCI bus id */
  uint64_t memory_bytes, free_bytes;
  uint32_t multiprocessors;
  uint32_t capability; /* 90: compute capability 9.0 */
};

enum mo_device_precision {
  MO_DEVICE_EXACT = 0, /* products of split float16, float32-like: what scores are computed with */
  MO_DEVICE_FAST = 1   /* plain float16 products */
};

/* Losses of rows. All that it points to is borrowed for the call. */
struct mo_device_score {
  struct mo_device_controller *controller; /* NULL: passive bodies */
  const struct mo_robot *
      robots; /* (n) rows: body, environment; rows of one body adjacent pays, but is not required */
  uint32_t n; /* 1 … MO_DEVICE_ROWS_MAX */
  struct mo_physics physics; /* checked */
  enum mo_device_precision precision;
  const volatile int *cancel; /* NULL or a flag, looked at between launches of at most 100 ms */
  /* Results. */
  struct mo_outcome *outcomes; /* (n) */
  double host_s, device_s;     /* time of host work and of the device */
};

/* Gradients of rows, in shards of MO_DEVICE_SHARD consecutive rows (the last one may be shorter).
 */
struct mo_device_gradient {
  const struct mo_controller *controller; /* uploaded by the call: it changes with each step */
  const struct mo_robot *robots;          /* (n) rows */
  uint32_t n;                             /* 1 … MO_DEVICE_ROWS_MAX */
  struct mo_physics physics;              /* checked */
  struct mo_device_layout
      *layout; /* NULL, or of these very robots and physics: the call finds its rows laid out */
  double adjoint_bound, weight; /* as in mo_gradient_options */
  enum mo_adjoint_rule adjoint_rule;
  double restart_weight;
  const volatile int *cancel; /* as above */
  /* Results. */
  float *d_parameters; /* (shards, n_parameters) each shard's own sum; robots that diverged or were
                        * zeroed count as 0; faster in memory of `allocate` */
  struct mo_outcome *outcomes;      /* (n) */
  struct mo_gradient_counts counts; /* of this call alone */
  double host_s, device_s;
};

struct mo_device_module {
  uint32_t abi;     /* MO_DEVICE_ABI; first for ever */
  const char *name; /* "cuda" */
  const char *score_code, *fast_code,
      *gradient_code; /* versions of the code, for fingerprints: exact, fast, gradient */
  int (*count)(
      uint32_t *n); /* devices of this machine that the module can use; 0 without a driver */
  int (*open)(uint32_t index, struct mo_device **device);
  void (*close)(struct mo_device *device); /* its controllers were freed before; NULL-safe */
  int (*info)(struct mo_device *device, struct mo_device_info *info);
  /* Keeps no reference to `controller`. */
  int (*controller_create)(struct mo_device *device, const struct mo_controller *controller,
                           struct mo_device_controller **ret);
  void (*controller_free)(struct mo_device *device,
                          struct mo_device_controller *controller); /* NULL-safe */
  int (*score)(struct mo_device *device, struct mo_device_score *score);
  int (*gradient)(struct mo_device *device, struct mo_device_gradient *gradient);
  /* Lays out the rows of a gradient to come, for this device and those like it: the call that
   * computes it then begins sooner. The robots stay as they are until that call. *layout: NULL, or
   * one that no call uses any more: its memory is used again. The errors of `gradient`, but for
   * MO_ERR_DEVICE; after one the layout is there, if it was, and is of no robots. */
  int (*lay_out)(const struct mo_device *device, const struct mo_robot *robots, uint32_t n,
                 const struct mo_physics *physics, struct mo_device_layout **layout);
  void (*layout_free)(struct mo_device_layout *layout); /* before its device is closed; NULL-safe */
  /* Memory of the host that devices reach faster, where there is such, else any. NULL: there is
   * none. */
  void *(*allocate)(const struct mo_device *device, size_t bytes);
  void (*release)(void *memory);                        /* before its device is closed; NULL-safe */
  const char *(*error)(const struct mo_device *device); /* text of the last failure; never NULL; the
                                                           device's, until its next call */
};

/* The module's one exported symbol. Static storage. */
__attribute__((visibility("default"))) const struct mo_device_module *mo_device_module(void);

#ifdef __cplusplus
}
#endif
#endif
