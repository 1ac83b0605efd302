/* stats.h: comparisons with an interval: of two controllers over the same designs, and of two sets
 * of campaigns. */
#ifndef MORPHOCTL_STATS_H
#define MORPHOCTL_STATS_H

#include <stddef.h>

#define CONFIDENCE 0.95 /* of all intervals */

/* Returns the quantile of Student's t distribution: t with P(T ≤ t) = p, for `freedom` > 0 degrees
 * of freedom and 0 < p < 1. */
double student_quantile(double p, double freedom);
/* Returns P(T ≤ t). */
double student_probability(double t, double freedom);

struct paired {
  size_t n;               /* pairs in which both scores are finite; only these count below */
  double mean_a, mean_b;  /* over these pairs; NaN: none */
  double difference;      /* mean of b − a */
  double error;           /* its standard error; NaN below two pairs */
  double low, high;       /* confidence interval of the difference; NaN below two pairs */
  size_t improved, equal; /* pairs with b < a, with b = a */
};
/* Compares paired scores. a, b: (n); not finite for a missing score. */
struct paired compare_pairs(const double *a, const double *b, size_t n);

struct interval {
  double difference; /* mean of b − mean of a */
  double low, high;  /* its confidence interval; NaN: a set has fewer than two values */
};
/* Compares the means of two sets that are not paired, by Welch's interval. */
struct interval compare_means(const double *a, size_t n_a, const double *b, size_t n_b);

/* Returns what an interval of score differences says of b, as a word for programs. */
const char *verdict_of(double low, double high);

#endif
