/* variation.c: random bodies, mutation and crossover: validity, rates, determinism. */
#include "plain.h"

static const struct mo_workspace home = {6, 6, 4};

static void random_bodies(void)
{
  static const struct mo_workspace several[] = {{6, 6, 4}, {1, 1, 1}, {2, 1, 1},
                                                {3, 5, 2}, {6, 4, 4}, {10, 10, 9}};
  for (size_t i = 0; i < COUNT(several); i++) {
    struct mo_workspace w = several[i];
    struct mo_random random = dice(41, 0, i);
    for (int round = 0; round < 500; round++) {
      uint64_t bits[16];
      REQUIRE(mo_genotype_random(w, &random, bits) == MO_OK);
      CHECK_INT(mo_genotype_is_contiguous(w, bits), 1);
      CHECK(is_placed(w, bits));
    }
  }
}

/* Without removal of duplicates: 37 masses, 171 springs, 10 voxels on average. */
static void averages(void)
{
  struct mo_lattice *lattice = make_lattice(home);
  const int n = 20000;
  double masses = 0, springs = 0, voxels = 0;
  for (int i = 0; i < n; i++) {
    struct mo_random random;
    uint64_t bits[3];
    mo_random_init(&random, 1, MO_PURPOSE_BODY, 0, (uint64_t)i);
    REQUIRE(mo_genotype_random(home, &random, bits) == MO_OK);
    struct mo_body *body = NULL;
    REQUIRE(mo_body_create(lattice, bits, &body) == MO_OK);
    masses += (double)body->n_masses / n;
    springs += (double)body->n_springs / n;
    voxels += (double)body->n_voxels / n;
    mo_body_free(body);
  }
  printf("# %d draws: %.2f masses, %.2f springs, %.2f voxels on average\n", n, masses, springs,
         voxels);
  CHECK_NEAR(masses, 37.0, 1.5);
  CHECK_NEAR(springs, 171.0, 8.0);
  CHECK_NEAR(voxels, 10.0, 0.6);
}

static void mutation(void)
{
  struct mo_random random = dice(42, 0, 0);
  for (int round = 0; round < 2000; round++) {
    uint64_t parent[3], child[3];
    REQUIRE(mo_genotype_random(home, &random, parent) == MO_OK);
    int code = mo_genotype_mutate(home, parent, 1.0 / 144, &random, child);
    if (code == MO_OK) {
      CHECK_INT(mo_genotype_is_contiguous(home, child), 1);
      CHECK(is_placed(home, child));
    } else {
      CHECK_INT(code, MO_ERR_EMPTY);
    }
  }
  /* Rate 0 returns the parent, rate 1 the largest component of its complement. */
  uint64_t parent[3], child[3] = {5, 5, 5};
  REQUIRE(mo_genotype_random(home, &random, parent) == MO_OK);
  CHECK_INT(mo_genotype_mutate(home, parent, 0.0, &random, child), MO_OK);
  CHECK(memcmp(parent, child, sizeof(parent)) == 0);
  const uint64_t full[3] = {UINT64_MAX, UINT64_MAX, 0xffff};
  memset(child, 5, sizeof(child));
  uint64_t before = child[0];
  CHECK_INT(mo_genotype_mutate(home, full, 1.0, &random, child), MO_ERR_EMPTY);
  CHECK(child[0] == before);
  const uint64_t nothing[3] = {0};
  CHECK_INT(mo_genotype_mutate(home, nothing, 1.0, &random, child), MO_OK);
  CHECK_INT(mo_genotype_count(home, child), 144);
  CHECK_INT(mo_genotype_mutate(home, parent, -0.1, &random, child), MO_ERR_RANGE);
  CHECK_INT(mo_genotype_mutate(home, parent, 1.1, &random, child), MO_ERR_RANGE);
  CHECK_INT(mo_genotype_mutate(home, parent, NAN, &random, child), MO_ERR_RANGE);
}

/* A body in the middle of a wide workspace grows by what is added at its faces. From a full body,
 * the missing voxels count the flips: a few flips cannot split it. */
static void mutation_rate(void)
{
  const uint64_t full[3] = {UINT64_MAX, UINT64_MAX, 0xffff};
  struct mo_random random = dice(43, 0, 0);
  const int n = 20000;
  double flips = 0.0;
  int unchanged = 0;
  for (int i = 0; i < n; i++) {
    uint64_t child[3];
    REQUIRE(mo_genotype_mutate(home, full, 1.0 / 144, &random, child) == MO_OK);
    uint32_t missing = 144 - mo_genotype_count(home, child);
    flips += missing;
    unchanged += missing == 0;
  }
  CHECK_NEAR(flips / n, 1.0, 5.0 / sqrt(n));
  CHECK_NEAR((double)unchanged / n, pow(1.0 - 1.0 / 144, 144), 4.0 * 0.5 / sqrt(n));
}

static void crossover(void)
{
  struct mo_random random = dice(44, 0, 0);
  for (int round = 0; round < 2000; round++) {
    uint64_t a[3], b[3], child[3] = {9, 9, 9}, reverse[3];
    REQUIRE(mo_genotype_random(home, &random, a) == MO_OK &&
            mo_genotype_random(home, &random, b) == MO_OK);
    CHECK_INT(mo_genotype_crossover(home, a, a, child), MO_ERR_EMPTY);
    CHECK(child[0] == 9 && child[1] == 9 && child[2] == 9);
    int code = mo_genotype_crossover(home, a, b, child);
    if (memcmp(a, b, sizeof(a)) == 0) {
      CHECK_INT(code, MO_ERR_EMPTY);
      continue;
    }
    REQUIRE(code == MO_OK);
    CHECK_INT(mo_genotype_is_contiguous(home, child), 1);
    CHECK(is_placed(home, child));
    const uint64_t differ[3] = {a[0] ^ b[0], a[1] ^ b[1], a[2] ^ b[2]};
    CHECK(mo_genotype_count(home, child) <= mo_genotype_count(home, differ));
    CHECK_INT(mo_genotype_crossover(home, b, a, reverse), MO_OK);
    CHECK(memcmp(child, reverse, sizeof(child)) == 0);
  }
}

static const struct check_case cases[] = {
    {"random bodies are valid and placed", random_bodies},
    {"random bodies have the known averages", averages},
    {"mutants are valid and placed", mutation},
    {"mutation flips at its rate", mutation_rate},
    {"crossover", crossover},
};
CHECK_MAIN(cases)
