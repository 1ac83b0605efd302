/* settings.c: defaults, bounds, and settings as JSON. */
#include "fixture.h"

#include "certificate/fields.h"

static void defaults(void)
{
  const struct mo_certificate_settings s = mo_certificate_defaults();
  CHECK_OK(mo_certificate_check(&s, NULL));
  CHECK(s.seed == 1 && s.axes == 0x1fff && s.held_out == 256 && s.worlds == 64 && s.chance == 16 &&
        s.top == 0 && s.n_levels == 4 && s.ranges.given && s.ranges.friction[0] == 1.0 / 3);
  CHECK_TEXT(mo_axis_words[MO_AXIS_HELD_OUT], "held_out");
  CHECK_TEXT(mo_axis_words[MO_AXIS_WORLDS], "worlds");
  CHECK(mo_axis_words[MO_AXES] == NULL);
}

static void refused(void)
{
  static struct mo_certificate_settings s;
  const struct field_case cases[] = {
      {FIELD(s.axes), 1 << MO_AXES | 1, MO_ERR_INVALID, "not an axis"},
      {FIELD(s.axes), 2, MO_ERR_INVALID, "axes must have the bit of the base"},
      {FIELD(s.axes), 1, MO_OK, ""},
      {FIELD(s.held_out), 1, MO_ERR_RANGE, "held_out must be at least 2 and at most 1024, got 1"},
      {FIELD(s.held_out), 1025, MO_ERR_RANGE, "held_out"},
      {FIELD(s.held_out), 1024, MO_OK, ""},
      {FIELD(s.worlds), 1, MO_ERR_RANGE, "worlds"},
      {FIELD(s.worlds), 257, MO_ERR_RANGE, "worlds"},
      {FIELD(s.chance), 1, MO_ERR_RANGE, "chance"},
      {FIELD(s.chance), 65, MO_ERR_RANGE, "chance"},
      {FIELD(s.top), 257, MO_ERR_RANGE, "top"},
      {FIELD(s.n_levels), 0, MO_ERR_RANGE, "levels must have 1 to 8 numbers, got 0"},
      {FIELD(s.n_levels), 9, MO_ERR_RANGE, "1 to 8"},
      {FIELD(s.levels[0]), 0.001, MO_ERR_RANGE, "levels must have numbers from 0.01 to 100"},
      {FIELD(s.levels[3]), 101, MO_ERR_RANGE, "got 101"},
      {FIELD(s.levels[2]), 1, MO_ERR_INVALID, "must not have 1, which is the base"},
      {FIELD(s.levels[1]), 0.7, MO_ERR_INVALID, "must be ascending, got 0.7 after 0.7"},
      {FIELD(s.levels[1]), NAN, MO_ERR_INVALID, "finite"},
      {FIELD(s.ranges.mass[0]), 2, MO_ERR_RANGE, "ranges.mass must be [lowest, highest]"},
      {FIELD(s.ranges.drag[0]), -1, MO_ERR_RANGE, "ranges.drag"},
  };
  for (size_t i = 0; i < COUNT(cases); i++) {
    struct mo_message message = {""};
    s = mo_certificate_defaults();
    set_field(cases[i].field, cases[i].size, cases[i].value);
    CHECK_INT(mo_certificate_check(&s, &message), cases[i].code);
    CHECK_SAYS(message, cases[i].says);
  }
}

/* Returns the message about a JSON text; "": it was read. */
static const char *read_json(const char *json, struct mo_certificate_settings *settings)
{
  static struct mo_message message;
  message.text[0] = '\0';
  (void)mo_fields_parse(json, strlen(json), &mo_certificate_fields, settings, &message);
  return message.text;
}

static void json(void)
{
  struct mo_certificate_settings s = mo_certificate_defaults(), back = mo_certificate_defaults();
  struct mo_text text = {0};
  CHECK_TEXT(read_json("{\"axes\":[\"friction\",\"step\"],\"levels\":[0.5,2],\"seed\":9,"
                       "\"ranges\":{\"mass\":[0.9,1.1]},\"top\":3}",
                       &s),
             "");
  CHECK(s.axes == (1 << MO_AXIS_BASE | 1 << MO_AXIS_FRICTION | 1 << MO_AXIS_STEP));
  CHECK(s.n_levels == 2 && s.levels[0] == 0.5 && s.levels[1] == 2 && s.seed == 9 && s.top == 3);
  CHECK(s.ranges.mass[0] == 0.9 && s.ranges.drag[0] == 0.7 && s.held_out == 256);
  mo_fields_write_object(&text, &mo_certificate_fields, &s);
  CHECK_HAS(text.data, "\"axes\":[\"base\",\"step\",\"friction\"]");
  CHECK_HAS(text.data, "\"levels\":[0.5,2]");
  CHECK_TEXT(read_json(text.data, &back), "");
  CHECK(memcmp(&s, &back, sizeof(s)) == 0);
  mo_text_free(&text);
  CHECK_HAS(read_json("{\"axes\":[\"wind\"]}", &s), "must be \"base\", \"precision\"");
  CHECK_HAS(read_json("{\"axes\":[]}", &s), "at least one axis");
  CHECK_HAS(read_json("{\"levels\":[0.5,1]}", &s), "must not have 1");
  CHECK_HAS(read_json("{\"levels\":[1,2,3,4,5,6,7,8,9]}", &s), "must have 1 to 8 numbers, got 9");
  CHECK_HAS(read_json("{\"ranges\":{\"mass\":[2,1]}}", &s), "");
  CHECK(s.n_levels == 2 && s.axes == back.axes); /* unchanged by refused values */
}

static const struct check_case cases[] = {
    {"defaults are valid", defaults},
    {"settings out of their bounds are refused", refused},
    {"settings as JSON", json},
};
CHECK_MAIN(cases)
