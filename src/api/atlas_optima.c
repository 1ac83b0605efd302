/* atlas_optima.c: the local optima with the largest basins, and which of these basins touch.
 *
 * Two basins touch where a body of one is a neighbor of a body of the other. A pair of neighbors is
 * found once, from its larger body. Only the bodies of the listed basins are looked at: a small
 * part of all. */
#include <stdlib.h>
#include <string.h>

#include "api/atlas_json.h"

#define OPTIMA_DEFAULT 200
#define PER_CHECK      4096 /* bodies between two looks at whether the client is still there */

struct optimum {
  uint32_t position, basin;
  float score;
};

struct network {
  struct optimum *optima; /* (n) the largest basins first */
  uint32_t n, limit;
  uint16_t *places;   /* (bodies) 1 + the place of a body's optimum in `optima`; 0: not listed */
  uint32_t *touching; /* (n, n) pairs of neighbors, at [lower place][higher place] */
};

static void free_network(struct network *network)
{
  free(network->optima);
  free(network->places);
  free(network->touching);
}

static int compare(const void *a, const void *b)
{
  const struct optimum *p = a, *q = b;
  if (p->basin != q->basin)
    return p->basin > q->basin ? -1 : 1;
  if (p->score != q->score)
    return p->score < q->score ? -1 : 1;
  return p->position < q->position ? -1 : 1;
}

static int find_optima(const struct mo_atlas_use *use, struct network *network)
{
  const uint64_t n_bodies = mo_atlas_bodies_of(use->atlas);
  uint32_t n = 0;
  network->optima = malloc(mo_atlas_optima(use->basins) * sizeof(*network->optima));
  if (network->optima == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint64_t i = 0; i < n_bodies; i++) {
    const uint64_t basin = mo_atlas_basin_of(use->basins, i);
    if (basin > 0)
      network->optima[n++] =
          (struct optimum){(uint32_t)i, (uint32_t)basin, mo_atlas_score(use->atlas, i)};
  }
  qsort(network->optima, n, sizeof(*network->optima), compare);
  network->n = n < network->limit ? n : network->limit;
  return MO_OK;
}

/* Counts the pairs of a body and its neighbors with one voxel less. */
static void count_pairs(const struct mo_atlas_use *use, struct network *network, uint64_t body)
{
  struct mo_atlas_neighbor smaller[MO_ATLAS_NEIGHBORS_MAX];
  const uint32_t from = network->places[body];
  const uint32_t n = mo_atlas_neighbors(use->atlas, body, MO_ATLAS_REMOVE, smaller);
  for (uint32_t i = 0; i < n; i++) {
    const uint32_t to = network->places[smaller[i].position];
    if (to != 0 && to != from)
      network->touching[(from < to ? from - 1 : to - 1) * (size_t)network->n +
                        (from < to ? to - 1 : from - 1)]++;
  }
}

static int find_touching(struct mo_request *request, const struct mo_atlas_use *use,
                         struct network *network)
{
  const uint64_t n_bodies = mo_atlas_bodies_of(use->atlas);
  network->places = calloc(n_bodies, sizeof(*network->places));
  network->touching = calloc((size_t)network->n * network->n, sizeof(*network->touching));
  if (network->places == NULL || network->touching == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint32_t i = 0; i < network->n; i++)
    network->places[network->optima[i].position] = (uint16_t)(i + 1);
  for (uint64_t i = 0; i < n_bodies; i++)
    network->places[i] = network->places[mo_atlas_optimum_of(use->basins, i)];
  for (uint64_t i = 0; i < n_bodies; i++) {
    if (i % PER_CHECK == 0 && mo_request_is_over(request))
      return MO_ERR_CANCELLED;
    if (network->places[i] != 0)
      count_pairs(use, network, i);
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
  if (!mo_query_number(request, "limit", 1, MO_LIST_MAX, &limit) ||
      !mo_atlas_begin(request, MO_ATLAS_NEED_BASINS, &use))
    return;
  struct network network = {.limit = (uint32_t)limit};
  int error = find_optima(&use, &network);
  if (error == MO_OK)
    error = find_touching(request, &use, &network);
  if (error == MO_OK)
    write_network(&text, &use, &network);
  mo_reply_text(request, error, &text, "optima");
  free_network(&network);
  mo_atlas_done(request, &use);
}
