/* campaign_history.c: every design of a campaign, as each reader returns it. Survivors, scores and
 * parents of each generation are tested with the campaigns of room jobs, against plain loops. */
#include "../check.h"
#include "../image.h"
#include "campaign_fixture.h"
#include "one_store.h"

#define UNTIL 40 /* generations after the first */
#define BORN  ((UNTIL + 1) * MADE_POPULATION)

static bool same_design(const struct mo_campaign_design *a, const struct mo_campaign_design *b)
{
  return a->number == b->number && mo_genotype_equal(&a->form, &b->form) &&
         mo_genotype_equal(&a->genotype, &b->genotype) &&
         a->descent.parents[0] == b->descent.parents[0] &&
         a->descent.parents[1] == b->descent.parents[1] && a->descent.op == b->descent.op &&
         a->born == b->born && a->died == b->died &&
         memcmp(&a->score, &b->score, sizeof(a->score)) == 0 &&
         memcmp(&a->size, &b->size, sizeof(a->size)) == 0;
}

/* Checks the designs by page, by number, and for an unknown campaign. all: (BORN). */
static void check_designs(int64_t id, const struct mo_campaign_design *all)
{
  static const uint32_t some[] = {7, 3, BORN - 1, 0, 3};
  struct mo_campaign_design page[7];
  uint32_t n_read = 0;
  int64_t n;
  while ((n = mo_store_campaign_designs(store, id, (int64_t)n_read - 1, page, 7)) > 0)
    for (int64_t i = 0; i < n; i++, n_read++)
      CHECK(page[i].number == n_read && same_design(&page[i], &all[n_read]));
  CHECK(n == 0 && n_read == BORN);
  CHECK_OK(mo_store_campaign_designs_of(store, id, some, 5, page));
  for (int i = 0; i < 5; i++)
    CHECK(same_design(&page[i], &all[some[i]]));
  CHECK_INT(mo_store_campaign_designs_of(store, id, (const uint32_t[]){1, BORN}, 2, page),
            MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_campaign_designs_of(store, 99, some, 1, page), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_campaign_designs(store, 99, -1, page, 7), 0);
  CHECK_INT(mo_store_campaign_designs(store, id, -1, page, MO_PAGE_MAX + 1), MO_ERR_LIMIT);
}

/* Checks the population of each generation, with its scores at that time. */
static void check_populations(int64_t id, const struct mo_campaign_design *all)
{
  struct mo_campaign_design page[MADE_POPULATION], part[2];
  uint32_t n = 0;
  for (int64_t g = UNTIL; g >= -1; g--) { /* generation 3 is checked again below */
    const uint32_t at = g < 0 ? UNTIL : (uint32_t)g;
    CHECK_INT(mo_store_campaign_population(store, id, g, 0, page, MADE_POPULATION, &n),
              MADE_POPULATION);
    CHECK_INT(n, MADE_POPULATION);
    for (uint32_t i = 0; i < MADE_POPULATION; i++) {
      struct mo_campaign_design now = all[page[i].number];
      CHECK(now.born <= at && (now.died < 0 || now.died > at));
      if (at == UNTIL)
        CHECK(memcmp(&page[i].score, &now.score, sizeof(now.score)) == 0);
      now.score = page[i].score;
      CHECK(same_design(&page[i], &now));
    }
  }
  CHECK_INT(mo_store_campaign_population(store, id, -1, 2, part, 2, &n), 2);
  CHECK(n == MADE_POPULATION && same_design(&part[0], &page[2]) && same_design(&part[1], &page[3]));
  CHECK_INT(mo_store_campaign_population(store, id, 3, MADE_POPULATION, page, 2, &n), 0);
  CHECK_INT(mo_store_campaign_population(store, id, UNTIL + 1, 0, page, 2, &n), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_campaign_population(store, 99, -1, 0, page, 2, &n), MO_ERR_NOT_FOUND);
  CHECK_INT(mo_store_campaign_population(store, id, 3, 0, page, MO_PAGE_MAX + 1, &n), MO_ERR_LIMIT);
}

static void check_descents(int64_t id, const struct mo_campaign_design *all)
{
  struct mo_descent *descents = NULL;
  uint32_t *born = NULL, n = 0;
  REQUIRE_OK(mo_store_campaign_descents(store, id, &descents, &born, &n));
  CHECK_INT(n, BORN);
  for (uint32_t i = 0; i < n; i++)
    CHECK(descents[i].parents[0] == all[i].descent.parents[0] &&
          descents[i].parents[1] == all[i].descent.parents[1] &&
          descents[i].op == all[i].descent.op && born[i] == all[i].born);
  free(descents);
  free(born);
  REQUIRE_OK(mo_store_campaign_descents(store, id, &descents, NULL, &n));
  CHECK_INT(n, BORN);
  free(descents);
  CHECK_INT(mo_store_campaign_descents(store, 99, &descents, &born, &n), MO_ERR_NOT_FOUND);
}

struct taken {
  const struct mo_campaign_design *all;
  uint32_t n, until;
  bool same;
};

static int take(void *context, const struct mo_genotype *genotype)
{
  struct taken *taken = context;
  if (taken->n == taken->until)
    return 42;
  taken->same = taken->same && mo_genotype_equal(genotype, &taken->all[taken->n++].genotype);
  return 0;
}

static void check_each(int64_t id, const struct mo_campaign_design *all)
{
  struct taken taken = {all, 0, BORN, true};
  CHECK_OK(mo_store_campaign_each(store, id, take, &taken));
  CHECK(taken.same && taken.n == BORN);
  taken = (struct taken){all, 0, 10, true};
  CHECK_INT(mo_store_campaign_each(store, id, take, &taken), 42);
  CHECK(taken.same && taken.n == 10);
}

/* Checks the children right after the commit. */
static void check_children(int64_t id, const struct mo_campaign_commit *commit)
{
  struct mo_campaign_design page[2 * MADE_POPULATION];
  const uint32_t n = commit->row.n_children;
  CHECK_INT(mo_store_campaign_designs(store, id, (int64_t)commit->row.born_before - 1, page,
                                      2 * MADE_POPULATION),
            n);
  for (uint32_t i = 0; i < n; i++)
    CHECK(SAME(&commit->forms[i], page[i].form.words, 1) &&
          SAME(&commit->genotypes[i], page[i].genotype.words, 1) &&
          memcmp(&page[i].size, &commit->sizes[i], sizeof(page[i].size)) == 0 &&
          memcmp(&page[i].score, &commit->child_scores[i], sizeof(page[i].score)) == 0);
}

static void tells_the_whole_history(int mode)
{
  static struct mo_campaign_design all[BORN];
  const struct mo_campaign_request submission = campaign_submission(mode, MADE_POPULATION, UNTIL);
  const int64_t id = submit_campaign(&submission);
  struct made made = made_start(id, mode, 9);
  REQUIRE_OK(mo_store_run_start(store, id));
  for (int g = 0; g <= UNTIL; g++) {
    made_next(&made);
    REQUIRE_OK(mo_store_campaign_commit(store, id, &made.commit));
    check_children(id, &made.commit);
    made_apply(&made);
  }
  CHECK_INT(mo_store_campaign_designs(store, id, -1, all, BORN), BORN);
  for (int life = 0; life < 2; life++) {
    check_designs(id, all);
    check_populations(id, all);
    check_descents(id, all);
    check_each(id, all);
    REQUIRE_OK(reopen());
  }
  CHECK_OK(check_whole());
}

/* A form is found in every campaign that produced it, in any orientation. */
static void finds_where_a_form_was_born(void)
{
  struct made made[3] = {{0}};
  struct mo_campaign_request submission = campaign_submission(MO_ZERO_SHOT, MADE_POPULATION, 3);
  struct mo_campaign_place places[4];
  struct mo_genotype nowhere = {.workspace = MO_DEFAULT_WORKSPACE, .words = {1}}, form;
  struct mo_bits turned;
  int64_t ids[3];
  for (int i = 0; i < 3; i++) {
    ids[i] = submit_campaign(&submission);
    REQUIRE_OK(mo_store_run_start(store, ids[i]));
    made[i] = made_start(ids[i], MO_ZERO_SHOT, i == 1 ? 8 : 9);
    made_next(&made[i]);
    if (i == 2) { /* the same body, turned */
      make_image(MO_DEFAULT_WORKSPACE, made[i].children[4].words, 1, turned.words);
      mo_genotype_place(MO_DEFAULT_WORKSPACE, turned.words);
      CHECK(memcmp(&turned, &made[i].children[4], sizeof(turned)) != 0);
      made[i].children[4] = turned;
    }
    form = mo_genotype_of(MO_DEFAULT_WORKSPACE, &made[i].forms[4]);
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
