/* selection.c: selects the survivors.
 *
 * Candidates are ranked by score, then by number, so no two have the same rank. The order of
 * candidates in memory could affect only the distances of novelty, but these are exact sums divided
 * by one number. A scheme receives the candidates that did not diverge, by rank, and chooses the
 * survivors among them. Diverged candidates fill the remaining places, oldest first. */
#include "evolution/internal.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* The input and output of a scheme: (n) ranks, best first, none diverged; n > places. lives: (n),
 * zeroed; the scheme sets `places` of them to 1. */
struct choice {
  const struct mo_campaign_settings *settings;
  uint32_t generation;
  const uint64_t *genotypes; /* for all candidates */
  const struct mo_candidate *candidates;
  uint32_t n_candidates;
  const struct mo_rank *ranks;
  uint32_t n, places;
  uint8_t *lives;
};

/* ---- tournament ---- */

/* Chooses by tournament: the best candidate survives, and each further survivor is the best of
 * `tournament_size` draws, with replacement, from the remaining candidates. */
static int choose_by_tournament(struct choice *choice)
{
  uint32_t left = choice->n - 1; /* n > places ≥ 1 */
  uint32_t *pool = calloc(left, sizeof(*pool));
  if (pool == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < left; i++)
    pool[i] = i + 1;
  struct mo_random random;
  mo_random_init(&random, choice->settings->seed, MO_PURPOSE_SELECTION, choice->generation,
                 MO_STREAM_TOURNAMENTS);
  choice->lives[0] = 1;
  for (uint32_t filled = 1; filled < choice->places; filled++) {
    uint32_t winner = mo_random_below(&random, left);
    for (uint32_t i = 1; i < choice->settings->selection.tournament_size; i++) {
      const uint32_t rival = mo_random_below(&random, left);
      winner = pool[rival] < pool[winner] ? rival : winner;
    }
    choice->lives[pool[winner]] = 1;
    pool[winner] = pool[--left];
  }
  free(pool);
  return MO_OK;
}

/* ---- novelty ---- */

/* Chooses by novelty: the best survives, then the candidates with the smallest (1 − weight) · rank
 * by score + weight · rank by novelty, both from 0. With equal novelty, or an equal sum, the better
 * score goes first. With weight 0 the sum is the rank by score: truncation. */
static int choose_by_novelty(struct choice *choice)
{
  const double weight = choice->settings->selection.novelty_weight;
  double *distances = malloc(choice->n_candidates * sizeof(*distances));
  struct mo_rank *novelty = malloc(choice->n * sizeof(*novelty));
  struct mo_rank *both = malloc(choice->n * sizeof(*both));
  const int r = distances != NULL && novelty != NULL && both != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  if (r == MO_OK) {
    mo_distinctiveness(choice->settings->workspace, choice->genotypes, choice->n_candidates,
                       distances);
    for (uint32_t i = 0; i < choice->n; i++)
      novelty[i] = (struct mo_rank){.score = -distances[choice->ranks[i].place], .number = i};
    mo_rank_sort(novelty, choice->n);
    for (uint32_t i = 0; i < choice->n; i++) {
      const uint64_t rank = novelty[i].number;
      both[i] = (struct mo_rank){.score = (1.0 - weight) * (double)rank + weight * (double)i,
                                 .number = rank};
    }
    mo_rank_sort(both, choice->n);
    choice->lives[0] = 1;
    for (uint32_t i = 0, filled = 1; filled < choice->places; i++)
      if (!choice->lives[both[i].number]) {
        choice->lives[both[i].number] = 1;
        filled++;
      }
  }
  free(both);
  free(novelty);
  free(distances);
  return r;
}

/* ---- age layers ---- */

/* Chooses by age layers, from the youngest to the last: the best candidates that are within the
 * layer's age limit and not yet chosen take its share of the places; unfilled places go to the next
 * layer. The last layer has no limit and at least one place, so the best survives. */
static void choose_by_age(struct choice *choice)
{
  const struct mo_selection *selection = &choice->settings->selection;
  const uint32_t layers = selection->n_layers;
  uint64_t limit = selection->age_gap;
  uint32_t filled = 0;
  for (uint32_t layer = 0; layer < layers; layer++, limit *= 2) {
    const uint32_t until = (uint32_t)((uint64_t)choice->places * (layer + 1) / layers);
    for (uint32_t i = 0; i < choice->n && filled < until; i++) {
      const uint32_t born = choice->candidates[choice->ranks[i].place].born;
      const uint32_t age = choice->generation > born ? choice->generation - born : 0;
      if (!choice->lives[i] && (age <= limit || layer + 1 == layers)) {
        choice->lives[i] = 1;
        filled++;
      }
    }
  }
}

/* ---- all schemes ---- */

static int choose(struct choice *choice)
{
  switch (choice->settings->selection.kind) {
  case MO_SELECT_TOURNAMENT: return choose_by_tournament(choice);
  case MO_SELECT_NOVELTY: return choose_by_novelty(choice);
  case MO_SELECT_AGE_LAYERED: choose_by_age(choice); return MO_OK;
  case MO_SELECT_TRUNCATION: break;
  }
  memset(choice->lives, 1, choice->places);
  return MO_OK;
}

int mo_select(const struct mo_campaign_settings *settings, uint32_t generation,
              const uint64_t *genotypes, const struct mo_candidate *candidates, uint32_t n,
              uint32_t *survivors, uint32_t *n_survivors)
{
  const uint32_t places = n < settings->population ? n : settings->population;
  struct mo_rank *ranks = malloc((n + (size_t)1) * sizeof(*ranks));
  uint8_t *lives = calloc(n + (size_t)1, 1);
  struct choice choice = {.settings = settings,
                          .generation = generation,
                          .genotypes = genotypes,
                          .candidates = candidates,
                          .n_candidates = n,
                          .ranks = ranks,
                          .places = places,
                          .lives = lives};
  int r = ranks != NULL && lives != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < n && r == MO_OK; i++) {
    ranks[i] = (struct mo_rank){candidates[i].score, candidates[i].number, i};
    choice.n += candidates[i].score != INFINITY;
    r = isnan(candidates[i].score) ? MO_ERR_INVALID : MO_OK;
  }
  if (r == MO_OK) {
    mo_rank_sort(ranks, n);
    if (choice.n > places)
      r = choose(&choice);
    else
      memset(lives, 1, places); /* diverged candidates rank last */
  }
  if (r == MO_OK)
    *n_survivors = 0;
  for (uint32_t i = 0; i < n && r == MO_OK && *n_survivors < places; i++)
    if (lives[i])
      survivors[(*n_survivors)++] = ranks[i].place;
  free(lives);
  free(ranks);
  return r;
}
