/* Templates and tables. */
#include "../check.h"

#include <time.h>

#include "commands.h"
#include "table.h"

static void templates(void)
{
  static const struct {
    const char *template, *expected;
  } tries[] = {
      {"{id} of {deep.0.word}, {n}{none}", "7 of ä, 1234567"},
      {"{n:,} {zero:,} {minus:,} {small:,} {none:,}", "1,234,567 0 -1,000 999 0"},
      {"{x:.4f} {x:.4g} {x:g} {none:.4f} {x:.1%}", "0.1235 0.1235 0.123456 – 12.3 %"},
      {"{word:.3} {list:#} item{list:s}, {none:.3}", "job 1 item, "},
      {"{at:time} {word:time} {none:time}", "2026-11-21 13:15:02 UTC job.started –"},
      {"{s:duration} {days:duration} {minus:duration}", "0:12:34 3 d 04:05 –"},
      {"{n:GiB} {n:MB}", "0.0 1.2"},
      {"{small/n:%} {n/n:%} {small/zero:%}", "0 % 100 % 0 %"},
      {"[{none} left out][{empty}|{zero} is there|{n}]", "0 is there"},
      {"[{zero>0}|{n>999:,}][{n>9999999}]", "1,234,567"},
      {"[{word=job.started}a][{word!=job.started}b][{!none}c][{!n}d][{n>0:-}e]", "ace"},
      {"[[{none}x|y{word}][z{none}]]", "yjob.started"},
      {"{evil}", "?[2J\\u202e"},
      {"a|b", "a"},
  };
  setenv("TZ", "UTC", 1);
  tzset();
  json_t *json = json_loads(
      "{\"id\": \"7\", \"n\": 1234567, \"zero\": 0, \"minus\": -1000, \"small\": 999, \"x\": "
      "0.123456, \"word\": \"job.started\", \"list\": [1], \"empty\": \"\", \"none\": null, \"s\": "
      "754, \"days\": 273900, \"at\": \"2026-11-21T13:15:02.123Z\", \"deep\": [{\"word\": \"ä\"}], "
      "\"evil\": \"\\u001b[2J\\u202e\"}",
      0, NULL);
  REQUIRE(json != NULL);
  for (size_t i = 0; i < sizeof(tries) / sizeof(tries[0]); i++) {
    char *text = text_from(json, tries[i].template);
    CHECK_TEXT(text, tries[i].expected);
    free(text);
  }
  json_decref(json);
}

static void columns(void)
{
  struct ctl ctl = {0};
  char *text = NULL;
  size_t length = 0;
  json_t *items = json_loads("[{\"n\": 0, \"name\": \"ä\", \"score\": 0.5}, {\"n\": 10, \"name\": "
                             "\"longer\"}]",
                             0, NULL);
  FILE *memory = open_memstream(&text, &length);
  REQUIRE(memory != NULL);
  print_table(memory, &ctl, items, ">#={n}|name=[{none}|{name}]|>score={score:.1f}");
  fclose(memory);
  CHECK_TEXT(text, " #  name    score\n"
                   " 0  ä         0.5\n"
                   "10  longer      –\n");
  free(text);
  json_decref(items);
}

static void ids_and_states(void)
{
  CHECK_TEXT(job_id("12"), "12");
  CHECK(is_final("succeeded") && is_final("failed") && is_final("cancelled") &&
        !is_final("paused") && !is_final(""));
}

static const struct check_case cases[] = {
    {"templates", templates}, {"columns", columns}, {"ids and states", ids_and_states}};
CHECK_MAIN(cases)
