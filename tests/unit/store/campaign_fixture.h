/* campaign_fixture.h: made-up generations as a runner would commit them, with random bodies and
 * random scores. */
#ifndef MORPHO_TESTS_STORE_CAMPAIGN_FIXTURE_H
#define MORPHO_TESTS_STORE_CAMPAIGN_FIXTURE_H

#include <math.h>

#include "fixture.h"
#include "store/campaign_designs.h"
#include "store/campaign_runs.h"
#include "store/campaigns.h"

#define MADE_POPULATION   6
#define MADE_ENVIRONMENTS 3

static inline struct mo_campaign_request
campaign_submission(enum mo_campaign_mode mode, uint32_t population, uint32_t generations)
{
  return (struct mo_campaign_request){
      .record = {.settings = {.mode = mode,
                              .seed = UINT64_C(0x1CBA9876543210),
                              .workspace = MO_DEFAULT_WORKSPACE,
                              .population = population,
                              .generations = generations,
                              .mutation_share = 0.25,
                              .mutation_rate = 0.1,
                              .mutation_growth = 1.025,
                              .selection = {MO_SELECT_NOVELTY, 3, 0.3, 5, 7},
                              .exclude_pretraining = true,
                              .collapse_share = 0.7,
                              .parent_steps = 2,
                              .child_steps = 3,
                              .batch = 17,
                              .learning = fixture_learning(),
                              .sensor = MO_SENSOR_INVERSE_SQUARE,
                              .physics = mo_paper_physics()},
                 .name = "walker",
                 .preset = "demo",
                 .environment_set = "paper-test",
                 .replicates = 1,
                 .checkpoint_every_s = 30},
      .controller = mode == MO_SIMULTANEOUS ? NULL : "default",
      .job.label = "a label"};
}

static inline int64_t submit_campaign(const struct mo_campaign_request *submission)
{
  int64_t id = 0;
  bool replayed = true;
  const int error = mo_store_submit_campaign(store, submission, &id, &replayed);
  return error != MO_OK ? error : id;
}

static inline struct mo_campaign_status status_of(int64_t id)
{
  struct mo_campaign_status status = {.generation = -1};
  CHECK_OK(mo_store_campaign(store, id, &status));
  return status;
}

/* A campaign as its runner keeps it. */
struct made {
  int64_t id;
  bool learns;    /* parents are rescored in each generation; otherwise zero-shot, with losses */
  uint64_t state; /* state of the score generator */
  struct mo_body_stream *stream;
  int64_t generation;
  uint64_t n_designs;
  uint32_t n, numbers[MADE_POPULATION]; /* the population: */
  struct mo_bits genotypes[MADE_POPULATION];
  double scores[MADE_POPULATION];
  /* The latest commit, and the arrays that it points to. */
  struct mo_campaign_commit commit;
  struct mo_birth births[MADE_POPULATION];
  struct mo_bits forms[MADE_POPULATION], children[MADE_POPULATION];
  struct mo_design_size sizes[MADE_POPULATION];
  double child_scores[MADE_POPULATION], parent_scores[MADE_POPULATION];
  uint32_t survivors[2 * MADE_POPULATION];
  struct mo_campaign_loss losses[MADE_POPULATION];
  struct mo_campaign_step steps[2];
  int64_t fingerprint;
};

static inline double made_number(struct made *made)
{
  made->state = made->state * UINT64_C(6364136223846793005) + UINT64_C(1442695040888963407);
  return (double)(made->state >> 11) * 0x1p-53 + 0x1p-60;
}

static inline struct made made_start(int64_t id, enum mo_campaign_mode mode, uint64_t seed)
{
  struct made made = {.id = id,
                      .learns = mode != MO_ZERO_SHOT,
                      .state = seed,
                      .stream = make_body_stream(MO_DEFAULT_WORKSPACE, seed),
                      .generation = -1};
  make_check(mo_store_fingerprint(store, "by hand", &made.fingerprint), "a fingerprint");
  return made;
}

static inline double made_score_of(const struct made *made, uint32_t place)
{
  uint32_t n_parents = made->commit.n_parents;
  return place < n_parents ? made->parent_scores[place] : made->child_scores[place - n_parents];
}

/* Draws the next generation into made->commit, with as many children as the population has members.
 * One child diverges. */
static inline void made_next(struct made *made)
{
  const uint32_t n = MADE_POPULATION, n_parents = made->generation < 0 ? 0 : made->n;
  const uint32_t generation = (uint32_t)(made->generation + 1);
  for (uint32_t i = 0; i < n_parents; i++)
    made->parent_scores[i] = made->learns ? made_number(made) : made->scores[i];
  for (uint32_t i = 0; i < n; i++) {
    double sum = 0;
    make_check(mo_body_stream_next(made->stream, made->children[i].words, NULL), "a body");
    mo_genotype_place(MO_DEFAULT_WORKSPACE, made->children[i].words);
    mo_genotype_canonical(MO_DEFAULT_WORKSPACE, made->children[i].words, made->forms[i].words);
    made->sizes[i] =
        (struct mo_design_size){mo_genotype_count(MO_DEFAULT_WORKSPACE, made->children[i].words),
                                i % 36 + 1, 100 + i % 100, 1000 + i % 1000};
    made->births[i] = (struct mo_birth){MO_BORN_RANDOM, {MO_NO_PARENT, MO_NO_PARENT}};
    if (n_parents > 0 && i % 4 == 0)
      made->births[i] = (struct mo_birth){MO_BORN_MUTATION, {i % n_parents, MO_NO_PARENT}, 1};
    else if (n_parents > 0)
      made->births[i] =
          (struct mo_birth){MO_BORN_CROSSOVER, {i % n_parents, (i + 1) % n_parents}, 2};
    made->losses[i].place = i;
    for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++) {
      made->losses[i].losses[k] = i == 3 ? INFINITY : made_number(made);
      made->losses[i].diverged_steps[k] = i == 3 ? 5 : 0;
      sum += made->losses[i].losses[k];
    }
    made->child_scores[i] = sum / MO_PAPER_TEST_COUNT;
  }
  for (uint32_t s = 0; s < 2 && made->learns; s++)
    made->steps[s] = (struct mo_campaign_step){.generation = generation,
                                               .step = s + 1,
                                               .on_children = s == 1,
                                               .report = {.step = 2 * generation + s + 1,
                                                          .mean_loss = made_number(made),
                                                          .rate = 1e-3,
                                                          .diverged = s},
                                               .seconds = 0.5};
  made->commit =
      (struct mo_campaign_commit){.row = {.generation = generation,
                                          .born_before = made->n_designs,
                                          .n_children = n,
                                          .stats = {.n = n, .diversity = 0.25 - 0.01 * generation},
                                          .mean_parents = NAN,
                                          .mean_children = 0.5 + generation,
                                          .seconds = 1.5},
                                  .births = made->births,
                                  .forms = made->forms,
                                  .genotypes = made->children,
                                  .sizes = made->sizes,
                                  .child_scores = made->child_scores,
                                  .parent_numbers = made->numbers,
                                  .parent_scores = made->parent_scores,
                                  .n_parents = n_parents,
                                  .survivors = made->survivors,
                                  .n_survivors = MADE_POPULATION,
                                  .losses = made->losses,
                                  .n_losses = made->learns ? 0 : n,
                                  .steps = made->steps,
                                  .n_steps = made->learns ? 2 : 0,
                                  .fingerprint = made->fingerprint,
                                  .event_data = "{\"made\":true}"};
  for (uint32_t i = 0; i < n_parents + n; i++) { /* insertion sort by score; older designs first */
    uint32_t at = i;
    while (at > 0 && made_score_of(made, made->survivors[at - 1]) > made_score_of(made, i)) {
      made->survivors[at] = made->survivors[at - 1];
      at--;
    }
    made->survivors[at] = i;
  }
}

/* The commit succeeded: the survivors become the population. */
static inline void made_apply(struct made *made)
{
  const struct made old = *made;
  const uint32_t n_parents = old.commit.n_parents;
  for (uint32_t i = 0; i < MADE_POPULATION; i++) {
    const uint32_t place = old.survivors[i];
    const bool is_parent = place < n_parents;
    made->genotypes[i] = is_parent ? old.genotypes[place] : old.children[place - n_parents];
    made->numbers[i] = is_parent ? old.numbers[place] : (uint32_t)old.n_designs + place - n_parents;
    made->scores[i] = made_score_of(&old, place);
  }
  made->n = MADE_POPULATION;
  made->n_designs += MADE_POPULATION;
  made->generation++;
}

/* Returns whether the stored state is exactly what was committed last. */
static inline bool made_is_stored(const struct made *made)
{
  struct mo_campaign_state *state = NULL;
  bool same = mo_store_campaign_state(store, made->id, &state) == MO_OK &&
              state->generation == (uint32_t)made->generation && state->n == made->n &&
              state->n_designs == made->n_designs && SAME(state->numbers, made->numbers, made->n) &&
              SAME(state->genotypes, made->genotypes, made->n) &&
              SAME(state->scores, made->scores, made->n) && state->diversity_max == 0.25;
  for (uint32_t i = 0; same && i < state->n; i++)
    same = state->born[i] == state->numbers[i] / MADE_POPULATION;
  mo_campaign_state_free(state);
  return same;
}

static inline int made_commit(struct made *made)
{
  const int error = mo_store_campaign_commit(store, made->id, &made->commit);
  if (error == MO_OK)
    made_apply(made);
  return error;
}

/* Draws and commits a generation. */
static inline int made_generation(struct made *made)
{
  made_next(made);
  return made_commit(made);
}

#endif
