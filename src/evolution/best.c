/* best.c: finds the k best of many designs without computing all their losses.
 *
 * A design is out when the sum of its known losses, divided by the number of all environments, is
 * above the k-th best of the complete scores so far. Then k designs are better, no matter what its
 * other losses are. A design that may still equal the k-th best is not out, so no rule for ties is
 * needed.
 *
 * The first round requests all losses of a few designs, spread evenly over the list, to find out
 * which environments are hard. Later rounds request the losses of all designs in the hardest
 * environment, then in the next two, and then in the rest. In between, the most promising designs
 * get all their losses, which lowers the bound at once. These sizes took the least time for 10,000
 * random bodies (docs/performance.md). */
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
                           .estimate = {.later = -1}, /* unknown */
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
  best->n_given++;
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

/* Returns the i-th of the few designs that get all their losses first. */
static uint32_t sample(const struct mo_best *best, uint32_t i, uint32_t few)
{
  return (uint32_t)((uint64_t)i * best->n_designs / few);
}

/* ---- rounds ---- */

/* Ranks the designs with complete scores. Sets the bound to the k-th best of them. */
static void find_bound(struct mo_best *best)
{
  uint32_t n = 0;
  for (uint32_t i = 0; i < best->n_designs; i++)
    if (best->asked[i] == all_environments(best))
      best->ranks[n++] = (struct mo_rank){
          .score = mo_race_score(losses_of(best, i), best->n_environments), .number = i};
  mo_rank_sort(best->ranks, n);
  if (n >= best->k)
    best->race.bound = fmin(best->race.bound, best->ranks[best->k - 1].score);
}

/* Ranks the designs that are neither complete nor out, the most promising first. Returns their
 * number, and counts the losses that will never be needed. */
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

/* Returns how many designs get all their losses first: all designs if k is half of them or more. */
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
      n_asked += ask(best, sample(best, i, few), all_environments(best));
    best->is_whole = few == best->n_designs;
    return n_asked;
  }
  find_bound(best);
  if (round == 1)
    plan(best);
  best->prefix = best->race.ends[best->wave > 0 ? best->wave - 1 : 0];
  const uint32_t n_open = rank_open(best), promising = best->k + best->k / 2 + few;
  const bool completes = round % 2 == 0 || n_open <= few; /* the most promising designs */
  const uint64_t environments = completes ? all_environments(best) : next_wave(best);
  for (uint32_t i = 0; i < n_open && (i < promising || !completes); i++)
    n_asked += ask(best, (uint32_t)best->ranks[i].number, environments);
  return n_asked;
}
