/* atlas_compare.c: compares the scores of the same bodies in two atlases, or the scores of an atlas
 * with one of its measures, as a histogram of both and as Kendall's rank correlation.
 *
 * Atlases of one workspace list the same bodies in the same order, so a body is usually at the same
 * position; if it is not, it is looked up. Kendall's tau-b is exact, by Knight's method: the bodies
 * are put in the order of the first score, and the exchanges in a merge sort by the second score
 * are the discordant pairs. The order comes from the index of the first atlas, which takes another
 * 8 bytes per body. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "api/atlas_json.h"
#include "atlas/file.h"
#include "base/memory.h"

#define BINS_MAX     256
#define BINS_DEFAULT 64
#define PER_CHECK    65536 /* bodies between two checks of the request */

struct comparison {
  struct mo_request *request;
  struct mo_atlas_use a, b; /* a has an index */
  int measure;           /* measure of a that is compared instead of the scores of b; −1: none */
  uint64_t n, n_outside; /* bodies in both atlases; those of them that diverged in either one */
  uint32_t bins;
  float edges[2][BINS_MAX + 1];
  uint64_t *counts; /* (bins, bins): [bin of a][bin of b] */
  double tau;       /* NaN: in one of the atlases, all bodies have the same score */
};

/* Periodically checks whether the client has left or the service is stopping. */
static bool is_over(const struct comparison *comparison, uint64_t i)
{
  return i % PER_CHECK == 0 && mo_request_is_over(comparison->request);
}

/* Finds a body of the first atlas in the second one. */
static bool find_other(const struct comparison *comparison, uint64_t position, uint64_t *other)
{
  const struct mo_atlas *b = comparison->b.atlas;
  uint64_t key, there;
  const uint32_t n_voxels = mo_atlas_key_at(comparison->a.atlas, position, &key);
  if (position < mo_atlas_bodies_of(b) && mo_atlas_key_at(b, position, &there) == n_voxels &&
      there == key) {
    *other = position;
    return true;
  }
  return mo_atlas_find_key(b, n_voxels, key, other) == MO_OK;
}

/* Reads both scores of a body of the first atlas, or its score and its measure. Returns false if
 * the second atlas does not have it, or if the measure has no value. */
static bool read_scores(const struct comparison *comparison, uint64_t position, float scores[2])
{
  uint64_t other;
  if (comparison->measure >= 0) {
    scores[0] = mo_atlas_score(comparison->a.atlas, position);
    scores[1] =
        mo_atlas_measure(comparison->a.atlas, position, (enum mo_measure)comparison->measure);
    return !isnan(scores[1]);
  }
  if (!find_other(comparison, position, &other))
    return false;
  scores[0] = mo_atlas_score(comparison->a.atlas, position);
  scores[1] = mo_atlas_score(comparison->b.atlas, other);
  return true;
}

/* ---- the histogram ---- */

static void set_edges(struct comparison *comparison, const float low[2], const float high[2])
{
  for (int of = 0; of < 2; of++) {
    const double lo = comparison->n > comparison->n_outside ? (double)low[of] : 0;
    const double hi =
        comparison->n > comparison->n_outside ? (double)nextafterf(high[of], INFINITY) : 1;
    for (uint32_t i = 0; i <= comparison->bins; i++)
      comparison->edges[of][i] = (float)(lo + (hi - lo) * i / comparison->bins);
    comparison->edges[of][comparison->bins] = (float)hi;
  }
}

/* Returns the bin of a score that is within the edges. */
static uint32_t bin_of(const float *edges, uint32_t bins, float score)
{
  const double width = (double)edges[bins] - (double)edges[0];
  uint32_t bin = (uint32_t)(((double)score - (double)edges[0]) / width * bins);
  bin = bin < bins ? bin : bins - 1;
  while (bin > 0 && score < edges[bin])
    bin--;
  while (bin + 1 < bins && score >= edges[bin + 1])
    bin++;
  return bin;
}

static int count_bins(struct comparison *comparison)
{
  const uint64_t n = mo_atlas_bodies_of(comparison->a.atlas);
  float low[2] = {INFINITY, INFINITY}, high[2] = {-INFINITY, -INFINITY}, scores[2];
  comparison->counts = calloc((size_t)comparison->bins * comparison->bins, sizeof(uint64_t));
  if (comparison->counts == NULL)
    return MO_ERR_NO_MEMORY;
  for (uint64_t i = 0; i < n; i++) {
    if (is_over(comparison, i))
      return MO_ERR_CANCELLED;
    if (!read_scores(comparison, i, scores))
      continue;
    const bool is_inside = isfinite(scores[0]) && isfinite(scores[1]);
    comparison->n++;
    comparison->n_outside += !is_inside;
    for (int of = 0; of < 2 && is_inside; of++) {
      low[of] = fminf(low[of], scores[of]);
      high[of] = fmaxf(high[of], scores[of]);
    }
  }
  set_edges(comparison, low, high);
  for (uint64_t i = 0; i < n; i++) {
    if (is_over(comparison, i))
      return MO_ERR_CANCELLED;
    if (read_scores(comparison, i, scores) && isfinite(scores[0]) && isfinite(scores[1]))
      comparison->counts[(size_t)bin_of(comparison->edges[0], comparison->bins, scores[0]) *
                             comparison->bins +
                         bin_of(comparison->edges[1], comparison->bins, scores[1])]++;
  }
  return MO_OK;
}

/* ---- Kendall's tau ---- */

static uint64_t pairs_of(uint64_t n)
{
  return n * (n - 1) / 2;
}

static int compare_floats(const void *a, const void *b)
{
  const float p = *(const float *)a, q = *(const float *)b;
  return p < q ? -1 : p > q;
}

/* Returns the number of pairs of equal values in a sorted array. */
static uint64_t tied_pairs(const float *values, uint64_t n)
{
  uint64_t pairs = 0, run = 1;
  for (uint64_t i = 1; i <= n; i++) {
    if (i < n && values[i] == values[i - 1]) {
      run++;
    } else {
      pairs += pairs_of(run);
      run = 1;
    }
  }
  return pairs;
}

/* Sorts values by merging, through `scratch`. Returns the number of pairs that were in the wrong
 * order. */
static uint64_t sort_counting(float *values, float *scratch, uint64_t n)
{
  uint64_t exchanges = 0;
  for (uint64_t width = 1; width < n; width *= 2) {
    for (uint64_t begin = 0; begin < n; begin += 2 * width) {
      const uint64_t middle = begin + width < n ? begin + width : n;
      const uint64_t end = middle + width < n ? middle + width : n;
      uint64_t left = begin, right = middle;
      for (uint64_t i = begin; i < end; i++) {
        const bool is_right = left == middle || (right < end && values[right] < values[left]);
        exchanges += is_right ? middle - left : 0;
        scratch[i] = values[is_right ? right++ : left++];
      }
    }
    memcpy(values, scratch, n * sizeof(*values));
  }
  return exchanges;
}

/* Writes the second scores in the order of the first, those of equal first scores ascending.
 * Returns their number; *ties, *both: pairs with equal first scores, and with both equal. */
static uint64_t order_seconds(const struct comparison *comparison, float *seconds, uint64_t *ties,
                              uint64_t *both)
{
  const uint64_t n = mo_atlas_bodies_of(comparison->a.atlas);
  uint64_t found = 0, begin = 0;
  float last = 0, scores[2];
  *ties = *both = 0;
  for (uint64_t i = 0; i <= n; i++) {
    const bool is_end = i == n;
    if (!is_end && !read_scores(comparison, mo_atlas_nth(comparison->a.index, 0, i), scores))
      continue;
    if (is_end || scores[0] != last) {
      qsort(seconds + begin, found - begin, sizeof(*seconds), compare_floats);
      *ties += found > begin ? pairs_of(found - begin) : 0;
      *both += found > begin ? tied_pairs(seconds + begin, found - begin) : 0;
      begin = found;
    }
    if (!is_end) {
      last = scores[0];
      seconds[found++] = scores[1];
    }
  }
  return found;
}

static int correlate(struct comparison *comparison)
{
  float *seconds = mo_pages_alloc(comparison->n + 1, sizeof(*seconds));
  float *scratch = mo_pages_alloc(comparison->n + 1, sizeof(*scratch));
  const int error = seconds != NULL && scratch != NULL ? MO_OK : MO_ERR_NO_MEMORY;
  if (error == MO_OK) {
    uint64_t ties, both;
    const uint64_t n = order_seconds(comparison, seconds, &ties, &both);
    const uint64_t discordant = sort_counting(seconds, scratch, n);
    const uint64_t others = n > 0 ? tied_pairs(seconds, n) : 0, all = n > 0 ? pairs_of(n) : 0;
    const double untied = ((double)all - (double)ties) * ((double)all - (double)others);
    const double balance =
        (double)all - (double)ties - (double)others + (double)both - 2 * (double)discordant;
    comparison->tau = untied > 0 ? balance / sqrt(untied) : NAN;
  }
  mo_pages_free(seconds, comparison->n + 1, sizeof(*seconds));
  mo_pages_free(scratch, comparison->n + 1, sizeof(*scratch));
  return error;
}

/* ---- the request ---- */

/* b: the other atlas. */
static void write_comparison(struct mo_text *text, const struct comparison *comparison,
                             const char *a, const char *b)
{
  const uint32_t bins = comparison->bins;
  const bool is_map = comparison->measure >= 0;
  mo_text_object(text);
  mo_text_member(text, is_map ? "name" : "a", a);
  mo_text_member(text, is_map ? "measure" : "b",
                 is_map ? mo_measure_info[comparison->measure].name : b);
  mo_text_member_count(text, "bodies", comparison->n);
  mo_atlas_member_floats(text, is_map ? "edges_score" : "edges_a", comparison->edges[0],
                         bins + (size_t)1);
  mo_atlas_member_floats(text, is_map ? "edges_measure" : "edges_b", comparison->edges[1],
                         bins + (size_t)1);
  mo_text_open(text, "counts", "[");
  for (uint32_t i = 0; i < bins; i++) {
    mo_text_add(text, i > 0 ? ",[" : "[");
    for (uint32_t k = 0; k < bins; k++)
      mo_text_format(text, k > 0 ? ",%llu" : "%llu",
                     (unsigned long long)comparison->counts[(size_t)i * bins + k]);
    mo_text_add(text, "]");
  }
  mo_text_add(text, "]");
  mo_text_member_count(text, "outside", comparison->n_outside);
  if (is_map)
    mo_text_member_count(text, "without_value",
                         mo_atlas_bodies_of(comparison->a.atlas) - comparison->n);
  mo_text_member_number(text, "kendall_tau", comparison->tau);
  mo_text_add(text, "}");
}

static void compare(struct comparison *comparison, const char *a, const char *b)
{
  struct mo_request *request = comparison->request;
  struct mo_text text = {0};
  int error = count_bins(comparison);
  if (error == MO_OK && mo_request_is_over(request))
    error = MO_ERR_CANCELLED;
  if (error == MO_OK)
    error = correlate(comparison);
  if (error == MO_OK)
    write_comparison(&text, comparison, a, b);
  mo_reply_text(request, error, &text, "comparison");
  free(comparison->counts);
}

/* Reads `bins`. Returns NULL if it has replied. */
static struct comparison *begin(struct mo_request *request)
{
  int64_t bins = BINS_DEFAULT;
  if (!mo_query_number(request, "bins", 1, BINS_MAX, &bins))
    return NULL;
  struct comparison *comparison = calloc(1, sizeof(*comparison));
  if (comparison == NULL) {
    mo_reply_error(request, MO_ERR_NO_MEMORY, "comparison");
    return NULL;
  }
  comparison->request = request;
  comparison->bins = (uint32_t)bins;
  comparison->measure = -1;
  return comparison;
}

void mo_api_get_atlas_map(struct mo_request *request)
{
  struct comparison *comparison = begin(request);
  if (comparison == NULL)
    return;
  if (mo_query(request, "measure") == NULL) {
    mo_reply_bad_parameter(request, "measure", "give one of the atlas's measures");
  } else if (mo_atlas_begin(request, MO_ATLAS_NEED_INDEX, &comparison->a)) {
    if (mo_atlas_query_measure(request, &comparison->a, &comparison->measure)) {
      mo_atlas_make_room(&mo_api_of(request)->atlases,
                         2 * sizeof(float) * mo_atlas_bodies_of(comparison->a.atlas));
      compare(comparison, request->parameters[0], NULL);
    }
    mo_atlas_done(request, &comparison->a);
  }
  free(comparison);
}

void mo_api_get_atlas_comparison(struct mo_request *request)
{
  const char *other = mo_query(request, "with");
  struct comparison *comparison = begin(request);
  if (comparison == NULL)
    return;
  if (other == NULL) {
    mo_reply_bad_parameter(request, "with", "give the name of another atlas");
  } else if (mo_atlas_begin(request, MO_ATLAS_NEED_INDEX, &comparison->a)) {
    /* Memory for both scores as floats; parts of other atlases are freed for it if necessary. */
    mo_atlas_make_room(&mo_api_of(request)->atlases,
                       2 * sizeof(float) * mo_atlas_bodies_of(comparison->a.atlas));
    if (mo_atlas_begin_named(request, other, MO_ATLAS_NEED_FILE, &comparison->b)) {
      compare(comparison, request->parameters[0], other);
      mo_atlas_done(request, &comparison->b);
    }
    mo_atlas_done(request, &comparison->a);
  }
  free(comparison);
}
