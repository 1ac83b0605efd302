/* aggregate.c: computes the score of a design from its losses over the environments.
 *
 * A race needs lower bounds, so the mean, quantile and cvar must be monotone in every loss, not
 * only in exact arithmetic. They are: the order statistics are, because sorting does not round.
 * After that, losses are only multiplied by weights that are not negative, added, and divided by a
 * positive number. The weights depend only on the number of losses and the level, and rounding to
 * nearest never reverses the order of two numbers: if x ≤ y, then round(w · x) ≤ round(w · y), and
 * the same holds for sums and quotients. This is why a quantile is computed as (1 − f) · x + f · y:
 * x + f · (y − x) subtracts a loss, so with rounding errors the score could fall while x rises. */
#include <math.h>

#include "evolution/internal.h"

const char *const mo_aggregate_words[] = {"mean", "quantile", "cvar", "mean-sd", NULL};

double mo_race_score(const double *losses, uint32_t n)
{
  double sum = 0;
  for (uint32_t k = 0; k < n; k++)
    sum += isnan(losses[k]) ? 0 : losses[k];
  return sum / n;
}

/* Copies the losses in ascending order. Losses that were not computed count as 0. */
static void sort(const double *losses, uint32_t n, double sorted[MO_RACE_ENVIRONMENTS_MAX])
{
  for (uint32_t k = 0; k < n; k++) {
    const double loss = isnan(losses[k]) ? 0 : losses[k];
    uint32_t place = k;
    for (; place > 0 && sorted[place - 1] > loss; place--)
      sorted[place] = sorted[place - 1];
    sorted[place] = loss;
  }
}

/* sorted: ascending, finite. */
static double quantile(const double *sorted, uint32_t n, double level)
{
  const double place = level * (n - 1); /* counts from 0 */
  const uint32_t below = (uint32_t)place;
  const double share = place - below;
  return share > 0 ? (1 - share) * sorted[below] + share * sorted[below + 1] : sorted[below];
}

/* sorted: ascending, finite. */
static double cvar(const double *sorted, uint32_t n, double level)
{
  const double before = level * n; /* losses that are not in the worst share */
  const uint32_t first = (uint32_t)ceil(before);
  if (first == n) /* the worst share is at most one loss */
    return sorted[n - 1];
  double sum = first > 0 ? (first - before) * sorted[first - 1] : 0;
  for (uint32_t k = first; k < n; k++)
    sum += sorted[k];
  return sum / (n - before);
}

static double deviation(const double *losses, uint32_t n, double mean)
{
  double squares = 0;
  for (uint32_t k = 0; k < n; k++) {
    const double off = (isnan(losses[k]) ? 0 : losses[k]) - mean;
    squares += off * off;
  }
  return n > 1 ? sqrt(squares / (n - 1)) : 0;
}

double mo_aggregate_score(const struct mo_aggregate *aggregate, const double *losses, uint32_t n)
{
  double sorted[MO_RACE_ENVIRONMENTS_MAX];
  const double mean = mo_race_score(losses, n);
  if (aggregate->kind == MO_AGGREGATE_MEAN || n == 0 || isinf(mean))
    return mean;
  if (aggregate->kind == MO_AGGREGATE_MEAN_SD)
    return mean + aggregate->weight * deviation(losses, n, mean);
  sort(losses, n, sorted);
  return aggregate->kind == MO_AGGREGATE_QUANTILE ? quantile(sorted, n, aggregate->level)
                                                  : cvar(sorted, n, aggregate->level);
}

bool mo_aggregate_is_monotone(const struct mo_aggregate *aggregate)
{
  return aggregate->kind != MO_AGGREGATE_MEAN_SD;
}
