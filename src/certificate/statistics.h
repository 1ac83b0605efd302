/* statistics.h: sums, intervals of means, and rank correlation with its interval. */
#ifndef MORPHO_CERTIFICATE_STATISTICS_H
#define MORPHO_CERTIFICATE_STATISTICS_H

#include <morpho/certificate.h>

#define MO_UNKNOWN_INTERVAL ((struct mo_interval){NAN, NAN})

/* Returns the sum, computed pairwise: the sum of both halves, each of which is summed in the same
 * way. */
double mo_pairwise_sum(const double *values, uint32_t n);
/* Returns the t with P(|T| < t) = 0.95 for Student's distribution, to six digits; degrees ≥ 1. */
double mo_student_t(uint32_t degrees);

/* A mean and its uncertainty. */
struct mo_mean {
  double mean;
  double variance;  /* of the mean; NaN for a single unit */
  uint32_t n_units; /* independent ones */
};
/* Values k, k + n_units, … belong to one unit. scratch: (n). */
struct mo_mean mo_mean_of_units(const double *values, uint32_t n, uint32_t n_units,
                                double *scratch);
/* Returns mean ± t · sqrt(widen · variance of the mean). */
struct mo_interval mo_mean_interval(const struct mo_mean *mean, double widen);
/* Returns Welch's interval of a − b. */
struct mo_interval mo_welch_interval(const struct mo_mean *a, const struct mo_mean *b);

/* kendall.c: the mean of tau over several lists of scores of the same designs and, for its
 * jackknife, the same mean with each design left out. Begin with zeros; `without` has room for one
 * number per design. */
struct mo_kendall {
  uint32_t n_designs, n_lists;
  double tau;    /* sum over lists */
  double untied; /* the same sum, but of the pairs that can differ */
  double *without;
};
/* Adds tau-b of (n_designs) pairs of finite scores. */
void mo_kendall_add(struct mo_kendall *kendall, const double *base, const double *here);
double mo_kendall_tau(const struct mo_kendall *kendall);
struct mo_interval mo_kendall_interval(const struct mo_kendall *kendall);

#endif
