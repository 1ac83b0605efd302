/* How campaigns are shown: sparklines, lines of generations, the view. */
#include "campaign.h"
#include "commands.h"

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
  char text[256];
  campaign_generation_text(-1, 30, text, sizeof(text));
  CHECK_TEXT(text, "before generation 0 of 30");
  campaign_generation_text(1200, 100000, text, sizeof(text));
  CHECK_TEXT(text, "generation 1,200 of 100,000");
  const struct campaign_row row = {.generation = 3,
                                   .mean = 0.41234,
                                   .best = 0.2,
                                   .diversity = 0.21,
                                   .mutants = 0.125,
                                   .recombinants = (double)NAN,
                                   .voxels = 23.04,
                                   .seconds = 1.25};
  campaign_row_text(&row, text, sizeof(text));
  CHECK_TEXT(text, "mean 0.4123  best 0.2000  diversity 0.2100  survived: mutants 12 % "
                   "recombinants –  voxels 23.0  1.2 s");
  json_t *campaign = json_loads(
      "{\"phase\": \"scoring\", \"progress\": {\"under_way\": 5, \"done\": 34, \"total\": "
      "64, \"rollouts_per_s\": 210.4,"
      "\"seconds_left\": 192}}",
      0, NULL);
  campaign_progress_text(campaign, text, sizeof(text));
  CHECK_TEXT(text, "generation 5: scoring 34 of 64 designs  210 rollouts/s  0:03:12 left");
  json_object_set_new(campaign, "phase", json_string("preparing"));
  campaign_progress_text(campaign, text, sizeof(text));
  CHECK_TEXT(text, "generation 5: preparing 34 of 64 bodies of the pretraining  210 rollouts/s  "
                   "0:03:12 until they are drawn");
  json_object_set_new(json_object_get(campaign, "progress"), "generation", json_integer(4));
  campaign_progress_text(campaign, text, sizeof(text));
  CHECK_TEXT(
      text,
      "generation 5: preparing 34 of 64 bodies of the pretraining  210 rollouts/s  0:03:12 left");
  json_object_set_new(campaign, "phase", json_string("idle"));
  campaign_progress_text(campaign, text, sizeof(text));
  CHECK(*text == 0);
  json_decref(campaign);
  json_t *data = json_loads("{\"generation\": 7, \"generations\": 30, \"mean\": 0.5, \"best\": "
                            "null, \"diversity\": 0.25}",
                            0, NULL);
  campaign_event_text("campaign.generation", data, text, sizeof(text));
  CHECK_TEXT(text, "  generation 7 of 30  mean 0.5000  best –  diversity 0.2500");
  campaign_event_text("job.started", data, text, sizeof(text));
  CHECK(*text == 0);
  json_decref(data);
  data = json_loads("{\"controller\": \"0123456789abcdef\", \"field\": \"morphod.seed\", "
                    "\"detail\": \"no number\"}",
                    0, NULL);
  campaign_event_text("campaign.lineage_unreadable", data, text, sizeof(text));
  CHECK_TEXT(text, "  morphod.seed of controller 0123456789ab: no number");
  json_decref(data);
}

static char drawn[40][800];
static int n_drawn;

static void keep(void *context, const char *text)
{
  (void)context;
  if (n_drawn < 40)
    snprintf(drawn[n_drawn++], sizeof(drawn[0]), "%s", text);
}

static size_t width(const char *text)
{
  size_t n = 0;
  for (; *text != '\0'; text++)
    n += ((unsigned char)*text & 0xc0) != 0x80;
  return n;
}

static void view(void)
{
  struct campaign_row rows[100];
  for (int i = 0; i < 100; i++)
    rows[i] = (struct campaign_row){.generation = i,
                                    .mean = 1.0 / (i + 1),
                                    .median = 0.5,
                                    .best = 0.1,
                                    .diversity = 0.2,
                                    .mutants = i > 0 ? 0.25 : (double)NAN,
                                    .recombinants = 0.5,
                                    .voxels = 20,
                                    .seconds = 1};
  struct campaign campaign = {.rows = rows, .n = 100};
  struct ctl ctl = {.utf8 = true};
  campaign_draw(&ctl, &campaign, 80, 5, keep, NULL);
  CHECK(n_drawn == 6 + 2 + 5);
  for (int i = 0; i < n_drawn; i++)
    CHECK(width(drawn[i]) <= (i < 6 ? 80 : 92));
  CHECK(strncmp(drawn[0], "mean score       0.0100  █", strlen("mean score       0.0100  █")) == 0);
  CHECK(strtol(drawn[8], NULL, 10) == 95 && strtol(drawn[12], NULL, 10) == 99);
  for (int i = 9; i < n_drawn; i++)
    CHECK(width(drawn[i]) == width(drawn[7])); /* columns stand under their heads */
  n_drawn = 0;
  campaign.n = 0;
  campaign_draw(&ctl, &campaign, 80, 5, keep, NULL);
  CHECK(n_drawn == 1);
  n_drawn = 0;
  campaign.n = 1;
  campaign_draw(&ctl, &campaign, 10, 0, keep, NULL); /* too narrow for curves */
  CHECK(n_drawn == 0);
}

static const struct check_case cases[] = {
    {"sparklines", sparks}, {"texts", texts}, {"the view", view}};
CHECK_MAIN(cases)
