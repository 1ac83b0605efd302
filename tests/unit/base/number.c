/* Numbers in messages: what is refused never looks like what is allowed. */
#include "base/number.h"

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

/* One step beyond each bound, and on it where that is allowed or not. */
static void bounds(void)
{
  static const double lows[] = {0.0, 1e-7, -2.5}, highs[] = {1.0, 1e6, 1e9};
  for (int i = 0; i < 3; i++)
    for (int k = 0; k < 3; k++)
      for (int open = 0; open < 4; open++) {
        const double low = lows[i], high = highs[k];
        struct mo_bounded one = {"it", high, low, high, open & 1, open & 2};
        struct mo_message message = {""};
        char words[128];
        CHECK_INT(mo_bounded_check(&one, 1, &message), open & 2 ? MO_ERR_RANGE : MO_OK);
        one.value = low;
        CHECK_INT(mo_bounded_check(&one, 1, &message), open & 1 ? MO_ERR_RANGE : MO_OK);
        one.value = nextafter(high, INFINITY);
        CHECK_INT(mo_bounded_check(&one, 1, &message), MO_ERR_RANGE);
        snprintf(words, sizeof(words), "it is %s; it must be %s %s and %s %s", MO_NUMBER(one.value),
                 open & 1 ? "above" : "at least", MO_NUMBER(low), open & 2 ? "below" : "at most",
                 MO_NUMBER(high));
        CHECK_TEXT(message.text, words);
        CHECK(strcmp(MO_NUMBER(one.value), MO_NUMBER(high)) != 0);
        one.value = nextafter(low, -INFINITY);
        CHECK_INT(mo_bounded_check(&one, 1, &message), MO_ERR_RANGE);
        CHECK(strcmp(MO_NUMBER(one.value), MO_NUMBER(low)) != 0);
        one.value = NAN;
        CHECK_INT(mo_bounded_check(&one, 1, &message), MO_ERR_INVALID);
        CHECK(strncmp(message.text, "it is not finite; it must be ", 29) == 0);
        CHECK_INT(mo_bounded_check(&one, 1, NULL), MO_ERR_INVALID);
      }
}

static const struct check_case cases[] = {{"the text of a number reads back", reads_back},
                                          {"bounds, one step beyond", bounds}};
CHECK_MAIN(cases)
