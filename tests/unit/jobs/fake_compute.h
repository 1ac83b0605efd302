/* fake_compute.h: a back end for tests: made-up losses, fast or slow, and failures on demand.
 *
 * Linked instead of the real one. Like a real loss, a fake loss depends only on its inputs:
 * genotype, environment, physics, precision and the controller's first weights. About one in 30
 * "diverges", with any weights. Some genotypes are a hundred times as good as others, so that races
 * cut children short. */
#ifndef MORPHO_TESTS_FAKE_COMPUTE_H
#define MORPHO_TESTS_FAKE_COMPUTE_H

#include <morpho/compute.h>
#include <stdatomic.h>

struct fake_plan {
  atomic_int delay_us;            /* duration of one block, which checks its cancel flag every 200
µs */
  atomic_int fail_status;         /* 0, or the error of blocks with the genotype below */
  atomic_uint_fast64_t fail_word; /* first word of that genotype; 0 = any */
  atomic_int fail_times;          /* number of blocks that will fail */
  atomic_bool poison;             /* losses are NaN */
  atomic_int skew;                /* added to losses, as if the code had changed */
  atomic_int gradient_delay_us;   /* the same for one batch */
  atomic_int gradient_status;     /* 0, or the error of the next `gradient_fails` batches */
  atomic_int gradient_fails;
  _Atomic(const char *) gradient_fingerprint; /* NULL means "fake gradient" */
  atomic_bool gradient_crash;                 /* raises SIGSEGV in the calling thread */
};
extern struct fake_plan fake_plan;
/* Resets the plan and the history. NULL in programs with the real back end. */
__attribute__((weak)) void fake_reset(void);

/* Counters for finished rollouts of blocks and of gradient batches. They may lie in shared memory;
 * NULL = not counted. */
struct fake_count {
  atomic_uint_fast64_t rollouts, robots;
};
extern struct fake_count *fake_count;

/* Returns the result of a block with these inputs. */
struct mo_outcome fake_outcome(const uint64_t *genotype, const struct mo_controller *controller,
                               const struct mo_environment *environment,
                               const struct mo_physics *physics, enum mo_precision precision);

/* Computes the fake gradient of a batch: a function of the robots and the weights, with a loss per
 * robot. */
void fake_gradient(const struct mo_controller *controller, const struct mo_robot *robots,
                   uint32_t n, double *d_parameters, struct mo_outcome *outcomes,
                   struct mo_gradient_counts *counts);

/* Returns the tags of blocks and gradient batches in the order in which they started. */
size_t fake_history(int64_t *tags, size_t room);

/* Returns the weight of the share of a tag's newest block or batch when it started; 0 if it had no
 * share. */
double fake_weight(int64_t tag);
int fake_shares(void); /* created and not yet freed */

#endif
