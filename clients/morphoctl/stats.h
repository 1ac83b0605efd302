/* stats.h: paired comparison of two controllers over the same designs. */
#ifndef MORPHOCTL_STATS_H
#define MORPHOCTL_STATS_H

#include <stddef.h>

/* Returns the quantile of Student's t distribution: t with P(T ≤ t) = p, for `freedom` > 0 degrees
 * of freedom and 0 < p < 1. */
double student_quantile(double p, double freedom);
/* Returns P(T ≤ t). */
double student_probability(double t, double freedom);

struct paired {
  size_t n;               /* pairs in which both scores are finite; only these count below */
  double mean_a, mean_b;  /* over these pairs; NaN: none */
  double difference;      /* mean of b − a */
  double deviation;       /* standard deviation of b − a; NaN below two pairs */
  double error;           /* its standard error */
  double low, high;       /* confidence interval of the difference; NaN below two pairs */
  size_t improved, equal; /* pairs with b < a, with b = a */
};
/* Compares paired scores. a, b: (n); not finite for a missing score. */
struct paired compare_pairs(const double *a, const double *b, size_t n, double confidence);

#endif
