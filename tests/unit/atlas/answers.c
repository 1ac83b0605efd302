/* answers.c: writes an atlas file with invented losses, and prints what the library answers about
 * every body of it, as lines of JSON: for tests of other readers of the same file.
 *
 * LEVELS are those of fixture_loss, MEASURES a set as bits, CONTROLLER and PHYSICS hashes. */
#include "fixture.h"

#include <math.h>

#define USAGE        "PATH NX NY NZ VOXELS LEVELS [MEASURES [CONTROLLER [PHYSICS]]]"
#define ENVIRONMENTS 3
#define PATH_MOST    64
#define MANY         4096 /* bodies; of more, only some have their neighbors printed */
#define SOME         211

static const unsigned STEPS[] = {MO_ATLAS_ADD, MO_ATLAS_REMOVE, MO_ATLAS_GROW_SHRINK,
                                 MO_ATLAS_GROW_SHRINK | MO_ATLAS_MOVE};

static void fail(const char *what, int error)
{
  fprintf(stderr, "atlas-answers: %s: %s\n", what, mo_error_text(error));
  exit(1);
}

/* Some bodies diverge. */
static double loss_of(const uint64_t *form, uint32_t environment, uint64_t levels)
{
  return fixture_loss(form, ENVIRONMENTS, 29) == 0 ? INFINITY
                                                   : fixture_loss(form, environment, levels);
}

/* Two have tasks, and one has factors. */
static void fill_environments(struct mo_environment environments[MO_PAPER_TEST_COUNT])
{
  mo_environment_paper_test(environments);
  environments[1].task.guide = (struct mo_guide){.kind = MO_GUIDE_AHEAD, .distance_m = 1.5};
  environments[1].task.objective = MO_OBJECTIVE_TRAVEL;
  environments[1].light_xy_m[0] = environments[1].light_xy_m[1] = 0;
  environments[2].task = environments[1].task;
  environments[2].light_xy_m[0] = environments[2].light_xy_m[1] = 0;
  environments[2].factors = mo_factors_ones();
  environments[2].factors.mass = 1.25;
}

static void write_file(const char *path, const struct mo_atlas_source *source, uint64_t levels)
{
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_atlas_writer *writer = NULL;
  struct mo_atlas_bodies *bodies = NULL;
  struct mo_message message = {""};
  uint64_t form[MO_DEFAULT_WORDS] = {0};
  double losses[ENVIRONMENTS], measures[MO_MEASURES];
  fill_environments(environments);
  int error = mo_atlas_writer_create(path, source, environments, ENVIRONMENTS, &writer, &message);
  if (error == MO_OK)
    error = mo_atlas_bodies_create(&source->scope, &bodies);
  while (error == MO_OK && mo_atlas_writer_position(writer) < mo_atlas_writer_bodies(writer)) {
    error = mo_atlas_bodies_next(bodies, form);
    for (uint32_t e = 0; e < ENVIRONMENTS; e++)
      losses[e] = loss_of(form, e, levels);
    for (uint32_t m = 0; m < MO_MEASURES; m++)
      measures[m] = fixture_measure(form, m, levels);
    if (error == MO_OK)
      error = mo_atlas_writer_add(writer, form, losses, measures);
  }
  if (error == MO_OK)
    error = mo_atlas_writer_finish(writer, &message);
  mo_atlas_bodies_free(bodies);
  mo_atlas_writer_free(writer);
  if (error != MO_OK)
    fail(message.text[0] != '\0' ? message.text : path, error);
}

/* JSON has neither infinity nor NaN. */
static void print_score(float score)
{
  if (!isfinite(score))
    printf("null");
  else
    printf("%.9g", (double)score);
}

static void print_rank(const char *name, struct mo_atlas_rank rank)
{
  printf(", \"%s\": [%llu, %llu, %llu, %.17g]", name, (unsigned long long)rank.better,
         (unsigned long long)rank.equal, (unsigned long long)rank.worse, rank.percentile);
}

static void print_neighbors(const struct mo_atlas *atlas, uint64_t position)
{
  struct mo_atlas_neighbor neighbors[MO_ATLAS_NEIGHBORS_MAX];
  uint64_t path[PATH_MOST], optimum;
  printf(", \"neighbors\": [");
  for (size_t s = 0; s < sizeof(STEPS) / sizeof(*STEPS); s++) {
    const uint32_t n = mo_atlas_neighbors(atlas, position, STEPS[s], neighbors);
    printf("%s[", s > 0 ? ", " : "");
    for (uint32_t i = 0; i < n; i++) {
      printf("%s[%llu, ", i > 0 ? ", " : "", (unsigned long long)neighbors[i].position);
      print_score(neighbors[i].score);
      printf(", %d]", (int)neighbors[i].step);
    }
    printf("]");
  }
  printf("], \"paths\": [");
  for (size_t s = 0; s < sizeof(STEPS) / sizeof(*STEPS); s++) {
    const uint64_t n = mo_atlas_ascend(atlas, position, STEPS[s], path, PATH_MOST, &optimum);
    printf("%s[", s > 0 ? ", " : "");
    for (uint64_t i = 0; i < n && i < PATH_MOST; i++)
      printf("%s%llu", i > 0 ? ", " : "", (unsigned long long)path[i]);
    printf("]");
  }
  printf("]");
}

/* [value, percentile] of each measure. */
static void print_measures(const struct mo_atlas *atlas, uint64_t position)
{
  const uint32_t set = mo_atlas_source_of(atlas)->measures;
  bool any = false;
  printf(", \"measures\": {");
  for (int m = 0; m < MO_MEASURES; m++) {
    if ((set >> m & 1) == 0)
      continue;
    const double percentile = mo_atlas_measure_percentile(atlas, position, (enum mo_measure)m);
    printf("%s\"%s\": [", any ? ", " : "", mo_measure_info[m].name);
    print_score(mo_atlas_measure(atlas, position, (enum mo_measure)m));
    if (isnan(percentile))
      printf(", null]");
    else
      printf(", %.17g]", percentile);
    any = true;
  }
  printf("}");
}

static void print_body(const struct mo_atlas *atlas, const struct mo_atlas_index *index,
                       const struct mo_atlas_basins *basins, uint64_t position)
{
  const struct mo_workspace workspace = mo_atlas_source_of(atlas)->scope.workspace;
  uint64_t form[MO_DEFAULT_WORDS];
  struct mo_bits designs[MO_ORIENTATIONS];
  char text[MO_ATLAS_WORKSPACE_MAX + 1], id[MO_ATLAS_WORKSPACE_MAX / 4 + 2];
  float losses[ENVIRONMENTS];
  const uint32_t voxels = mo_atlas_form(atlas, position, form);
  mo_genotype_to_text(workspace, form, text);
  (void)mo_genotype_id(workspace, form, id);
  printf("{\"position\": %llu, \"voxels\": %u, \"genotype\": \"%s\", \"id\": \"%s\", \"score\": ",
         (unsigned long long)position, voxels, text, id);
  print_score(mo_atlas_score(atlas, position));
  mo_atlas_losses(atlas, position, losses);
  printf(", \"losses\": [");
  for (int e = 0; e < ENVIRONMENTS; e++) {
    printf("%s", e > 0 ? ", " : "");
    print_score(losses[e]);
  }
  printf("], \"images\": [");
  const uint32_t n =
      mo_atlas_designs(&mo_atlas_source_of(atlas)->scope, form, MO_ATLAS_IMAGES, designs);
  for (uint32_t i = 0; i < n; i++) {
    mo_genotype_to_text(workspace, designs[i].words, text);
    printf("%s\"%s\"", i > 0 ? ", " : "", text);
  }
  printf("]");
  print_rank("rank", mo_atlas_rank_of(index, position, false));
  print_rank("rank_of_size", mo_atlas_rank_of(index, position, true));
  printf(", \"nth\": %llu, \"optimum\": %llu, \"basin\": %llu",
         (unsigned long long)mo_atlas_nth(index, 0, position),
         (unsigned long long)mo_atlas_optimum_of(basins, position),
         (unsigned long long)mo_atlas_basin_of(basins, position));
  print_measures(atlas, position);
  if (mo_atlas_bodies_of(atlas) <= MANY || position < SOME || position % SOME == 0)
    print_neighbors(atlas, position);
  printf("}\n");
}

/* Of each size: counts between 0, 0.1 … 1. */
static void print_histograms(const struct mo_atlas_index *index, uint32_t voxels_max)
{
  float edges[11];
  uint64_t counts[10];
  for (int i = 0; i <= 10; i++)
    edges[i] = (float)i / 10;
  printf("{\"histograms\": [");
  for (uint32_t n = 0; n <= voxels_max; n++) {
    mo_atlas_histogram(index, n, edges, 10, counts);
    printf("%s[", n > 0 ? ", " : "");
    for (int i = 0; i < 10; i++)
      printf("%s%llu", i > 0 ? ", " : "", (unsigned long long)counts[i]);
    printf("]");
  }
  printf("]");
}

static void print_footprints(const struct mo_atlas *atlas)
{
  struct mo_atlas_footprint footprints[MO_ATLAS_VOXELS_MAX + 1];
  mo_atlas_footprints(atlas, footprints);
  printf(", \"footprints\": [");
  for (int i = 0; i <= MO_ATLAS_VOXELS_MAX; i++)
    printf("%s[%llu, %llu]", i > 0 ? ", " : "", (unsigned long long)footprints[i].bodies,
           (unsigned long long)footprints[i].optimum);
  printf("]}\n");
}

static void read_hash(const char *digits, uint8_t bytes[32])
{
  struct mo_sha256 hash;
  const int error = mo_sha256_from_hex(digits, strlen(digits), &hash);
  if (error != MO_OK)
    fail(digits, error);
  memcpy(bytes, hash.bytes, sizeof(hash.bytes));
}

int main(int argc, char **argv)
{
  struct mo_atlas_index *index = NULL;
  struct mo_atlas_basins *basins = NULL;
  struct mo_atlas *atlas = NULL;
  struct mo_message message = {""};
  if (argc < 7 || argc > 10) {
    fprintf(stderr, "usage: atlas-answers %s\n", USAGE);
    return 1;
  }
  struct mo_atlas_source source = fixture_source((uint32_t)strtoul(argv[5], NULL, 10));
  source.scope.workspace = (struct mo_workspace){(uint16_t)strtoul(argv[2], NULL, 10),
                                                 (uint16_t)strtoul(argv[3], NULL, 10),
                                                 (uint16_t)strtoul(argv[4], NULL, 10)};
  source.orientations = MO_ATLAS_IMAGES;
  source.measures = argc > 7 ? (uint32_t)strtoul(argv[7], NULL, 10) : 0;
  if (argc > 8)
    read_hash(argv[8], source.controller_sha256);
  if (argc > 9)
    read_hash(argv[9], source.physics_sha256);
  write_file(argv[1], &source, strtoull(argv[6], NULL, 10));
  int error = mo_atlas_open(argv[1], &atlas, &message);
  if (error == MO_OK)
    error = mo_atlas_index_create(atlas, &index);
  if (error == MO_OK)
    error = mo_atlas_basins_create(atlas, index, NULL, &basins);
  if (error != MO_OK)
    fail("the file cannot be read", error);
  print_histograms(index, source.scope.voxels_max);
  print_footprints(atlas);
  for (uint64_t i = 0; i < mo_atlas_bodies_of(atlas); i++)
    print_body(atlas, index, basins, i);
  mo_atlas_basins_free(basins);
  mo_atlas_index_free(index);
  mo_atlas_close(atlas);
  return 0;
}
