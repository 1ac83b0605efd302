/* racing.c: plans are sound, and a child that is cut short would not have survived. */
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

/* Draws losses of one kind: of many magnitudes, with few distinct values so that scores tie, or
 * with a few divergences. */
static double draw(struct mo_random *random, uint32_t sort)
{
  const double u = mo_random_uniform(random);
  if (sort % 3 == 1)
    return 0.125 * floor(4 * u);
  if (sort % 3 == 2 && u > 0.97)
    return INFINITY;
  return exp(8 * u - 6);
}

/* Returns the score of a child up to the point where it is cut short, and the number of losses that
 * this took. The time that a race saves can be computed from these as well as from all losses. */
static double race_child(const struct mo_race *race, const double *all, uint32_t *needed)
{
  double known[MO_RACE_ENVIRONMENTS_MAX];
  uint32_t blocks = 0, whole = (race->n_environments + 15) / 16;
  for (uint32_t k = 0; k < race->n_environments; k++)
    known[k] = NAN;
  *needed = 0;
  for (uint32_t wave = 0; wave < race->n_waves; wave++) {
    const uint32_t first = *needed;
    for (; *needed < race->ends[wave]; (*needed)++)
      known[race->order[*needed]] = all[race->order[*needed]];
    blocks += (*needed - first + 15) / 16;
    if (mo_race_is_lost(race, known))
      break;
  }
  const int saved = (int)(race->n_environments + 2 * whole) - (int)(*needed + 2 * blocks);
  CHECK_INT(mo_race_saved(race, known, false), saved);
  CHECK_INT(mo_race_saved(race, all, false), saved);
  CHECK_INT(mo_race_saved(race, known, true), (int)(race->n_environments - *needed));
  return mo_aggregate_score(&race->aggregate, known, race->n_environments);
}

static void same_survivors_by(enum mo_aggregate_kind kind)
{
  uint64_t genotypes[2 * N * 3] = {0};
  uint64_t computed = 0, all = 0;
  for (uint32_t round = 0; round < ROUNDS; round++) {
    struct mo_random random;
    mo_random_init(&random, 3, MO_PURPOSE_CHECK, round, 0);
    const uint32_t e = 1 + mo_random_below(&random, MO_RACE_ENVIRONMENTS_MAX);
    struct mo_campaign_settings settings = settings_of(N);
    settings.aggregate = (struct mo_aggregate){kind, 0.1 * (round % 11), 0};
    struct mo_candidate full[2 * N], raced[2 * N];
    uint32_t survivors[2][N], n[2];
    double packed[N * MO_RACE_ENVIRONMENTS_MAX], scores[N];
    struct mo_race race;
    for (uint32_t i = 0; i < 2 * N; i++) {
      const double talent = i < N ? 1 : 1 + mo_random_uniform(&random);
      for (uint32_t k = 0; k < e; k++)
        losses[i][k] = talent * draw(&random, round);
      full[i] =
          (struct mo_candidate){mo_aggregate_score(&settings.aggregate, losses[i], e), i, i / N};
      if (i < N)
        scores[i] = full[i].score;
      for (uint32_t k = 0; k < e && i < N; k++)
        packed[i * e + k] = losses[i][k];
    }
    mo_race_plan(&settings, packed, scores, N, e, true, &race);
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
  printf("# %s: %.3f of the rollouts of children\n", mo_aggregate_words[kind],
         (double)computed / (double)all);
  CHECK(computed < all);
}

static void same_survivors(void)
{
  same_survivors_by(MO_AGGREGATE_MEAN);
  same_survivors_by(MO_AGGREGATE_QUANTILE);
  same_survivors_by(MO_AGGREGATE_CVAR);
}

static void plans(void)
{
  for (uint32_t e = 1; e <= MO_RACE_ENVIRONMENTS_MAX; e++) {
    const struct mo_campaign_settings settings = settings_of(2);
    bool seen[MO_RACE_ENVIRONMENTS_MAX] = {false};
    double two[2 * MO_RACE_ENVIRONMENTS_MAX];
    struct mo_race race;
    for (uint32_t k = 0; k < e; k++) { /* the spread grows with k */
      two[k] = 1;
      two[e + k] = 1 + k;
    }
    mo_race_plan(&settings, two, (const double[]){1, 7}, 2, e, true, &race);
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

/* If nothing can be proved, every child is scored in one wave. */
static void without_a_bound(void)
{
  struct mo_campaign_settings settings = settings_of(3);
  const double two[4] = {1, 2, 3, 4};
  struct mo_race race;
  mo_race_plan(&settings, two, (const double[]){1, 2}, 2, 2, true, &race);
  CHECK(race.bound == INFINITY && race.n_waves == 1 && race.ends[0] == 2);
  settings.population = 2;
  mo_race_plan(&settings, two, (const double[]){1, INFINITY}, 2, 2, true, &race);
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

/* Each wave after the first waits for the previous one, and costs a device as much time as 2000
 * rollouts; so does the first wave if it waits for parents. */
static void waits(void)
{
  const struct mo_campaign_settings settings = settings_of(2);
  const double none[2 * 30] = {0};
  struct mo_race race;
  mo_race_plan(&settings, none, (const double[]){0, 0}, 2, 30, true, &race);
  CHECK_INT(race.n_waves, 4);
  CHECK_INT(mo_race_lost(&race, true, false), 6000);
  CHECK_INT(mo_race_lost(&race, true, true), 8000);
  CHECK_INT(mo_race_lost(&race, false, true), 0);
}

/* A child that stored losses cut before a wave needs no rollouts of that wave. */
static void stored_losses(void)
{
  const struct mo_campaign_settings settings = settings_of(2);
  double none[2 * 10] = {0}, losses_of[10];
  struct mo_race race;
  mo_race_plan(&settings, none, (const double[]){0.1, 0.1}, 2, 10, true, &race);
  for (uint32_t k = 0; k < 10; k++)
    losses_of[k] = NAN;
  losses_of[race.order[9]] = 1.2;
  CHECK_INT(mo_race_saved(&race, losses_of, false), 12);
  losses_of[race.order[0]] = losses_of[race.order[1]] = 0;
  CHECK_INT(mo_race_saved(&race, losses_of, false), 8);
  CHECK_INT(mo_race_saved(&race, losses_of, true), 8);
}

/* Unknown losses (NaN) neither sort first nor spoil the order. */
static void unknown_losses(void)
{
  const struct mo_campaign_settings settings = settings_of(2);
  const double two[8] = {1, NAN, 3, INFINITY, 1, NAN, 7, 5};
  struct mo_race race;
  mo_race_plan(&settings, two, (const double[]){1, 2}, 2, 4, true, &race);
  CHECK_INT(race.order[0], 2);
  CHECK_INT(race.n_waves, 2);
}

/* ---- the best k designs ---- */

enum { DESIGNS = 3 * N };

/* The plain reference computes and sorts all losses. Designs with a score up to the k-th best have
 * exactly that score, to the last bit; the others have lower bounds above it. Returns the number of
 * losses that the race computed. */
static uint64_t race_best(const double (*all)[MO_RACE_ENVIRONMENTS_MAX], uint32_t n, uint32_t e,
                          uint32_t k)
{
  const uint64_t whole = UINT64_MAX >> (64 - e);
  struct mo_best *best;
  double sorted[DESIGNS], scores[DESIGNS];
  uint64_t before[DESIGNS] = {0}, n_asked, computed = 0;
  if (mo_best_create(n, e, k, &best) != MO_OK)
    abort();
  while ((n_asked = mo_best_ask(best)) > 0) {
    computed += n_asked;
    for (uint32_t i = 0; i < n; i++) {
      CHECK((before[i] & ~best->asked[i]) == 0);
      for (uint64_t more = best->asked[i] & ~before[i]; more != 0; more &= more - 1, n_asked--) {
        const uint32_t cell = (uint32_t)__builtin_ctzll(more);
        mo_best_give(best, i, cell, all[i][cell]);
      }
      before[i] = best->asked[i];
    }
    CHECK_INT(n_asked, 0);
  }
  CHECK(computed + best->n_cut == (uint64_t)n * e);
  for (uint32_t i = 0; i < n; i++)
    sorted[i] = scores[i] = mo_race_score(all[i], e);
  for (uint32_t i = 1; i < n; i++)
    for (uint32_t j = i; j > 0 && sorted[j] < sorted[j - 1]; j--) {
      const double swap = sorted[j];
      sorted[j] = sorted[j - 1];
      sorted[j - 1] = swap;
    }
  for (uint32_t i = 0; i < n; i++) {
    const double known = mo_race_score(best->losses + (size_t)i * e, e);
    CHECK(best->asked[i] == whole ? known == scores[i] : known > sorted[k - 1]);
    CHECK(known <= scores[i] && (best->asked[i] == whole || scores[i] > sorted[k - 1]));
  }
  mo_best_free(best);
  return computed;
}

static void the_best(void)
{
  static double all[DESIGNS][MO_RACE_ENVIRONMENTS_MAX];
  uint64_t computed = 0, whole = 0;
  for (uint32_t round = 0; round < ROUNDS; round++) {
    struct mo_random random;
    mo_random_init(&random, 4, MO_PURPOSE_CHECK, round, 0);
    const uint32_t n = 1 + mo_random_below(&random, DESIGNS),
                   e = 1 + mo_random_below(&random, MO_RACE_ENVIRONMENTS_MAX),
                   k = 1 + mo_random_below(&random, round % 2 == 0 ? n : 1 + n / 16);
    for (uint32_t i = 0; i < n; i++) {
      const double talent = mo_random_uniform(&random);
      for (uint32_t j = 0; j < e; j++)
        all[i][j] = talent * draw(&random, round);
    }
    computed += race_best(all, n, e, k);
    whole += (uint64_t)n * e;
  }
  printf("# %.3f of the rollouts\n", (double)computed / (double)whole);
  CHECK(computed < whole);
  for (uint32_t i = 0; i < DESIGNS; i++) /* all the same: no design can be cut short */
    for (uint32_t j = 0; j < 10; j++)
      all[i][j] = 0.1 * j;
  CHECK(race_best(all, DESIGNS, 10, 1) == 10 * DESIGNS);
  for (uint32_t i = 0; i < DESIGNS;
       i++) /* all diverge in some environment, and none of them is among the best */
    all[i][i % 10] = INFINITY;
  CHECK(race_best(all, DESIGNS, 10, 1) == 10 * DESIGNS);
}

/* ---- the losses that are left ---- */

enum { MANY = 5000, ENVIRONMENTS = 10, MOMENTS = 200 };

/* Draws losses: talent times noise; in odd rounds few designs are good, and environments differ in
 * their difficulty. */
static void draw_losses(uint32_t round, double (*all)[ENVIRONMENTS])
{
  struct mo_random random;
  double difficulty[ENVIRONMENTS];
  const bool few_good = round % 2 == 1;
  mo_random_init(&random, 5, MO_PURPOSE_CHECK, round, 0);
  for (uint32_t j = 0; j < ENVIRONMENTS; j++)
    difficulty[j] = few_good ? 0.5 + mo_random_uniform(&random) : 1;
  for (uint32_t i = 0; i < MANY; i++) {
    const double talent = few_good ? 0.05 + exp(-fabs(mo_random_normal(&random)))
                                   : 0.2 + 1.8 * mo_random_uniform(&random);
    for (uint32_t j = 0; j < ENVIRONMENTS; j++)
      all[i][j] = talent * (0.5 + mo_random_uniform(&random)) * difficulty[j];
  }
}

struct moment {
  uint64_t computed;
  double left; /* estimated; negative: unknown */
};

/* Delivers losses one after the other, and looks at the estimate as a progress bar does. Returns
 * the number of losses. */
static uint64_t watch_race(const double (*all)[ENVIRONMENTS], uint32_t k, struct moment *moments)
{
  struct mo_best *best;
  uint64_t n_asked, computed = 0;
  static uint64_t before[MANY];
  memset(before, 0, sizeof(before));
  if (mo_best_create(MANY, ENVIRONMENTS, k, &best) != MO_OK)
    abort();
  CHECK(mo_best_left(best) < 0);
  for (uint32_t n = 0; (n_asked = mo_best_ask(best)) > 0;)
    for (uint32_t i = 0; i < MANY; i++)
      for (uint64_t more = best->asked[i] & ~before[i]; more != 0; more &= more - 1) {
        const uint32_t cell = (uint32_t)__builtin_ctzll(more);
        before[i] |= more & -more;
        mo_best_give(best, i, cell, all[i][cell]);
        n_asked--;
        if (computed++ % (MANY * ENVIRONMENTS / MOMENTS) == 0)
          moments[n++] = (struct moment){computed, (double)n_asked + mo_best_left(best)};
      }
  CHECK(mo_best_left(best) == 0);
  mo_best_free(best);
  return computed;
}

/* How many losses a race still needs is unknown at first. After a tenth of them, 95 % of the
 * estimates are within 30 %. */
static void estimates(void)
{
  static double all[MANY][ENVIRONMENTS];
  static struct moment moments[MOMENTS + 1];
  const uint32_t ks[] = {10, 50, 500};
  for (uint32_t place = 0; place < 3; place++) {
    uint32_t n = 0, right = 0, n_first = 0;
    double sum = 0;
    for (uint32_t round = 0; round < 20; round++) {
      draw_losses(round, all);
      const uint64_t whole = watch_race(all, ks[place], moments);
      bool is_first = true;
      for (uint32_t i = 0; i < MOMENTS && moments[i].computed < whole * 9 / 10; i++) {
        if (10 * moments[i].computed < whole)
          continue;
        const double left = (double)(whole - moments[i].computed),
                     off = fabs(moments[i].left / left - 1);
        n++;
        sum += off;
        right += off < 0.3;
        n_first += is_first && off < 0.3;
        is_first = false;
      }
    }
    printf("# best %u: %.3f of the moments within 30 %%, %u of 20 at a tenth, mean error %.3f\n",
           (unsigned)ks[place], (double)right / n, (unsigned)n_first, sum / n);
    CHECK(right > 0.95 * n);
    CHECK(sum < 0.1 * n);
  }
}

static const struct check_case cases[] = {
    {"the same survivors", same_survivors},
    {"plans", plans},
    {"without a bound", without_a_bound},
    {"waiting times of a device", waits},
    {"stored losses", stored_losses},
    {"unknown losses", unknown_losses},
    {"the best", the_best},
    {"estimates of the best", estimates},
};
CHECK_MAIN(cases)
