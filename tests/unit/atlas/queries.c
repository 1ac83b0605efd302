/* queries.c: queries of the atlas against a plain program, with invented losses of few levels, so
 * that many bodies have equal scores. */
#include "fixture.h"
#include "plain.h"

#define LEVELS 3

static const struct mo_atlas_scope scopes[] = {
    {{6, 6, 4}, 6}, {{3, 2, 2}, 7}, {{2, 4, 1}, 8}, {{6, 6, 4}, 1}};

/* The plain program's atlas: bodies in order, and their scores. */
static struct plain_body *bodies;
static float *scores;
static size_t n;
static struct mo_atlas_scope scope;
static const struct mo_atlas *atlas;
static struct mo_atlas_index *ranking;

static void drop_index(void *index)
{
  mo_atlas_index_free(index);
}

static void make(int c)
{
  struct mo_atlas_source source = fixture_source(1);
  scope = source.scope = scopes[c];
  atlas = fixture_atlas(&source, LEVELS);
  bodies = make_zeros(PLAIN_BODIES, sizeof(*bodies));
  n = plain_bodies(&scope, bodies);
  scores = make_zeros(n, sizeof(*scores));
  for (size_t i = 0; i < n; i++) {
    uint64_t form[MO_DEFAULT_WORDS];
    double sum = 0;
    plain_bits(scope.workspace, &bodies[i], form);
    for (uint32_t e = 0; e < MO_PAPER_TEST_COUNT; e++)
      sum += fixture_loss(form, e, LEVELS);
    scores[i] = (float)(sum / MO_PAPER_TEST_COUNT);
  }
  make_check(mo_atlas_index_create(atlas, &ranking), "index");
  check_keep(ranking, drop_index);
}

/* ---- the plain program ---- */

static int by_score(const void *a, const void *b)
{
  const uint64_t p = *(const uint64_t *)a, q = *(const uint64_t *)b;
  if (scores[p] != scores[q])
    return scores[p] < scores[q] ? -1 : 1;
  return p < q ? -1 : p > q;
}

static bool is_whole(const struct plain_body *body)
{
  bool reached[PLAIN_CELLS + 1] = {true}, goes_on = body->n > 0;
  int n_reached = 1;
  while (goes_on) {
    goes_on = false;
    for (int i = 0; i < body->n; i++)
      for (int k = 0; k < body->n; k++) {
        int distance = 0;
        for (int axis = 0; axis < 3; axis++)
          distance += abs(body->cells[i][axis] - body->cells[k][axis]);
        if (reached[i] && !reached[k] && distance == 1) {
          reached[k] = goes_on = true;
          n_reached++;
        }
      }
  }
  return n_reached == body->n;
}

/* Adds the position of a changed body to a list, if it is another body of the scope. */
static void list_body(const struct plain_body *changed, uint64_t own, uint64_t *list,
                      size_t *length)
{
  struct plain_body form = {0};
  if (changed->n > (int)scope.voxels_max || !plain_canonical(scope.workspace, changed, &form))
    return;
  const struct plain_body *found = bsearch(&form, bodies, n, sizeof(form), plain_order);
  if (found == NULL || (uint64_t)(found - bodies) == own)
    return;
  for (size_t i = 0; i < *length; i++)
    if (list[i] == (uint64_t)(found - bodies))
      return;
  list[(*length)++] = (uint64_t)(found - bodies);
}

static void list_larger(const struct plain_body *body, const int *never, uint64_t own,
                        uint64_t *list, size_t *length)
{
  for (int c = 0; c < body->n && body->n < PLAIN_CELLS; c++)
    for (int step = 0; step < 6; step++) {
      struct plain_body larger = *body;
      int *cell = larger.cells[larger.n];
      memcpy(cell, body->cells[c], sizeof(larger.cells[0]));
      cell[step / 2] += step % 2 ? 1 : -1;
      if (plain_has(body, cell) || (never != NULL && plain_compare_cells(cell, never) == 0))
        continue;
      larger.n++;
      list_body(&larger, own, list, length);
    }
}

/* Lists the neighbors of a body, sorted. */
static size_t plain_neighbors(uint64_t own, unsigned steps, uint64_t *list)
{
  const struct plain_body *body = &bodies[own];
  size_t length = 0;
  if (steps & MO_ATLAS_ADD)
    list_larger(body, NULL, own, list, &length);
  for (int gone = 0; gone < body->n && body->n > 1; gone++) {
    struct plain_body rest = *body;
    memcpy(rest.cells[gone], rest.cells[--rest.n], sizeof(rest.cells[0]));
    if (!is_whole(&rest))
      continue;
    if (steps & MO_ATLAS_REMOVE)
      list_body(&rest, own, list, &length);
    if (steps & MO_ATLAS_MOVE)
      list_larger(&rest, body->cells[gone], own, list, &length);
  }
  qsort(list, length, sizeof(*list), by_score);
  return length;
}

/* ---- comparisons ---- */

static void neighbors(int c)
{
  size_t different = 0, optima = 0, most = 0;
  make(c);
  CHECK_INT(mo_atlas_bodies_of(atlas), n);
  for (uint64_t i = 0; i < n; i++)
    for (unsigned steps = 0; steps < 8; steps++) {
      struct mo_atlas_neighbor found[MO_ATLAS_NEIGHBORS_MAX], best;
      uint64_t expected[MO_ATLAS_NEIGHBORS_MAX];
      const size_t length = plain_neighbors(i, steps, expected);
      CHECK_INT(mo_atlas_neighbors(atlas, i, steps, found), length);
      for (size_t k = 0; k < length; k++) {
        const int more = bodies[expected[k]].n - bodies[i].n;
        different += found[k].position != expected[k] || found[k].score != scores[expected[k]] ||
                     found[k].step != (more > 0   ? MO_ATLAS_ADD
                                       : more < 0 ? MO_ATLAS_REMOVE
                                                  : MO_ATLAS_MOVE);
      }
      const bool has_better = length > 0 && scores[expected[0]] < scores[i];
      CHECK_INT(mo_atlas_best_step(atlas, i, steps, &best), has_better ? MO_OK : MO_ERR_NOT_FOUND);
      different += has_better && best.position != expected[0];
      optima += !has_better;
      most = length > most ? length : most;
    }
  CHECK_INT(different, 0);
  CHECK(optima > 0);
  CHECK(most > 3 || scope.voxels_max == 1);
}

static void ascents(int c)
{
  make(c);
  struct mo_atlas_basins *basins = NULL;
  uint64_t *sizes = make_zeros(n, sizeof(*sizes)), optima = 0, longest = 0;
  REQUIRE_OK(mo_atlas_basins_create(atlas, ranking, NULL, &basins));
  for (unsigned steps = MO_ATLAS_GROW_SHRINK; steps < 8; steps += MO_ATLAS_MOVE)
    for (uint64_t i = 0; i < n; i++) {
      uint64_t list[MO_ATLAS_NEIGHBORS_MAX], path[4] = {0}, optimum = 0, at = i, length = 1;
      const uint64_t found = mo_atlas_ascend(atlas, i, steps, path, COUNT(path), &optimum);
      CHECK_INT(path[0], i);
      while (plain_neighbors(at, steps, list) > 0 && scores[list[0]] < scores[at]) {
        at = list[0];
        CHECK(length >= COUNT(path) || path[length] == at);
        length++;
      }
      CHECK_INT(found, length);
      CHECK_INT(optimum, at);
      longest = length > longest ? length : longest;
      if (steps == MO_ATLAS_GROW_SHRINK) {
        CHECK_INT(mo_atlas_optimum_of(basins, i), at);
        sizes[at]++;
      }
    }
  for (uint64_t i = 0; i < n; i++) {
    CHECK_INT(mo_atlas_basin_of(basins, i), sizes[i]);
    optima += sizes[i] > 0;
  }
  CHECK_INT(mo_atlas_optima(basins), optima);
  CHECK(longest > 2 || scope.voxels_max == 1);
  mo_atlas_basins_free(basins);
  basins = NULL;
  CHECK_INT(mo_atlas_basins_create(atlas, ranking, &(int){1}, &basins), MO_ERR_CANCELLED);
  CHECK(basins == NULL);
}

static bool is_of(uint64_t i, uint32_t n_voxels)
{
  return n_voxels == 0 || bodies[i].n == (int)n_voxels;
}

static void ranks(int c)
{
  size_t ties = 0;
  make(c);
  for (uint64_t i = 0; i < n; i++)
    for (int within_size = 0; within_size < 2; within_size++) {
      const struct mo_atlas_rank rank = mo_atlas_rank_of(ranking, i, within_size);
      uint64_t better = 0, equal = 0, worse = 0;
      for (uint64_t k = 0; k < n; k++)
        if (k != i && (!within_size || bodies[k].n == bodies[i].n)) {
          better += scores[k] < scores[i];
          equal += scores[k] == scores[i];
          worse += scores[k] > scores[i];
        }
      CHECK(rank.better == better && rank.equal == equal && rank.worse == worse);
      const double others = (double)(better + equal + worse);
      CHECK_NEAR(rank.percentile,
                 others > 0 ? 100 * ((double)worse + 0.5 * (double)equal) / others : 100, 1e-9);
      ties += equal > 0;
    }
  CHECK(ties > n / 2 || n == 1);
}

static void best(int c)
{
  make(c);
  uint64_t *list = make_zeros(n, sizeof(*list)), *found = make_zeros(n + 1, sizeof(*found));
  for (uint32_t n_voxels = 0; n_voxels <= scope.voxels_max; n_voxels++) {
    size_t length = 0;
    for (uint64_t i = 0; i < n; i++)
      if (is_of(i, n_voxels))
        list[length++] = i;
    qsort(list, length, sizeof(*list), by_score);
    CHECK_INT(mo_atlas_best(ranking, n_voxels, n + 1, found), length);
    CHECK(SAME(found, list, length));
    found[1] = 77;
    CHECK_INT(mo_atlas_best(ranking, n_voxels, 1, found), length > 0);
    CHECK(found[1] == 77);
    for (size_t i = 0; i < length; i++)
      CHECK_INT(mo_atlas_nth(ranking, n_voxels, i), list[i]);
  }
  CHECK_INT(mo_atlas_best(ranking, scope.voxels_max + 1, 5, found), 0);
}

static void histograms(int c)
{
  static const float edges[] = {-1.0F, 0.0F, 0.1F, 0.3F, 0.3F, 0.35F, 0.4F, 0.65F, INFINITY};
  make(c);
  for (uint32_t n_voxels = 0; n_voxels <= scope.voxels_max; n_voxels++) {
    uint64_t counts[COUNT(edges) - 1];
    mo_atlas_histogram(ranking, n_voxels, edges, COUNT(counts), counts);
    for (size_t e = 0; e < COUNT(counts); e++) {
      uint64_t expected = 0;
      for (uint64_t i = 0; i < n; i++)
        expected += is_of(i, n_voxels) && scores[i] >= edges[e] && scores[i] < edges[e + 1];
      CHECK_INT(counts[e], expected);
    }
  }
}

static void footprints(int c)
{
  struct mo_atlas_footprint found[MO_ATLAS_VOXELS_MAX + 1], expected[MO_ATLAS_VOXELS_MAX + 1] = {0};
  make(c);
  mo_atlas_footprints(atlas, found);
  for (uint64_t i = 0; i < n; i++) {
    bool columns[6][6] = {{false}};
    int footprint = 0;
    for (int k = 0; k < bodies[i].n; k++) {
      bool *column = &columns[bodies[i].cells[k][0]][bodies[i].cells[k][1]];
      footprint += !*column;
      *column = true;
    }
    if (expected[footprint].bodies++ == 0 || scores[i] < scores[expected[footprint].optimum])
      expected[footprint].optimum = i;
  }
  for (size_t f = 0; f < COUNT(found); f++) {
    CHECK_INT(found[f].bodies, expected[f].bodies);
    CHECK_INT(found[f].optimum, expected[f].optimum);
  }
}

/* +infinity comes last, and −0 equals 0. */
static void special_scores(void)
{
  const struct mo_atlas_source source = fixture_source(3);
  static const double losses[] = {INFINITY, 0.0, -0.0, -2.0, 1e-40, 3.0, INFINITY, 1.0};
  static const uint64_t order[] = {3, 1, 2, 4, 7, 5, 0, 6};
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_atlas_writer *writer = NULL;
  struct mo_atlas_bodies *stream = NULL;
  char path[FIXTURE_PATH];
  uint64_t form[MO_DEFAULT_WORDS];
  snprintf(path, sizeof(path), "%s/a", fixture_folder());
  mo_environment_paper_test(environments);
  REQUIRE_OK(mo_atlas_writer_create(path, &source, environments, 1, &writer, NULL));
  REQUIRE_OK(mo_atlas_bodies_create(&source.scope, &stream));
  for (size_t i = 0; i < COUNT(losses); i++) {
    REQUIRE_OK(mo_atlas_bodies_next(stream, form));
    CHECK_OK(mo_atlas_writer_add(writer, form, &losses[i], NULL));
  }
  CHECK_OK(mo_atlas_writer_finish(writer, NULL));
  mo_atlas_writer_free(writer);
  mo_atlas_bodies_free(stream);
  atlas = fixture_open(path);
  make_check(mo_atlas_index_create(atlas, &ranking), "index");
  check_keep(ranking, drop_index);
  for (size_t i = 0; i < COUNT(order); i++)
    CHECK_INT(mo_atlas_nth(ranking, 0, i), order[i]);
  const struct mo_atlas_rank zero = mo_atlas_rank_of(ranking, 2, false);
  CHECK(zero.better == 1 && zero.equal == 1 && zero.worse == 5);
  const struct mo_atlas_rank diverged = mo_atlas_rank_of(ranking, 0, false);
  CHECK(diverged.better == 6 && diverged.equal == 1 && diverged.worse == 0);
}

#define EACH(name, run)                                                                            \
  {name ", 6 x 6 x 4", WITH(run, 0)}, {name ", 3 x 2 x 2", WITH(run, 1)},                          \
      {name ", 2 x 4 x 1", WITH(run, 2)},                                                          \
  {                                                                                                \
    name ", one body", WITH(run, 3)                                                                \
  }
static const struct check_case cases[] = {
    EACH("neighbors and best changes", neighbors),
    EACH("ascents, optima and basins", ascents),
    EACH("ranks", ranks),
    EACH("the best", best),
    EACH("histograms", histograms),
    EACH("footprints", footprints),
    {"infinite, negative and zero scores", special_scores},
};
CHECK_MAIN(cases)
