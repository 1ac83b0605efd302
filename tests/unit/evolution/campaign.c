/* campaign.c: whole campaigns: the same bits for the same settings, whatever was computed before
 * and however often a generation is made again; what is given in the beginning; what was seen. */
#include "../image.h"
#include "fixture.h"

#include <pthread.h>
#include <sched.h>

/* All births and populations of `generations` generations. */
static uint64_t hash_of(const struct mo_campaign_settings *settings, int generations)
{
  struct made_up_campaign *campaign = make_campaign(settings, NULL);
  uint64_t h = FNV_START;
  for (int g = 0; g < generations; g++) {
    campaign_vary(campaign);
    for (uint32_t i = 0; i < campaign->n_children; i++) {
      const struct mo_birth *birth = &campaign->births[i];
      const uint32_t fields[] = {(uint32_t)birth->op, birth->parents[0], birth->parents[1],
                                 birth->attempts};
      hash(&h, fields, sizeof(fields));
    }
    hash(&h, genotype_of(campaign, campaign->n),
         (size_t)campaign->words * campaign->n_children * sizeof(uint64_t));
    campaign_select(campaign);
    for (uint32_t i = 0; i < campaign->n; i++)
      hash(&h, &campaign->candidates[i].number, sizeof(uint64_t));
  }
  return h;
}

/* A seed always means the same campaign: changing these numbers would break the promise of every
 * stored one. */
static void frozen(void)
{
  static const uint64_t expected[] = {0xf8335799e4385b08, 0x1cb3583196a004d1, 0x1be14bcdd46d7c5e,
                                      0xa2e254174761a693};
  for (int kind = 0; kind < 4; kind++) {
    struct mo_campaign_settings settings = small_campaign(42, 64);
    settings.selection.kind = (enum mo_selection_kind)kind;
    settings.selection.age_gap = 1;
    const uint64_t h = hash_of(&settings, 12);
    printf("# %s: 0x%016llx\n", mo_selection_words[settings.selection.kind], (unsigned long long)h);
    CHECK(h == expected[kind]);
    CHECK(hash_of(&settings, 12) == h);
    settings.seed = 43;
    CHECK(hash_of(&settings, 12) != h);
  }
}

/* The seeds of few-shot generations too. */
static void frozen_seeds(void)
{
  struct mo_campaign_settings settings = mo_campaign_preset(MO_FEW_SHOT, MO_PRESET_DEMO);
  settings.seed = 42;
  CHECK_INT(mo_campaign_training(&settings, 1).seed, 4694565246690077);
  CHECK_INT(mo_campaign_training(&settings, 2).seed, 8483268893388179);
}

/* A generation is recomputed from the population and the designs seen before it, with the same
 * result. */
static void made_again(void)
{
  for (int kind = 0; kind < 4; kind++) {
    struct mo_campaign_settings settings = small_campaign(7, 48);
    uint64_t *born = make_zeros(48 * 20 * W, sizeof(*born)); /* every design, in order */
    uint64_t children[48 * W];
    struct mo_birth births[48];
    size_t n_born = 48;
    settings.selection.kind = (enum mo_selection_kind)kind;
    struct made_up_campaign *campaign = make_campaign(&settings, NULL);
    memcpy(born, campaign->genotypes, 48 * W * sizeof(*born));
    for (uint32_t g = 1; g < 20; g++) {
      struct mo_variation_counts counts;
      uint32_t n = 0;
      /* First with a separate set of all designs so far, added in another order. */
      struct mo_seen *seen = make_seen(settings.workspace, NULL);
      for (size_t i = n_born; i-- > 0;)
        REQUIRE(mo_seen_add(seen, born + W * i) == 1);
      REQUIRE(mo_variation(&settings, g, campaign->genotypes, campaign->n, seen, children, births,
                           &n, &counts, NULL) == MO_OK);
      campaign_vary(campaign);
      CHECK_INT(n, campaign->n_children);
      CHECK(SAME(children, genotype_of(campaign, campaign->n), W * n));
      for (uint32_t i = 0; i < n; i++)
        CHECK(births[i].op == campaign->births[i].op &&
              births[i].attempts == campaign->births[i].attempts &&
              births[i].parents[0] == campaign->births[i].parents[0] &&
              births[i].parents[1] == campaign->births[i].parents[1]);
      CHECK(memcmp(&counts, &campaign->counts, sizeof(counts)) == 0);
      memcpy(born + W * n_born, children, W * n * sizeof(*children));
      n_born += n;
      campaign_select(campaign);
    }
  }
}

/* ---- the initial population ---- */

/* Returns the initial population of a campaign, whose first `n_given` members are given. */
static uint32_t populate(const struct mo_campaign_settings *settings, struct mo_seen *seen,
                         uint64_t *genotypes, uint32_t n_given, uint32_t *fault)
{
  uint32_t n = 0;
  CHECK_INT(mo_population_initial(settings, seen, genotypes, n_given, &n, fault, NULL), MO_OK);
  return n;
}

static void given(void)
{
  const struct mo_campaign_settings settings = small_campaign(3, 20);
  uint64_t alone[20 * W], genotypes[20 * W] = {1}, mirrored[W];
  struct mo_seen *seen = make_seen(settings.workspace, NULL);
  uint32_t n = 55, fault = 99;
  CHECK_INT(populate(&settings, seen, alone, 0, NULL), 20);
  CHECK_INT(mo_seen_count(seen), 20);

  /* Two designs are given. The stream would have drawn one of them third: it is skipped there. */
  mo_genotype_place(settings.workspace, genotypes);
  memcpy(genotypes + W, alone + 2 * W, W * sizeof(uint64_t));
  seen = make_seen(settings.workspace, NULL);
  CHECK_INT(populate(&settings, seen, genotypes, 2, &fault), 20);
  CHECK(SAME(genotypes + W, alone + 2 * W, W));
  CHECK(SAME(genotypes + 2 * W, alone, 2 * W));
  CHECK(SAME(genotypes + 4 * W, alone + 3 * W, W));
  CHECK(mo_seen_count(seen) == 20 && mo_seen_add(seen, genotypes) == 0 && fault == 99);

  /* The same form twice, although mirrored. */
  for (unsigned k = 1; k < 8; k++)
    if (make_image(settings.workspace, alone + 2 * W, k, mirrored) == MO_OK) {
      mo_genotype_place(settings.workspace, mirrored);
      memcpy(genotypes + 2 * W, mirrored, sizeof(mirrored));
    }
  seen = make_seen(settings.workspace, NULL);
  CHECK_INT(mo_population_initial(&settings, seen, genotypes, 3, &n, &fault, NULL),
            MO_ERR_DUPLICATE);
  CHECK(fault == 2 && n == 55);
  CHECK_INT(mo_population_initial(&settings, seen, genotypes, 21, &n, &fault, NULL), MO_ERR_RANGE);
}

/* A given design may be one of the excluded ones; a random one may not. */
static void given_and_excluded(void)
{
  const struct mo_campaign_settings settings = small_campaign(3, 10);
  struct mo_form_set *excluded = make_form_set(settings.workspace);
  uint64_t genotypes[10 * W], again[10 * W], form[W];
  const uint64_t nothing[W] = {0};
  populate(&settings, make_seen(settings.workspace, NULL), genotypes, 0, NULL);
  for (int i = 0; i < 2; i++) {
    mo_genotype_canonical(settings.workspace, genotypes + (size_t)W * i, form);
    REQUIRE(mo_form_set_add(excluded, form) == 1);
  }
  memcpy(again, genotypes, W * sizeof(uint64_t));
  struct mo_seen *seen = make_seen(settings.workspace, excluded);
  CHECK_INT(mo_seen_add(seen, genotypes), 0);
  CHECK_INT(mo_seen_add(seen, genotypes + W), 0);
  CHECK_INT(mo_seen_count(seen), 0);
  CHECK_INT(populate(&settings, seen, again, 1, NULL), 10);
  CHECK(SAME(again + W, genotypes + 2 * W, 8 * W));
  CHECK_INT(mo_seen_add(seen, nothing), MO_ERR_EMPTY);
  seen = NULL;
  CHECK(mo_seen_create((struct mo_workspace){0, 1, 1}, NULL, &seen) == MO_ERR_RANGE &&
        seen == NULL);
  mo_seen_free(NULL);
}

/* ---- bodies of a pretraining run ---- */

#define BATCH 300
#define STEPS 4

/* Draws the next body of a stream that is not held out, and its form. */
static int next_body(struct mo_body_stream *stream, uint64_t body[W], uint64_t form[W])
{
  int r;
  do {
    r = mo_body_stream_next(stream, body, NULL);
    mo_genotype_canonical(MO_DEFAULT_WORKSPACE, body, form);
  } while (r == MO_OK && mo_held_out_form(form));
  return r;
}

/* Exactly the bodies that a real pretraining run learns from in its first steps. */
static void pretraining(void)
{
  struct mo_training_settings settings = mo_training_defaults(MO_TRAINING_PRETRAIN);
  static struct mo_outcome outcomes[BATCH];
  const struct mo_gradient_counts counts = {0};
  volatile uint64_t done = 0;
  settings.seed = 11;
  settings.n_steps = STEPS + 1;
  settings.batch = BATCH;
  struct mo_form_set *set = make_form_set(MO_DEFAULT_WORKSPACE);
  CHECK_INT(mo_pretraining_forms(11, STEPS * BATCH, MO_DEFAULT_WORKSPACE, 1, NULL, &done, set),
            MO_OK);
  CHECK(done == STEPS * BATCH && mo_form_set_count(set) == STEPS * BATCH);
  struct mo_lattice *lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  struct mo_body_stream *stream = make_body_stream(MO_DEFAULT_WORKSPACE, 11);
  struct mo_training *training = make_training(&settings, NULL, NULL, 0);
  double *gradient = make_zeros(mo_training_controller(training)->n_parameters, sizeof(*gradient));
  for (int step = 0; step <= STEPS; step++) {
    const struct mo_robot *robots = NULL;
    REQUIRE(mo_training_draw(training, NULL, NULL, &robots) == MO_OK);
    for (int i = 0; i < BATCH; i++) {
      uint64_t genotype[W], form[W];
      REQUIRE(next_body(stream, genotype, form) == MO_OK);
      struct mo_body *body = make_body(lattice, genotype);
      CHECK(body->n_springs == robots[i].body->n_springs &&
            body->n_voxels == robots[i].body->n_voxels &&
            memcmp(body->spring_lattice, robots[i].body->spring_lattice,
                   body->n_springs * sizeof(uint32_t)) == 0);
      CHECK_INT(mo_form_set_has(set, form), step < STEPS);
    }
    REQUIRE(mo_training_apply(training, gradient, outcomes, &counts, NULL) == MO_OK);
  }
}

/* In a smaller workspace: the bodies that fit, without moving them. A set that is not empty gets
 * the same forms. */
static void pretraining_elsewhere(void)
{
  const struct mo_workspace small = {5, 4, 2};
  const volatile int cancel = 1;
  struct mo_form_set *set = make_form_set(small);
  struct mo_form_set *expected = make_form_set(small);
  struct mo_form_set *again = make_form_set(MO_DEFAULT_WORKSPACE);
  struct mo_body_stream *stream = make_body_stream(MO_DEFAULT_WORKSPACE, 11);
  CHECK_INT(mo_pretraining_forms(11, 1200, small, 1, NULL, NULL, set), MO_OK);
  for (int i = 0; i < 1200; i++) {
    uint64_t body[W], form[W], moved, moved_form;
    REQUIRE(next_body(stream, body, form) == MO_OK);
    if (mo_genotype_move(MO_DEFAULT_WORKSPACE, body, small, &moved) != MO_OK)
      continue;
    mo_genotype_canonical(small, &moved, &moved_form);
    REQUIRE(mo_form_set_add(expected, &moved_form) >= 0);
    CHECK_INT(mo_form_set_has(set, &moved_form), 1);
  }
  CHECK_INT(mo_form_set_count(set), mo_form_set_count(expected));
  CHECK(mo_form_set_count(set) > 100 && mo_form_set_count(set) < 1100);
  CHECK_INT(mo_pretraining_forms(11, 100, MO_DEFAULT_WORKSPACE, 1, NULL, NULL, again), MO_OK);
  CHECK_INT(mo_pretraining_forms(11, 1200, MO_DEFAULT_WORKSPACE, 1, NULL, NULL, again), MO_OK);
  CHECK_INT(mo_form_set_count(again), 1200);
  CHECK_INT(mo_pretraining_forms(12, 100, MO_DEFAULT_WORKSPACE, 1, &cancel, NULL, again),
            MO_ERR_CANCELLED);
  CHECK_INT(mo_form_set_count(again), 1200);
}

/* Counts the forms of a pretraining run's first n bodies that fit the workspace and are not in the
 * set; `add`: adds them. */
static int missing_forms(uint64_t seed, int n, struct mo_workspace workspace,
                         struct mo_form_set *set, bool add)
{
  struct mo_body_stream *stream = make_body_stream(MO_DEFAULT_WORKSPACE, seed);
  uint64_t body[W], form[W], moved[W];
  int missing = 0;
  for (int i = 0; i < n; i++) {
    make_check(next_body(stream, body, form), "a body");
    if (mo_genotype_move(MO_DEFAULT_WORKSPACE, body, workspace, moved) == MO_OK) {
      mo_genotype_canonical(workspace, moved, form);
      missing += add ? mo_form_set_add(set, form) == 1 : !mo_form_set_has(set, form);
    }
  }
  return missing;
}

#ifdef __SANITIZE_THREAD__ /* thirty times as slow */
#define MANY 10000
#else
#define MANY 60000
#endif

static void pretraining_on_threads(void)
{
  const struct mo_workspace workspaces[] = {MO_DEFAULT_WORKSPACE, {5, 4, 2}};
  const uint32_t threads[] = {1, 2, 7};
  for (int w = 0; w < 2; w++) {
    struct mo_form_set *expected = make_form_set(workspaces[w]);
    CHECK(missing_forms(5, MANY, workspaces[w], expected, true) > 1000);
    for (int t = 0; t < 3; t++) {
      volatile uint64_t done = 0;
      struct mo_form_set *set = make_form_set(workspaces[w]);
      CHECK_INT(mo_pretraining_forms(5, MANY, workspaces[w], threads[t], NULL, &done, set), MO_OK);
      CHECK_INT(done, MANY);
      CHECK_INT(mo_form_set_count(set), mo_form_set_count(expected));
      CHECK_INT(mo_form_set_bytes(set), mo_form_set_bytes(expected));
      CHECK_INT(missing_forms(5, MANY, workspaces[w], set, false), 0);
    }
  }
}

struct interruption {
  volatile uint64_t done;
  volatile int cancel;
};

static void *interrupt(void *context)
{
  struct interruption *interruption = context;
  while (__atomic_load_n(&interruption->done, __ATOMIC_RELAXED) == 0)
    sched_yield();
  __atomic_store_n(&interruption->cancel, 1, __ATOMIC_RELAXED);
  return NULL;
}

static void pretraining_interrupted(void)
{
  struct interruption interruption = {.cancel = 0};
  pthread_t thread;
  struct mo_form_set *set = make_form_set(MO_DEFAULT_WORKSPACE);
  REQUIRE(pthread_create(&thread, NULL, interrupt, &interruption) == 0);
  CHECK_INT(mo_pretraining_forms(5, 50 * MANY, MO_DEFAULT_WORKSPACE, 3, &interruption.cancel,
                                 &interruption.done, set),
            MO_ERR_CANCELLED);
  CHECK(interruption.done > 0 && mo_form_set_count(set) == interruption.done);
  pthread_join(thread, NULL);
}

static const struct check_case cases[] = {
    {"a seed always means the same", frozen},
    {"the seeds of few-shot generations", frozen_seeds},
    {"a recomputed generation", made_again},
    {"given designs, then random ones", given},
    {"given designs that are excluded", given_and_excluded},
    {"the bodies of a pretraining", pretraining},
    {"the bodies of a pretraining, in another workspace", pretraining_elsewhere},
    {"the bodies of a pretraining, on any number of threads", pretraining_on_threads},
    {"the bodies of a pretraining, interrupted", pretraining_interrupted},
};
CHECK_MAIN(cases)
