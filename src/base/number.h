/* number.h: numbers in messages, and their bounds. Different numbers always have different texts,
 * so that no message contradicts itself. */
#ifndef MORPHO_BASE_NUMBER_H
#define MORPHO_BASE_NUMBER_H

#include <stdbool.h>
#include <stddef.h>

#include <morpho/error.h>

#define MO_NUMBER_BYTES 32

/* Writes a number as a short text that reads back as the same number, with six digits or more where
 * the number has them. The decimal point does not depend on the locale. */
const char *mo_number_text(double value, char text[MO_NUMBER_BYTES]);
/* Makes the same text as an argument of "%s"; valid until the end of the block. */
#define MO_NUMBER(value) mo_number_text((value), (char[MO_NUMBER_BYTES]){0})

struct mo_bounded {
  const char *name;
  double value, low, high;
  bool above_low, below_high; /* the bound itself is not allowed */
};
/* Checks numbers. Reports the first that is not finite (MO_ERR_INVALID) or out of bounds
 * (MO_ERR_RANGE). */
int mo_bounded_check(const struct mo_bounded *numbers, size_t n, struct mo_message *message);

#endif
