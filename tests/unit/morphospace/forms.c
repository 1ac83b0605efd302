/* forms.c: the set of forms compared with a sorted list, its memory, and the stream of distinct
 * bodies. */
#include "../make.h"

#include "morphospace/form_set.h"

static const struct mo_workspace home = {6, 6, 4};

static void set_is_exact(void)
{
  enum { N = 60000 };
  struct mo_form_set *set = NULL;
  REQUIRE(mo_form_set_create(home, &set) == MO_OK);
  /* Forms from a small range, so that about half of them repeat; a bit array records which were
   * seen. */
  static uint8_t seen[N];
  struct mo_random random = dice(51, 0, 0);
  uint64_t count = 0;
  int wrong = 0;
  for (int i = 0; i < N; i++) {
    uint32_t k = mo_random_below(&random, N / 2);
    uint64_t form[3] = {k + 1, k % 7 == 0 ? 0 : (uint64_t)k * k, k & 0xffff};
    wrong += mo_form_set_has(set, form) != seen[k];
    wrong += mo_form_set_add(set, form) != !seen[k];
    count += !seen[k];
    seen[k] = 1;
  }
  CHECK_INT(wrong, 0);
  CHECK_INT(mo_form_set_count(set), count);
  for (uint32_t k = 0; k < N / 2; k++) {
    uint64_t form[3] = {k + 1, k % 7 == 0 ? 0 : (uint64_t)k * k, k & 0xffff};
    wrong += mo_form_set_has(set, form) != seen[k];
  }
  CHECK_INT(wrong, 0);
  const uint64_t nothing[3] = {0};
  CHECK_INT(mo_form_set_add(set, nothing), MO_ERR_EMPTY);
  CHECK_INT(mo_form_set_has(set, nothing), 0);
  mo_form_set_free(set);
  mo_form_set_free(NULL);
  CHECK_INT(mo_form_set_create((struct mo_workspace){0, 1, 1}, &set), MO_ERR_RANGE);
}

static void set_of_other_workspaces(void)
{
  static const struct mo_workspace several[] = {
      {1, 1, 1}, {2, 2, 2}, {4, 4, 4}, {5, 5, 5}, {12, 12, 8}};
  for (size_t i = 0; i < COUNT(several); i++) {
    struct mo_form_set *set = make_form_set(several[i]);
    uint64_t form[18] = {0};
    uint32_t voxels = mo_workspace_voxels(several[i]);
    for (uint32_t v = 0; v < voxels; v++) {
      form[v / 64] |= UINT64_C(1) << v % 64;
      CHECK_INT(mo_form_set_has(set, form), 0);
      CHECK_INT(mo_form_set_add(set, form), 1);
      CHECK_INT(mo_form_set_add(set, form), 0);
      CHECK_INT(mo_form_set_has(set, form), 1);
    }
    CHECK_INT(mo_form_set_count(set), voxels);
  }
}

#define MANY 40000

/* Forms with many repetitions and some that are not to be added, one by one and all at once. */
static void set_of_many(void)
{
  const uint32_t threads[] = {1, 2, 7};
  static uint64_t forms[MANY][3], hashes[MANY];
  static uint8_t marks[MANY];
  for (int t = 0; t < 3; t++) {
    int wrong = 0;
    struct mo_random random = dice(52, 0, 0);
    struct mo_form_set *set = make_form_set(home);
    struct mo_form_set *plain = make_form_set(home);
    for (int part = 0; part < 2; part++) { /* the second time, half of them are already present */
      for (uint64_t i = 0; i < MANY; i++) {
        const uint64_t k = mo_random_below(&random, MANY / 2) + (uint64_t)part * (MANY / 4) + 1;
        forms[i][0] = k;
        forms[i][1] = k * k;
        forms[i][2] = k & 0xff;
        hashes[i] = mo_form_set_hash(set, forms[i]);
        marks[i] = k % 5 == 0 ? MO_FORM_OUT : MO_FORM_IN;
      }
      CHECK_INT(mo_form_set_add_many(set, forms[0], hashes, MANY, threads[t], marks), MO_OK);
      for (int i = 0; i < MANY; i++) {
        const int mark = forms[i][0] % 5 == 0                    ? MO_FORM_OUT
                         : mo_form_set_add(plain, forms[i]) == 1 ? MO_FORM_NEW
                                                                 : MO_FORM_IN;
        wrong += marks[i] != mark;
      }
      for (int i = 0; i < MANY; i++)
        wrong += mo_form_set_has(set, forms[i]) != (forms[i][0] % 5 != 0);
    }
    CHECK_INT(wrong, 0);
    CHECK_INT(mo_form_set_count(set), mo_form_set_count(plain));
    CHECK_INT(mo_form_set_bytes(set), mo_form_set_bytes(plain));
  }
}

/* At every size the set stays below 30 bytes per form: ten million fit in 300 MiB. */
static void set_is_small(void)
{
  struct mo_form_set *set = make_form_set(home);
  double worst = 0.0;
  for (uint64_t i = 0; i < 1000000; i++) {
    uint64_t form[3] = {i + 1, 0, 0};
    REQUIRE(mo_form_set_add(set, form) == 1);
    if (i > 50000) {
      double bytes = (double)mo_form_set_bytes(set) / (double)(i + 1);
      worst = bytes > worst ? bytes : worst;
      if (i % 1000 == 0) { /* known in advance */
        double estimated = (double)mo_form_set_estimate(home, i + 1) / (double)(i + 1);
        CHECK(estimated >= bytes && estimated < 2.0 * bytes);
      }
    }
  }
  printf("# at worst %.2f bytes per form\n", worst);
  CHECK(worst < 30.0 && worst > 18.0);
}

static void stream_is_distinct(void)
{
  enum { N = 3000 };
  struct mo_body_stream *stream = make_body_stream(home, 1);
  static uint64_t forms[N][3], bodies[N][3];
  int wrong = 0;
  for (int i = 0; i < N; i++) {
    uint64_t form[3];
    if (i % 1000 == 500) { /* the number of threads makes no difference at any point */
      REQUIRE(mo_body_stream_set_threads(stream, (uint32_t)i / 500) == MO_OK);
    }
    REQUIRE(mo_body_stream_next(stream, bodies[i], form) == MO_OK);
    mo_genotype_canonical(home, bodies[i], forms[i]);
    wrong += memcmp(form, forms[i], sizeof(form)) != 0;
  }
  for (int i = 0; i < N; i++)
    for (int j = 0; j < i; j++)
      wrong += memcmp(forms[i], forms[j], sizeof(forms[i])) == 0;
  CHECK_INT(wrong, 0);
  uint64_t draws = mo_body_stream_draws(stream);
  CHECK(draws > N);

  /* Its bodies are the plain draws, without those seen before. */
  struct mo_form_set *seen = make_form_set(home);
  int n = 0;
  for (uint64_t i = 0; i < draws; i++) {
    struct mo_random random;
    uint64_t bits[3], form[3];
    mo_random_init(&random, 1, MO_PURPOSE_BODY, 0, i);
    REQUIRE(mo_genotype_random(home, &random, bits) == MO_OK);
    mo_genotype_canonical(home, bits, form);
    if (mo_form_set_add(seen, form) == 1) {
      REQUIRE(n < N);
      wrong += memcmp(bits, bodies[n++], sizeof(bits)) != 0;
    }
  }
  CHECK_INT(n, N);
  CHECK_INT(wrong, 0);
  mo_body_stream_free(NULL);
}

/* 2 × 2 × 1 has four designs: one, two, three and four voxels. */
static void stream_runs_dry(void)
{
  struct mo_body_stream *stream = make_body_stream((struct mo_workspace){2, 2, 1}, 3);
  uint64_t bits;
  uint32_t sizes = 0;
  for (int i = 0; i < 4; i++) {
    REQUIRE(mo_body_stream_next(stream, &bits, NULL) == MO_OK);
    sizes |= 1U << mo_genotype_count((struct mo_workspace){2, 2, 1}, &bits);
  }
  CHECK_INT(sizes, 0x1e);
  bits = 77;
  CHECK_INT(mo_body_stream_next(stream, &bits, NULL), MO_ERR_EXHAUSTED);
  CHECK(bits == 77);
}

static const struct check_case cases[] = {
    {"the set is exact", set_is_exact},
    {"the set holds forms of any size", set_of_other_workspaces},
    {"many at once, on any number of threads", set_of_many},
    {"the set is small", set_is_small},
    {"the stream's bodies are distinct", stream_is_distinct},
    {"a small workspace runs out of bodies", stream_runs_dry},
};
CHECK_MAIN(cases)
