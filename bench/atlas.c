/* atlas.c: finding all bodies of at most ten voxels, and the atlas file: writing, opening and
 * queries; `morpho-bench atlas [folder]`.
 *
 * The losses are invented: a hash of the body. So there are more local optima than with real ones,
 * which changes the time of no query but the ascent's. Exits with 1 if a query takes longer than
 * promised. */
#include "bench.h"

#include <morpho/atlas.h>
#include <morpho/random.h>

#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define SAMPLE          20000 /* bodies that are looked up */
#define SCORE_MAX_US    5.0
#define NEIGHBOR_MAX_US 200.0

static double loss_of(const uint64_t *form, uint32_t environment)
{
  uint64_t hash = environment;
  for (int w = 0; w < MO_DEFAULT_WORDS; w++)
    hash = (hash ^ form[w]) * UINT64_C(0x9e3779b97f4a7c15) ^ hash >> 29;
  return (double)(hash >> 40) / (double)(UINT64_C(1) << 24);
}

static void find_all(const struct mo_atlas_scope *scope)
{
  static const uint64_t known[MO_ATLAS_VOXELS_MAX] = {1,   2,    5,     21,     95,
                                                      530, 3168, 20313, 133961, 899126};
  struct mo_atlas_bodies *bodies = NULL;
  uint64_t counts[MO_ATLAS_VOXELS_MAX];
  const double start = bench_thread_s();
  bench_check(mo_atlas_bodies_create(scope, &bodies), "stream of bodies");
  bench_check(mo_atlas_bodies_count(bodies, counts), "bodies");
  printf("%-46s %10.2f s\n", "finding all bodies", bench_thread_s() - start);
  mo_atlas_bodies_free(bodies);
  bench_check(memcmp(counts, known, sizeof(known)) == 0 ? MO_OK : MO_ERR_CORRUPT,
              "number of bodies");
}

static void write_all(const struct mo_atlas_source *source, const char *path)
{
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_atlas_writer *writer = NULL;
  struct mo_atlas_bodies *bodies = NULL;
  uint64_t form[MO_DEFAULT_WORDS];
  double losses[MO_PAPER_TEST_COUNT];
  struct mo_message message = {""};
  int error;
  mo_environment_paper_test(environments);
  const double start = bench_now_s();
  error =
      mo_atlas_writer_create(path, source, environments, MO_PAPER_TEST_COUNT, &writer, &message);
  bench_check(error, message.text);
  bench_check(mo_atlas_bodies_create(&source->scope, &bodies), "stream of bodies");
  while ((error = mo_atlas_bodies_next(bodies, form)) == MO_OK) {
    for (uint32_t e = 0; e < MO_PAPER_TEST_COUNT; e++)
      losses[e] = loss_of(form, e);
    bench_check(mo_atlas_writer_add(writer, form, losses, NULL), "body");
  }
  bench_check(error == MO_ERR_EXHAUSTED ? MO_OK : error, "stream of bodies");
  bench_check(mo_atlas_writer_finish(writer, &message), message.text);
  mo_atlas_writer_free(writer);
  mo_atlas_bodies_free(bodies);
  printf("%-46s %10.2f s\n", "writing the file (with syncs)", bench_now_s() - start);
}

struct asking {
  const struct mo_atlas *atlas;
  const struct mo_atlas_index *index;
  uint64_t (*bodies)[MO_DEFAULT_WORDS];
  uint64_t *positions;
  uint64_t n;
  double sink; /* keeps results alive */
};

static void ask_scores(struct asking *asking)
{
  for (uint64_t i = 0; i < asking->n; i++) {
    uint64_t position;
    bench_check(mo_atlas_find(asking->atlas, asking->bodies[i], &position), "body");
    asking->sink += (double)mo_atlas_score(asking->atlas, position);
  }
}

static void ask_neighbors(struct asking *asking, unsigned steps)
{
  struct mo_atlas_neighbor neighbors[MO_ATLAS_NEIGHBORS_MAX];
  for (uint64_t i = 0; i < asking->n; i++)
    asking->sink += mo_atlas_neighbors(asking->atlas, asking->positions[i], steps, neighbors);
}

static void ask_few(struct asking *asking)
{
  ask_neighbors(asking, MO_ATLAS_GROW_SHRINK);
}

static void ask_moves(struct asking *asking)
{
  ask_neighbors(asking, MO_ATLAS_GROW_SHRINK | MO_ATLAS_MOVE);
}

static void ask_ascents(struct asking *asking)
{
  uint64_t optimum;
  for (uint64_t i = 0; i < asking->n; i++)
    asking->sink += (double)mo_atlas_ascend(asking->atlas, asking->positions[i],
                                            MO_ATLAS_GROW_SHRINK, NULL, 0, &optimum);
}

static void ask_ranks(struct asking *asking)
{
  for (uint64_t i = 0; i < asking->n; i++)
    asking->sink += mo_atlas_rank_of(asking->index, asking->positions[i], i % 2 == 0).percentile;
}

/* Times a query of many bodies. Returns whether it is within its bound; 0: it has none. */
static bool measure(struct asking *asking, const char *name, void (*ask)(struct asking *),
                    double most_us)
{
  const double start = bench_thread_s();
  ask(asking);
  const double us = 1e6 * (bench_thread_s() - start) / (double)asking->n;
  const bool is_within = most_us == 0 || us <= most_us;
  printf("%-46s %10.2f us%s\n", name, us, is_within ? "" : "  TOO SLOW");
  return is_within;
}

static bool ask_all(const struct mo_atlas *atlas, const struct mo_atlas_index *index)
{
  struct asking asking = {.atlas = atlas, .index = index, .n = SAMPLE};
  bool is_within = true;
  asking.bodies = bench_zeros(SAMPLE, sizeof(*asking.bodies));
  asking.positions = bench_zeros(SAMPLE, sizeof(*asking.positions));
  for (uint64_t i = 0; i < SAMPLE; i++) {
    struct mo_random random;
    mo_random_init(&random, 1, MO_PURPOSE_CHECK, 0, i);
    asking.positions[i] = mo_random_below(&random, (uint32_t)mo_atlas_bodies_of(atlas));
    (void)mo_atlas_form(atlas, asking.positions[i], asking.bodies[i]);
    mo_genotype_place(MO_DEFAULT_WORKSPACE, asking.bodies[i]);
  }
  is_within &= measure(&asking, "score of a body", ask_scores, SCORE_MAX_US);
  is_within &= measure(&asking, "neighbors (add, remove) with scores", ask_few, NEIGHBOR_MAX_US);
  is_within &= measure(&asking, "neighbors (also move) with scores", ask_moves, NEIGHBOR_MAX_US);
  is_within &= measure(&asking, "rank and percentile", ask_ranks, 0);
  is_within &= measure(&asking, "path of steepest ascent", ask_ascents, 0);
  if (asking.sink == 1) /* practically never; makes the results needed */
    printf("\n");
  return is_within;
}

int bench_atlas(int argc, char **argv)
{
  const struct mo_atlas_source source = {.scope = {MO_DEFAULT_WORKSPACE, MO_ATLAS_VOXELS_MAX},
                                         .fingerprint = "invented losses"};
  struct mo_atlas *atlas = NULL;
  struct mo_atlas_index *index = NULL;
  struct mo_atlas_basins *basins = NULL;
  struct mo_message message = {""};
  char folder[4096], path[4128];
  snprintf(folder, sizeof(folder), "%s/atlas-XXXXXX", argc > 1 ? argv[1] : "/tmp");
  if (argc > 2 || mkdtemp(folder) == NULL) {
    fprintf(stderr, "morpho-bench atlas [folder]: a folder in which files can be made\n");
    return EXIT_FAILURE;
  }
  snprintf(path, sizeof(path), "%s/bench.atlas", folder);
  find_all(&source.scope);
  write_all(&source, path);
  double start = bench_now_s();
  const int error = mo_atlas_open(path, &atlas, &message);
  bench_check(error, message.text);
  printf("%-46s %10.2f s\n", "opening and checking it", bench_now_s() - start);
  start = bench_thread_s();
  bench_check(mo_atlas_index_create(atlas, &index), "index");
  printf("%-46s %10.2f s\n", "index of ranks", bench_thread_s() - start);
  start = bench_thread_s();
  bench_check(mo_atlas_basins_create(atlas, index, NULL, &basins), "basins");
  printf("%-46s %10.2f s\n", "basins of all local optima", bench_thread_s() - start);
  struct mo_atlas_footprint footprints[MO_ATLAS_VOXELS_MAX + 1];
  start = bench_thread_s();
  mo_atlas_footprints(atlas, footprints);
  printf("%-46s %10.2f s\n", "optimum of each footprint", bench_thread_s() - start);
  const bool is_within = ask_all(atlas, index);
  printf("%llu bodies, %llu local optima; peak memory %.0f MiB\n",
         (unsigned long long)mo_atlas_bodies_of(atlas), (unsigned long long)mo_atlas_optima(basins),
         bench_peak_mib());
  mo_atlas_basins_free(basins);
  mo_atlas_index_free(index);
  mo_atlas_close(atlas);
  (void)unlink(path);
  (void)rmdir(folder);
  return is_within ? EXIT_SUCCESS : EXIT_FAILURE;
}
