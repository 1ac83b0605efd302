/* The JSON reader: what it accepts, and the positions of its faults. The fuzz targets of requests
 * compare it with jansson. */
#include "unit/check.h"

#include "base/base64.h"
#include "base/json.h"

static struct mo_json json;
static struct mo_faults faults;

/* Reads a whole text and ignores its values. */
static bool well_formed(const char *text, size_t size)
{
  faults = (struct mo_faults){0};
  mo_json_start(&json, text, size, &faults);
  mo_json_skip(&json);
  return mo_json_finish(&json) && faults.n == 0;
}

static bool good(const char *text)
{
  return well_formed(text, strlen(text));
}

/* Checks which texts of a list are accepted as JSON. */
#define TEXTS(...)                                                                                 \
  (const char *const[])                                                                            \
  {                                                                                                \
    __VA_ARGS__, NULL                                                                              \
  }

static void check_texts(const char *const *texts, bool is_json)
{
  for (; *texts != NULL; texts++) {
    if (good(*texts) != is_json)
      printf("# %s: %s\n", *texts, is_json ? faults.items[0].detail : "accepted");
    CHECK(good(*texts) == is_json);
    CHECK(is_json || (faults.malformed && faults.n == 1));
  }
}

static void accepts(void)
{
  check_texts(TEXTS("{}", "[]", " [ ] ", "0", "-0", "-0.0e+10", "1E5", "\"\"",
                    "\"\\u00e9\\ud83d\\ude00\\n\\/\"", "\"é😀\"", "true", "null",
                    "[1,2,[3,{\"a\":{\"b\":[]}}]]", "{\"a\":1,\"b\":{\"a\":1}}", "\t[\r\n1]\n",
                    "1e400"),
              true);
}

static void rejects(void)
{
  check_texts(TEXTS("", " ", "{", "[", "]", "}", "[1", "[1,", "[1,]", "[,1]", "{\"a\"}", "{\"a\":}",
                    "{\"a\":1,}", "{,}", "{a:1}", "{'a':1}", "[1 2]", "[1]x", "[1][2]", "nul",
                    "tru", "True", "NaN", "Infinity", "-Infinity", "[NaN]", "+1", "01", "-", "-01",
                    "1.", ".5", "1e", "1e+", "0x10", "1_000", "\"", "\"\\\"", "\"\\x\"",
                    "\"\\u12\"", "\"\\u12g4\"", "\"\\ud800\"", "\"\\udc00\"", "\"\\ud800\\u0041\"",
                    "\"\\u0000\"", "\"\n\"", "\"\x80\"", "\"\xc0\xaf\"", "\"\xed\xa0\x80\"",
                    "\"\xf4\x90\x80\x80\"", "\"\xe2\x82\"", "\xef\xbb\xbf{}", "{\"a\":1,\"a\":2}",
                    "{\"a\":1,\"\\u0061\":2}", "[{\"b\":[{\"k\":1,\"k\":1}]}]", "// x\n1", "/**/1",
                    "[1;2]", "1 1", "{\"a\" 1}", "{\"a\":1 \"b\":2}", "{1:2}", "\"\x7f", "\v1"),
              false);
  CHECK(!well_formed("[1]\0", 4));
  CHECK(!well_formed("\"a\0b\"", 5));
  CHECK(!well_formed("[1\0]", 4));
}

static void depth(void)
{
  char text[400];
  memset(text, '[', 64);
  memset(text + 64, ']', 64);
  CHECK(well_formed(text, 128));
  memset(text, '[', 65);
  memset(text + 65, ']', 65);
  CHECK(!well_formed(text, 130));
  CHECK(faults.malformed && strstr(faults.items[0].detail, "64") != NULL);
  /* A deeply nested bomb takes neither stack nor time. */
  size_t size = 1 << 20;
  char *bomb = malloc(size + 1);
  REQUIRE(bomb != NULL);
  memset(bomb, '[', size);
  bomb[size] = '\0';
  CHECK(!well_formed(bomb, size));
  free(bomb);
  /* More keys than allowed. */
  char keys[2048] = "{";
  for (int i = 0; i < 65; i++)
    sprintf(keys + strlen(keys), "%s\"k%d\":0", i > 0 ? "," : "", i);
  strcat(keys, "}");
  CHECK(!good(keys));
}

static void places(void)
{
  const char *text = "{\"a/b~c\":[0,{\"x\":\"y\"}],\"\\u00e9\":1,\"d\":[[1,2],[3,\"four\"]]}";
  struct mo_json_slice key, word;
  int64_t number;
  faults = (struct mo_faults){0};
  mo_json_start(&json, text, strlen(text), &faults);
  REQUIRE(mo_json_object(&json));
  REQUIRE(mo_json_member(&json, &key) && mo_json_is(key, "a/b~c"));
  REQUIRE(mo_json_array(&json) && mo_json_item(&json));
  CHECK(!mo_json_string(&json, &word)); /* a number is given */
  REQUIRE(mo_json_item(&json) && mo_json_object(&json) && mo_json_member(&json, &key));
  CHECK(!mo_json_integer(&json, 0, 9, &number));
  CHECK(!mo_json_member(&json, &key));
  CHECK(!mo_json_item(&json));
  REQUIRE(mo_json_member(&json, &key));
  CHECK(!mo_json_array(&json));
  REQUIRE(mo_json_member(&json, &key) && mo_json_array(&json));
  while (mo_json_item(&json)) {
    unsigned level = json.depth;
    REQUIRE(mo_json_array(&json));
    while (mo_json_item(&json))
      mo_json_integer(&json, 2, 9, &number);
    mo_json_fault_at(&json, level, "/7", "below");
  }
  CHECK(!mo_json_member(&json, &key));
  CHECK(mo_json_finish(&json));
  static const char *const expected[] = {"/a~1b~0c/0", "/a~1b~0c/1/x", "/é",    "/d/0/0",
                                         "/d/0/7",     "/d/1/1",       "/d/1/7"};
  CHECK_INT(faults.n, 7);
  for (unsigned i = 0; i < 7 && i < faults.n; i++)
    CHECK_TEXT(faults.items[i].where, expected[i]);
  CHECK(!faults.malformed);
  /* A syntax error also has a position. */
  CHECK(!good("{\"designs\":[{\"cells\":[[0,0,NaN]]}]}"));
  CHECK_TEXT(faults.items[0].where, "/designs/0/cells/0/2");
  CHECK(strstr(faults.items[0].detail, "line 1, column 28") != NULL);
}

static bool read_integer(const char *text, int64_t min, int64_t max, int64_t *value)
{
  faults = (struct mo_faults){0};
  mo_json_start(&json, text, strlen(text), &faults);
  return mo_json_integer(&json, min, max, value) && mo_json_finish(&json);
}

static void numbers(void)
{
  int64_t n = -1;
  CHECK(read_integer("17", 0, 20, &n) && n == 17);
  CHECK(read_integer("3.0", 0, 20, &n) && n == 3);
  CHECK(read_integer("1e1", 0, 20, &n) && n == 10);
  CHECK(read_integer("-5", -9, 20, &n) && n == -5);
  CHECK(read_integer("9007199254740991", 0, INT64_MAX, &n) && n == INT64_C(9007199254740991));
  CHECK(!read_integer("21", 0, 20, &n) && !faults.malformed);
  CHECK(!read_integer("1.5", 0, 20, &n) && !faults.malformed);
  /* By the digits as written, not by the nearest float64. */
  static const char *const fractions[] = {"9007199254740991.4",
                                          "1.00000000000000000001",
                                          "1e-400",
                                          "5e-1",
                                          "-0.1",
                                          "100000000000000000000000001e-26",
                                          "12e-99999999999999999999"};
  for (size_t i = 0; i < sizeof(fractions) / sizeof(fractions[0]); i++)
    CHECK(!read_integer(fractions[i], -20, INT64_MAX, &n) && !faults.malformed && faults.n == 1);
  CHECK(read_integer("900719925474099100e-2", 0, INT64_MAX, &n) && n == INT64_C(9007199254740991));
  CHECK(read_integer("9007199254740993.0", 0, INT64_MAX, &n) && n == INT64_C(9007199254740993));
  CHECK(read_integer("0.00120e5", 0, INT64_MAX, &n) && n == 120);
  CHECK(read_integer("10203000000000000000000e-20", 0, INT64_MAX, &n) == false);
  CHECK(read_integer("1020300000000000000000000e-20", 0, INT64_MAX, &n) && n == 10203);
  CHECK(read_integer("-0.0e99999999999999999999", -1, 1, &n) && n == 0);
  CHECK(read_integer("999999999999999999", 0, INT64_MAX, &n) && n == INT64_C(999999999999999999));
  CHECK(!read_integer("1e18", 0, INT64_MAX, &n) &&
        !read_integer("1e99999999999999999999", 0, INT64_MAX, &n));
  CHECK(!read_integer("1e400", 0, 20, &n) && !faults.malformed && faults.n == 1);
  CHECK(!read_integer("99999999999999999999", 0, INT64_MAX, &n) && !faults.malformed);
  CHECK(!read_integer("true", 0, 20, &n) && !faults.malformed);
  double x = 0;
  const char *text = "[1e400, 0.1, -2.5e-3, 1e-400]";
  faults = (struct mo_faults){0};
  mo_json_start(&json, text, strlen(text), &faults);
  REQUIRE(mo_json_array(&json) && mo_json_item(&json));
  CHECK(!mo_json_number(&json, &x));
  REQUIRE(mo_json_item(&json) && mo_json_number(&json, &x));
  CHECK(x == 0.1);
  REQUIRE(mo_json_item(&json) && mo_json_number(&json, &x));
  CHECK(x == -2.5e-3);
  REQUIRE(mo_json_item(&json) && mo_json_number(&json, &x));
  CHECK(x == 0);
  CHECK_TEXT(faults.items[0].where, "/0");
}

/* A key that is spelled with escapes is that key, and remains so while an array of plain keys is
 * read. */
static void escaped_keys(void)
{
  static const char text[] = "{\"\\u0064esigns\":[{\"cells\":1}],\"la\\u0062el\":2,"
                             "\"\\ud83d\\ude00\\/\":3,\"p\":{\"\\u0071\":4}}";
  struct mo_json_slice key;
  int64_t n;
  faults = (struct mo_faults){0};
  mo_json_start(&json, text, strlen(text), &faults);
  REQUIRE(mo_json_object(&json) && mo_json_member(&json, &key) && mo_json_is(key, "designs"));
  REQUIRE(mo_json_array(&json) && mo_json_item(&json) && mo_json_object(&json) &&
          mo_json_member(&json, &key));
  CHECK(mo_json_is(key, "cells") && mo_json_integer(&json, 0, 9, &n));
  CHECK(!mo_json_member(&json, &key) && !mo_json_item(&json));
  REQUIRE(mo_json_member(&json, &key) && mo_json_is(key, "label") &&
          mo_json_integer(&json, 0, 9, &n));
  REQUIRE(mo_json_member(&json, &key) && mo_json_is(key, "😀/") && mo_json_integer(&json, 0, 9, &n));
  REQUIRE(mo_json_member(&json, &key) && mo_json_is(key, "p") && mo_json_object(&json));
  REQUIRE(mo_json_member(&json, &key) && mo_json_is(key, "q") && !mo_json_integer(&json, 0, 3, &n));
  CHECK_TEXT(faults.items[0].where, "/p/q");
  CHECK(!mo_json_member(&json, &key) && !mo_json_member(&json, &key) && mo_json_finish(&json));
}

static void strings(void)
{
  struct mo_json_slice word;
  const char *text = "\"a\\\"\\\\\\b\\f\\n\\r\\t\\u20ac\\ud83d\\ude00\"";
  faults = (struct mo_faults){0};
  mo_json_start(&json, text, strlen(text), &faults);
  REQUIRE(mo_json_string(&json, &word));
  CHECK(mo_json_is(word, "a\"\\\b\f\n\r\t€😀"));
  char longer[3000];
  memset(longer, 'x', sizeof(longer));
  longer[0] = longer[2000] = '"';
  faults = (struct mo_faults){0};
  mo_json_start(&json, longer, 2001, &faults);
  CHECK(!mo_json_string(&json, &word) && !faults.malformed && faults.n == 1);
}

/* Long strings, and the bytes in them. */
static void bytes(void)
{
  static const struct {
    const char *text;
    size_t n; /* SIZE_MAX means refused */
  } cases[] = {{"\"\"", 0},
               {"\"AP8=\"", 2},
               {"\"AP9=\"", SIZE_MAX},
               {"\"AA==\"", 1},
               {"\"AB==\"", SIZE_MAX},
               {"\"A===\"", SIZE_MAX},
               {"\"====\"", SIZE_MAX},
               {"\"AP8\"", SIZE_MAX},
               {"\"AAAAAP8=\"", 5},
               {"\"AA==AAAA\"", SIZE_MAX},
               {"\"AA AA\"", SIZE_MAX},
               {"\"+/+/\"", 3}};
  struct mo_json_slice text;
  uint8_t decoded[8] = {1};
  size_t n;
  for (size_t i = 0; i < sizeof(cases) / sizeof(cases[0]); i++) {
    faults = (struct mo_faults){0};
    mo_json_start(&json, cases[i].text, strlen(cases[i].text), &faults);
    REQUIRE(mo_json_text(&json, &text));
    const bool good = mo_base64_decode(text.bytes, text.size, decoded, &n);
    CHECK(good == (cases[i].n != SIZE_MAX) && (!good || n == cases[i].n));
  }
  CHECK(decoded[0] == 0xfb && decoded[1] == 0xff && decoded[2] == 0xbf);
  faults = (struct mo_faults){0};
  mo_json_start(&json, "\"a\\u0041\"", 9, &faults);
  CHECK(!mo_json_text(&json, &text) && faults.n == 1 && !faults.malformed);
}

static void many_faults(void)
{
  char text[400] = "[";
  for (int i = 0; i < 50; i++)
    strcat(text, i > 0 ? ",true" : "true");
  strcat(text, "]");
  faults = (struct mo_faults){0};
  mo_json_start(&json, text, strlen(text), &faults);
  int64_t n;
  int items = 0;
  REQUIRE(mo_json_array(&json));
  while (mo_json_item(&json) && items++ < 100)
    mo_json_integer(&json, 0, 1, &n);
  CHECK_INT(faults.n, MO_FAULTS_MAX);
  CHECK_INT(items, MO_FAULTS_MAX);
}

static const struct check_case cases[] = {
    {"accepts JSON", accepts},
    {"rejects other text", rejects},
    {"bounds depth and keys", depth},
    {"reports the position of every fault", places},
    {"reads numbers", numbers},
    {"resolves escapes in keys", escaped_keys},
    {"reads strings", strings},
    {"reads bytes", bytes},
    {"stops at many faults", many_faults},
};
CHECK_MAIN(cases)
