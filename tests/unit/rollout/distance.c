/* The distance that losses are computed from: correct to the last place, and with the same bits
 * whatever the C library's hypot returns. */
#include <inttypes.h>
#include <math.h>
#include <morpho/random.h>
#include <stdio.h>
#include <string.h>

#include "../make.h"
#include "rollout/distance.h"

#define PAIRS 200000

static void same(double found, double expected)
{
  CHECK(memcmp(&found, &expected, sizeof(found)) == 0);
  if (memcmp(&found, &expected, sizeof(found)) != 0)
    printf("# %a for %a\n", found, expected);
}

static void exact(void)
{
  static const double triples[][3] = {{3, 4, 5},       {5, 12, 13}, {8, 15, 17},     {20, 21, 29},
                                      {119, 120, 169}, {0, 7, 7},   {1, 0x1p-60, 1}, {0, 0, 0}};
  static const int scales[] = {0, -20, 300, -300, 1000, -1000};
  for (size_t i = 0; i < COUNT(triples); i++)
    for (size_t s = 0; s < COUNT(scales); s++) {
      const double a = ldexp(triples[i][0], scales[s]), b = ldexp(triples[i][1], scales[s]);
      const double c = ldexp(triples[i][2], scales[s]);
      same(mo_distance(a, b), c);
      same(mo_distance(-b, a), c);
    }
  same(mo_distance(INFINITY, NAN), INFINITY);
  same(mo_distance(1, -INFINITY), INFINITY);
  same(mo_distance(0x1.fp1023, 0x1.fp1023), INFINITY);
  same(mo_distance(0x1p-1074, 0), 0x1p-1074);
  CHECK(isnan(mo_distance(NAN, 1)) && isnan(mo_distance(0, NAN)));
}

/* Distances of the size that robots have, in meters; in one of eight pairs the numbers differ
 * widely in size. */
static void frozen(void)
{
  uint64_t h = FNV_START;
  double worst = 0;
  struct mo_random random = dice(5, 0, 0);
  for (uint64_t i = 0; i < PAIRS; i++) {
    const double x = 8 * mo_random_uniform(&random) - 4;
    const double y =
        (8 * mo_random_uniform(&random) - 4) * (i % 8 == 0 ? ldexp(1, -(int)(i / 8 % 60)) : 1);
    const double d = mo_distance(x, y);
    const long double right = sqrtl((long double)x * x + (long double)y * y);
    worst = fmax(
        worst, (double)(fabsl((long double)d - right) / ((long double)nextafter(d, INFINITY) - d)));
    uint64_t bits;
    memcpy(&bits, &d, sizeof(bits));
    h = (h ^ bits) * UINT64_C(0x100000001b3);
    h ^= h >> 29;
  }
  printf("# at most %.3f units of the last place off; the bits hash to 0x%016" PRIx64 "\n", worst,
         h);
  CHECK(worst > 0.5 && worst < 0.56);
  CHECK(h == UINT64_C(0x16c7aedc72a64049));
}

static const struct check_case cases[] = {
    {"exact, large, small and invalid numbers", exact},
    {"the bits have not changed", frozen},
};
CHECK_MAIN(cases)
