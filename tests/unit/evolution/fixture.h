/* fixture.h: small campaigns, and plain implementations of what the room does fast. */
#ifndef MORPHO_TESTS_EVOLUTION_FIXTURE_H
#define MORPHO_TESTS_EVOLUTION_FIXTURE_H

#include "../check.h"

#include <morpho/evolution.h>

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

static inline struct mo_random check_stream(uint32_t step, uint64_t index)
{
  struct mo_random random;
  mo_random_init(&random, 77, MO_PURPOSE_CHECK, step, index);
  return random;
}

/* ---- canonical forms, by another road: all eight images as lists of cells, the smallest of them
 * as text ---- */

#define CELLS_MAX 720

struct plain_form {
  uint32_t side[3];
  char bits[CELLS_MAX + 1];
};

static inline bool plain_bit(struct mo_workspace w, const uint64_t *bits, uint32_t x, uint32_t y,
                             uint32_t z)
{
  const uint32_t v = (x * w.ny + y) * w.nz + z;
  return bits[v / 64] >> v % 64 & 1;
}

static inline int plain_compare(const struct plain_form *a, const struct plain_form *b)
{
  for (int axis = 0; axis < 3; axis++)
    if (a->side[axis] != b->side[axis])
      return a->side[axis] < b->side[axis] ? -1 : 1;
  return strcmp(a->bits, b->bits);
}

/* Of workspaces whose sides x and y are equal, or whose bodies need not be turned. */
static inline struct plain_form plain_canonical(struct mo_workspace w, const uint64_t *bits)
{
  struct plain_form best = {{0}, ""};
  uint32_t low[3] = {~0U, ~0U, ~0U}, high[3] = {0};
  for (uint32_t x = 0; x < w.nx; x++)
    for (uint32_t y = 0; y < w.ny; y++)
      for (uint32_t z = 0; z < w.nz; z++)
        if (plain_bit(w, bits, x, y, z)) {
          const uint32_t at[3] = {x, y, z};
          for (int axis = 0; axis < 3; axis++) {
            low[axis] = at[axis] < low[axis] ? at[axis] : low[axis];
            high[axis] = at[axis] > high[axis] ? at[axis] : high[axis];
          }
        }
  for (unsigned k = 0; k < 8; k++) {
    struct plain_form image = {{high[0] - low[0] + 1, high[1] - low[1] + 1, high[2] - low[2] + 1},
                               ""};
    if (k & 4) {
      const uint32_t side = image.side[0];
      image.side[0] = image.side[1];
      image.side[1] = side;
    }
    if (image.side[0] > w.nx || image.side[1] > w.ny)
      continue;
    size_t n = 0;
    for (uint32_t x = 0; x < image.side[0]; x++)
      for (uint32_t y = 0; y < image.side[1]; y++)
        for (uint32_t z = 0; z < image.side[2]; z++) {
          const uint32_t mx = k & 1 ? image.side[0] - 1 - x : x,
                         my = k & 2 ? image.side[1] - 1 - y : y;
          const uint32_t fx = k & 4 ? my : mx, fy = k & 4 ? mx : my;
          image.bits[n++] = plain_bit(w, bits, low[0] + fx, low[1] + fy, low[2] + z) ? '1' : '0';
        }
    if (k == 0 || plain_compare(&image, &best) < 0)
      best = image;
  }
  return best;
}

struct plain_set {
  struct plain_form *forms;
  size_t n, room;
};

static inline int plain_add(struct plain_set *set, struct mo_workspace w, const uint64_t *bits)
{
  if (set->n == set->room) {
    set->room = set->room * 2 + 64;
    struct plain_form *more = realloc(set->forms, set->room * sizeof(*more));
    if (more == NULL)
      return MO_ERR_NO_MEMORY;
    set->forms = more;
  }
  set->forms[set->n++] = plain_canonical(w, bits);
  return MO_OK;
}

static inline int plain_order(const void *a, const void *b)
{
  return plain_compare(a, b);
}

/* How many different ones there are. */
static inline size_t plain_distinct(struct plain_set *set)
{
  size_t distinct = 0;
  if (set->n > 0)
    qsort(set->forms, set->n, sizeof(*set->forms), plain_order);
  for (size_t i = 0; i < set->n; i++)
    distinct += i == 0 || plain_compare(&set->forms[i - 1], &set->forms[i]) != 0;
  return distinct;
}

/* ---- a campaign without a world: a design's score is a hash of it ---- */

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

static inline void campaign_free(struct made_up_campaign *campaign)
{
  mo_seen_free(campaign->seen);
  free(campaign->genotypes);
  free(campaign->candidates);
  free(campaign->births);
  free(campaign->survivors);
}

static inline void campaign_score(struct made_up_campaign *campaign, uint32_t from, uint32_t to)
{
  for (uint32_t i = from; i < to; i++)
    campaign->candidates[i] = (struct mo_candidate){
        .score = made_up_score(campaign->genotypes + campaign->words * i, campaign->words),
        .number = campaign->n_designs++,
        .born = campaign->generation};
}

static inline int campaign_start(struct made_up_campaign *campaign,
                                 const struct mo_campaign_settings *settings,
                                 const struct mo_form_set *excluded)
{
  *campaign = (struct made_up_campaign){.settings = *settings,
                                        .words = mo_workspace_words(settings->workspace)};
  const size_t room = 2 * (size_t)settings->population;
  campaign->genotypes = calloc(room * campaign->words, sizeof(uint64_t));
  campaign->candidates = calloc(room, sizeof(struct mo_candidate));
  campaign->births = calloc(settings->population, sizeof(struct mo_birth));
  campaign->survivors = calloc(room, sizeof(uint32_t));
  if (campaign->genotypes == NULL || campaign->candidates == NULL || campaign->births == NULL ||
      campaign->survivors == NULL)
    return MO_ERR_NO_MEMORY;
  int r = mo_seen_create(settings->workspace, excluded, &campaign->seen);
  if (r == MO_OK)
    r = mo_population_initial(settings, campaign->seen, campaign->genotypes, 0, &campaign->n, NULL,
                              NULL);
  if (r == MO_OK)
    campaign_score(campaign, 0, campaign->n);
  return r;
}

/* Children of the next generation, behind the population. */
static inline int campaign_vary(struct made_up_campaign *campaign)
{
  campaign->generation++;
  return mo_variation(&campaign->settings, campaign->generation, campaign->genotypes, campaign->n,
                      campaign->seen, campaign->genotypes + (size_t)campaign->words * campaign->n,
                      campaign->births, &campaign->n_children, &campaign->counts, NULL);
}

/* The next population, in place. */
static inline int campaign_select(struct made_up_campaign *campaign)
{
  const uint32_t n = campaign->n + campaign->n_children;
  const size_t bytes = campaign->words * sizeof(uint64_t);
  campaign_score(campaign, campaign->n, n);
  uint64_t *genotypes = malloc(n * bytes);
  struct mo_candidate *candidates = malloc(n * sizeof(*candidates));
  int r = genotypes != NULL && candidates != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  if (r == MO_OK)
    r = mo_select(&campaign->settings, campaign->generation, campaign->genotypes,
                  campaign->candidates, n, campaign->survivors, &campaign->n);
  if (r == MO_OK) {
    memcpy(genotypes, campaign->genotypes, n * bytes);
    memcpy(candidates, campaign->candidates, n * sizeof(*candidates));
    for (uint32_t i = 0; i < campaign->n; i++) {
      memcpy(campaign->genotypes + campaign->words * i,
             genotypes + campaign->words * campaign->survivors[i], bytes);
      campaign->candidates[i] = candidates[campaign->survivors[i]];
    }
  }
  free(genotypes);
  free(candidates);
  return r;
}

static inline int campaign_advance(struct made_up_campaign *campaign)
{
  const int r = campaign_vary(campaign);
  return r == MO_OK ? campaign_select(campaign) : r;
}

#endif
