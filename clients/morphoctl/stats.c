/* stats.c: see stats.h.
 *
 * The t distribution uses the regularized incomplete beta function: with x = ν/(ν + t²), P(|T| > t)
 * = I_x(ν/2, 1/2). I_x is computed by its continued fraction (from the front, modified Lentz), on
 * the side of the mean where the fraction converges fast. Quantiles are found by bisection, to the
 * last bits of a double. */
#include "stats.h"

#include <float.h>
#include <math.h>
#include <stdbool.h>

/* Returns the continued fraction of I_x(a, b), for x below (a + 1)/(a + b + 2). */
static double beta_fraction(double a, double b, double x)
{
  const double tiny = 1e-300;
  double c = 1, d = 1 - (a + b) * x / (a + 1);
  d = 1 / (fabs(d) < tiny ? tiny : d);
  double value = d;
  for (int m = 1; m <= 10000; m++) {
    double even = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m));
    double odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1));
    double change = 1;
    for (int half = 0; half < 2; half++) {
      double term = half == 0 ? even : odd;
      d = 1 + term * d;
      d = 1 / (fabs(d) < tiny ? tiny : d);
      c = 1 + term / c;
      c = fabs(c) < tiny ? tiny : c;
      change = c * d;
      value *= change;
    }
    if (fabs(change - 1) < DBL_EPSILON)
      break;
  }
  return value;
}

/* Returns I_x(a, b). y = 1 − x, exact where x is near 1. */
static double incomplete_beta(double a, double b, double x, double y)
{
  if (x <= 0 || y <= 0)
    return x <= 0 ? 0 : 1;
  double front = exp(lgamma(a + b) - lgamma(a) - lgamma(b) + a * log(x) + b * log(y));
  if (x < (a + 1) / (a + b + 2))
    return front * beta_fraction(a, b, x) / a;
  return 1 - front * beta_fraction(b, a, y) / b;
}

double student_probability(double t, double freedom)
{
  double square = t * t, tails = incomplete_beta(freedom / 2, 0.5, freedom / (freedom + square),
                                                 square / (freedom + square));
  return t > 0 ? 1 - tails / 2 : tails / 2;
}

double student_quantile(double p, double freedom)
{
  if (p < 0.5)
    return -student_quantile(1 - p, freedom);
  double low = 0, high = 1;
  while (student_probability(high, freedom) < p && high < 1e300)
    high *= 2;
  for (int i = 0; i < 200; i++) {
    double middle = low + (high - low) / 2;
    if (middle <= low || middle >= high)
      break;
    if (student_probability(middle, freedom) < p)
      low = middle;
    else
      high = middle;
  }
  return low + (high - low) / 2;
}

/* Returns the two-sided p of `lower` successes in n trials with even odds. */
static double sign_test(size_t lower, size_t n)
{
  const double least = (double)(lower < n - lower ? lower : n - lower);
  return n == 0 ? NAN : fmin(1, 2 * incomplete_beta((double)n - least, least + 1, 0.5, 0.5));
}

/* Returns whether the design has a finite loss with both controllers in every environment. */
static bool is_whole(const double *a, const double *b, size_t worlds)
{
  for (size_t w = 0; w < worlds; w++)
    if (!isfinite(a[w]) || !isfinite(b[w]))
      return false;
  return true;
}

static double mean_difference(const double *a, const double *b, size_t worlds)
{
  double sum = 0;
  for (size_t w = 0; w < worlds; w++)
    sum += b[w] - a[w];
  return sum / (double)worlds;
}

/* Returns the mean difference in one environment over the designs that count. */
static double world_difference(const double *a, const double *b, size_t n, size_t worlds,
                               size_t world, double count)
{
  double sum = 0;
  for (size_t i = 0; i < n; i++)
    if (is_whole(a + i * worlds, b + i * worlds, worlds))
      sum += b[i * worlds + world] - a[i * worlds + world];
  return sum / count;
}

/* Fills in the standard error and its degrees of freedom from the mean squares of designs,
 * environments and residuals. */
static void find_error(struct paired *paired, const double *a, const double *b, size_t n,
                       size_t worlds)
{
  const double designs = (double)paired->n, all = designs * (double)worlds;
  double of_designs = 0, of_worlds = 0, rest = 0;
  for (size_t i = 0; i < n; i++)
    if (is_whole(a + i * worlds, b + i * worlds, worlds)) {
      const double off =
          mean_difference(a + i * worlds, b + i * worlds, worlds) - paired->difference;
      of_designs += (double)worlds * off * off;
    }
  of_designs /= designs - 1;
  paired->freedom = designs - 1;
  paired->error = sqrt(of_designs / all);
  if (worlds < 2)
    return;
  for (size_t w = 0; w < worlds; w++) {
    const double mean = world_difference(a, b, n, worlds, w, designs);
    of_worlds += designs * (mean - paired->difference) * (mean - paired->difference);
    for (size_t i = 0; i < n; i++) {
      const double *one = a + i * worlds, *other = b + i * worlds;
      if (!is_whole(one, other, worlds))
        continue;
      const double left =
          other[w] - one[w] - mean - mean_difference(one, other, worlds) + paired->difference;
      rest += left * left;
    }
  }
  const double world_freedom = (double)worlds - 1, rest_freedom = (designs - 1) * world_freedom;
  of_worlds /= world_freedom;
  rest /= rest_freedom;
  /* A component with an estimate below 0 counts as 0. */
  const double total = of_designs + of_worlds - fmin(rest, fmin(of_designs, of_worlds));
  const double squares = of_designs * of_designs / (designs - 1) +
                         of_worlds * of_worlds / world_freedom + rest * rest / rest_freedom;
  paired->error = sqrt(total / all);
  paired->freedom = squares > 0 ? fmax(1, total * total / squares) : designs - 1;
}

struct paired compare_crossed(const double *a, const double *b, size_t n, size_t worlds)
{
  struct paired paired = {.mean_a = NAN,
                          .mean_b = NAN,
                          .difference = NAN,
                          .error = NAN,
                          .freedom = NAN,
                          .low = NAN,
                          .high = NAN,
                          .sign_p = NAN};
  double sum_a = 0, sum_b = 0, sum = 0;
  for (size_t i = 0; i < n; i++) {
    const double *one = a + i * worlds, *other = b + i * worlds;
    if (worlds == 0 || !is_whole(one, other, worlds))
      continue;
    const double difference = mean_difference(one, other, worlds);
    paired.n++;
    paired.improved += difference < 0;
    paired.equal += difference == 0;
    sum += difference;
    for (size_t w = 0; w < worlds; w++) {
      sum_a += one[w];
      sum_b += other[w];
    }
  }
  if (paired.n == 0)
    return paired;
  paired.mean_a = sum_a / (double)(paired.n * worlds);
  paired.mean_b = sum_b / (double)(paired.n * worlds);
  paired.difference = sum / (double)paired.n;
  paired.sign_p = sign_test(paired.improved, paired.n - paired.equal);
  if (paired.n < 2)
    return paired;
  find_error(&paired, a, b, n, worlds);
  const double half = paired.error * student_quantile(0.5 + CONFIDENCE / 2, paired.freedom);
  paired.low = paired.difference - half;
  paired.high = paired.difference + half;
  return paired;
}

/* Returns the mean of n values and the square of its standard error; NaN if n is below two. */
static double mean_of(const double *values, size_t n, double *error)
{
  double sum = 0, squares = 0;
  for (size_t i = 0; i < n; i++)
    sum += values[i];
  const double mean = sum / (double)n;
  for (size_t i = 0; i < n; i++)
    squares += (values[i] - mean) * (values[i] - mean);
  *error = n < 2 ? NAN : squares / ((double)n - 1) / (double)n;
  return mean;
}

struct interval compare_means(const double *a, size_t n_a, const double *b, size_t n_b)
{
  double error_a, error_b;
  const double mean_a = mean_of(a, n_a, &error_a), mean_b = mean_of(b, n_b, &error_b),
               both = error_a + error_b;
  struct interval interval = {.difference = mean_b - mean_a};
  const double freedom =
      both * both / (error_a * error_a / ((double)n_a - 1) + error_b * error_b / ((double)n_b - 1));
  const double half =
      both > 0 ? student_quantile(0.5 + CONFIDENCE / 2, freedom) * sqrt(both) : both;
  interval.low = interval.difference - half;
  interval.high = interval.difference + half;
  return interval;
}

const char *verdict_of(double low, double high)
{
  return high < 0 ? "better" : low > 0 ? "worse" : "undecided";
}
