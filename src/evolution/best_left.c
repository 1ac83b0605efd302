/* best_left.c: estimates how many losses a race for the k best will still request.
 *
 * The number depends on the k best of all designs, and these cannot be known from the few designs
 * that get all their losses first. Therefore, the rest of the race is simulated: unknown losses are
 * guessed, and a copy of the race requests them by the same rules. A guess scales the losses of a
 * donor: a design with all its losses, and with a similar sum over the environments that both
 * designs have. A good sum is partly chance, so the scale is the ratio of the two sums raised to a
 * power: the slope of the donors' logarithms. A design that still waits for its first-wave losses
 * borrows them from a design that has them. */
#include "evolution/internal.h"

#include <math.h>
#include <stdlib.h>

#define MODEL_MAX  8192 /* designs in the copy; if there are more, an evenly spaced sample */
#define NEIGHBORS  8    /* donors that a guess chooses from */
#define DONORS_MIN 4    /* for a slope */

struct rehearsal {
  struct mo_best *best, *model;
  double *guesses;   /* (model->n_designs, n_environments) */
  uint32_t *sources; /* (n_sources) designs that have the prefix */
  uint32_t n_sources;
  uint32_t n_donors; /* in best->ranks, ascending by the sum over the prefix */
  uint32_t prefix;   /* environments of race.order that open designs have, or will have first */
  double slope;
};

static const double *losses_of(const struct mo_best *best, uint32_t design)
{
  return best->losses + (size_t)design * best->n_environments;
}

/* Returns a sum over environments in the order of the race; NaN if a loss is unknown. */
static double sum_of(const struct mo_best *best, uint32_t design, uint32_t first, uint32_t end)
{
  double sum = 0;
  for (uint32_t i = first; i < end; i++)
    sum += losses_of(best, design)[best->race.order[i]];
  return sum;
}

/* Finds donors and sources. */
static void find_known(struct rehearsal *one)
{
  struct mo_best *best = one->best;
  for (uint32_t i = 0; i < best->n_designs; i++) {
    const double sum = sum_of(best, i, 0, one->prefix);
    if (!isnan(sum))
      one->sources[one->n_sources++] = i;
    if (isfinite(sum) && !isnan(sum_of(best, i, one->prefix, best->n_environments)))
      best->ranks[one->n_donors++] = (struct mo_rank){.score = sum, .number = i};
  }
  mo_rank_sort(best->ranks, one->n_donors);
}

/* Finds the slope of the logarithm of the other losses against that of the prefix: 1 if both are
 * proportional, 0 if the prefix predicts nothing. */
static double find_slope(const struct rehearsal *one)
{
  const struct mo_best *best = one->best;
  double n = 0, mean_x = 0, mean_y = 0, squares = 0, products = 0;
  for (uint32_t i = 0; i < one->n_donors; i++) {
    const uint32_t design = (uint32_t)best->ranks[i].number;
    const double rest = sum_of(best, design, one->prefix, best->n_environments);
    if (!(best->ranks[i].score > 0) || !(rest > 0) || !isfinite(rest))
      continue;
    const double x = log(best->ranks[i].score), y = log(rest), off = x - mean_x;
    n++;
    mean_x += off / n;
    squares += off * (x - mean_x);
    products += off * (y - mean_y - (y - mean_y) / n);
    mean_y += (y - mean_y) / n;
  }
  return n < DONORS_MIN || !(squares > 0) ? 1 : fmin(1, fmax(0, products / squares));
}

/* Returns the donor for a sum over the prefix: one of its nearest neighbors, in turn. */
static uint32_t choose_donor(const struct rehearsal *one, double sum, uint32_t turn)
{
  const struct mo_rank *ranks = one->best->ranks;
  const uint32_t n = one->n_donors, width = n < NEIGHBORS ? n : NEIGHBORS;
  uint32_t low = 0, high = n;
  while (low < high) {
    const uint32_t middle = low + (high - low) / 2;
    if (ranks[middle].score < sum)
      low = middle + 1;
    else
      high = middle;
  }
  low = low > width / 2 ? low - width / 2 : 0;
  low = low > n - width ? n - width : low;
  return low + turn % width;
}

/* Copies a design into the model, and guesses its unknown losses. */
static void guess(struct rehearsal *one, uint32_t place, uint32_t design)
{
  const struct mo_best *best = one->best;
  const uint32_t n = best->n_environments;
  double *losses = one->model->losses + (size_t)place * n,
         *guesses = one->guesses + (size_t)place * n;
  for (uint32_t i = 0; i < n; i++)
    guesses[i] = losses[i] = losses_of(best, design)[i];
  one->model->asked[place] = best->asked[design];
  if (mo_race_score(losses, n) > best->race.bound)
    return;
  double sum = sum_of(best, design, 0, one->prefix);
  if (isnan(sum)) {
    const uint32_t source = one->sources[(uint64_t)place * one->n_sources / one->model->n_designs];
    for (uint32_t i = 0; i < one->prefix; i++)
      guesses[best->race.order[i]] = losses_of(best, source)[best->race.order[i]];
    sum = sum_of(best, source, 0, one->prefix);
  }
  const struct mo_rank donor = best->ranks[choose_donor(one, sum, place)];
  const double scale = donor.score > 0 && isfinite(sum) ? pow(sum / donor.score, one->slope) : 1;
  for (uint32_t i = 0; i < n; i++) {
    if (isnan(guesses[i]))
      guesses[i] = scale > 0 ? scale * losses_of(best, (uint32_t)donor.number)[i] : 0;
    if (isnan(losses[i]) && (best->asked[design] >> i & 1) != 0)
      losses[i] = guesses[i];
  }
}

/* Runs the race of the model to its end. Returns how many losses it requests. */
static uint64_t run(const struct rehearsal *one)
{
  struct mo_best *model = one->model;
  const uint32_t n = model->n_environments;
  uint64_t all = 0, more;
  while ((more = mo_best_ask(model)) > 0) {
    all += more;
    for (uint32_t i = 0; i < model->n_designs; i++)
      for (uint64_t left = model->asked[i]; left != 0; left &= left - 1) {
        const size_t cell = (size_t)i * n + (uint32_t)__builtin_ctzll(left);
        model->losses[cell] = one->guesses[cell];
      }
  }
  return all;
}

/* Returns the estimate, or a negative number if there are no donors. */
static double rehearse(struct rehearsal *one)
{
  struct mo_best *best = one->best, *model = one->model;
  find_known(one);
  if (one->n_donors == 0)
    return -1;
  one->slope = find_slope(one);
  model->race = best->race;
  model->round = best->round;
  model->wave = best->wave;
  for (uint32_t i = 0; i < model->n_designs; i++)
    guess(one, i, (uint32_t)((uint64_t)i * best->n_designs / model->n_designs));
  return (double)run(one) * best->n_designs / model->n_designs;
}

static double estimate(struct mo_best *best)
{
  const uint32_t n = best->n_designs < MODEL_MAX ? best->n_designs : MODEL_MAX;
  const uint64_t k = ((uint64_t)best->k * n + best->n_designs / 2) / best->n_designs;
  struct rehearsal one = {.best = best, .prefix = best->prefix};
  double later = best->estimate.later;
  one.guesses = calloc((size_t)n * best->n_environments, sizeof(*one.guesses));
  one.sources = calloc(best->n_designs, sizeof(*one.sources));
  if (one.guesses != NULL && one.sources != NULL &&
      mo_best_create(n, best->n_environments, k > 0 ? (uint32_t)k : 1, &one.model) == MO_OK) {
    later = rehearse(&one);
    mo_best_free(one.model);
  }
  free(one.guesses);
  free(one.sources);
  return later;
}

/* A new estimate is made in each round, and each time that the number of known losses doubles. */
double mo_best_left(struct mo_best *best)
{
  if (best->round < 2)
    return best->is_whole ? 0 : -1;
  if (best->estimate.round == best->round && best->n_given < 2 * best->estimate.n_given)
    return best->estimate.later;
  best->estimate.round = best->round;
  best->estimate.n_given = best->n_given;
  best->estimate.later = estimate(best);
  return best->estimate.later;
}
