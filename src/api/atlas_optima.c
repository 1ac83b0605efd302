/* atlas_optima.c: the local optima with the largest basins, and which of these basins touch.
 *
 * Two basins touch where a body of one is a neighbor of a body of the other. A pair of neighbors is
 * found once, from its larger body. Only the bodies of the listed basins are examined, a small part
 * of all bodies. */
#include <stdlib.h>

#include "api/atlas_json.h"

#define OPTIMA_MAX     500
#define OPTIMA_DEFAULT 200
#define PER_CHECK      4096 /* bodies between two checks that the client is still connected */

struct optimum {
  uint32_t position, basin;
  float score;
};

struct network {
  uint32_t n, limit;
  struct optimum optima[OPTIMA_MAX]; /* (n) the largest basins first */
  uint32_t positions[OPTIMA_MAX];    /* (n) the positions of these optima, ascending */
  uint16_t places[OPTIMA_MAX];       /* (n) the place in `optima` of each of these */
  uint32_t *touching;                /* (n, n) pairs of neighbors, at [lower place][higher place] */
};

static int compare(const struct optimum *a, const struct optimum *b)
{
  if (a->basin != b->basin)
    return a->basin > b->basin ? -1 : 1;
  if (a->score != b->score)
    return a->score < b->score ? -1 : 1;
  return a->position < b->position ? -1 : 1;
}

/* Keeps an optimum if it is among the first. */
static void keep(struct network *network, struct optimum optimum)
{
  uint32_t at = network->n;
  if (at == network->limit && compare(&network->optima[at - 1], &optimum) < 0)
    return;
  at -= at == network->limit;
  network->n = at + 1;
  for (; at > 0 && compare(&optimum, &network->optima[at - 1]) < 0; at--)
    network->optima[at] = network->optima[at - 1];
  network->optima[at] = optimum;
}

static void find_optima(const struct mo_atlas_use *use, struct network *network)
{
  const uint64_t n_bodies = mo_atlas_bodies_of(use->atlas);
  for (uint64_t i = 0; i < n_bodies; i++) {
    const uint64_t basin = mo_atlas_basin_of(use->basins, i);
    if (basin > 0)
      keep(network, (struct optimum){(uint32_t)i, (uint32_t)basin, mo_atlas_score(use->atlas, i)});
  }
  for (uint32_t i = 0; i < network->n; i++) {
    const uint32_t position = network->optima[i].position;
    uint32_t at = i;
    for (; at > 0 && network->positions[at - 1] > position; at--) {
      network->positions[at] = network->positions[at - 1];
      network->places[at] = network->places[at - 1];
    }
    network->positions[at] = position;
    network->places[at] = (uint16_t)i;
  }
}

/* Returns the place of the optimum of a body, or OPTIMA_MAX if it is not listed. */
static uint32_t place_of(const struct mo_atlas_use *use, const struct network *network,
                         uint64_t body)
{
  const uint64_t optimum = mo_atlas_optimum_of(use->basins, body);
  uint32_t low = 0, high = network->n;
  while (low < high) {
    const uint32_t middle = low + (high - low) / 2;
    if (network->positions[middle] < optimum)
      low = middle + 1;
    else
      high = middle;
  }
  return low < network->n && network->positions[low] == optimum ? network->places[low] : OPTIMA_MAX;
}

/* Counts the pairs of a body and its neighbors with one voxel fewer. from: its optimum's place. */
static void count_pairs(const struct mo_atlas_use *use, struct network *network, uint64_t body,
                        uint32_t from)
{
  struct mo_atlas_neighbor smaller[MO_ATLAS_NEIGHBORS_MAX];
  const uint32_t n = mo_atlas_neighbors(use->atlas, body, MO_ATLAS_REMOVE, smaller);
  for (uint32_t i = 0; i < n; i++) {
    const uint32_t to = place_of(use, network, smaller[i].position);
    const uint32_t low = from < to ? from : to, high = from < to ? to : from;
    if (high != OPTIMA_MAX && low != high)
      network->touching[low * (size_t)network->n + high]++;
  }
}

static int find_touching(struct mo_request *request, const struct mo_atlas_use *use,
                         struct network *network)
{
  const uint64_t n_bodies = mo_atlas_bodies_of(use->atlas);
  network->touching = calloc((size_t)network->n * network->n + 1, sizeof(*network->touching));
  if (network->touching == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint64_t i = 0; i < n_bodies; i++) {
    if (i % PER_CHECK == 0 && mo_request_is_over(request))
      return MO_ERR_CANCELLED;
    const uint32_t place = place_of(use, network, i);
    if (place != OPTIMA_MAX)
      count_pairs(use, network, i, place);
  }
  return MO_OK;
}

static void write_network(struct mo_text *text, const struct mo_atlas_use *use,
                          const struct network *network)
{
  mo_text_add(text, "{\"items\":[");
  for (uint32_t i = 0; i < network->n; i++) {
    mo_text_object(text);
    mo_atlas_write_body(text, use, network->optima[i].position);
    mo_text_member_count(text, "basin", network->optima[i].basin);
    mo_text_add(text, "}");
  }
  mo_text_add(text, "]");
  mo_text_member_count(text, "optima", mo_atlas_optima(use->basins));
  mo_text_open(text, "edges", "[");
  for (uint32_t i = 0; i < network->n; i++)
    for (uint32_t k = i + 1; k < network->n; k++) {
      const uint32_t pairs = network->touching[i * (size_t)network->n + k];
      if (pairs > 0) {
        mo_text_next(text);
        mo_text_format(text, "[%u,%u,%u]", i, k, pairs);
      }
    }
  mo_text_add(text, "]}");
}

void mo_api_get_atlas_optima(struct mo_request *request)
{
  struct mo_atlas_use use;
  struct mo_text text = {0};
  int64_t limit = OPTIMA_DEFAULT;
  if (!mo_query_number(request, "limit", 1, OPTIMA_MAX, &limit) ||
      !mo_atlas_begin(request, MO_ATLAS_NEED_BASINS, &use))
    return;
  struct network *network = calloc(1, sizeof(*network));
  int error = network != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  if (error == MO_OK) {
    network->limit = (uint32_t)limit;
    find_optima(&use, network);
    error = find_touching(request, &use, network);
  }
  if (error == MO_OK)
    write_network(&text, &use, network);
  mo_reply_text(request, error, &text, "optima");
  if (network != NULL)
    free(network->touching);
  free(network);
  mo_atlas_done(request, &use);
}
