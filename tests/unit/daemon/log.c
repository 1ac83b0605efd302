/* Log lines: one line per entry, in three formats, whatever the values contain. */
#include "../check.h"

#include <jansson.h>

#include "daemon/log.h"

static char line[4096];

static size_t format(enum log_format kind, bool priority, int64_t time_us, const char *message,
                     const struct log_field *fields, size_t n)
{
  return log_format_line(line, sizeof(line), kind, priority, time_us, LOG_LEVEL_INFO, message,
                         fields, n);
}

static void text_for_people(void)
{
  const struct log_field fields[] = {LOG_TEXT("address", "127.0.0.1:8765"), LOG_INT("jobs", -3),
                                     LOG_REAL("seconds", 0.5), LOG_TEXT("label", "two words"),
                                     LOG_TEXT("none", NULL)};
  format(LOG_FORMAT_TEXT, false, 1700000000123456, "listening", fields, 5);
  CHECK_TEXT(line, "2023-11-14T22:13:20.123456Z info: listening address=127.0.0.1:8765 jobs=-3 "
                   "seconds=0.5 label=\"two words\" "
                   "none=null\n");
}

static void logfmt_and_priority(void)
{
  const struct log_field fields[] = {LOG_TEXT("a", "x=\"y\"\n")};
  format(LOG_FORMAT_LOGFMT, true, 0, "hello there", fields, 1);
  CHECK_TEXT(line, "<6>level=info msg=\"hello there\" a=\"x=\\\"y\\\"\\n\"\n");
}

static void json_is_json(void)
{
  const struct log_field fields[] = {LOG_TEXT("path", "/a\"b\\c\n\x01"), LOG_REAL("nan", NAN),
                                     LOG_INT("n", INT64_MIN)};
  format(LOG_FORMAT_JSON, false, 1700000000000001, "request", fields, 3);
  json_t *object = json_loads(line, 0, NULL);
  REQUIRE(object != NULL);
  CHECK_TEXT(json_string_value(json_object_get(object, "path")), "/a\"b\\c\n\x01");
  CHECK(json_is_null(json_object_get(object, "nan")));
  CHECK(json_integer_value(json_object_get(object, "n")) == INT64_MIN);
  CHECK_TEXT(json_string_value(json_object_get(object, "level")), "info");
  CHECK_TEXT(json_string_value(json_object_get(object, "time")), "2023-11-14T22:13:20.000001Z");
  json_decref(object);
}

/* Text from elsewhere, such as from a hostile daemon, cannot control the terminal that shows the
 * log. */
static void terminals_are_safe(void)
{
  static const char *const shown[][2] = {
      {"a\xC2\x9B"
       "31m",
       "\"a\\u009b31m\""},
      {"\xC2\x80\xC2\x9F\xC2\xA0", "\"\\u0080\\u009f\xC2\xA0\""},
      {"\xE2\x80\xAA\xE2\x80\xAE\xE2\x80\xAF", "\"\\u202a\\u202e\xE2\x80\xAF\""},
      {"\xE2\x81\xA5\xE2\x81\xA6\xE2\x81\xA9\xE2\x81\xAA",
       "\"\xE2\x81\xA5\\u2066\\u2069\xE2\x81\xAA\""},
      {"gr\xC3\xBC\xC3\x9F", "\"gr\xC3\xBC\xC3\x9F\""}};
  for (size_t i = 0; i < sizeof(shown) / sizeof(shown[0]); i++)
    for (enum log_format kind = LOG_FORMAT_TEXT; kind <= LOG_FORMAT_JSON; kind++) {
      const struct log_field field = LOG_TEXT("a", shown[i][0]);
      format(kind, false, 0, "m", &field, 1);
      CHECK_HAS(line, shown[i][1]);
    }
}

static void a_line_stays_one_line(void)
{
  char *large = malloc(100001);
  REQUIRE(large != NULL);
  memset(large, '\n', 100000);
  large[100000] = 0;
  const struct log_field fields[] = {LOG_TEXT("a", large), LOG_TEXT("b", large), LOG_INT("c", 1)};
  for (enum log_format kind = LOG_FORMAT_TEXT; kind <= LOG_FORMAT_JSON; kind++) {
    size_t n = format(kind, true, 1, large, fields, 3);
    CHECK(n < sizeof(line));
    CHECK(line[n] == 0 && line[n - 1] == '\n');
    CHECK(strchr(line, '\n') == line + n - 1);
  }
  free(large);
  large = malloc(3000);
  REQUIRE(large != NULL);
  memset(large, 'x', 2999);
  large[2999] = 0;
  const struct log_field two[] = {LOG_TEXT("a", large), LOG_TEXT("b", large), LOG_INT("c", 1)};
  format(LOG_FORMAT_JSON, false, 1, "m", two, 3);
  json_t *object = json_loads(line, 0, NULL);
  CHECK(object != NULL); /* truncated, and still JSON */
  json_decref(object);
  free(large);
}

static void levels(void)
{
  log_open(LOG_FORMAT_TEXT, LOG_LEVEL_WARNING);
  CHECK(log_enabled(LOG_LEVEL_ERROR) && log_enabled(LOG_LEVEL_WARNING) &&
        !log_enabled(LOG_LEVEL_INFO));
  log_set_level(LOG_LEVEL_DEBUG);
  CHECK(log_enabled(LOG_LEVEL_DEBUG));
}

static const struct check_case cases[] = {
    {"text for people", text_for_people},
    {"logfmt and priority", logfmt_and_priority},
    {"JSON is JSON", json_is_json},
    {"values cannot control a terminal", terminals_are_safe},
    {"an entry stays on one line", a_line_stays_one_line},
    {"levels", levels},
};
CHECK_MAIN(cases)
