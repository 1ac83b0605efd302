/* fixture.h: small campaigns, and plain implementations of what the room computes fast. */
#ifndef MORPHO_TESTS_EVOLUTION_FIXTURE_H
#define MORPHO_TESTS_EVOLUTION_FIXTURE_H

#include "../make.h"

#include <stdbool.h>

#define W MO_DEFAULT_WORDS

static inline struct mo_campaign_settings small_campaign(uint64_t seed, uint32_t population)
{
  struct mo_campaign_settings settings = mo_campaign_preset(MO_ZERO_SHOT, MO_PRESET_DEMO);
  settings.seed = seed;
  settings.population = population;
  return settings;
}

static inline uint32_t hamming(const uint64_t *a, const uint64_t *b)
{
  uint32_t n = 0;
  for (int w = 0; w < W; w++)
    n += (uint32_t)__builtin_popcountll(a[w] ^ b[w]);
  return n;
}

/* ---- designs, distinguished by their ids ---- */

enum { ID_BYTES = 720 / 4 + 1 };

struct id_list {
  char (*ids)[ID_BYTES];
  size_t n, room;
};

static inline void id_add(struct id_list *list, struct mo_workspace w, const uint64_t *bits)
{
  if (list->n == list->room) {
    list->room = list->room * 2 + 64;
    list->ids = realloc(list->ids, list->room * ID_BYTES);
    make_check(list->ids != NULL ? MO_OK : MO_ERR_NO_MEMORY, "ids");
  }
  mo_genotype_id(w, bits, list->ids[list->n++]);
}

static inline int id_order(const void *a, const void *b)
{
  return strcmp(a, b);
}

/* Returns the number of different ids, and frees them. */
static inline size_t id_distinct(struct id_list *list)
{
  size_t distinct = 0;
  if (list->n > 0)
    qsort(list->ids, list->n, ID_BYTES, id_order);
  for (size_t i = 0; i < list->n; i++)
    distinct += i == 0 || strcmp(list->ids[i - 1], list->ids[i]) != 0;
  free(list->ids);
  return distinct;
}

/* ---- a campaign without a simulation: a design's score is a hash of it ---- */

struct made_up_campaign {
  struct mo_campaign_settings settings;
  struct mo_seen *seen;
  uint32_t words, generation, n, n_children;
  uint64_t *genotypes; /* (2 population, words) the population, then its children */
  struct mo_candidate *candidates;
  struct mo_birth *births;
  uint32_t *survivors;
  struct mo_variation_counts counts;
  uint64_t n_designs;
};

static inline double made_up_score(const uint64_t *genotype, uint32_t words)
{
  uint64_t hash = 1469598103934665603U;
  uint32_t voxels = 0;
  for (uint32_t w = 0; w < words; w++) {
    hash = (hash ^ genotype[w]) * 1099511628211U;
    hash ^= hash >> 29;
    voxels += (uint32_t)__builtin_popcountll(genotype[w]);
  }
  return 1.0 / (1.0 + voxels) + (double)(hash % 1000) * 1e-4;
}

static inline void campaign_score(struct made_up_campaign *campaign, uint32_t from, uint32_t to)
{
  for (uint32_t i = from; i < to; i++)
    campaign->candidates[i] = (struct mo_candidate){
        .score = made_up_score(campaign->genotypes + campaign->words * i, campaign->words),
        .number = campaign->n_designs++,
        .born = campaign->generation};
}

static inline struct made_up_campaign *make_campaign(const struct mo_campaign_settings *settings,
                                                     const struct mo_form_set *excluded)
{
  const size_t room = 2 * (size_t)settings->population;
  struct made_up_campaign *campaign = make_zeros(1, sizeof(*campaign));
  *campaign = (struct made_up_campaign){.settings = *settings,
                                        .words = mo_workspace_words(settings->workspace),
                                        .seen = make_seen(settings->workspace, excluded),
                                        .candidates = make_zeros(room, sizeof(struct mo_candidate)),
                                        .births = make_zeros(room, sizeof(struct mo_birth)),
                                        .survivors = make_zeros(room, sizeof(uint32_t))};
  campaign->genotypes = make_zeros(room * campaign->words, sizeof(uint64_t));
  make_check(mo_population_initial(settings, campaign->seen, campaign->genotypes, 0, &campaign->n,
                                   NULL, NULL),
             "population");
  campaign_score(campaign, 0, campaign->n);
  return campaign;
}

static inline uint64_t *genotype_of(const struct made_up_campaign *campaign, uint32_t i)
{
  return campaign->genotypes + (size_t)campaign->words * i;
}

/* Makes the children of the next generation, after the population. */
static inline void campaign_vary(struct made_up_campaign *campaign)
{
  campaign->generation++;
  make_check(mo_variation(&campaign->settings, campaign->generation, campaign->genotypes,
                          campaign->n, campaign->seen, genotype_of(campaign, campaign->n),
                          campaign->births, &campaign->n_children, &campaign->counts, NULL),
             "variation");
}

/* Selects the next population, in place. */
static inline void campaign_select(struct made_up_campaign *campaign)
{
  const uint32_t n = campaign->n + campaign->n_children;
  const size_t bytes = campaign->words * sizeof(uint64_t);
  uint64_t *genotypes = malloc(n * bytes + 1);
  struct mo_candidate *candidates = malloc(n * sizeof(*candidates) + 1);
  campaign_score(campaign, campaign->n, n);
  make_check(genotypes == NULL || candidates == NULL
                 ? MO_ERR_NO_MEMORY
                 : mo_select(&campaign->settings, campaign->generation, campaign->genotypes,
                             campaign->candidates, n, campaign->survivors, &campaign->n),
             "selection");
  memcpy(genotypes, campaign->genotypes, n * bytes);
  memcpy(candidates, campaign->candidates, n * sizeof(*candidates));
  for (uint32_t i = 0; i < campaign->n; i++) {
    const uint32_t from = campaign->survivors[i];
    memcpy(genotype_of(campaign, i), genotypes + (size_t)campaign->words * from, bytes);
    campaign->candidates[i] = candidates[from];
  }
  free(genotypes);
  free(candidates);
}

#endif
