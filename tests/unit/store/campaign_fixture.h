/* campaign_fixture.h: generations as a runner would commit them, made up: bodies of a stream,
 * scores of a generator. */
#ifndef MORPHO_TESTS_STORE_CAMPAIGN_FIXTURE_H
#define MORPHO_TESTS_STORE_CAMPAIGN_FIXTURE_H

#include <math.h>

#include "fixture.h"
#include "store/campaign_designs.h"
#include "store/campaign_runs.h"
#include "store/campaigns.h"

#define MADE_POPULATION   6
#define MADE_ENVIRONMENTS 3

static inline struct mo_campaign_submission
campaign_submission(enum mo_campaign_mode mode, uint32_t population, uint32_t generations)
{
  return (struct mo_campaign_submission){
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
                              .physics = mo_default_physics()},
                 .name = "walker",
                 .preset = "demo",
                 .environment_set = "paper-test",
                 .replicates = 1,
                 .checkpoint_every_s = 30},
      .controller = mode == MO_SIMULTANEOUS ? NULL : "default",
      .priority = MO_BATCH,
      .weight = 1,
      .label = "a label"};
}

static inline int64_t campaign_submit(struct fixture *in,
                                      const struct mo_campaign_submission *submission)
{
  int64_t id = 0;
  bool replayed = true;
  int error = mo_store_submit_campaign(in->store, submission, &id, &replayed);
  return error != MO_OK ? error : id;
}

static inline enum mo_job_state campaign_state(struct fixture *in, int64_t id)
{
  struct mo_job job = {.state = MO_JOB_FAILED};
  (void)mo_store_job(in->store, id, &job);
  return job.state;
}

/* The newest event of a job. */
static inline struct mo_event campaign_event(struct fixture *in, int64_t id)
{
  struct mo_event events[200] = {{0}};
  int64_t n = mo_store_events(in->store, 0, id, events, 200, NULL, NULL);
  return events[n > 0 ? n - 1 : 0];
}

/* A campaign as its runner holds it. */
struct made {
  struct mo_store *store;
  int64_t id;
  bool rescores;       /* parents get new scores each generation */
  bool with_losses;    /* zero-shot */
  uint32_t population; /* asked for */
  uint64_t state;      /* of the generator of scores */
  struct mo_body_stream *stream;
  int64_t generation;
  uint64_t n_designs;
  uint32_t n; /* the population: */
  uint32_t *numbers;
  struct mo_bits *genotypes;
  double *scores;
  /* The last commit, and what it points to. */
  struct mo_campaign_commit commit;
  struct mo_birth *births;
  struct mo_bits *forms, *children;
  struct mo_design_size *sizes;
  double *child_scores, *parent_scores;
  uint32_t *survivors;
  struct mo_campaign_loss *losses;
  struct mo_campaign_step steps[2];
  int64_t fingerprint;
};

static inline double made_number(struct made *made)
{
  made->state = made->state * UINT64_C(6364136223846793005) + UINT64_C(1442695040888963407);
  return (double)(made->state >> 11) * 0x1p-53 + 0x1p-60;
}

static inline void made_free(struct made *made)
{
  mo_body_stream_free(made->stream);
  free(made->numbers);
  free(made->genotypes);
  free(made->scores);
  free(made->births);
  free(made->forms);
  free(made->children);
  free(made->sizes);
  free(made->child_scores);
  free(made->parent_scores);
  free(made->survivors);
  free(made->losses);
}

static inline int made_start(struct made *made, struct mo_store *store, int64_t id,
                             enum mo_campaign_mode mode, uint32_t population, uint64_t seed)
{
  size_t n = population;
  *made = (struct made){.store = store,
                        .id = id,
                        .rescores = mode != MO_ZERO_SHOT,
                        .with_losses = mode == MO_ZERO_SHOT,
                        .population = population,
                        .state = seed,
                        .generation = -1};
  made->numbers = calloc(n, sizeof(*made->numbers));
  made->genotypes = calloc(2 * n, sizeof(*made->genotypes));
  made->scores = calloc(n, sizeof(*made->scores));
  made->births = calloc(n, sizeof(*made->births));
  made->forms = calloc(n, sizeof(*made->forms));
  made->children = calloc(n, sizeof(*made->children));
  made->sizes = calloc(n, sizeof(*made->sizes));
  made->child_scores = calloc(n, sizeof(*made->child_scores));
  made->parent_scores = calloc(n, sizeof(*made->parent_scores));
  made->survivors = calloc(2 * n, sizeof(*made->survivors));
  made->losses = calloc(n, sizeof(*made->losses));
  if (made->numbers == NULL || made->genotypes == NULL || made->scores == NULL ||
      made->births == NULL || made->forms == NULL || made->children == NULL ||
      made->sizes == NULL || made->child_scores == NULL || made->parent_scores == NULL ||
      made->survivors == NULL || made->losses == NULL)
    return MO_ERR_NO_MEMORY;
  if (mo_store_fingerprint(store, "by hand", &made->fingerprint) != MO_OK)
    return MO_ERR_IO;
  return mo_body_stream_create(MO_DEFAULT_WORKSPACE, seed, &made->stream);
}

static inline double made_score_of(const struct made *made, uint32_t place)
{
  uint32_t n_parents = made->commit.n_parents;
  return place < n_parents ? made->parent_scores[place] : made->child_scores[place - n_parents];
}

/* Draws the next generation into made->commit: as many children as the population, one of which
 * diverges. */
static inline int made_next(struct made *made)
{
  uint32_t n = made->population, n_parents = made->generation < 0 ? 0 : made->n, n_all;
  uint32_t generation = (uint32_t)(made->generation + 1);
  int error = MO_OK;
  for (uint32_t i = 0; i < n_parents; i++)
    made->parent_scores[i] = made->rescores ? made_number(made) : made->scores[i];
  for (uint32_t i = 0; i < n && error == MO_OK; i++) {
    double sum = 0;
    error = mo_body_stream_next(made->stream, made->children[i].words, NULL);
    if (error != MO_OK)
      return error;
    mo_genotype_place(MO_DEFAULT_WORKSPACE, made->children[i].words);
    mo_genotype_canonical(MO_DEFAULT_WORKSPACE, made->children[i].words, made->forms[i].words);
    made->sizes[i] =
        (struct mo_design_size){mo_genotype_count(MO_DEFAULT_WORKSPACE, made->children[i].words),
                                i % 36 + 1, 100 + i % 100, 1000 + i % 1000};
    made->births[i] =
        (struct mo_birth){.op = MO_BORN_RANDOM, .parents = {MO_NO_PARENT, MO_NO_PARENT}};
    if (n_parents > 0)
      made->births[i] =
          i % 4 == 0
              ? (struct mo_birth){MO_BORN_MUTATION, {i % n_parents, MO_NO_PARENT}, 1}
              : (struct mo_birth){MO_BORN_CROSSOVER, {i % n_parents, (i + 1) % n_parents}, 2};
    made->losses[i].place = i;
    for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++) {
      made->losses[i].losses[k] = i == 3 ? INFINITY : made_number(made);
      made->losses[i].diverged_steps[k] = i == 3 ? 5 : 0;
      sum += made->losses[i].losses[k];
    }
    made->child_scores[i] = sum / MO_PAPER_TEST_COUNT;
  }
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
                                  .fingerprint = made->fingerprint};
  n_all = n_parents + n;
  for (uint32_t i = 0; i < n_all; i++) { /* insertion by score; the older first */
    uint32_t at = i;
    while (at > 0 && made_score_of(made, made->survivors[at - 1]) > made_score_of(made, i)) {
      made->survivors[at] = made->survivors[at - 1];
      at--;
    }
    made->survivors[at] = i;
  }
  made->commit.n_survivors = n_all < made->population ? n_all : made->population;
  if (made->with_losses) {
    made->commit.losses = made->losses;
    made->commit.n_losses = n;
  } else {
    for (uint32_t s = 0; s < 2; s++)
      made->steps[s] = (struct mo_campaign_step){.generation = generation,
                                                 .step = s + 1,
                                                 .on_children = s == 1,
                                                 .report = {.step = 2 * generation + s + 1,
                                                            .mean_loss = made_number(made),
                                                            .rate = 1e-3,
                                                            .diverged = s},
                                                 .seconds = 0.5};
    made->commit.steps = made->steps;
    made->commit.n_steps = 2;
  }
  made->commit.event_data = "{\"made\":true}";
  return MO_OK;
}

/* The commit went through: what lives becomes the population. */
static inline void made_apply(struct made *made)
{
  uint32_t n_parents = made->commit.n_parents, n = made->commit.n_survivors;
  struct mo_bits *genotypes = calloc(n, sizeof(*genotypes));
  uint32_t *numbers = calloc(n, sizeof(*numbers));
  double *scores = calloc(n, sizeof(*scores));
  for (uint32_t i = 0; i < n && genotypes != NULL && numbers != NULL && scores != NULL; i++) {
    uint32_t place = made->survivors[i];
    genotypes[i] = place < n_parents ? made->genotypes[place] : made->children[place - n_parents];
    numbers[i] =
        place < n_parents ? made->numbers[place] : (uint32_t)made->n_designs + place - n_parents;
    scores[i] = made_score_of(made, place);
  }
  free(made->genotypes);
  free(made->numbers);
  free(made->scores);
  made->genotypes = genotypes;
  made->numbers = numbers;
  made->scores = scores;
  made->n = n;
  made->n_designs += made->commit.row.n_children;
  made->generation++;
}

/* Whether the store goes on from just what was committed. */
static inline bool made_is_stored(const struct made *made)
{
  struct mo_campaign_state *state = NULL;
  bool same = mo_store_campaign_state(made->store, made->id, &state) == MO_OK &&
              state->generation == (uint32_t)made->generation && state->n == made->n &&
              state->n_designs == made->n_designs &&
              memcmp(state->numbers, made->numbers, made->n * sizeof(*made->numbers)) == 0 &&
              memcmp(state->genotypes, made->genotypes, made->n * sizeof(*made->genotypes)) == 0 &&
              memcmp(state->scores, made->scores, made->n * sizeof(*made->scores)) == 0;
  for (uint32_t i = 0; same && i < state->n; i++)
    same = state->born[i] == state->numbers[i] / made->population;
  same = same && state->diversity_max == 0.25;
  mo_campaign_state_free(state);
  return same;
}

/* A generation, whole. */
static inline int made_generation(struct made *made)
{
  int error = made_next(made);
  if (error == MO_OK)
    error = mo_store_campaign_commit(made->store, made->id, &made->commit);
  if (error == MO_OK)
    made_apply(made);
  return error;
}

#endif
