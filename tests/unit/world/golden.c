/* golden.c: bits that must never change, because stored scores and seeds refer to them. A new hash
 * here is a new file format. */
#include "../make.h"

static void expect(const char *what, uint64_t actual, uint64_t expected)
{
  printf("# %s: %016llx\n", what, (unsigned long long)actual);
  CHECK(actual == expected);
}

static void bodies(void)
{
  const struct mo_workspace home = MO_DEFAULT_WORKSPACE;
  uint64_t placed = FNV_START, ids = FNV_START;
  for (uint64_t i = 0; i < 1000; i++) {
    struct mo_random random;
    uint64_t bits[MO_DEFAULT_WORDS];
    char id[MO_DEFAULT_ID_DIGITS + 1];
    mo_random_init(&random, 1, MO_PURPOSE_BODY, 0, i);
    REQUIRE(mo_genotype_random(home, &random, bits) == MO_OK);
    mo_genotype_id(home, bits, id);
    hash(&placed, bits, sizeof(bits));
    hash(&ids, id, MO_DEFAULT_ID_DIGITS);
  }
  expect("first 1000 random bodies", placed, UINT64_C(0x867d538b6eed327d));
  expect("their ids", ids, UINT64_C(0x4413e6cfe70d426c));
}

static void children(void)
{
  const struct mo_workspace home = MO_DEFAULT_WORKSPACE;
  uint64_t h = FNV_START;
  uint64_t parent[MO_DEFAULT_WORDS] = {0};
  for (uint64_t i = 0; i < 1000; i++) {
    struct mo_random random;
    uint64_t other[MO_DEFAULT_WORDS], child[MO_DEFAULT_WORDS] = {0};
    mo_random_init(&random, 2, MO_PURPOSE_BODY, 0, i);
    REQUIRE(mo_genotype_random(home, &random, other) == MO_OK);
    mo_genotype_crossover(home, parent, other, child);
    hash(&h, child, sizeof(child));
    mo_random_init(&random, 2, MO_PURPOSE_MUTATION, 5, i);
    mo_genotype_mutate(home, other, 0.02, &random, child);
    hash(&h, child, sizeof(child));
    memcpy(parent, other, sizeof(parent));
  }
  expect("1000 crossovers and mutations", h, UINT64_C(0x7067c1f79882edb6));
}

static void normals(void)
{
  uint64_t h = FNV_START;
  struct mo_random random = dice(3, 0, 0);
  for (int i = 0; i < 100000; i++) {
    double z = mo_random_normal(&random);
    hash(&h, &z, sizeof(z));
  }
  expect("100000 normal numbers", h, UINT64_C(0x531fde0565f5cc95));
}

/* Light and terrain: these environments have no task. */
static void hash_environment(uint64_t *h, const struct mo_environment *environment)
{
  CHECK(mo_task_is_plain(&environment->task));
  hash(h, environment, offsetof(struct mo_environment, task));
}

static void environments(void)
{
  struct mo_environment set[MO_PAPER_TEST_COUNT];
  mo_environment_paper_test(set);
  uint64_t h = FNV_START;
  for (int i = 0; i < MO_PAPER_TEST_COUNT; i++)
    hash_environment(&h, &set[i]);
  expect("paper test set", h, UINT64_C(0x6f554be07560e57d));
  h = FNV_START;
  for (uint64_t i = 0; i < 1000; i++) {
    struct mo_environment environment;
    mo_environment_training(1, 7, i, &environment);
    hash_environment(&h, &environment);
  }
  expect("1000 training environments", h, UINT64_C(0xd5d18799692b594e));
}

static void springs(void)
{
  struct mo_lattice *lattice = make_lattice(MO_DEFAULT_WORKSPACE);
  uint64_t h = FNV_START;
  hash(&h, lattice->spring_a, lattice->n_springs * sizeof(uint32_t));
  hash(&h, lattice->spring_b, lattice->n_springs * sizeof(uint32_t));
  expect("the default lattice's springs", h, UINT64_C(0x8a8694acbf9a5d55));
}

static const struct check_case cases[] = {
    {"random bodies and their ids", bodies}, {"children", children}, {"normal numbers", normals},
    {"environments", environments},          {"springs", springs},
};
CHECK_MAIN(cases)
