/* fixture.h: robots of a batch, blocks to score, and waiting for them. */
#ifndef MORPHO_TESTS_COMPUTE_FIXTURE_H
#define MORPHO_TESTS_COMPUTE_FIXTURE_H

#include "../make.h"

#include <pthread.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <unistd.h>

static struct mo_controller *controller;
static struct mo_lattice *lattice;

static inline void make_scene(void)
{
  lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  controller = make_random_controller(MO_SENSOR_INVERSE_SQRT, 5);
}

/* One design or body in n environments. */
static inline struct mo_block block_of(const uint64_t *genotype, const struct mo_body *body,
                                       struct mo_compute_controller *brain,
                                       const struct mo_environment *environments, uint32_t n,
                                       uint32_t steps)
{
  struct mo_block block = {.lattice = lattice,
                           .genotype = genotype,
                           .body = body,
                           .controller = brain,
                           .n_environments = n,
                           .physics = physics_of(steps),
                           .tag = 1};
  for (uint32_t i = 0; i < n; i++)
    block.environments[i] = environments + i;
  return block;
}

/* Returns whether a counter reaches n within a minute or two. */
static inline bool await(atomic_int *number, int n)
{
  const double late_s = now_s() + 600;
  while (atomic_load(number) != n && now_s() < late_s)
    usleep(200);
  return atomic_load(number) == n;
}

/* Returns the processor time of all threads of this process. */
static inline double processor_s(void)
{
  struct timespec used;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &used);
  return (double)used.tv_sec + 1e-9 * (double)used.tv_nsec;
}

/* A `done` callback that counts. */
static inline void count_one(struct mo_block *block, void *number)
{
  (void)block;
  atomic_fetch_add((atomic_int *)number, 1);
}

/* Submits a block with a `done` that counts. */
static inline void submit_counted(struct mo_compute *compute, struct mo_block *block,
                                  atomic_int *ended)
{
  block->done = count_one;
  block->context = ended;
  make_check(mo_compute_submit(compute, block), "a block");
}

static inline struct mo_compute_stats stats_of(struct mo_compute *compute)
{
  struct mo_compute_stats stats;
  mo_compute_get_stats(compute, &stats);
  return stats;
}

/* Cosine of two arrays, and the ratio of their lengths. */
static inline double cosine_of(const double *a, const double *b, size_t n, double *ratio)
{
  double ab = 0, aa = 0, bb = 0;
  for (size_t i = 0; i < n; i++) {
    ab += a[i] * b[i];
    aa += a[i] * a[i];
    bb += b[i] * b[i];
  }
  *ratio = sqrt(aa / bb);
  return ab / sqrt(aa * bb);
}

#endif
