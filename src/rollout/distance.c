/* distance.c: see distance.h. */
#include "rollout/distance.h"

#include <math.h>

/* With e the square root of the rounded sum of squares, e² exceeds a² + b² by the rounding error,
 * which one step of Newton's method removes. The excess is written as a sum of terms that are small
 * and nearly exact, in one way for b near a, and in another for b below about a/2 (C. F. Borges,
 * "An improved algorithm for hypot(a, b)", 2019, algorithm "corrected, unfused"). */
double mo_distance(double dx_m, double dy_m)
{
  double a = fmax(fabs(dx_m), fabs(dy_m)), b = fmin(fabs(dx_m), fabs(dy_m));
  double unit = 1.0;
  if (isinf(dx_m) || isinf(dy_m))
    return INFINITY;
  if (isnan(dx_m) || isnan(dy_m))
    return NAN;
  if (b <= a * 0x1p-54)
    return a + b;
  if (a > 0x1p510 || b < 0x1p-459) { /* the squares leave float64's range */
    unit = a > 0x1p510 ? 0x1p600 : 0x1p-600;
    a /= unit;
    b /= unit;
  }
  const double e = sqrt(a * a + b * b);
  double excess;
  if (e <= 2.0 * b) {
    const double rest = e - b;
    excess = a * (2.0 * rest - a) + (rest - 2.0 * (a - b)) * rest;
  } else {
    const double rest = e - a;
    excess = 2.0 * rest * (a - 2.0 * b) + ((4.0 * rest - b) * b + rest * rest);
  }
  return (e - excess / (2.0 * e)) * unit;
}
