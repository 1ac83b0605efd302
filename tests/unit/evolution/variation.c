/* variation.c: each rule for making children, on many seeds. */
#include "fixture.h"

#define SEEDS 40

static bool is_placed(struct mo_workspace w, const uint64_t *bits)
{
  const uint32_t words = mo_workspace_words(w), voxels = mo_workspace_voxels(w);
  uint64_t again[16];
  if (words > 16 || (voxels % 64 != 0 && bits[words - 1] >> voxels % 64 != 0))
    return false;
  memcpy(again, bits, words * sizeof(uint64_t));
  mo_genotype_place(w, again);
  return SAME(again, bits, words);
}

/* ---- 25 % mutate, 75 % recombine ---- */

static void check_births(const struct made_up_campaign *campaign)
{
  const struct mo_campaign_settings *s = &campaign->settings;
  const uint32_t n = campaign->n, mutants = (uint32_t)floor(s->mutation_share * n + 0.5);
  uint8_t *mutates = make_zeros(n, 1);
  uint64_t attempts = 0, pairs = 0;
  CHECK_INT(campaign->n_children, s->population);
  CHECK_INT(campaign->counts.mutants - campaign->counts.fallbacks, mutants);
  CHECK_INT(campaign->counts.recombinants + campaign->counts.fallbacks, s->population - mutants);
  CHECK(!campaign->counts.exhausted);
  CHECK(campaign->counts.fallbacks == 0 ||
        n - mutants < 20); /* few pairs of small bodies may produce nothing new */
  for (uint32_t i = 0; i < campaign->n_children; i++) {
    const struct mo_birth *birth = &campaign->births[i];
    CHECK(birth->attempts >= 1);
    REQUIRE(birth->parents[0] < n);
    if (i < mutants) { /* number of each member within its group */
      CHECK(birth->op == MO_BORN_MUTATION && birth->parents[1] == MO_NO_PARENT);
      CHECK(!mutates[birth->parents[0]]);
      mutates[birth->parents[0]] = 1;
      attempts += birth->attempts;
    } else if (i >= mutants + campaign->counts.recombinants) {
      CHECK(birth->op == MO_BORN_MUTATION && birth->parents[1] == MO_NO_PARENT);
      CHECK(n - mutants < 2 || !mutates[birth->parents[0]]);
      attempts += birth->attempts;
    } else {
      REQUIRE(birth->parents[1] < n);
      CHECK(birth->op == MO_BORN_CROSSOVER && birth->parents[0] != birth->parents[1]);
      if (n - mutants >= 2)
        CHECK(!mutates[birth->parents[0]] && !mutates[birth->parents[1]]);
      pairs += birth->attempts;
    }
  }
  CHECK_INT(campaign->counts.mutation_attempts, attempts);
  CHECK_INT(campaign->counts.crossover_attempts,
            pairs + (campaign->counts.fallbacks > 0 ? 1000 : 0));
}

static void split(void)
{
  static const double shares[] = {0.0, 0.1, 0.25, 0.333, 0.5, 0.9, 1.0};
  static const uint32_t populations[] = {6, 7, 10, 33, 64, 90, 201};
  for (size_t k = 0; k < COUNT(populations); k++)
    for (size_t j = 0; j < COUNT(shares); j++) {
      struct mo_campaign_settings settings = small_campaign(k + 1, populations[k]);
      settings.mutation_share = shares[j];
      struct made_up_campaign *campaign = make_campaign(&settings, NULL);
      campaign_vary(campaign);
      check_births(campaign);
    }
}

/* Each member mutates in a quarter of the generations, independently of its neighbors. */
static void groups_are_random(void)
{
  const struct mo_campaign_settings settings = small_campaign(5, 64);
  uint32_t times[64] = {0}, together = 0;
  struct made_up_campaign *campaign = make_campaign(&settings, NULL);
  for (int g = 0; g < 200; g++) {
    uint8_t mutates[64] = {0};
    campaign_vary(campaign);
    for (uint32_t i = 0; i < 16; i++) {
      times[campaign->births[i].parents[0]]++;
      mutates[campaign->births[i].parents[0]] = 1;
    }
    for (int i = 1; i < 64; i++)
      together += mutates[i] & mutates[i - 1];
  }
  for (int i = 0; i < 64; i++)
    CHECK_NEAR(times[i], 50, 4.5 * sqrt(200 * 0.25 * 0.75));
  CHECK_NEAR(together, 200 * 63 * (16.0 / 64) * (15.0 / 63), 5 * sqrt(200 * 63 * 0.06));
}

/* All pairs of recombining members are equally likely. */
static void pairs_are_random(void)
{
  struct mo_campaign_settings settings = small_campaign(6, 5);
  uint32_t times[5][5] = {{0}}, all = 0;
  settings.mutation_share = 0.0;
  for (uint64_t seed = 0; seed < 1500; seed++) {
    settings.seed = seed;
    struct made_up_campaign *campaign = make_campaign(&settings, NULL);
    campaign_vary(campaign);
    if (campaign->births[0].attempts == 1) {
      times[campaign->births[0].parents[0]][campaign->births[0].parents[1]]++;
      all++;
    }
  }
  for (int a = 0; a < 5; a++)
    for (int b = 0; b < 5; b++)
      CHECK_NEAR(times[a][b], a == b ? 0 : all / 20.0, 4.5 * sqrt(all / 20.0));
}

/* ---- children are valid bodies, and none occurs twice ---- */

static void children(void)
{
  static const struct mo_workspace workspaces[] = {{6, 6, 4}, {6, 6, 4}, {3, 3, 3},
                                                   {6, 5, 1}, {6, 6, 2}, {12, 10, 6}};
  for (size_t k = 0; k < COUNT(workspaces); k++)
    for (uint64_t seed = 1; seed <= 4; seed++) {
      struct mo_campaign_settings settings = small_campaign(seed, 32);
      settings.workspace = workspaces[k];
      struct made_up_campaign *campaign = make_campaign(&settings, NULL);
      for (int g = 0; g < 12; g++) {
        campaign_vary(campaign);
        CHECK_INT(campaign->n_children, 32);
        for (uint32_t i = 0; i < campaign->n + campaign->n_children; i++) {
          const uint64_t *bits = genotype_of(campaign, i);
          CHECK_INT(mo_genotype_is_contiguous(settings.workspace, bits),
                    1); /* also 0 for an empty one */
          CHECK(is_placed(settings.workspace, bits));
        }
        campaign_select(campaign);
      }
    }
}

/* A recombinant is the result of its two parents; a mutant of one attempt differs from its parent
 * by a few flips. */
static void inheritance(void)
{
  const struct mo_campaign_settings settings = small_campaign(9, 64);
  struct made_up_campaign *campaign = make_campaign(&settings, NULL);
  for (int g = 0; g < 20; g++) {
    campaign_vary(campaign);
    for (uint32_t i = 0; i < campaign->n_children; i++) {
      const struct mo_birth *birth = &campaign->births[i];
      const uint64_t *child = genotype_of(campaign, campaign->n + i);
      uint64_t expected[W];
      if (birth->op != MO_BORN_CROSSOVER)
        continue;
      CHECK_INT(mo_genotype_crossover(MO_DEFAULT_WORKSPACE,
                                      genotype_of(campaign, birth->parents[0]),
                                      genotype_of(campaign, birth->parents[1]), expected),
                MO_OK);
      CHECK(SAME(child, expected, W));
    }
    campaign_select(campaign);
  }
}

static void uniqueness(void)
{
  for (uint64_t seed = 1; seed <= 3; seed++) {
    const struct mo_campaign_settings settings = small_campaign(seed, 64);
    struct id_list list = {0};
    struct mo_form_set *excluded = make_form_set(MO_DEFAULT_WORKSPACE);
    /* Excluded: 500 bodies of the stream that the initial population comes from, so that some draws
     * must be skipped. Later also the first children of the same campaign without exclusion, so
     * that variation must skip some, too. */
    for (uint32_t i = 0; i < 500; i++) {
      struct mo_random random;
      uint64_t body[W], form[W];
      mo_random_init(&random, seed, MO_PURPOSE_POPULATION, 0, i / 2);
      REQUIRE(mo_genotype_random(MO_DEFAULT_WORKSPACE, &random, body) == MO_OK);
      mo_genotype_canonical(MO_DEFAULT_WORKSPACE, body, form);
      if (mo_form_set_add(excluded, form) == 1)
        id_add(&list, MO_DEFAULT_WORKSPACE, body);
    }
    struct made_up_campaign *campaign = make_campaign(&settings, excluded);
    campaign_vary(campaign);
    for (uint32_t i = 0; i < campaign->n_children; i++) {
      uint64_t form[W];
      const uint64_t *child = genotype_of(campaign, campaign->n + i);
      mo_genotype_canonical(MO_DEFAULT_WORKSPACE, child, form);
      CHECK_INT(mo_form_set_add(excluded, form), 1);
      id_add(&list, MO_DEFAULT_WORKSPACE, child);
    }
    const uint64_t n_excluded = mo_form_set_count(excluded);
    campaign = make_campaign(&settings, excluded);
    for (uint32_t i = 0; i < campaign->n; i++)
      id_add(&list, MO_DEFAULT_WORKSPACE, genotype_of(campaign, i));
    for (int g = 0; g < 40; g++) {
      campaign_vary(campaign);
      CHECK_INT(campaign->n_children, 64);
      for (uint32_t i = 0; i < campaign->n_children; i++)
        id_add(&list, MO_DEFAULT_WORKSPACE, genotype_of(campaign, campaign->n + i));
      campaign_select(campaign);
    }
    CHECK_INT(list.n, n_excluded + 64 * 41);
    CHECK_INT(id_distinct(&list), list.n);
    CHECK_INT(mo_seen_count(campaign->seen), 64 * 41);
  }
}

/* ---- the mutation rate ---- */

static const uint64_t full[W] = {UINT64_MAX, UINT64_MAX, 0xffff};

struct flips {
  uint32_t by_attempts[8]; /* children that were new at their first, second, … attempt */
  double sum[8];           /* flips of those children */
  uint32_t first[16];      /* children of the first attempt by flips */
};

/* Mutates the full block `times` times. A few flips remove exactly as many voxels from the full
 * block, so they can be counted. */
static void mutate_full(struct mo_campaign_settings settings, uint32_t times, struct flips *flips)
{
  settings.population = 1;
  settings.mutation_share = 1.0;
  *flips = (struct flips){{0}};
  for (uint32_t i = 0; i < times; i++) {
    struct mo_seen *seen = NULL;
    struct mo_birth birth;
    struct mo_variation_counts counts;
    uint64_t child[W];
    uint32_t n = 0;
    settings.seed = i;
    REQUIRE(mo_seen_create(settings.workspace, NULL, &seen) == MO_OK &&
            mo_seen_add(seen, full) == 1);
    REQUIRE(mo_variation(&settings, 1, full, 1, seen, child, &birth, &n, &counts, NULL) == MO_OK);
    REQUIRE(n == 1 && birth.attempts >= 1);
    const uint32_t flipped = hamming(full, child);
    if (birth.attempts <= 8) {
      flips->by_attempts[birth.attempts - 1]++;
      flips->sum[birth.attempts - 1] += flipped;
    }
    if (birth.attempts == 1)
      flips->first[flipped < 15 ? flipped : 15]++;
    mo_seen_free(seen);
  }
}

static double binomial(uint32_t k, double rate)
{
  return exp(lgamma(145) - lgamma(k + 1) - lgamma(145 - k) + k * log(rate) +
             (144 - k) * log1p(-rate));
}

static void rate_of_flips(void)
{
  const uint32_t times = 20000;
  struct flips flips;
  mutate_full(small_campaign(1, 1), times, &flips);
  const double none = binomial(0, 1.0 / 144);
  CHECK_NEAR(flips.by_attempts[0], times * (1 - none), 4.5 * sqrt(times * none * (1 - none)));
  for (uint32_t k = 0; k <= 7; k++) { /* none: the child equals its parent, which was seen before */
    const double expected = k == 0 ? 0.0 : times * binomial(k, 1.0 / 144);
    CHECK_NEAR(flips.first[k], expected, 4.5 * sqrt(expected) + 1e-9);
  }
}

static void escalation(void)
{
  struct mo_campaign_settings settings = small_campaign(1, 1);
  static const double growths[] = {1.0, 1.025, 1.6};
  for (int g = 0; g < 3; g++) {
    struct flips flips;
    double rate = 0.002, left = 12000;
    settings.mutation_rate = rate;
    settings.mutation_growth = growths[g];
    mutate_full(settings, 12000, &flips);
    for (int i = 0; i < 8 && left > 500; i++) {
      const double none = binomial(0, rate), born = left * (1 - none);
      const double mean = 144 * rate / (1 - none); /* of those that flip at least one */
      CHECK_NEAR(flips.by_attempts[i], born, 4.5 * sqrt(12000 * 0.25) + 1);
      CHECK_NEAR(flips.sum[i] / flips.by_attempts[i], mean,
                 4.5 * sqrt(144 * rate / flips.by_attempts[i]));
      left -= flips.by_attempts[i];
      rate *= growths[g];
    }
  }
}

/* Whatever the growth, at most half of the voxels flip: for a body of one voxel whose only changes
 * were seen before. */
static void rate_has_an_end(void)
{
  struct mo_campaign_settings settings = small_campaign(3, 1);
  struct mo_seen *seen = make_seen(settings.workspace, NULL);
  struct mo_birth birth;
  struct mo_variation_counts counts;
  uint64_t child[W];
  double voxels = 0;
  settings.mutation_rate = 0.5;
  settings.mutation_growth = 2.0;
  settings.mutation_share = 1.0;
  for (uint32_t i = 0; i < 300; i++) {
    uint32_t n = 0;
    settings.seed = i;
    REQUIRE(mo_variation(&settings, 1, full, 1, seen, child, &birth, &n, &counts, NULL) == MO_OK &&
            n == 1);
    voxels += mo_genotype_count(settings.workspace, child);
  }
  CHECK(voxels / 300 > 60 && voxels / 300 < 74); /* largest components with half the voxels */

  /* In one voxel, a rate above 1/2 would empty it more and more often: all 2^16 attempts are made,
   * and none succeeds. */
  settings.workspace = (struct mo_workspace){1, 1, 1};
  const uint64_t one = 1;
  uint32_t n = 7;
  seen = make_seen(settings.workspace, NULL);
  REQUIRE(mo_seen_add(seen, &one) == 1);
  CHECK_INT(mo_variation(&settings, 1, &one, 1, seen, child, &birth, &n, &counts, NULL), MO_OK);
  CHECK(n == 0 && counts.exhausted && counts.mutation_attempts == 65536);
}

/* ---- when nothing new is found ---- */

static void fallback(void)
{
  for (uint64_t seed = 1; seed <= SEEDS; seed++) {
    struct mo_campaign_settings settings = small_campaign(seed, 20);
    settings.mutation_share = 0.0;
    struct made_up_campaign *campaign = make_campaign(&settings, NULL);
    memmove(campaign->genotypes + W, campaign->genotypes + (size_t)W * (1 + seed % 19),
            W * sizeof(uint64_t));
    campaign->n = 2; /* two parents: one pair, and at most one child */
    campaign_vary(campaign);
    CHECK_INT(campaign->n_children, 20);
    CHECK(campaign->counts.recombinants <= 1 && !campaign->counts.exhausted);
    CHECK_INT(campaign->counts.fallbacks, 20 - campaign->counts.recombinants);
    CHECK_INT(campaign->counts.mutants, campaign->counts.fallbacks);
    uint64_t pairs = 1000, attempts = 0;
    uint32_t of_first = 0;
    for (uint32_t i = 0; i < 20; i++) {
      const struct mo_birth *birth = &campaign->births[i];
      CHECK(birth->op ==
            (i < campaign->counts.recombinants ? MO_BORN_CROSSOVER : MO_BORN_MUTATION));
      *(i < campaign->counts.recombinants ? &pairs : &attempts) += birth->attempts;
      CHECK(birth->parents[0] < 2);
      of_first += birth->op == MO_BORN_MUTATION && birth->parents[0] == 0;
    }
    CHECK(of_first > 0 && of_first < campaign->counts.fallbacks);
    CHECK_INT(campaign->counts.crossover_attempts, pairs);
    CHECK_INT(campaign->counts.mutation_attempts, attempts);
  }
}

/* A single parent has no partner; without parents there are no children. */
static void few_parents(void)
{
  const struct mo_campaign_settings settings = small_campaign(8, 16);
  struct made_up_campaign *campaign = make_campaign(&settings, NULL);
  campaign->n = 1;
  campaign_vary(campaign);
  CHECK(campaign->n_children == 16 && campaign->counts.fallbacks == 16 &&
        campaign->counts.crossover_attempts == 0);
  campaign->n = 0;
  campaign_vary(campaign);
  CHECK(campaign->n_children == 0 && campaign->counts.exhausted);
  campaign->n = 3; /* one mutates; two form one pair */
  campaign_vary(campaign);
  CHECK(campaign->n_children == 16 && campaign->counts.mutants - campaign->counts.fallbacks == 1);
}

/* Counts every form of a workspace by trying all sets of voxels. */
static size_t count_forms(struct mo_workspace w)
{
  struct id_list list = {0};
  for (uint64_t bits = 1; bits >> mo_workspace_voxels(w) == 0; bits++)
    if (mo_genotype_is_contiguous(w, &bits) == 1)
      id_add(&list, w, &bits);
  return id_distinct(&list);
}

static void exhaustion(void)
{
  static const struct mo_workspace workspaces[] = {{1, 1, 1}, {2, 1, 1}, {2, 2, 1},
                                                   {1, 1, 3}, {2, 2, 2}, {3, 3, 1}};
  static const size_t known[] = {1, 2, 4, 3};
  for (size_t k = 0; k < COUNT(workspaces); k++)
    for (uint32_t population = 2; population <= 64; population *= 8) {
      const size_t forms = count_forms(workspaces[k]);
      struct mo_campaign_settings settings = small_campaign(1, population);
      size_t born;
      int generations = 0;
      settings.workspace = workspaces[k];
      CHECK(k > 3 || forms == known[k]);
      struct made_up_campaign *campaign = make_campaign(&settings, NULL);
      CHECK_INT(campaign->n, forms < population ? forms : population);
      born = campaign->n;
      do {
        campaign_vary(campaign);
        CHECK(campaign->counts.exhausted == (campaign->n_children < population));
        born += campaign->n_children;
        campaign_select(campaign);
      } while (!campaign->counts.exhausted && ++generations < 100);
      CHECK_INT(born, forms);
      campaign_vary(campaign);
      CHECK(campaign->n_children == 0 && campaign->counts.exhausted);
    }
}

/* Everything is excluded: there is no initial population, and no children of one. */
static void nothing_left(void)
{
  struct mo_campaign_settings settings = small_campaign(1, 8);
  settings.workspace = (struct mo_workspace){2, 1, 1};
  const uint64_t forms[] = {1, 3};
  struct mo_form_set *excluded = make_form_set(settings.workspace);
  CHECK(mo_form_set_add(excluded, &forms[0]) == 1 && mo_form_set_add(excluded, &forms[1]) == 1);
  struct made_up_campaign *campaign = make_campaign(&settings, excluded);
  CHECK_INT(campaign->n, 0);
}

static void cancelled(void)
{
  const struct mo_campaign_settings settings = small_campaign(8, 16);
  struct made_up_campaign *campaign = make_campaign(&settings, NULL);
  const volatile int cancel[] = {1, 0};
  uint32_t n = 77;
  for (int i = 0; i < 2; i++) {
    CHECK_INT(mo_variation(&settings, 1, campaign->genotypes, 16, campaign->seen,
                           genotype_of(campaign, campaign->n), campaign->births, &n,
                           &campaign->counts, &cancel[i]),
              cancel[i] ? MO_ERR_CANCELLED : MO_OK);
    CHECK_INT(n, cancel[i] ? 77 : 16);
  }
  CHECK_INT(mo_population_initial(&settings, campaign->seen, campaign->genotypes, 0, &n, NULL,
                                  &cancel[0]),
            MO_ERR_CANCELLED);
}

static const struct check_case cases[] = {
    {"the share that mutates, exactly; parents from one group or the other", split},
    {"groups are random", groups_are_random},
    {"pairs are random", pairs_are_random},
    {"children are valid and placed", children},
    {"recombinants are the result of their parents", inheritance},
    {"no duplicate and no excluded design", uniqueness},
    {"flips are binomial at one in the number of voxels", rate_of_flips},
    {"the rate grows with each attempt", escalation},
    {"the rate is at most one half", rate_has_an_end},
    {"mutants when pairs produce nothing new", fallback},
    {"zero, one and two parents that recombine", few_parents},
    {"small workspaces are explored completely, and end", exhaustion},
    {"nothing left at the start", nothing_left},
    {"cancelled", cancelled},
};
CHECK_MAIN(cases)
