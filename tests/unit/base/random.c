/* random.c: the generator against its published vectors, its streams against each other, its
 * distributions against theory. The samples are fixed by their seeds, so a bound that holds once
 * always holds. */
#include "../check.h"

#include "base/normal.h"

#include <morpho/random.h>

static void vector(const uint32_t counter[4], const uint32_t key[2], const uint32_t expected[4])
{
  uint32_t out[4];
  mo_philox4x32_10(counter, key, out);
  for (int i = 0; i < 4; i++)
    CHECK_INT(out[i], expected[i]);
}

/* The known answers that Random123 publishes for philox4x32-10. */
static void known_answers(void)
{
  vector((uint32_t[4]){0, 0, 0, 0}, (uint32_t[2]){0, 0},
         (uint32_t[4]){0x6627e8d5, 0xe169c58d, 0xbc57ac4c, 0x9b00dbd8});
  vector((uint32_t[4]){0xffffffff, 0xffffffff, 0xffffffff, 0xffffffff},
         (uint32_t[2]){0xffffffff, 0xffffffff},
         (uint32_t[4]){0x408f276d, 0x41c83b0e, 0xa20bc7c6, 0x6d5451fd});
  vector((uint32_t[4]){0x243f6a88, 0x85a308d3, 0x13198a2e, 0x03707344},
         (uint32_t[2]){0xa4093822, 0x299f31d0},
         (uint32_t[4]){0xd16cfe09, 0x94fdcceb, 0x5001e420, 0x24126ea1});
}

/* The layout that random.h promises. */
static void stream_layout(void)
{
  struct mo_random random;
  mo_random_init(&random, UINT64_C(0x0123456789abcdef), MO_PURPOSE_LIGHT, 77,
                 UINT64_C(0xfedc98765432));
  for (uint32_t block = 0; block < 3; block++) {
    uint32_t out[4];
    mo_philox4x32_10((uint32_t[4]){block, 0x98765432, 77, 3U << 16 | 0xfedc},
                     (uint32_t[2]){0x89abcdef, 0x01234567}, out);
    for (int i = 0; i < 4; i++)
      CHECK_INT(mo_random_u32(&random), out[i]);
  }
  struct mo_random other;
  mo_random_init(&random, 1, MO_PURPOSE_CHECK, 0, 0);
  mo_random_init(&other, 1, MO_PURPOSE_CHECK, 0, 0);
  uint64_t low = mo_random_u32(&other);
  uint64_t high = mo_random_u32(&other);
  CHECK(mo_random_u64(&random) == (low | high << 32));
}

static void fill_equals_single_numbers(void)
{
  for (size_t n = 0; n < 200; n++) {
    for (uint32_t before = 0; before < 5; before++) {
      struct mo_random a;
      struct mo_random b;
      mo_random_init(&a, n, MO_PURPOSE_CHECK, before, 3);
      mo_random_init(&b, n, MO_PURPOSE_CHECK, before, 3);
      for (uint32_t i = 0; i < before; i++)
        CHECK_INT(mo_random_u32(&a), mo_random_u32(&b));
      uint32_t numbers[200];
      mo_random_fill(&a, numbers, n);
      int wrong = 0;
      for (size_t i = 0; i < n; i++)
        wrong += numbers[i] != mo_random_u32(&b);
      CHECK_INT(wrong, 0);
      CHECK_INT(mo_random_u32(&a), mo_random_u32(&b));
    }
  }
}

static void streams_differ(void)
{
  struct mo_random random;
  uint32_t first[5];
  mo_random_init(&random, 1, MO_PURPOSE_BODY, 2, 3);
  first[0] = mo_random_u32(&random);
  mo_random_init(&random, 2, MO_PURPOSE_BODY, 2, 3);
  first[1] = mo_random_u32(&random);
  mo_random_init(&random, 1, MO_PURPOSE_LIGHT, 2, 3);
  first[2] = mo_random_u32(&random);
  mo_random_init(&random, 1, MO_PURPOSE_BODY, 3, 3);
  first[3] = mo_random_u32(&random);
  mo_random_init(&random, 1, MO_PURPOSE_BODY, 2, (UINT64_C(1) << 32) + 3);
  first[4] = mo_random_u32(&random);
  for (int i = 0; i < 5; i++) {
    for (int j = 0; j < i; j++)
      CHECK(first[i] != first[j]);
  }
}

static void uniform(void)
{
  enum { BINS = 64, N = 1000000 };
  static int count[BINS];
  struct mo_random random;
  mo_random_init(&random, 20, MO_PURPOSE_CHECK, 0, 0);
  double sum = 0.0;
  for (int i = 0; i < N; i++) {
    double u = mo_random_uniform(&random);
    CHECK(u >= 0.0 && u < 1.0);
    sum += u;
    count[(int)(u * BINS)]++;
  }
  double chi = 0.0;
  for (int i = 0; i < BINS; i++) {
    double d = count[i] - (double)N / BINS;
    chi += d * d / ((double)N / BINS);
  }
  CHECK_NEAR(sum / N, 0.5, 4.0 * sqrt(1.0 / 12 / N));
  CHECK_NEAR(chi, BINS - 1, 4.0 * sqrt(2.0 * (BINS - 1)));
}

static void below(void)
{
  struct mo_random random;
  mo_random_init(&random, 21, MO_PURPOSE_CHECK, 0, 0);
  CHECK_INT(mo_random_below(&random, 0), 0);
  CHECK_INT(mo_random_below(&random, 1), 0);
  static const uint32_t bounds[] = {2, 3, 5, 6, 7, 45, 100};
  for (size_t b = 0; b < sizeof(bounds) / sizeof(bounds[0]); b++) {
    int count[100] = {0};
    const int n = 200000;
    for (int i = 0; i < n; i++) {
      uint32_t k = mo_random_below(&random, bounds[b]);
      REQUIRE(k < bounds[b]);
      count[k]++;
    }
    double chi = 0.0;
    for (uint32_t k = 0; k < bounds[b]; k++) {
      double expected = (double)n / bounds[b];
      chi += (count[k] - expected) * (count[k] - expected) / expected;
    }
    CHECK_NEAR(chi, bounds[b] - 1, 4.0 * sqrt(2.0 * (bounds[b] - 1)));
  }
  /* A bound of 3 · 2³⁰ reveals bias at once: without rejection, every third number would occur
   * twice as often. */
  int low = 0;
  const int n = 100000;
  for (int i = 0; i < n; i++)
    low += mo_random_below(&random, UINT32_C(3) << 30) % 3 == 0;
  CHECK_NEAR((double)low / n, 1.0 / 3, 4.0 * sqrt(2.0 / 9 / n));
}

static void logarithm(void)
{
  struct mo_random random;
  mo_random_init(&random, 22, MO_PURPOSE_CHECK, 0, 0);
  for (int i = 0; i < 100000; i++) {
    double x = ldexp(1.0 + mo_random_uniform(&random), (int)mo_random_below(&random, 120) - 60);
    CHECK_NEAR(mo_natural_log(x), log(x), 4e-16 * fmax(fabs(log(x)), 1e-3));
  }
  CHECK(mo_natural_log(1.0) == 0.0);
}

/* z(p) against tabulated quantiles, and converted back with the complementary error function. */
static void quantiles(void)
{
  CHECK(mo_normal_quantile(0.5) == 0.0);
  CHECK_NEAR(mo_normal_quantile(0.25), -0.6744897501960817, 1e-15);
  CHECK_NEAR(mo_normal_quantile(0.001), -3.090232306167813, 1e-14);
  CHECK_NEAR(mo_normal_quantile(1e-20), -9.262340089798408, 1e-13);
  CHECK_NEAR(mo_normal_quantile(0.975), 1.959963984540054, 1e-15);
  struct mo_random random;
  mo_random_init(&random, 23, MO_PURPOSE_CHECK, 0, 0);
  for (int i = 0; i < 100000; i++) {
    double p = ldexp(1.0 + mo_random_uniform(&random), -2 - (int)mo_random_below(&random, 52));
    double z = mo_normal_quantile(p);
    /* relative error of the tail grows with z² times that of z */
    CHECK_NEAR(0.5 * erfc(-z / sqrt(2.0)) / p, 1.0, 1e-15 * (4.0 + 2.0 * z * z));
    if (p > 1e-9)
      CHECK_NEAR(mo_normal_quantile(1.0 - p), -z, 1e-6);
  }
}

static void normal(void)
{
  enum { BINS = 50, N = 1000000 };
  static int count[BINS + 2];
  struct mo_random random;
  mo_random_init(&random, 24, MO_PURPOSE_CHECK, 0, 0);
  double m[5] = {0};
  int beyond_3 = 0;
  int beyond_4 = 0;
  for (int i = 0; i < N; i++) {
    double z = mo_random_normal(&random);
    double power = 1.0;
    for (int k = 1; k <= 4; k++) {
      power *= z;
      m[k] += power / N;
    }
    beyond_3 += fabs(z) > 3.0;
    beyond_4 += fabs(z) > 4.0;
    int bin = (int)floor((z + 2.5) * 10.0);
    count[bin < 0 ? BINS : bin >= BINS ? BINS + 1 : bin]++;
  }
  CHECK_NEAR(m[1], 0.0, 4.0 / sqrt(N));
  CHECK_NEAR(m[2], 1.0, 4.0 * sqrt(2.0 / N));
  CHECK_NEAR(m[3], 0.0, 4.0 * sqrt(15.0 / N));
  CHECK_NEAR(m[4], 3.0, 4.0 * sqrt(96.0 / N));
  CHECK_NEAR(beyond_3, N * 2.6997960632601866e-3, 4.0 * sqrt(N * 2.7e-3));
  CHECK_NEAR(beyond_4, N * 6.334248366623993e-5, 4.0 * sqrt(N * 6.33e-5));
  double chi = 0.0;
  for (int i = 0; i < BINS + 2; i++) {
    double low = i < BINS ? -2.5 + 0.1 * i : i == BINS ? -INFINITY : 2.5;
    double high = i < BINS ? -2.5 + 0.1 * (i + 1) : i == BINS ? -2.5 : INFINITY;
    double expected = N * 0.5 * (erfc(low / sqrt(2.0)) - erfc(high / sqrt(2.0)));
    chi += (count[i] - expected) * (count[i] - expected) / expected;
  }
  CHECK_NEAR(chi, BINS + 1, 4.0 * sqrt(2.0 * (BINS + 1)));
}

/* Neighboring streams are independent: the correlation of their numbers vanishes. */
static void neighbors(void)
{
  const int n = 200000;
  double product = 0.0;
  for (int i = 0; i < n; i++) {
    struct mo_random a;
    struct mo_random b;
    mo_random_init(&a, 9, MO_PURPOSE_BODY, 0, (uint64_t)i);
    mo_random_init(&b, 9, MO_PURPOSE_BODY, 0, (uint64_t)i + 1);
    product += (mo_random_uniform(&a) - 0.5) * (mo_random_uniform(&b) - 0.5);
  }
  CHECK_NEAR(product / n, 0.0, 4.0 / 12 / sqrt(n));
}

static const struct check_case cases[] = {
    {"Philox returns the published numbers", known_answers},
    {"streams are laid out as documented", stream_layout},
    {"filling equals single numbers", fill_equals_single_numbers},
    {"every part of a stream's name counts", streams_differ},
    {"uniform numbers are uniform", uniform},
    {"bounded numbers are unbiased", below},
    {"the logarithm is exact to rounding", logarithm},
    {"normal quantiles", quantiles},
    {"normal numbers are normal", normal},
    {"neighboring streams are uncorrelated", neighbors},
};
CHECK_MAIN(cases)
