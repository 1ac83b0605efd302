/* Racing: plans are sound, and a child that is cut short would not have survived. */
#include "../make.h"

#include <morpho/evolution.h>

enum { N = 24, ROUNDS = 4000 };

static double losses[2 * N][MO_RACE_ENVIRONMENTS_MAX];

static struct mo_campaign_settings settings_of(uint32_t n)
{
  struct mo_campaign_settings settings = mo_campaign_preset(MO_ZERO_SHOT, MO_PRESET_DEMO);
  settings.population = n;
  return settings;
}

/* Losses of one sort: spread over many sizes, with few values so that scores tie, or diverged here
 * and there. */
static double draw(struct mo_random *random, uint32_t sort)
{
  const double u = mo_random_uniform(random);
  if (sort % 3 == 1)
    return 0.125 * floor(4 * u);
  if (sort % 3 == 2 && u > 0.97)
    return INFINITY;
  return exp(8 * u - 6);
}

/* Returns the score of a child up to where it is cut, and the losses that it needed. */
static double race_child(const struct mo_race *race, const double *all, uint32_t *needed)
{
  double known[MO_RACE_ENVIRONMENTS_MAX];
  for (uint32_t k = 0; k < race->n_environments; k++)
    known[k] = NAN;
  *needed = 0;
  for (uint32_t wave = 0; wave < race->n_waves; wave++) {
    for (; *needed < race->ends[wave]; (*needed)++)
      known[race->order[*needed]] = all[race->order[*needed]];
    if (mo_race_score(known, race->n_environments) > race->bound)
      break;
  }
  return mo_race_score(known, race->n_environments);
}

static void same_survivors(void)
{
  uint64_t genotypes[2 * N * 3] = {0};
  uint64_t computed = 0, all = 0;
  for (uint32_t round = 0; round < ROUNDS; round++) {
    struct mo_random random;
    mo_random_init(&random, 3, MO_PURPOSE_CHECK, round, 0);
    const uint32_t e = 1 + mo_random_below(&random, MO_RACE_ENVIRONMENTS_MAX);
    const struct mo_campaign_settings settings = settings_of(N);
    struct mo_candidate full[2 * N], raced[2 * N];
    uint32_t survivors[2][N], n[2];
    double packed[N * MO_RACE_ENVIRONMENTS_MAX], scores[N];
    struct mo_race race;
    for (uint32_t i = 0; i < 2 * N; i++) {
      const double talent = i < N ? 1 : 1 + mo_random_uniform(&random);
      for (uint32_t k = 0; k < e; k++)
        losses[i][k] = talent * draw(&random, round);
      full[i] = (struct mo_candidate){mo_race_score(losses[i], e), i, i / N};
      if (i < N)
        scores[i] = full[i].score;
      for (uint32_t k = 0; k < e && i < N; k++)
        packed[i * e + k] = losses[i][k];
    }
    mo_race_plan(&settings, packed, scores, N, e, &race);
    for (uint32_t i = 0; i < 2 * N; i++) {
      uint32_t needed = e;
      raced[i] = full[i];
      if (i >= N)
        raced[i].score = race_child(&race, losses[i], &needed);
      CHECK(raced[i].score <= full[i].score);
      computed += i >= N ? needed : 0;
      all += i >= N ? e : 0;
    }
    CHECK_OK(mo_select(&settings, 1, genotypes, full, 2 * N, survivors[0], &n[0]));
    CHECK_OK(mo_select(&settings, 1, genotypes, raced, 2 * N, survivors[1], &n[1]));
    CHECK(n[0] == n[1] && memcmp(survivors[0], survivors[1], n[0] * sizeof(**survivors)) == 0);
    for (uint32_t i = 0; i < n[0]; i++)
      CHECK(raced[survivors[0][i]].score == full[survivors[0][i]].score);
  }
  printf("# %.3f of the rollouts of children\n", (double)computed / (double)all);
  CHECK(computed < all);
}

static void plans(void)
{
  for (uint32_t e = 1; e <= MO_RACE_ENVIRONMENTS_MAX; e++) {
    const struct mo_campaign_settings settings = settings_of(2);
    bool seen[MO_RACE_ENVIRONMENTS_MAX] = {false};
    double two[2 * MO_RACE_ENVIRONMENTS_MAX];
    struct mo_race race;
    for (uint32_t k = 0; k < e; k++) { /* the spread rises with k */
      two[k] = 1;
      two[e + k] = 1 + k;
    }
    mo_race_plan(&settings, two, (const double[]){1, 7}, 2, e, &race);
    CHECK(race.bound == 7 && race.n_environments == e);
    for (uint32_t i = 0; i < e; i++) {
      CHECK_INT(race.order[i], e - 1 - i);
      seen[race.order[i]] = true;
    }
    for (uint32_t k = 0; k < e; k++)
      CHECK(seen[k]);
    for (uint32_t w = 1; w < race.n_waves; w++)
      CHECK(race.ends[w] > race.ends[w - 1] + 1);
    CHECK_INT(race.ends[race.n_waves - 1], e);
  }
}

/* Where nothing can be proved, every child is scored in one wave. */
static void without_a_bound(void)
{
  struct mo_campaign_settings settings = settings_of(3);
  const double two[4] = {1, 2, 3, 4};
  struct mo_race race;
  mo_race_plan(&settings, two, (const double[]){1, 2}, 2, 2, &race);
  CHECK(race.bound == INFINITY && race.n_waves == 1 && race.ends[0] == 2);
  settings.population = 2;
  mo_race_plan(&settings, two, (const double[]){1, INFINITY}, 2, 2, &race);
  CHECK(race.bound == INFINITY && race.n_waves == 1);
  CHECK(mo_race_is_possible(&settings));
  for (int kind = MO_SELECT_TOURNAMENT; mo_selection_words[kind] != NULL; kind++) {
    settings.selection.kind = (enum mo_selection_kind)kind;
    CHECK(!mo_race_is_possible(&settings));
  }
  settings = mo_campaign_preset(MO_STUDY, MO_PRESET_DEMO);
  CHECK(!mo_race_is_possible(&settings));
  settings = settings_of(2);
  settings.racing = MO_RACING_OFF;
  CHECK(!mo_race_is_possible(&settings));
}

/* Losses that are not known neither lead the order nor poison it. */
static void unknown_losses(void)
{
  const struct mo_campaign_settings settings = settings_of(2);
  const double two[8] = {1, NAN, 3, INFINITY, 1, NAN, 7, 5};
  struct mo_race race;
  mo_race_plan(&settings, two, (const double[]){1, 2}, 2, 4, &race);
  CHECK_INT(race.order[0], 2);
  CHECK_INT(race.n_waves, 2);
}

static const struct check_case cases[] = {
    {"the same survivors", same_survivors},
    {"plans", plans},
    {"without a bound", without_a_bound},
    {"unknown losses", unknown_losses},
};
CHECK_MAIN(cases)
