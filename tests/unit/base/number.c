/* Numbers in messages: different numbers have different texts. */
#include "base/text.h"

#include <float.h>

#include "../check.h"

static void reads_back(void)
{
  static const struct {
    double value;
    const char *text;
  } known[] = {{0, "0"},       {-1, "-1"},       {0.1, "0.1"},
               {1e6, "1e+06"}, {0.001, "0.001"}, {1000000.0000001, "1000000.0000001"}};
  static const double values[] = {1e6, 1.0, 0.5, 0.9, 0.001, 1e-7, 1e9, 1e30, DBL_MIN, DBL_MAX / 2};
  for (size_t i = 0; i < sizeof(known) / sizeof(known[0]); i++)
    CHECK_TEXT(MO_NUMBER(known[i].value), known[i].text);
  for (size_t i = 0; i < sizeof(values) / sizeof(values[0]); i++) {
    const double v = values[i], next = nextafter(v, INFINITY), last = nextafter(v, -INFINITY);
    CHECK(strtod(MO_NUMBER(v), NULL) == v);
    CHECK(strtod(MO_NUMBER(next), NULL) == next);
    CHECK(strtod(MO_NUMBER(last), NULL) == last);
    CHECK(strlen(MO_NUMBER(-last)) < MO_NUMBER_BYTES - 1);
  }
}

static const struct check_case cases[] = {{"the text of a number reads back", reads_back}};
CHECK_MAIN(cases)
