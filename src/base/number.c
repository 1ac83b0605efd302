/* number.c: see number.h. */
#include "base/number.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

const char *mo_number_text(double value, char text[MO_NUMBER_BYTES])
{
  for (int digits = 6; digits <= 17; digits++) {
    snprintf(text, MO_NUMBER_BYTES, "%.*g", digits, value);
    if (strtod(text, NULL) == value)
      break;
  }
  for (char *c = text; *c != '\0'; c++)
    if (*c == ',')
      *c = '.';
  return text;
}

int mo_bounded_check(const struct mo_bounded *numbers, size_t n, struct mo_message *message)
{
  for (size_t i = 0; i < n; i++) {
    const struct mo_bounded *number = &numbers[i];
    const double value = number->value;
    const char *low = number->above_low ? "above" : "at least";
    const char *high = number->below_high ? "below" : "at most";
    if (!isfinite(value))
      return mo_fail(message, MO_ERR_INVALID, "%s is not finite; it must be %s %s and %s %s",
                     number->name, low, MO_NUMBER(number->low), high, MO_NUMBER(number->high));
    if (value < number->low || (number->above_low && value == number->low) ||
        value > number->high || (number->below_high && value == number->high))
      return mo_fail(message, MO_ERR_RANGE, "%s is %s; it must be %s %s and %s %s", number->name,
                     MO_NUMBER(value), low, MO_NUMBER(number->low), high, MO_NUMBER(number->high));
  }
  return MO_OK;
}
