/* statistics.c: diversity, distinctiveness, sizes and champions compared with their definitions. */
#include "fixture.h"

/* Draws n random bodies of a workspace, some of them twice. */
static uint64_t *bodies_of(struct mo_workspace workspace, uint32_t n, uint32_t step)
{
  const uint32_t words = mo_workspace_words(workspace);
  uint64_t *bodies = make_zeros((size_t)n * words, sizeof(*bodies));
  for (uint32_t i = 0; i < n; i++) {
    struct mo_random random = dice(77, step, i / 5 * 5 + (i % 5 < 3 ? i % 5 : 0));
    make_check(mo_genotype_random(workspace, &random, bodies + (size_t)words * i), "a body");
  }
  return bodies;
}

static const struct mo_workspace workspaces[] = {{6, 6, 4}, {1, 1, 1}, {2, 1, 1},
                                                 {3, 3, 3}, {6, 6, 2}, {20, 9, 7}};
#define WORKSPACES COUNT(workspaces)

static bool has(const uint64_t *bits, uint32_t v)
{
  return bits[v / 64] >> v % 64 & 1;
}

static void distances(void)
{
  for (size_t k = 0; k < WORKSPACES; k++)
    for (uint32_t n = 2; n <= 130; n += 1 + n / 2) {
      const struct mo_workspace w = workspaces[k];
      const uint32_t words = mo_workspace_words(w), voxels = mo_workspace_voxels(w);
      uint64_t *bodies = bodies_of(w, n, n);
      double each[130];
      mo_distinctiveness(w, bodies, n, each);
      uint64_t all = 0;
      for (uint32_t i = 0; i < n; i++) {
        uint64_t sum = 0;
        for (uint32_t j = 0; j < n; j++)
          for (uint32_t v = 0; v < voxels; v++)
            sum += has(bodies + (size_t)words * i, v) != has(bodies + (size_t)words * j, v);
        all += sum;
        CHECK(each[i] == (double)sum / ((double)(n - 1) * voxels));
      }
      CHECK(mo_diversity(w, bodies, n) ==
            (double)(all / 2) / ((double)((uint64_t)n * (n - 1) / 2) * voxels));
    }
}

static void distances_of_few(void)
{
  const uint64_t bodies[] = {1, 0, 0, 3, 0, 0}, equal[] = {5, 0, 0, 5, 0, 0};
  double each[2] = {-1, -1};
  CHECK(mo_diversity(MO_DEFAULT_WORKSPACE, bodies, 0) == 0.0);
  CHECK(mo_diversity(MO_DEFAULT_WORKSPACE, bodies, 1) == 0.0);
  CHECK(mo_diversity(MO_DEFAULT_WORKSPACE, equal, 2) == 0.0);
  CHECK(mo_diversity(MO_DEFAULT_WORKSPACE, bodies, 2) == 1.0 / 144.0);
  mo_distinctiveness(MO_DEFAULT_WORKSPACE, bodies, 1, each);
  CHECK(each[0] == 0.0 && each[1] == -1);
  mo_distinctiveness(MO_DEFAULT_WORKSPACE, bodies, 2, each);
  CHECK(each[0] == 1.0 / 144.0 && each[1] == each[0]);
}

static void sizes(void)
{
  for (size_t k = 0; k < WORKSPACES; k++) {
    const struct mo_workspace w = workspaces[k];
    uint64_t *bodies = bodies_of(w, 100, 3);
    struct mo_lattice *lattice = make_lattice(w);
    for (uint32_t i = 0; i < 100; i++) {
      const uint64_t *bits = bodies + (size_t)mo_workspace_words(w) * i;
      struct mo_design_size size;
      struct mo_body *body = make_body(lattice, bits);
      CHECK_INT(mo_design_size(lattice, bits, &size), MO_OK);
      uint32_t footprint = 0;
      for (uint32_t x = 0; x < w.nx; x++)
        for (uint32_t y = 0; y < w.ny; y++) {
          bool any = false;
          for (uint32_t z = 0; z < w.nz; z++)
            any |= has(bits, (x * w.ny + y) * w.nz + z);
          footprint += any;
        }
      CHECK(size.voxels == body->n_voxels && size.masses == body->n_masses &&
            size.springs == body->n_springs);
      CHECK_INT(size.footprint, footprint);
    }
  }
}

static void populations(void)
{
  const struct mo_workspace w = MO_DEFAULT_WORKSPACE;
  uint64_t *bodies = bodies_of(w, 21, 9);
  double scores[21];
  struct mo_design_size size[21];
  struct mo_population_stats stats;
  struct id_list list = {0};
  for (uint32_t i = 0; i < 21; i++) {
    scores[i] = (double)((i * 8) % 21) / 20.0; /* 0 … 1 in another order */
    size[i] = (struct mo_design_size){
        .voxels = i + 1, .footprint = 4, .masses = 100 - i, .springs = i * i};
    id_add(&list, w, bodies + (size_t)W * i);
  }
  CHECK_INT(mo_population_stats(w, bodies, scores, size, 21, &stats), MO_OK);
  CHECK(stats.n == 21 && stats.n_diverged == 0);
  CHECK_NEAR(stats.mean_score, 0.5, 1e-15);
  const double expected[MO_QUANTILES] = {0, 0.05, 0.25, 0.5, 0.75, 0.95, 1};
  for (int q = 0; q < MO_QUANTILES; q++)
    CHECK_NEAR(stats.quantiles[q], expected[q], 1e-15);
  CHECK(stats.diversity == mo_diversity(w, bodies, 21) && stats.diversity > 0.0);
  CHECK_INT(stats.species, id_distinct(&list));
  CHECK(stats.species < 21 && stats.species > 5);
  CHECK(stats.voxels.least == 1 && stats.voxels.mean == 11 && stats.voxels.most == 21);
  CHECK(stats.footprint.least == 4 && stats.footprint.mean == 4 && stats.footprint.most == 4);
  CHECK(stats.masses.least == 80 && stats.masses.mean == 90 && stats.masses.most == 100);
  CHECK_NEAR(stats.springs.mean, 2870.0 / 21.0, 1e-12);

  /* Two of four diverged: quantiles between the others. */
  const double some[] = {INFINITY, 0.25, INFINITY, 0.75};
  CHECK_INT(mo_population_stats(w, bodies, some, size, 4, &stats), MO_OK);
  CHECK(stats.n_diverged == 2 && stats.mean_score == 0.5 && stats.quantiles[0] == 0.25 &&
        stats.quantiles[6] == 0.75);
  CHECK_NEAR(stats.quantiles[1], 0.275, 1e-15);
  CHECK_INT(mo_population_stats(w, bodies, some, size, 1, &stats), MO_OK);
  CHECK(stats.n_diverged == 1 && isnan(stats.mean_score) && isnan(stats.quantiles[3]) &&
        stats.diversity == 0.0);
  CHECK_INT(mo_population_stats(w, bodies, some, size, 0, &stats), MO_OK);
  CHECK(stats.n == 0 && stats.species == 0 && stats.voxels.mean == 0.0);
}

/* ---- champions ---- */

/* Returns the positions in order of score, diverged designs last, by plain insertion. */
static void rank(const double *scores, uint32_t n, uint32_t *order)
{
  for (uint32_t i = 0; i < n; i++) {
    uint32_t at = i;
    while (at > 0 && scores[order[at - 1]] > scores[i]) {
      order[at] = order[at - 1];
      at--;
    }
    order[at] = i;
  }
}

static double mean_distance(const uint64_t *bodies, const uint32_t *picks, uint32_t m, uint32_t i)
{
  uint64_t sum = 0;
  for (uint32_t j = 0; j < m; j++)
    sum += hamming(bodies + (size_t)W * picks[i], bodies + (size_t)W * picks[j]);
  return (double)sum;
}

static void champions(void)
{
  enum { N = 97 };
  double scores[N];
  uint32_t order[N], picks[N];
  for (uint32_t step = 0; step < 5; step++) {
    struct mo_random random = dice(77, step, 1000);
    uint64_t *bodies = bodies_of(MO_DEFAULT_WORKSPACE, N, step);
    for (uint32_t i = 0; i < N; i++)
      scores[i] =
          mo_random_below(&random, 8) == 0 ? INFINITY : (double)mo_random_below(&random, 40) / 40.0;
    rank(scores, N, order);
    uint32_t sound = 0;
    while (sound < N && isfinite(scores[order[sound]]))
      sound++;
    for (uint32_t m = 1; m <= N; m++) {
      double distances[N];
      CHECK_INT(mo_champions(MO_DEFAULT_WORKSPACE, bodies, scores, N, m, picks, distances), MO_OK);
      uint8_t picked[N] = {0};
      for (uint32_t i = 0; i < m; i++) {
        CHECK(!picked[picks[i]]);
        picked[picks[i]] = 1;
      }
      CHECK(picked[order[0]]);
      CHECK(m == 1 ||
            picked[order[(m < sound ? sound : m) - 1]]); /* the other end of the ranking */
      uint32_t last = 0, widest = 0, narrowest = N;      /* even steps */
      for (uint32_t i = 1; i < N; i++)
        if (picked[order[i]]) {
          widest = i - last > widest ? i - last : widest;
          narrowest = i - last < narrowest ? i - last : narrowest;
          last = i;
        }
      CHECK(m == 1 || widest - narrowest <= 1);
      for (uint32_t i = 0; m <= sound && i < m; i++)
        CHECK(isfinite(scores[picks[i]]));
      for (uint32_t i = 0; i < m; i++)
        CHECK(distances[i] == mean_distance(bodies, picks, m, i) / ((m > 1 ? m - 1 : 1) * 144.0));
      for (uint32_t i = 1; i < m; i++) {
        const double before = mean_distance(bodies, picks, m, i - 1),
                     here = mean_distance(bodies, picks, m, i);
        const double better = scores[picks[i - 1]], worse = scores[picks[i]];
        CHECK(before > here ||
              (before == here && (better < worse || (better == worse && picks[i - 1] < picks[i]))));
      }
    }
    CHECK_INT(mo_champions(MO_DEFAULT_WORKSPACE, bodies, scores, N, 0, picks, NULL), MO_OK);
    CHECK_INT(mo_champions(MO_DEFAULT_WORKSPACE, bodies, scores, N, N + 1, picks, NULL),
              MO_ERR_RANGE);
  }
}

/* Positions are rounded to the nearest one, upward in the middle: of four designs the first, the
 * third and the last. */
static void champions_by_hand(void)
{
  const uint64_t bodies[4 * W] = {1, 0, 0, 3, 0, 0, 7, 0, 0, 1, 0, 0};
  const double scores[] = {0.4, 0.1, 0.3, 0.2}, lost[] = {INFINITY, 0.5, INFINITY, 0.2};
  uint32_t picks[4];
  CHECK_INT(mo_champions(MO_DEFAULT_WORKSPACE, bodies, scores, 4, 3, picks, NULL), MO_OK);
  CHECK(picks[0] == 2 && picks[1] == 0 &&
        picks[2] == 1); /* sums of distances 3, 3, 2; 2 is better than 0 */
  CHECK_INT(mo_champions(MO_DEFAULT_WORKSPACE, bodies, lost, 4, 2, picks, NULL), MO_OK);
  CHECK(picks[0] == 3 && picks[1] == 1);
  CHECK_INT(mo_champions(MO_DEFAULT_WORKSPACE, bodies, lost, 4, 3, picks, NULL),
            MO_OK); /* a diverged design: the first one */
  CHECK((picks[0] == 0 || picks[1] == 0 || picks[2] == 0) && picks[0] != 2 && picks[1] != 2 &&
        picks[2] != 2);
}

static const struct check_case cases[] = {
    {"distances as defined, pair by pair", distances},
    {"distances of fewer than two designs, and of equal ones", distances_of_few},
    {"sizes equal those of the body", sizes},
    {"statistics of a population", populations},
    {"champions: the best, even steps, most distinct first", champions},
    {"champions by hand", champions_by_hand},
};
CHECK_MAIN(cases)
