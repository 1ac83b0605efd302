/* space.c: the cost of drawing, recognizing, varying and expressing bodies; `morpho-bench space
 * [bodies]`.
 *
 * Each operation runs over the same sample of random bodies of the default workspace, several
 * times; the fastest run counts. The last table times one body of over a million springs. */
#include "bench.h"

#include <morpho/morphospace.h>

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define RUNS 5

struct sample {
  struct mo_workspace workspace;
  uint32_t n;
  uint64_t (*bodies)[MO_DEFAULT_WORDS];
  uint64_t (*forms)[MO_DEFAULT_WORDS];
  const struct mo_lattice *lattice;
  uint64_t sink; /* keeps results alive */
};

static void draw(struct sample *sample)
{
  for (uint32_t i = 0; i < sample->n; i++) {
    struct mo_random random;
    mo_random_init(&random, 1, MO_PURPOSE_BODY, 0, i);
    mo_genotype_random(sample->workspace, &random, sample->bodies[i]);
  }
}

static void canonicalise(struct sample *sample)
{
  for (uint32_t i = 0; i < sample->n; i++)
    mo_genotype_canonical(sample->workspace, sample->bodies[i], sample->forms[i]);
}

static void place(struct sample *sample)
{
  for (uint32_t i = 0; i < sample->n; i++) {
    uint64_t placed[MO_DEFAULT_WORDS];
    memcpy(placed, sample->bodies[i], sizeof(placed));
    mo_genotype_place(sample->workspace, placed);
    sample->sink += placed[0];
  }
}

static void keep_largest(struct sample *sample)
{
  for (uint32_t i = 0; i < sample->n; i++) {
    uint64_t kept[MO_DEFAULT_WORDS];
    for (int w = 0; w < MO_DEFAULT_WORDS; w++) {
      kept[w] = sample->bodies[i][w] ^ sample->bodies[(i + 1) % sample->n][w];
    }
    mo_genotype_keep_largest(sample->workspace, kept);
    sample->sink += kept[0];
  }
}

static void spell(struct sample *sample)
{
  for (uint32_t i = 0; i < sample->n; i++) {
    char id[MO_DEFAULT_ID_DIGITS + 1];
    mo_genotype_id(sample->workspace, sample->bodies[i], id);
    sample->sink += (unsigned char)id[3];
  }
}

static void mutate(struct sample *sample)
{
  for (uint32_t i = 0; i < sample->n; i++) {
    struct mo_random random;
    uint64_t child[MO_DEFAULT_WORDS] = {0};
    mo_random_init(&random, 1, MO_PURPOSE_MUTATION, 0, i);
    mo_genotype_mutate(sample->workspace, sample->bodies[i], 1.0 / MO_DEFAULT_VOXELS, &random,
                       child);
    sample->sink += child[0];
  }
}

static void cross(struct sample *sample)
{
  for (uint32_t i = 0; i < sample->n; i++) {
    uint64_t child[MO_DEFAULT_WORDS] = {0};
    mo_genotype_crossover(sample->workspace, sample->bodies[i], sample->bodies[(i + 1) % sample->n],
                          child);
    sample->sink += child[0];
  }
}

static void insert(struct sample *sample)
{
  struct mo_form_set *set = NULL;
  bench_check(mo_form_set_create(sample->workspace, &set), "set of forms");
  for (uint32_t i = 0; i < sample->n; i++)
    sample->sink += (uint64_t)mo_form_set_add(set, sample->forms[i]);
  mo_form_set_free(set);
}

static void express(struct sample *sample)
{
  for (uint32_t i = 0; i < sample->n; i++) {
    struct mo_body *body = NULL;
    bench_check(mo_body_create(sample->lattice, sample->bodies[i], &body), "body");
    sample->sink += body->n_springs;
    mo_body_free(body);
  }
}

static void stream(struct sample *sample)
{
  struct mo_body_stream *bodies = NULL;
  bench_check(mo_body_stream_create(sample->workspace, 1, &bodies), "body stream");
  uint64_t bits[MO_DEFAULT_WORDS];
  while (mo_body_stream_draws(bodies) < sample->n &&
         mo_body_stream_next(bodies, bits, NULL) == MO_OK) {
    sample->sink += bits[0];
  }
  mo_body_stream_free(bodies);
}

static void measure(struct sample *sample, const char *name, void (*run)(struct sample *))
{
  double best_s = INFINITY;
  for (int i = 0; i < RUNS; i++) {
    const double start = bench_now_s();
    run(sample);
    best_s = fmin(best_s, bench_now_s() - start);
  }
  printf("%-46s %10.1f ns\n", name, 1e9 * best_s / sample->n);
}

static void large_body(void)
{
  const struct mo_workspace workspace = {64, 48, 40};
  struct mo_lattice *lattice = NULL;
  struct mo_body *body = NULL;
  const uint32_t words = mo_workspace_words(workspace);
  uint64_t *bits = bench_zeros(words, sizeof(uint64_t));
  memset(bits, 0xff, words * sizeof(uint64_t));
  const double start = bench_now_s();
  bench_check(mo_lattice_create(workspace, &lattice), "lattice");
  const double middle = bench_now_s();
  bench_check(mo_body_create(lattice, bits, &body), "body");
  printf("\nfull %u x %u x %u workspace: %u masses, %u springs; lattice %.1f ms, body %.1f ms\n",
         workspace.nx, workspace.ny, workspace.nz, body->n_masses, body->n_springs,
         1e3 * (middle - start), 1e3 * (bench_now_s() - middle));
}

int bench_space(int argc, char **argv)
{
  long n = argc > 1 ? strtol(argv[1], NULL, 10) : 100000;
  if (n < 2 || n > 100000000) {
    fprintf(stderr,
            "morpho-bench space [bodies]: between 2 and 100000000 bodies, 100000 by default\n");
    return EXIT_FAILURE;
  }
  struct sample sample = {.workspace = MO_DEFAULT_WORKSPACE, .n = (uint32_t)n};
  struct mo_lattice *lattice = NULL;
  sample.bodies = bench_zeros(sample.n, sizeof(*sample.bodies));
  sample.forms = bench_zeros(sample.n, sizeof(*sample.forms));
  bench_check(mo_lattice_create(sample.workspace, &lattice), "lattice");
  sample.lattice = lattice;
  printf("%u random bodies of 6 x 6 x 4 voxels, one core, best of %d runs, per body:\n", sample.n,
         RUNS);
  measure(&sample, "draw (with largest component and placement)", draw);
  measure(&sample, "canonical form", canonicalise);
  measure(&sample, "id (with canonical form)", spell);
  measure(&sample, "largest component of the XOR of two", keep_largest);
  measure(&sample, "placement", place);
  measure(&sample, "mutation", mutate);
  measure(&sample, "crossover", cross);
  measure(&sample, "insertion into a set of forms", insert);
  measure(&sample, "distinct stream, per draw", stream);
  measure(&sample, "body (masses and springs)", express);
  if (sample.sink == 1) /* practically never; makes the results needed */
    printf("\n");
  large_body();
  return EXIT_SUCCESS;
}
