/* distinct.c: the statistics of a large distinct stream, and bodies of more than a million springs.
 *
 * 1.43 million distinct bodies are known to average 79 masses, 389 springs and 23 voxels; 32 % of
 * the draws are new. By default, a smaller stream is drawn. Its averages are smaller, because small
 * bodies run out slowly. If MORPHO_TEST_FULL is set, the full size is drawn. */
#include "../image.h"
#include "../make.h"

static const struct mo_workspace home = {6, 6, 4};

struct figures {
  double masses, springs, voxels, new_share;
};

static struct figures figures_of(uint32_t n)
{
  const struct mo_lattice *lattice = make_lattice(home);
  struct mo_body_stream *stream = make_body_stream(home, 1);
  struct figures figures = {0};
  const double start_s = now_s();
  for (uint32_t i = 0; i < n; i++) {
    uint64_t bits[MO_DEFAULT_WORDS];
    struct mo_body *body = NULL;
    make_check(mo_body_stream_next(stream, bits, NULL), "a body");
    make_check(mo_body_create(lattice, bits, &body), "a body");
    figures.masses += (double)body->n_masses / n;
    figures.springs += (double)body->n_springs / n;
    figures.voxels += (double)body->n_voxels / n;
    mo_body_free(body);
  }
  figures.new_share = (double)n / (double)mo_body_stream_draws(stream);
  printf("# %u distinct bodies in %.2f s: %.2f masses, %.2f springs, %.2f voxels on average; %.2f "
         "%% of draws are new\n",
         n, now_s() - start_s, figures.masses, figures.springs, figures.voxels,
         100.0 * figures.new_share);
  return figures;
}

static void hundred_thousand(void)
{
  const struct figures figures = figures_of(100000);
  CHECK(figures.new_share > 0.3 && figures.new_share < 0.5);
  CHECK(figures.masses > 60.0 && figures.masses < 79.0);
}

static void full_stream(void)
{
  if (getenv("MORPHO_TEST_FULL") == NULL) {
    printf("# set MORPHO_TEST_FULL for the stream of 1.43 million bodies\n");
    return;
  }
  const struct figures figures = figures_of(1430000);
  CHECK_NEAR(figures.masses, 79.0, 1.0);
  CHECK_NEAR(figures.springs, 389.0, 5.0);
  CHECK_NEAR(figures.voxels, 23.0, 0.5);
  CHECK_NEAR(figures.new_share, 0.32, 0.01);
}

/* A dense box and a random body in a workspace with more than a million springs. */
static void million_springs(void)
{
  const struct mo_workspace large = {64, 48, 40};
  static uint64_t bits[64 * 48 * 40 / 64], other[64 * 48 * 40 / 64];
  static char id[64 * 48 * 40 / 4 + 1], other_id[64 * 48 * 40 / 4 + 1];
  const double start_s = now_s();
  const struct mo_lattice *lattice = make_lattice(large);
  const double lattice_s = now_s() - start_s;
  CHECK_INT(lattice->n_masses, 65 * 49 * 41);
  const struct mo_body *full = make_full_body(lattice);
  printf("# %u masses, %u springs: lattice %.1f ms, body %.1f ms\n", full->n_masses,
         full->n_springs, 1e3 * lattice_s, 1e3 * (now_s() - start_s - lattice_s));
  CHECK(full->n_springs > 1000000);
  CHECK_INT(full->n_springs, lattice->n_springs);
  CHECK_INT(full->n_masses, lattice->n_masses);
  struct mo_random random = dice(61, 0, 0);
  int big = 0;
  for (int i = 0; i < 5; i++) {
    REQUIRE(mo_genotype_random(large, &random, bits) == MO_OK);
    CHECK_INT(mo_genotype_is_contiguous(large, bits), 1);
    big += mo_genotype_count(large, bits) > 1000;
    for (unsigned k = 0; k < 8; k++) {
      if (make_image(large, bits, k, other) == MO_OK) {
        mo_genotype_id(large, bits, id);
        mo_genotype_id(large, other, other_id);
        CHECK(strcmp(id, other_id) == 0);
        CHECK_INT(mo_genotype_from_id(large, id, strlen(id), other), MO_OK);
      }
    }
    CHECK_INT(mo_genotype_mutate(large, bits, 0.01, &random, other), MO_OK);
    CHECK_INT(mo_genotype_is_contiguous(large, other), 1);
    CHECK_INT(mo_genotype_crossover(large, bits, bits, other), MO_ERR_EMPTY);
    CHECK_INT(make_body(lattice, bits)->n_voxels, mo_genotype_count(large, bits));
  }
  CHECK(big > 0);
}

/* The largest workspaces that are accepted, in three shapes. */
static void largest_workspaces(void)
{
  static const struct mo_workspace several[] = {{128, 128, 64}, {16, 65535, 1}, {1, 1, 65535}};
  for (size_t i = 0; i < COUNT(several); i++) {
    struct mo_lattice *lattice = make_lattice(several[i]);
    const struct mo_body *body = make_full_body(lattice);
    CHECK(body->n_springs == lattice->n_springs && body->n_masses == lattice->n_masses);
    CHECK(body->mass_xyz[3 * body->n_masses - 3] == several[i].nx &&
          body->mass_xyz[3 * body->n_masses - 2] == several[i].ny &&
          body->mass_xyz[3 * body->n_masses - 1] == several[i].nz);
    CHECK_INT(lattice->spring_b[lattice->n_springs - 1], lattice->n_masses - 1);
  }
}

static const struct check_case cases[] = {
    {"a stream of 100,000 distinct bodies", hundred_thousand},
    {"a stream of 1.43 million distinct bodies", full_stream},
    {"a body of more than a million springs", million_springs},
    {"the largest workspaces", largest_workspaces},
};
CHECK_MAIN(cases)
