/* losses.c: see losses.h. */
#include "atlas/losses.h"

#include <math.h>

#define LARGEST      65504.0
#define INFINITE     0x7c00
#define DIGITS       11  /* significant bits */
#define LEAST_WEIGHT -24 /* exponent of the last bit of the smallest numbers */

/* With q units of 2^weight, the bits of the number are q, plus 1024 for each weight above the
 * least: a q of 2048, after rounding up, is the first of the next exponent. */
uint16_t mo_atlas_pack_loss(double loss)
{
  const unsigned sign = signbit(loss) ? 0x8000 : 0;
  const double size = fabs(loss);
  int exponent = 0;
  if (isinf(size))
    return (uint16_t)(sign | INFINITE);
  if (size >= LARGEST)
    return (uint16_t)(sign | (INFINITE - 1));
  if (size == 0)
    return 0;
  (void)frexp(size, &exponent);
  const int weight = exponent - DIGITS > LEAST_WEIGHT ? exponent - DIGITS : LEAST_WEIGHT;
  const unsigned units = (unsigned)rint(ldexp(size, -weight));
  return (uint16_t)(sign | ((unsigned)(weight - LEAST_WEIGHT) * 1024 + units));
}

float mo_atlas_unpack_loss(uint16_t packed)
{
  const int exponent = packed >> 10 & 31, fraction = packed & 1023;
  const double size = exponent == 31  ? (fraction == 0 ? INFINITY : NAN)
                      : exponent == 0 ? ldexp(fraction, LEAST_WEIGHT)
                                      : ldexp(fraction + 1024, exponent - 1 + LEAST_WEIGHT);
  return (float)(packed & 0x8000 ? -size : size);
}

bool mo_atlas_loss_is_nan(uint16_t packed)
{
  return (packed & 0x7fff) > INFINITE;
}
