/* Settings as tables: reading with faults, writing, parsing back bit for bit, bounds, paths, and
 * the packed form. */
#include "base/fields.h"

#include "../check.h"

enum color { RED, GREEN };

struct inner {
  double share;
  uint32_t steps, flat;
};

struct outer {
  uint32_t count, batch;
  uint64_t seed;
  double rate;
  bool on;
  enum color color;
  struct inner inner;
  uint16_t side[2];
};

static void read_side(struct mo_json *json, void *value)
{
  uint16_t side[2] = {0};
  int64_t number;
  size_t n = 0;
  if (!mo_json_array(json))
    return;
  for (; mo_json_item(json); n++)
    if (mo_json_integer(json, 1, 6, &number) && n < 2)
      side[n] = (uint16_t)number;
  if (n == 2)
    memcpy(value, side, sizeof(side));
}

static void write_side(struct mo_text *text, const void *value)
{
  uint16_t side[2];
  memcpy(side, value, sizeof(side));
  mo_text_format(text, "[%u,%u]", side[0], side[1]);
}

static const struct mo_field_own side = {.read = read_side, .write = write_side};
static const char *const colors[] = {"red", "green", NULL};
static const struct mo_field inner_rows[] = {
    {"share", MO_FIELD_NUMBER, MO_FIELD_BELOW_MAX, offsetof(struct inner, share), .min = 0,
     .max = 1},
    {"steps", MO_FIELD_COUNT, 0, offsetof(struct inner, steps), .min = 1, .max = 1000},
};
static const struct mo_fields inner = {inner_rows, 2};
static const struct mo_field flat_rows[] = {
    {"flat", MO_FIELD_COUNT, 0, offsetof(struct inner, flat), .min = 0, .max = 9},
};
static const struct mo_fields flat = {flat_rows, 1};
static const struct mo_field rows[] = {
    {"count", MO_FIELD_COUNT, 0, offsetof(struct outer, count), .min = 1, .max = 4294967295.0},
    {"batch", MO_FIELD_COUNT, MO_FIELD_NULL, offsetof(struct outer, batch), .min = 1, .max = 64},
    {"seed", MO_FIELD_SEED, 0, offsetof(struct outer, seed)},
    {NULL, MO_FIELD_INLINE, 0, offsetof(struct outer, inner), .group = &flat},
    {"rate", MO_FIELD_NUMBER, MO_FIELD_ABOVE_MIN, offsetof(struct outer, rate), .min = 0,
     .max = 1e6},
    {"on", MO_FIELD_FLAG, 0, offsetof(struct outer, on)},
    {"color", MO_FIELD_WORD, 0, offsetof(struct outer, color), .words = colors},
    {"inner", MO_FIELD_GROUP, 0, offsetof(struct outer, inner), .group = &inner},
    {"side", MO_FIELD_OWN, 0, offsetof(struct outer, side), .own = &side},
};
static const struct mo_fields fields = {rows, sizeof(rows) / sizeof(rows[0])};

static const struct outer start = {1, 0, 1, 0.5, false, RED, {0.25, 10, 3}, {1, 1}};

static int parse(const char *text, struct outer *outer, struct mo_message *message)
{
  return mo_fields_parse(text, strlen(text), &fields, outer, message);
}

static void reads_what_is_given(void)
{
  struct outer outer = start;
  struct mo_message message = {""};
  CHECK_INT(parse("{\"count\":7,\"inner\":{\"steps\":3},\"color\":\"green\",\"side\":[2,3]}",
                  &outer, &message),
            MO_OK);
  CHECK_INT(outer.count, 7);
  CHECK_INT(outer.inner.steps, 3);
  CHECK(outer.inner.share == 0.25); /* unchanged */
  CHECK_INT(outer.color, GREEN);
  CHECK_INT(outer.side[1], 3);
  outer.batch = 5;
  CHECK_INT(parse("{\"batch\":null}", &outer, &message), MO_OK);
  CHECK_INT(outer.batch, 0);
}

static void returns_every_bit(void)
{
  const struct outer full = {UINT32_MAX, 64,    (uint64_t)MO_SEED_MAX,          0.1 + 0.2,
                             true,       GREEN, {0x1.fffffffffffffp-1, 999, 9}, {6, 5}};
  struct outer outer = start;
  struct mo_message message = {""};
  struct mo_text text = {0};
  mo_fields_write_object(&text, &fields, &full);
  REQUIRE(!text.failed);
  CHECK_INT(parse(text.data, &outer, &message), MO_OK);
  CHECK(outer.count == full.count && outer.batch == full.batch && outer.seed == full.seed &&
        outer.on);
  CHECK(outer.rate == full.rate && outer.inner.share == full.inner.share &&
        outer.inner.steps == 999 && outer.inner.flat == 9);
  CHECK(outer.color == GREEN && outer.side[0] == 6 && outer.side[1] == 5);
  mo_text_free(&text);
  mo_fields_write_object(&text, &fields, &start);
  CHECK_TEXT(text.data, "{\"count\":1,\"batch\":null,\"seed\":1,\"flat\":3,\"rate\":0.5,\"on\":"
                        "false,\"color\":\"red\",\"inner\":"
                        "{\"share\":0.25,\"steps\":10},\"side\":[1,1]}");
  mo_text_free(&text);
}

static void refuses(const char *text, const char *expected)
{
  struct outer outer = start;
  struct mo_message message = {""};
  CHECK_INT(parse(text, &outer, &message), MO_ERR_FORMAT);
  CHECK_TEXT(message.text, expected);
  CHECK(outer.rate == 0.5 && outer.color == RED && outer.inner.share == 0.25 &&
        outer.count == 1); /* unchanged */
}

static void says_what_is_wrong(void)
{
  refuses("{\"rate\":0}", "/rate: must be above 0 and at most 1e+06, got 0");
  refuses("{\"rate\":1000000.0000001}",
          "/rate: must be above 0 and at most 1e+06, got 1000000.0000001");
  refuses("{\"inner\":{\"share\":1}}", "/inner/share: must be at least 0 and below 1, got 1");
  refuses("{\"color\":\"blue\"}", "/color: must be \"red\" or \"green\", got \"blue\"");
  refuses("{\"inner\":{\"size\":1}}", "/inner/size: unknown field; the fields are share, steps");
  refuses("{\"count\":\"7\"}", "/count: must be an integer, got a string");
  refuses("{\"count\":1", "/count: line 1, column 11: the text ends inside an array or object");
}

static void checks_bounds(void)
{
  struct mo_message message = {""};
  struct outer outer = start;
  CHECK_INT(mo_fields_check(&fields, "", &outer, &message), MO_OK);
  outer.inner.share = 1;
  CHECK_INT(mo_fields_check(&fields, "", &outer, &message), MO_ERR_RANGE);
  CHECK_TEXT(message.text, "inner.share must be at least 0 and below 1, got 1");
  outer = start;
  outer.rate = NAN;
  CHECK_INT(mo_fields_check(&fields, "", &outer, &message), MO_ERR_INVALID);
  outer = start;
  outer.color = (enum color)2;
  CHECK_INT(mo_fields_check(&fields, "", &outer, &message), MO_ERR_INVALID);
  CHECK_TEXT(message.text, "color must be \"red\" or \"green\", got number 2");
}

/* Texts, and an optional group. */
struct named {
  char name[5], words[4 * 3 + 1];
  struct {
    bool is_there;
    uint32_t n;
  } more;
};

static const struct mo_field more_rows[] = {
    {"n", MO_FIELD_COUNT, 0, offsetof(struct named, more.n) - offsetof(struct named, more),
     .max = 9},
};
static const struct mo_fields more = {more_rows, 1};
static const struct mo_field named_rows[] = {
    {"name", MO_FIELD_TEXT, 0, offsetof(struct named, name), .min = 1, .max = 4},
    {"words", MO_FIELD_TEXT, MO_FIELD_NULL | MO_FIELD_UTF8, offsetof(struct named, words),
     .max = 3},
    {"more", MO_FIELD_GROUP, MO_FIELD_NULL, offsetof(struct named, more), .group = &more},
};
static const struct mo_fields named_fields = {named_rows, 3};

static void check_named(const char *text, const char *expected)
{
  struct named named = {.name = "x", .words = "y", .more = {true, 1}};
  struct mo_message message = {""};
  struct mo_text again = {0};
  if (mo_fields_parse(text, strlen(text), &named_fields, &named, &message) != MO_OK)
    mo_text_add(&again, message.text);
  else
    mo_fields_write_object(&again, &named_fields, &named);
  CHECK_TEXT(again.data, expected);
  mo_text_free(&again);
}

static void texts_and_absent_groups(void)
{
  check_named("{}", "{\"name\":\"x\",\"words\":\"y\",\"more\":{\"n\":1}}");
  check_named("{\"name\":\"abcd\",\"words\":\"\\u20ac\\ud83d\\ude00ü\",\"more\":null}",
              "{\"name\":\"abcd\",\"words\":\"€😀ü\",\"more\":null}");
  check_named("{\"words\":null,\"more\":{\"n\":9}}",
              "{\"name\":\"x\",\"words\":null,\"more\":{\"n\":9}}");
  check_named("{\"name\":\"\"}", "/name: must have 1 to 4 printable ASCII characters");
  check_named("{\"name\":\"abcde\"}", "/name: must have 1 to 4 printable ASCII characters");
  check_named("{\"name\":\"ü\"}", "/name: must have 1 to 4 printable ASCII characters");
  check_named("{\"name\":\"a\\n\"}", "/name: must have 1 to 4 printable ASCII characters");
  check_named("{\"name\":null}", "/name: must be a string, got null");
  check_named("{\"words\":\"abcd\"}", "/words: must have 0 to 3 characters");
  check_named("{\"words\":\"a\\u0000\"}", "/words: line 1, column 12: \\u0000 is not allowed");
  check_named("{\"more\":7}", "/more: must be an object, got a number");
}

static void check_counts(const char *json, uint32_t n, const char *expected)
{
  struct mo_faults faults = {0};
  struct mo_json reader;
  struct mo_text text = {0};
  uint32_t counts[3] = {7, 7, 7}, found = 0;
  mo_json_start(&reader, json, strlen(json), &faults);
  mo_json_counts(&reader, 9, counts, 3, &found);
  CHECK(mo_json_finish(&reader));
  CHECK_INT(found, n);
  mo_text_counts(&text, counts, 3);
  mo_text_add(&text, faults.n > 0 ? faults.items[0].where : "");
  CHECK_TEXT(text.data, expected);
  mo_text_free(&text);
}

static void counts(void)
{
  check_counts("[]", 0, "[7,7,7]");
  check_counts("[1,0,9,10,\"x\"]", 5, "[1,0,9]");
  check_counts("[1,10]", 2, "[1,7,7]/1");
  check_counts("3", 0, "[7,7,7]");
}

static void add_difference(void *context, const char *pointer, const char *first,
                           const char *second)
{
  mo_text_format(context, "%s: %s, %s; ", pointer, first, second);
}

/* Lists each row that differs, by its pointer, with both values. */
static void compares(void)
{
  struct mo_text text = {0};
  struct outer other = start;
  mo_fields_compare(&fields, "", &start, &other, add_difference, &text);
  CHECK_INT(text.size, 0);
  other.batch = 7;
  other.inner.flat = 4;
  other.inner.steps = 11;
  other.rate = 0.25;
  other.color = GREEN;
  other.side[1] = 6;
  mo_fields_compare(&fields, "/settings", &start, &other, add_difference, &text);
  REQUIRE(!text.failed);
  CHECK_TEXT(text.data, "/settings/batch: null, 7; /settings/flat: 3, 4; "
                        "/settings/rate: 0.5, 0.25; /settings/color: \"red\", \"green\"; "
                        "/settings/inner/steps: 10, 11; /settings/side: [1,1], [1,6]; ");
  mo_text_free(&text);
}

/* ---- the packed form ---- */

struct part {
  double size;
  uint32_t n;
};

struct packed {
  bool on;
  uint32_t count;
  enum color color;
  uint64_t seed;
  double rate, table[4];
  struct part part;
  double added;   /* in version 2 */
  uint32_t steps; /* in version 3, in a separate part */
};

static const struct mo_field part_rows[] = {
    {"n", MO_FIELD_COUNT, 0, offsetof(struct part, n)},
    {"size", MO_FIELD_NUMBER, 0, offsetof(struct part, size)},
};
static const struct mo_fields part = MO_FIELDS(part_rows);
static const struct mo_field steps_rows[] = {
    {"steps", MO_FIELD_COUNT, 0, offsetof(struct packed, steps), .since = 3},
};
static const struct mo_fields steps = MO_FIELDS(steps_rows);
static const struct mo_field packed_rows[] = {
    {"on", MO_FIELD_FLAG, 0, offsetof(struct packed, on)},
    {"count", MO_FIELD_COUNT, 0, offsetof(struct packed, count)},
    {"part", MO_FIELD_GROUP, 0, offsetof(struct packed, part), .group = &part},
    {"rate", MO_FIELD_NUMBER, 0, offsetof(struct packed, rate)},
    {"table", MO_FIELD_NUMBERS, 0, offsetof(struct packed, table), .n = 4, .side = 2, .min = -9,
     .max = 9},
    {"added", MO_FIELD_NUMBER, 0, offsetof(struct packed, added), .since = 2},
    {"color", MO_FIELD_WORD, 0, offsetof(struct packed, color), .words = colors},
    {"seed", MO_FIELD_SEED, 0, offsetof(struct packed, seed)},
    {NULL, MO_FIELD_INLINE, 0, 0, .group = &steps},
};
static const struct mo_fields packed_fields = MO_FIELDS(packed_rows);
static const struct packed plain = {true, 2, GREEN, 5, 0.5, {1, 2, 3, 4}, {1.5, 3}, 7, 9};

/* Numbers in rows can also be written as rows. */
static void reads_numbers(void)
{
  static const struct {
    const char *text, *fault;
  } given[] = {{"[1,-2,3,4.5]", NULL},
               {"[[1,-2],[3,4.5]]", NULL},
               {"[1,-2,3]", "/table: must be an array of 4 numbers, got 3"},
               {"[[1,-2],[3,4.5],[]]", "/table: must have 2 rows, got 3"},
               {"[[1,-2],[3]]", "/table/1: must be an array of 2 numbers, got 1"},
               {"[1,-2,3,9.5]", "/table/3: "},
               {"3", "/table: "}};
  for (size_t i = 0; i < COUNT(given); i++) {
    struct packed got = plain;
    struct mo_message message = {""};
    struct mo_text text = {0};
    mo_text_format(&text, "{\"table\":%s}", given[i].text);
    const int error = mo_fields_parse(text.data, text.size, &packed_fields, &got, &message);
    CHECK_INT(error, given[i].fault == NULL ? MO_OK : MO_ERR_FORMAT);
    if (given[i].fault != NULL)
      CHECK(strncmp(message.text, given[i].fault, strlen(given[i].fault)) == 0);
    else
      CHECK(got.table[0] == 1 && got.table[1] == -2 && got.table[2] == 3 && got.table[3] == 4.5);
    mo_text_free(&text);
    mo_fields_write(&text, &(struct mo_fields){&packed_rows[4], 1}, &got);
    CHECK(error != MO_OK || strcmp(text.data, "\"table\":[1,-2,3,4.5]") == 0);
    mo_text_free(&text);
  }
  struct packed bad = plain;
  struct mo_message message = {""};
  bad.table[2] = INFINITY;
  CHECK_INT(mo_fields_check(&(struct mo_fields){&packed_rows[4], 1}, "", &bad, &message),
            MO_ERR_INVALID);
  CHECK_SAYS(message, "table[2] must be at least -9 and at most 9");
}

/* Eight bytes first, then four, then one. */
static void packs(void)
{
  const uint8_t expected[] = {
      0, 0, 0, 0, 0, 0, 0xf8, 0x3f, 0, 0, 0, 0, 0, 0, 0xe0, 0x3f, 0, 0, 0, 0, 0, 0, 0xf0, 0x3f,
      0, 0, 0, 0, 0, 0, 0,    0x40, 0, 0, 0, 0, 0, 0, 8,    0x40, 0, 0, 0, 0, 0, 0, 0x10, 0x40,
      5, 0, 0, 0, 0, 0, 0,    0,    2, 0, 0, 0, 3, 0, 0,    0,    1, 0, 0, 0, 1};
  uint8_t bytes[sizeof(struct packed)], bad[sizeof(bytes)];
  struct packed got = {.added = -1, .steps = 4};
  REQUIRE(mo_fields_packed_bytes(&packed_fields, 1) == sizeof(expected));
  mo_fields_pack(&packed_fields, 1, &plain, bytes);
  CHECK(memcmp(bytes, expected, sizeof(expected)) == 0);
  REQUIRE(mo_fields_unpack(&packed_fields, 1, bytes, &got));
  CHECK(got.added == -1 && got.steps == 4);
  got.added = plain.added;
  got.steps = plain.steps;
  CHECK(mo_fields_equal(&packed_fields, &got, &plain));
  for (size_t at = sizeof(expected) - 5; at < sizeof(expected); at += 4) { /* color and flag */
    memcpy(bad, bytes, sizeof(expected));
    bad[at] = 2;
    CHECK(!mo_fields_unpack(&packed_fields, 1, bad, &got));
  }
}

static void packs_added_rows(void)
{
  uint8_t bytes[sizeof(struct packed)];
  struct packed changed = plain, got = {0};
  CHECK_INT(mo_fields_version(&packed_fields, &changed, &plain), 1);
  changed.rate = 8;
  CHECK_INT(mo_fields_version(&packed_fields, &changed, &plain), 1);
  changed.added = 0;
  CHECK_INT(mo_fields_version(&packed_fields, &changed, &plain), 2);
  CHECK_INT(mo_fields_packed_bytes(&packed_fields, 2), 77);
  changed.steps = 1;
  CHECK_INT(mo_fields_version(&packed_fields, &changed, &plain), 3);
  CHECK_INT(mo_fields_packed_bytes(&packed_fields, 3), 81);
  mo_fields_pack(&packed_fields, 3, &changed, bytes);
  REQUIRE(mo_fields_unpack(&packed_fields, 3, bytes, &got));
  CHECK(mo_fields_equal(&packed_fields, &got, &changed));
}

/* Each value counts; only the sign of 0 does not. */
static void equals(void)
{
  struct packed others[9];
  for (int i = 0; i < 9; i++)
    others[i] = plain;
  others[0].on = false;
  others[1].count++;
  others[2].color = RED;
  others[3].seed++;
  others[4].rate = NAN;
  others[5].part.size = -1.5;
  others[6].added++;
  others[7].steps++;
  others[8].table[3]++;
  for (int i = 0; i < 9; i++)
    CHECK(!mo_fields_equal(&packed_fields, &others[i], &plain));
  struct packed zero = plain, minus = plain;
  zero.part.size = 0.0;
  minus.part.size = -0.0;
  zero.table[3] = 0.0;
  minus.table[3] = -0.0;
  CHECK(mo_fields_equal(&packed_fields, &zero, &minus));
  mo_fields_clear_minus(&packed_fields, &minus);
  CHECK(!signbit(minus.part.size) && !signbit(minus.table[3]) && minus.rate == plain.rate);
}

static const struct check_case cases[] = {
    {"compares", compares},
    {"reads the given values", reads_what_is_given},
    {"round-trips every bit", returns_every_bit},
    {"says what is wrong", says_what_is_wrong},
    {"checks bounds", checks_bounds},
    {"texts and optional groups", texts_and_absent_groups},
    {"arrays of counts", counts},
    {"several numbers", reads_numbers},
    {"packs in a fixed order", packs},
    {"packs added rows when they differ", packs_added_rows},
    {"equality", equals},
};
CHECK_MAIN(cases)
