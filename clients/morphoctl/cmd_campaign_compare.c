/* cmd_campaign_compare.c: campaign compare: compares campaigns by their best scores at the newest
 * generation that all of them have reached. A campaign and its replicates form one side; their
 * spread gives the interval. Scores under different physics, environments or aggregates are not
 * comparable, so such comparisons are rejected; other differences in settings are listed. */
#include <inttypes.h>
#include <math.h>
#include <string.h>

#include "commands.h"
#include "differences.h"
#include "stats.h"

enum { SIDES_MAX = 8, REPLICATES_MAX = 100 };

struct side {
  json_t *json;          /* printed description */
  const json_t *members; /* the campaigns that are compared */
  double scores[REPLICATES_MAX];
  size_t n;
};

static bool ended_early(const json_t *campaign)
{
  const char *state = text_of(campaign, "state");
  return strcmp(state, "cancelled") == 0 || strcmp(state, "failed") == 0;
}

/* Returns whether another side has the same group. If so, each side is only the named campaign. */
static bool shares_group(const struct ctl *ctl, const json_t *const campaigns[], size_t n)
{
  for (size_t i = 0; i < ctl->n_operands; i++)
    if (i != n &&
        json_equal(value_at(campaigns[i], "group.id"), value_at(campaigns[n], "group.id")))
      return true;
  return false;
}

/* Fills a side with the replicates of a campaign. Replicates that ended early are only listed,
 * unless all did. */
static void choose_members(struct ctl *ctl, const json_t *campaign, bool alone, struct side *side)
{
  json_t *early = json_array(), *names = json_array(), *members = keep(json_array());
  const json_t *group = keep(json_pack("[O]", campaign)), *one;
  size_t i;
  if (!alone) {
    const char *id = json_string_value(value_at(campaign, "group.id"));
    group = collect(ctl, path_to("/v1/campaigns?group=%s&archived=all", id), REPLICATES_MAX);
  }
  json_array_foreach(group, i, one)
  {
    if (!alone && ended_early(one))
      json_array_append_new(early, json_pack("{s:O, s:O}", "id", json_object_get(one, "id"),
                                             "state", json_object_get(one, "state")));
    else
      json_array_append(members, (json_t *)one);
  }
  if (json_array_size(members) == 0) {
    members = (json_t *)group;
    json_array_clear(early);
  }
  side->members = members;
  json_array_foreach(side->members, i, one) json_array_append(names, json_object_get(one, "id"));
  side->json =
      keep(json_pack("{s:O, s:O, s:o, s:o}", "campaign", json_object_get(campaign, "id"), "label",
                     json_object_get(campaign, "label"), "replicates", names, "left_out", early));
}

/* ---- settings ---- */

/* Returns the settings that scores depend on, except the seed: members for find_differences. */
static json_t *conditions_of(struct ctl *ctl, const json_t *campaign)
{
  json_t *settings = keep(json_copy(json_object_get(campaign, "settings"))), *worlds = json_array();
  const json_t *items = json_object_get(
                   get_json(ctl, "/v1/campaigns/%s/environments", text_of(campaign, "id")),
                   "items"),
               *one;
  size_t i;
  json_array_foreach(items, i, one) json_array_append(worlds, json_object_get(one, "sha256"));
  json_object_del(settings, "seed");
  json_object_set_new(settings, "environments", worlds);
  json_t *own = json_object_get(campaign, "own_score");
  return keep(json_pack("{s:O, s:O, s:O?, s:O, s:O?}", "mode", json_object_get(campaign, "mode"),
                        "settings", settings, "controller", value_at(campaign, "controller.sha256"),
                        "device", json_object_get(campaign, "device"), "own_score",
                        json_is_object(own) ? own : NULL));
}

/* Adds to a side the settings that differ from the first side. Ends the program if their scores
 * cannot be compared. */
static void add_differences(struct side *side, const json_t *first, const json_t *own,
                            const char *a, const char *b)
{
  json_t *found = differences_of(first, own);
  const json_t *one;
  size_t i;
  json_array_foreach(found, i, one)
  {
    const char *setting = text_of(one, "setting");
    if (strncmp(setting, "own_score", strlen("own_score")) == 0 ||
        strncmp(setting, "settings.aggregate", strlen("settings.aggregate")) == 0)
      fail(STATUS_NEGATIVE,
           "campaigns %s and %s have different settings for %s (%s, %s), so their scores are not "
           "comparable. Evaluate the champions of both instead: morphoctl campaign champions, then "
           "morphoctl eval",
           a, b, setting, short_text(value_at(one, "values.0")),
           short_text(value_at(one, "values.1")));
    if (strcmp(setting, "settings.environments") == 0)
      fail(STATUS_NEGATIVE,
           "campaigns %s and %s are in different environments: their scores are not comparable. "
           "Score their champions in the same environments: campaign champions, eval",
           a, b);
    if (strncmp(setting, "settings.physics.", 17) == 0)
      fail(
          STATUS_NEGATIVE,
          "campaigns %s and %s differ in %s (%s, %s): their scores are not comparable. Score their "
          "champions under one physics: campaign champions, eval",
          a, b, setting + 9, short_text(value_at(one, "values.0")),
          short_text(value_at(one, "values.1")));
  }
  json_object_set(side->json, "differences", found);
}

/* ---- scores ---- */

/* Lowers *newest to the newest generation that all campaigns of a side have reached. */
static void find_newest(const struct side *side, int64_t *newest)
{
  const json_t *one;
  size_t i;
  json_array_foreach(side->members, i, one)
  {
    const json_t *generation = value_at(one, "newest.generation");
    if (generation == NULL)
      fail(STATUS_NEGATIVE, "campaign %s has no complete generation yet", text_of(one, "id"));
    if (json_integer_value(generation) < *newest)
      *newest = json_integer_value(generation);
  }
}

static void read_scores(struct ctl *ctl, struct side *side, int64_t generation)
{
  const char *cursor = generation > 0 ? keep(format_text("&cursor=%" PRId64, generation - 1)) : "";
  const json_t *one;
  size_t i;
  json_array_foreach(side->members, i, one)
  {
    const json_t *page =
        get_json(ctl, "/v1/campaigns/%s/generations?limit=1%s", text_of(one, "id"), cursor);
    side->scores[side->n++] = real_at(page, "items.0.score.quantiles.p0");
  }
}

/* Adds its comparison with the first side to a side. */
static void compare(const struct side *first, struct side *side)
{
  const struct interval found = compare_means(first->scores, first->n, side->scores, side->n);
  double sum = 0;
  for (size_t i = 0; i < side->n; i++)
    sum += side->scores[i];
  json_object_set_new(side->json, "best", real_or_null(sum / (double)side->n));
  if (side == first)
    return;
  json_object_set_new(side->json, "difference", real_or_null(found.difference));
  json_object_set_new(side->json, "low", real_or_null(found.low));
  json_object_set_new(side->json, "high", real_or_null(found.high));
  json_object_set_new(side->json, "verdict", json_string(verdict_of(found.low, found.high)));
}

static void print_verdict(const struct side *first, const struct side *side)
{
  const char *a = text_of(first->json, "campaign"), *b = text_of(side->json, "campaign"),
             *verdict = text_of(side->json, "verdict");
  const double difference = real_at(side->json, "difference");
  if (first->n < 2 || side->n < 2)
    print_plain_line(stdout,
                     "Cannot say whether campaign %s is better than %s: a confidence interval "
                     "needs at least two replicates of each.",
                     b, a);
  else if (strcmp(verdict, "undecided") == 0)
    print_plain_line(stdout,
                     "No significant difference between campaigns %s and %s: the confidence "
                     "interval of the difference includes 0. More replicates would narrow it.",
                     a, b);
  else
    print_plain_line(stdout, "Campaign %s is %s than %s: its best score is %s by %.4f.", b, verdict,
                     a, difference < 0 ? "lower" : "higher", fabs(difference));
}

static void print_comparison(const struct ctl *ctl, const struct side *sides, size_t n,
                             int64_t generation)
{
  json_t *rows = keep(json_array());
  for (size_t i = 0; i < n; i++)
    json_array_append(rows, sides[i].json);
  if (ctl->json) {
    print_json(keep(json_pack("{s:I, s:f, s:O}", "generation", (json_int_t)generation, "confidence",
                              CONFIDENCE, "sides", rows)));
    return;
  }
  print_fact(ctl, "generation",
             "%" PRId64 ", the newest that all have reached; best scores, lower is "
             "better",
             generation);
  print_table(stdout, ctl, rows,
              ">campaign={campaign}|label={label}|>replicates={replicates:#}"
              "|>best score={best:.4f}|>difference=[{difference:.4f}|–]"
              "|>95 % from=[{low:.4f}|–]|>to=[{high:.4f}|–]|verdict=[{verdict}|–]");
  for (size_t i = 0; i < n; i++) {
    const json_t *one;
    size_t k;
    json_array_foreach(json_object_get(sides[i].json, "left_out"), k, one)
        print_fact(ctl, "left out", "campaign %s, a replicate of %s: it %s early",
                   text_of(one, "id"), text_of(sides[i].json, "campaign"),
                   strcmp(text_of(one, "state"), "failed") == 0 ? "failed" : "was cancelled");
  }
  for (size_t i = 1; i < n; i++)
    print_setting_differences(ctl,
                              keep(format_text("campaign %s", text_of(sides[i].json, "campaign"))),
                              json_object_get(sides[i].json, "differences"));
  for (size_t i = 1; i < n; i++)
    print_verdict(&sides[0], &sides[i]);
}

void run_campaign_compare(struct ctl *ctl)
{
  static struct side sides[SIDES_MAX];
  const json_t *campaigns[SIDES_MAX] = {0};
  const size_t n = ctl->n_operands;
  if (n > SIDES_MAX)
    fail(STATUS_USAGE, "at most %d campaigns can be compared, got %zu", SIDES_MAX, n);
  require_distinct(ctl, "campaign");
  int64_t generation = INT64_MAX;
  for (size_t i = 0; i < n; i++)
    campaigns[i] = get_json(ctl, "/v1/campaigns/%s", job_id(ctl->operands[i]));
  for (size_t i = 0; i < n; i++)
    choose_members(ctl, campaigns[i], shares_group(ctl, campaigns, i), &sides[i]);
  const json_t *first = conditions_of(ctl, campaigns[0]);
  for (size_t i = 1; i < n; i++)
    add_differences(&sides[i], first, conditions_of(ctl, campaigns[i]), ctl->operands[0],
                    ctl->operands[i]);
  for (size_t i = 0; i < n; i++)
    find_newest(&sides[i], &generation);
  for (size_t i = 0; i < n; i++)
    read_scores(ctl, &sides[i], generation);
  for (size_t i = 0; i < n; i++)
    compare(&sides[0], &sides[i]);
  print_comparison(ctl, sides, n, generation);
}
