/* statistics.c: sums, Student's t, and intervals of means. */
#include "certificate/statistics.h"

#include <math.h>

#define TABLE 10

double mo_pairwise_sum(const double *values, uint32_t n)
{
  double sum = 0;
  if (n > 8)
    return mo_pairwise_sum(values, n / 2) + mo_pairwise_sum(values + n / 2, n - n / 2);
  for (uint32_t k = 0; k < n; k++)
    sum += values[k];
  return sum;
}

/* Looks t up in a table or, beyond it, uses the expansion in 1 / degrees (Abramowitz & Stegun
 * 26.7.5) around the quantile of the normal distribution. */
double mo_student_t(uint32_t degrees)
{
  static const double table[TABLE] = {
      12.7062047361747, 4.30265272974946, 3.18244630528371, 2.77644510519779, 2.57058183563631,
      2.44691185114497, 2.36462425159278, 2.30600413520417, 2.2621571627982,  2.22813885198627};
  const double x = 1.0 / degrees;
  if (degrees <= TABLE)
    return table[degrees > 0 ? degrees - 1 : 0];
  return 1.959963984540054 +
         x * (2.372271230298562 +
              x * (2.8224986157396112 + x * (2.555849679507722 + x * 1.5895340533938225)));
}

struct mo_mean mo_mean_of_units(const double *values, uint32_t n, uint32_t n_units, double *scratch)
{
  struct mo_mean made = {mo_pairwise_sum(values, n) / n, NAN, n_units < n ? n_units : n};
  const uint32_t units = made.n_units;
  if (units < 2)
    return made;
  for (uint32_t g = 0; g < units; g++) {
    double off = 0;
    for (uint32_t k = g; k < n; k += units)
      off += values[k] - made.mean;
    scratch[g] = off * off;
  }
  made.variance = mo_pairwise_sum(scratch, units) * units / (units - 1) / n / n;
  return made;
}

struct mo_interval mo_mean_interval(const struct mo_mean *mean, double widen)
{
  if (!(mean->n_units >= 2))
    return MO_UNKNOWN_INTERVAL;
  const double half = mo_student_t(mean->n_units - 1) * sqrt(widen * mean->variance);
  return (struct mo_interval){mean->mean - half, mean->mean + half};
}

struct mo_interval mo_welch_interval(const struct mo_mean *a, const struct mo_mean *b)
{
  if (a->n_units < 2 || b->n_units < 2)
    return MO_UNKNOWN_INTERVAL;
  const double variance = a->variance + b->variance, change = a->mean - b->mean;
  const double parts =
      a->variance * a->variance / (a->n_units - 1) + b->variance * b->variance / (b->n_units - 1);
  const double degrees = parts > 0 ? variance * variance / parts : 1;
  const double half = mo_student_t((uint32_t)degrees) * sqrt(variance);
  return (struct mo_interval){change - half, change + half};
}
