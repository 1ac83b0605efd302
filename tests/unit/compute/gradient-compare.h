/* gradient-compare.h: a batch's gradient by the fast path and by the float64 reference. Used by a
 * test and by a benchmark. */
#ifndef MORPHO_TESTS_GRADIENT_COMPARE_H
#define MORPHO_TESTS_GRADIENT_COMPARE_H

#include <morpho/compute.h>

struct gradient_likeness {
  double cosine, norm_fast, norm_reference;
};

/* How like each other two ways are, robot by robot: 1 − cosine at the median and the 90th
 * percentile, and the share of robots below 1e-3. */
struct gradient_spread {
  double median, p90, share_alike;
};

struct gradient_comparison {
  struct gradient_likeness all, tensor[MO_CONTROLLER_TENSORS];
  struct gradient_spread robots;
  /* The reference against itself with every light moved by 1e-7 m: what no arithmetic can do better
   * than. Zeros if not asked for. */
  struct gradient_likeness moved_all;
  struct gradient_spread moved_robots;
  struct mo_gradient_counts fast, reference;
  double loss_median, loss_p90,
      loss_most;            /* |difference in loss| over the robots that neither path saw diverge */
  uint32_t diverged_in_one; /* robots that diverged in one of the two alone */
  double fast_s, reference_s; /* wall clock */
};

/* The names of the tensors, in file order. */
extern const char *const gradient_tensor_names[MO_CONTROLLER_TENSORS];

/* options: the weight is not looked at: the gradient is that of the mean. workers: 1 … 64. moved:
 * fills in moved_* too, which takes twice as long. A negative mo_error. */
int gradient_compare(const struct mo_controller *controller, const struct mo_robot *robots,
                     uint32_t n, const struct mo_physics *physics,
                     const struct mo_gradient_options *options, enum mo_isa isa, uint32_t workers,
                     bool moved, struct gradient_comparison *comparison);

#endif
