/* number.c: see number.h. */
#include "base/number.h"

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

int mo_hex_digit(char c)
{
  return c >= '0' && c <= '9'   ? c - '0'
         : c >= 'a' && c <= 'f' ? c - 'a' + 10
         : c >= 'A' && c <= 'F' ? c - 'A' + 10
                                : -1;
}
