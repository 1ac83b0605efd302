/* Tables, numbers and times. */
#include "../check.h"

#include <time.h>

#include "commands.h"
#include "table.h"

static void columns(void)
{
  struct table table;
  struct ctl ctl = {0};
  char *text = NULL;
  size_t length = 0;
  table_open(&table, ">#|name|>score");
  table_add(&table, (const char *[]){"0", "ä", "0.5"});
  table_add(&table, (const char *[]){"10", "longer", NULL});
  FILE *memory = open_memstream(&text, &length);
  REQUIRE(memory != NULL);
  table_print(&table, memory, &ctl);
  fclose(memory);
  CHECK_TEXT(text, " #  name    score\n"
                   " 0  ä         0.5\n"
                   "10  longer      –\n");
  free(text);
}

static void a_column_less(void)
{
  struct table table;
  struct ctl ctl = {0};
  char *text = NULL;
  size_t length = 0;
  table_open(&table, "a|b|>c");
  table_add(&table, (const char *[]){"1", "2", "3"});
  table_add(&table, (const char *[]){"4", "5", "66"});
  table_drop(&table, 1);
  FILE *memory = open_memstream(&text, &length);
  REQUIRE(memory != NULL);
  table_print(&table, memory, &ctl);
  fclose(memory);
  CHECK_TEXT(text, "a   c\n1   3\n4  66\n");
  free(text);
}

static void numbers(void)
{
  char text[32];
  CHECK_TEXT(count_text(0, text), "0");
  CHECK_TEXT(count_text(999, text), "999");
  CHECK_TEXT(count_text(1000, text), "1,000");
  CHECK_TEXT(count_text(-1234567, text), "-1,234,567");
  json_t *score = json_real(0.123456);
  CHECK_TEXT(score_text(score, text), "0.1235");
  json_decref(score);
  CHECK_TEXT(score_text(json_null(), text), "–");
  setenv("TZ", "UTC", 1);
  tzset();
  json_t *time = json_string("2026-11-21T13:15:02.123Z"), *none = json_string("soon");
  CHECK_TEXT(time_text(time, text), "2026-11-21 13:15:02");
  CHECK_TEXT(time_text(none, text), "soon");
  CHECK_TEXT(time_text(json_null(), text), "–");
  json_decref(time);
  json_decref(none);
}

static void ids_and_states(void)
{
  CHECK(check_job_id("12") && !check_job_id("") && !check_job_id("012") && !check_job_id("1x") &&
        !check_job_id("1234567890123456789"));
  CHECK(is_final("succeeded") && is_final("failed") && is_final("cancelled") &&
        !is_final("paused") && !is_final(""));
}

static const struct check_case cases[] = {{"columns", columns},
                                          {"a column less", a_column_less},
                                          {"numbers", numbers},
                                          {"ids and states", ids_and_states}};
CHECK_MAIN(cases)
