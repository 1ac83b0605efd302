/* Factors of environments: drawing by Latin hypercube sampling, products, checks. */
#include "../make.h"

#include "world/factors.h"

enum { N = 500, FACTORS = 6 };

static const struct mo_factor_ranges ranges = {true,       {0.7, 1.3}, {0.5, 2},          {1, 1},
                                               {0.8, 0.8}, {0, 1},     {1.0 / 3, 4.0 / 3}};

static double factor(const struct mo_factors *factors, int k)
{
  const double all[FACTORS] = {factors->stiffness, factors->mass,      factors->drag,
                               factors->gravity,   factors->actuation, factors->friction};
  return all[k];
}

static const double *range(int k)
{
  const double *all[FACTORS] = {ranges.stiffness, ranges.mass,      ranges.drag,
                                ranges.gravity,   ranges.actuation, ranges.friction};
  return all[k];
}

/* Each of the n parts of a range has one number. */
static void one_in_each_part(void)
{
  struct mo_factors drawn[N];
  REQUIRE_OK(mo_factors_draw(&ranges, 5, 3, N, drawn));
  for (int k = 0; k < FACTORS; k++) {
    uint32_t counts[N] = {0}, wrong = 0;
    const double low = range(k)[0], high = range(k)[1];
    for (uint32_t i = 0; i < N; i++) {
      const double value = factor(&drawn[i], k);
      CHECK(drawn[i].given == 1 && mo_factors_check(&drawn[i]) == MO_OK);
      if (low == high)
        CHECK(value == low);
      else
        counts[(uint32_t)fmin(N - 1, (value - low) / (high - low) * N)]++;
    }
    for (uint32_t i = 0; i < N; i++)
      wrong += low < high && counts[i] != 1;
    CHECK(wrong <= 2); /* a number at the border of two parts may be rounded across it */
  }
}

/* Factors are paired at random: their ranks correlate little. */
static void not_correlated(void)
{
  struct mo_factors drawn[N];
  REQUIRE_OK(mo_factors_draw(&ranges, 6, 0, N, drawn));
  for (int a = 0; a < FACTORS; a++)
    for (int b = a + 1; b < FACTORS; b++) {
      const double wide = (range(a)[1] - range(a)[0]) * (range(b)[1] - range(b)[0]);
      double sum = 0;
      for (uint32_t i = 0; i < N && wide > 0; i++)
        sum += (factor(&drawn[i], a) - 0.5 * (range(a)[0] + range(a)[1])) *
               (factor(&drawn[i], b) - 0.5 * (range(b)[0] + range(b)[1]));
      CHECK(wide == 0 || fabs(12 * sum / (wide * N)) < 4 / sqrt(N));
    }
}

static bool same(const struct mo_factors *a, const struct mo_factors *b)
{
  uint32_t n = 0;
  for (uint32_t i = 0; i < N; i++)
    n += a[i].given == b[i].given && mo_fields_equal(&mo_factor_fields, &a[i], &b[i]);
  return n == N;
}

static void streams(void)
{
  struct mo_factors a[N], b[N];
  const struct mo_factor_ranges constant = mo_factors_constant();
  REQUIRE_OK(mo_factors_draw(&ranges, 5, 3, N, a));
  REQUIRE_OK(mo_factors_draw(&ranges, 5, 3, N, b));
  CHECK(same(a, b));
  REQUIRE_OK(mo_factors_draw(&ranges, 5, 4, N, b));
  CHECK(!same(a, b));
  REQUIRE_OK(mo_factors_draw(&ranges, 6, 3, N, b));
  CHECK(!same(a, b));
  REQUIRE_OK(mo_factors_draw(&constant, 6, 3, N, b));
  for (uint32_t i = 0; i < N; i++)
    CHECK(b[i].given == 0);
  CHECK(mo_factors_vary(&ranges) && !mo_factors_vary(&constant));
}

static void products(void)
{
  const struct mo_factors none = {0}, a = {1, 2, 1, 1, 0.5, 1, 0.25}, b = {1, 0.5, 1, 1, 2, 1, 4},
                          c = {1, 3, 1, 1, 1, 1, 1};
  struct mo_factors product = mo_factors_times(&a, &none);
  CHECK(SAME(&product, &a, 1));
  product = mo_factors_times(&none, &a);
  CHECK(SAME(&product, &a, 1));
  product = mo_factors_times(&a, &b);
  CHECK(SAME(&product, &none, 1)); /* all are 1 */
  product = mo_factors_times(&a, &c);
  CHECK(product.stiffness == 6 && product.gravity == 0.5 && product.friction == 0.25);
}

static void checks(void)
{
  struct mo_factors one = mo_factors_ones();
  struct mo_factor_ranges range = ranges;
  struct mo_message message;
  CHECK(mo_factors_check(&one) == MO_ERR_INVALID); /* given, but all are 1 */
  one.mass = 0.009;
  CHECK(mo_factors_check(&one) == MO_ERR_RANGE);
  one.mass = NAN;
  CHECK(mo_factors_check(&one) == MO_ERR_INVALID);
  one.mass = 2;
  CHECK(mo_factors_check(&one) == MO_OK);
  one.given = 0;
  CHECK(mo_factors_check(&one) == MO_ERR_INVALID);
  CHECK(mo_factor_ranges_check("vary", &range, NULL) == MO_OK);
  range.mass[0] = 0;
  CHECK(mo_factor_ranges_check("vary", &range, &message) == MO_ERR_RANGE);
  CHECK(strstr(message.text, "vary.mass") != NULL);
  range.mass[0] = 3;
  CHECK(mo_factor_ranges_check("vary", &range, &message) == MO_ERR_RANGE);
  CHECK(strcmp(message.text, "vary.mass must be [lowest, highest], got [3, 2]") == 0);
}

static const struct check_case cases[] = {
    {"one number in each part of a range", one_in_each_part},
    {"factors are paired at random", not_correlated},
    {"streams", streams},
    {"products", products},
    {"checks", checks},
};
CHECK_MAIN(cases)
