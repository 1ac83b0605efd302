/* best.c: the k best of many designs, without all their losses.
 *
 * A design is out when the sum of its known losses, over the number of all environments, is above
 * the k-th best of the whole scores so far: k designs are then better, whatever its other losses
 * are. A design that may still equal the k-th best is not out, so that ties need no rule.
 *
 * The rounds: a few designs, evenly over the list, in all environments; they tell which
 * environments are hard. Then the hardest one for all designs, and the next two, and the rest. In
 * between, the designs that look best so far get all their losses, which lowers the bound at once.
 * The numbers are those that take the least time with the losses of 10,000 random bodies
 * (docs/performance.md). */
#include "evolution/internal.h"

#include <math.h>
#include <stdlib.h>

#define FEW_MIN 4
#define FEW_MAX 64

static const double *losses_of(const struct mo_best *best, uint32_t design)
{
  return best->losses + (size_t)design * best->n_environments;
}

static uint64_t all_environments(const struct mo_best *best)
{
  return UINT64_MAX >> (MO_RACE_ENVIRONMENTS_MAX - best->n_environments);
}

int mo_best_create(uint32_t n_designs, uint32_t n_environments, uint32_t k, struct mo_best **ret)
{
  struct mo_best *best = calloc(1, sizeof(*best));
  const size_t n_losses = (size_t)n_designs * n_environments;
  if (best == NULL)
    return MO_ERR_NO_MEMORY;
  *best = (struct mo_best){.n_designs = n_designs,
                           .n_environments = n_environments,
                           .k = k,
                           .share = 1,
                           .asked = calloc(n_designs, sizeof(*best->asked)),
                           .losses = calloc(n_losses, sizeof(*best->losses)),
                           .ranks = calloc(n_designs, sizeof(*best->ranks)),
                           .race = {.bound = INFINITY, .n_environments = n_environments}};
  if (best->asked == NULL || best->losses == NULL || best->ranks == NULL) {
    mo_best_free(best);
    return MO_ERR_NO_MEMORY;
  }
  for (size_t i = 0; i < n_losses; i++)
    best->losses[i] = NAN;
  *ret = best;
  return MO_OK;
}

void mo_best_free(struct mo_best *best)
{
  if (best == NULL)
    return;
  free(best->asked);
  free(best->losses);
  free(best->ranks);
  free(best);
}

void mo_best_give(struct mo_best *best, uint32_t design, uint32_t environment, double loss)
{
  best->losses[(size_t)design * best->n_environments + environment] = loss;
}

/* ---- the plan ---- */

/* Returns the mean of the known finite losses in an environment. */
static double mean_of(const struct mo_best *best, uint32_t environment)
{
  double sum = 0;
  uint32_t n = 0;
  for (uint32_t i = 0; i < best->n_designs; i++) {
    const double loss = losses_of(best, i)[environment];
    if (isfinite(loss)) {
      sum += loss;
      n++;
    }
  }
  return n > 0 ? sum / n : 0;
}

/* Orders the environments, the hardest first, and cuts them into waves. */
static void plan(struct mo_best *best)
{
  static const uint8_t sizes[MO_RACE_WAVES_MAX] = {1, 2, 13, 16, 16, 16};
  struct mo_race *race = &best->race;
  struct mo_rank ranks[MO_RACE_ENVIRONMENTS_MAX];
  for (uint32_t k = 0; k < race->n_environments; k++)
    ranks[k] = (struct mo_rank){.score = -mean_of(best, k), .number = k};
  mo_rank_sort(ranks, race->n_environments);
  for (uint32_t k = 0; k < race->n_environments; k++)
    race->order[k] = (uint8_t)ranks[k].number;
  mo_race_cut_waves(race, sizes);
}

/* Returns how many losses a design needs until it is out. */
static uint32_t needed(const struct mo_best *best, uint32_t design, double bound)
{
  const struct mo_race *race = &best->race;
  double sum = 0;
  for (uint32_t wave = 0, i = 0; wave < race->n_waves; wave++) {
    for (; i < race->ends[wave]; i++)
      sum += losses_of(best, design)[race->order[i]];
    if (sum / race->n_environments > bound)
      return i;
  }
  return race->n_environments;
}

/* Estimates the share of the losses that the race needs, from n designs that are whole and ranked,
 * as if the bound were the score that has as many of them before it as the k-th best has of all. */
static void estimate(struct mo_best *best, uint32_t n)
{
  const uint64_t rank = (uint64_t)(best->k - 1) * n / best->n_designs;
  uint64_t sum = 0;
  for (uint32_t i = 0; i < n; i++)
    sum += needed(best, (uint32_t)best->ranks[i].number, best->ranks[rank].score);
  best->share = (double)sum / ((double)n * best->n_environments);
}

/* ---- rounds ---- */

/* Sets the bound: the k-th best of the whole scores. Ranks the designs that have one, and returns
 * their number. */
static uint32_t find_bound(struct mo_best *best)
{
  uint32_t n = 0;
  for (uint32_t i = 0; i < best->n_designs; i++)
    if (best->asked[i] == all_environments(best))
      best->ranks[n++] = (struct mo_rank){
          .score = mo_race_score(losses_of(best, i), best->n_environments), .number = i};
  mo_rank_sort(best->ranks, n);
  if (n >= best->k)
    best->race.bound = best->ranks[best->k - 1].score;
  return n;
}

/* Ranks the designs that are neither whole nor out, those that look best first. Returns their
 * number, and counts the losses that the others will never need. */
static uint32_t rank_open(struct mo_best *best)
{
  uint32_t n = 0;
  best->n_cut = 0;
  for (uint32_t i = 0; i < best->n_designs; i++) {
    const double score = mo_race_score(losses_of(best, i), best->n_environments);
    const uint64_t missing = all_environments(best) & ~best->asked[i];
    if (score > best->race.bound)
      best->n_cut += (uint64_t)__builtin_popcountll(missing);
    else if (missing != 0)
      best->ranks[n++] = (struct mo_rank){.score = score, .number = i};
  }
  mo_rank_sort(best->ranks, n);
  return n;
}

static uint64_t ask(struct mo_best *best, uint32_t design, uint64_t environments)
{
  const uint64_t more = environments & ~best->asked[design];
  best->asked[design] |= more;
  return (uint64_t)__builtin_popcountll(more);
}

static uint64_t next_wave(struct mo_best *best)
{
  const struct mo_race *race = &best->race;
  uint64_t wave = 0;
  for (uint32_t i = best->wave > 0 ? race->ends[best->wave - 1] : 0; i < race->ends[best->wave];
       i++)
    wave |= UINT64_C(1) << race->order[i];
  best->wave++;
  return wave;
}

/* Returns how many designs get all their losses first: all where half of them are asked for. */
static uint32_t few_of(const struct mo_best *best)
{
  const uint32_t sixteenth = best->n_designs / 16;
  const uint32_t few = sixteenth < FEW_MIN ? FEW_MIN : sixteenth < FEW_MAX ? sixteenth : FEW_MAX;
  return 2 * (uint64_t)best->k < best->n_designs && few < best->n_designs ? few : best->n_designs;
}

uint64_t mo_best_ask(struct mo_best *best)
{
  const uint32_t few = few_of(best), round = best->round++;
  uint64_t n_asked = 0;
  if (round == 0) {
    for (uint32_t i = 0; i < few; i++)
      n_asked += ask(best, (uint32_t)((uint64_t)i * best->n_designs / few), all_environments(best));
    return n_asked;
  }
  const uint32_t n_whole = find_bound(best);
  if (round == 1) {
    plan(best);
    estimate(best, n_whole);
  }
  const uint32_t n_open = rank_open(best), promising = best->k + best->k / 2 + few;
  const bool completes = round % 2 == 0 || n_open <= few; /* those that look best */
  const uint64_t environments = completes ? all_environments(best) : next_wave(best);
  for (uint32_t i = 0; i < n_open && (i < promising || !completes); i++)
    n_asked += ask(best, (uint32_t)best->ranks[i].number, environments);
  return n_asked;
}
