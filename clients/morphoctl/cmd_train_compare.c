/* cmd_train_compare.c: train compare: compares two controllers on one held-out set, rollout by
 * rollout. A trained controller carries the settings of its training run, even if it came from
 * elsewhere; settings that differ are listed, because they may explain the difference in scores. */
#include <inttypes.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "base/text.h"
#include "commands.h"
#include "differences.h"
#include "stats.h"

#define PREFIX   "morphod." /* of the metadata that a training run adds */
#define SETTINGS PREFIX "settings"

struct side {
  const char *name;     /* as given */
  const json_t *about;  /* the controller */
  const json_t *recipe; /* the settings of its training run; NULL if they are not in its file */
  const json_t *evaluation;
  double *losses; /* (n, n_environments); NaN if the rollout diverged */
  size_t n, n_environments;
  size_t diverged; /* number of designs */
  size_t rollouts, rollouts_diverged;
};

/* ---- training runs ---- */

static void read_side(struct ctl *ctl, struct side *side)
{
  side->about = get_json(ctl, "/v1/controllers/%s", escape(side->name));
  const char *text =
      json_string_value(json_object_get(json_object_get(side->about, "metadata"), SETTINGS));
  json_t *recipe = text != NULL ? json_loads(text, JSON_REJECT_DUPLICATES, NULL) : NULL;
  side->recipe = json_is_object(recipe) ? keep(recipe) : NULL;
  if (side->recipe == NULL)
    json_decref(recipe);
}

/* Returns what may explain a difference in scores, except the seed: members for differences_of.
 * trained: whether both have the entries that a training run adds to the metadata. */
static json_t *conditions_of(const struct side *side, bool trained)
{
  json_t *conditions = keep(json_object()), *value;
  const char *name;
  json_object_set(conditions, "sensor", json_object_get(side->about, "sensor"));
  if (!trained) { /* otherwise it is in the physics */
    name = "control_period_s";
    json_object_set(conditions, name, json_object_get(side->about, name));
    return conditions;
  }
  json_object_foreach(json_object_get(side->about, "metadata"), name, value)
  {
    const bool is_left_out = strcmp(name, PREFIX "seed") == 0 ||
                             strcmp(name, PREFIX "code") == 0; /* its end is in the version */
    if (strncmp(name, PREFIX, strlen(PREFIX)) == 0 && !is_left_out)
      json_object_set(conditions, name + strlen(PREFIX), value);
  }
  json_object_set(conditions, SETTINGS + strlen(PREFIX), (json_t *)side->recipe);
  return conditions;
}

/* Ends the program if both names mean one controller. Returns the differences. */
static json_t *settings_that_differ(const struct side sides[2])
{
  const char *sha256 = text_of(sides[0].about, "sha256");
  if (sha256[0] != '\0' && strcmp(sha256, text_of(sides[1].about, "sha256")) == 0)
    fail(STATUS_NEGATIVE,
         "%s and %s are the same controller (sha256:%s): there is nothing to compare. See "
         "morphoctl controller list for others",
         sides[0].name, sides[1].name, sha256);
  const bool trained = sides[0].recipe != NULL && sides[1].recipe != NULL;
  return differences_of(conditions_of(&sides[0], trained), conditions_of(&sides[1], trained));
}

static void print_trainings(const struct ctl *ctl, const struct side sides[2],
                            const json_t *differences)
{
  print_setting_differences(ctl, sides[1].name, differences);
  for (int s = 0; s < 2; s++) {
    const int64_t tasks = number_of(sides[s].recipe, "tasks"),
                  worlds = number_of(sides[s].recipe, "environments");
    if (sides[s].recipe == NULL)
      print_fact(ctl, "not known",
                 "how %s was trained: its file does not say, so training settings are not compared",
                 sides[s].name);
    if (tasks > 0 || worlds > 0)
      print_fact(ctl, "note",
                 "%s learned in %" PRId64 " %s of its own; here robots reach stationary lights. "
                 "To score its own: morphoctl eval --environments … -c %s",
                 sides[s].name, tasks > 0 ? tasks : worlds, tasks > 0 ? "tasks" : "environments",
                 sides[s].name);
  }
}

/* ---- scores ---- */

static void score_side(struct ctl *ctl, const json_t *held_out, struct side *side)
{
  json_t *request = keep(json_copy((json_t *)held_out));
  const json_t *result;
  size_t i;
  if (json_object_set_new(request, "controller", json_string(side->name)) != 0)
    fail(STATUS_USAGE, "\"%s\" is not the name of a controller", side->name);
  request_fill_physics(ctl, request);
  side->evaluation = evaluate(ctl, "/v1/evaluations", request, true);
  expect_success("job", side->evaluation);
  const json_t *results = json_object_get(side->evaluation, "results");
  side->n = json_array_size(results);
  side->n_environments = json_array_size(json_object_get(held_out, "environments"));
  side->losses = keep(calloc(side->n * side->n_environments + 1, sizeof(*side->losses)));
  json_array_foreach(results, i, result)
  {
    const json_t *losses = json_object_get(result, "losses");
    if (json_array_size(losses) != side->n_environments)
      fail(STATUS_ERROR, "the server's reply has %zu losses for a design, expected %zu",
           json_array_size(losses), side->n_environments);
    for (size_t k = 0; k < side->n_environments; k++) {
      const json_t *loss = json_array_get(losses, k);
      side->losses[i * side->n_environments + k] =
          json_is_number(loss) ? json_number_value(loss) : NAN;
    }
    side->diverged += isnan(real_at(result, "score"));
    side->rollouts += side->n_environments;
    side->rollouts_diverged += json_array_size(json_object_get(result, "diverged"));
  }
}

static json_t *side_json(const struct side *side, double mean)
{
  return json_pack("{s:s, s:O, s:O, s:o, s:I, s:I, s:b}", "controller", side->name, "sha256",
                   json_object_get(json_object_get(side->evaluation, "controller"), "sha256"),
                   "evaluation", json_object_get(side->evaluation, "id"), "mean_score",
                   real_or_null(mean), "designs_diverged", (json_int_t)side->diverged,
                   "rollouts_diverged", (json_int_t)side->rollouts_diverged, "training_known",
                   side->recipe != NULL);
}

static void print_comparison_json(const struct side sides[2], const struct paired *paired,
                                  const json_t *differences, int64_t seed, int64_t n_environments)
{
  print_json(keep(json_pack(
      "{s:o, s:o, s:O, s:{s:I, s:I, s:I}, s:I, s:o, s:o, s:f, s:o, s:o, s:s, s:I, s:I, s:o, s:s}",
      "a", side_json(&sides[0], paired->mean_a), "b", side_json(&sides[1], paired->mean_b),
      "differences", differences, "held_out", "seed", (json_int_t)seed, "designs",
      (json_int_t)sides[0].n, "environments", (json_int_t)n_environments, "pairs",
      (json_int_t)paired->n, "difference", real_or_null(paired->difference), "standard_error",
      real_or_null(paired->error), "confidence", CONFIDENCE, "low", real_or_null(paired->low),
      "high", real_or_null(paired->high), "interval_for",
      n_environments < 2 ? "designs" : "designs and environments", "improved",
      (json_int_t)paired->improved, "equal", (json_int_t)paired->equal, "sign_test_p",
      real_or_null(paired->sign_p), "verdict", verdict_of(paired->low, paired->high))));
}

static void print_verdict(const struct side sides[2], const struct paired *paired)
{
  const char *a = sides[0].name, *b = sides[1].name;
  if (paired->n < 2)
    print_plain_line(stdout,
                     "Too few designs have a score with both controllers to say which is better.");
  else if (paired->high < 0 || paired->low > 0)
    print_plain_line(stdout,
                     "%s is %s than %s: its mean score is %s by %.4f (%.0f %% "
                     "confidence: %.4f to %.4f).",
                     b, verdict_of(paired->low, paired->high), a,
                     paired->high < 0 ? "lower" : "higher", fabs(paired->difference),
                     100 * CONFIDENCE, fmin(fabs(paired->low), fabs(paired->high)),
                     fmax(fabs(paired->low), fabs(paired->high)));
  else
    print_plain_line(stdout,
                     "No significant difference between %s and %s: the confidence interval of the "
                     "difference includes 0. More designs and environments would narrow it.",
                     a, b);
  if (paired->n >= 2 && paired->sign_p < 1 - CONFIDENCE &&
      strcmp(verdict_of(paired->low, paired->high),
             2 * paired->improved > paired->n - paired->equal ? "better" : "worse") != 0)
    print_plain_line(
        stdout,
        "However, most designs are better with %s (sign test, p = %.2g): the mean weighs how much "
        "they differ, the sign test how many.",
        2 * paired->improved > paired->n - paired->equal ? b : a, paired->sign_p);
}

static void print_comparison(const struct ctl *ctl, const struct side sides[2],
                             const struct paired *paired, const json_t *differences, int64_t seed,
                             int64_t n_environments)
{
  json_t *rows = keep(json_array());
  for (int s = 0; s < 2; s++) {
    json_t *row = side_json(&sides[s], s == 0 ? paired->mean_a : paired->mean_b);
    json_object_set_new(row, "side", json_string(s == 0 ? "A" : "B"));
    json_object_set_new(row, "designs", json_integer((json_int_t)sides[s].n));
    json_object_set_new(row, "rollouts", json_integer((json_int_t)sides[s].rollouts));
    json_array_append_new(rows, row);
  }
  print_fact(ctl, "held out", "%s × %s, seed %" PRId64, MO_COUNTED(sides[0].n, "design"),
             MO_COUNTED((uint64_t)n_environments, "environment"), seed);
  print_table(stdout, ctl, rows,
              "={side}|controller={controller}|>mean score={mean_score:.4f}"
              "|>diverged designs={designs_diverged} of {designs}"
              "|>diverged rollouts={rollouts_diverged} of {rollouts}|sha256={sha256}");
  print_trainings(ctl, sides, differences);
  if (paired->n >= 2)
    print_fact(ctl, "B - A",
               "%+.4f, %.0f %% confidence %+.4f to %+.4f for other designs%s (Student t, %.1f "
               "degrees of freedom)",
               paired->difference, 100 * CONFIDENCE, paired->low, paired->high,
               n_environments < 2 ? " in this environment" : " and environments", paired->freedom);
  if (paired->n > 0)
    print_fact(ctl, "improved", "%zu of %zu designs (%.1f %%), %zu equal; sign test p = %.2g",
               paired->improved, paired->n, 100 * (double)paired->improved / (double)paired->n,
               paired->equal, isnan(paired->sign_p) ? 1 : paired->sign_p);
  if (paired->n < sides[0].n)
    print_fact(ctl, "left out",
               "%s that diverged with A or B: left out of the means and the difference",
               MO_COUNTED(sides[0].n - paired->n, "design"));
  print_verdict(sides, paired);
}

void run_train_compare(struct ctl *ctl)
{
  struct side sides[2] = {{.name = ctl->operands[0]}, {.name = ctl->operands[1]}};
  require_distinct(ctl, "controller");
  const int64_t seed = option_number(ctl, "seed", 0, (INT64_C(1) << 53) - 1, 1),
                n_designs = option_number(ctl, "designs", 2, 1000, 64),
                n_environments = option_number(ctl, "environments", 1, 64, 16);
  const json_t *held_out =
      get_json(ctl, "/v1/held-out?seed=%" PRId64 "&designs=%" PRId64 "&environments=%" PRId64, seed,
               n_designs, n_environments);
  for (int s = 0; s < 2; s++) /* check both before the first rollout */
    read_side(ctl, &sides[s]);
  const json_t *differences = settings_that_differ(sides);
  for (int s = 0; s < 2; s++)
    score_side(ctl, held_out, &sides[s]);
  if (sides[0].n != sides[1].n)
    fail(STATUS_ERROR, "the server's replies have different numbers of designs");
  const struct paired paired =
      compare_crossed(sides[0].losses, sides[1].losses, sides[0].n, sides[0].n_environments);
  if (ctl->json)
    print_comparison_json(sides, &paired, differences, seed, n_environments);
  else
    print_comparison(ctl, sides, &paired, differences, seed, n_environments);
}
