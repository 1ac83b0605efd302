/* bodies.c: the stream of all bodies of a scope, against a plain program and the known numbers. */
#include "plain.h"

static const struct mo_atlas_scope scopes[] = {
    {{6, 6, 4}, 6},  {{2, 3, 2}, 10}, {{4, 2, 3}, 6},
    {{1, 5, 1}, 10}, {{5, 1, 2}, 7},  {{1, 1, 1}, 3},
};
static const uint64_t known[MO_ATLAS_VOXELS_MAX] = {1,   2,    5,     21,     95,
                                                    530, 3168, 20313, 133961, 899126};

static void drop_bodies(void *bodies)
{
  mo_atlas_bodies_free(bodies);
}

static struct mo_atlas_bodies *make_bodies(struct mo_atlas_scope scope)
{
  struct mo_atlas_bodies *made = NULL;
  make_check(mo_atlas_bodies_create(&scope, &made), "stream of bodies");
  return check_keep(made, drop_bodies);
}

static void like_plain(int c)
{
  const struct mo_atlas_scope scope = scopes[c];
  struct mo_atlas_bodies *bodies = make_bodies(scope);
  struct plain_body *plain = make_zeros(PLAIN_BODIES, sizeof(*plain));
  const size_t n = plain_bodies(&scope, plain), words = mo_workspace_words(scope.workspace);
  uint64_t form[MO_DEFAULT_WORDS], expected[MO_DEFAULT_WORDS];
  uint64_t counts[MO_ATLAS_VOXELS_MAX], sum = 0;
  size_t different = 0;
  for (size_t i = 0; i < n; i++) {
    REQUIRE_OK(mo_atlas_bodies_next(bodies, form));
    plain_bits(scope.workspace, &plain[i], expected);
    different += !SAME(form, expected, words);
  }
  CHECK_INT(different, 0);
  CHECK_INT(mo_atlas_bodies_next(bodies, form), MO_ERR_EXHAUSTED);
  CHECK_INT(mo_atlas_bodies_next(bodies, form), MO_ERR_EXHAUSTED);
  CHECK_OK(mo_atlas_bodies_count(bodies, counts));
  for (int i = 0; i < MO_ATLAS_VOXELS_MAX; i++)
    sum += counts[i];
  CHECK_INT(sum, n);
}

/* All ten sizes take about a second; with sanitizers, eight are seen. */
static void numbers(void)
{
  const struct mo_atlas_scope scope = {MO_DEFAULT_WORKSPACE, CHECK_SANITIZED ? 8 : 10};
  struct mo_atlas_bodies *bodies = make_bodies(scope);
  uint64_t counts[MO_ATLAS_VOXELS_MAX], form[MO_DEFAULT_WORDS], canonical[MO_DEFAULT_WORDS];
  char before[MO_DEFAULT_ID_DIGITS + 1] = "", id[MO_DEFAULT_ID_DIGITS + 1];
  size_t unsorted = 0, not_canonical = 0;
  REQUIRE_OK(mo_atlas_bodies_count(bodies, counts));
  for (uint32_t n = 1; n <= MO_ATLAS_VOXELS_MAX; n++) {
    CHECK_INT(counts[n - 1], n <= scope.voxels_max ? known[n - 1] : 0);
    before[0] = '\0';
    for (uint64_t i = 0; i < counts[n - 1]; i++) {
      REQUIRE_OK(mo_atlas_bodies_next(bodies, form));
      mo_genotype_canonical(scope.workspace, form, canonical);
      not_canonical += !SAME(form, canonical, MO_DEFAULT_WORDS) ||
                       mo_genotype_count(scope.workspace, form) != n ||
                       mo_genotype_is_contiguous(scope.workspace, form) != 1;
      REQUIRE_OK(mo_genotype_id(scope.workspace, form, id));
      unsorted += i > 0 && strcmp(before, id) <= 0;
      memcpy(before, id, sizeof(id));
    }
  }
  CHECK_INT(not_canonical, 0);
  CHECK_INT(unsorted, 0);
}

/* Draws bodies in several workspaces, because those drawn in the default one are large. */
static void random_bodies(void)
{
  static const struct mo_workspace from[] = {{6, 6, 4}, {3, 3, 2}, {4, 3, 1}, {2, 6, 2}, {1, 5, 4}};
  const struct mo_atlas_scope scope = {MO_DEFAULT_WORKSPACE, CHECK_SANITIZED ? 7 : 10};
  struct mo_atlas_bodies *bodies = make_bodies(scope);
  struct mo_form_set *all = make_form_set(scope.workspace);
  uint64_t form[MO_DEFAULT_WORDS];
  uint32_t seen[MO_ATLAS_VOXELS_MAX + 1] = {0}, missing = 0;
  int error;
  while ((error = mo_atlas_bodies_next(bodies, form)) == MO_OK)
    CHECK_INT(mo_form_set_add(all, form), 1);
  REQUIRE(error == MO_ERR_EXHAUSTED);
  for (uint64_t i = 0; i < 40000; i++) {
    const struct mo_workspace workspace = from[i % COUNT(from)];
    struct mo_random random;
    uint64_t drawn[MO_DEFAULT_WORDS] = {0}, moved[MO_DEFAULT_WORDS];
    mo_random_init(&random, 5, MO_PURPOSE_BODY, 0, i);
    REQUIRE_OK(mo_genotype_random(workspace, &random, drawn));
    const uint32_t n = mo_genotype_count(workspace, drawn);
    if (n > scope.voxels_max)
      continue;
    REQUIRE_OK(mo_genotype_move(workspace, drawn, scope.workspace, moved));
    mo_genotype_canonical(scope.workspace, moved, form);
    missing += !mo_form_set_has(all, form);
    seen[n]++;
  }
  CHECK_INT(missing, 0);
  for (uint32_t n = 1; n <= scope.voxels_max; n++)
    CHECK(seen[n] >= 20);
}

static void positions(void)
{
  const struct mo_atlas_scope scope = {MO_DEFAULT_WORKSPACE, 5};
  struct mo_atlas_bodies *bodies = make_bodies(scope);
  struct mo_bits list[124];
  uint64_t form[MO_DEFAULT_WORDS];
  for (size_t i = 0; i < COUNT(list); i++)
    REQUIRE_OK(mo_atlas_bodies_next(bodies, list[i].words));
  for (size_t step = 0; step < COUNT(list); step++) { /* 41 and 124 have no common divisor */
    const size_t i = step * 41 % COUNT(list);
    REQUIRE_OK(mo_atlas_bodies_seek(bodies, i));
    for (size_t k = i; k < i + 3; k++) {
      CHECK_INT(mo_atlas_bodies_next(bodies, form), k < COUNT(list) ? MO_OK : MO_ERR_EXHAUSTED);
      CHECK(k >= COUNT(list) || SAME(form, list[k].words, MO_DEFAULT_WORDS));
    }
  }
  struct mo_atlas_bodies *fresh = make_bodies(scope); /* has counted nothing */
  REQUIRE_OK(mo_atlas_bodies_seek(fresh, 100));
  CHECK_INT(mo_atlas_bodies_seek(fresh, COUNT(list) + 1), MO_ERR_RANGE);
  REQUIRE_OK(mo_atlas_bodies_next(fresh, form)); /* it is where it was */
  CHECK(SAME(form, list[100].words, MO_DEFAULT_WORDS));
  REQUIRE_OK(mo_atlas_bodies_seek(fresh, COUNT(list)));
  CHECK_INT(mo_atlas_bodies_next(fresh, form), MO_ERR_EXHAUSTED);
}

static void refused(void)
{
  static const struct {
    struct mo_atlas_scope scope;
    int error;
    const char *words;
  } wrong[] = {
      {{{6, 6, 0}, 3}, MO_ERR_RANGE, "at least 1"},
      {{{9, 9, 9}, 3}, MO_ERR_LIMIT, "at most 192 voxels"},
      {{{6, 6, 4}, 0}, MO_ERR_RANGE, "got 0"},
      {{{6, 6, 4}, 11}, MO_ERR_RANGE, "at most 10, got 11"},
  };
  for (size_t i = 0; i < COUNT(wrong); i++) {
    struct mo_atlas_bodies *bodies = NULL;
    struct mo_message message = {""};
    CHECK_INT(mo_atlas_scope_check(&wrong[i].scope, &message), wrong[i].error);
    CHECK_SAYS(message, wrong[i].words);
    CHECK_INT(mo_atlas_bodies_create(&wrong[i].scope, &bodies), wrong[i].error);
    CHECK(bodies == NULL);
  }
}

static const struct check_case cases[] = {
    {"6 x 6 x 4, 6 voxels, like a plain program", WITH(like_plain, 0)},
    {"2 x 3 x 2, all, like a plain program", WITH(like_plain, 1)},
    {"4 x 2 x 3, like a plain program", WITH(like_plain, 2)},
    {"1 x 5 x 1, like a plain program", WITH(like_plain, 3)},
    {"5 x 1 x 2, like a plain program", WITH(like_plain, 4)},
    {"one voxel, like a plain program", WITH(like_plain, 5)},
    {"known numbers; sorted, canonical, contiguous", numbers},
    {"every random body is among them", random_bodies},
    {"continues at any position", positions},
    {"scopes that are refused", refused},
};
CHECK_MAIN(cases)
