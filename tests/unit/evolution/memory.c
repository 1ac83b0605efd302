/* memory.c: every allocation of this room fails once. Each time the function must report the error,
 * leave its outputs unchanged, and leak nothing (checked by the address sanitizer). */
#include "fixture.h"

#include "../failing.h"

#define N 12

static struct mo_campaign_settings settings;
static uint64_t genotypes[2 * N * W];
static struct mo_candidate candidates[2 * N];
static double scores[2 * N];
static struct mo_design_size sizes[2 * N];
static struct mo_descent descents[N];
static uint32_t born[N];

/* Also the allocations of a growing set. */
static int initial(void)
{
  struct mo_seen *seen = NULL;
  uint32_t n = 99;
  int r = mo_seen_create(settings.workspace, NULL, &seen);
  CHECK((seen != NULL) == (r == MO_OK));
  if (r == MO_OK) {
    r = mo_population_initial(&settings, seen, genotypes, 0, &n, NULL, NULL);
    CHECK(n == (r == MO_OK ? N : 99));
  }
  mo_seen_free(seen);
  return r;
}

static int the_best(void)
{
  struct mo_best *best = NULL;
  const int r = mo_best_create(N, 3, 2, &best);
  CHECK((best != NULL) == (r == MO_OK));
  mo_best_free(best);
  return r;
}

static struct mo_seen *seen_population(void)
{
  struct mo_seen *seen = NULL;
  const long before = left;
  left = -1;
  if (mo_seen_create(settings.workspace, NULL, &seen) == MO_OK)
    for (uint32_t i = 0; i < N; i++)
      mo_seen_add(seen, genotypes + (size_t)W * i);
  left = before;
  return seen;
}

static int vary(void)
{
  struct mo_seen *seen = seen_population();
  struct mo_birth births[N];
  struct mo_variation_counts counts = {.mutants = 99};
  uint32_t n = 99;
  if (seen == NULL)
    return MO_ERR_INVALID;
  const int r = mo_variation(&settings, 1, genotypes, N, seen, genotypes + (size_t)W * N, births,
                             &n, &counts, NULL);
  CHECK(n == (r == MO_OK ? N : 99) && (counts.mutants == 99) == (r != MO_OK));
  mo_seen_free(seen);
  return r;
}

static int select_some(void)
{
  uint32_t survivors[2 * N], n = 99;
  const int r = mo_select(&settings, 1, genotypes, candidates, 2 * N, survivors, &n);
  CHECK(n == (r == MO_OK ? N : 99));
  return r;
}

static int statistics(void)
{
  struct mo_population_stats stats = {.n = 99};
  const int r = mo_population_stats(settings.workspace, genotypes, scores, sizes, 2 * N, &stats);
  CHECK(stats.n == (r == MO_OK ? 2 * N : 99));
  return r;
}

static int champions(void)
{
  uint32_t picks[5] = {99};
  const int r = mo_champions(settings.workspace, genotypes, scores, 2 * N, 5, picks, NULL);
  CHECK((picks[0] == 99) == (r != MO_OK));
  return r;
}

static int newick(void)
{
  struct mo_newick *tree = NULL;
  const int r = mo_newick_create(descents, born, N, &tree);
  mo_newick_free(tree);
  return r;
}

static int forms_of(struct mo_workspace workspace)
{
  struct mo_form_set *set = NULL;
  int r = mo_form_set_create(workspace, &set);
  if (r == MO_OK)
    r = mo_pretraining_forms(1, 40, workspace, 1, NULL, NULL, set);
  mo_form_set_free(set);
  return r;
}

static int forms(void)
{
  return forms_of(MO_DEFAULT_WORKSPACE);
}

static int forms_elsewhere(void)
{
  return forms_of((struct mo_workspace){5, 5, 3});
}

/* Workspaces that do not fit on the stack. */
static const struct mo_workspace large = {20, 20, 20};
static struct mo_lattice *lattice;
static uint64_t large_body[125];

static int large_size(void)
{
  struct mo_design_size size = {.voxels = 99};
  const int r = mo_design_size(lattice, large_body, &size);
  CHECK((size.voxels == 99) == (r != MO_OK));
  return r;
}

static int large_seen(void)
{
  struct mo_seen *seen = NULL;
  int r = mo_seen_create(large, NULL, &seen);
  if (r == MO_OK)
    r = mo_seen_add(seen, large_body);
  if (r >= 0) {
    CHECK_INT(r, 1);
    r = mo_seen_add(seen, large_body);
  }
  mo_seen_free(seen);
  return r;
}

static void functions(void)
{
  settings = small_campaign(1, N);
  each_fails(initial, 2 + N);
  each_fails(the_best, 4);
  each_fails(vary, 5);
  for (uint32_t i = 0; i < 2 * N; i++) {
    scores[i] = i;
    candidates[i] = (struct mo_candidate){.score = i, .number = i};
    sizes[i] = (struct mo_design_size){1, 1, 8, 24};
    if (i < N)
      descents[i] =
          (struct mo_descent){{i > 0 ? i - 1 : MO_NO_PARENT, MO_NO_PARENT}, MO_BORN_MUTATION};
  }
  for (int kind = 0; mo_selection_words[kind] != NULL; kind++) {
    settings.selection.kind = (enum mo_selection_kind)kind;
    each_fails(select_some, kind == MO_SELECT_NOVELTY ? 5 : kind == MO_SELECT_TOURNAMENT ? 3 : 2);
  }
  each_fails(statistics, 3);
  each_fails(champions, 4);
  each_fails(newick, 3);
  each_fails(forms, 10);
  each_fails(forms_elsewhere, 12);
}

static void large_workspaces(void)
{
  struct mo_random random = dice(77, 1, 1);
  REQUIRE(mo_lattice_create(large, &lattice) == MO_OK &&
          mo_genotype_random(large, &random, large_body) == MO_OK);
  each_fails(large_size, 1);
  each_fails(large_seen, 4);
  mo_lattice_free(lattice);
}

static const struct check_case cases[] = {
    {"functions without memory", functions},
    {"in workspaces that do not fit on the stack", large_workspaces},
};
CHECK_MAIN(cases)
