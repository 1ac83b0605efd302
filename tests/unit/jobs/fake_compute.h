/* fake_compute.h: a back end for tests: made-up losses, at once or slowly, wrong on demand.
 *
 * Linked in place of the real one. A loss depends on genotype, environment, physics, precision and
 * the controller's first weights alone, like a real one; one in about 30 "diverges", under any
 * weights. Some genotypes are a hundred times as good as others, so that races cut children short.
 */
#ifndef MORPHO_TESTS_FAKE_COMPUTE_H
#define MORPHO_TESTS_FAKE_COMPUTE_H

#include <morpho/compute.h>
#include <stdatomic.h>

struct fake_plan {
  atomic_int delay_us;            /* of one block; it looks at its cancel flag every 200 µs */
  atomic_int fail_status;         /* 0, or what blocks of the genotype below end with */
  atomic_uint_fast64_t fail_word; /* first word of that genotype; 0: of any */
  atomic_int fail_times;          /* blocks left to fail */
  atomic_bool poison;             /* losses are NaN */
  atomic_int skew;                /* added to losses: as if the code had changed */
  atomic_int gradient_delay_us;   /* of one batch; it looks at its cancel flag every 200 µs */
  atomic_int gradient_status;     /* 0, or what the next `gradient_fails` batches end with */
  atomic_int gradient_fails;
  _Atomic(const char *) gradient_fingerprint; /* NULL: "fake gradient" */
  atomic_bool gradient_crash;                 /* the calling thread gets a SIGSEGV */
};
extern struct fake_plan fake_plan;
/* Forgets the plan and the history. NULL in programs with the real back end. */
__attribute__((weak)) void fake_reset(void);

/* Counts the rollouts of blocks and of batches of gradients when they are finished; may lie in
 * memory that processes share; NULL: not. */
struct fake_count {
  atomic_uint_fast64_t rollouts, robots;
};
extern struct fake_count *fake_count;

/* What a block with these inputs gives. */
struct mo_outcome fake_outcome(const uint64_t *genotype, const struct mo_controller *controller,
                               const struct mo_environment *environment,
                               const struct mo_physics *physics, enum mo_precision precision);

/* The fake gradient of a batch: a function of the robots and of the weights, with a loss per robot.
 */
void fake_gradient(const struct mo_controller *controller, const struct mo_robot *robots,
                   uint32_t n, double *d_parameters, struct mo_outcome *outcomes,
                   struct mo_gradient_counts *counts);

/* Order in which blocks and batches of gradients were started: their tags. */
size_t fake_history(int64_t *tags, size_t room);

/* The weight that the share of a tag's newest block or batch had then; 0: it named none. */
double fake_weight(int64_t tag);
int fake_shares(void); /* that were made and not freed */

#endif
