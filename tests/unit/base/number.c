/* Numbers and names in messages. Different numbers have different texts. */
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

static void counts(void)
{
  CHECK_TEXT(MO_COUNTED(0, "open job"), "0 open jobs");
  CHECK_TEXT(MO_COUNTED(1, "open job"), "1 open job");
  CHECK_TEXT(MO_COUNTED(UINT64_MAX, "byte"), "18446744073709551615 bytes");
}

static void cuts(void)
{
  char text[8];
  CHECK_TEXT(mo_cut_text("abcd", 4, text), "abcd");
  CHECK_TEXT(mo_cut_text("abcde", 4, text), "abcd…");
  CHECK_TEXT(mo_cut_text("abcéf", 4, text), "abc…"); /* é has two bytes */
  CHECK_TEXT(mo_cut_text("é", 1, text), "…");
}

static const struct check_case cases[] = {{"the text of a number reads back", reads_back},
                                          {"one thing, and several", counts},
                                          {"names are cut between two characters", cuts}};
CHECK_MAIN(cases)
