/* Student's t and comparisons. The reference quantiles come from printed tables (and agree to three
 * or more places), and from the closed forms for one and two degrees of freedom. */
#include "stats.h"
#include "../check.h"

#include <stdlib.h>

static void quantiles(void)
{
  static const struct {
    double freedom, p, t;
  } table[] = {{3, 0.975, 3.182446305},  {5, 0.975, 2.570581836},  {10, 0.975, 2.228138852},
               {30, 0.975, 2.042272456}, {63, 0.975, 1.998340543}, {120, 0.975, 1.979930405},
               {10, 0.95, 1.812461123},  {5, 0.995, 4.032142984},  {999, 0.975, 1.962341461}};
  for (size_t i = 0; i < sizeof(table) / sizeof(table[0]); i++) {
    CHECK_NEAR(student_quantile(table[i].p, table[i].freedom), table[i].t, 2e-9 * table[i].t);
    CHECK_NEAR(student_quantile(1 - table[i].p, table[i].freedom), -table[i].t, 2e-9 * table[i].t);
  }
  for (int i = 11; i < 20; i++) {
    double p = i / 20.0, u = 2 * p - 1;
    CHECK_NEAR(student_quantile(p, 1), tan(3.14159265358979323846 * (p - 0.5)), 1e-9);
    CHECK_NEAR(student_quantile(p, 2), u * sqrt(2 / (1 - u * u)), 1e-9);
    CHECK_NEAR(student_probability(student_quantile(p, 7.5), 7.5), p, 1e-14);
  }
  CHECK_NEAR(student_probability(0, 4), 0.5, 1e-15);
  CHECK_NEAR(student_quantile(0.975, 1e8), 1.959963984540054, 1e-7); /* the normal distribution */
}

/* In one environment the interval is Student's, over designs. */
static void one_world(void)
{
  /* Differences −1, −2, −3, 0, and one missing pair. */
  const double a[] = {2, 4, 6, 1, NAN, 5}, b[] = {1, 2, 3, 1, 3, INFINITY};
  struct paired paired = compare_crossed(a, b, 6, 1);
  CHECK_INT(paired.n, 4);
  CHECK_INT(paired.improved, 3);
  CHECK_INT(paired.equal, 1);
  CHECK_NEAR(paired.mean_a, 3.25, 1e-15);
  CHECK_NEAR(paired.mean_b, 1.75, 1e-15);
  CHECK_NEAR(paired.difference, -1.5, 1e-15);
  CHECK_NEAR(paired.error, sqrt(5.0 / 12), 1e-15);
  CHECK_NEAR(paired.high - paired.low, 2 * 3.182446305284263 * sqrt(5.0 / 12), 1e-9);
  CHECK_NEAR(paired.low + paired.high, -3, 1e-12);
  CHECK_NEAR(paired.sign_p, 0.25, 1e-12); /* 3 of 3 */
  paired = compare_crossed(a, b, 1, 1);
  CHECK(paired.n == 1 && paired.difference == -1 && isnan(paired.low));
  paired = compare_crossed(a + 4, b + 4, 2, 1);
  CHECK(paired.n == 0 && isnan(paired.mean_a) && isnan(paired.difference));
}

/* By hand: differences 1 2 | 3 6; means 1.5 and 4.5 of designs, 2 and 4 of environments, 3 in all;
 * mean squares 9, 4 and 1. The third design has no loss in one environment. */
static void two_worlds(void)
{
  const double a[] = {0, 0, 0, 0, 0, NAN}, b[] = {1, 2, 3, 6, 7, 7};
  const struct paired paired = compare_crossed(a, b, 3, 2);
  CHECK_INT(paired.n, 2);
  CHECK_NEAR(paired.difference, 3, 1e-15);
  CHECK_NEAR(paired.mean_b, 3, 1e-15);
  CHECK_NEAR(paired.error, sqrt((9 + 4 - 1) / 4.0), 1e-15);
  CHECK_NEAR(paired.freedom, 12 * 12 / (81 + 16 + 1.0), 1e-12);
  CHECK_INT(paired.improved, 0);
  CHECK_NEAR(paired.sign_p, 0.5, 1e-12);
}

static double normal(void)
{
  const double length = sqrt(-2 * log(1 - drand48()));
  return length * cos(2 * 3.14159265358979323846 * drand48());
}

/* Of 1000 experiments in which designs, environments and their pairs all vary, about 950 intervals
 * contain the true difference, 0. An interval only over designs, which takes the environments as
 * given, contains it in about 600. */
static void intervals_hold_for_other_worlds(void)
{
  enum { DESIGNS = 20, WORLDS = 8, TIMES = 1000 };
  static double a[DESIGNS * WORLDS], b[DESIGNS * WORLDS], mean[DESIGNS];
  int crossed = 0, alone = 0;
  srand48(3);
  for (int time = 0; time < TIMES; time++) {
    double worlds[WORLDS];
    for (int w = 0; w < WORLDS; w++)
      worlds[w] = normal();
    for (int i = 0; i < DESIGNS; i++) {
      const double design = normal();
      mean[i] = 0;
      for (int w = 0; w < WORLDS; w++) {
        b[i * WORLDS + w] = design + worlds[w] + 0.5 * normal();
        mean[i] += b[i * WORLDS + w] / WORLDS;
      }
    }
    const struct paired both = compare_crossed(a, b, DESIGNS, WORLDS),
                        one = compare_crossed(a, mean, DESIGNS, 1);
    crossed += both.low <= 0 && 0 <= both.high;
    alone += one.low <= 0 && 0 <= one.high;
  }
  CHECK(crossed > 930 && crossed < 975);
  CHECK(alone < 800);
}

static void means(void)
{
  /* Means 2 and 4, squared errors 1/3 and 4/3: 2 standard errors of sqrt(5/3) at 50/17 degrees. */
  const double a[] = {1, 2, 3}, b[] = {2, 4, 6};
  struct interval interval = compare_means(a, 3, b, 3);
  CHECK_NEAR(interval.difference, 2, 1e-15);
  CHECK_NEAR(interval.high - 2, student_quantile(0.975, 50.0 / 17) * sqrt(5.0 / 3), 1e-12);
  CHECK_NEAR(interval.low + interval.high, 4, 1e-12);
  CHECK(strcmp(verdict_of(interval.low, interval.high), "undecided") == 0);
  interval = compare_means(a, 3, b, 1);
  CHECK(interval.difference == 0 && isnan(interval.low) && isnan(interval.high));
  CHECK(strcmp(verdict_of(interval.low, interval.high), "undecided") == 0);
  const double same[] = {3, 3};
  interval = compare_means(same, 2, (const double[]){1, 1}, 2);
  CHECK(interval.low == -2 && interval.high == -2);
  CHECK(strcmp(verdict_of(interval.low, interval.high), "better") == 0);
}

static const struct check_case cases[] = {
    {"quantiles of Student's t", quantiles},
    {"one world", one_world},
    {"two worlds", two_worlds},
    {"intervals hold for other environments", intervals_hold_for_other_worlds},
    {"means of two sets", means}};
CHECK_MAIN(cases)
