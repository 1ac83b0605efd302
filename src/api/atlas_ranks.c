/* atlas_ranks.c: the best bodies of an atlas, and how its scores are distributed. */
#include <math.h>
#include <stdlib.h>

#include "api/atlas_json.h"

#define BINS_MAX     1024
#define BINS_DEFAULT 64

/* Returns how many bodies of a size, or of all (0), have a finite score. */
static uint64_t count_finite(const struct mo_atlas_use *use, uint32_t n_voxels)
{
  const float edges[] = {-INFINITY, INFINITY};
  uint64_t n = 0;
  mo_atlas_histogram(use->index, n_voxels, edges, 1, &n);
  return n;
}

/* ---- the best ---- */

void mo_api_get_atlas_best(struct mo_request *request)
{
  struct mo_atlas_use use;
  struct mo_text text = {0};
  uint32_t n_voxels = 0;
  int64_t cursor;
  size_t limit;
  if (!mo_query_limit(request, &limit) || !mo_query_cursor(request, &cursor) ||
      !mo_atlas_begin(request, MO_ATLAS_NEED_INDEX, &use))
    return;
  float edges[] = {-INFINITY, -INFINITY, INFINITY};
  if (mo_atlas_query_voxels(request, &use, &n_voxels) &&
      mo_atlas_query_range(request, &edges[1], &edges[2])) {
    uint64_t counts[2] = {0}; /* before the range, and in it */
    const uint64_t skipped = cursor > 0 ? (uint64_t)cursor : 0;
    mo_atlas_histogram(use.index, n_voxels, edges, 2, counts);
    if (mo_query(request, "hi") == NULL) /* then diverged bodies follow, as the worst */
      counts[1] = (n_voxels > 0 ? mo_atlas_size(use.atlas, n_voxels, NULL)
                                : mo_atlas_bodies_of(use.atlas)) -
                  counts[0];
    uint64_t i = skipped;
    mo_text_add(&text, "{\"items\":[");
    for (; i < counts[1] && i - skipped < limit; i++)
      mo_atlas_item_body(&text, &use, mo_atlas_nth(use.index, n_voxels, counts[0] + i));
    mo_text_add(&text, "]");
    mo_text_member_count(&text, "bodies", counts[1]);
    mo_text_member_id(&text, "next_cursor", i < counts[1] ? (int64_t)i : -1);
    mo_text_add(&text, "}");
    mo_reply_text(request, MO_OK, &text, "page");
  }
  mo_atlas_done(request, &use);
}

/* ---- distributions ---- */

/* Divides a range into n bins of the same width. */
static void divide(float lo, float hi, uint32_t n, float *edges)
{
  for (uint32_t i = 0; i <= n; i++)
    edges[i] = (float)((double)lo + ((double)hi - (double)lo) * (double)i / (double)n);
  edges[n] = hi;
}

static void write_counts(struct mo_text *text, const struct mo_atlas_use *use, uint32_t first,
                         uint32_t last, const float *edges, uint32_t n)
{
  uint64_t counts[BINS_MAX], outside[MO_ATLAS_VOXELS_MAX + 1] = {0};
  mo_text_open(text, "sizes", "[");
  for (uint32_t size = first; size <= last; size++)
    mo_text_format(text, size > first ? ",%u" : "%u", size);
  mo_text_add(text, "]");
  mo_text_open(text, "counts", "[");
  for (uint32_t size = first; size <= last; size++) {
    outside[size] = mo_atlas_size(use->atlas, size, NULL);
    mo_atlas_histogram(use->index, size, edges, n, counts);
    mo_text_add(text, size > first ? ",[" : "[");
    for (uint32_t i = 0; i < n; i++) {
      mo_text_format(text, i > 0 ? ",%llu" : "%llu", (unsigned long long)counts[i]);
      outside[size] -= counts[i];
    }
    mo_text_add(text, "]");
  }
  mo_text_add(text, "]");
  mo_text_open(text, "outside", "[");
  for (uint32_t size = first; size <= last; size++)
    mo_text_format(text, size > first ? ",%llu" : "%llu", (unsigned long long)outside[size]);
  mo_text_add(text, "]");
}

void mo_api_get_atlas_histogram(struct mo_request *request)
{
  struct mo_atlas_use use;
  struct mo_text text = {0};
  int64_t bins = BINS_DEFAULT;
  uint32_t n_voxels = 0;
  float lo = 0, hi = 1, edges[BINS_MAX + 1];
  if (!mo_query_number(request, "bins", 1, BINS_MAX, &bins) ||
      !mo_atlas_begin(request, MO_ATLAS_NEED_INDEX, &use))
    return;
  const uint64_t n_finite = count_finite(&use, 0);
  if (n_finite > 0) {
    lo = mo_atlas_score(use.atlas, mo_atlas_nth(use.index, 0, 0));
    hi = nextafterf(mo_atlas_score(use.atlas, mo_atlas_nth(use.index, 0, n_finite - 1)), INFINITY);
  }
  if (mo_atlas_query_voxels(request, &use, &n_voxels) && mo_atlas_query_range(request, &lo, &hi)) {
    divide(lo, hi, (uint32_t)bins, edges);
    mo_text_object(&text);
    mo_atlas_member_floats(&text, "edges", edges, (size_t)bins + 1);
    write_counts(&text, &use, n_voxels > 0 ? n_voxels : 1,
                 n_voxels > 0 ? n_voxels : mo_atlas_source_of(use.atlas)->scope.voxels_max, edges,
                 (uint32_t)bins);
    mo_text_add(&text, "}");
    mo_reply_text(request, MO_OK, &text, "histogram");
  }
  mo_atlas_done(request, &use);
}

void mo_api_get_atlas_footprints(struct mo_request *request)
{
  struct mo_atlas_footprint footprints[MO_ATLAS_VOXELS_MAX + 1];
  struct mo_atlas_use use;
  struct mo_text text = {0};
  if (!mo_atlas_begin(request, MO_ATLAS_NEED_INDEX, &use))
    return;
  mo_atlas_footprints(use.atlas, footprints);
  mo_text_add(&text, "{\"items\":[");
  for (uint32_t i = 1; i <= MO_ATLAS_VOXELS_MAX; i++) {
    if (footprints[i].bodies == 0)
      continue;
    mo_text_object(&text);
    mo_text_member_count(&text, "footprint", i);
    mo_text_member_count(&text, "bodies", footprints[i].bodies);
    mo_atlas_member_body(&text, "best", &use, footprints[i].optimum);
    mo_text_add(&text, "}");
  }
  mo_text_add(&text, "]}");
  mo_reply_text(request, MO_OK, &text, "footprints");
  mo_atlas_done(request, &use);
}
