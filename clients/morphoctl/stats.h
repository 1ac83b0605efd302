/* stats.h: paired comparison of two controllers over the same designs. */
#ifndef MORPHOCTL_STATS_H
#define MORPHOCTL_STATS_H

#include <stddef.h>

/* Quantile of Student's t distribution: P(T ≤ t) = p with `freedom` > 0 degrees of freedom, 0 < p
 * < 1. */
double student_quantile(double p, double freedom);
/* P(T ≤ t). */
double student_probability(double t, double freedom);

struct paired {
  size_t n; /* pairs of which both are finite; the others are left out of what follows */
  double mean_a, mean_b;  /* over these pairs; NaN: there are none */
  double difference;      /* mean of b − a */
  double deviation;       /* standard deviation of b − a; NaN below two pairs */
  double error;           /* its standard error */
  double low, high;       /* confidence interval of the difference; NaN below two pairs */
  size_t improved, equal; /* pairs with b < a, with b = a */
};
/* a, b: (n) scores, not finite where there is none. */
struct paired compare_pairs(const double *a, const double *b, size_t n, double confidence);

#endif
