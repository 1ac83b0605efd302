/* campaign_history.c: every design that a campaign bore, against a model that is kept beside it. */
#include "../check.h"
#include "campaign_fixture.h"
#include "one_store.h"

#define UNTIL 40 /* generations after the first */
#define BORN  ((UNTIL + 1) * MADE_POPULATION)

struct model {
  struct mo_campaign_design designs[BORN];
  uint32_t population[UNTIL + 1][MADE_POPULATION];
  double scores[UNTIL + 1][MADE_POPULATION];
};

/* What a commit makes of the model. */
static void remember(struct model *model, const struct made *made)
{
  const struct mo_campaign_commit *commit = &made->commit;
  uint32_t g = commit->row.generation, first = (uint32_t)commit->row.born_before,
           n_parents = commit->n_parents;
  for (uint32_t i = 0; i < commit->row.n_children; i++) {
    struct mo_campaign_design *design = &model->designs[first + i];
    *design = (struct mo_campaign_design){.number = first + i,
                                          .form = commit->forms[i],
                                          .genotype = commit->genotypes[i],
                                          .descent = {.op = (uint8_t)commit->births[i].op},
                                          .born = g,
                                          .died = g,
                                          .score = commit->child_scores[i],
                                          .size = commit->sizes[i]};
    for (int p = 0; p < 2; p++)
      design->descent.parents[p] = commit->births[i].parents[p] == MO_NO_PARENT
                                       ? MO_NO_PARENT
                                       : commit->parent_numbers[commit->births[i].parents[p]];
  }
  for (uint32_t i = 0; i < n_parents; i++) {
    model->designs[commit->parent_numbers[i]].died = g;
    model->designs[commit->parent_numbers[i]].score = commit->parent_scores[i];
  }
  for (uint32_t i = 0; i < commit->n_survivors; i++) {
    uint32_t place = commit->survivors[i];
    uint32_t number = place < n_parents ? commit->parent_numbers[place] : first + place - n_parents;
    model->population[g][i] = number;
    model->scores[g][i] = made_score_of(made, place);
    model->designs[number].died = -1;
  }
}

static bool same_design(const struct mo_campaign_design *a, const struct mo_campaign_design *b)
{
  return a->number == b->number && memcmp(&a->form, &b->form, sizeof(a->form)) == 0 &&
         memcmp(&a->genotype, &b->genotype, sizeof(a->genotype)) == 0 &&
         a->descent.parents[0] == b->descent.parents[0] &&
         a->descent.parents[1] == b->descent.parents[1] && a->descent.op == b->descent.op &&
         a->born == b->born && a->died == b->died &&
         memcmp(&a->score, &b->score, sizeof(a->score)) == 0 &&
         memcmp(&a->size, &b->size, sizeof(a->size)) == 0;
}

static void check_designs(int64_t id, const struct model *model)
{
  static const uint32_t some[] = {7, 3, BORN - 1, 0, 3};
  struct mo_campaign_design page[50];
  uint32_t n_read = 0;
  int64_t n;
  while ((n = mo_store_campaign_designs(store, id, (int64_t)n_read - 1, page, 7)) > 0)
    for (int64_t i = 0; i < n; i++, n_read++)
      CHECK(same_design(&page[i], &model->designs[n_read]));
  CHECK(n == 0 && n_read == BORN);
  CHECK_OK(mo_store_campaign_designs_of(store, id, some, 5, page));
  for (int i = 0; i < 5; i++)
    CHECK(same_design(&page[i], &model->designs[some[i]]));
  CHECK_INT(mo_store_campaign_designs_of(store, id, (const uint32_t[]){1, BORN}, 2, page),
            MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_campaign_designs_of(store, 99, some, 1, page), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_campaign_designs(store, 99, -1, page, 7), 0);
  CHECK_INT(mo_store_campaign_designs(store, id, -1, page, MO_PAGE_MAX + 1), MO_ERR_LIMIT);
}

static void check_populations(int64_t id, const struct model *model)
{
  struct mo_campaign_design page[MADE_POPULATION], expected;
  uint32_t n = 0;
  for (int64_t g = -1; g <= UNTIL; g++) {
    int64_t at = g < 0 ? UNTIL : g;
    CHECK_INT(mo_store_campaign_population(store, id, g, 0, page, MADE_POPULATION, &n),
              MADE_POPULATION);
    CHECK_INT(n, MADE_POPULATION);
    for (uint32_t i = 0; i < MADE_POPULATION; i++) {
      expected = model->designs[model->population[at][i]];
      expected.score = model->scores[at][i]; /* as it was then */
      CHECK(same_design(&page[i], &expected));
    }
  }
  CHECK_INT(mo_store_campaign_population(store, id, 3, 2, page, 2, &n), 2);
  CHECK(n == MADE_POPULATION && page[0].number == model->population[3][2] &&
        page[1].number == model->population[3][3]);
  CHECK_INT(mo_store_campaign_population(store, id, 3, MADE_POPULATION, page, 2, &n), 0);
  CHECK_INT(mo_store_campaign_population(store, id, UNTIL + 1, 0, page, 2, &n), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_campaign_population(store, 99, -1, 0, page, 2, &n), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_campaign_population(store, id, 3, 0, page, MO_PAGE_MAX + 1, &n), MO_ERR_LIMIT);
}

static void check_descents(int64_t id, const struct model *model)
{
  struct mo_descent *descents = NULL;
  uint32_t *born = NULL, n = 0;
  REQUIRE_OK(mo_store_campaign_descents(store, id, &descents, &born, &n));
  CHECK_INT(n, BORN);
  for (uint32_t i = 0; i < n; i++)
    CHECK(descents[i].parents[0] == model->designs[i].descent.parents[0] &&
          descents[i].parents[1] == model->designs[i].descent.parents[1] &&
          descents[i].op == model->designs[i].descent.op && born[i] == model->designs[i].born);
  free(descents);
  free(born);
  REQUIRE_OK(mo_store_campaign_descents(store, id, &descents, NULL, &n));
  CHECK_INT(n, BORN);
  free(descents);
  CHECK_INT(mo_store_campaign_descents(store, 99, &descents, &born, &n), MO_ERR_NOT_FOUND);
}

struct taken {
  const struct model *model;
  uint32_t n, until;
  bool same;
};

static int take(void *context, const struct mo_bits *genotype)
{
  struct taken *taken = context;
  if (taken->n == taken->until)
    return 42;
  taken->same = taken->same && memcmp(genotype, &taken->model->designs[taken->n++].genotype,
                                      sizeof(*genotype)) == 0;
  return 0;
}

static void check_each(int64_t id, const struct model *model)
{
  struct taken taken = {model, 0, BORN, true};
  CHECK_OK(mo_store_campaign_each(store, id, take, &taken));
  CHECK(taken.same && taken.n == BORN);
  taken = (struct taken){model, 0, 10, true};
  CHECK_INT(mo_store_campaign_each(store, id, take, &taken), 42);
  CHECK(taken.same && taken.n == 10);
}

static void tells_the_whole_history(int mode)
{
  struct made made = {0};
  struct mo_campaign_request submission = campaign_submission(mode, MADE_POPULATION, UNTIL);
  struct model *model = calloc(1, sizeof(*model));
  REQUIRE(model != NULL);
  int64_t id = submit_campaign(&submission);
  made = made_start(id, mode, 9);
  REQUIRE_OK(mo_store_run_start(store, id));
  for (int g = 0; g <= UNTIL; g++) {
    made_next(&made);
    REQUIRE_OK(mo_store_campaign_commit(store, id, &made.commit));
    remember(model, &made);
    made_apply(&made);
  }
  for (int life = 0; life < 2; life++) {
    check_designs(id, model);
    check_populations(id, model);
    check_descents(id, model);
    check_each(id, model);
    REQUIRE_OK(reopen());
  }
  CHECK_OK(check_whole());
  free(model);
}

/* Forms are found in every campaign that bore them, whichever way round. */
static void finds_where_a_form_was_born(void)
{
  struct made made[3] = {{0}};
  struct mo_campaign_request submission = campaign_submission(MO_ZERO_SHOT, MADE_POPULATION, 3);
  struct mo_campaign_place places[4];
  struct mo_bits nowhere = {{1}}, form, turned;
  int64_t ids[3];
  for (int i = 0; i < 3; i++) {
    ids[i] = submit_campaign(&submission);
    REQUIRE_OK(mo_store_run_start(store, ids[i]));
    made[i] = made_start(ids[i], MO_ZERO_SHOT, i == 1 ? 8 : 9);
    made_next(&made[i]);
    if (i == 2) { /* the same body, turned */
      mo_genotype_image(MO_DEFAULT_WORKSPACE, made[i].children[4].words, 1, turned.words);
      mo_genotype_place(MO_DEFAULT_WORKSPACE, turned.words);
      CHECK(memcmp(&turned, &made[i].children[4], sizeof(turned)) != 0);
      made[i].children[4] = turned;
    }
    form = made[i].forms[4];
    REQUIRE_OK(mo_store_campaign_commit(store, ids[i], &made[i].commit));
  }
  CHECK_INT(mo_store_campaigns_of_design(store, &form, 0, places, 4), 2);
  CHECK(places[0].campaign == ids[0] && places[0].number == 4 && places[1].campaign == ids[2] &&
        places[1].number == 4);
  CHECK_INT(mo_store_campaigns_of_design(store, &form, 0, places, 1), 1);
  CHECK_INT(mo_store_campaigns_of_design(store, &form, ids[0], places, 4), 1);
  CHECK_INT(places[0].campaign, ids[2]);
  CHECK_INT(mo_store_campaigns_of_design(store, &form, ids[2], places, 4), 0);
  CHECK_INT(mo_store_campaigns_of_design(store, &nowhere, 0, places, 4), 0);
  CHECK_INT(mo_store_campaigns_of_design(store, &form, 0, places, MO_PAGE_MAX + 1), MO_ERR_LIMIT);
}

static const struct check_case cases[] = {
    {"reports frozen scores", WITH(tells_the_whole_history, MO_ZERO_SHOT)},
    {"reports scores that change", WITH(tells_the_whole_history, MO_SIMULTANEOUS)},
    {"finds where a form was born", finds_where_a_form_was_born},
};
CHECK_MAIN_AROUND(cases, with_a_store)
