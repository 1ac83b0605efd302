/* atlas_bodies.c: the rank of a body in an atlas, its neighbors, and similar bodies. */
#include <stdlib.h>
#include <string.h>

#include "api/atlas_json.h"
#include "exchange/values.h"

#define CHANGES_MAX     64
#define CHANGES_DEFAULT 8
#define PATH_MAX_BODIES 1000 /* bodies of an ascent that are listed */

static void write_neighbors(struct mo_text *text, const char *name, const struct mo_atlas_use *use,
                            const struct mo_atlas_neighbor *neighbors, uint32_t n)
{
  mo_text_open(text, name, "[");
  for (uint32_t i = 0; i < n; i++) {
    mo_text_object(text);
    mo_atlas_write_body(text, use, neighbors[i].position);
    mo_text_member(text, "step", mo_atlas_step_word(neighbors[i].step));
    mo_text_add(text, "}");
  }
  mo_text_add(text, "]");
}

/* ---- a body ---- */

static void write_losses(struct mo_text *text, const struct mo_atlas_use *use, uint64_t position)
{
  double losses[MO_ATLAS_ENVIRONMENTS_MAX];
  float read[MO_ATLAS_ENVIRONMENTS_MAX];
  uint32_t n = 0;
  const struct mo_environment *environments = mo_atlas_environments(use->atlas, &n);
  mo_atlas_losses(use->atlas, position, read);
  for (uint32_t e = 0; e < n; e++)
    losses[e] = (double)read[e];
  mo_members_losses(text, losses, n, environments, NULL);
}

static void write_of_size(struct mo_text *text, const struct mo_atlas_use *use, uint64_t position)
{
  const struct mo_atlas_rank rank = mo_atlas_rank_of(use->index, position, true);
  mo_text_open(text, "of_size", "{");
  mo_text_member_count(text, "rank", rank.better + 1);
  mo_text_member_count(text, "bodies", rank.better + rank.equal + 1 + rank.worse);
  mo_text_member_number(text, "percentile", rank.percentile);
  mo_atlas_member_measures(text, use, position, true);
  mo_text_add(text, "}");
}

static void write_basin(struct mo_text *text, const struct mo_atlas_use *use, uint64_t position)
{
  if (use->basins == NULL) {
    mo_text_add(text, ",\"basin\":null,\"optimum\":null");
    return;
  }
  mo_text_member_count(text, "basin", mo_atlas_basin_of(use->basins, position));
  mo_atlas_member_body(text, "optimum", use, mo_atlas_optimum_of(use->basins, position));
}

void mo_api_get_atlas_body(struct mo_request *request)
{
  struct mo_atlas_neighbor neighbors[MO_ATLAS_NEIGHBORS_MAX];
  struct mo_atlas_use use;
  struct mo_text text = {0};
  uint64_t position = 0, form[MO_DEFAULT_WORDS];
  int64_t changes = CHANGES_DEFAULT;
  unsigned steps;
  if (!mo_query_number(request, "changes", 0, CHANGES_MAX, &changes) ||
      !mo_atlas_query_steps(request, &steps) || !mo_atlas_begin(request, MO_ATLAS_NEED_INDEX, &use))
    return;
  if (mo_atlas_query_body(request, &use, &position)) {
    const uint32_t n = mo_atlas_neighbors(use.atlas, position, steps, neighbors);
    const uint32_t n_voxels = mo_atlas_form(use.atlas, position, form);
    mo_text_object(&text);
    mo_atlas_write_body(&text, &use, position);
    write_of_size(&text, &use, position);
    write_losses(&text, &use, position);
    mo_atlas_member_body(&text, "best_of_size", &use, mo_atlas_nth(use.index, n_voxels, 0));
    write_neighbors(&text, "best_changes", &use, neighbors,
                    n < (uint32_t)changes ? n : (uint32_t)changes);
    mo_text_member_bool(&text, "is_optimum",
                        n == 0 || neighbors[0].score >= mo_atlas_score(use.atlas, position));
    write_basin(&text, &use, position);
    mo_text_add(&text, "}");
    mo_reply_text(request, MO_OK, &text, "body");
  }
  mo_atlas_done(request, &use);
}

/* ---- its surroundings ---- */

void mo_api_get_atlas_neighbors(struct mo_request *request)
{
  struct mo_atlas_neighbor neighbors[MO_ATLAS_NEIGHBORS_MAX];
  struct mo_atlas_use use;
  struct mo_text text = {0};
  uint64_t position = 0;
  unsigned steps;
  if (!mo_atlas_query_steps(request, &steps) || !mo_atlas_begin(request, MO_ATLAS_NEED_INDEX, &use))
    return;
  if (mo_atlas_query_body(request, &use, &position)) {
    const uint32_t n = mo_atlas_neighbors(use.atlas, position, steps, neighbors);
    mo_text_object(&text);
    write_neighbors(&text, "items", &use, neighbors, n);
    mo_text_add(&text, "}");
    mo_reply_text(request, MO_OK, &text, "neighbors");
  }
  mo_atlas_done(request, &use);
}

void mo_api_get_atlas_ascent(struct mo_request *request)
{
  struct mo_atlas_use use;
  struct mo_text text = {0};
  uint64_t position = 0, optimum = 0, path[PATH_MAX_BODIES];
  unsigned steps;
  if (!mo_atlas_query_steps(request, &steps) || !mo_atlas_begin(request, MO_ATLAS_NEED_INDEX, &use))
    return;
  if (mo_atlas_query_body(request, &use, &position)) {
    const uint64_t n = mo_atlas_ascend(use.atlas, position, steps, path, PATH_MAX_BODIES, &optimum);
    mo_text_add(&text, "{\"items\":[");
    for (uint64_t i = 0; i < n && i < PATH_MAX_BODIES; i++)
      mo_atlas_item_body(&text, &use, path[i]);
    mo_text_add(&text, "]");
    mo_text_member_count(&text, "bodies_on_path", n);
    mo_atlas_member_body(&text, "optimum", &use, optimum);
    mo_text_add(&text, "}");
    mo_reply_text(request, MO_OK, &text, "ascent");
  }
  mo_atlas_done(request, &use);
}

/* ---- similar bodies: at most two steps of adding or removing away ---- */

struct near {
  uint64_t position;
  float score;
  uint32_t distance;
};

static int compare_places(const void *a, const void *b)
{
  const struct near *p = a, *q = b;
  if (p->position != q->position)
    return p->position < q->position ? -1 : 1;
  return p->distance < q->distance ? -1 : p->distance > q->distance;
}

static int compare_scores(const void *a, const void *b)
{
  const struct near *p = a, *q = b;
  if (p->score != q->score)
    return p->score < q->score ? -1 : 1;
  return p->position < q->position ? -1 : 1;
}

/* Keeps the nearest entry of each body, drops the body itself, and sorts the rest by score. */
static uint32_t sort_out(struct near *near, uint32_t n, uint64_t position)
{
  uint32_t kept = 0;
  qsort(near, n, sizeof(*near), compare_places);
  for (uint32_t i = 0; i < n; i++)
    if (near[i].position != position && (kept == 0 || near[kept - 1].position != near[i].position))
      near[kept++] = near[i];
  qsort(near, kept, sizeof(*near), compare_scores);
  return kept;
}

/* Finds the similar bodies, best first: (n), malloc. MO_ERR_NO_MEMORY. */
static int find_similar(const struct mo_atlas *atlas, uint64_t position, struct near **ret,
                        uint32_t *ret_n)
{
  struct mo_atlas_neighbor first[MO_ATLAS_NEIGHBORS_MAX], second[MO_ATLAS_NEIGHBORS_MAX];
  const uint32_t n_first = mo_atlas_neighbors(atlas, position, MO_ATLAS_GROW_SHRINK, first);
  struct near *near = NULL;
  uint32_t n = 0;
  for (uint32_t i = 0; i < n_first; i++) {
    const uint32_t n_second =
        mo_atlas_neighbors(atlas, first[i].position, MO_ATLAS_GROW_SHRINK, second);
    struct near *grown = realloc(near, (n + 1 + (size_t)n_second) * sizeof(*near));
    if (grown == NULL) {
      free(near);
      return MO_ERR_NO_MEMORY;
    }
    near = grown;
    near[n++] = (struct near){first[i].position, first[i].score, 1};
    for (uint32_t k = 0; k < n_second; k++)
      near[n++] = (struct near){second[k].position, second[k].score, 2};
  }
  *ret_n = n > 0 ? sort_out(near, n, position) : 0;
  *ret = near;
  return MO_OK;
}

void mo_api_get_atlas_similar(struct mo_request *request)
{
  struct mo_atlas_use use;
  struct mo_text text = {0};
  struct near *near = NULL;
  uint64_t position = 0;
  uint32_t n = 0;
  size_t limit;
  if (!mo_query_limit(request, &limit) || !mo_atlas_begin(request, MO_ATLAS_NEED_INDEX, &use))
    return;
  if (mo_atlas_query_body(request, &use, &position)) {
    const int error = find_similar(use.atlas, position, &near, &n);
    mo_text_add(&text, "{\"items\":[");
    for (uint32_t i = 0; i < n && i < limit; i++) {
      mo_text_object(&text);
      mo_atlas_write_body(&text, &use, near[i].position);
      mo_text_member_count(&text, "distance", near[i].distance);
      mo_text_add(&text, "}");
    }
    mo_text_add(&text, "]}");
    mo_reply_text(request, error, &text, "body");
    free(near);
  }
  mo_atlas_done(request, &use);
}
