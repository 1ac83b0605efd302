/* elementary.c: sin, exp and log computed only with IEEE operations (fast.h). They are in their own
 * file, so that programs that run no kernel link no kernel. */
#include "rollout/fast.h"

#include <math.h>

double mo_fast_sin(double x)
{
  /* x = n π/2 + r, π/2 in two parts of which the first has trailing zeros: n · high is exact for
   * |n| < 2^20. */
  const double n = nearbyint(x * 0.63661977236758134308);
  const double r = (x - n * 0x1.921fb544p+0) - n * 0x1.0b4611a626331p-34;
  const double s = r * r;
  const int quadrant = (int)((int64_t)n & 3);
  /* Taylor: the cosine to s^8, the sine to r^17. */
  static const double terms[2][8] = {
      {1.0 / 355687428096000.0, -1.0 / 1307674368000.0, 1.0 / 6227020800.0, -1.0 / 39916800.0,
       1.0 / 362880.0, -1.0 / 5040.0, 1.0 / 120.0, -1.0 / 6.0},
      {1.0 / 20922789888000.0, -1.0 / 87178291200.0, 1.0 / 479001600.0, -1.0 / 3628800.0,
       1.0 / 40320.0, -1.0 / 720.0, 1.0 / 24.0, -0.5}};
  const double *term = terms[quadrant & 1];
  double sum = term[0];
  for (int i = 1; i < 8; i++)
    sum = sum * s + term[i];
  sum = quadrant & 1 ? sum * s + 1.0 : r + r * s * sum;
  return quadrant & 2 ? -sum : sum;
}

double mo_fast_exp(double x)
{
  if (x < -700.0)
    return 0.0;
  const double n = nearbyint(x * 1.4426950408889634074);
  const double r = (x - n * 0x1.62e42fefa2p-1) - n * 0x1.9ef35793c7673p-41;
  double sum = 1.0;
  for (int i = 14; i > 0; i--) /* Horner: 1 + r/1 (1 + r/2 (1 + …)) */
    sum = 1.0 + r / i * sum;
  return ldexp(sum, (int)n);
}

double mo_fast_log(double x)
{
  int exponent;
  double m = frexp(x, &exponent);
  if (m < 0.70710678118654752440) {
    m *= 2;
    exponent--;
  }
  /* log m = 2 artanh(s) = 2 (s + s³/3 + s⁵/5 + …), |s| < 0.172 */
  const double s = (m - 1) / (m + 1), square = s * s;
  double sum = 0;
  for (int i = 23; i > 1; i -= 2)
    sum = square * (1.0 / i + sum);
  return exponent * 0x1.62e42fefa2p-1 + (exponent * 0x1.9ef35793c7673p-41 + 2 * (s + s * sum));
}
