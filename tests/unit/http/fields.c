/* Header fields, paths, queries, routes, hosts, tokens, problem documents. tests/api/test_raw.py
 * has malformed requests. */
#include "unit/check.h"

#include <jansson.h>
#include <math.h>
#include <time.h>

#include "http/field.h"
#include "http/guard.h"
#include "http/reply.h"
#include "http/route.h"

static void percent(void)
{
  char out[16];
  CHECK(mo_percent_decode("a%20b+c", 7, false, out, sizeof(out)) && strcmp(out, "a b+c") == 0);
  CHECK(mo_percent_decode("a%20b+c", 7, true, out, sizeof(out)) && strcmp(out, "a b c") == 0);
  CHECK(mo_percent_decode("%c3%A9", 6, false, out, sizeof(out)) && strcmp(out, "é") == 0);
  CHECK(!mo_percent_decode("%00", 3, false, out, sizeof(out)));
  CHECK(!mo_percent_decode("%0a", 3, false, out, sizeof(out)));
  CHECK(!mo_percent_decode("%4", 2, false, out, sizeof(out)));
  CHECK(!mo_percent_decode("%zz", 3, false, out, sizeof(out)));
  CHECK(!mo_percent_decode("%ff", 3, false, out, sizeof(out)));
  CHECK(!mo_percent_decode("0123456789abcdef", 16, false, out, sizeof(out)));
}

static void queries(void)
{
  const char *query = "&a=1&&b&c=x=y&=z";
  struct mo_query_item item;
  REQUIRE(mo_query_next(&query, &item));
  CHECK(item.name_size == 1 && item.value_size == 1 && *item.value == '1');
  REQUIRE(mo_query_next(&query, &item));
  CHECK(item.name_size == 1 && *item.name == 'b' && item.value_size == 0);
  REQUIRE(mo_query_next(&query, &item));
  CHECK(item.value_size == 3);
  REQUIRE(mo_query_next(&query, &item));
  CHECK(item.name_size == 0 && item.value_size == 1);
  CHECK(!mo_query_next(&query, &item));
  int64_t n;
  CHECK(mo_decimal("12", 2, 0, 99, &n) && n == 12);
  CHECK(!mo_decimal("", 0, 0, 99, &n));
  CHECK(!mo_decimal("-1", 2, 0, 99, &n));
  CHECK(!mo_decimal("100", 3, 0, 99, &n));
  CHECK(!mo_decimal("9999999999999999999", 19, 0, INT64_MAX, &n));
}

static void prefer(void)
{
  CHECK_INT(mo_prefer_wait(NULL, 60), -1);
  CHECK_INT(mo_prefer_wait("wait=30", 60), 30);
  CHECK_INT(mo_prefer_wait("respond-async, wait=5", 60), 5);
  CHECK_INT(mo_prefer_wait("Wait = \"7\"", 60), 7);
  CHECK_INT(mo_prefer_wait("wait=100", 60), 60);
  CHECK_INT(mo_prefer_wait("return=minimal", 60), -1);
  CHECK_INT(mo_prefer_wait("wait", 60), -1);
  CHECK_INT(mo_prefer_wait("wait=-1", 60), -1);
  CHECK_INT(mo_prefer_wait("wait=1.5", 60), -1);
  CHECK_INT(mo_prefer_wait("wait=soon, wait=5", 60), 5);
  CHECK_INT(mo_prefer_wait("wait=99999999999999999999999", 60), -1);
}

static void accepts(void)
{
  static const char *const types[] = {"application/octet-stream", "application/json"};
  CHECK_INT(mo_accept_choose(NULL, types, 2), 0);
  CHECK_INT(mo_accept_choose("*/*", types, 2), 0);
  CHECK_INT(mo_accept_choose("application/json", types, 2), 1);
  CHECK_INT(mo_accept_choose("application/*", types, 2), 0);
  CHECK_INT(mo_accept_choose("application/json;q=0.9, */*;q=0.1", types, 2), 1);
  CHECK_INT(mo_accept_choose("application/octet-stream;q=0, */*", types, 2), 1);
  CHECK_INT(mo_accept_choose("text/html", types, 2), -1);
  CHECK_INT(mo_accept_choose("application/json;q=0", types, 2), -1);
  CHECK_INT(mo_accept_choose("text/html, APPLICATION/JSON ; charset=utf-8", types, 2), 1);
}

static void codings(void)
{
  static const char *const yes[] = {
      "gzip",         "br, gzip",        "GZIP ;q=0.001", "*",
      "br;q=0, gzip", "*;q=0, gzip;q=1", "gzip, *;q=0",   "deflate, gzip;q=1.0, *;q=0.5",
      "gzip,"};
  static const char *const no[] = {"",         "br",          "gzip;q=0",    "gzip; q=0.000",
                                   "xgzip",    "gzip;q=0, *", "*, gzip;q=0", "*;q=0",
                                   "gzip;q=x", "identity"};
  CHECK(!mo_accept_coding(NULL, "gzip"));
  for (size_t i = 0; i < sizeof(yes) / sizeof(yes[0]); i++)
    CHECK(mo_accept_coding(yes[i], "gzip"));
  for (size_t i = 0; i < sizeof(no) / sizeof(no[0]); i++)
    CHECK(!mo_accept_coding(no[i], "gzip"));
}

static void etags(void)
{
  CHECK(mo_etag_matches("\"a\"", "\"a\""));
  CHECK(mo_etag_matches("\"b\", W/\"a\"", "\"a\""));
  CHECK(mo_etag_matches("*", "\"a\""));
  CHECK(!mo_etag_matches("\"ab\"", "\"a\""));
  CHECK(!mo_etag_matches("a", "\"a\""));
  CHECK(!mo_etag_matches("\"a", "\"a\""));
  CHECK(!mo_etag_matches(NULL, "\"a\""));
  CHECK(mo_etag_matches("\"x,y\" , \"a\"", "\"a\""));
}

static void content_types(void)
{
  char type[64], charset[32];
  CHECK(mo_content_type("Application/JSON; Charset=\"UTF-8\"", type, charset));
  CHECK_TEXT(type, "application/json");
  CHECK_TEXT(charset, "utf-8");
  CHECK(!mo_content_type("", type, charset));
  CHECK(!mo_content_type("json", type, charset));
}

static void keys(void)
{
  char key[256], longest[300];
  CHECK(mo_idempotency_key("\"a \\\" b\"", key) && strcmp(key, "a \" b") == 0);
  CHECK(mo_idempotency_key(" abc ", key) && strcmp(key, "abc") == 0);
  CHECK(!mo_idempotency_key("\"\"", key));
  CHECK(!mo_idempotency_key("", key));
  CHECK(!mo_idempotency_key("é", key));
  memset(longest, 'k', sizeof(longest));
  longest[255] = '\0';
  CHECK(mo_idempotency_key(longest, key));
  longest[255] = 'k';
  longest[256] = '\0';
  CHECK(!mo_idempotency_key(longest, key));
}

static void ids(void)
{
  int64_t id = 0;
  CHECK(mo_id("1", &id) && mo_id("999999999999999999", &id) && id == INT64_C(999999999999999999));
  CHECK(!mo_id("", &id) && !mo_id("0", &id) && !mo_id("01", &id) && !mo_id("-1", &id) &&
        !mo_id("1000000000000000000", &id));
}

/* Finds a path in a small table; returns the index of its first row, or −1. */
static const struct mo_route lines[] = {
    {"/", MO_GET, NULL, MO_RIGHT_READ, 0, MO_BODY_SMALL, ""},
    {"/v1/jobs", MO_GET, NULL, MO_RIGHT_READ, 0, MO_BODY_SMALL, ""},
    {"/v1/jobs/{id}", MO_GET, NULL, MO_RIGHT_READ, 0, MO_BODY_SMALL, ""},
    {"/v1/jobs/{id}", MO_DELETE, NULL, MO_RIGHT_READ, 0, MO_BODY_SMALL, ""},
    {"/v1/jobs/{id}/pause", MO_POST, NULL, MO_RIGHT_READ, 0, MO_BODY_SMALL, ""},
    {"/v1/{a}/3/b/{c}", MO_GET, NULL, MO_RIGHT_READ, 0, MO_BODY_SMALL, ""}};
static const struct mo_routes table = {lines, sizeof(lines) / sizeof(lines[0])};
static char parameters[MO_PATH_PARAMETERS][MO_PATH_PARAMETER_BYTES];

static int find(const char *path)
{
  const struct mo_route *route = mo_route_find(&table, path, strlen(path), parameters);
  return route != NULL ? (int)(route - lines) : -1;
}

static void routes(void)
{
  char allow[64];
  CHECK_INT(find("/"), 0);
  CHECK_INT(find("/v1/jobs"), 1);
  CHECK_INT(find("/v1/jobs/"), -1);
  CHECK_INT(find("/v1/jobs/17"), 2);
  CHECK_TEXT(parameters[0], "17");
  CHECK_INT(find("/v1/jobs/17/pause"), 4);
  CHECK_INT(find("/v1/jobs//pause"), -1);
  CHECK_INT(find("//v1/jobs"), -1);
  CHECK_INT(find("/v1/../v1/jobs"), -1);
  CHECK_INT(find("/v1/evaluations/3/b/9"), 5);
  CHECK_TEXT(parameters[1], "9");
  CHECK_INT(find("/v1/jobs/sha256%3Aab"), 2);
  CHECK_TEXT(parameters[0], "sha256:ab");
  CHECK_INT(find("/v1/jobs/a%00b"), -1);
  CHECK_INT(find("*"), -1);
  mo_route_allow(&table, &lines[2], allow);
  CHECK_TEXT(allow, "GET, HEAD, DELETE, OPTIONS");
  CHECK(mo_route_of_method(&table, &lines[2], MO_DELETE) == &lines[3]);
  CHECK(mo_route_of_method(&table, &lines[2], MO_HEAD) == &lines[2]);
  CHECK(mo_route_of_method(&table, &lines[2], MO_POST) == NULL);
  CHECK(mo_route_of_method(&table, NULL, MO_GET) == NULL);
  CHECK_INT(mo_method_of("get"), MO_OTHER_METHOD);
}

#define TEXTS(...)                                                                                 \
  (const char *const[])                                                                            \
  {                                                                                                \
    __VA_ARGS__, NULL                                                                              \
  }

static void check_hosts(const char *const *hosts, bool local, const struct mo_names *names,
                        bool good)
{
  for (; *hosts != NULL; hosts++) {
    if (mo_guard_host(*hosts, strlen(*hosts), local, names) != good)
      printf("# %s\n", *hosts);
    CHECK(mo_guard_host(*hosts, strlen(*hosts), local, names) == good);
  }
}

static void hosts(void)
{
  static const char *const configured[] = {"Robots.example", "lab.example:9000"};
  const struct mo_names names = {configured, 2};
  check_hosts(TEXTS("localhost", "LOCALHOST:8765", "127.0.0.1:1", "[::1]:8765", "192.168.1.7",
                    "robots.example", "ROBOTS.example:77", "lab.example:9000"),
              false, &names, true);
  check_hosts(TEXTS("lab.example", "evil.example", "", "localhost.evil.example", "localhost:0",
                    "localhost:99999", "local host", "localhost:8765:1", "[::1", "user@localhost",
                    "127.0.0.1.nip.io"),
              false, &names, false);
  check_hosts(
      TEXTS("localhost", "127.0.0.1:8765", "127.1.2.3", "[::1]", "robots.example", "[::1]:8765"),
      true, &names, true);
  check_hosts(TEXTS("10.0.0.7", "[fe80::1]", "evil.example:8765"), true, &names, false);
  CHECK(mo_guard_fetch_site(NULL));
  CHECK(mo_guard_fetch_site("same-origin"));
  CHECK(mo_guard_fetch_site("none"));
  CHECK(!mo_guard_fetch_site("Cross-Site"));
  CHECK(!mo_guard_fetch_site("same-site"));
  CHECK(mo_guard_origin("http://127.0.0.1:8765", "127.0.0.1:8765", &names));
  CHECK(mo_guard_origin("http://localhost", "localhost:80", &names));
  CHECK(mo_guard_origin("https://robots.example", "127.0.0.1:8765", &names));
  CHECK(!mo_guard_origin("http://localhost:3000", "localhost:8765", &names));
  CHECK(!mo_guard_origin("http://localhost:8765", "127.0.0.1:8765", &names));
  CHECK(!mo_guard_origin("null", "127.0.0.1:8765", &names));
  CHECK(!mo_guard_origin("http://evil.example", "127.0.0.1:8765", &names));
  CHECK(!mo_guard_origin("file://", "127.0.0.1:8765", &names));
}

static void tokens(void)
{
  static const struct mo_token two[] = {{"anna", MO_RIGHT_READ, "0123456789abcdef"},
                                        {"<b>", MO_RIGHT_SUBMIT, "another-token-of-24-bytes"}};
  static const struct mo_token bad[] = {{"anna", MO_RIGHT_READ, "0123456789abcde"},
                                        {"anna", MO_RIGHT_READ, "0123456789 abcdef"},
                                        {"", MO_RIGHT_READ, "0123456789abcdef"},
                                        {"an na", MO_RIGHT_READ, "0123456789abcdef"}};
  static const char *const wrong[] = {"Bearer 0123456789abcdeg",
                                      "Bearer 0123456789abcde",
                                      "Bearer 0123456789abcdef0123456789abcdef",
                                      "Bearer ",
                                      "Basic 0123456789abcdef",
                                      NULL};
  struct mo_tokens set = {.lock = PTHREAD_RWLOCK_INITIALIZER};
  struct mo_caller caller = {"nobody", MO_RIGHT_ADMIN};
  struct mo_message message;
  CHECK_INT(mo_tokens_check(&set, "Bearer x", &caller), -1);
  REQUIRE(mo_tokens_set(&set, two, 2, &message) == MO_OK);
  for (size_t i = 0; i < sizeof(wrong) / sizeof(wrong[0]); i++)
    CHECK_INT(mo_tokens_check(&set, wrong[i], &caller), 0);
  CHECK(strcmp(caller.name, "nobody") == 0); /* a wrong token leaves the fields empty */
  CHECK_INT(mo_tokens_check(&set, "Bearer 0123456789abcdef", &caller), 1);
  CHECK(strcmp(caller.name, "anna") == 0 && caller.right == MO_RIGHT_READ);
  CHECK_INT(mo_tokens_check(&set, "bearer  another-token-of-24-bytes", &caller), 1);
  CHECK(strcmp(caller.name, "<b>") == 0 && caller.right == MO_RIGHT_SUBMIT);
  for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
    CHECK_INT(mo_tokens_set(&set, &bad[i], 1, &message), MO_ERR_INVALID);
    CHECK(strstr(message.text, bad[i].text) == NULL); /* messages never quote a token */
  }
  CHECK_INT(mo_tokens_check(&set, "Bearer 0123456789abcdef", &caller),
            1); /* the old tokens remain in use valid */
  REQUIRE(mo_tokens_set(&set, two + 1, 1, &message) == MO_OK);
  CHECK_INT(mo_tokens_check(&set, "Bearer 0123456789abcdef", &caller), 0);
  mo_tokens_free(&set);
}

static void problems(void)
{
  struct mo_text text = {0};
  struct mo_faults faults = {0};
  char longest[600];
  for (size_t i = 0; i < sizeof(longest) - 1; i += 2)
    memcpy(longest + i, "é", 2);
  longest[sizeof(longest) - 1] = '\0';
  mo_faults_add(&faults, MO_FAULT_BODY, "/designs/3", "a \"quoted\" \x01 word");
  mo_faults_add(&faults, MO_FAULT_PARAMETER, "limit", "%s", longest);
  for (int i = 0; i < 40; i++)
    mo_faults_add(&faults, MO_FAULT_HEADER, longest, "again");
  mo_problem_write(&text, 422, "detail \xff", "/v1/\"x", "0123456789abcdef", &faults);
  json_error_t error;
  json_t *tree = json_loads(text.data, JSON_REJECT_DUPLICATES, &error);
  REQUIRE(tree != NULL);
  CHECK_INT(json_integer_value(json_object_get(tree, "status")), 422);
  CHECK_TEXT(json_string_value(json_object_get(tree, "detail")), "detail \xEF\xBF\xBD");
  CHECK_INT(json_array_size(json_object_get(tree, "errors")), MO_FAULTS_MAX);
  json_decref(tree);
  mo_text_free(&text);
}

/* Formats with printf's digits: the fewest, from 15 on, that read back exactly. */
static void shortest_numbers(void)
{
  struct mo_text text = {0};
  uint64_t state = 1, wrong = 0;
  for (int i = 0; i < 200000; i++) {
    char expected[40];
    double number;
    state = state * UINT64_C(6364136223846793005) + UINT64_C(1442695040888963407);
    memcpy(&number, &state, sizeof(number));
    if (i % 4 == 1) /* with few digits */
      number = (double)(int64_t)(state >> 20) * pow(10, -(int)(state % 30));
    else if (i % 4 == 2) /* next to powers of ten and powers of two */
      number = i % 8 == 2 ? nextafter(pow(10, (int)(state >> 40) % 40 - 20), (double)(state % 3))
                          : ldexp(1, (int)(state >> 40) % 70 - 18);
    else if (i % 4 == 3) /* a score */
      number = (double)(state >> 11) * 0x1p-53;
    if (!isfinite(number) || (number == trunc(number) && fabs(number) < 1e15))
      continue;
    for (int digits = 15; digits <= 17; digits++) {
      snprintf(expected, sizeof(expected), "%.*g", digits, number);
      if (strtod(expected, NULL) == number)
        break;
    }
    text.size = 0;
    mo_text_json_number(&text, number);
    if (strcmp(text.data, expected) != 0 && wrong++ == 0)
      printf("# %s, expected %s\n", text.data, expected);
  }
  CHECK_INT(wrong, 0);
  mo_text_free(&text);
}

static void texts(void)
{
  struct mo_text text = {0};
  static const double numbers[] = {0,
                                   -0.0,
                                   0.1,
                                   1.0 / 3,
                                   1e-320,
                                   1.7976931348623157e308,
                                   123456789012345680.0,
                                   0.30000000000000004};
  for (size_t i = 0; i < sizeof(numbers) / sizeof(numbers[0]); i++) {
    mo_text_json_number(&text, numbers[i]);
    double back = strtod(text.data, NULL);
    CHECK(memcmp(&back, &numbers[i], sizeof(back)) == 0);
    text.size = 0;
    mo_text_json_float(&text, (float)numbers[i]);
    if (isfinite((float)numbers[i]))
      CHECK(strtof(text.data, NULL) == (float)numbers[i]);
    text.size = 0;
  }
  mo_text_json_number(&text, INFINITY);
  CHECK_TEXT(text.data, "null");
  text.size = 0;
  mo_text_json_number(&text, 0.1);
  CHECK_TEXT(text.data, "0.1");
  /* Whole numbers are written like printf writes them. */
  static const double whole[] = {
      0, -0.0, 7, -40, 123456, 999999999999999, -999999999999999, 1e14, 1e15, 0x1p53, 1e300};
  for (size_t i = 0; i < sizeof(whole) / sizeof(whole[0]); i++) {
    char expected[64];
    snprintf(expected, sizeof(expected), whole[i] == 0x1p53 ? "%.16g" : "%.15g", whole[i]);
    text.size = 0;
    mo_text_json_number(&text, whole[i]);
    CHECK_TEXT(text.data, expected);
  }
  text.size = 0;
  mo_text_member_time(&text, "at", INT64_C(1763724844123456));
  CHECK_TEXT(text.data, "\"at\":\"2025-11-21T11:34:04.123Z\"");
  mo_text_free(&text);
}

static float random_float(uint64_t *state)
{
  *state = *state * UINT64_C(6364136223846793005) + UINT64_C(1442695040888963407);
  uint32_t word = (uint32_t)(*state >> 32);
  float value;
  memcpy(&value, &word, sizeof(value));
  /* All bit patterns, and as many numbers in the range of a robot's coordinates. */
  return *state >> 31 & 1 ? value : (float)(int32_t)word * 0x1p-30F;
}

/* The writer of recordings writes the same text as printf, in less time than one printf. */
static void floats(void)
{
  enum { N = 300000 };
  struct mo_text text = {0};
  uint64_t state = 1;
  char expected[32];
  int differing = 0;
  static const float edges[] = {1e-4F, 0x1.a36e2ep-14F, 999999.94F, 1e6F, 99999.99F, 9.9999996e-5F,
                                1.0F,  100000.0F,       0.3F,       -0.1F};
  for (int i = 0; i < N; i++) {
    float value = i < 10 ? edges[i] : random_float(&state);
    if (!isfinite(value))
      continue;
    for (int precision = 6; precision <= 9; precision++) {
      snprintf(expected, sizeof(expected), "%.*g", precision, (double)value);
      if (strtof(expected, NULL) == value)
        break;
    }
    text.size = 0;
    mo_text_json_float(&text, value);
    if (strcmp(text.data, expected) != 0 && differing++ == 0)
      printf("# %s, not %s\n", text.data, expected);
  }
  CHECK_INT(differing, 0);
  clock_t begin = clock();
  for (int i = 0; i < N; i++)
    snprintf(expected, sizeof(expected), "%.9g", (double)i * 0x1.23456p-15);
  clock_t printing = clock() - begin;
  begin = clock();
  for (int i = 0; i < N; i++) {
    text.size = 0;
    mo_text_json_float(&text, (float)i * 0x1.23456p-15F);
  }
  clock_t writing = clock() - begin;
  printf("# %.3f s, printf %.3f s\n", (double)writing / CLOCKS_PER_SEC,
         (double)printing / CLOCKS_PER_SEC);
  CHECK(writing < printing);
  mo_text_free(&text);
}

static const struct check_case cases[] = {
    {"percent escapes", percent},
    {"queries and numbers", queries},
    {"Prefer", prefer},
    {"Accept", accepts},
    {"Accept-Encoding", codings},
    {"entity tags", etags},
    {"content types", content_types},
    {"idempotency keys", keys},
    {"ids", ids},
    {"routes", routes},
    {"Host and Origin", hosts},
    {"tokens", tokens},
    {"problems", problems},
    {"texts", texts},
    {"shortest numbers", shortest_numbers},
    {"floats", floats},
};
CHECK_MAIN(cases)
