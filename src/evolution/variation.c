/* variation.c: the initial population, and the children of a generation (paper, section 2.5).
 *
 * The results of a seed depend on which numbers are taken from which stream. Never change this.
 *   groups        (SELECTION, generation, MO_STREAM_GROUPS): a partial Fisher-Yates shuffle of
 *                 0 … n − 1; its first round(share · n) places mutate, in this order, the
 *                 others recombine
 *   mutants       (MUTATION, generation, i) for the child at place i: mo_genotype_mutate until
 *                 the child is new
 *   recombinants  (CROSSOVER, generation, 0): a pair is below(g), then below(g − 1) among the
 *                 others, g the size of the group
 *   fallbacks     (MUTATION, generation, i) for the child at place i: below(g) chooses the
 *                 parent, then as for mutants
 * Only children that are kept take a place. */
#include "evolution/internal.h"

#include "base/thread.h"
#include "morphospace/bits.h"

#define PAIRS_FRUITLESS 1000 /* discards in a row after which no more pairs are tried */
#define RATE_MAX        0.5
#define ASK_EVERY       64

/* ---- the initial population: given designs, then random ones ---- */

/* Fills places *n … population − 1. */
static int fill(const struct mo_campaign_settings *settings, struct mo_seen *seen,
                uint64_t *genotypes, uint32_t *n, const volatile int *cancel)
{
  const size_t words = mo_workspace_words(settings->workspace);
  uint32_t fruitless = 0;
  for (uint64_t i = 0; *n < settings->population && fruitless < MO_FRUITLESS_MAX; i++) {
    struct mo_random random;
    uint64_t *body = genotypes + words * *n;
    if (i % ASK_EVERY == 0 && mo_is_cancelled(cancel))
      return MO_ERR_CANCELLED;
    mo_random_init(&random, settings->seed, MO_PURPOSE_POPULATION, 0, i);
    int r = mo_genotype_random(settings->workspace, &random, body);
    if (r == MO_OK)
      r = mo_seen_add(seen, body);
    if (r < 0)
      return r;
    *n += r == 1;
    fruitless = r == 1 ? 0 : fruitless + 1;
  }
  return MO_OK;
}

int mo_population_initial(const struct mo_campaign_settings *settings, struct mo_seen *seen,
                          uint64_t *genotypes, uint32_t n_given, uint32_t *n, uint32_t *fault,
                          const volatile int *cancel)
{
  const size_t words = mo_workspace_words(settings->workspace);
  if (n_given > settings->population)
    return MO_ERR_RANGE;
  for (uint32_t i = 0; i < n_given; i++) {
    const int r = mo_seen_add_own(seen, genotypes + words * i);
    if (r == 1)
      continue;
    if (r == 0 && fault != NULL)
      *fault = i;
    return r == 0 ? MO_ERR_DUPLICATE : r;
  }
  uint32_t found = n_given;
  const int r = fill(settings, seen, genotypes, &found, cancel);
  if (r < 0)
    return r;
  *n = found;
  return MO_OK;
}

/* ---- children ---- */

struct nursery {
  const struct mo_campaign_settings *settings;
  uint32_t generation;
  const uint64_t *parents;
  const uint32_t *group; /* (n_group) places of the parents that recombine */
  uint32_t n_group;
  struct mo_seen *seen;
  uint64_t *children;
  struct mo_birth *births;
  uint32_t n;
  struct mo_variation_counts counts;
  const volatile int *cancel;
  size_t words;
};

static const uint64_t *parent_at(const struct nursery *nursery, uint32_t place)
{
  return nursery->parents + nursery->words * place;
}

static uint64_t *next_child(const struct nursery *nursery)
{
  return nursery->children + nursery->words * nursery->n;
}

static bool is_due(const struct nursery *nursery, uint32_t attempts)
{
  return attempts % ASK_EVERY == 1 && mo_is_cancelled(nursery->cancel);
}

/* Keeps the child in the next place if it is new. Returns 1, or 0 if it is empty or seen. */
static int try_child(struct nursery *nursery, int made)
{
  if (made == MO_ERR_EMPTY)
    return 0;
  return made < 0 ? made : mo_seen_add(nursery->seen, next_child(nursery));
}

static void record_birth(struct nursery *nursery, enum mo_operator op, uint32_t first,
                         uint32_t second, uint32_t attempts)
{
  nursery->births[nursery->n++] =
      (struct mo_birth){.op = op, .parents = {first, second}, .attempts = attempts};
}

/* Makes one mutant of `place`. Returns 1, or 0 if MO_FRUITLESS_MAX attempts found nothing new. */
static int make_mutant(struct nursery *nursery, uint32_t place, struct mo_random *random)
{
  const struct mo_campaign_settings *settings = nursery->settings;
  double rate = settings->mutation_rate > 0.0
                    ? settings->mutation_rate
                    : 1.0 / (double)mo_workspace_voxels(settings->workspace);
  for (uint32_t attempts = 1; attempts <= MO_FRUITLESS_MAX; attempts++) {
    rate = rate < RATE_MAX ? rate : RATE_MAX;
    if (is_due(nursery, attempts))
      return MO_ERR_CANCELLED;
    nursery->counts.mutation_attempts++;
    const int r =
        try_child(nursery, mo_genotype_mutate(settings->workspace, parent_at(nursery, place), rate,
                                              random, next_child(nursery)));
    if (r < 0)
      return r;
    if (r == 1) {
      record_birth(nursery, MO_BORN_MUTATION, place, MO_NO_PARENT, attempts);
      nursery->counts.mutants++;
      return 1;
    }
    rate *= settings->mutation_growth;
  }
  return 0;
}

static struct mo_random mutation_stream(const struct nursery *nursery)
{
  struct mo_random random;
  mo_random_init(&random, nursery->settings->seed, MO_PURPOSE_MUTATION, nursery->generation,
                 nursery->n);
  return random;
}

/* These three functions return 1 when done, or 0 if the morphospace is exhausted. */

static int make_mutants(struct nursery *nursery, const uint32_t *places, uint32_t n)
{
  int r = 1;
  for (uint32_t i = 0; i < n && r == 1; i++) {
    struct mo_random random = mutation_stream(nursery);
    r = make_mutant(nursery, places[i], &random);
  }
  return r;
}

static int make_recombinants(struct nursery *nursery)
{
  const struct mo_campaign_settings *settings = nursery->settings;
  const uint32_t g = nursery->n_group;
  struct mo_random random;
  mo_random_init(&random, settings->seed, MO_PURPOSE_CROSSOVER, nursery->generation, 0);
  for (uint32_t attempts = 1;
       g >= 2 && nursery->n < settings->population && attempts <= PAIRS_FRUITLESS; attempts++) {
    if (is_due(nursery, attempts))
      return MO_ERR_CANCELLED;
    const uint32_t first = mo_random_below(&random, g);
    uint32_t second = mo_random_below(&random, g - 1);
    second += second >= first;
    const uint32_t a = nursery->group[first], b = nursery->group[second];
    nursery->counts.crossover_attempts++;
    const int r =
        try_child(nursery, mo_genotype_crossover(settings->workspace, parent_at(nursery, a),
                                                 parent_at(nursery, b), next_child(nursery)));
    if (r < 0)
      return r;
    if (r == 1) {
      record_birth(nursery, MO_BORN_CROSSOVER, a, b, attempts);
      nursery->counts.recombinants++;
      attempts = 0;
    }
  }
  return 1;
}

static int make_fallbacks(struct nursery *nursery)
{
  int r = 1;
  while (nursery->n < nursery->settings->population && r == 1) {
    struct mo_random random = mutation_stream(nursery);
    const uint32_t place = nursery->group[mo_random_below(&random, nursery->n_group)];
    r = make_mutant(nursery, place, &random);
    nursery->counts.fallbacks += r == 1;
  }
  return r;
}

/* Moves `first` random numbers of 0 … n − 1 to the front of `places`. */
static void shuffle(uint32_t *places, uint32_t n, uint32_t first, struct mo_random *random)
{
  for (uint32_t i = 0; i < n; i++)
    places[i] = i;
  for (uint32_t i = 0; i < first; i++) {
    const uint32_t j = i + mo_random_below(random, n - i);
    const uint32_t swapped = places[i];
    places[i] = places[j];
    places[j] = swapped;
  }
}

void mo_variation_parents(uint64_t seed, uint32_t generation, uint32_t n, uint32_t k,
                          uint32_t *places)
{
  struct mo_random random;
  mo_random_init(&random, seed, MO_PURPOSE_SELECTION, generation, MO_STREAM_PARENTS);
  shuffle(places, n, k, &random);
}

static int make_all(struct nursery *nursery, uint32_t *places, uint32_t n_parents)
{
  const struct mo_campaign_settings *settings = nursery->settings;
  const uint32_t share = (uint32_t)(settings->mutation_share * n_parents + 0.5);
  uint32_t n_mutate = share < n_parents ? share : n_parents;
  struct mo_random random;
  mo_random_init(&random, settings->seed, MO_PURPOSE_SELECTION, nursery->generation,
                 MO_STREAM_GROUPS);
  shuffle(places, n_parents, n_mutate, &random);
  const bool lonely = n_parents - n_mutate < 2;
  nursery->group = lonely ? places : places + n_mutate;
  nursery->n_group = lonely ? n_parents : n_parents - n_mutate;
  n_mutate = n_mutate < settings->population ? n_mutate : settings->population;
  int r = make_mutants(nursery, places, n_mutate);
  if (r == 1)
    r = make_recombinants(nursery);
  if (r == 1)
    r = make_fallbacks(nursery);
  return r;
}

int mo_variation(const struct mo_campaign_settings *settings, uint32_t generation,
                 const uint64_t *parents, uint32_t n_parents, struct mo_seen *seen,
                 uint64_t *children, struct mo_birth *births, uint32_t *n,
                 struct mo_variation_counts *counts, const volatile int *cancel)
{
  struct nursery nursery = {.settings = settings,
                            .generation = generation,
                            .parents = parents,
                            .seen = seen,
                            .children = children,
                            .births = births,
                            .cancel = cancel,
                            .words = mo_workspace_words(settings->workspace)};
  int r = 0;
  if (n_parents > 0) {
    uint32_t *places = malloc(n_parents * sizeof(*places));
    if (places == NULL)
      return MO_ERR_NO_MEMORY;
    r = make_all(&nursery, places, n_parents);
    free(places);
  }
  if (r < 0)
    return r;
  nursery.counts.exhausted = r == 0;
  *n = nursery.n;
  *counts = nursery.counts;
  return MO_OK;
}
