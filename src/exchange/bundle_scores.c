/* bundle_scores.c: see bundle_scores.h. The lines of a design contain each loss of a class once,
 * and the score of the design follows from its losses, bit for bit.
 *
 * Older programs wrote a loss twice if two blocks of their store had it. Therefore a limited number
 * of lines may repeat an earlier line from another block. */
#include "exchange/bundle_scores.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "store/hash.h"

#define CLASSES 32 /* of one design */
#define AGAIN   64 /* lines of one design without a new loss */

struct class {
  char fingerprint[MO_FINGERPRINT_BYTES];
  uint64_t known; /* a bit for each place */
  double losses[MO_ENVIRONMENTS_MAX];
  uint32_t diverged_steps[MO_ENVIRONMENTS_MAX];
  int64_t computed_us[MO_ENVIRONMENTS_MAX];
  uint64_t measured; /* a bit for each place */
  double measures[MO_ENVIRONMENTS_MAX][MO_MEASURES];
};

struct mo_bundle_scores {
  uint32_t n_environments, measures; /* measures: of the campaign, as bits */
  bool selects_by_measure;
  struct mo_aggregate aggregate;
  uint32_t same[MO_ENVIRONMENTS_MAX]; /* the first place with the same environment */
  uint32_t number, n, n_again;        /* n: classes */
  struct class classes[CLASSES];
};

struct mo_bundle_scores *mo_bundle_scores_create(void)
{
  return calloc(1, sizeof(struct mo_bundle_scores));
}

void mo_bundle_scores_free(struct mo_bundle_scores *scores)
{
  free(scores);
}

void mo_bundle_scores_open(struct mo_bundle_scores *scores,
                           const struct mo_imported_campaign *campaign)
{
  struct mo_sha256 hashes[MO_ENVIRONMENTS_MAX];
  scores->n_environments = campaign->record.n_environments;
  scores->measures = campaign->record.measures;
  scores->selects_by_measure = campaign->record.select_by.is_set;
  scores->aggregate = campaign->record.settings.aggregate;
  for (uint32_t k = 0; k < scores->n_environments; k++) {
    uint32_t i = 0;
    mo_environment_hash(&campaign->environments[k], &hashes[k]);
    while (!mo_sha256_equal(&hashes[i], &hashes[k]))
      i++;
    scores->same[k] = i;
  }
}

void mo_bundle_scores_begin(struct mo_bundle_scores *scores, uint32_t number)
{
  scores->number = number;
  scores->n = scores->n_again = 0;
}

static bool same_bits(double a, double b)
{
  uint64_t words[2];
  memcpy(&words[0], &a, sizeof(a));
  memcpy(&words[1], &b, sizeof(b));
  return words[0] == words[1];
}

static struct class *class_of(struct mo_bundle_scores *scores, const char *fingerprint)
{
  uint32_t i = 0;
  while (i < scores->n && strcmp(scores->classes[i].fingerprint, fingerprint) != 0)
    i++;
  if (i == CLASSES)
    return NULL;
  if (i == scores->n) {
    memset(&scores->classes[i], 0, sizeof(scores->classes[i]));
    snprintf(scores->classes[i].fingerprint, sizeof(scores->classes[i].fingerprint), "%s",
             fingerprint);
    scores->n++;
  }
  return &scores->classes[i];
}

int mo_bundle_scores_add(struct mo_bundle_scores *scores, const struct mo_campaign_score *score,
                         struct mo_message *message)
{
  struct class *class = class_of(scores, score->fingerprint);
  bool is_new = false, is_same = true;
  if (class == NULL)
    return mo_fail(message, MO_ERR_FORMAT, "there may be at most %d classes of scores", CLASSES);
  for (uint32_t k = 0; k < score->n; k++) {
    const uint32_t place = score->environments[k];
    if (score->measures != NULL) {
      class->measured |= UINT64_C(1) << place;
      memcpy(class->measures[place], score->measures[k], sizeof(class->measures[place]));
    }
    if (class->known >> place & 1) {
      if (!same_bits(class->losses[place], score->losses[k]) ||
          class->diverged_steps[place] != score->diverged_steps[k])
        return mo_fail(message, MO_ERR_FORMAT,
                       "environment %u has a different loss in an earlier line of this class",
                       place);
      is_same = is_same && class->computed_us[place] == score->computed_us;
      continue;
    }
    is_new = true;
    class->known |= UINT64_C(1) << place;
    class->losses[place] = score->losses[k];
    class->diverged_steps[place] = score->diverged_steps[k];
    class->computed_us[place] = score->computed_us;
  }
  if (!is_new && (is_same || ++scores->n_again > AGAIN))
    return mo_fail(message, MO_ERR_DUPLICATE,
                   "duplicate line: earlier lines of the design have all of these losses");
  return is_new;
}

/* Returns the score that follows from the losses, in the order of the environments, as in campaigns
 * (mo_aggregate_score). Uses the losses of class `a`, or of class `b` where `a` has none. */
static double score_of(const struct mo_bundle_scores *scores, const struct class *a,
                       const struct class *b, bool *is_whole)
{
  double losses[MO_ENVIRONMENTS_MAX];
  *is_whole = true;
  for (uint32_t k = 0; k < scores->n_environments; k++) {
    const uint32_t place = scores->same[k];
    const struct class *class = a->known >> place & 1 ? a : b;
    const bool is_known = class->known >> place & 1;
    losses[k] = is_known ? class->losses[place] : NAN;
    *is_whole = *is_whole && is_known;
  }
  return mo_aggregate_score(&scores->aggregate, losses, scores->n_environments);
}

/* Returns whether the measures of a class have these means. */
static bool has_means(const struct mo_bundle_scores *scores, const struct class *class,
                      const double *means)
{
  double values[MO_ENVIRONMENTS_MAX][MO_MEASURES], own[MO_MEASURES];
  bool same = true;
  for (uint32_t k = 0; k < scores->n_environments; k++) {
    const uint32_t place = scores->same[k];
    if ((class->measured >> place & 1) == 0)
      return false;
    memcpy(values[k], class->measures[place], sizeof(values[k]));
  }
  const uint32_t n = mo_measures_mean(scores->measures, (const double(*)[MO_MEASURES])values,
                                      scores->n_environments, own);
  for (uint32_t m = 0; m < n; m++)
    same = same && (isnan(means[m]) ? isnan(own[m]) : same_bits(means[m], own[m]));
  return same;
}

/* A design that was cut short has no means. */
static bool check_means(const struct mo_bundle_scores *scores, bool is_cut, const double *means)
{
  bool found = means == NULL || is_cut;
  for (uint32_t a = 0; a < scores->n && !found; a++)
    found = has_means(scores, &scores->classes[a], means);
  return found;
}

int mo_bundle_scores_end(const struct mo_bundle_scores *scores, double score, bool is_cut,
                         const double *means, struct mo_message *message)
{
  bool is_whole;
  if (!check_means(scores, is_cut, means))
    return mo_fail(message, MO_ERR_FORMAT,
                   "the measures of design %u are not the means over its rollouts", scores->number);
  if (scores->selects_by_measure)
    return MO_OK;
  for (uint32_t a = 0; a < scores->n; a++)
    for (uint32_t b = 0; b < scores->n; b++) {
      const double own = score_of(scores, &scores->classes[a], &scores->classes[b], &is_whole);
      /* A child is cut short once its score exceeds the bound or is infinite. Other jobs may have
       * computed more of its losses. */
      if ((is_cut && own >= score) || (same_bits(own, score) && (is_whole || isinf(own))))
        return MO_OK;
    }
  return mo_fail(message, MO_ERR_FORMAT,
                 "the score of design %u, %.17g, is not the %s of its losses", scores->number,
                 score, mo_aggregate_words[scores->aggregate.kind]);
}
