/* stats.h: comparisons with a confidence interval: of two controllers over the same designs, and of
 * two sets of campaigns. */
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
  size_t n; /* designs with a finite loss in every environment; only these count below */
  double mean_a, mean_b; /* over these designs and all environments; NaN if none */
  double difference;     /* mean of b − a */
  double error;          /* its standard error; NaN with fewer than two designs */
  double freedom;        /* degrees of freedom of the interval */
  double low, high; /* confidence interval of the difference; NaN with fewer than two designs */
  size_t improved, equal; /* designs with a lower mean with b; designs with equal means */
  double sign_p; /* two-sided p of the sign test over the designs that differ; NaN if none */
};
/* Compares the losses of two controllers over the same designs in the same environments. a, b: (n,
 * environments), row by row; not finite if a rollout diverged. With two or more environments the
 * interval holds for other designs in other environments: both are random effects, crossed (mean
 * squares of the two-way layout without replication; Satterthwaite 1946 for the degrees of
 * freedom). With one environment it holds for other designs in that environment. */
struct paired compare_crossed(const double *a, const double *b, size_t n, size_t worlds);

struct interval {
  double difference; /* mean of b − mean of a */
  double low, high;  /* its confidence interval; NaN if a set has fewer than two values */
};
/* Compares the means of two sets that are not paired, by Welch's interval. */
struct interval compare_means(const double *a, size_t n_a, const double *b, size_t n_b);

/* Returns what an interval of score differences says about b, as a word for programs. */
const char *verdict_of(double low, double high);

#endif
