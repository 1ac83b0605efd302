/* normal.c: quantiles of the normal distribution.
 *
 * Rational approximations of Wichura (1988), "Algorithm AS 241: The Percentage Points of the Normal
 * Distribution", Applied Statistics 37 (3), routine PPND16: one pair of polynomials for the middle
 * (|p − ½| ≤ 0.425) and two for the tails, in r = sqrt(−log(tail)). The code uses only +, −, ×, ÷
 * and sqrt, which IEEE 754 rounds correctly, and the build never contracts them, so the bits are
 * equal on all machines. For the same reason the logarithm is implemented here. */
#include "base/normal.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

#define LN2    0.69314718055994530942
#define DEGREE 7

/* Coefficients, constant term first. */
static const double middle_numerator[DEGREE + 1] = {
    3.3871328727963666080e0, 1.3314166789178437745e2, 1.9715909503065514427e3,
    1.3731693765509461125e4, 4.5921953931549871457e4, 6.7265770927008700853e4,
    3.3430575583588128105e4, 2.5090809287301226727e3};
static const double middle_denominator[DEGREE + 1] = {1.0,
                                                      4.2313330701600911252e1,
                                                      6.8718700749205790830e2,
                                                      5.3941960214247511077e3,
                                                      2.1213794301586595867e4,
                                                      3.9307895800092710610e4,
                                                      2.8729085735721942674e4,
                                                      5.2264952788528545610e3};
static const double tail_numerator[DEGREE + 1] = {
    1.42343711074968357734e0,  4.63033784615654529590e0, 5.76949722146069140550e0,
    3.64784832476320460504e0,  1.27045825245236838258e0, 2.41780725177450611770e-1,
    2.27238449892691845833e-2, 7.74545014278341407640e-4};
static const double tail_denominator[DEGREE + 1] = {1.0,
                                                    2.05319162663775882187e0,
                                                    1.67638483018380384940e0,
                                                    6.89767334985100004550e-1,
                                                    1.48103976427480074590e-1,
                                                    1.51986665636164571966e-2,
                                                    5.47593808499534494600e-4,
                                                    1.05075007164441684324e-9};
static const double far_numerator[DEGREE + 1] = {
    6.65790464350110377720e0,  5.46378491116411436990e0,  1.78482653991729133580e0,
    2.96560571828504891230e-1, 2.65321895265761230930e-2, 1.24266094738807843860e-3,
    2.71155556874348757815e-5, 2.01033439929228813265e-7};
static const double far_denominator[DEGREE + 1] = {1.0,
                                                   5.99832206555887937690e-1,
                                                   1.36929880922735805310e-1,
                                                   1.48753612908506148525e-2,
                                                   7.86869131145613259100e-4,
                                                   1.84631831751005468180e-5,
                                                   1.42151175831644588870e-7,
                                                   2.04426310338993978564e-15};

static double ratio(const double numerator[DEGREE + 1], const double denominator[DEGREE + 1],
                    double r)
{
  double n = numerator[DEGREE];
  double d = denominator[DEGREE];
  for (int i = DEGREE - 1; i >= 0; i--) {
    n = n * r + numerator[i];
    d = d * r + denominator[i];
  }
  return n / d;
}

/* Writes x = m · 2^e with m in [√½, √2), and log m = 2 artanh(s) with s = (m − 1)/(m + 1), |s| ≤
 * 0.1716: thirteen terms of the series suffice. */
double mo_natural_log(double x)
{
  uint64_t bits;
  memcpy(&bits, &x, sizeof(bits));
  int exponent = (int)(bits >> 52 & 0x7ff) - 1023;
  bits = (bits & UINT64_C(0x000fffffffffffff)) | UINT64_C(0x3ff0000000000000);
  double m;
  memcpy(&m, &bits, sizeof(m));
  if (m > 1.41421356237309504880) {
    m *= 0.5;
    exponent++;
  }
  double s = (m - 1.0) / (m + 1.0);
  double square = s * s;
  double sum = 0.0;
  for (int k = 25; k >= 3; k -= 2) {
    sum = (sum + 1.0 / k) * square;
  }
  return (double)exponent * LN2 + (2.0 * s + 2.0 * s * sum);
}

double mo_normal_quantile(double p)
{
  double q = p - 0.5;
  if (fabs(q) <= 0.425) {
    return q * ratio(middle_numerator, middle_denominator, 0.180625 - q * q);
  }
  double r = sqrt(-mo_natural_log(q < 0.0 ? p : 1.0 - p));
  double z = r <= 5.0 ? ratio(tail_numerator, tail_denominator, r - 1.6)
                      : ratio(far_numerator, far_denominator, r - 5.0);
  return q < 0.0 ? -z : z;
}
