/* atlas_ranks.c: the best bodies of an atlas, and how its scores and measures are distributed. */
#include <math.h>
#include <stdlib.h>

#include "api/atlas_json.h"

#define BINS_MAX     1024
#define BINS_DEFAULT 64

/* The number by which bodies are ordered: the score, or a measure. */
struct order {
  const struct mo_atlas_index *index;
  struct mo_atlas_index *own; /* NULL: the index is that of the scores */
  int measure;                /* −1: the score */
  bool is_negative;           /* the highest value of the measure comes first */
};

/* Reads `measure` and, for lists, `order`, and sorts the bodies. Returns false if it has replied.
 * The caller frees order->own. */
static bool begin_order(struct mo_request *request, const struct mo_atlas_use *use, bool is_list,
                        struct order *order)
{
  static const char *const words[] = {"descending", "ascending", NULL};
  int which = 0;
  *order = (struct order){.index = use->index, .measure = -1};
  if (!mo_query_word(request, "order", words, &which) ||
      !mo_atlas_query_measure(request, use, &order->measure))
    return false;
  if (order->measure < 0) {
    if (mo_query(request, "order") != NULL)
      mo_reply_bad_parameter(request, "order",
                             "needs a measure; scores are always listed best first");
    return mo_query(request, "order") == NULL;
  }
  order->is_negative = is_list && which == 0;
  if (!mo_atlas_sort_by(request, use, order->measure, order->is_negative, &order->own))
    return false;
  order->index = order->own;
  return true;
}

/* ---- the best ---- */

/* Finds the bodies in a range of scores or of values: counts[1] bodies, which follow the first
 * counts[0]. Bodies without a value, and diverged ones, come last, if the range is open at that
 * end. */
static void find_range(const struct mo_request *request, const struct mo_atlas_use *use,
                       const struct order *order, uint32_t n_voxels, float lo, float hi,
                       uint64_t counts[2])
{
  float edges[] = {-INFINITY, lo, hi};
  if (order->is_negative) { /* lo ≤ value < hi */
    edges[1] = nextafterf(-hi, INFINITY);
    edges[2] = nextafterf(-lo, INFINITY);
  }
  mo_atlas_histogram(order->index, n_voxels, edges, 2, counts);
  if (mo_query(request, order->is_negative ? "lo" : "hi") == NULL)
    counts[1] = (n_voxels > 0 ? mo_atlas_size(use->atlas, n_voxels, NULL)
                              : mo_atlas_bodies_of(use->atlas)) -
                counts[0];
}

/* The part of an ordered range that a list shows: all of it, or the bodies whose scores are in a
 * range. */
struct part {
  const struct mo_atlas_use *use;
  const struct order *order;
  uint32_t n_voxels;
  uint64_t first, n; /* the range in the order */
  bool is_filtered;
  float lo, hi; /* lo ≤ score < hi, if it is filtered */
};

/* Reads `score_lo` and `score_hi`, which need a measure. Returns false if it has replied. */
static bool read_scores(struct mo_request *request, struct part *part)
{
  const bool has_lo = mo_query(request, "score_lo") != NULL;
  part->is_filtered = has_lo || mo_query(request, "score_hi") != NULL;
  if (part->is_filtered && part->order->measure < 0) {
    mo_reply_bad_parameter(request, has_lo ? "score_lo" : "score_hi",
                           "needs a measure; without one, lo and hi are scores");
    return false;
  }
  return mo_atlas_query_interval(request, "score_lo", "score_hi", &part->lo, &part->hi);
}

static uint64_t nth_of(const struct part *part, uint64_t i)
{
  return mo_atlas_nth(part->order->index, part->n_voxels, part->first + i);
}

/* Writes those bodies of a filtered part, at most `limit`, that follow its first `skipped`. Returns
 * how many bodies the part has. */
static uint64_t write_filtered(struct mo_text *text, const struct part *part, uint64_t skipped,
                               uint64_t limit)
{
  uint64_t n = 0;
  for (uint64_t i = 0; i < part->n; i++) {
    const uint64_t position = nth_of(part, i);
    const float score = mo_atlas_score(part->use->atlas, position);
    if (score < part->lo || score >= part->hi)
      continue;
    if (n >= skipped && n - skipped < limit)
      mo_atlas_item_body(text, part->use, position);
    n++;
  }
  return n;
}

/* The same for any part. */
static uint64_t write_part(struct mo_text *text, const struct part *part, uint64_t skipped,
                           uint64_t limit)
{
  if (part->is_filtered)
    return write_filtered(text, part, skipped, limit);
  for (uint64_t i = skipped; i < part->n && i - skipped < limit; i++)
    mo_atlas_item_body(text, part->use, nth_of(part, i));
  return part->n;
}

void mo_api_get_atlas_best(struct mo_request *request)
{
  struct mo_atlas_use use;
  struct mo_text text = {0};
  struct order order = {.own = NULL};
  uint32_t n_voxels = 0;
  float lo = -INFINITY, hi = INFINITY;
  int64_t cursor;
  size_t limit;
  if (!mo_query_limit(request, &limit) || !mo_query_cursor(request, &cursor) ||
      !mo_atlas_begin(request, MO_ATLAS_NEED_INDEX, &use))
    return;
  struct part part = {.use = &use, .order = &order, .lo = -INFINITY, .hi = INFINITY};
  if (mo_atlas_query_voxels(request, &use, &n_voxels) && mo_atlas_query_range(request, &lo, &hi) &&
      begin_order(request, &use, true, &order) && read_scores(request, &part)) {
    uint64_t counts[2] = {0}; /* before the range, and in it */
    const uint64_t skipped = cursor > 0 ? (uint64_t)cursor : 0;
    find_range(request, &use, &order, n_voxels, lo, hi, counts);
    part.n_voxels = n_voxels;
    part.first = counts[0];
    part.n = counts[1];
    mo_text_add(&text, "{\"items\":[");
    const uint64_t n = write_part(&text, &part, skipped, limit);
    mo_text_add(&text, "]");
    mo_text_member_count(&text, "bodies", n);
    mo_text_member_id(&text, "next_cursor", skipped + limit < n ? (int64_t)(skipped + limit) : -1);
    mo_text_add(&text, "}");
    mo_reply_text(request, MO_OK, &text, "page");
  }
  mo_atlas_index_free(order.own);
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

static void write_counts(struct mo_text *text, const struct mo_atlas_use *use,
                         const struct mo_atlas_index *index, uint32_t first, uint32_t last,
                         const float *edges, uint32_t n)
{
  uint64_t counts[BINS_MAX], outside[MO_ATLAS_VOXELS_MAX + 1] = {0};
  mo_text_open(text, "sizes", "[");
  for (uint32_t size = first; size <= last; size++)
    mo_text_format(text, size > first ? ",%u" : "%u", size);
  mo_text_add(text, "]");
  mo_text_open(text, "counts", "[");
  for (uint32_t size = first; size <= last; size++) {
    outside[size] = mo_atlas_size(use->atlas, size, NULL);
    mo_atlas_histogram(index, size, edges, n, counts);
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

/* Finds where the bins begin and end if the request does not specify it: at the lowest and after
 * the highest finite score or value. */
static void find_ends(const struct mo_atlas_use *use, const struct order *order, float *lo,
                      float *hi)
{
  const float all[] = {-INFINITY, INFINITY};
  float ends[2] = {0, 0};
  uint64_t n = 0;
  mo_atlas_histogram(order->index, 0, all, 1, &n);
  if (n == 0)
    return;
  for (int end = 0; end < 2; end++) {
    const uint64_t position = mo_atlas_nth(order->index, 0, end == 0 ? 0 : n - 1);
    ends[end] = order->measure < 0
                    ? mo_atlas_score(use->atlas, position)
                    : mo_atlas_measure(use->atlas, position, (enum mo_measure)order->measure);
  }
  *lo = ends[0];
  *hi = nextafterf(ends[1], INFINITY);
}

void mo_api_get_atlas_histogram(struct mo_request *request)
{
  struct mo_atlas_use use;
  struct mo_text text = {0};
  struct order order = {.own = NULL};
  int64_t bins = BINS_DEFAULT;
  uint32_t n_voxels = 0;
  float lo = 0, hi = 1, edges[BINS_MAX + 1];
  if (!mo_query_number(request, "bins", 1, BINS_MAX, &bins) ||
      !mo_atlas_begin(request, MO_ATLAS_NEED_INDEX, &use))
    return;
  bool is_valid = begin_order(request, &use, false, &order);
  if (is_valid)
    find_ends(&use, &order, &lo, &hi);
  is_valid = is_valid && mo_atlas_query_voxels(request, &use, &n_voxels) &&
             mo_atlas_query_range(request, &lo, &hi);
  if (is_valid) {
    divide(lo, hi, (uint32_t)bins, edges);
    mo_text_object(&text);
    mo_atlas_member_floats(&text, "edges", edges, (size_t)bins + 1);
    write_counts(&text, &use, order.index, n_voxels > 0 ? n_voxels : 1,
                 n_voxels > 0 ? n_voxels : mo_atlas_source_of(use.atlas)->scope.voxels_max, edges,
                 (uint32_t)bins);
    mo_text_add(&text, "}");
    mo_reply_text(request, MO_OK, &text, "histogram");
  }
  mo_atlas_index_free(order.own);
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
