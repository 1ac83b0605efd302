/* selection.c: which designs survive under each scheme, compared with a plain description of the
 * scheme. */
#include "fixture.h"

#define N 96

struct scene {
  struct mo_campaign_settings settings;
  uint64_t genotypes[N * W];
  struct mo_candidate candidates[N];
  uint32_t survivors[N], n;
};

/* Makes N candidates of generations 0 … 20 (the current one), a few with equal scores; `diverged`
 * of 96 have no score. */
static void make_up(struct scene *scene, uint32_t step, uint32_t diverged,
                    enum mo_selection_kind kind)
{
  struct mo_random random = dice(77, step, 500);
  scene->settings = small_campaign(step + 1, N / 2);
  scene->settings.selection.kind = kind;
  for (uint32_t i = 0; i < N; i++) {
    const double score = (double)mo_random_below(&random, 60) / 60.0;
    const bool lost = mo_random_below(&random, 96) < diverged;
    scene->candidates[i] = (struct mo_candidate){.score = lost ? INFINITY : score,
                                                 .number = (i * 37) % N + 1000,
                                                 .born = mo_random_below(&random, 21)};
    make_check(mo_genotype_random(MO_DEFAULT_WORKSPACE, &random, scene->genotypes + (size_t)W * i),
               "a body");
  }
}

static int run(struct scene *scene)
{
  return mo_select(&scene->settings, 20, scene->genotypes, scene->candidates, N, scene->survivors,
                   &scene->n);
}

static bool is_better(const struct mo_candidate *a, const struct mo_candidate *b)
{
  return a->score < b->score || (a->score == b->score && a->number < b->number);
}

/* Returns how many candidates are better than i. */
static uint32_t rank_of(const struct scene *scene, uint32_t i)
{
  uint32_t rank = 0;
  for (uint32_t j = 0; j < N; j++)
    rank += is_better(&scene->candidates[j], &scene->candidates[i]);
  return rank;
}

static void alive(const struct scene *scene, uint8_t lives[N])
{
  memset(lives, 0, N);
  for (uint32_t i = 0; i < scene->n; i++)
    lives[scene->survivors[i]] = 1;
}

/* Checks what holds for every scheme. */
static void every_scheme(void)
{
  for (int kind = 0; mo_selection_words[kind] != NULL; kind++)
    for (uint32_t step = 0; step < 60; step++) {
      static struct scene scene;
      uint8_t lives[N];
      make_up(&scene, step, step % 3 * 35, (enum mo_selection_kind)kind);
      scene.settings.selection.novelty_weight = 0.25 * (step % 5);
      scene.settings.selection.age_gap = 1 + step % 4;
      scene.settings.population = 1 + step % 70;
      CHECK_INT(run(&scene), MO_OK);
      CHECK_INT(scene.n, scene.settings.population);
      alive(&scene, lives);
      uint32_t sound = 0, living = 0, sound_living = 0;
      for (uint32_t i = 0; i < N; i++) {
        living += lives[i];
        sound += isfinite(scene.candidates[i].score);
        sound_living += lives[i] && isfinite(scene.candidates[i].score);
        CHECK(rank_of(&scene, i) > 0 || lives[i]); /* the best one */
      }
      CHECK_INT(living, scene.n); /* no candidate twice */
      CHECK_INT(sound_living,
                sound < scene.n ? sound : scene.n); /* diverged ones, if there is nothing better */
      for (uint32_t i = 1; i < scene.n; i++)
        CHECK(is_better(&scene.candidates[scene.survivors[i - 1]],
                        &scene.candidates[scene.survivors[i]]));
      /* The older of the diverged candidates survive. */
      for (uint32_t i = 0; i < N; i++)
        for (uint32_t j = 0; j < N; j++)
          if (!isfinite(scene.candidates[i].score) && !isfinite(scene.candidates[j].score) &&
              lives[i] && !lives[j])
            CHECK(scene.candidates[i].number < scene.candidates[j].number);
    }
}

static void truncation(void)
{
  for (uint32_t step = 0; step < 50; step++) {
    static struct scene scene;
    uint8_t lives[N];
    make_up(&scene, step, step % 2 * 10, MO_SELECT_TRUNCATION);
    CHECK_INT(run(&scene), MO_OK);
    alive(&scene, lives);
    for (uint32_t i = 0; i < N; i++)
      CHECK_INT(lives[i], rank_of(&scene, i) < N / 2);
  }
}

static void ties_and_nonsense(void)
{
  static struct scene scene;
  make_up(&scene, 1, 0, MO_SELECT_TRUNCATION);
  for (uint32_t i = 0; i < N; i++)
    scene.candidates[i].score = i % 2 ? 0.0 : -0.0; /* all equal: in order of number */
  CHECK_INT(run(&scene), MO_OK);
  for (uint32_t i = 0; i < scene.n; i++)
    CHECK_INT(scene.candidates[scene.survivors[i]].number, 1000 + i);
  scene.n = 5;
  scene.candidates[17].score = NAN;
  CHECK_INT(run(&scene), MO_ERR_INVALID);
  CHECK_INT(scene.n, 5);
  CHECK_INT(mo_select(&scene.settings, 1, scene.genotypes, scene.candidates, 0, scene.survivors,
                      &scene.n),
            MO_OK);
  CHECK_INT(scene.n, 0);
  scene.settings.population = 200; /* more places than candidates: all survive */
  scene.candidates[17].score = INFINITY;
  for (int kind = 0; mo_selection_words[kind] != NULL; kind++) {
    scene.settings.selection.kind = (enum mo_selection_kind)kind;
    CHECK_INT(run(&scene), MO_OK);
    CHECK(scene.n == N && scene.survivors[N - 1] == 17);
  }
}

/* The order of the candidates does not matter: the same numbers survive. */
static void any_order(void)
{
  for (int kind = 0; mo_selection_words[kind] != NULL; kind++)
    for (uint32_t step = 0; step < 10; step++) {
      static struct scene scene, turned;
      make_up(&scene, step, 8, (enum mo_selection_kind)kind);
      turned = scene;
      for (uint32_t i = 0; i < N; i++) {
        turned.candidates[i] = scene.candidates[N - 1 - i];
        memcpy(turned.genotypes + (size_t)W * i, scene.genotypes + (size_t)W * (N - 1 - i),
               W * sizeof(uint64_t));
      }
      CHECK(run(&scene) == MO_OK && run(&turned) == MO_OK);
      for (uint32_t i = 0; i < scene.n; i++)
        CHECK(scene.candidates[scene.survivors[i]].number ==
              turned.candidates[turned.survivors[i]].number);
    }
}

/* Larger tournaments leave less to chance. Returns the mean rank of the survivors over 200
 * draws. */
static void tournament(void)
{
  static const uint32_t sizes[] = {2, 4, 16, 64};
  double before = N;
  for (int k = 0; k < 4; k++) {
    double sum = 0;
    uint32_t same = 0;
    static struct scene scene;
    for (uint32_t step = 0; step < 200; step++) {
      make_up(&scene, 3, 0, MO_SELECT_TOURNAMENT);
      scene.settings.selection.tournament_size = sizes[k];
      scene.settings.seed = step;
      scene.settings.population = 24;
      CHECK_INT(run(&scene), MO_OK);
      for (uint32_t i = 0; i < scene.n; i++) {
        sum += rank_of(&scene, scene.survivors[i]);
        same += rank_of(&scene, scene.survivors[i]) < 24;
      }
    }
    sum /= 200 * 24;
    printf("# tournaments of %u: mean rank %.2f\n", sizes[k], sum);
    CHECK(sum < before - 1);
    CHECK(sum > 11.5); /* of the best 24 */
    CHECK(same < 200 * 24);
    before = sum;
  }
  CHECK(before < 14);
}

/* One place after the best candidate's: of the 95 others, rank r (from 0) wins a tournament of k
 * with probability ((95 − r)/95)^k − ((94 − r)/95)^k. */
static void tournament_odds(void)
{
  static struct scene scene;
  uint32_t times[N] = {0};
  const uint32_t draws = 20000;
  make_up(&scene, 4, 0, MO_SELECT_TOURNAMENT);
  scene.settings.selection.tournament_size = 3;
  scene.settings.population = 2;
  for (uint32_t i = 0; i < draws; i++) {
    scene.settings.seed = i;
    REQUIRE(run(&scene) == MO_OK && scene.n == 2);
    times[rank_of(&scene, scene.survivors[1]) - 1]++;
  }
  for (int r = 0; r < 95; r++) {
    const double p = pow((95 - r) / 95.0, 3) - pow((94 - r) / 95.0, 3);
    CHECK_NEAR(times[r], draws * p, 4.5 * sqrt(draws * p) + 1);
  }
}

static uint64_t distance_to_all(const struct scene *scene, uint32_t i)
{
  uint64_t sum = 0;
  for (uint32_t j = 0; j < N; j++)
    sum += hamming(scene->genotypes + (size_t)W * i, scene->genotypes + (size_t)W * j);
  return sum;
}

static void novelty(void)
{
  for (uint32_t step = 0; step < 25; step++) {
    static struct scene scene, other;
    const double weight = 0.25 * (step % 5);
    double value[N];
    uint32_t rank[N], outlived = 0;
    uint64_t distance[N];
    uint8_t lives[N];
    make_up(&scene, step, 0, MO_SELECT_NOVELTY);
    scene.settings.selection.novelty_weight = weight;
    CHECK_INT(run(&scene), MO_OK);
    alive(&scene, lives);
    for (uint32_t i = 0; i < N; i++) {
      rank[i] = rank_of(&scene, i);
      distance[i] = distance_to_all(&scene, i);
    }
    for (uint32_t i = 0; i < N; i++) {
      uint32_t newer = 0;
      for (uint32_t j = 0; j < N; j++)
        newer += distance[j] > distance[i] || (distance[j] == distance[i] && rank[j] < rank[i]);
      value[i] = (1 - weight) * rank[i] + weight * newer;
    }
    for (uint32_t i = 0; i < N; i++) {
      uint32_t before = 0; /* candidates that are better */
      for (uint32_t j = 0; j < N; j++)
        before +=
            rank[j] == 0 || value[j] < value[i] || (value[j] == value[i] && rank[j] < rank[i]);
      CHECK_INT(lives[i], rank[i] == 0 || before < N / 2);
      outlived += lives[i] && rank[i] >= N / 2;
    }
    CHECK(weight == 0 ? outlived == 0 : outlived > 0);
    if (weight == 0) {
      other = scene;
      other.settings.selection.kind = MO_SELECT_TRUNCATION;
      CHECK(run(&other) == MO_OK &&
            memcmp(other.survivors, scene.survivors, scene.n * sizeof(uint32_t)) == 0);
    }
  }
}

static void age_layers(void)
{
  uint32_t kept = 0, kept_by_truncation = 0;
  for (uint32_t step = 0; step < 60; step++) {
    static struct scene scene;
    uint8_t lives[N], expected[N] = {0};
    make_up(&scene, step, 0, MO_SELECT_AGE_LAYERED);
    const uint32_t layers = 2 + step % 5, gap = 1 + step % 3;
    scene.settings.selection.n_layers = layers;
    scene.settings.selection.age_gap = gap;
    for (uint32_t i = 0; i < N; i++) /* young candidates have bad scores */
      scene.candidates[i].score += scene.candidates[i].born >= 19 ? 1.0 : 0.0;
    CHECK_INT(run(&scene), MO_OK);
    alive(&scene, lives);
    uint32_t filled = 0;
    for (uint32_t layer = 0; layer < layers; layer++)
      while (filled <
             N / 2 * (layer + 1) /
                 layers) { /* the best of its age among those that have not been selected yet */
        uint32_t best = N;
        for (uint32_t i = 0; i < N; i++)
          if (!expected[i] &&
              (layer + 1 == layers || 20 - scene.candidates[i].born <= gap << layer) &&
              (best == N || is_better(&scene.candidates[i], &scene.candidates[best])))
            best = i;
        if (best == N)
          break;
        expected[best] = 1;
        filled++;
      }
    CHECK(memcmp(lives, expected, N) == 0);
    for (uint32_t i = 0; i < N; i++) {
      kept += lives[i] && scene.candidates[i].born >= 19;
      kept_by_truncation += rank_of(&scene, i) < N / 2 && scene.candidates[i].born >= 19;
    }
  }
  printf("# young survivors: %u, by truncation %u\n", kept, kept_by_truncation);
  CHECK(kept > 60 * 5 && kept_by_truncation == 0);
}

/* If all have the same age, layers change nothing. A birth later than now (damaged data) counts as
 * now. */
static void one_age(void)
{
  static struct scene scene;
  for (uint32_t born = 20; born <= 30; born += 10) {
    make_up(&scene, 2, 0, MO_SELECT_AGE_LAYERED);
    for (uint32_t i = 0; i < N; i++)
      scene.candidates[i].born = born;
    CHECK_INT(run(&scene), MO_OK);
    for (uint32_t i = 0; i < scene.n; i++)
      CHECK(rank_of(&scene, scene.survivors[i]) == i);
  }
}

static const struct check_case cases[] = {
    {"in every scheme, the best survives and diverged designs come last", every_scheme},
    {"truncation: the better half", truncation},
    {"ties go by number; no score is refused", ties_and_nonsense},
    {"the order of candidates does not matter", any_order},
    {"tournaments: pressure grows with size", tournament},
    {"tournaments: odds of each rank", tournament_odds},
    {"novelty: the weighted sum of two ranks", novelty},
    {"age layers keep young designs", age_layers},
    {"age layers with equal ages", one_age},
};
CHECK_MAIN(cases)
