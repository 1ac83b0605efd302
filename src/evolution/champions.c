/* champions.c: picks a few designs that represent a population (paper, appendix: morphological
 * distinctiveness). */
#include "evolution/internal.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* Ranks the places of the population by score; diverged ones come last. */
static struct mo_rank *rank_all(const double *scores, uint32_t n, uint32_t *n_sound)
{
  struct mo_rank *ranks = malloc(n * sizeof(*ranks));
  if (ranks == NULL)
    return NULL;
  *n_sound = 0;
  for (uint32_t i = 0; i < n; i++) {
    const bool sound = isfinite(scores[i]);
    ranks[i] = (struct mo_rank){.score = sound ? scores[i] : INFINITY, .number = i, .place = i};
    *n_sound += sound;
  }
  mo_rank_sort(ranks, n);
  return ranks;
}

/* Orders `chosen`, (m) ranked places, best first, by distinctiveness. distances, genotypes: scratch
 * space for m. */
static void order(struct mo_workspace workspace, const uint64_t *population, const uint32_t *chosen,
                  uint32_t m, uint64_t *genotypes, double *distances, struct mo_rank *ranks,
                  uint32_t *picks)
{
  const size_t words = mo_workspace_words(workspace);
  for (size_t i = 0; i < m; i++)
    memcpy(genotypes + words * i, population + words * chosen[i], words * sizeof(*genotypes));
  mo_distinctiveness(workspace, genotypes, m, distances);
  for (uint32_t i = 0; i < m; i++)
    ranks[i] = (struct mo_rank){.score = -distances[i], .number = i, .place = chosen[i]};
  mo_rank_sort(ranks, m);
  for (uint32_t i = 0; i < m; i++)
    picks[i] = ranks[i].place;
}

int mo_champions(struct mo_workspace workspace, const uint64_t *genotypes, const double *scores,
                 uint32_t n, uint32_t m, uint32_t *picks, double *ret_distances)
{
  if (m > n)
    return MO_ERR_RANGE;
  if (m == 0)
    return MO_OK;
  uint32_t n_sound = 0;
  struct mo_rank *ranks = rank_all(scores, n, &n_sound);
  uint32_t *chosen = calloc(m, sizeof(*chosen));
  uint64_t *some = malloc((size_t)m * mo_workspace_words(workspace) * sizeof(*some));
  double *distances = malloc(m * sizeof(*distances));
  int r = MO_ERR_NO_MEMORY;
  if (ranks != NULL && chosen != NULL && some != NULL && distances != NULL) {
    const uint64_t last = (n_sound > m ? n_sound : m) - 1;
    const uint64_t steps = m > 1 ? m - 1 : 1;
    for (uint32_t i = 0; i < m; i++)
      chosen[i] = ranks[(i * last + steps / 2) / steps].place;
    order(workspace, genotypes, chosen, m, some, distances, ranks, picks);
    for (uint32_t i = 0; i < m && ret_distances != NULL; i++)
      ret_distances[i] = -ranks[i].score;
    r = MO_OK;
  }
  free(distances);
  free(some);
  free(chosen);
  free(ranks);
  return r;
}
