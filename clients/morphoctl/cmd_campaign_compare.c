/* cmd_campaign_compare.c: campaign compare: compares campaigns by their best scores at the newest
 * generation that all have. A campaign with its replicates is one side; their spread gives the
 * interval. */
#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "stats.h"
#include "table.h"
#include "template.h"
#include "transport.h"

enum { SIDES_MAX = 8, REPLICATES_MAX = 100 };

struct side {
  json_t *json;    /* what is told of it */
  json_t *members; /* the campaigns that count */
  double scores[REPLICATES_MAX];
  size_t n;
};

static bool ended_early(const json_t *campaign)
{
  const char *state = text_of(campaign, "state");
  return strcmp(state, "cancelled") == 0 || strcmp(state, "failed") == 0;
}

/* Returns whether another side has the same group: then each is the one campaign that was named. */
static bool shares_group(const struct ctl *ctl, const json_t *const campaigns[], size_t n)
{
  for (size_t i = 0; i < ctl->n_operands; i++)
    if (i != n &&
        json_equal(value_at(campaigns[i], "group.id"), value_at(campaigns[n], "group.id")))
      return true;
  return false;
}

/* Fills a side with the replicates of a campaign. Those that ended early are only named, unless all
 * did. */
static int choose_members(struct ctl *ctl, json_t *campaign, bool alone, struct side *side)
{
  json_t *group = json_pack("[O]", campaign), *early = json_array(), *names = json_array(), *one;
  int status = STATUS_OK;
  size_t i;
  if (!alone) {
    json_decref(group);
    const char *id = json_string_value(value_at(campaign, "group.id"));
    status = collect(ctl, path_to("/v1/campaigns?group=%s", id), REPLICATES_MAX, &group);
  }
  side->members = json_array();
  json_array_foreach(group, i, one)
  {
    if (!alone && ended_early(one))
      json_array_append_new(early, json_pack("{s:O, s:O}", "id", json_object_get(one, "id"),
                                             "state", json_object_get(one, "state")));
    else
      json_array_append(side->members, one);
  }
  if (json_array_size(side->members) == 0 && group != NULL) {
    json_array_extend(side->members, group);
    json_array_clear(early);
  }
  json_array_foreach(side->members, i, one) json_array_append(names, json_object_get(one, "id"));
  side->json =
      need(json_pack("{s:O, s:O, s:o, s:o}", "campaign", json_object_get(campaign, "id"), "label",
                     json_object_get(campaign, "label"), "replicates", names, "left_out", early));
  json_decref(group);
  return status;
}

/* Lowers *newest to the newest generation that all of a side have. */
static int find_newest(const struct side *side, int64_t *newest)
{
  const json_t *one;
  size_t i;
  json_array_foreach(side->members, i, one)
  {
    const json_t *generation = value_at(one, "newest.generation");
    if (generation == NULL)
      return complain(STATUS_NEGATIVE, "campaign %s has no generation yet", text_of(one, "id"));
    if (json_integer_value(generation) < *newest)
      *newest = json_integer_value(generation);
  }
  return STATUS_OK;
}

static int read_scores(struct ctl *ctl, struct side *side, int64_t generation)
{
  int status = STATUS_OK;
  char cursor[32] = "";
  const json_t *one;
  size_t i;
  if (generation > 0)
    snprintf(cursor, sizeof(cursor), "&cursor=%" PRId64, generation - 1);
  json_array_foreach(side->members, i, one)
  {
    json_t *page = NULL;
    if (status == STATUS_OK)
      status = get_json(ctl, &page, "/v1/campaigns/%s/generations?limit=1%s", text_of(one, "id"),
                        cursor);
    side->scores[side->n++] =
        real_at(json_array_get(json_object_get(page, "items"), 0), "score.quantiles.p0");
    json_decref(page);
  }
  return status;
}

/* Adds to a side how it compares with the first. */
static void compare(const struct side *first, struct side *side)
{
  const struct interval found =
      compare_means(first->scores, first->n, side->scores, side->n, CONFIDENCE);
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
                     "Whether campaign %s is better than %s is not shown: an interval needs two "
                     "replicates of each.",
                     b, a);
  else if (strcmp(verdict, "undecided") == 0)
    print_plain_line(stdout,
                     "Which of campaigns %s and %s is better is not shown: the interval of the "
                     "difference holds 0. More replicates make it narrower.",
                     a, b);
  else
    print_plain_line(stdout, "Campaign %s is %s than %s: its best score is %s by %.4f.", b, verdict,
                     a, difference < 0 ? "lower" : "higher", fabs(difference));
}

static void print_comparison(const struct ctl *ctl, const struct side *sides, size_t n,
                             int64_t generation)
{
  json_t *rows = json_array();
  for (size_t i = 0; i < n; i++)
    json_array_append(rows, sides[i].json);
  print_fact(ctl, "generation",
             "%" PRId64 ", the newest that all have; best scores, lower is "
             "better",
             generation);
  print_table(stdout, ctl, rows,
              ">campaign={campaign}|label={label}|>replicates={replicates:#}"
              "|>best score={best:.4f}|>difference=[{difference:.4f}|–]"
              "|>95 % from=[{low:.4f}|–]|>to=[{high:.4f}|–]|verdict=[{verdict}|–]");
  json_decref(rows);
  for (size_t i = 0; i < n; i++) {
    const json_t *one;
    size_t k;
    json_array_foreach(json_object_get(sides[i].json, "left_out"), k, one) print_fact(
        ctl, "left out", "campaign %s, a replicate of %s: it was %s early", text_of(one, "id"),
        text_of(sides[i].json, "campaign"),
        strcmp(text_of(one, "state"), "failed") == 0 ? "ended by a failure" : "cancelled");
  }
  for (size_t i = 1; i < n; i++)
    print_verdict(&sides[0], &sides[i]);
}

static void print_comparison_json(const struct side *sides, size_t n, int64_t generation)
{
  json_t *list = json_array();
  for (size_t i = 0; i < n; i++)
    json_array_append(list, sides[i].json);
  json_t *json = json_pack("{s:I, s:f, s:o}", "generation", (json_int_t)generation, "confidence",
                           CONFIDENCE, "sides", list);
  print_json(json);
  json_decref(json);
}

int run_campaign_compare(struct ctl *ctl)
{
  struct side sides[SIDES_MAX] = {0};
  json_t *campaigns[SIDES_MAX] = {0};
  const size_t n = ctl->n_operands;
  int64_t generation = INT64_MAX;
  int status = STATUS_OK;
  for (size_t i = 0; i < n && status == STATUS_OK; i++)
    status = check_job_id(ctl->operands[i])
                 ? get_json(ctl, &campaigns[i], "/v1/campaigns/%s", ctl->operands[i])
                 : STATUS_USAGE;
  for (size_t i = 0; i < n && status == STATUS_OK; i++)
    status = choose_members(ctl, campaigns[i],
                            shares_group(ctl, (const json_t *const *)campaigns, i), &sides[i]);
  for (size_t i = 0; i < n && status == STATUS_OK; i++)
    status = find_newest(&sides[i], &generation);
  for (size_t i = 0; i < n && status == STATUS_OK; i++)
    status = read_scores(ctl, &sides[i], generation);
  for (size_t i = 0; i < n && status == STATUS_OK; i++)
    compare(&sides[0], &sides[i]);
  if (status == STATUS_OK && ctl->json)
    print_comparison_json(sides, n, generation);
  else if (status == STATUS_OK)
    print_comparison(ctl, sides, n, generation);
  for (size_t i = 0; i < n; i++) {
    json_decref(campaigns[i]);
    json_decref(sides[i].members);
    json_decref(sides[i].json);
  }
  return status;
}
