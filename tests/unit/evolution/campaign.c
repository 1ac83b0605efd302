/* campaign.c: whole campaigns: the same bits for the same settings, whatever was computed before
 * and however often a generation is made again; what is given in the beginning; what was seen. */
#include "fixture.h"

#include <pthread.h>
#include <sched.h>

static uint64_t fnv(uint64_t hash, const void *bytes, size_t n)
{
  const uint8_t *at = bytes;
  for (size_t i = 0; i < n; i++)
    hash = (hash ^ at[i]) * UINT64_C(1099511628211);
  return hash;
}

/* Every child with its birth, and every population, of `generations`. */
static uint64_t hash_of(const struct mo_campaign_settings *settings, int generations)
{
  uint64_t hash = UINT64_C(14695981039346656037);
  struct made_up_campaign campaign;
  if (campaign_start(&campaign, settings, NULL) != MO_OK)
    generations = 0;
  for (int g = 0; g < generations; g++) {
    if (campaign_vary(&campaign) != MO_OK)
      break;
    for (uint32_t i = 0; i < campaign.n_children; i++) {
      const struct mo_birth *birth = &campaign.births[i];
      const uint32_t fields[] = {(uint32_t)birth->op, birth->parents[0], birth->parents[1],
                                 birth->attempts};
      hash = fnv(hash, fields, sizeof(fields));
    }
    hash = fnv(hash, campaign.genotypes + (size_t)campaign.words * campaign.n,
               (size_t)campaign.words * campaign.n_children * sizeof(uint64_t));
    if (campaign_select(&campaign) != MO_OK)
      break;
    for (uint32_t i = 0; i < campaign.n; i++)
      hash = fnv(hash, &campaign.candidates[i].number, sizeof(uint64_t));
  }
  campaign_free(&campaign);
  return hash;
}

/* A seed always means the same campaign: a change of these numbers breaks the promise of every
 * stored one. */
static void frozen(void)
{
  static const uint64_t expected[] = {0xf8335799e4385b08, 0x1cb3583196a004d1, 0x1be14bcdd46d7c5e,
                                      0xa2e254174761a693};
  for (int kind = 0; kind < 4; kind++) {
    struct mo_campaign_settings settings = small_campaign(42, 64);
    settings.selection.kind = (enum mo_selection_kind)kind;
    settings.selection.age_gap = 1;
    const uint64_t hash = hash_of(&settings, 12);
    if (hash != expected[kind]) {
      printf("# %s: 0x%016llx\n", mo_selection_name(settings.selection.kind),
             (unsigned long long)hash);
      CHECK(0);
    }
    CHECK(hash_of(&settings, 12) == hash);
    settings.seed = 43;
    CHECK(hash_of(&settings, 12) != hash);
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

/* A generation is made again from the population and what was seen before it, and comes out the
 * same. */
static void made_again(void)
{
  for (int kind = 0; kind < 4; kind++) {
    struct mo_campaign_settings settings = small_campaign(7, 48);
    struct made_up_campaign campaign;
    uint64_t *born = calloc(48 * 20 * W, sizeof(*born)); /* every design, in order */
    uint64_t *children = calloc(48 * W, sizeof(*children));
    struct mo_birth births[48];
    size_t n_born = 48;
    settings.selection.kind = (enum mo_selection_kind)kind;
    REQUIRE(born != NULL && children != NULL &&
            campaign_start(&campaign, &settings, NULL) == MO_OK);
    memcpy(born, campaign.genotypes, 48 * W * sizeof(*born));
    for (uint32_t g = 1; g < 20; g++) {
      struct mo_seen *seen = NULL;
      struct mo_variation_counts counts;
      uint32_t n = 0;
      /* First with a set of its own, made of all designs so far, in another order. */
      REQUIRE(mo_seen_create(settings.workspace, NULL, &seen) == MO_OK);
      for (size_t i = n_born; i-- > 0;)
        REQUIRE(mo_seen_add(seen, born + W * i) == 1);
      REQUIRE(mo_variation(&settings, g, campaign.genotypes, campaign.n, seen, children, births, &n,
                           &counts, NULL) == MO_OK);
      mo_seen_free(seen);
      REQUIRE(campaign_vary(&campaign) == MO_OK);
      CHECK_INT(n, campaign.n_children);
      CHECK(memcmp(children, campaign.genotypes + (size_t)W * campaign.n,
                   W * n * sizeof(*children)) == 0);
      for (uint32_t i = 0; i < n; i++)
        CHECK(births[i].op == campaign.births[i].op &&
              births[i].attempts == campaign.births[i].attempts &&
              births[i].parents[0] == campaign.births[i].parents[0] &&
              births[i].parents[1] == campaign.births[i].parents[1]);
      CHECK(memcmp(&counts, &campaign.counts, sizeof(counts)) == 0);
      memcpy(born + W * n_born, children, W * n * sizeof(*children));
      n_born += n;
      REQUIRE(campaign_select(&campaign) == MO_OK);
    }
    campaign_free(&campaign);
    free(children);
    free(born);
  }
}

/* ---- the beginning ---- */

static void given(void)
{
  const struct mo_campaign_settings settings = small_campaign(3, 20);
  uint64_t alone[20 * W], genotypes[20 * W] = {0};
  struct mo_seen *seen = NULL;
  uint32_t n = 0, fault = 99;
  REQUIRE(mo_seen_create(settings.workspace, NULL, &seen) == MO_OK);
  REQUIRE(mo_population_initial(&settings, seen, alone, 0, &n, NULL, NULL) == MO_OK && n == 20);
  CHECK_INT(mo_seen_count(seen), 20);
  mo_seen_free(seen);

  /* Two are given, one of which the stream would have drawn third: it is left out there. */
  for (int i = 0; i < W; i++)
    genotypes[i] = i == 0;
  mo_genotype_place(settings.workspace, genotypes);
  memcpy(genotypes + W, alone + 2 * W, W * sizeof(uint64_t));
  REQUIRE(mo_seen_create(settings.workspace, NULL, &seen) == MO_OK);
  REQUIRE(mo_population_initial(&settings, seen, genotypes, 2, &n, &fault, NULL) == MO_OK &&
          n == 20);
  CHECK(memcmp(genotypes + W, alone + 2 * W, W * sizeof(uint64_t)) == 0);
  CHECK(memcmp(genotypes + 2 * W, alone, 2 * W * sizeof(uint64_t)) == 0);
  CHECK(memcmp(genotypes + 4 * W, alone + 3 * W, W * sizeof(uint64_t)) == 0);
  CHECK(mo_seen_count(seen) == 20 && mo_seen_add(seen, genotypes) == 0 && fault == 99);
  mo_seen_free(seen);

  /* Twice one form, though mirrored. */
  uint64_t mirrored[W];
  for (unsigned k = 1; k < 8; k++)
    if (mo_genotype_image(settings.workspace, alone + 2 * W, k, mirrored) == MO_OK) {
      mo_genotype_place(settings.workspace, mirrored);
      memcpy(genotypes + 2 * W, mirrored, sizeof(mirrored));
    }
  REQUIRE(mo_seen_create(settings.workspace, NULL, &seen) == MO_OK);
  n = 55;
  CHECK_INT(mo_population_initial(&settings, seen, genotypes, 3, &n, &fault, NULL),
            MO_ERR_DUPLICATE);
  CHECK(fault == 2 && n == 55);
  CHECK_INT(mo_population_initial(&settings, seen, genotypes, 21, &n, &fault, NULL), MO_ERR_RANGE);
  mo_seen_free(seen);
}

/* A given design may be one of those that are excluded; a random one may not. */
static void given_and_excluded(void)
{
  const struct mo_campaign_settings settings = small_campaign(3, 10);
  struct mo_form_set *excluded = NULL;
  struct mo_seen *seen = NULL;
  uint64_t genotypes[10 * W], form[W];
  uint32_t n = 0;
  REQUIRE(mo_seen_create(settings.workspace, NULL, &seen) == MO_OK);
  REQUIRE(mo_population_initial(&settings, seen, genotypes, 0, &n, NULL, NULL) == MO_OK);
  mo_seen_free(seen);
  REQUIRE(mo_form_set_create(settings.workspace, &excluded) == MO_OK);
  for (int i = 0; i < 2; i++) {
    mo_genotype_canonical(settings.workspace, genotypes + (size_t)W * i, form);
    REQUIRE(mo_form_set_add(excluded, form) == 1);
  }
  uint64_t again[10 * W];
  memcpy(again, genotypes, W * sizeof(uint64_t));
  REQUIRE(mo_seen_create(settings.workspace, excluded, &seen) == MO_OK);
  CHECK_INT(mo_seen_add(seen, genotypes), 0);
  CHECK_INT(mo_seen_add(seen, genotypes + W), 0);
  CHECK_INT(mo_seen_count(seen), 0);
  REQUIRE(mo_population_initial(&settings, seen, again, 1, &n, NULL, NULL) == MO_OK && n == 10);
  CHECK(memcmp(again + W, genotypes + 2 * W, 8 * W * sizeof(uint64_t)) == 0);
  const uint64_t nothing[W] = {0};
  CHECK_INT(mo_seen_add(seen, nothing), MO_ERR_EMPTY);
  mo_seen_free(seen);
  mo_form_set_free(excluded);
  seen = NULL;
  CHECK(mo_seen_create((struct mo_workspace){0, 1, 1}, NULL, &seen) == MO_ERR_RANGE &&
        seen == NULL);
  mo_seen_free(NULL);
}

/* ---- bodies of a pretraining ---- */

#define BATCH 300
#define STEPS 4

/* The next body of a stream that is not held out, and its form. */
static int next_body(struct mo_body_stream *stream, uint64_t body[W], uint64_t form[W])
{
  int r;
  do {
    r = mo_body_stream_next(stream, body);
    mo_genotype_canonical(MO_DEFAULT_WORKSPACE, body, form);
  } while (r == MO_OK && mo_held_out_form(form));
  return r;
}

/* What a real pretraining learns from in its first steps, and nothing else. */
static void pretraining(void)
{
  struct mo_training_settings settings = mo_training_defaults(MO_TRAINING_PRETRAIN);
  struct mo_training *training = NULL;
  struct mo_body_stream *stream = NULL;
  struct mo_lattice *lattice = NULL;
  struct mo_form_set *set = NULL;
  static struct mo_outcome outcomes[BATCH];
  const struct mo_gradient_counts counts = {0};
  volatile uint64_t done = 0;
  settings.seed = 11;
  settings.n_steps = STEPS + 1;
  settings.batch = BATCH;
  REQUIRE(mo_form_set_create(MO_DEFAULT_WORKSPACE, &set) == MO_OK);
  CHECK_INT(mo_pretraining_forms(11, STEPS * BATCH, MO_DEFAULT_WORKSPACE, 1, NULL, &done, set),
            MO_OK);
  CHECK(done == STEPS * BATCH && mo_form_set_count(set) == STEPS * BATCH);
  REQUIRE(mo_lattice_create(MO_DEFAULT_WORKSPACE, &lattice) == MO_OK);
  REQUIRE(mo_body_stream_create(MO_DEFAULT_WORKSPACE, 11, &stream) == MO_OK);
  REQUIRE(mo_training_create(&settings, NULL, NULL, 0, &training, NULL) == MO_OK);
  double *gradient = calloc(mo_training_controller(training)->n_parameters, sizeof(*gradient));
  REQUIRE(gradient != NULL);
  for (int step = 0; step <= STEPS; step++) {
    const struct mo_robot *robots = NULL;
    REQUIRE(mo_training_draw(training, NULL, NULL, &robots) == MO_OK);
    for (int i = 0; i < BATCH; i++) {
      uint64_t genotype[W], form[W];
      struct mo_body *body = NULL;
      REQUIRE(next_body(stream, genotype, form) == MO_OK &&
              mo_body_create(lattice, genotype, &body) == MO_OK);
      CHECK(body->n_springs == robots[i].body->n_springs &&
            body->n_voxels == robots[i].body->n_voxels &&
            memcmp(body->spring_lattice, robots[i].body->spring_lattice,
                   body->n_springs * sizeof(uint32_t)) == 0);
      CHECK_INT(mo_form_set_has(set, form), step < STEPS);
      mo_body_free(body);
    }
    REQUIRE(mo_training_apply(training, gradient, outcomes, &counts, NULL) == MO_OK);
  }
  free(gradient);
  mo_training_free(training);
  mo_body_stream_free(stream);
  mo_lattice_free(lattice);
  mo_form_set_free(set);
}

/* In a smaller workspace: those that fit it, as they are there. A set that holds something gets the
 * same forms. */
static void pretraining_elsewhere(void)
{
  const struct mo_workspace small = {5, 4, 2};
  struct mo_body_stream *stream = NULL;
  struct mo_form_set *set = NULL, *expected = NULL, *again = NULL;
  const volatile int cancel = 1;
  REQUIRE(mo_form_set_create(small, &set) == MO_OK &&
          mo_form_set_create(small, &expected) == MO_OK &&
          mo_form_set_create(MO_DEFAULT_WORKSPACE, &again) == MO_OK &&
          mo_body_stream_create(MO_DEFAULT_WORKSPACE, 11, &stream) == MO_OK);
  CHECK_INT(mo_pretraining_forms(11, 1200, small, 1, NULL, NULL, set), MO_OK);
  for (int i = 0; i < 1200; i++) {
    uint64_t body[W], form[W], moved, moved_form;
    REQUIRE(next_body(stream, body, form) == MO_OK);
    const struct plain_form plain = plain_canonical(MO_DEFAULT_WORKSPACE, body);
    const bool upright = plain.side[0] <= 5 && plain.side[1] <= 4,
               fits_turned = plain.side[1] <= 5 && plain.side[0] <= 4;
    const bool fits = plain.side[2] <= 2 && (upright || fits_turned);
    CHECK_INT(mo_genotype_move(MO_DEFAULT_WORKSPACE, body, small, &moved),
              fits ? MO_OK : MO_ERR_RANGE);
    if (!fits)
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
  mo_body_stream_free(stream);
  mo_form_set_free(set);
  mo_form_set_free(expected);
  mo_form_set_free(again);
}

/* The forms of a pretraining's first n bodies, of those that fit the workspace, one after the
 * other. */
static int plain_forms(uint64_t seed, int n, struct mo_workspace workspace, struct mo_form_set *set)
{
  struct mo_body_stream *stream = NULL;
  uint64_t body[W], form[W], moved[W];
  int r = mo_body_stream_create(MO_DEFAULT_WORKSPACE, seed, &stream);
  for (int i = 0; i < n && r >= 0; i++) {
    r = next_body(stream, body, form);
    if (r == MO_OK && mo_genotype_move(MO_DEFAULT_WORKSPACE, body, workspace, moved) == MO_OK) {
      mo_genotype_canonical(workspace, moved, form);
      r = mo_form_set_add(set, form);
    }
  }
  mo_body_stream_free(stream);
  return r < 0 ? r : MO_OK;
}

/* How many of the forms of a pretraining's first n bodies, of those that fit the workspace, the set
 * has not. */
static int missing_forms(uint64_t seed, int n, struct mo_workspace workspace,
                         const struct mo_form_set *set)
{
  struct mo_body_stream *stream = NULL;
  uint64_t body[W], form[W], moved[W];
  int missing = mo_body_stream_create(MO_DEFAULT_WORKSPACE, seed, &stream) != MO_OK;
  for (int i = 0; i < n && missing == 0; i++) {
    missing = next_body(stream, body, form) != MO_OK;
    if (mo_genotype_move(MO_DEFAULT_WORKSPACE, body, workspace, moved) == MO_OK) {
      mo_genotype_canonical(workspace, moved, form);
      missing += !mo_form_set_has(set, form);
    }
  }
  mo_body_stream_free(stream);
  return missing;
}

#define MANY 60000

static void pretraining_on_threads(void)
{
  const struct mo_workspace workspaces[] = {MO_DEFAULT_WORKSPACE, {5, 4, 2}};
  const uint32_t threads[] = {1, 2, 7};
  for (int w = 0; w < 2; w++) {
    struct mo_form_set *expected = NULL;
    REQUIRE(mo_form_set_create(workspaces[w], &expected) == MO_OK);
    REQUIRE(plain_forms(5, MANY, workspaces[w], expected) == MO_OK);
    for (int t = 0; t < 3; t++) {
      struct mo_form_set *set = NULL;
      volatile uint64_t done = 0;
      REQUIRE(mo_form_set_create(workspaces[w], &set) == MO_OK);
      CHECK_INT(mo_pretraining_forms(5, MANY, workspaces[w], threads[t], NULL, &done, set), MO_OK);
      CHECK_INT(done, MANY);
      CHECK_INT(mo_form_set_count(set), mo_form_set_count(expected));
      CHECK_INT(mo_form_set_bytes(set), mo_form_set_bytes(expected));
      CHECK_INT(missing_forms(5, MANY, workspaces[w], set), 0);
      mo_form_set_free(set);
    }
    mo_form_set_free(expected);
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
  struct mo_form_set *set = NULL;
  pthread_t thread;
  REQUIRE(mo_form_set_create(MO_DEFAULT_WORKSPACE, &set) == MO_OK);
  REQUIRE(pthread_create(&thread, NULL, interrupt, &interruption) == 0);
  CHECK_INT(mo_pretraining_forms(5, 50 * MANY, MO_DEFAULT_WORKSPACE, 3, &interruption.cancel,
                                 &interruption.done, set),
            MO_ERR_CANCELLED);
  CHECK(interruption.done > 0 && mo_form_set_count(set) == interruption.done);
  pthread_join(thread, NULL);
  mo_form_set_free(set);
}

static const struct check_case cases[] = {
    {"a seed always means the same", frozen},
    {"the seeds of few-shot generations, too", frozen_seeds},
    {"a generation made again from the population and what was seen", made_again},
    {"given designs, then random ones", given},
    {"given designs that are excluded", given_and_excluded},
    {"the bodies of a pretraining", pretraining},
    {"the bodies of a pretraining, elsewhere", pretraining_elsewhere},
    {"the bodies of a pretraining, on any number of threads", pretraining_on_threads},
    {"the bodies of a pretraining, interrupted", pretraining_interrupted},
};
CHECK_MAIN(cases)
