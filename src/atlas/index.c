/* index.c: ranks, best bodies and histograms, from positions sorted by score. */
#include "atlas/index.h"

#include "atlas/neighbors.h"
#include "base/memory.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define DIGITS (UINT32_C(1) << 16)

/* Returns what bodies are sorted by: the score, or a measure, which may be NaN. */
static float value_at(const struct mo_atlas_index *index, uint64_t position)
{
  if (index->column < 0)
    return mo_atlas_score(index->atlas, position);
  const float value = mo_atlas_in_column(index->atlas, position, (uint32_t)index->column);
  return index->is_negative ? -value : value;
}

/* Returns a number that is ordered like a score. −0 and 0 are one score; NaN is the highest. */
static uint32_t order_of(float score)
{
  uint32_t bits;
  if (isnan(score))
    return UINT32_MAX;
  score = score == 0 ? 0 : score;
  memcpy(&bits, &score, sizeof(bits));
  return bits >> 31 != 0 ? ~bits : bits | UINT32_C(1) << 31;
}

/* Turns counts into the place of the first item of each digit. */
static void place_digits(uint32_t *counts)
{
  uint32_t sum = 0;
  for (uint32_t digit = 0; digit < DIGITS; digit++) {
    const uint32_t n = counts[digit];
    counts[digit] = sum;
    sum += n;
  }
}

/* Sorts all positions by score, stably, with digits of 16 bits. by_size holds the positions between
 * the passes, next to their higher digits, so that little memory is needed in addition to the
 * index. */
static int sort_all(struct mo_atlas_index *index)
{
  uint32_t *low = mo_pages_alloc(2 * (size_t)DIGITS, sizeof(*low));
  uint32_t *high = low != NULL ? low + DIGITS : NULL;
  uint16_t *higher = mo_pages_alloc(index->n, sizeof(*higher));
  const int error = low != NULL && higher != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  for (uint64_t i = 0; error == MO_OK && i < index->n; i++) {
    const uint32_t order = order_of(value_at(index, i));
    low[order % DIGITS]++;
    high[order / DIGITS]++;
  }
  if (error == MO_OK) {
    place_digits(low);
    place_digits(high);
  }
  for (uint64_t i = 0; error == MO_OK && i < index->n; i++) {
    const uint32_t order = order_of(value_at(index, i));
    const uint32_t at = low[order % DIGITS]++;
    index->by_size[at] = (uint32_t)i;
    higher[at] = (uint16_t)(order / DIGITS);
  }
  for (uint64_t i = 0; error == MO_OK && i < index->n; i++)
    index->all[high[higher[i]]++] = index->by_size[i];
  mo_pages_free(low, 2 * (size_t)DIGITS, sizeof(*low));
  mo_pages_free(higher, index->n, sizeof(*higher));
  return error;
}

static void divide_by_size(struct mo_atlas_index *index)
{
  const struct mo_atlas_layout *layout = &index->atlas->layout;
  uint64_t ends[MO_ATLAS_VOXELS_MAX];
  memcpy(ends, layout->firsts, sizeof(ends));
  for (uint64_t i = 0; i < index->n; i++) {
    uint32_t size = 0;
    while (index->all[i] >= layout->firsts[size + 1])
      size++;
    index->by_size[ends[size]++] = index->all[i];
  }
}

static int create(const struct mo_atlas *atlas, int column, bool is_negative,
                  struct mo_atlas_index **index)
{
  struct mo_atlas_index *made = calloc(1, sizeof(*made));
  if (made == NULL)
    return MO_ERR_NO_MEMORY;
  made->atlas = atlas;
  made->column = column;
  made->is_negative = is_negative;
  made->n = mo_atlas_bodies_of(atlas);
  made->all = mo_pages_alloc(made->n, sizeof(*made->all));
  made->by_size = mo_pages_alloc(made->n, sizeof(*made->by_size));
  int error = made->all != NULL && made->by_size != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  if (error == MO_OK)
    error = sort_all(made);
  if (error != MO_OK) {
    mo_atlas_index_free(made);
    return error;
  }
  divide_by_size(made);
  *index = made;
  return MO_OK;
}

int mo_atlas_index_create(const struct mo_atlas *atlas, struct mo_atlas_index **index)
{
  return create(atlas, -1, false, index);
}

int mo_atlas_index_create_by(const struct mo_atlas *atlas, enum mo_measure measure,
                             bool is_negative, struct mo_atlas_index **index)
{
  const int column = mo_atlas_column_of(atlas, measure);
  return column >= 0 ? create(atlas, column, is_negative, index) : MO_ERR_NOT_FOUND;
}

void mo_atlas_index_free(struct mo_atlas_index *index)
{
  if (index == NULL)
    return;
  mo_pages_free(index->all, index->n, sizeof(*index->all));
  mo_pages_free(index->by_size, index->n, sizeof(*index->by_size));
  free(index);
}

/* ---- queries ---- */

/* Returns the sorted positions of a size, or of all sizes. */
static const uint32_t *sorted(const struct mo_atlas_index *index, uint32_t n_voxels, uint64_t *n)
{
  uint64_t first = 0;
  if (n_voxels == 0) {
    *n = index->n;
    return index->all;
  }
  *n = mo_atlas_size(index->atlas, n_voxels, &first);
  return index->by_size + first;
}

/* Counts the positions with a lower score or, with `or_equal`, a score that is not higher. */
static uint64_t count(const struct mo_atlas_index *index, const uint32_t *positions, uint64_t n,
                      float score, bool or_equal)
{
  uint64_t low = 0, high = n;
  while (low < high) {
    const uint64_t middle = low + (high - low) / 2;
    const float there = value_at(index, positions[middle]);
    if (there < score || (or_equal && there == score))
      low = middle + 1;
    else
      high = middle;
  }
  return low;
}

struct mo_atlas_rank mo_atlas_rank_of(const struct mo_atlas_index *index, uint64_t position,
                                      bool within_size)
{
  uint64_t key, n;
  const uint32_t n_voxels = within_size ? mo_atlas_key_at(index->atlas, position, &key) : 0;
  const uint32_t *positions = sorted(index, n_voxels, &n);
  const float score = value_at(index, position);
  const uint64_t better = count(index, positions, n, score, false);
  const uint64_t up_to = count(index, positions, n, score, true);
  struct mo_atlas_rank rank = {
      .better = better, .equal = up_to - better - 1, .worse = n - up_to, .percentile = 100};
  if (n > 1)
    rank.percentile = 100 * ((double)rank.worse + (double)rank.equal / 2) / (double)(n - 1);
  return rank;
}

uint64_t mo_atlas_nth(const struct mo_atlas_index *index, uint32_t n_voxels, uint64_t i)
{
  uint64_t n;
  return sorted(index, n_voxels, &n)[i];
}

uint64_t mo_atlas_best(const struct mo_atlas_index *index, uint32_t n_voxels, uint64_t max,
                       uint64_t *positions)
{
  uint64_t n;
  const uint32_t *from = sorted(index, n_voxels, &n);
  n = n < max ? n : max;
  for (uint64_t i = 0; i < n; i++)
    positions[i] = from[i];
  return n;
}

void mo_atlas_histogram(const struct mo_atlas_index *index, uint32_t n_voxels, const float *edges,
                        uint32_t n, uint64_t *counts)
{
  uint64_t bodies;
  const uint32_t *positions = sorted(index, n_voxels, &bodies);
  uint64_t before = count(index, positions, bodies, edges[0], false);
  for (uint32_t i = 0; i < n; i++) {
    const uint64_t up_to = count(index, positions, bodies, edges[i + 1], false);
    counts[i] = up_to - before;
    before = up_to;
  }
}

void mo_atlas_footprints(const struct mo_atlas *atlas,
                         struct mo_atlas_footprint footprints[MO_ATLAS_VOXELS_MAX + 1])
{
  const uint64_t n = mo_atlas_bodies_of(atlas);
  const uint32_t nz = atlas->source.scope.workspace.nz;
  memset(footprints, 0, (MO_ATLAS_VOXELS_MAX + 1) * sizeof(*footprints));
  for (uint64_t i = 0; i < n; i++) {
    uint32_t voxels[MO_ATLAS_VOXELS_MAX], columns = 1;
    uint64_t key;
    const uint32_t n_voxels = mo_atlas_key_at(atlas, i, &key);
    mo_atlas_key_voxels(&atlas->sets, key, n_voxels, voxels);
    for (uint32_t v = 1; v < n_voxels; v++) /* the voxels of a column are consecutive */
      columns += voxels[v] / nz != voxels[v - 1] / nz;
    struct mo_atlas_footprint *footprint = &footprints[columns];
    if (footprint->bodies++ == 0 ||
        mo_atlas_score(atlas, i) < mo_atlas_score(atlas, footprint->optimum))
      footprint->optimum = i;
  }
}
