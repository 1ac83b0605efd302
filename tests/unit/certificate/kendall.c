/* kendall.c: Kendall's tau-b against its definition and known values, and the coverage of its
 * interval. */
#include "fixture.h"

#include "certificate/statistics.h"

enum { MOST = 64 };

/* Computes tau and its interval of one list. */
static double tau_of(const double *x, const double *y, uint32_t n, struct mo_interval *interval)
{
  double without[MOST] = {0};
  struct mo_kendall kendall = {.n_designs = n, .without = without};
  mo_kendall_add(&kendall, x, y);
  *interval = mo_kendall_interval(&kendall);
  return mo_kendall_tau(&kendall);
}

static int sign(double x)
{
  return (x > 0) - (x < 0);
}

/* Computes tau-b without the designs in `skip`, pair by pair. */
static double plain_tau(const double *x, const double *y, uint32_t n, uint32_t skip)
{
  double balance = 0, in_x = 0, in_y = 0;
  for (uint32_t i = 0; i < n; i++)
    for (uint32_t k = 0; k < i; k++) {
      if (i == skip || k == skip)
        continue;
      balance += sign(x[i] - x[k]) * sign(y[i] - y[k]);
      in_x += x[i] != x[k];
      in_y += y[i] != y[k];
    }
  return balance / sqrt(in_x * in_y);
}

/* The second one is the example of scipy.stats.kendalltau. */
static void known_values(void)
{
  const double x[] = {1, 2, 3, 4, 5}, y[] = {3, 1, 2, 5, 4}, down[] = {5, 4, 3, 2, 1};
  const double tied[] = {12, 2, 1, 12, 2}, with[] = {1, 4, 7, 1, 0}, same[] = {2, 2, 2, 2, 2};
  struct mo_interval interval;
  CHECK_NEAR(tau_of(x, y, 5, &interval), 0.4, 1e-15); /* 7 pairs agree, 3 do not */
  CHECK_NEAR(tau_of(tied, with, 5, &interval), -0.47140452079103173, 1e-15);
  CHECK(tau_of(x, x, 5, &interval) == 1 && interval.hi == 1 && interval.lo < 0.5);
  CHECK(tau_of(x, down, 5, &interval) == -1 && interval.lo == -1 && interval.hi > -0.5);
  CHECK(isnan(tau_of(x, same, 5, &interval)) && isnan(interval.lo) && isnan(interval.hi));
  CHECK(tau_of(x, x, 2, &interval) == 1 && isnan(interval.lo)); /* fewer than four designs */
  CHECK(tau_of(x, x, 3, &interval) == 1 && isnan(interval.lo));
  CHECK(tau_of(x, x, 4, &interval) == 1 && interval.hi == 1);
  /* All but one are tied: without that one, there is no tau. */
  const double one[] = {1, 1, 1, 2};
  CHECK(tau_of(one, one, 4, &interval) == 1 && isnan(interval.lo));
}

/* Tau without each design, and the interval from its definition. */
static void as_defined(void)
{
  for (uint32_t k = 0; k < 300; k++) {
    struct mo_random random = dice(81, 0, k);
    const uint32_t n = 4 + mo_random_below(&random, 20), values = 2 + mo_random_below(&random, 30);
    double x[MOST], y[MOST], without[MOST] = {0}, mean = 0, variance = 0;
    for (uint32_t i = 0; i < n; i++) {
      x[i] = mo_random_below(&random, values);
      y[i] = x[i] + mo_random_below(&random, values);
    }
    struct mo_kendall kendall = {.n_designs = n, .without = without};
    mo_kendall_add(&kendall, x, y);
    const double tau = mo_kendall_tau(&kendall), plain = plain_tau(x, y, n, UINT32_MAX);
    CHECK(isnan(plain) ? isnan(tau) : fabs(tau - plain) < 1e-14);
    for (uint32_t i = 0; i < n; i++) {
      const double one = plain_tau(x, y, n, i);
      CHECK(isnan(one) ? isnan(without[i]) : fabs(without[i] - one) < 1e-14);
      mean += one / n;
    }
    for (uint32_t i = 0; i < n; i++)
      variance += (without[i] - mean) * (without[i] - mean) * (n - 1) / n;
    const struct mo_interval interval = mo_kendall_interval(&kendall);
    if (isnan(tau) || isnan(variance) || fabs(tau) == 1)
      continue;
    double m = fmax((1 - tau * tau) / variance, n / 2.0);
    m = fmin(m, kendall.untied);
    for (int end = 0; end < 2; end++) { /* (tau − t)² = z² (1 − t²) / m */
      const double t = end == 0 ? interval.lo : interval.hi;
      CHECK_NEAR((tau - t) * (tau - t), 1.959963984540054 * 1.959963984540054 * (1 - t * t) / m,
                 1e-12);
      CHECK(t >= -1 && t <= 1 && (end == 0 ? t < tau : t > tau));
    }
  }
}

/* One exception has a narrower interval than the bound for none: perfect agreement is not punished
 * with less certainty. */
static void agreement_is_monotonic(void)
{
  for (uint32_t n = 4; n <= MOST; n++) {
    double x[MOST], y[MOST];
    struct mo_interval all, one;
    for (uint32_t i = 0; i < n; i++)
      x[i] = y[i] = i;
    CHECK(tau_of(x, y, n, &all) == 1);
    y[0] = 1;
    y[1] = 0;
    CHECK(tau_of(x, y, n, &one) < 1);
    CHECK(all.lo >= one.lo - 1e-12 && all.hi == 1 && one.hi < 1);
  }
}

/* Normal scores with correlation sin(π tau / 2) have this tau. */
static void coverage(void)
{
  static const double taus[] = {-0.5, 0, 0.3, 0.5, 0.7, 0.9, 0.95};
  static const uint32_t sizes[] = {5, 10, 20, 50};
  enum { REPEATS = CHECK_SANITIZED ? 100 : 1000 };
  for (size_t s = 0; s < COUNT(sizes); s++)
    for (size_t t = 0; t < COUNT(taus); t++) {
      const double r = sin(M_PI / 2 * taus[t]);
      struct mo_random random = dice(82, (uint32_t)s, t);
      uint32_t hits = 0;
      for (uint32_t k = 0; k < REPEATS; k++) {
        double x[MOST], y[MOST];
        struct mo_interval interval;
        for (uint32_t i = 0; i < sizes[s]; i++) {
          x[i] = mo_random_normal(&random);
          y[i] = r * x[i] + sqrt(1 - r * r) * mo_random_normal(&random);
        }
        (void)tau_of(x, y, sizes[s], &interval);
        hits += interval.lo <= taus[t] && taus[t] <= interval.hi;
      }
      printf("# n %u, tau %g: coverage %g\n", sizes[s], taus[t], (double)hits / REPEATS);
      CHECK(hits >= (CHECK_SANITIZED ? 0.85 : 0.92) * REPEATS); /* of 100, 92 may be too many */
    }
}

/* Several lists: the mean of their taus, and a narrower interval than that of one. */
static void several_lists(void)
{
  double x[20], y[20], without[20] = {0}, alone = 0, widths = 0;
  struct mo_random random = dice(83, 0, 0);
  struct mo_kendall kendall = {.n_designs = 20, .without = without};
  for (uint32_t i = 0; i < 20; i++)
    x[i] = mo_random_normal(&random);
  for (uint32_t k = 0; k < 8; k++) {
    struct mo_interval interval;
    for (uint32_t i = 0; i < 20; i++)
      y[i] = x[i] + 0.5 * mo_random_normal(&random);
    mo_kendall_add(&kendall, x, y);
    alone += tau_of(x, y, 20, &interval) / 8;
    widths += (interval.hi - interval.lo) / 8;
  }
  const struct mo_interval interval = mo_kendall_interval(&kendall);
  CHECK_NEAR(mo_kendall_tau(&kendall), alone, 1e-14);
  CHECK(interval.hi - interval.lo < widths && interval.lo < alone && interval.hi > alone);
}

static const struct check_case cases[] = {
    {"known values", known_values},
    {"tau and its interval as defined", as_defined},
    {"agreement without an exception", agreement_is_monotonic},
    {"coverage of the interval", coverage},
    {"several lists", several_lists},
};
CHECK_MAIN(cases)
