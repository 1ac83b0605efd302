/* basins.c: where steepest ascent ends, for all bodies.
 *
 * Removing a voxel is the reverse of adding it, so each pair of neighbors is found once, from its
 * larger body, which has few voxels to remove, and recorded for both. Then, best first, each body
 * gets the optimum of its best neighbor, which is better and therefore already known. */
#include "atlas/index.h"
#include "atlas/neighbors.h"
#include "base/memory.h"
#include "base/thread.h"

#include <stdlib.h>

#define NONE      UINT32_MAX
#define PER_CHECK 4096 /* bodies between two checks of `cancel` */

struct mo_atlas_basins {
  uint64_t n, n_optima;
  uint32_t *optima; /* (n) the optimum of each body */
  uint32_t *bodies; /* (n) how many bodies have this one as their optimum */
};

/* Keeps a neighbor if it is better than the body and than the neighbor kept so far. */
static void learn(const struct mo_atlas *atlas, uint32_t *best, uint64_t body, uint64_t neighbor)
{
  const float score = mo_atlas_score(atlas, neighbor);
  if (score < mo_atlas_score(atlas, body) &&
      (best[body] == NONE ||
       mo_atlas_is_before(score, neighbor, mo_atlas_score(atlas, best[body]), best[body])))
    best[body] = (uint32_t)neighbor;
}

static int find_best(const struct mo_atlas *atlas, const volatile int *cancel, uint32_t *best)
{
  const uint64_t n = mo_atlas_bodies_of(atlas);
  for (uint64_t i = 0; i < n; i++)
    best[i] = NONE;
  for (uint64_t i = 0; i < n; i++) {
    struct mo_atlas_change changes[MO_ATLAS_NEIGHBORS_MAX];
    if (i % PER_CHECK == 0 && mo_is_cancelled(cancel))
      return MO_ERR_CANCELLED;
    const uint32_t n_changes = mo_atlas_changes(atlas, i, MO_ATLAS_REMOVE, changes);
    for (uint32_t c = 0; c < n_changes; c++) {
      uint64_t smaller;
      if (mo_atlas_find_key(atlas, changes[c].n_voxels, changes[c].key, &smaller) != MO_OK)
        continue;
      learn(atlas, best, i, smaller);
      learn(atlas, best, smaller, i);
    }
  }
  return MO_OK;
}

/* Replaces each body's best neighbor with its optimum. */
static void follow(struct mo_atlas_basins *basins, const struct mo_atlas_index *index)
{
  for (uint64_t i = 0; i < basins->n; i++) {
    const uint32_t body = index->all[i];
    uint32_t *optimum = &basins->optima[body];
    basins->n_optima += *optimum == NONE;
    *optimum = *optimum == NONE ? body : basins->optima[*optimum];
    basins->bodies[*optimum]++;
  }
}

int mo_atlas_basins_create(const struct mo_atlas *atlas, const struct mo_atlas_index *index,
                           const volatile int *cancel, struct mo_atlas_basins **basins)
{
  struct mo_atlas_basins *made = calloc(1, sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  made->n = mo_atlas_bodies_of(atlas);
  made->optima = mo_pages_alloc(made->n, sizeof(*made->optima));
  made->bodies = mo_pages_alloc(made->n, sizeof(*made->bodies));
  int error = made->optima != NULL && made->bodies != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  if (error == MO_OK)
    error = find_best(atlas, cancel, made->optima);
  if (error != MO_OK) {
    mo_atlas_basins_free(made);
    return error;
  }
  follow(made, index);
  *basins = made;
  return MO_OK;
}

void mo_atlas_basins_free(struct mo_atlas_basins *basins)
{
  if (basins == NULL)
    return;
  mo_pages_free(basins->optima, basins->n, sizeof(*basins->optima));
  mo_pages_free(basins->bodies, basins->n, sizeof(*basins->bodies));
  free(basins);
}

uint64_t mo_atlas_optima(const struct mo_atlas_basins *basins)
{
  return basins->n_optima;
}

uint64_t mo_atlas_optimum_of(const struct mo_atlas_basins *basins, uint64_t position)
{
  return basins->optima[position];
}

uint64_t mo_atlas_basin_of(const struct mo_atlas_basins *basins, uint64_t position)
{
  return basins->bodies[position];
}
