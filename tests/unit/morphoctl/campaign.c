/* How campaigns are displayed: sparklines, lines of generations, the live view. */
#include "campaign.h"
#include "table.h"

#include <math.h>

#include "../check.h"

static void sparks(void)
{
  char text[3 * 40 + 1];
  const double falling[] = {9, 8, 7, 6, 5, 4, 3, 2, 1, 0};
  sparkline(falling, 10, 40, false, text);
  CHECK_TEXT(text, "9876543210");
  sparkline(falling, 10, 5, false, text); /* pairs: 8.5, 6.5, 4.5, 2.5, 0.5 */
  CHECK(strlen(text) == 5 && text[0] == '9' && text[2] == '4' && text[4] == '0');
  sparkline(falling, 10, 40, true, text);
  CHECK(strlen(text) == 30 && strncmp(text, "█", 3) == 0 && strcmp(text + 27, "▁") == 0);
  const double gap[] = {1, (double)NAN, 2};
  sparkline(gap, 3, 40, false, text);
  CHECK_TEXT(text, "0 9");
  const double flat[] = {0.3, 0.3};
  sparkline(flat, 2, 40, false, text);
  CHECK(text[0] == text[1] && text[2] == 0);
  sparkline(flat, 0, 40, true, text);
  CHECK(text[0] == 0);
}

static void texts(void)
{
  static const char job[] = "{\"phase\": \"%s\", \"progress\": {\"under_way\": 5, \"done\": 34, "
                            "\"total\": 64, \"generation\": %s, \"rollouts_per_s\": 210.4, "
                            "\"seconds_left\": 192}}";
  static const struct {
    const char *phase, *generation, *expected;
  } tries[] = {
      {"scoring", "null", "generation 5: scoring 34 of 64 designs  210 rollouts/s  0:03:12 left"},
      {"preparing", "null",
       "generation 5: preparing 34 of 64 pretraining bodies  210 rollouts/s  0:03:12 until they "
       "are drawn"},
      {"preparing", "4",
       "generation 5: preparing 34 of 64 pretraining bodies  210 rollouts/s  0:03:12 left"},
      {"idle", "4", ""}};
  char text[512];
  for (size_t i = 0; i < sizeof(tries) / sizeof(tries[0]); i++) {
    snprintf(text, sizeof(text), job, tries[i].phase, tries[i].generation);
    json_t *campaign = json_loads(text, 0, NULL);
    char *words = text_from(campaign, CAMPAIGN_NOW_WORDS);
    CHECK_TEXT(words, tries[i].expected);
    free(words);
    json_decref(campaign);
  }
  const struct campaign_row row = {
      3, {0.41234, (double)NAN, 0.2, 0.21, 12.5, (double)NAN, 23.04, 1.25}};
  campaign_row_text(&row, text, sizeof(text));
  CHECK_TEXT(text, "mean 0.4123  best 0.2000  diversity 0.2100  survived: mutants 12 % "
                   "recombinants –  voxels 23.0  1.2 s");
}

static char drawn[40][800];
static int n_drawn;

/* Draws a campaign and keeps its lines. */
static void draw(const struct campaign *campaign, int columns, int table_rows)
{
  char *text = campaign_draw(campaign, columns, table_rows), *rest = text;
  n_drawn = 0;
  for (char *line; (line = strsep(&rest, "\n")) != NULL && rest != NULL && n_drawn < 40;)
    snprintf(drawn[n_drawn++], sizeof(drawn[0]), "%s", line);
  free(text);
}

static void view(void)
{
  struct campaign_row rows[100];
  for (int i = 0; i < 100; i++)
    rows[i] = (struct campaign_row){
        i, {1.0 / (i + 1), 0.5, 0.1, 0.2, i > 0 ? 25 : (double)NAN, 50, 20, 1}};
  struct ctl ctl = {.utf8 = true};
  struct campaign campaign = {.live.ctl = &ctl, .rows = rows, .n = 100};
  draw(&campaign, 80, 5);
  CHECK(n_drawn == 6 + 2 + 5);
  for (int i = 0; i < n_drawn; i++)
    CHECK(text_width(drawn[i]) <= (i < 6 ? 80 : 92));
  CHECK(strncmp(drawn[0], "mean score       0.0100  █", strlen("mean score       0.0100  █")) == 0);
  CHECK(strtol(drawn[8], NULL, 10) == 95 && strtol(drawn[12], NULL, 10) == 99);
  for (int i = 9; i < n_drawn; i++)
    CHECK(text_width(drawn[i]) == text_width(drawn[7])); /* columns stand under their heads */
  campaign.n = 0;
  draw(&campaign, 80, 5);
  CHECK(n_drawn == 1);
  campaign.n = 1;
  draw(&campaign, 10, 0); /* too narrow for curves */
  CHECK(n_drawn == 0);
}

static const struct check_case cases[] = {
    {"sparklines", sparks}, {"texts", texts}, {"the view", view}};
CHECK_MAIN(cases)
